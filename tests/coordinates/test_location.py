"""Points with their uncertainty: against Monte Carlo by the twin, refusals, sensitivities by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from support.bent_rig import (
    BENT,
    DRAWS,
    NO_NOISE_DEG,
    NOISE_DEG,
    NOMINAL,
    ROUNDING_MM,
    SD,
    TWIN_SIDE,
    calibration,
    twin_angle_deg,
    twin_points,
    twin_ray_at,
)
from support.waits import check_forward

from tvsbayes.calibration.drawn_looks import drawn
from tvsbayes.calibration.located_point import DIVERGING_SHARE
from tvsbayes.calibration.pointing import INPUT_NAMES, Calibration
from tvsbayes.coordinates.location import BLOCK, carry, locate, locate_linear, settings_of
from tvsbayes.errors import InputError

A_MM = 200.0


BENT_SETTINGS = ((130.0, 90.0, 60.0, ("left", "up")), (-60.0, -70.0, 70.0, ("right", "unknown")))


def cloud(one: Calibration, inputs, angle_noise_deg, reading_noise_deg, setting, place=None) -> np.ndarray:
    """Points (draws, 3) by the twin alone: gears, mirrors, frames, and bisection for the reading."""
    pan, tilt, reading, approach = setting
    rays = []
    for i, row in enumerate(inputs):
        values = dict(zip(INPUT_NAMES, row, strict=True))
        angles = []
        for axis, name in enumerate(("pan", "tilt")):
            where = place[i, axis] if approach[axis] == "unknown" else TWIN_SIDE[approach[axis]]
            steps = (pan, tilt)[axis]
            angles.append(
                twin_angle_deg(values, name, steps, where, one.period_deg.get(name)) + angle_noise_deg[i, axis]
            )
        rays.append(twin_ray_at(values, *angles))
    origin, direction = (np.array(part) for part in zip(*rays, strict=True))
    column = dict(zip(INPUT_NAMES, inputs.T, strict=True))
    true = reading - column["aperture_zero_deg"] - reading_noise_deg
    return twin_points(origin, direction, column["baseline_mm"], true, one.azimuth)


def stop_sd_deg(noise: np.ndarray, approach: tuple[str, str]) -> np.ndarray:
    """Standard deviations (draws, 2) of both stop errors; an unknown side takes the root mean square."""
    left, right, up, down = noise[:, :4].T
    pan = {"left": left, "right": right, "unknown": np.sqrt((left**2 + right**2) / 2)}[approach[0]]
    tilt = {"up": up, "down": down, "unknown": np.sqrt((up**2 + down**2) / 2)}[approach[1]]
    return np.stack([pan, tilt], axis=1)


def test_every_draw_goes_through_the_twins_optics(either):
    """The unit noises of a draw, put through the twin with its parameters, give that draw of the point."""
    sample = drawn(either, DRAWS, 4)
    unit = sample.noise
    assert np.abs(unit[:, 2:4]).max() <= 0.5
    for setting in BENT_SETTINGS:
        carried = carry(either, sample, settings_of(*setting[:3], setting[3]))
        assert np.isfinite(carried).all()
        stop = unit[:, :2] * stop_sd_deg(either.noise, setting[3])
        expected = cloud(either, either.inputs, stop, unit[:, 4] * either.noise[:, 4], setting, unit[:, 2:4])
        # Bisection of 1e5 mm: rounding of the angle, 1e-13 deg, times at most 100 mm per degree.
        np.testing.assert_allclose(carried[:, 0], expected, atol=100 * ROUNDING_MM)


def test_mean_and_covariance_are_a_monte_carlo_by_the_twin(either):
    """Same distribution, other draws of the noises: means and standard deviations within Monte Carlo errors."""
    rng = np.random.default_rng(12)
    for setting in BENT_SETTINGS:
        place = rng.uniform(-0.5, 0.5, (DRAWS, 2))
        stop = rng.standard_normal((DRAWS, 2)) * stop_sd_deg(either.noise, setting[3])
        points = cloud(either, either.inputs, stop, rng.standard_normal(DRAWS) * either.noise[:, 4], setting, place)
        point = locate(either, *setting, draws=DRAWS)
        assert point.refused == (None,) and point.draws == DRAWS
        sd = points.std(axis=0)
        # Five standard errors of the difference of two means, two variances and correlations, of DRAWS each.
        assert np.abs((point.xyz_mm[0] - points.mean(axis=0)) / sd).max() < 5 * math.sqrt(2 / DRAWS)
        distance = (point.covariance_mm2[0] - np.cov(points.T)) / np.outer(sd, sd)
        assert np.abs(distance).max() < 5 * math.sqrt(2 * 2 / DRAWS)
        interval = np.quantile(points, (0.025, 0.975), axis=0)
        # The error of an end is sqrt(0.025 0.975 / n) over the density 0.058 / sd there.
        assert np.abs((point.interval95_mm[0] - interval) / sd).max() < 5 * math.sqrt(2) * 2.67 / math.sqrt(DRAWS)
        np.testing.assert_allclose(point.u95_mm[0], np.diff(point.interval95_mm[0], axis=0)[0] / 2, rtol=1e-12)


def test_a_point_does_not_depend_on_its_neighbours():
    """260 points make many blocks; one alone makes a block of one."""
    assert 260 > 2 * BLOCK // DRAWS
    one = calibration()
    rng = np.random.default_rng(9)
    pan, tilt = rng.integers(-150, 150, (2, 260)).astype(float)
    reading = rng.uniform(40.0, 65.0, 260)
    approach = [("left", "up"), ("right", "down"), ("unknown", "up"), ("left", "unknown")] * 65
    reading[7] = 150.0
    waits = []
    many = locate(one, pan, tilt, reading, approach, draws=DRAWS, progress=waits.append)
    check_forward(waits)
    assert waits[-1].doing == f"locating: {len(pan)} of {len(pan)} points"
    assert [i for i, error in enumerate(many.refused) if error is not None] == [7]
    for i in (0, 7, 8, 255, 256, 259):
        single = locate(one, pan[i], tilt[i], reading[i], approach[i], draws=DRAWS)
        for name in ("xyz_mm", "covariance_mm2", "interval95_mm", "u95_mm", "linear_xyz_mm", "linear_covariance_mm2"):
            # Other vector lengths add in another order.
            np.testing.assert_allclose(
                getattr(single, name)[0], getattr(many, name)[i], rtol=1e-9, atol=ROUNDING_MM, err_msg=name
            )
        assert single.diverging_share[0] == many.diverging_share[i]
        np.testing.assert_array_equal(single.validation.validated[0], many.validation.validated[i])
    bad = many.refused[7]
    assert isinstance(bad, InputError) and bad.code == "diverging" and "aperture 150 deg" in bad.message
    for name in ("xyz_mm", "covariance_mm2", "interval95_mm", "u95_mm", "linear_xyz_mm", "linear_covariance_mm2"):
        assert np.isnan(getattr(many, name)[7]).all()
        assert np.isfinite(np.delete(getattr(many, name), 7, axis=0)).all()
    assert many.diverging_share[7] == 1.0
    again = locate(one, pan[:1], tilt[:1], reading[:1], approach[:1], draws=DRAWS, seed=1)
    assert not np.array_equal(again.xyz_mm[0], many.xyz_mm[0]), "the seed moves the noises"
    json.dumps([many.as_json(i) for i in (0, 7)], allow_nan=False)
    assert set(many.as_json(0)) >= {"xyz_mm", "covariance_mm2", "u95_mm"}
    refused = many.as_json(7)
    assert refused["xyz_mm"] is refused["covariance_mm2"] is refused["u95_mm"] is None
    assert refused["refused"]["code"] == "diverging"


def with_diverging(count: int) -> Calibration:
    """A nominal rig of DRAWS draws in which `count` have their C0 at 170 deg."""
    one = calibration(NOMINAL, {"pan_zero_emission_deg": 0.05}, NO_NOISE_DEG)
    inputs = one.inputs.copy()
    inputs[:count, INPUT_NAMES.index("pan_zero_emission_deg")] = 170.0
    return replace(one, inputs=inputs)


def test_the_law_alone_has_no_number_where_there_is_no_point():
    law = locate_linear(calibration(BENT, SD, NOISE_DEG), settings_of([100.0, 100.0], [20.0, 20.0], [70.0, 150.0]))
    for field in (law.value, law.jacobian, law.covariance):
        assert np.isfinite(field[0]).all() and np.isnan(field[1]).all()


@pytest.mark.parametrize(("count", "refused"), [(0, False), (1, False), (2, True), (DRAWS, True)])
def test_more_than_a_thousandth_of_diverging_draws_refuses(count, refused):
    """One of 1000 is exactly the allowed share."""
    assert DIVERGING_SHARE == 1 / DRAWS
    point = locate(with_diverging(count), 0.0, 0.0, 60.0, draws=DRAWS)
    assert (point.refused[0] is not None) == refused
    assert point.diverging_share[0] == pytest.approx(count / DRAWS, abs=1e-12)
    if not refused:
        # The point of the others: B = 60, C = 90, x = (a - L) tan 60; an outlier would carry it away.
        assert point.xyz_mm[0, 0] == pytest.approx(170.0 * math.tan(math.radians(60.0)), abs=0.05)


def test_impossible_arguments_are_refused():
    one = calibration()
    with pytest.raises(ValueError, match="at least 500"):
        locate(one, 0.0, 0.0, 60.0, draws=499)
    with pytest.raises(ValueError):
        locate(one, [0.0, 1.0], [0.0, 1.0, 2.0], 60.0, draws=DRAWS)
    with pytest.raises(InputError) as caught:
        locate(replace(one, inputs=one.inputs[:0], noise=one.noise[:0]), 0.0, 0.0, 60.0, draws=DRAWS)
    assert caught.value.code == "no-draws"
    with pytest.raises(InputError) as caught:
        locate(one, [0.0, 1.0], 0.0, 60.0, [("left", "up"), ("up", "left")], draws=DRAWS)
    assert (caught.value.code, caught.value.column) == ("approach", "pan_approach")


def test_draws_are_chosen_evenly_or_used_again():
    one = calibration(noise_spread=0.0)
    few, all_, more = (drawn(one, n, 0).inputs[:, : len(INPUT_NAMES)] for n in (500, DRAWS, DRAWS + 7))
    np.testing.assert_array_equal(few[[0, -1]], one.inputs[[0, -1]])
    assert len({tuple(row) for row in few}) == 500
    np.testing.assert_array_equal(all_, one.inputs)
    np.testing.assert_array_equal(more, np.concatenate([one.inputs, one.inputs[:7]]))
    noise = drawn(one, DRAWS + 7, 0).noise
    assert not np.any(noise[:7] == noise[DRAWS:]), "rows that come again get other noises"


def test_the_law_is_validated_near_and_refuted_far():
    # The law holds the sds of the noises still; here they are.
    small = {name: 0.02 * sd for name, sd in NOISE_DEG.items()}
    near = calibration(spread=0.02, noise_deg=small, noise_spread=0.0)
    point = locate(near, 130.0, 90.0, 60.0, draws=DRAWS)
    assert point.validation.validated.all()
    linear = point.as_json(0)["linear"]
    assert linear["validated"] is True and linear["digits"] == 2
    # C is 99 deg here: the point moves out to several metres, where u is a fair part of the range.
    far = locate(calibration(), 130.0, 0.0, 77.5, draws=DRAWS)
    assert far.refused == (None,) and far.linear_xyz_mm[0, 0] > 1500
    assert not far.validation.validated[0, 0] and far.validation.decided[0, 0]
    assert far.as_json(0)["linear"]["validated"] is False


C_DEG, B_DEG = 80.0, 75.0
"""Angles at which the sensitivities are checked; the beam leaves from the baseline, level."""


def sensitivities() -> dict[str, np.ndarray]:
    """Per degree of angle and per mm of a."""
    B, C = np.radians([B_DEG, C_DEG])
    s2, turn = math.sin(B + C) ** 2, math.pi / 180 * A_MM
    x = A_MM * math.sin(B) * math.sin(C) / math.sin(B + C)
    y = A_MM * (0.5 - math.sin(B) * math.cos(C) / math.sin(B + C))
    d_c = turn * np.array([math.sin(B) ** 2 / s2, math.sin(B) * math.cos(B) / s2, 0.0])
    d_b = turn * np.array([math.sin(C) ** 2 / s2, -math.sin(C) * math.cos(C) / s2, 0.0])
    return {
        "C": d_c,
        "B": d_b,
        "a": np.array([x, y, 0.0]) / A_MM,
        "tilt": np.array([0.0, 0.0, math.pi / 180 * x / math.sin(C)]),
    }

"""Errors of gears away from the looks: against dense Gaussian processes, written out once more."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.bent_rig import BENT, twin_points, twin_ray
from support.small_campaign import small_campaign

from tvsbayes.assessment.fitted_calibration import calibration_of_draws
from tvsbayes.assessment.gear_tables import Process, conditional, drawn_gears
from tvsbayes.calibration.optics import GEAR_INPUTS
from tvsbayes.calibration.pointing import NOISE_NAMES, Calibration
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.model.gear_processes import GearScales, place_root
from tvsbayes.twin.gear_errors import AxisErrors, matern_waves

AGREEMENT = 1e-8
"""Relative to the sd: a Cholesky factor and a solution of normal equations of condition 1e6."""
DRAWS = 1500
RATIO = {"pan": 0.06, "tilt": -0.07}


def dense(one: np.ndarray, other: np.ndarray, sd: float, length: float, wave: float, period: float) -> np.ndarray:
    """Covariance of a Matern process of smoothness 5/2 and a cosine of random phase (formulation 3.1)."""
    d = np.abs(one[:, None] - other[None, :])
    root = np.sqrt(5) * d / length
    return sd**2 * (1 + root + 5 * d**2 / (3 * length**2)) * np.exp(-root) + wave**2 * np.cos(2 * np.pi * d / period)


@pytest.mark.parametrize("wave", [0.0, 0.03])
def test_a_table_is_the_process_given_its_places(wave):
    """Mean and covariance of one draw at new angles are those of a dense Gaussian process (GPML 2.19)."""
    places, new = np.array([-9.0, -4.2, 0.0, 1.1, 6.0, 8.5]), np.linspace(-30.0, 30.0, 23)
    values = np.array([0.03, -0.02, 0.05, 0.04, -0.06, -0.01])
    one = Process(np.array([0.05]), np.array([7.0]), np.array([[wave]]), (25.0,))
    floor = 1e-10 * (0.05**2 + wave**2) * np.eye(len(places))
    prior = dense(places, places, 0.05, 7.0, wave, 25.0) + floor
    across = dense(new, places, 0.05, 7.0, wave, 25.0)
    table = conditional(one, places[None], values[None], new[None], np.zeros((1, len(new))))
    np.testing.assert_allclose(table.expected[0], across @ np.linalg.solve(prior, values), atol=AGREEMENT)
    assert np.all(table.left_open == 0)
    # As many equal draws as angles, with unit normals in turn: the factor of what is left open, column by column.
    count = len(new)
    same = Process(*(np.repeat(x, count, axis=0) for x in (one.sd, one.length, one.amplitudes)), one.periods)
    tiled = [np.tile(x, (count, 1)) for x in (places, values, new)]
    factor = conditional(same, *tiled, np.eye(count)).left_open
    left = dense(new, new, 0.05, 7.0, wave, 25.0) - across @ np.linalg.solve(prior, across.T)
    np.testing.assert_allclose(factor.T @ factor, left, atol=0.05 * AGREEMENT)


def fitted(steps: dict[str, list[float]], scales: dict[str, float], ratios: dict[str, float] = RATIO):
    """What `drawn_gears` reads of a fit: padded places, their prior's factor, the mode."""
    counters = np.array([*steps["pan"], *steps["tilt"], 0.0, 0.0])
    on_tilt = np.array([*(False for _ in steps["pan"]), *(True for _ in steps["tilt"]), False, False])
    valid = np.arange(len(counters)) < len(counters) - 2
    mode = np.array([TWO_MIRROR.priors[name].value if name in TWO_MIRROR.priors else 0.0 for name in TWO_MIRROR.names])
    for axis, ratio in ratios.items():
        mode[TWO_MIRROR.index[f"degrees_per_step.{axis}"]] = ratio
        for block, value in scales.items():
            mode[TWO_MIRROR.index[f"{block}.{axis}"]] = value
    rad = np.radians([scales["transmission_error_deg"]] * 2)
    shape = GearScales(
        rad,
        np.radians([scales["transmission_error_length_deg"]] * 2),
        np.radians([scales["play_variation_deg"]] * 2),
        np.zeros(2),
        np.zeros((2, 3)),
        np.full((2, 3), 2 * np.pi),
    )
    angle = np.radians(counters * np.where(on_tilt, ratios["tilt"], ratios["pan"]))
    root = place_root(shape, angle, on_tilt, valid)
    places = SimpleNamespace(steps=counters, on_tilt=on_tilt, valid=valid)
    fit = SimpleNamespace(
        space=SimpleNamespace(mechanism=TWO_MIRROR),
        arrays=SimpleNamespace(gears=SimpleNamespace(places=places, at_places=lambda errors: errors)),
        linearised=SimpleNamespace(place_root=root),
        mode=SimpleNamespace(physical=mode),
        campaign=SimpleNamespace(rig=SimpleNamespace(harmonic_period_deg={})),
    )
    return fit, mode, root


SCALES = {"transmission_error_deg": 0.05, "transmission_error_length_deg": 8.0, "play_variation_deg": 0.02}
STEPS = {"pan": [-200.0, -120.0, 0.0, 77.0, 210.0], "tilt": [-90.0, 0.0, 90.0, 140.0]}


@pytest.mark.parametrize("own_scales", [True, False])
def test_tables_hold_what_draws_hold_at_places_and_forget_it_beyond(own_scales):
    """At a place the draw's own value, but for interpolation (1.2 % of the sd); far away the process itself."""
    fit, mode, root = fitted(STEPS, SCALES)
    rng = np.random.default_rng(5)
    errors = rng.standard_normal((DRAWS, len(root))) @ root.T
    gears = drawn_gears(fit, np.tile(mode, (DRAWS, 1)), errors, 3, own_scales)
    drawn, half = gears.expected + gears.left_open, len(root) // 2
    for name in GEAR_INPUTS:
        kind, axis = name.split(".")
        block, first = (
            ("transmission_error_deg", 0) if kind.startswith("transmission") else ("play_variation_deg", half)
        )
        sd, places = (
            SCALES[block],
            first
            + np.flatnonzero(fit.arrays.gears.places.valid & (fit.arrays.gears.places.on_tilt == (axis == "tilt"))),
        )
        counters = np.array(STEPS[axis])
        at = gears.table.at(drawn, (counters, counters))[name]
        off = at - np.degrees(errors[:, places])
        assert np.sqrt(np.mean(off**2)) < 0.02 * sd, name
        part = gears.table.parts[name]
        nodes = np.array(gears.table.steps[axis == "tilt"])
        # Three lengths beyond: 400 steps of pan, and a standard deviation from 1500 draws is known to 2 %.
        reach = 3 * 8.0 / abs(RATIO[axis])
        assert nodes[0] == pytest.approx(counters.min() - reach) and nodes[-1] == pytest.approx(counters.max() + reach)
        for column in (part.start, part.stop - 2, part.stop - 1):
            assert np.std(drawn[:, column]) == pytest.approx(sd, rel=0.08), (name, column)
        assert abs(np.corrcoef(drawn[:, part.stop - 1], drawn[:, part.stop - 2])[0, 1]) < 5 / np.sqrt(DRAWS)
        np.testing.assert_allclose(drawn[:, part.stop - 1].mean(), 0, atol=1e-12)
    # At the scales of the mode the means follow the places by `by_places`.
    normal = np.linalg.solve(root, errors.T).T
    np.testing.assert_allclose(gears.expected, normal @ gears.by_places.T, atol=1e-6)


def test_every_draw_has_scales_of_its_own():
    """Draws of twice the sd scatter twice as much away from the looks, each with its length."""
    fit, mode, root = fitted(STEPS, SCALES)
    rng = np.random.default_rng(6)
    physical = np.tile(mode, (DRAWS, 1))
    large = np.arange(DRAWS) % 2 == 1
    physical[large, TWO_MIRROR.index["transmission_error_deg.pan"]] *= 2
    gears = drawn_gears(fit, physical, rng.standard_normal((DRAWS, len(root))) @ root.T, 3)
    part = gears.table.parts["transmission_error_at_deg.pan"]
    for column in (part.start, part.stop - 1):
        sds = [np.std(gears.left_open[rows, column]) for rows in (~large, large)]
        # Each known to 3 %.
        assert sds[1] / sds[0] == pytest.approx(2.0, rel=0.15)


TWINS, TWIN_DRAWS = 30, 200
POSES = {"seen": (77.0, 90.0), "between": (40.0, 45.0), "outside": (-500.0, -260.0), "beyond": (-900.0, 30.0)}
"""Counters (pan, tilt): places of `STEPS`, between them, half a table beyond, and beyond the table."""
READINGS_DEG = {"seen": 80.0, "between": 80.0, "outside": 95.0, "beyond": 110.0}


TRUE = {**BENT, "degrees_per_step.pan": 0.06, "degrees_per_step.tilt": 0.07}
RATIOS = {axis: TRUE[f"degrees_per_step.{axis}"] for axis in ("pan", "tilt")}


def twin_gears(number: int) -> list[AxisErrors]:
    """Errors of pan and tilt as the twin draws them."""
    rng = np.random.default_rng([7, number])
    sds = SCALES["transmission_error_deg"], SCALES["play_variation_deg"]
    length = SCALES["transmission_error_length_deg"]
    return [AxisErrors(*(matern_waves(sd, length, rng) for sd in sds)) for _ in RATIOS]


def calibrated(gears: list[AxisErrors], seed: int) -> Calibration:
    """A calibration of the true rig, except for errors of its gears away from the places."""
    fit, mode, _ = fitted(STEPS, SCALES, RATIOS)
    for name, value in {**TRUE, **dict.fromkeys(NOISE_NAMES, 1e-9)}.items():
        mode[TWO_MIRROR.index[name]] = value
    angles = [np.array(STEPS[axis]) * ratio for axis, ratio in RATIOS.items()]
    known = [
        np.concatenate([*(getattr(one, kind)(at) for one, at in zip(gears, angles, strict=True)), np.zeros(2)])
        for kind in ("error_deg", "play_deg")
    ]
    tiled = np.tile(mode, (TWIN_DRAWS, 1))
    drawn = drawn_gears(fit, tiled, np.tile(np.radians(np.concatenate(known)), (TWIN_DRAWS, 1)), seed)
    counters = np.array([[-200.0, 210.0], [-90.0, 140.0]])
    calibration = calibration_of_draws(TWO_MIRROR.names, tiled, small_campaign(), "posterior", 0, counters, drawn)
    return replace(calibration, azimuth=False, period_deg={})


def true_point(gears: list[AxisErrors], steps: tuple[float, float], reading_deg: float) -> np.ndarray:
    """Where the twin's beam, reached from left and up, meets the aperture's reading."""
    moved = []
    for one, n, ratio in zip(gears, steps, RATIOS.values(), strict=True):
        angle = np.array([n * ratio])
        moved.append(n + float(one.error_deg(angle)[0] - 0.5 * one.play_deg(angle)[0]) / ratio)
    origin, direction = twin_ray(TRUE, moved, ("left", "up"))
    true_deg = reading_deg - TRUE["aperture_zero_deg"]
    return twin_points(origin[None], direction[None], TRUE["baseline_mm"], true_deg, False)[0]


def test_located_points_of_twins_whose_gears_err():
    """Points where the twin's beam truly is, within the stated u; wider away from the looks, and marked so.

    The twin draws errors by waves and has mirrors and a meeting of beam and reading of its own.
    """
    scores: dict[str, list[np.ndarray]] = {name: [] for name in POSES}
    widths: dict[str, list[np.ndarray]] = {name: [] for name in POSES}
    for number in range(TWINS):
        gears = twin_gears(number)
        one = calibrated(gears, number)
        for name, steps in POSES.items():
            point = one.locate(*steps, READINGS_DEG[name])
            assert point.extrapolated is (name in ("outside", "beyond"))
            off = true_point(gears, steps, READINGS_DEG[name]) - point.xyz_mm
            scores[name].append(off / np.sqrt(np.diag(point.covariance_mm2)))
            widths[name].append(one.beam_u95_deg(steps, (1.0, 1.0)))
    near, between, outside, _ = (np.mean(widths[name], axis=0) for name in POSES)
    assert np.all(near < 0.2 * between) and np.all(between < 0.5 * outside)
    # Two angles err of each of 30 twins: RMS z to 9 %, and to a few more for the twin's sums of waves.
    for name in ("between", "outside", "beyond"):
        assert 0.7 < np.sqrt(np.mean(np.square(scores[name]))) < 1.35, name

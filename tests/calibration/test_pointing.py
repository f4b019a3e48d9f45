"""What a robot loads: rays, points, counters and files of a calibration, against the twin's optics and JAX."""

from __future__ import annotations

import io
import json
import math
import shutil
import subprocess
import sys
import zipfile
from dataclasses import fields, replace
from itertools import product

import jax
import numpy as np
import pytest
from promises.test_conventions import LAST_6, LAST_9, LAST_12, VECTOR
from support.bent_rig import (
    AXES,
    BENT,
    NO_NOISE_DEG,
    NOMINAL,
    WOBBLE,
    calibration,
    twin_angle_deg,
    twin_points,
    twin_ray,
    twin_ray_at,
)
from support.small_campaign import small_campaign

from tvsbayes.assessment.fitted_calibration import CLEARED_PROBABILITY, _overshoot_steps, calibration_of_draws
from tvsbayes.calibration.calibration_file import (
    CALIBRATION_FORMAT,
    NO_CALIBRATION,
    calibration_bytes,
    calibration_header,
    calibration_json,
    expected_error,
    load_calibration,
    stored_calibration,
)
from tvsbayes.calibration.optics import output_deg, range_components, unit_vector
from tvsbayes.calibration.pointing import DIVERGING_SHARE, INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.coordinates.beam_meeting import carry, meeting, sources
from tvsbayes.coordinates.location import locate, locate_linear, settings_of
from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import input_hashes
from tvsbayes.instrument.parameters import HARMONIC_NAMES, Prior
from tvsbayes.statistics.intervals import NORMAL_95
from tvsbayes.twin import physics
from tvsbayes.twin.physics import to_tvs

ROUNDING_MM = 1e-9
"""Of a hundred operations on lengths up to 1000 mm, magnified tenfold by a grazing line of sight."""
ROUNDING = 1e-12
"""Of a hundred operations on numbers of order 1."""
SIDES = tuple(product(("left", "right", "unknown"), ("up", "down", "unknown")))
PERIODS_DEG = {"pan": 360.0, "tilt": 40.0}
"""The wheel's error on one axis, the pinion's on the other."""
POSES = ((130.0, 90.0, 66.0), (-60.0, -70.0, 75.0))
"""Counters and readings of two points 300 to 700 mm away."""


@pytest.fixture(scope="module")
def bent() -> Calibration:
    return calibration()


@pytest.fixture(scope="module")
def wobbling() -> Calibration:
    """Transmission errors on both axes, aperture readings as azimuths."""
    return calibration(BENT | WOBBLE, azimuth=True, period_deg=PERIODS_DEG)


def refusal(call) -> InputError:
    with pytest.raises(InputError) as caught:
        call()
    return caught.value


@pytest.mark.parametrize("approach", SIDES)
@pytest.mark.parametrize("periods", [{}, {"pan": 360.0, "tilt": 40.0}, {"pan": 25.0, "tilt": 360.0}])
def test_ray_is_the_twins(approach, periods):
    values = BENT | (WOBBLE if periods else {})
    one = calibration(values, {}, period_deg=periods)
    for steps in ((0, 0), (200, 100), (-350, 210), (777, -300)):
        ray = one.ray(*steps, approach=approach)
        origin, direction = twin_ray(values, steps, approach, periods)
        np.testing.assert_allclose(ray.origin_mm, origin, atol=ROUNDING_MM)
        np.testing.assert_allclose(ray.direction, direction, atol=ROUNDING)


def test_ray_of_the_test_vector():
    """DESIGN 3.2: psi 10 deg, beta 5 deg; 250 mm along the beam with C0 91 deg and a 200 mm."""
    values = NOMINAL | VECTOR | {"pan_zero_emission_deg": 91.0, "degrees_per_step.pan": 0.05}
    values |= {"degrees_per_step.tilt": 0.05}
    one = calibration(values, {})
    ray = one.ray(200, 100)
    printed = np.array([250.365237, 119.492704, 18.238043])
    assert np.abs(ray.origin_mm + 250.0 * ray.direction - printed).max() <= LAST_6 * 1.01
    # Turned back into frame P.
    turned = to_tvs(np.stack([ray.origin_mm - [0, 100, 0], ray.direction]), 0.0, 89.0)
    assert np.abs(turned[0] - [5.371658918, -29.176887333, -0.940368833]).max() <= LAST_9 * 1.01
    assert np.abs(turned[1] - [0.981182562588, 0.177188586189, 0.076713648059]).max() <= LAST_12 * 1.01
    for azimuth, reading in ((False, 48.834423), (True, 48.759278)):
        found = replace(one, azimuth=azimuth).locate(200, 100, reading).xyz_mm
        # Half a unit of the last digit of the reading moves the point by a sin(C) / sin(B + C)^2 = 14 mm per degree.
        assert np.abs(found - printed).max() <= LAST_6 + 14.0 * LAST_6


def test_sides_differ_by_the_play(bent):
    """Arriving from the left needs b / k more steps than from the right for the same beam."""
    for axis, negative, positive in (("pan", "right", "left"), ("tilt", "down", "up")):
        play_steps = bent.estimates[f"backlash_deg.{axis}"] / bent.estimates[f"degrees_per_step.{axis}"]
        steps = np.array([100.0, 50.0])
        shifted = steps + play_steps * (np.array(AXES) == axis)
        approach = {"pan": "unknown", "tilt": "unknown"}
        one = bent.ray(*shifted, approach=tuple((approach | {axis: positive}).values()))
        other = bent.ray(*steps, approach=tuple((approach | {axis: negative}).values()))
        np.testing.assert_allclose(one.direction, other.direction, atol=ROUNDING)
    azimuth = [math.atan2(d[1], d[0]) for d in (bent.ray(9, 0, (side, "up")).direction for side in ("right", "left"))]
    # The pan turns the beam nearly one to one: 2 % for a degree of misalignment, five times what the rig has.
    assert math.degrees(azimuth[0] - azimuth[1]) == pytest.approx(bent.estimates["backlash_deg.pan"], rel=0.1)


def test_transmission_error_is_that_of_wheel_or_pinion(wobbling):
    """The wheel's error follows the output, which the play shifts; the pinion's the driving angle."""
    for axis, side in product(AXES, (1.0, -1.0, 0.0)):
        for steps in (-211, 0, 55, 180):
            found = output_deg(wobbling.estimates, axis, steps, side, PERIODS_DEG[axis])
            expected = twin_angle_deg(wobbling.estimates, axis, steps, -side / 2, PERIODS_DEG[axis])
            assert found == pytest.approx(expected, abs=ROUNDING * 100)
    values = wobbling.estimates
    ratio, play = values["degrees_per_step.pan"], values["backlash_deg.pan"]
    gap = [output_deg(values, "pan", 55, side, 360.0) - (ratio * 55 - side * play / 2) for side in (1, -1)]
    assert abs(gap[0] - gap[1]) > 1e-4, "the wheel's error differs between the sides"


@pytest.mark.parametrize("rig", ["bent", "wobbling"])
@pytest.mark.parametrize("approach", [("left", "up"), ("right", "unknown"), ("unknown", "down")])
def test_locate_is_where_the_twin_reads_the_same_angle(rig, approach, request):
    one = request.getfixturevalue(rig)
    for pan, tilt, reading in POSES:
        origin, direction = twin_ray(one.estimates, (pan, tilt), approach, one.period_deg)
        true = reading - one.estimates["aperture_zero_deg"]
        expected = twin_points(origin[None], direction[None], one.estimates["baseline_mm"], true, one.azimuth)[0]
        # Bisection of 1e5 mm ends at rounding of the angle: 1e-13 deg times 100 mm per degree.
        np.testing.assert_allclose(one.locate(pan, tilt, reading, approach).xyz_mm, expected, atol=10 * ROUNDING_MM)


@pytest.mark.parametrize("rig", ["bent", "wobbling"])
def test_locate_is_the_law_of_propagation_in_jax(rig, request):
    one = request.getfixturevalue(rig)
    asked = [(*pose, side) for pose in POSES for side in SIDES]
    pan, tilt, reading = np.array([a[:3] for a in asked]).T
    law = locate_linear(one, settings_of(pan, tilt, reading, [a[3] for a in asked]))
    for i, (pan, tilt, reading, approach) in enumerate(asked):
        found = one.locate(pan, tilt, reading, approach)
        np.testing.assert_allclose(found.xyz_mm, law.value[i], atol=ROUNDING_MM)
        scale = np.sqrt(np.outer(np.diag(law.covariance[i]), np.diag(law.covariance[i])))
        assert np.abs((found.covariance_mm2 - law.covariance[i]) / scale).max() < 100 * ROUNDING
        np.testing.assert_allclose(found.u95_mm, NORMAL_95 * np.sqrt(np.diag(found.covariance_mm2)), rtol=ROUNDING)


@pytest.mark.parametrize("rig", ["bent", "wobbling"])
def test_derivatives_are_the_jacobian_of_jax(rig, request):
    """Of every input that varies and unit noise, an unknown place in the play before the wheel's error included."""
    one = request.getfixturevalue(rig)
    varies = np.diag(one.covariance_with_noise) > 0
    assert varies.sum() >= 20
    for pose, side in product(POSES, SIDES):
        expected = locate_linear(one, settings_of(*pose, side)).jacobian[0][:, varies]
        found = one.derivatives(*pose, side)[:, varies]
        np.testing.assert_allclose(found, expected, rtol=ROUNDING, atol=ROUNDING * np.abs(expected).max())


@pytest.mark.parametrize("azimuth", [False, True])
def test_ranges_are_those_of_jax_from_anywhere(azimuth):
    """Beams from all around: those that meet only the other nappe of the aperture's cone meet nothing."""
    rng = np.random.default_rng(1)
    origin = rng.normal(size=(3, 2000)) * 60 + np.array([[0.0], [100.0], [0.0]])
    direction = rng.normal(size=(3, 2000))
    direction /= np.linalg.norm(direction, axis=0)
    angle_deg = rng.uniform(1, 179, 2000)
    with jax.enable_x64(True):
        arrays = [jax.numpy.asarray(x) for x in (origin, direction, 200.0, np.radians(angle_deg), azimuth)]
        expected = meeting(*arrays)
    meets = np.asarray(expected.meets)
    assert 400 < meets.sum() < 1600
    found = range_components(tuple(origin), tuple(direction), 200.0, angle_deg, azimuth)
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(found > 0, meets)
    np.testing.assert_allclose(found[meets], np.asarray(expected.range_mm)[meets], rtol=1e3 * ROUNDING)
    for k in range(100):
        single = range_components(
            tuple(origin[:, k].tolist()), tuple(direction[:, k].tolist()), 200.0, angle_deg[k], azimuth, math
        )
        assert single == pytest.approx(found[k], rel=1e3 * ROUNDING, nan_ok=True)


@pytest.mark.parametrize("azimuth", [False, True])
def test_numpy_and_jax_refuse_the_same_settings(azimuth):
    """Random settings all around the machine: beams that miss, diverge, graze, run backwards."""
    one = calibration(BENT, {}, NO_NOISE_DEG, azimuth=azimuth)
    rng = np.random.default_rng(5)
    pan, tilt = rng.uniform(-3000, 3000, 256), rng.uniform(-900, 900, 256)
    reading = rng.uniform(0.5, 179.5, 256)
    with jax.enable_x64(True):
        found = carry(settings_of(pan, tilt, reading), sources(one, 1, 0))
    meets = np.asarray(found.meets)[0]
    assert 30 < meets.sum() < 226
    codes = set()
    for i in range(256):
        try:
            point = one.locate(pan[i], tilt[i], reading[i]).xyz_mm
        except InputError as error:
            codes.add(error.code)
            assert not meets[i], (pan[i], tilt[i], reading[i])
        else:
            assert meets[i], (pan[i], tilt[i], reading[i], point)
    assert codes == ({"diverging"} if azimuth else {"diverging", "grazing"})


@pytest.mark.parametrize("azimuth", [False, True])
@pytest.mark.parametrize("reading", [0.0, 180.0, math.nan, math.inf, 89.99, 179.0])
def test_an_impossible_reading_is_refused(azimuth, reading):
    """Exact zeros of the nominal rig are no accident of the arithmetic: level beam, reading along the baseline."""
    one = calibration(NOMINAL, {}, NO_NOISE_DEG, azimuth=azimuth)
    steps = 0 if reading != 89.99 else 200
    error = refusal(lambda: one.locate(steps, 0, reading))
    assert error.code in ("diverging", "grazing")
    assert error.column == "aperture_deg" and error.remedy and error.allowed


def test_a_beam_along_the_line_of_sight_is_refused():
    """Nominal rig, B + C = 180 deg exactly: no range, and no division by zero."""
    for azimuth in (False, True):
        one = calibration(NOMINAL, {}, azimuth=azimuth)
        assert refusal(lambda one=one: one.locate(500, 0, 60.0)).code == "diverging"


def test_points_that_too_many_draws_lose_are_refused_as_by_the_draws(bent):
    """DESIGN 5: more than 0.1 % of draws diverge. The law of propagation asks range and u, the other counts draws."""
    rng = np.random.default_rng(4)
    count = 4000
    inputs = np.array([NOMINAL[name] for name in INPUT_NAMES]) + np.zeros((count, 1))
    sds = {"pan_zero_emission_deg": 0.2, "baseline_mm": 0.5, "degrees_per_step.pan": 1e-4}
    for name, sd in sds.items():
        inputs[:, INPUT_NAMES.index(name)] += sd * rng.standard_normal(count)
    noise = np.full((count, len(NOISE_NAMES)), 0.05)
    drawn = replace(
        calibration(NOMINAL, {}, NO_NOISE_DEG),
        mean=inputs.mean(axis=0),
        covariance=np.cov(inputs, rowvar=False),
        noise_variance=dict.fromkeys(NOISE_NAMES, 0.05**2),
        inputs=inputs,
        noise=noise,
    )
    for reading, meets in ((57.0, True), (59.0, True), (59.6, False), (59.9, False)):
        share = locate(drawn, 500.0, 0.0, reading, draws=count).diverging_share[0]
        assert (share <= DIVERGING_SHARE) == meets, (reading, share)
        if meets:
            assert np.isfinite(drawn.locate(500, 0, reading).u95_mm).all()
        else:
            assert refusal(lambda reading=reading: drawn.locate(500, 0, reading)).code == "diverging"


def test_unknown_approaches_are_refused(bent):
    for approach, axis in ((("up", "up"), "pan"), (("left", "left"), "tilt"), (("left", "\x1b[31m"), "tilt")):
        for call in (
            lambda a=approach: bent.ray(0, 0, a),
            lambda a=approach: bent.locate(0, 0, 70.0, a),
            lambda a=approach: bent.steps_for((500, 0, 0), approach=a),
        ):
            error = refusal(call)
            assert (error.code, error.column) == ("approach", f"{axis}_approach")
            assert "\x1b" not in error.message + error.found


GRID = tuple(product((200.0, 350.0, 700.0, 1500.0), (-200.0, -50.0, 100.0, 200.0), (-150.0, 0.0, 60.0, 150.0)))


@pytest.mark.parametrize("rig", ["bent", "wobbling"])
def test_steps_for_a_point_come_back_to_it(rig, request):
    one = request.getfixturevalue(rig)
    for target in GRID:
        steps = one.steps_for(target)
        assert steps.approach == ("left", "up")
        counters = (steps.pan_steps, steps.tilt_steps)
        ray = one.ray(*counters, steps.approach)
        np.testing.assert_array_equal(steps.ray.direction, ray.direction)
        found = one.locate(*counters, steps.aperture_deg, steps.approach).xyz_mm
        # The reading's rounding of 1e-14 of 100 deg, times at most 700 mm per degree at 1.5 m.
        assert np.abs(found - steps.xyz_mm).max() < 1e-6
        across = target - steps.xyz_mm
        assert abs(across @ ray.direction) < ROUNDING_MM * 10
        assert steps.rounding_mm == pytest.approx(np.linalg.norm(across), rel=1e-12)
        # Half a step of each axis in mm across the beam, here; the step's own curvature is 0.0005 rad of it.
        reach = (steps.xyz_mm - ray.origin_mm) @ ray.direction
        half_mm = 0.0
        for axis in range(2):
            corners = [one.ray(*(np.array(counters) + s * 0.5 * np.eye(2)[axis]), steps.approach) for s in (1, -1)]
            moved = [c.origin_mm + reach * c.direction - steps.xyz_mm for c in corners]
            half_mm += max(np.linalg.norm(m - (m @ ray.direction) * ray.direction) for m in moved)
        assert steps.rounding_mm <= half_mm * 1.001
        assert steps.rounding_deg is None and steps.u95_deg is None


def test_steps_for_a_direction(bent):
    for azimuth, elevation in ((0.0, 0.0), (25.0, -12.0), (-40.0, 30.0)):
        steps = bent.steps_for(azimuth_deg=azimuth, elevation_deg=elevation)
        d = steps.ray.direction
        gone = [math.degrees(math.atan2(d[1], d[0])) - azimuth, math.degrees(math.asin(d[2])) - elevation]
        # Half a step of 0.0621 and 0.0704 deg, and 5 % for the crosstalk of a bent rig at 30 deg of elevation.
        assert abs(gone[0]) < 0.05 * 0.0704 + 0.5 * 0.0621 * 1.05
        assert abs(gone[1]) < 0.05 * 0.0621 + 0.5 * 0.0704 * 1.05
        wanted = unit_vector(azimuth, elevation)
        # The cosine loses half of the digits.
        assert steps.rounding_deg == pytest.approx(math.degrees(math.acos(min(1.0, wanted @ d))), abs=1e-5)
        assert steps.xyz_mm is None and steps.aperture_deg is None and steps.u95_mm is None
        assert steps.u95_deg.shape == (2,)


def test_half_widths_of_the_beam_are_the_draws(bent):
    """Every draw's beam with its own stop error, by the twin; 95 % of a normal distribution."""
    steps = bent.steps_for((700.0, 30.0, 60.0))
    reach = (steps.xyz_mm - steps.ray.origin_mm) @ steps.ray.direction
    stop = np.random.default_rng(8).standard_normal((len(bent.inputs), 2)) * np.sqrt(
        [bent.noise_variance["stop_sd_deg.left"], bent.noise_variance["stop_sd_deg.up"]]
    )
    points, angles = [], []
    for row, error in zip(bent.inputs, stop, strict=True):
        values = dict(zip(INPUT_NAMES, row, strict=True))
        pan = twin_angle_deg(values, "pan", steps.pan_steps, -0.5) + error[0]
        tilt = twin_angle_deg(values, "tilt", steps.tilt_steps, -0.5) + error[1]
        o, d = twin_ray_at(values, pan, tilt)
        points.append(o + reach * d)
        angles.append(np.degrees([math.atan2(d[1], d[0]), math.asin(d[2])]))
    directions = bent.steps_for(azimuth_deg=angles[0][0], elevation_deg=angles[0][1])
    # Five standard errors sqrt(1 / 2n) of a standard deviation; the angles' u hardly depends on the pose.
    bound = 5 * math.sqrt(0.5 / len(points)) + 0.01
    np.testing.assert_allclose(steps.u95_mm, NORMAL_95 * np.std(points, axis=0), rtol=bound)
    np.testing.assert_allclose(directions.u95_deg, NORMAL_95 * np.std(angles, axis=0), rtol=bound)


def test_the_approach_is_obeyed_or_the_other_side_is_taken(bent):
    target = (600.0, 40.0, 50.0)
    free = bent.steps_for(target)
    for approach in product(("left", "right"), ("up", "down")):
        steps = bent.steps_for(target, approach=approach)
        assert steps.approach == approach
        signs = [-1 if side in ("left", "up") else 1 for side in approach]
        assert steps.via_pan_steps == steps.pan_steps + signs[0] * bent.overshoot_steps["pan"]
        assert steps.via_tilt_steps == steps.tilt_steps + signs[1] * bent.overshoot_steps["tilt"]
        # The other side's counter stands b / k steps lower: the same beam within the rounding of both.
        play_steps = bent.estimates["backlash_deg.pan"] / bent.estimates["degrees_per_step.pan"]
        assert abs(free.pan_steps - steps.pan_steps - play_steps * (approach[0] == "right")) <= 1.0
    # From the left the pan would start below `low`.
    low = free.pan_steps - bent.overshoot_steps["pan"] + 1
    other = bent.steps_for(target, limits={"pan": (low, 1000)})
    assert other.approach == ("right", "up")
    assert other.pan_steps >= low and other.via_pan_steps > other.pan_steps
    edge = bent.steps_for(target, limits={"pan": (low - 1, 1000)})
    assert edge.approach == ("left", "up"), "a limit itself may be reached"
    error = refusal(lambda: bent.steps_for(target, limits={"pan": (low, 1000)}, approach=("left", "up")))
    assert (error.code, error.column) == ("outside-limits", "pan")
    assert error.found == f"{free.pan_steps} and {low - 1}" and error.allowed == f"{low} to 1000"


def test_targets_out_of_limits_or_reach_are_refused(bent):
    error = refusal(lambda: bent.steps_for((600.0, 40.0, 200.0), limits={"tilt": (-50, 50)}))
    assert (error.code, error.column, error.allowed) == ("outside-limits", "tilt", "-50 to 50") and error.remedy
    for target in ((0.0, 100.0, 0.0), (math.nan, 0.0, 0.0), (5.0, 80.0, 900.0), (-400.0, 50.0, 10.0)):
        error = refusal(lambda target=target: bent.steps_for(target))
        assert error.code == "out-of-reach" and error.allowed and error.remedy
    for azimuth, elevation in ((0.0, 95.0), (math.inf, 0.0), (95.0, 0.0)):
        wanted = {"azimuth_deg": azimuth, "elevation_deg": elevation}
        assert refusal(lambda wanted=wanted: bent.steps_for(**wanted)).code == "out-of-reach"
    point = {"xyz_mm": (600.0, 40.0, 0.0)}
    both = {"azimuth_deg": 1.0, "elevation_deg": 1.0}
    for wanted in (
        {},
        {"azimuth_deg": 1.0},
        point | both,
        point | {"azimuth_deg": 40.0},
        point | {"elevation_deg": 1.0},
    ):
        assert refusal(lambda wanted=wanted: bent.steps_for(**wanted)).code == "no-target"


def play_gone(one: Calibration, axis: str, start: int, end: int, sign: int) -> float:
    """Share of the draws in which a move takes up all play, from its worst state, by the twin's gear."""
    gone = []
    for row in one.inputs:
        values = dict(zip(INPUT_NAMES, row, strict=True))
        ratio, play = values[f"degrees_per_step.{axis}"], values[f"backlash_deg.{axis}"]
        output = physics.play([ratio * start, ratio * end], ratio * start + sign * play / 2, play)[-1]
        gone.append(abs(output - (ratio * end - sign * play / 2)) < 1e-9)
    return float(np.mean(gone))


@pytest.mark.parametrize("approach", [("left", "up"), ("right", "down")])
def test_the_way_over_via_takes_up_all_play(bent, approach):
    assert CLEARED_PROBABILITY == 0.99
    column = {name: bent.inputs[:, i] for i, name in enumerate(INPUT_NAMES)}
    one = replace(bent, overshoot_steps={axis: _overshoot_steps(column, axis) for axis in AXES})
    steps = one.steps_for((600.0, 40.0, 50.0), approach=approach)
    for axis, side in zip(AXES, approach, strict=True):
        sign = 1 if side in ("left", "up") else -1
        via, end = (getattr(steps, f"{way}{axis}_steps") for way in ("via_", ""))
        assert play_gone(one, axis, via, end, sign) >= CLEARED_PROBABILITY
        assert play_gone(one, axis, via + sign, end, sign) < CLEARED_PROBABILITY


def test_covers_the_counters_of_the_campaign(bent):
    assert bent.covers(400, -300) and not bent.covers(401, 0) and not bent.covers(0, 301)


def test_steps_as_json_are_plain(bent):
    document = bent.steps_for((600.0, 40.0, 50.0)).as_json()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["approach"] == {"pan": "left", "tilt": "up"}
    assert set(document["ray"]) == {"origin_mm", "direction"}


def drawn(campaign, draws=4000):
    """`calibration_of_draws` of normal draws in an order of columns of its own, with names it does not need."""
    bent = calibration(draws=draws)
    names = ("pixel_scale", *reversed((*INPUT_NAMES, *NOISE_NAMES)))
    physical = np.concatenate([bent.inputs, bent.noise], axis=1)[:, ::-1]
    physical = np.column_stack([np.full(draws, 7.0), physical])
    return bent, calibration_of_draws(names, physical, campaign, "laplace", 3)


def test_calibration_of_draws_takes_its_columns():
    campaign = small_campaign()
    bent, one = drawn(campaign)
    np.testing.assert_array_equal(one.inputs, bent.inputs)
    np.testing.assert_array_equal(one.noise, bent.noise)
    np.testing.assert_allclose(one.mean, bent.inputs.mean(axis=0), rtol=ROUNDING)
    np.testing.assert_allclose(one.covariance, np.cov(bent.inputs.T), atol=ROUNDING)
    # Mean of the squares, not square of the mean: a variance adds up in variances.
    assert one.noise_variance["aperture_sd_deg"] == pytest.approx((bent.noise[:, 4] ** 2).mean(), rel=ROUNDING)
    assert one.azimuth and one.estimator == "laplace" and one.causes == ()
    np.testing.assert_array_equal(one.range_steps, [[-100, 200], [-7, 120]])
    assert one.inputs_sha256 == input_hashes(campaign)
    play_steps = bent.inputs[:, 2] / bent.inputs[:, 0]
    least = one.overshoot_steps["pan"]
    assert (play_steps <= least).mean() >= 0.99 > (play_steps <= least - 1).mean()


def test_the_apertures_noise_takes_its_prior_without_readings():
    """A sampler holds it still; its log-normal prior has E s^2 = m^2 exp(2 u^2)."""
    campaign = small_campaign()
    priors = campaign.rig.priors | {"aperture_sd_deg": Prior(0.02, 0.8, "log-normal")}
    unread = tuple(replace(spot, aperture_deg=None) for spot in campaign.spots)
    one = drawn(replace(campaign, spots=unread, rig=replace(campaign.rig, priors=priors)))[1]
    # 4000 draws of exp(1.6 w): sd of the mean is sqrt(exp(2.56) - 1) / sqrt(4000) = 5.5 % of it.
    assert one.noise_variance["aperture_sd_deg"] == pytest.approx(0.02**2 * np.exp(2 * 0.8**2), rel=4 * 0.055)


def test_what_only_readings_tell_takes_its_prior_without_them():
    campaign = small_campaign()
    silent = replace(campaign, spots=tuple(replace(s, aperture_deg=None) for s in campaign.spots))
    _, one = drawn(silent)
    for name in ("baseline_mm", "pan_zero_emission_deg", "aperture_zero_deg"):
        prior, column = silent.rig.priors[name], one.inputs[:, INPUT_NAMES.index(name)]
        assert prior.u > 0
        assert column.mean() == pytest.approx(prior.value, abs=1e-9)
        assert column.std() == pytest.approx(prior.u, rel=1e-9)
    _, again = drawn(silent)
    np.testing.assert_array_equal(one.inputs, again.inputs)


def differing(one: Calibration, other: Calibration, without: tuple[str, ...] = ()) -> list[str]:
    """Names of the fields that are not the same to the last bit, arrays in float64."""

    def equal(a: object, b: object) -> bool:
        if isinstance(a, np.ndarray):
            return b.dtype == np.float64 and np.array_equal(a, b)
        return a == b

    names = (f.name for f in fields(Calibration) if f.name not in without)
    return [name for name in names if not equal(getattr(one, name), getattr(other, name))]


def complete() -> Calibration:
    """Every field holds something that could get lost."""
    one = calibration(BENT | WOBBLE, azimuth=True, period_deg=PERIODS_DEG, draws=60)
    parts = np.stack([0.25 * one.covariance, 0.75 * one.covariance])
    return replace(one, causes=("pixel noise", "stereo"), cause_covariance=parts, estimator="laplace")


def test_draws_file_brings_everything_back(tmp_path):
    one = complete()
    (tmp_path / "results").mkdir()
    path = tmp_path / "results" / "draws.npz"
    path.write_bytes(calibration_bytes(one, physical=np.zeros((3, 65))))
    for asked in (tmp_path, str(tmp_path), tmp_path / "results", path):
        assert differing(one, load_calibration(asked)) == []


def test_results_without_a_calibration_are_no_damage(tmp_path):
    """A fit that did not converge, or an older version, leaves draws alone: such results are as good as none."""
    campaign = replace(small_campaign(), path=tmp_path)
    (tmp_path / "results").mkdir()
    np.savez_compressed(tmp_path / "results" / "draws.npz", names=np.array(INPUT_NAMES), physical=np.zeros((3, 65)))
    assert stored_calibration(campaign) is None
    error = refusal(lambda: load_calibration(tmp_path))
    assert error.code == NO_CALIBRATION and error.remedy and "did not converge" in error.message
    np.savez_compressed(tmp_path / "results" / "draws.npz", names=np.array(INPUT_NAMES))
    assert refusal(lambda: stored_calibration(campaign)).code == "damaged-results"


def test_json_export_brings_back_all_but_the_draws(tmp_path):
    one = complete()
    path = tmp_path / "robot.json"
    path.write_text(json.dumps(calibration_json(one), allow_nan=False))
    other = load_calibration(path)
    assert differing(one, other, without=("inputs", "noise", "causes", "cause_covariance")) == []
    assert len(other.inputs) == len(other.noise) == len(other.causes) == 0
    assert other.locate(100, 50, 75.0).u95_mm == pytest.approx(one.locate(100, 50, 75.0).u95_mm, rel=ROUNDING)
    assert other.steps_for((600, 0, 0)).as_json() == one.steps_for((600, 0, 0)).as_json()


def test_expected_error_is_that_of_the_middle():
    one = replace(complete(), range_steps=np.array([[-100.0, 300.0], [40.0, 60.0]]))
    error = expected_error(one)
    assert (error.pan_steps, error.tilt_steps) == (100, 50)
    d = one.ray(100, 50).direction
    there = one.steps_for(azimuth_deg=math.degrees(math.atan2(d[1], d[0])), elevation_deg=math.degrees(math.asin(d[2])))
    assert [error.u95_azimuth_deg, error.u95_elevation_deg] == pytest.approx(there.u95_deg, rel=ROUNDING)
    at_1_m = one.steps_for(one.ray(100, 50).origin_mm + 1000.0 * d)
    assert error.u95_at_1_m_mm == pytest.approx(at_1_m.u95_mm, rel=1e-9)


def arrays_of(one: Calibration) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(calibration_bytes(one))) as file:
        return {name: file[name] for name in file.files}


def table(arrays: dict[str, np.ndarray], name: str, value: object) -> dict[str, np.ndarray]:
    return arrays | {"tables": np.array(json.dumps(json.loads(str(arrays["tables"])) | {name: value}))}


def poisoned(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array.flat[3] = value
    return array


DAMAGES = {
    "another format": lambda a: a | {"format": np.array("tvsbayes-calibration/9")},
    "no format": lambda a: {name: value for name, value in a.items() if name != "format"},
    "other columns": lambda a: a | {"input_names": a["input_names"][::-1]},
    "other noises": lambda a: a | {"noise_names": a["noise_names"][::-1]},
    "no mean": lambda a: {name: value for name, value in a.items() if name != "mean"},
    "no tables": lambda a: {name: value for name, value in a.items() if name != "tables"},
    "nan in the mean": lambda a: a | {"mean": poisoned(a["mean"], np.nan)},
    "inf in the covariance": lambda a: a | {"covariance": poisoned(a["covariance"], np.inf)},
    "nan in the draws": lambda a: a | {"inputs": poisoned(a["inputs"], np.nan)},
    "a short mean": lambda a: a | {"mean": a["mean"][:-1]},
    "fewer noises": lambda a: a | {"noise": a["noise"][:-1]},
    "narrow draws": lambda a: a | {"inputs": a["inputs"][:, 1:]},
    "causes without parts": lambda a: a | {"cause_covariance": a["cause_covariance"][:1]},
    "integers": lambda a: a | {"mean": a["mean"].astype(int)},
    "objects": lambda a: a | {"mean": a["mean"].astype(object)},
    "text": lambda a: a | {"covariance": np.array("covariance")},
    "tables no json": lambda a: a | {"tables": np.array("{")},
    "tables a list": lambda a: a | {"tables": np.array("[]")},
    "noise variance missing": lambda a: table(a, "noise_variance", {"aperture_sd_deg": 1.0}),
    "noise variance nan": lambda a: table(a, "noise_variance", dict.fromkeys(NOISE_NAMES, math.nan)),
    "noise variance negative": lambda a: table(a, "noise_variance", dict.fromkeys(NOISE_NAMES, -1.0)),
    "noise variance text": lambda a: table(a, "noise_variance", dict.fromkeys(NOISE_NAMES, "1")),
    "overshoot missing": lambda a: table(a, "overshoot_steps", {"pan": 3}),
    "overshoot text": lambda a: table(a, "overshoot_steps", {"pan": "3", "tilt": 3}),
    "period zero": lambda a: table(a, "period_deg", {"pan": 0.0}),
    "period text": lambda a: table(a, "period_deg", {"pan": "360"}),
    "periods a list": lambda a: table(a, "period_deg", [360.0]),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_draws_are_refused(damage, tmp_path):
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **DAMAGES[damage](arrays_of(complete())))
    path = tmp_path / "draws.npz"
    path.write_bytes(buffer.getvalue())
    error = refusal(lambda: load_calibration(path))
    assert (error.code, error.file) == ("damaged-results", "draws.npz")
    assert error.remedy and CALIBRATION_FORMAT in error.allowed


def test_files_that_are_no_archive_are_refused(tmp_path):
    good = calibration_bytes(complete())
    path = tmp_path / "draws.npz"
    flipped = bytearray(good)
    flipped[len(good) // 3] ^= 0xFF
    for content in (b"", b"PK", b"hello", good[: len(good) // 2], good[:-30], good[100:], bytes(flipped)):
        path.write_bytes(content)
        assert refusal(lambda: load_calibration(path)).code == "damaged-results"
    assert refusal(lambda: load_calibration(tmp_path / "none")).exit_code == 2
    assert refusal(lambda: load_calibration(tmp_path / "none.json")).exit_code == 2


def test_an_archive_that_swells_is_refused(tmp_path):
    """A megabyte of zeros that claims a gigabyte of draws: refused before it is unpacked."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (2**20, len(INPUT_NAMES) * 5)}
    )
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("inputs.npy", "w", force_zip64=True) as member:
            member.write(header.getvalue())
            for _ in range(300):
                member.write(bytes(2**20))
        for name, array in arrays_of(complete()).items():
            if name != "inputs":
                one = io.BytesIO()
                np.save(one, array)
                archive.writestr(f"{name}.npy", one.getvalue())
    path = tmp_path / "draws.npz"
    path.write_bytes(buffer.getvalue())
    assert path.stat().st_size < 4 * 2**20
    error = refusal(lambda: load_calibration(path))
    assert error.code == "damaged-results" and "unpacked" in error.message


def edited(document: dict[str, object], **changes: object) -> dict[str, object]:
    return document | changes


JSON_DAMAGES = {
    "format": lambda d: d | {"format": "tvsbayes-calibration/9"},
    "no estimates": lambda d: {k: v for k, v in d.items() if k != "estimates"},
    "estimate missing": lambda d: d | {"estimates": {k: v for k, v in d["estimates"].items() if k != "baseline_mm"}},
    "estimate text": lambda d: d | {"estimates": d["estimates"] | {"baseline_mm": "wide"}},
    "estimate null": lambda d: d | {"estimates": d["estimates"] | {"baseline_mm": None}},
    "estimates a list": lambda d: d | {"estimates": [1.0]},
    "other names": lambda d: d | {"covariance": d["covariance"] | {"names": ["x"]}},
    "ragged": lambda d: d | {"covariance": d["covariance"] | {"matrix": [[1.0], [1.0, 2.0]]}},
    "small": lambda d: d | {"covariance": d["covariance"] | {"matrix": [[1.0]]}},
    "noise missing": lambda d: d | {"noise_variance_deg2": {}},
    "noise negative": lambda d: d | {"noise_variance_deg2": dict.fromkeys(NOISE_NAMES, -1.0)},
    "noise null": lambda d: d | {"noise_variance_deg2": None},
    "overshoot missing": lambda d: d | {"overshoot_steps": {}},
    "overshoot text": lambda d: d | {"overshoot_steps": {"pan": "x", "tilt": 1}},
    "overshoot negative": lambda d: d | {"overshoot_steps": {"pan": -1, "tilt": 1}},
    "range": lambda d: d | {"range_steps": {"pan": [0, 1]}},
    "period": lambda d: d | {"harmonic_period_deg": {"pan": 0}},
    "convention": lambda d: d | {"aperture_convention": "sideways"},
    "a list": lambda d: [d],
}


@pytest.mark.parametrize("damage", JSON_DAMAGES)
def test_damaged_json_is_refused(damage, tmp_path):
    path = tmp_path / "robot.json"
    path.write_text(json.dumps(JSON_DAMAGES[damage](calibration_json(complete()))))
    assert refusal(lambda: load_calibration(path)).file == "robot.json"
    path.write_text(path.read_text()[:-40])
    assert refusal(lambda: load_calibration(path)).file == "robot.json"


def test_stored_calibration_is_that_of_these_data(tmp_path):
    campaign = replace(small_campaign(), path=tmp_path)
    assert stored_calibration(replace(campaign, path=None)) is None
    assert stored_calibration(campaign) is None
    (tmp_path / "results").mkdir()
    path = tmp_path / "results" / "draws.npz"
    one = replace(complete(), inputs_sha256=input_hashes(campaign))
    path.write_bytes(calibration_bytes(one))
    assert differing(one, stored_calibration(campaign)) == []
    for name in one.inputs_sha256:
        path.write_bytes(calibration_bytes(replace(one, inputs_sha256=one.inputs_sha256 | {name: "f" * 64})))
        assert stored_calibration(campaign) is None, name
    path.write_bytes(b"no archive")
    assert refusal(lambda: stored_calibration(campaign)).code == "damaged-results"


MAIN = """
#include <stdio.h>
#include "tvs_calibration.h"
int main(void)
{
    double pan, tilt, reading, o[3], d[3], p[3];
    int left, up;
    while (scanf("%lf %lf %d %d %lf", &pan, &tilt, &left, &up, &reading) == 5) {
        tvs_beam(pan, tilt, left, up, o, d);
        int found = tvs_locate(pan, tilt, left, up, reading, p);
        printf("%d", found);
        for (int i = 0; i < 3; i++)
            printf(" %.17g %.17g %.17g", o[i], d[i], found ? p[i] : 0.0);
        puts("");
    }
    return 0;
}
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")
@pytest.mark.parametrize("periods", [{}, PERIODS_DEG, {"pan": 25.0, "tilt": 360.0}])
@pytest.mark.parametrize("azimuth", [False, True])
def test_the_c_header_computes_the_same(tmp_path, periods, azimuth):
    one = calibration(BENT | (WOBBLE if periods else {}), period_deg=periods, azimuth=azimuth)
    (tmp_path / "tvs_calibration.h").write_text(calibration_header(one))
    (tmp_path / "main.c").write_text(MAIN)
    strict = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
    subprocess.run(["cc", *strict, "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
    poses = (*POSES, (2600, 90, 110.0), (350, 10, 120.0))
    asked = [(pan, tilt, left, up, reading) for (pan, tilt, reading), left, up in product(poses, (1, -1), (1, -1))]
    text = "".join(" ".join(map(repr, row)) + "\n" for row in asked)
    done = subprocess.run([tmp_path / "main"], input=text, capture_output=True, text=True, check=True)
    rows = [list(map(float, line.split())) for line in done.stdout.splitlines()]
    refused = 0
    for (pan, tilt, left, up, reading), (found, *numbers) in zip(asked, rows, strict=True):
        approach = ("left" if left > 0 else "right", "up" if up > 0 else "down")
        origin, direction, point = np.array(numbers).reshape(3, 3).T
        ray = one.ray(pan, tilt, approach)
        np.testing.assert_allclose(origin, ray.origin_mm, atol=ROUNDING_MM)
        np.testing.assert_allclose(direction, ray.direction, atol=ROUNDING_MM / 1000)
        if found:
            np.testing.assert_allclose(point, one.locate(pan, tilt, reading, approach).xyz_mm, atol=ROUNDING_MM)
        else:
            assert refusal(lambda a=(pan, tilt, reading, approach): one.locate(*a)).code in ("diverging", "grazing")
            refused += 1
    assert refused >= 4


def test_the_c_header_states_its_error_and_overshoot(bent):
    text = calibration_header(bent)
    error = expected_error(bent)
    assert f"azimuth {error.u95_azimuth_deg:.3f} deg, elevation {error.u95_elevation_deg:.3f} deg" in text
    assert f"at 1 m {max(error.u95_at_1_m_mm):.2f} mm" in text
    assert f"#define TVS_OVERSHOOT_PAN_STEPS {bent.overshoot_steps['pan']}\n" in text
    assert "@" not in text
    for name in (*INPUT_NAMES, *HARMONIC_NAMES):
        assert f"#define TVS_{name.replace('.', '_').upper()} " in text


def test_driving_loads_no_jax(tmp_path):
    """From a file to counters and a point, without JAX, scipy or OpenCV."""
    path = tmp_path / "draws.npz"
    path.write_bytes(calibration_bytes(complete()))
    code = (
        "import sys; from tvsbayes.calibration.calibration_file import load_calibration\n"
        "c = load_calibration(sys.argv[1]); s = c.steps_for((600, 0, 0))\n"
        "c.locate(s.pan_steps, s.tilt_steps, s.aperture_deg)\n"
        "print(sorted({m.split('.')[0] for m in sys.modules} & {'jax', 'jaxlib', 'equinox', 'scipy', 'cv2'}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]", done.stdout

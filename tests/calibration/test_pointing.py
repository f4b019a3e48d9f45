"""Rays and points of a calibration, against the twin's optics and the law of propagation."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from support.bent_rig import (
    BENT,
    NO_NOISE_DEG,
    NOMINAL,
    PERIODS_DEG,
    POSES,
    ROUNDING,
    ROUNDING_MM,
    WOBBLE,
    calibration,
    twin_points,
    twin_ray,
)
from support.printed_vector import LAST_6, LAST_9, LAST_12, VECTOR
from support.refusals import refusal

from tvsbayes.calibration.drawn_looks import drawn
from tvsbayes.calibration.located_point import DIVERGING_SHARE
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES
from tvsbayes.coordinates.location import carry, locate, locate_linear, settings_of
from tvsbayes.errors import InputError
from tvsbayes.statistics.intervals import NORMAL_95
from tvsbayes.twin.physics import aperture_angle_deg, to_tvs

SIDES = tuple(product(("left", "right", "unknown"), ("up", "down", "unknown")))


@pytest.mark.parametrize("approach", SIDES)
@pytest.mark.parametrize("periods", [{}, PERIODS_DEG, {"pan": 25.0, "tilt": 360.0}])
def test_ray_is_the_twins(approach, periods):
    values = BENT | (WOBBLE if periods else {})
    one = calibration(values, {}, period_deg=periods)
    for steps in ((0, 0), (200, 100), (-350, 210), (777, -300)):
        ray = one.ray(*steps, approach=approach)
        origin, direction = twin_ray(values, steps, approach, periods)
        np.testing.assert_allclose(ray.origin_mm, origin, atol=ROUNDING_MM)
        np.testing.assert_allclose(ray.direction, direction, atol=ROUNDING)


def test_ray_of_the_test_vector():
    """Of formulation 3.2: psi 10 deg, beta 5 deg; 250 mm along the beam with C0 91 deg and a 200 mm."""
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
        xyz = replace(one, azimuth=azimuth).locate(200, 100, reading).xyz_mm
        # Half a unit of the last digit of the reading moves the point by a sin(C) / sin(B + C)^2 = 14 mm per degree.
        assert np.abs(xyz - printed).max() <= LAST_6 + 14.0 * LAST_6


@pytest.mark.parametrize("approach", [("left", "up"), ("right", "unknown"), ("unknown", "down")])
def test_locate_is_where_the_twin_reads_the_same_angle(either, approach):
    for pan, tilt, reading in POSES:
        origin, direction = twin_ray(either.estimates, (pan, tilt), approach, either.period_deg)
        true = reading - either.estimates["aperture_zero_deg"]
        expected = twin_points(origin[None], direction[None], either.estimates["baseline_mm"], true, either.azimuth)[0]
        # Bisection of 1e5 mm ends at rounding of the angle: 1e-13 deg times 100 mm per degree.
        np.testing.assert_allclose(either.locate(pan, tilt, reading, approach).xyz_mm, expected, atol=10 * ROUNDING_MM)


@pytest.mark.parametrize("approach", [("left", "up"), ("right", "unknown"), ("unknown", "down")])
def test_locate_is_the_law_of_propagation(either, approach):
    """Derivatives are central differences of every input that varies; a point alone is that of many."""
    varies = np.flatnonzero(np.diag(either.covariance) > 0)
    assert len(varies) >= 15
    settings = settings_of(*np.array(POSES).T, [approach] * len(POSES))
    many = locate_linear(either, settings)
    for i, pose in enumerate(POSES):
        slopes, point = either.derivatives(*pose, approach), either.locate(*pose, approach)
        for k in varies:
            step = 1e-3 * np.sqrt(either.covariance[k, k]) * np.eye(len(either.mean))[k]
            ends = [replace(either, mean=either.mean + s).locate(*pose, approach).xyz_mm for s in (step, -step)]
            # Third derivatives over steps of a thousandth of u.
            wanted = (ends[0] - ends[1]) / (2 * step[k])
            np.testing.assert_allclose(slopes[:, k], wanted, rtol=1e-6, atol=1e-6 * np.abs(slopes[:, k]).max())
        covariance = slopes @ either.covariance_with_noise @ slopes.T
        scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
        for found in (point.covariance_mm2, many.covariance[i]):
            assert np.abs((found - covariance) / scale).max() < 100 * ROUNDING
        np.testing.assert_allclose(many.value[i], point.xyz_mm, atol=ROUNDING_MM)
        np.testing.assert_allclose(point.u95_mm, NORMAL_95 * np.sqrt(np.diag(point.covariance_mm2)), rtol=ROUNDING)


@pytest.mark.parametrize("azimuth", [False, True])
def test_what_beam_and_reading_do_not_meet_under_is_refused(azimuth):
    """Random settings all around the machine, against the twin's angle along the beam; a point alone and many."""
    one = calibration(BENT, {}, NO_NOISE_DEG, azimuth=azimuth)
    rng = np.random.default_rng(5)
    pan, tilt = rng.uniform(-3000, 3000, 256), rng.uniform(-900, 900, 256)
    reading = rng.uniform(0.5, 179.5, 256)
    codes, reach_mm = set(), np.geomspace(1e-3, 1e7, 5000)[:, None]
    meets = np.isfinite(carry(one, drawn(one, 1, 0), settings_of(pan, tilt, reading))).all(axis=-1)[0]
    assert 30 < meets.sum() < 226
    for i in range(256):
        origin, direction = twin_ray(BENT, (pan[i], tilt[i]), ("left", "up"))
        beam = (origin + reach_mm * direction)[(origin + reach_mm * direction)[:, 0] > 0]
        angle = aperture_angle_deg(beam, BENT["baseline_mm"], "azimuth" if azimuth else "in-plane")
        turns = np.sign(angle - (reading[i] - BENT["aperture_zero_deg"]))
        assert meets[i] == bool(np.diff(turns).any()), (pan[i], tilt[i], reading[i])
        try:
            point = one.locate(pan[i], tilt[i], reading[i]).xyz_mm
        except InputError as error:
            codes.add(error.code)
            assert not meets[i], (pan[i], tilt[i], reading[i])
        else:
            assert meets[i], (pan[i], tilt[i], reading[i], point)
    # An azimuth reading belongs to the half-plane before the aperture.
    assert codes == ({"diverging"} if azimuth else {"diverging", "grazing", "behind"})


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
    """More than 0.1 % of draws diverge. The law of propagation needs range and u, the other counts draws."""
    rng = np.random.default_rng(4)
    count = 4000
    inputs = np.array([NOMINAL[name] for name in INPUT_NAMES]) + np.zeros((count, 1))
    sds = {"pan_zero_emission_deg": 0.2, "baseline_mm": 0.5, "degrees_per_step.pan": 1e-4}
    for name, sd in sds.items():
        inputs[:, INPUT_NAMES.index(name)] += sd * rng.standard_normal(count)
    noise = np.full((count, len(NOISE_NAMES)), 0.05)
    many = replace(
        calibration(NOMINAL, {}, NO_NOISE_DEG),
        mean=inputs.mean(axis=0),
        covariance=np.cov(inputs, rowvar=False),
        noise_variance=dict.fromkeys(NOISE_NAMES, 0.05**2),
        inputs=inputs,
        noise=noise,
    )
    for reading, meets in ((57.0, True), (59.0, True), (59.6, False), (59.9, False)):
        share = locate(many, 500.0, 0.0, reading, draws=count).diverging_share[0]
        assert (share <= DIVERGING_SHARE) == meets, (reading, share)
        if meets:
            assert np.isfinite(many.locate(500, 0, reading).u95_mm).all()
        else:
            error = refusal(lambda reading=reading: many.locate(500, 0, reading))
            assert error.code == "diverging" and "would meet" in str(error), "the estimates do meet"
    assert "would meet" not in str(refusal(lambda: many.locate(500, 0, 60.5)))


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


def test_covers_the_counters_of_the_campaign(bent):
    assert bent.covers(400, -300) and not bent.covers(401, 0) and not bent.covers(0, 301)

"""Errors over the work space, against the twin and by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.bent_rig import BENT, NO_NOISE_DEG, NOMINAL, ROUNDING_MM, calibration, twin_points, twin_ray
from support.published_equations import published_point

from tvsbayes.calibration.optics import range_components
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.coordinates.error_map import error_map
from tvsbayes.coordinates.simple_calibration import SimpleCalibration, simple_calibration, simple_rays
from tvsbayes.estimators.four_point import ClassicResult, DirectionResult
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import Prior
from tvsbayes.twin.physics import aperture_angle_deg


def direction_result(mean: float) -> DirectionResult:
    return DirectionResult(1, mean, None, None, None, None, None, 0.0, None)


def test_simple_calibration_is_nominal_or_classic():
    nominal = simple_calibration()
    assert nominal == SimpleCalibration({"left": 0.06, "right": 0.06, "up": 0.07, "down": 0.07}, 170.0, 70.0, 90.0, 0.0)
    assert simple_calibration(TWO_MIRROR.priors | {"aperture_zero_deg": Prior(5.0, 0.0)}).aperture_zero_deg == 5.0
    results = {"left": direction_result(0.0594), "right": None, "up": direction_result(0.069), "down": None}
    classic = simple_calibration(
        TWO_MIRROR.priors | {"mirror_offset_mm": Prior(20.0, 1.0)}, ClassicResult(results, (), ())
    )
    assert classic.deg_per_step == {"left": 0.0594, "right": 0.06, "up": 0.069, "down": 0.07}
    assert (classic.baseline_mm, classic.origin_y_mm) == (180.0, 80.0)


@pytest.mark.parametrize(("pan", "tilt"), [(0, 0), (200, 0), (-150, 120), (100, -200)])
def test_simple_rays_with_readings_are_the_published_equations(pan, tilt):
    """Baseline a - L, middle moved by -L/2; C and beta in the plane of beam and baseline, from the direction."""
    simple = SimpleCalibration({"left": 0.06, "right": 0.05, "up": 0.07, "down": 0.08}, 170.0, 70.0, 88.0, 0.0)
    rays = simple_rays(simple, np.array([[pan, tilt]]))
    azimuth = 88.0 - 90.0 + pan * (0.06 if pan > 0 else 0.05)
    elevation = tilt * (0.07 if tilt > 0 else 0.08)
    ez, az = np.radians([elevation, azimuth])
    d = np.array([np.cos(ez) * np.cos(az), np.cos(ez) * np.sin(az), np.sin(ez)])
    np.testing.assert_allclose(np.asarray(rays.direction)[:, 0], d, atol=1e-12)
    np.testing.assert_array_equal(np.asarray(rays.origin_mm)[:, 0], [0.0, 70.0, 0.0])
    C, beta = np.degrees(np.arccos(-d[1])), np.degrees(np.arctan2(d[2], d[0]))
    for reading in (50.0, 75.0):
        # The aperture stays at -a/2 = -100 mm.
        baseline_mm = 2 * (simple.baseline_mm - simple.origin_y_mm)
        reach = range_components((0.0, 70.0, 0.0), tuple(d.tolist()), baseline_mm, reading, False, math)
        expected = published_point(reading, C, beta, 170.0) - np.array([0.0, 15.0, 0.0])
        np.testing.assert_allclose(np.array([0.0, 70.0, 0.0]) + reach * d, expected, atol=10 * ROUNDING_MM)


PAN, TILT, RANGE_MM = np.array([-120.0, 90.0]), np.array([-100.0, 0.0, 150.0]), np.array([200.0, 350.0, 500.0, 800.0])


def mapped(one: Calibration, simple: SimpleCalibration, pan=PAN, tilt=TILT, ranges=RANGE_MM, **more):
    """All maps of one shape: compiled once."""
    assert (len(pan), len(tilt), len(ranges)) == (2, 3, 4)
    axes = [np.asarray(axis).tolist() for axis in (pan, tilt, ranges)]
    return error_map(one, *axes, simple={"nominal": simple}, draws=500, **more)


@pytest.mark.parametrize("azimuth", [False, True])
def test_a_perfect_rig_has_no_error_straight_ahead(azimuth):
    """At pan 0 the beam leaves where published equations assume it; turned, it runs L beside the pan axis."""
    one = calibration(NOMINAL, {}, NO_NOISE_DEG, azimuth=azimuth)
    errors = mapped(one, simple_calibration(), pan=np.array([0.0, 100.0]))
    assert errors.valid.all()
    assert errors.rms_mm["joint"].max() < ROUNDING_MM * 10
    assert errors.rms_mm["nominal"][0].max() < ROUNDING_MM * 10
    assert errors.rms_mm["nominal"][1].min() > 0.1


@pytest.mark.parametrize("azimuth", [False, True])
@pytest.mark.parametrize("approach", [(1.0, 1.0), (-1.0, 1.0)])
def test_error_of_the_nominal_estimator_is_the_twins(azimuth, approach):
    """A rig without scatter: the whole chain in NumPy, at every pose and range, in the order of the axes."""
    one = calibration(BENT, {}, NO_NOISE_DEG, azimuth=azimuth)
    errors = mapped(one, simple_calibration(), approach=approach)
    convention = "azimuth" if azimuth else "in-plane"
    side = ("left" if approach[0] > 0 else "right", "up")
    for i, j, k in np.ndindex(2, 3, 4):
        origin, direction = twin_ray(BENT, (PAN[i], TILT[j]), side)
        point = origin + RANGE_MM[k] * direction
        reading = aperture_angle_deg(point, BENT["baseline_mm"], convention) + BENT["aperture_zero_deg"]
        az, el = np.radians([0.06 * PAN[i], 0.07 * TILT[j]])
        d = np.array([[np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)]])
        if not errors.valid[i, j, k]:
            angle = aperture_angle_deg(1e7 * d[0], 200.0, convention)
            assert angle < reading + 1e-3, "lines of sight and nominal beam diverge"
            continue
        thought = twin_points(np.array([[0.0, 70.0, 0.0]]), d, 200.0, float(reading), azimuth)[0]
        # The nominal point may be 10 m away: bisection's 1e-13 deg times r^2 / a.
        bound = 10 * ROUNDING_MM * (1 + (np.linalg.norm(thought) / 1000.0) ** 2)
        assert errors.rms_mm["nominal"][i, j, k] == pytest.approx(np.linalg.norm(thought - point), abs=bound)
        # Every draw is the same rig.
        np.testing.assert_allclose(
            errors.distance_mm["nominal"][:, i, j, k], np.linalg.norm(thought - point), atol=bound
        )
        assert errors.rms_mm["joint"][i, j, k] < 10 * ROUNDING_MM
    assert errors.valid.sum() >= 18
    np.testing.assert_array_equal(errors.pan_steps, PAN)
    np.testing.assert_array_equal(errors.tilt_steps, TILT)
    np.testing.assert_array_equal(errors.range_mm, RANGE_MM)


def test_joint_beats_nominal_on_a_biased_rig():
    one = calibration()
    errors = mapped(one, simple_calibration(), ranges=np.array([150.0, 200.0, 300.0, 400.0]))
    assert errors.valid.all()
    assert np.all(errors.rms_mm["joint"] < errors.rms_mm["nominal"])
    # The joint error is that of `locate` for a look: the trace of its covariance.
    ray = one.ray(PAN[0], TILT[1])
    point = ray.origin_mm + 300.0 * ray.direction
    reading = aperture_angle_deg(point, one.estimates["baseline_mm"], "in-plane")
    law = one.locate(PAN[0], TILT[1], float(reading) + one.estimates["aperture_zero_deg"])
    # The errors' second moment from 500 draws, five standard errors of one dominating direction, 5 % of curvature.
    ratio = errors.rms_mm["joint"][0, 1, 2] / np.sqrt(np.trace(law.covariance_mm2))
    assert abs(ratio - 1) < 5 * np.sqrt(0.5 / 500) + 0.05


def test_where_nothing_can_be_located_the_map_is_empty():
    """At 100 m a thousandth of a degree decides whether beam and sight meet; stops scatter by 0.05 deg."""
    errors = mapped(calibration(), simple_calibration(), ranges=np.array([200.0, 300.0, 400.0, 1e5]))
    assert not errors.valid[..., 3].any() and errors.valid[..., :3].all()
    assert np.isnan(errors.rms_mm["joint"][..., 3]).all()
    assert np.isfinite(errors.rms_mm["nominal"][..., :3]).all()

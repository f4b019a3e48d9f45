"""The optics in components: transmission errors, ranges and beam angles, against the twin's."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from support.bent_rig import AXES, BENT, PERIODS_DEG, ROUNDING, ROUNDING_MM, SD, twin_angle_deg, twin_ray_at
from support.published_equations import published_point

from tvsbayes.calibration.optics import beam_deg_per_step, output_deg, range_components
from tvsbayes.twin.physics import aperture_angle_deg, local_deg_per_step
from tvsbayes.twin.true_rig import with_derived


def test_transmission_error_is_that_of_wheel_or_pinion(wobbling):
    """The wheel's error follows the output, which the play shifts; the pinion's the driving angle."""
    for axis, side in product(AXES, (1.0, -1.0, 0.0)):
        for steps in (-211, 0, 55, 180):
            angle = output_deg(wobbling.estimates, axis, steps, side, PERIODS_DEG[axis])
            expected = twin_angle_deg(wobbling.estimates, axis, steps, -side / 2, PERIODS_DEG[axis])
            assert angle == pytest.approx(expected, abs=ROUNDING * 100)
    values = wobbling.estimates
    ratio, play = values["degrees_per_step.pan"], values["backlash_deg.pan"]
    gap = [output_deg(values, "pan", 55, side, 360.0) - (ratio * 55 - side * play / 2) for side in (1, -1)]
    assert abs(gap[0] - gap[1]) > 1e-4, "the wheel's error differs between the sides"


def test_ratio_of_the_beam_is_the_twins():
    """Against the twin's own optics, whose slope is differentiated elsewhere."""
    pose = (7.0, 4.0)
    contrasts = dict.fromkeys(("ratio_contrast_deg_per_step.pan", "ratio_contrast_deg_per_step.tilt"), 0.0)
    true = local_deg_per_step(with_derived({**BENT, **contrasts}), pose)
    for axis, pair in (("pan", ("left", "right")), ("tilt", ("up", "down"))):
        mean = 0.5 * sum(true[d] for d in pair)
        # Two central differences, with steps of 1e-3 deg and the twin's own.
        assert beam_deg_per_step(BENT, axis, pose) == pytest.approx(mean, rel=1e-6)


A_MM = 200.0


def bent_beams(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins (n, 3), directions (n, 3) by the twin, and points (n, 3) on them 100 to 1500 mm away."""
    rng = np.random.default_rng(seed)
    origins, directions = [], []
    for pan, tilt in rng.uniform([-55.0, -35.0], [55.0, 35.0], (count, 2)):
        values = {name: BENT[name] + rng.normal() * SD.get(name, SD.get(name.split(".")[0], 0)) for name in BENT}
        values |= {"baseline_mm": A_MM, "mirror1_error_deg": rng.normal(), "laser_tilt_deg.x": rng.normal()}
        origin, direction = twin_ray_at(values, pan, tilt)
        origins.append(origin)
        directions.append(direction)
    o, d = np.array(origins), np.array(directions)
    return o, d, o + rng.uniform(100.0, 1500.0, (count, 1)) * d


def met(origin, direction, reading_deg, azimuth: bool):
    """Points (n, 3), ranges (n,), and whether they meet."""
    origin, direction = np.asarray(origin, float), np.asarray(direction, float)
    range_mm = range_components(tuple(origin.T), tuple(direction.T), A_MM, np.asarray(reading_deg, float), azimuth)
    meets = (range_mm > 0) & np.isfinite(range_mm)
    with np.errstate(invalid="ignore"):
        return origin + range_mm[:, None] * direction, range_mm, meets


@pytest.mark.parametrize("azimuth", [False, True])
def test_the_reading_of_a_point_leads_back_to_it(azimuth):
    origin, direction, points = bent_beams(200, 3)
    reading = aperture_angle_deg(points, A_MM, "azimuth" if azimuth else "in-plane")
    assert (reading > 90).sum() > 20 and (reading < 90).sum() > 20
    xyz, range_mm, meets = met(origin, direction, reading, azimuth)
    assert meets.all()
    # The reading's rounding of 2e-14 deg at up to r^2 / (a sin) = 200 mm per degree, and of the discriminant's root.
    np.testing.assert_allclose(xyz, points, atol=1e-7)
    np.testing.assert_allclose(range_mm, np.linalg.norm(points - origin, axis=1), atol=1e-7)


@pytest.mark.parametrize("azimuth", [False, True])
def test_a_right_angle_is_no_exception(azimuth):
    """B = 90 deg exactly: the plane y = -a/2."""
    origin, direction, _ = bent_beams(200, 4)
    reach = (-A_MM / 2 - origin[:, 1]) / direction[:, 1]
    ahead = (reach > 0) & (origin[:, 0] + reach * direction[:, 0] > 0)
    points = origin + reach[:, None] * direction
    xyz, _, meets = met(origin, direction, np.full(200, 90.0), azimuth)
    assert ahead.sum() > 50
    # cos(90 deg) is 6e-17, not 0: it decides about beams that run behind the positioner only.
    np.testing.assert_array_equal(meets, ahead)
    np.testing.assert_allclose(xyz[ahead], points[ahead], atol=ROUNDING_MM, rtol=1e-10)


def test_beams_from_the_baseline_give_the_published_point():
    rng = np.random.default_rng(6)
    B, C, beta = rng.uniform(20, 130, 200), rng.uniform(15, 120, 200), rng.uniform(-60, 60, 200)
    C = np.minimum(C, 172.0 - B)
    cr, br = np.radians(C), np.radians(beta)
    direction = np.stack([np.sin(cr) * np.cos(br), -np.cos(cr), np.sin(cr) * np.sin(br)], axis=1)
    origin = np.tile([0.0, A_MM / 2, 0.0], (200, 1))
    xyz, _, meets = met(origin, direction, B, False)
    assert meets.all()
    np.testing.assert_allclose(xyz, published_point(B, C, beta, A_MM).T, atol=1e-7)


def test_conventions_differ_by_the_documented_share():
    """B = C = 80 deg, a = 200 mm: printed to 0.1 mm; 3.4 % in x at 15 deg."""
    origin = np.array([[0.0, A_MM / 2, 0.0]])
    for elevation, in_plane, azimuth in ((5.0, (565.0, 49.4), (567.1, 50.4)), (15.0, (547.8, 146.8), (567.1, 154.3))):
        C, el = np.radians([80.0, elevation])
        plane = np.array([[math.sin(C) * math.cos(el), -math.cos(C), math.sin(C) * math.sin(el)]])
        level = np.array([[math.cos(el) * math.sin(C), -math.cos(el) * math.cos(C), math.sin(el)]])
        one, two = met(origin, plane, [80.0], False)[0][0], met(origin, level, [80.0], True)[0][0]
        assert one[[0, 2]] == pytest.approx(in_plane, abs=0.05)
        assert two[[0, 2]] == pytest.approx(azimuth, abs=0.05)
    assert one[0] / two[0] - 1 == pytest.approx(-0.034, abs=0.0005)

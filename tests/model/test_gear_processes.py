"""Covariances of what gears repeat, and the line through the looks as headline (formulation 3.1, 3.2)."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.small_campaign import small_stereo

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.rig import RigTable
from tvsbayes.model.gear_processes import GearScales, Places, place_root
from tvsbayes.model.headlines import SeenLine, effective_deg_per_step, line_deg_per_step
from tvsbayes.model.laser_path import beam_angles
from tvsbayes.model.parameter_space import parameter_space

pytestmark = pytest.mark.usefixtures("x64")

ON_TILT = np.array([False, False, False, True, True, False])
VALID = np.array([True, True, True, True, True, False])
ANGLE_RAD = np.radians([0.0, 1.0, 40.0, 3.0, 5.5, 0.0])
RELATIVE = 1e-9


def scales() -> GearScales:
    """Two points at once: leading axis 2."""
    values = {
        "error_rad": [[1e-3, 2e-3], [0.0, 1e-9]],
        "length_rad": [[0.1, 0.05], [1.0, 0.2]],
        "play_rad": [[5e-4, 1e-4], [0.0, 3e-3]],
        "drift_rad_per_root_hour": [[0.0, 0.0], [0.0, 0.0]],
        "amplitude_rad": [[[1e-3, 2e-4, 0.0], [0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0], [0.0, 1e-4, 0.0]]],
        "period_rad": [[[0.5, 0.02, 6.28], [6.28, 6.28, 6.28]], [[0.5, 0.02, 6.28], [6.28, 0.3, 6.28]]],
    }
    return GearScales(**{name: np.asarray(value) for name, value in values.items()})


def by_hand(point: int, i: int, j: int) -> tuple[float, float]:
    """Covariance of transmission errors and of plays at two places, rad^2."""
    known = scales()
    if i == j and not VALID[i]:
        return 0.0, 0.0
    if ON_TILT[i] != ON_TILT[j] or not VALID[i] or not VALID[j]:
        return 0.0, 0.0
    axis, distance = int(ON_TILT[i]), ANGLE_RAD[i] - ANGLE_RAD[j]
    x = np.sqrt(5) * abs(distance) / known.length_rad[point, axis]
    near = (1 + x + x**2 / 3) * np.exp(-x)
    waves = np.cos(2 * np.pi * distance / known.period_rad[point, axis]) * known.amplitude_rad[point, axis] ** 2
    return known.error_rad[point, axis] ** 2 * near + waves.sum(), known.play_rad[point, axis] ** 2 * near


def test_the_factor_is_that_of_the_covariance_of_both_processes():
    root = place_root(scales(), ANGLE_RAD, ON_TILT, VALID)
    size = len(ANGLE_RAD)
    assert root.shape == (2, 2 * size, 2 * size) and np.array_equal(root, np.tril(root))
    for point in range(2):
        covariance = root[point] @ root[point].T
        expected = np.zeros((2 * size, 2 * size))
        for i in range(size):
            for j in range(size):
                if VALID[i]:
                    expected[i, j], expected[size + i, size + j] = by_hand(point, i, j)
        known = np.flatnonzero(np.tile(VALID, 2))
        compared = np.ix_(known, known)
        # The share of 1e-10 of every variance, and the floor of 1e-24 rad^2.
        np.testing.assert_allclose(covariance[compared], expected[compared], rtol=RELATIVE, atol=2e-24)
        # Padding belongs to no other place.
        rest = np.setdiff1d(np.arange(2 * size), known)
        assert not (covariance[np.ix_(rest, known)]).any()


@pytest.fixture(scope="module")
def line():
    """(errors, share) -> slopes of the line, local slopes: a bent rig at three pan counters and one of tilt."""
    with jax.enable_x64(True):
        space = parameter_space(RigTable(), small_stereo())
        z = np.zeros(len(TWO_MIRROR.names))
        bent = ("laser_tilt_deg.x", "mirror1_error_deg", "tilt_axis_skew_deg", "tilt_zero_deg")
        for k, name in enumerate((*bent, "ratio_contrast_deg_per_step.pan", "backlash_deg.pan")):
            z[TWO_MIRROR.index[name]] = 0.7 - 0.3 * k
        model = jax.jit(lambda z: space.model(z))(z)
    steps, on_tilt = np.array([-200.0, 0.0, 300.0, 120.0]), np.array([False, False, False, True])
    pose_rad = np.array([0.05, 0.14])

    @jax.jit
    def slopes(errors_rad, share):
        places = Places(jnp.asarray(steps), jnp.asarray(on_tilt), jnp.ones(4, bool))
        angles = beam_angles(model.optics, *jnp.asarray(pose_rad))
        looks = SeenLine(pose_rad, places, share)
        return line_deg_per_step(model, looks, errors_rad, angles), effective_deg_per_step(model.transmission, angles)

    return SimpleNamespace(model=model, steps=steps, pose_rad=pose_rad, slopes=slopes)


SECANT = np.array([-1 / 500, 0.0, 1 / 500, 0.0])
"""Through the first and third counter of pan alone."""


def azimuth(model, pan_rad: float, tilt_rad: float) -> float:
    beam = jax.tree.map(np.asarray, model.optics).leaving(pan_rad, tilt_rad, np).direction
    return float(np.degrees(np.arctan2(beam.y, beam.x)))


def test_with_two_counters_the_ratio_is_the_secant_of_the_azimuth(line):
    errors_rad = np.array([2e-3, 0.5, -1e-3, 0.4, *[0.3] * 4])
    slopes, local = (np.asarray(x) for x in line.slopes(errors_rad, SECANT))
    ratio = float(line.model.transmission.ratio_rad_per_step[0])
    ends = [azimuth(line.model, ratio * n + e, line.pose_rad[1]) for n, e in ((-200, 2e-3), (300, -1e-3))]
    secant = (ends[1] - ends[0]) / 500
    # A contrast is one of gears: the mirrors alone change it.
    still = [azimuth(line.model, ratio * n, line.pose_rad[1]) for n in (-200, 300)]
    mirrors = (still[1] - still[0]) / 500 / ratio
    half = 0.5 * float(line.model.transmission.contrast_rad_per_step[0]) * mirrors
    assert half != 0
    np.testing.assert_allclose(slopes[:2], [secant + half, secant - half], rtol=1e-12)
    # One counter of tilt: no line.
    np.testing.assert_array_equal(slopes[2:], local[2:])
    assert abs(slopes[0] / local[0] - 1) > 1e-3


def test_an_error_that_grows_with_the_counter_is_ratio_to_the_line_alone(line):
    """Of 1e-5 rad a step: the line turns as if the gears had that ratio, the slope at the pose stays."""
    grown = 1e-5
    errors_rad = np.concatenate([grown * line.steps, np.zeros(4)])
    none = np.zeros(8)
    (with_error, local), (without, same) = (
        [np.asarray(x) for x in line.slopes(errors, SECANT)] for errors in (errors_rad, none)
    )
    np.testing.assert_array_equal(local, same)
    ratio = float(line.model.transmission.ratio_rad_per_step[0])
    mirrors = without[:2].mean() / np.degrees(ratio)
    # The azimuth is bent: over 0.3 deg its slope changes by some 1e-4.
    assert (with_error - without)[:2].mean() == pytest.approx(np.degrees(grown) * mirrors, rel=1e-2)
    assert with_error[2:] == pytest.approx(without[2:], rel=1e-12)

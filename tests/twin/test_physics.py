"""The twin's own physics against the design's printed vectors and worked examples."""

from __future__ import annotations

import numpy as np
import pytest
from support.printed_vector import LAST_6, LAST_7, LAST_9, LAST_12
from support.printed_vector import VECTOR as PRINTED

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.twin.physics import (
    aperture_angle_deg,
    beam_jacobian,
    effective_mirror_offset_mm,
    local_deg_per_step,
    mirror_chain,
    play,
    stop_errors,
    to_tvs,
    transmission,
)

NOMINAL = {name: prior.value for name, prior in TWO_MIRROR.priors.items()}
VECTOR = NOMINAL | PRINTED
POSE_DEG = (10.0, 5.0)


def test_mirror_chain_vector():
    """Origin and direction of formulation 3.2 to the last printed digit."""
    origin, direction = mirror_chain(*np.radians(POSE_DEG), VECTOR)
    assert origin == pytest.approx([5.371658918, -29.176887333, -0.940368833], abs=LAST_9 * 1.01)
    assert direction == pytest.approx([0.981182562588, 0.177188586189, 0.076713648059], abs=LAST_12 * 1.01)


def test_beam_jacobian_vector():
    """d(az, el)/d(psi, beta) of formulation 3.2 to the last printed digit."""
    printed = np.array([[1.0070677, 0.0038895], [-0.0025873, 0.9977070]])
    assert np.abs(beam_jacobian(VECTOR, POSE_DEG) - printed).max() <= LAST_7


def test_tvs_and_aperture_vector():
    """p_T and both readings of B of formulation 3.2 to the last printed digit."""
    origin, direction = mirror_chain(*np.radians(POSE_DEG), VECTOR)
    point = to_tvs(origin + 250.0 * direction, 200.0, 91.0)
    assert point == pytest.approx([250.365237, 119.492704, 18.238043], abs=LAST_6 * 1.01)
    assert aperture_angle_deg(point, 200.0, "in-plane") == pytest.approx(48.834423, abs=LAST_6)
    assert aperture_angle_deg(point, 200.0, "azimuth") == pytest.approx(48.759278, abs=LAST_6)


def test_aperture_beyond_a_right_angle():
    """A spot outside the aperture's side has B > 90 deg in both conventions."""
    points = np.array([[100.0, -200.0, 30.0]])
    assert aperture_angle_deg(points, 200.0, "in-plane")[0] > 90
    assert aperture_angle_deg(points, 200.0, "azimuth")[0] == pytest.approx(135.0)


def test_nominal_chain_is_a_periscope():
    """Nominal beam: origin (0, -L, 0), along +x; pan and tilt positive to the left and up."""
    origin, direction = mirror_chain(0.0, 0.0, NOMINAL)
    assert origin == pytest.approx([0.0, -30.0, 0.0], abs=1e-12)
    assert direction == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)
    left = mirror_chain(0.1, 0.0, NOMINAL).direction
    up = mirror_chain(0.0, 0.1, NOMINAL).direction
    assert left == pytest.approx([np.cos(0.1), np.sin(0.1), 0.0], abs=1e-12)
    assert up == pytest.approx([np.cos(0.1), 0.0, np.sin(0.1)], abs=1e-12)


def test_effective_ratios_and_offset_of_the_nominal_rig():
    """Nominal: the beam turns as the mirrors do and passes the pan axis at +L, at any pose."""
    parameters = NOMINAL | {"degrees_per_step.left": 0.0601, "degrees_per_step.right": 0.0599}
    parameters |= {"degrees_per_step.up": 0.0701, "degrees_per_step.down": 0.0699}
    effective = local_deg_per_step(parameters, (12.0, 7.0))
    # Differences of angles of order 0.1 rad over 2e-5 rad: rounding 1e-16 / 2e-5 = 1e-11, times ten.
    assert effective == pytest.approx({"left": 0.0601, "right": 0.0599, "up": 0.0701, "down": 0.0699}, rel=1e-10)
    assert effective_mirror_offset_mm(parameters, (12.0, 7.0)) == pytest.approx(30.0, abs=1e-10)
    tilted = parameters | {"laser_tilt_deg.x": 1.0}
    slope = local_deg_per_step(tilted, (12.0, 7.0))["left"] / 0.0601
    assert 0.001 < abs(slope - 1) < 0.02, "a laser tilt changes the local slope by up to 1.7 % (formulation 3.2)"


def test_play_vector():
    """The play vector of formulation 3.2, through the transmission with its two ratios and by itself."""
    counters = np.cumsum([0, 200, -200, 3, -2, 100])
    first = np.arange(6) == 0
    y = transmission(counters, first, np.full(6, -0.5), np.zeros(6), (0.061, -0.002), 0.3)
    # Exact in decimals: rounding of sums of order 12 only.
    assert y == pytest.approx([-0.15, 11.85, -0.25, -0.25, -0.25, 5.506], abs=1e-13)
    q = np.array([12.0, -0.4, -0.22, -0.344, 5.656])
    assert play(q, -0.15, 0.3) == pytest.approx(y[1:], abs=1e-13)


def test_stop_errors_persist_and_are_redrawn():
    """Held while the other axis moves or nothing does; redrawn by this axis' counter and by homing."""
    counters = np.array([0, 5, 5, 5, 4, 4, 4])
    first = np.array([1, 0, 0, 0, 0, 1, 0], bool)
    approach = ["left", "", "", "", "", "unknown", ""]
    draws = np.arange(1.0, 8.0)
    held = stop_errors(counters, first, approach, draws, {"+": 0.1, "-": 0.01})
    both = np.sqrt((0.1**2 + 0.01**2) / 2)
    assert held == pytest.approx([0.1, 0.2, 0.2, 0.2, 0.05, 6 * both, 6 * both], abs=1e-15)

"""The optics in components: transmission errors, ranges and beam angles, against the twin's and JAX."""

from __future__ import annotations

import math
from itertools import product

import jax
import numpy as np
import pytest
from support.bent_rig import (
    AXES,
    BENT,
    twin_angle_deg,
)
from support.two_poses import PERIODS_DEG

from tvsbayes.calibration.optics import beam_deg_per_step, output_deg, range_components
from tvsbayes.coordinates.beam_meeting import meeting
from tvsbayes.twin.physics import effective_deg_per_step
from tvsbayes.twin.simulated_campaign import with_derived

ROUNDING = 1e-12
"""Of a hundred operations on numbers of order 1."""


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


def test_ratio_of_the_beam_is_the_twins():
    """Against the twin's own optics, whose slope is differentiated elsewhere."""
    pose = (7.0, 4.0)
    contrasts = dict.fromkeys(("ratio_contrast_deg_per_step.pan", "ratio_contrast_deg_per_step.tilt"), 0.0)
    true = effective_deg_per_step(with_derived({**BENT, **contrasts}), pose)
    for axis, pair in (("pan", ("left", "right")), ("tilt", ("up", "down"))):
        mean = 0.5 * sum(true[d] for d in pair)
        # Two central differences, with steps of 1e-3 deg and the twin's own.
        assert beam_deg_per_step(BENT, axis, pose) == pytest.approx(mean, rel=1e-6)

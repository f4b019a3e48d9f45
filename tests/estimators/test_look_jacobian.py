"""The Jacobian of looks, put together from its parts, against JAX's own of the whole."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tvsbayes.estimators.likelihood import look_terms
from tvsbayes.estimators.look_jacobian import look_jacobian
from tvsbayes.estimators.looks import observe
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import NOISE_NAMES
from tvsbayes.model.laser_path import mirror_angles

pytestmark = pytest.mark.usefixtures("x64")

ROUNDING = 1e-11
"""Of a derivative, relative to the largest of its column: a hundred operations and the product with the root."""


@pytest.fixture(scope="module")
def both(dozen):
    """(columns put together, columns of the whole), shape (5, parameters, spots), at a point beside the truth."""

    def whole(z, ranges_mm):
        model = dozen.space.model(z)
        angles = mirror_angles(model.transmission, model.tilt_zero_rad, dozen.arrays.moves).angle_rad
        pan, tilt = angles[dozen.arrays.spots.move_index].T
        return observe(model, jnp.stack([pan, tilt, ranges_mm]), dozen.arrays.azimuth_convention)

    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def compute(z):
        looks = look_terms(dozen.space.model(z), dozen.arrays).looks
        parts = jnp.stack(look_jacobian(dozen.space.point(z), dozen.space, looks, dozen.arrays))
        return parts, jax.jacfwd(whole)(z, looks.range_mm).transpose(0, 2, 1), looks

    z = dozen.z + 0.5 * np.random.default_rng(61).standard_normal(len(TWO_MIRROR.names))
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, compute(jnp.asarray(z)))


def test_parts_make_the_whole(both, dozen):
    """Gears, optics, frames, cameras, receiver; harmonics have u = 0 here and columns of zero."""
    parts, whole, _ = both
    count = len(dozen.campaign.spots)
    scale = np.abs(whole[:, :, :count]).max(axis=2, keepdims=True)
    assert np.max(np.abs(parts - whole)[:, :, :count] - ROUNDING * scale) <= 0
    moving = scale[:, :, 0].max(axis=0) > 0
    assert not moving[[TWO_MIRROR.index[name] for name in NOISE_NAMES]].any()
    # Neither the noise scales nor the harmonics (8) nor, without temperatures, the shifts by them (2) move a look.
    assert moving.sum() == len(TWO_MIRROR.names) - len(NOISE_NAMES) - 8 - 2

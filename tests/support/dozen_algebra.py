"""Density and normal equations of the dozen spots at a point, in one compiled function."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tvsbayes.estimators.annealed_stage import Fixed, linear_campaign
from tvsbayes.estimators.likelihood import blocks_filled, innovations, standing
from tvsbayes.instrument.parameters import NAMES, NOISE_NAMES

NOISE = np.isin(NAMES, NOISE_NAMES)


@jax.jit
def _found(z, normals, space, arrays):
    model = space.model(z)
    found = standing(model, arrays)
    terms = {
        "residual": jnp.stack(found.terms.residual, axis=1),
        "slope": jnp.stack([jnp.stack(found.terms.by_pan, 1), jnp.stack(found.terms.by_tilt, 1)], axis=2),
        "log_scale": found.terms.log_scale,
    }
    blocks = blocks_filled(arrays)
    seen = jax.vmap(lambda normal: innovations(model, arrays, normal, blocks))(normals)
    return model, terms, seen


def found_at(spots: Any, z: np.ndarray) -> SimpleNamespace:
    """Everything of one point; errors at places at their means, then moved by each normal number by itself.

    Args:
        spots: something with `space` and `arrays` of JAX.
        z: coordinates, of which the noise scales are held.
    """
    size = 2 * len(spots.arrays.gears.places.steps)
    normals = np.concatenate([np.zeros((1, size)), np.eye(size)])
    arguments = jnp.asarray(z), jnp.asarray(normals), spots.space, spots.arrays
    model, terms, seen = jax.tree.map(np.asarray, _found(*arguments))
    reduced = linear_campaign(np.asarray(z), spots.space, spots.arrays, Fixed(NOISE, np.asarray(z), np.array(1.0)))
    return SimpleNamespace(model=model, terms=SimpleNamespace(**terms), seen=seen, reduced=reduced)

"""Draws of quantities with values that a test chooses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import QUANTITIES
from tvsbayes.model.headlines import MODELLED, Derived


def drawn_quantities(*shape: int, physical: np.ndarray | None = None, **blocks: np.ndarray) -> Derived:
    """Draws of a shape: parameters, and quantities by block (..., entries); what is not named is 0."""
    point = Derived(*(jnp.zeros(n) for n in (len(TWO_MIRROR.names), len(MODELLED), (2, 2), 0)), TWO_MIRROR.key)
    drawn = jax.tree.map(lambda x: np.zeros((*shape, *x.shape)), point)
    if physical is not None:
        drawn.physical[...] = physical
    for block, values in blocks.items():
        names = QUANTITIES.blocks[block]
        for name, each in zip(names, np.moveaxis(np.reshape(values, (*shape, len(names))), -1, 0), strict=True):
            column = (
                drawn.physical[..., TWO_MIRROR.index[name]]
                if name in TWO_MIRROR.index
                else drawn.modelled[..., MODELLED[name]]
            )
            column[...] = each
    return drawn

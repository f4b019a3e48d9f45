"""Density and normal equations of the dozen spots at a point."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from tvsbayes.estimators.annealed_stage import Fixed, linear_campaign
from tvsbayes.instrument.parameters import NAMES, NOISE_NAMES

NOISE = np.isin(NAMES, NOISE_NAMES)


def found_at(evaluate: Callable[..., Any], spots: Any, z: np.ndarray) -> SimpleNamespace:
    """Everything of one point.

    Args:
        evaluate: the fixture.
        spots: something with `space` and `arrays` of JAX.
        z: coordinates, of which the noise scales are held.
    """
    reduced = linear_campaign(np.asarray(z), spots.space, spots.arrays, Fixed(NOISE, np.asarray(z), np.array(1.0)))
    return SimpleNamespace(**vars(evaluate(z, spots.space, spots.arrays)), reduced=reduced)

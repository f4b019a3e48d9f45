"""Proposals of a shape that is known."""

from __future__ import annotations

import numpy as np

from tvsbayes.inference.proposal import Independence
from tvsbayes.inference.tables import LEADER_NODES, NODES, Followers, Tables


def tabulated(mean: np.ndarray, sd: np.ndarray, places: np.ndarray) -> Independence:
    """A proposal whose coordinates at `places` are skewed, Gumbel's density with that mode and scale."""
    at = (NODES - mean[places, None]) / sd[places, None]
    tables, coupled = Tables.normalised(-at - np.exp(-at)), np.flatnonzero(np.arange(len(mean)) % 4 == 0)
    none = no_followers()
    straight = np.zeros(len(mean)), np.eye(len(mean))
    return Independence(mean, sd, places, tables, coupled, none, *straight).moved(mean, sd, tables, none)


def no_followers() -> Followers:
    """Every coordinate has a density of its own."""
    nothing = np.zeros(0, int)
    return Followers(nothing, nothing, Tables(np.zeros((0, len(LEADER_NODES), len(NODES)))))

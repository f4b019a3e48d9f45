"""Tabulated densities of single coordinates and of coordinates given another, with exact draws.

Coordinates w are nearly standard normal; a table is a piecewise linear log density with nodes at `NODES`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tvsbayes.statistics.intervals import WithSd

NODES = np.linspace(-8.0, 12.0, 41)
"""Nodes of the tabulated densities, in w. Noise scales have a long upper tail."""
CUT_NODES = np.array([-8.0, -5.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0])
"""Nodes at which the target is evaluated, a subset of `NODES`: its log is smooth, and few draws lie far out."""
STEP = float(NODES[1] - NODES[0])
FLOOR = -40.0
"""Least tabulated log density relative to its largest: lower values are never drawn, and zero has no logarithm."""
CUT_FLOOR = -1e5
"""Least value of a cut relative to its largest. SciPy takes slopes that differ by less than 1e-9 of the largest
difference as equal: beside a fall by 1e15, which a cut may have, all are equal then."""


def _filled(values: np.ndarray) -> np.ndarray:
    """Fill valleys (..., cuts) to the lower of the maxima on either side.

    A target may fall by 1e5 where the map's steps diverge. A cubic through such a hole overshoots as far beside it, and
    each follower would add that to its leader's density.
    """
    before, behind = values, values[..., ::-1]
    return np.minimum(np.maximum.accumulate(before, axis=-1), np.maximum.accumulate(behind, axis=-1)[..., ::-1])


def between_cuts(log_density: np.ndarray) -> np.ndarray:
    """Interpolate log densities at `NODES` from those at `CUT_NODES` (..., cuts), valleys filled; -inf beside gaps.

    Akima's (1970) cubics are exact for parabolas where cuts are evenly spaced, to 0.2 elsewhere. They are local, since
    the map's own tables have kinks at nodes.
    """
    from scipy.interpolate import Akima1DInterpolator

    none = ~np.isfinite(log_density)
    least = np.min(np.where(none, np.inf, log_density), axis=-1, keepdims=True)
    finite = np.where(none, np.where(np.isfinite(least), least, 0.0), log_density)
    finite = np.maximum(_filled(finite), finite.max(axis=-1, keepdims=True) + CUT_FLOOR)
    below, above = np.searchsorted(CUT_NODES, NODES, "right") - 1, np.searchsorted(CUT_NODES, NODES, "left")
    beside = none[..., below] | none[..., above]
    return np.where(beside, -np.inf, Akima1DInterpolator(CUT_NODES, finite, axis=-1)(NODES))


@dataclass(frozen=True)
class Tables:
    """Densities of single coordinates, zero outside `NODES`; the log, (..., nodes), is piecewise linear between."""

    log_density: np.ndarray

    @classmethod
    def normalised(cls, log_density: np.ndarray) -> Tables:
        """Normalise log densities given up to a constant each, -inf or NaN where undefined."""
        finite = np.where(np.isfinite(log_density), log_density, -np.inf)
        finite = np.maximum(finite - finite.max(axis=-1, keepdims=True), FLOOR)
        return cls(finite - np.log(cls(finite).masses.sum(axis=-1, keepdims=True)))

    @cached_property
    def masses(self) -> np.ndarray:
        """Compute the probability between neighbouring nodes, shape (..., nodes - 1)."""
        low, rise = self.log_density[..., :-1], np.diff(self.log_density)
        steep = np.abs(rise) > 1e-9
        return STEP * np.exp(low) * np.where(steep, np.expm1(rise) / np.where(steep, rise, 1.0), 1.0)

    @cached_property
    def moments(self) -> WithSd[np.ndarray]:
        """Compute means and sds of h coordinates, shape (h,) each, by the trapezoid rule with ten points per step."""
        x = np.linspace(NODES[0], NODES[-1], 10 * (len(NODES) - 1) + 1)
        lines = np.array([np.interp(x, NODES, each) for each in self.log_density])
        density = np.exp(lines.reshape(len(self.log_density), len(x)))
        density /= density.sum(axis=1, keepdims=True)
        mean = density @ x
        return WithSd(mean, np.sqrt(density @ x**2 - mean**2))

    @cached_property
    def reached(self) -> np.ndarray:
        """Compute the probability below each node but the last, shape (..., nodes - 1)."""
        below = np.cumsum(self.masses, axis=-1)[..., :-1]
        return np.concatenate([np.zeros((*below.shape[:-1], 1)), below], axis=-1)

    def at(self, w: np.ndarray) -> np.ndarray:
        """Compute log densities of w (n, h)."""
        return _line_at(w, self.log_density)

    def draw(self, share: np.ndarray) -> np.ndarray:
        """Compute the quantiles (n, h) of these shares (n, h)."""
        return _point_below(share, self.log_density, self.reached)


def _line_at(w: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Interpolate piecewise linear functions (..., h, nodes) at w (n, h), -inf outside the nodes."""
    place = (w - NODES[0]) / STEP
    node = np.clip(np.nan_to_num(place).astype(int), 0, len(NODES) - 2)
    low, high = (_at_node(lines, node + k) for k in (0, 1))
    inside = (w >= NODES[0]) & (w <= NODES[-1])
    return np.where(inside, low + (place - node) * (high - low), -np.inf)


def _at_node(rows: np.ndarray, node: np.ndarray) -> np.ndarray:
    """Take the entries `node` (n, h) of rows (..., h, nodes)."""
    return np.take_along_axis(np.broadcast_to(rows, (*node.shape, rows.shape[-1])), node[..., None], axis=-1)[..., 0]


def _point_below(share: np.ndarray, lines: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Compute quantiles of shares (n, h) from log densities (..., h, nodes) and cumulative probabilities `reached`."""
    node = np.sum(share[..., None] >= reached, axis=-1) - 1
    low, above = _at_node(lines, node), _at_node(lines, node + 1)
    slope = (above - low) / STEP
    rest = (share - _at_node(reached, node)) * np.exp(-low)
    steep = np.abs(slope) > 1e-9
    along = np.where(steep, np.log1p(rest * slope) / np.where(steep, slope, 1.0), rest)
    return NODES[node] + np.clip(along, 0.0, STEP)


LEADER_NODES = np.linspace(-4.0, 4.0, 7)
"""Values of a leader, in w, at which its follower has a table each."""


@dataclass(frozen=True)
class Followers:
    """Coordinates whose density depends on another: of two scales that explain the same scatter only one can be large.

    Between two nodes of the leader the density is a mixture of their tables. A follower has one leader and may be one.

    Attributes:
        leader, follower: rows among the tabulated coordinates, leaders before their followers, shape (f,) each.
        tables: densities of the follower by the leader's node, shape (f, leader nodes, nodes).
    """

    leader: np.ndarray
    follower: np.ndarray
    tables: Tables

    def _share(self, leaders: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the node below leaders (n, ...) and the share of the node above."""
        at = np.clip((leaders - LEADER_NODES[0]) / (LEADER_NODES[1] - LEADER_NODES[0]), 0, len(LEADER_NODES) - 1)
        node = np.minimum(at.astype(int), len(LEADER_NODES) - 2)
        return node, at - node

    def at(self, w: np.ndarray) -> np.ndarray:
        """Compute log densities of the followers, shape (n, f), at tabulated coordinates w (n, h)."""
        (node, above), each = self._share(w[:, self.leader]), np.arange(len(self.leader))
        low, high = (_line_at(w[:, self.follower], self.tables.log_density[each, node + k]) for k in (0, 1))
        with np.errstate(divide="ignore"):
            return np.logaddexp(np.log1p(-above) + low, np.log(above) + high)

    def drawn(self, w: np.ndarray, share: np.ndarray, chance: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Draw followers again, except those kept; tabulated coordinates (n, h).

        Args:
            w: coordinates; leaders keep these values.
            share: uniform numbers for the densities, shape (n, h).
            chance: uniform numbers for the mixtures, shape (n, f).
            kept: shape (n, h), boolean.
        """
        result, tables = w.copy(), self.tables
        for k, (leader, follower) in enumerate(zip(self.leader, self.follower, strict=True)):
            node, above = self._share(result[:, leader])
            chosen = k, node + (chance[:, k] < above)
            new = _point_below(share[:, follower], tables.log_density[chosen], tables.reached[chosen])
            result[:, follower] = np.where(kept[:, follower], w[:, follower], new)
        return result

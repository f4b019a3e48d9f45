"""Probabilities of the possible sides of unrecorded homings, by the evidence of the fits under each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.instrument.homing import ANYWHERE, Sides, every_way, ways

WORTH_A_FIT = 0.02
"""Least probability of a homing hypothesis: one below shifts a mean by at most 1/50 of its difference."""


@dataclass(frozen=True)
class WeighedWay:
    """A homing hypothesis, side by axis, and its probability among all ways that were fitted."""

    sides: Sides
    probability: float


def most_fits(axes: Sequence[str]) -> int:
    """Return the largest number of ways that `weighed` evaluates."""
    return len(every_way(axes)) if axes else 0


def weighed(axes: Sequence[str], evidence: Callable[[Sides], float]) -> tuple[WeighedWay, ...]:
    """Compute the probabilities of homing hypotheses, most probable first.

    Ways of one axis are compared with the other axis' homing left open, then likely ways jointly.

    Args:
        axes: axes with unrecorded sides, at least one.
        evidence: log evidence of the fit under a way, including its prior probability; may be called again for a way.
    """
    open_sides = dict.fromkeys(axes, ANYWHERE)
    alone = {axis: {side: evidence({**open_sides, axis: side}) for side in ways(axis)} for axis in axes}
    expected = [(sides, sum(alone[axis][side] for axis, side in sides.items())) for sides in every_way(axes)]
    highest = max(value for _, value in expected)
    likely = [(sides, evidence(sides)) for sides, value in expected if value > highest + np.log(WORTH_A_FIT)]
    values = np.array([value for _, value in likely])
    chance = np.exp(values - values.max())
    chance /= chance.sum()
    return tuple(WeighedWay(likely[k][0], float(chance[k])) for k in np.argsort(-chance))

"""How probable each way is in which axes came home that nobody recorded, by the evidence of the fits under them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.instrument.homing import ANYWHERE, Sides, every_way, ways

WORTH_A_FIT = 0.02
"""Probability from which a way of homing takes part in the posterior: one below adds a fiftieth of its own distance to
a mean."""


@dataclass(frozen=True)
class WeighedWay:
    """A way of homing, side by axis, and its probability among all ways that were fitted."""

    sides: Sides
    probability: float


def most_fits(axes: Sequence[str]) -> int:
    """How many ways `weighed` asks for, at most."""
    return len(every_way(axes)) if axes else 0


def weighed(axes: Sequence[str], evidence: Callable[[Sides], float]) -> tuple[WeighedWay, ...]:
    """Ways of homing, most probable first.

    Ways of one axis are weighed with the other axis' homing left open, then together where both may matter.

    Args:
        axes: whose sides nobody recorded, at least one.
        evidence: log evidence of the fit under a way, its prior chance included; asked for one way more than once.
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

"""From which side a machine comes home: what nobody recorded, as a few ways that data can tell apart (formulation 3.1).

Always from one side, always from the other, or from anywhere anew; a way for each axis whose first rows all say
`unknown`. A single unknown among recorded homings stays "anywhere".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

from tvsbayes.instrument.axes import AXES, DIRECTION_SIGNS
from tvsbayes.instrument.campaign import Campaign, Move

ANYWHERE = "anywhere"
ONE_SIDED_CHANCE = 0.45
"""Prior probability of each side; the rest is "anywhere". Firmware homes onto a switch, always the same way."""

type Sides = Mapping[str, str]
"""Way of homing by axis: one of its two sides, or `ANYWHERE`."""


def unrecorded(moves: Sequence[Move]) -> tuple[str, ...]:
    """Axes of which no homing side was recorded."""
    return tuple(axis for axis in AXES if {getattr(m, f"{axis}_approach") for m in moves} <= {"", "unknown"})


def ways(axis: str) -> dict[str, float]:
    """Ways in which an axis may come home, with their prior probabilities."""
    sides = (side for side, (of, _) in DIRECTION_SIGNS.items() if of == axis)
    return {**dict.fromkeys(sides, ONE_SIDED_CHANCE), ANYWHERE: 1 - 2 * ONE_SIDED_CHANCE}


def every_way(axes: Sequence[str]) -> list[dict[str, str]]:
    """All combinations for some axes."""
    return [dict(zip(axes, chosen, strict=True)) for chosen in product(*(ways(axis) for axis in axes))]


def prior_chance(sides: Sides) -> float:
    """Of a combination: axes are independent."""
    chance = 1.0
    for axis, side in sides.items():
        chance *= ways(axis)[side]
    return chance


def homed(campaign: Campaign, sides: Sides) -> Campaign:
    """The campaign as if its axes had come home in these ways."""
    stated = {f"{axis}_approach": side for axis, side in sides.items() if side != ANYWHERE}
    if not stated:
        return campaign

    def one(move: Move) -> Move:
        first: dict[str, Any] = {name: side for name, side in stated.items() if getattr(move, name) == "unknown"}
        return replace(move, **first) if first else move

    return replace(campaign, moves=tuple(map(one, campaign.moves)))

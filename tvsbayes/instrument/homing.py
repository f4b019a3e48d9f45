"""Unrecorded homing sides as a few hypotheses that the data can distinguish (formulation 3.1).

Homing ends always at one side, always at the other, or anywhere each time; each axis whose first rows all say `unknown`
has one such hypothesis ("way"), unless it has no play or an absolute encoder. A single unknown among recorded homings
stays "anywhere".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

from tvsbayes.instrument.axes import AXES, SIDES
from tvsbayes.instrument.campaign import Campaign, Move
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.rig import RigTable

ANYWHERE = "anywhere"
ONE_SIDED_CHANCE = 0.45
"""Prior probability of each side; the rest is "anywhere". Firmware homes onto a switch, always in one direction."""

type Sides = Mapping[str, str]
"""Way of homing by axis: one of its two sides, or `ANYWHERE`."""


def has_play(priors: Mapping[str, Prior], axis: str) -> bool:
    """Whether an axis may have play, by its priors."""
    names = f"backlash_deg.{axis}", f"play_variation_deg.{axis}"
    return any(priors[name].u > 0 or priors[name].value > 0 for name in names)


def unrecorded(moves: Sequence[Move], rig: RigTable) -> tuple[str, ...]:
    """Axes with play without any recorded homing side.

    An absolute encoder is not homed: an unknown side at the first row of a segment is any, until the axis reverses.
    """
    driven = (axis for axis in AXES if axis not in rig.absolute and has_play(rig.priors, axis))
    return tuple(axis for axis in driven if {getattr(m, f"{axis}_approach") for m in moves} <= {"", "unknown"})


def scatter_of_prior(axes: Sequence[str]) -> str:
    """Say that the scatter of homings of these axes is their priors'."""
    words = " and of ".join(axes)
    return f"the scatter of homings of {words} is the prior's, home_sd_deg in [rig.prior]: the campaign has one homing"


def ways(axis: str) -> dict[str, float]:
    """Homing hypotheses of an axis, with their prior probabilities."""
    return {**dict.fromkeys(reversed(SIDES[axis]), ONE_SIDED_CHANCE), ANYWHERE: 1 - 2 * ONE_SIDED_CHANCE}


def every_way(axes: Sequence[str]) -> list[dict[str, str]]:
    """All combinations of ways of the axes."""
    return [dict(zip(axes, sides, strict=True)) for sides in product(*(ways(axis) for axis in axes))]


def prior_chance(sides: Sides) -> float:
    """Prior probability of a combination: axes are independent."""
    return math.prod((ways(axis)[side] for axis, side in sides.items()), start=1.0)


def homed(campaign: Campaign, sides: Sides) -> Campaign:
    """The campaign with these homing sides in place of unknown sides."""
    stated = {f"{axis}_approach": side for axis, side in sides.items() if side != ANYWHERE}
    if not stated:
        return campaign

    def with_sides(move: Move) -> Move:
        changes: dict[str, Any] = {name: side for name, side in stated.items() if getattr(move, name) == "unknown"}
        return replace(move, **changes) if changes else move

    return replace(campaign, moves=tuple(map(with_sides, campaign.moves)))

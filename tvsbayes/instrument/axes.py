"""Pan and tilt: names, directions of motion and their signs, sides of approach, constants of an axis.

A counter increases when pan turns left and tilt goes up. A side of approach is the direction of the last move.
"""

from __future__ import annotations

from typing import Literal

from tvsbayes.errors import InputError, escaped

Axis = Literal["pan", "tilt"]
PanApproach = Literal["left", "right", "unknown"]
TiltApproach = Literal["up", "down", "unknown"]

SENSES: dict[Axis, tuple[str, str]] = {"pan": ("left", "right"), "tilt": ("up", "down")}
"""Direction of positive and of negative motion of an axis; all other tables of axes follow from it."""
AXES: tuple[Axis, Axis] = ("pan", "tilt")
DIRECTIONS = (*SENSES["pan"], *SENSES["tilt"])
SIDES: dict[str, tuple[str, str]] = {axis: (negative, positive) for axis, (positive, negative) in SENSES.items()}
"""Approach sides of an axis, negative first."""
DIRECTION_SIGNS: dict[str, tuple[Axis, int]] = {
    direction: (axis, sign) for axis, pair in SENSES.items() for direction, sign in zip(pair, (1, -1), strict=True)
}
"""Axis and sense of motion by direction."""
APPROACH_SIGN = {**{direction: sign for direction, (_, sign) in DIRECTION_SIGNS.items()}, "unknown": 0}
"""Sense of motion of an approach (formulation 2)."""
HOME_APPROACH: tuple[PanApproach, TiltApproach] = ("left", "up")
"""Default side from which homing ends, per axis."""
FULL_TURN_DEG = 360.0
"""Period of the wheel (the output member); a shorter one is the pinion's."""


def direction_of(axis: str, change: float) -> str:
    """Direction of a motion of an axis by the sign of its change; "" for zero (no motion, or unknown)."""
    return SIDES[axis][int(change > 0)] if change else ""


def bad_approach(axis: str, name: object, allowed: tuple[str, ...]) -> InputError:
    """The error for an approach that the axis does not allow."""
    return InputError(
        "approach",
        f"{axis} approach {escaped(str(name))!r}; allowed: {', '.join(allowed)}",
        column=f"{axis}_approach",
        found=escaped(str(name)),
        allowed=", ".join(allowed),
        remedy="name the direction of the last move of the axis",
    )


def sides_of(approach: tuple[str, str]) -> tuple[float, float]:
    """+1, -1 or 0 for the approach of (pan, tilt).

    Raises:
        InputError: a side that the axis does not have.
    """
    for axis, name in zip(AXES, approach, strict=True):
        allowed = (*SENSES[axis], "unknown")
        if name not in allowed:
            raise bad_approach(axis, name, allowed)
    return float(APPROACH_SIGN[approach[0]]), float(APPROACH_SIGN[approach[1]])

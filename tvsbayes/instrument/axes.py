"""Pan and tilt, their sides, signs and turns."""

from __future__ import annotations

from operator import attrgetter

from tvsbayes.errors import InputError, escaped

AXES = ("pan", "tilt")
SIDES = {"pan": ("right", "left"), "tilt": ("down", "up")}
"""Approach sides of an axis, negative first."""


def bad_approach(axis: str, name: object, allowed: tuple[str, ...]) -> InputError:
    """The refusal of an approach that is not allowed for the axis."""
    return InputError(
        "approach",
        f"{axis} approach {escaped(str(name))!r}; allowed: {', '.join(allowed)}",
        column=f"{axis}_approach",
        found=escaped(str(name)),
        allowed=", ".join(allowed),
        remedy="name the direction of the last move of the axis",
    )


def sides_of(approach: tuple[str, str]) -> tuple[float, float]:
    """+1, -1 or 0 for the approach of (pan, tilt)."""
    for axis, name in zip(AXES, approach, strict=True):
        allowed = (*SIDES[axis][::-1], "unknown")
        if name not in allowed:
            raise bad_approach(axis, name, allowed)
    return float(APPROACH_SIGN[approach[0]]), float(APPROACH_SIGN[approach[1]])


APPROACH_SIGN = {"left": 1, "up": 1, "right": -1, "down": -1, "unknown": 0}
"""Sense of motion of an approach (DESIGN 2)."""
DIRECTION_SIGNS = {"left": ("pan", 1), "right": ("pan", -1), "up": ("tilt", 1), "down": ("tilt", -1)}
DIRECTIONS = ("left", "right", "up", "down")
PIXELS = attrgetter("u_left_px", "v_left_px", "u_right_px", "v_right_px")
FULL_TURN_DEG = 360.0
"""Period of the wheel (the output member); a shorter one is the pinion's."""
HOME_SD_DEG = 0.05
"""Standard deviation of the home offset of every segment after the first (DESIGN 3.2, fixed)."""

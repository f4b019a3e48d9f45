"""Inverse optics: mirror angles and counters that aim the beam at a point or along a direction.

Frame T (see `optics`), mm, degrees, counters in steps; best estimates in Python floats, one target at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.optics import Ray, Vector, ahead, beam_components, output_deg
from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import APPROACH_SIGN, AXES, SIDES, bad_approach
from tvsbayes.instrument.mechanisms import mechanism_of

AIM_STEPS, AIM_RAD = 40, 1e-11


@dataclass(frozen=True, repr=False)
class Steps(Shown):
    """Counters that aim the beam at a target.

    Attributes:
        pan_steps, tilt_steps: absolute counters.
        approach: last move of each axis, (left or right, up or down).
        via_pan_steps, via_tilt_steps: counters to go to first; the move from there takes up all play with a probability
            of `CLEARED_PROBABILITY`.
        ray: the beam at these counters.
        xyz_mm: the point on it nearest to the target, or None for a direction.
        aperture_deg: expected reading of the aperture there, or None.
        rounding_mm, rounding_deg: distance from the target due to whole steps.
        u95_mm, u95_deg: 95 % half widths of the beam's position at the point (3,), or of its azimuth and elevation.
        extrapolated: whether the counters are outside those of the campaign's looks; gear errors are extrapolated then.
        unseen: the axis and range concerned, in words.
    """

    pan_steps: int
    tilt_steps: int
    approach: tuple[str, str]
    via_pan_steps: int
    via_tilt_steps: int
    ray: Ray
    xyz_mm: np.ndarray | None = None
    aperture_deg: float | None = None
    rounding_mm: float | None = None
    rounding_deg: float | None = None
    u95_mm: np.ndarray | None = None
    u95_deg: np.ndarray | None = None
    extrapolated: bool = False
    unseen: str = ""

    def shown(self) -> View:
        """Show the counters to go to, in order."""
        pan, tilt = self.approach
        title = f"Steps: arrive by moving {pan} and {tilt}"
        title += f", EXTRAPOLATED: {self.unseen}, where looks were" * self.extrapolated
        rows = [
            ("first, which takes up the play", self.via_pan_steps, self.via_tilt_steps),
            ("then", self.pan_steps, self.tilt_steps),
        ]
        return View(title, ("go to", "pan, steps", "tilt, steps"), rows)

    def as_json(self) -> dict[str, object]:
        """Return the document of `steps-for`."""

        def plain(value: object) -> object:
            return value.tolist() if isinstance(value, np.ndarray) else value

        document = {key: plain(value) for key, value in vars(self).items() if key not in ("ray", "approach")}
        document["approach"] = dict(zip(AXES, self.approach, strict=True))
        document["ray"] = {key: plain(getattr(self.ray, key)) for key in ("origin_mm", "direction")}
        return document


@dataclass(frozen=True)
class Direction:
    """A target direction: azimuth atan2(d_y, d_x), the emission angle C less 90 deg, and elevation asin(d_z)."""

    azimuth_deg: float
    elevation_deg: float

    @property
    def finite(self) -> bool:
        """Whether both angles are finite."""
        return math.isfinite(self.azimuth_deg) and math.isfinite(self.elevation_deg)

    @property
    def ahead(self) -> bool:
        """Whether it points away from the baseline forwards."""
        return self.finite and abs(self.azimuth_deg) < 90

    def seen_from(self, origin: Vector) -> Direction:
        """Return the direction itself, which does not depend on the origin."""
        return self


@dataclass(frozen=True)
class Point:
    """A target point (3,), mm."""

    xyz_mm: np.ndarray

    @property
    def finite(self) -> bool:
        """Whether all coordinates are finite."""
        return bool(np.all(np.isfinite(self.xyz_mm)))

    @property
    def ahead(self) -> bool:
        """Whether the point is in front of the baseline."""
        return self.finite and bool(ahead(float(self.xyz_mm[0])))

    def seen_from(self, origin: Vector) -> Direction:
        """Compute the direction to it from the origin of a beam."""
        x, y, z = (float(t) - c for t, c in zip(self.xyz_mm, origin, strict=True))
        return Direction(math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y))))


def mirror_angles(values: Mapping[str, float], target: Point | Direction) -> tuple[float, float]:
    """Compute mirror angles (pan, tilt) of the beam through a point or along a direction, degrees.

    A mirror angle rotates the beam by nearly as much, so that plain correction converges.

    Args:
        values: best estimates by name.
        target: point or direction.

    Raises:
        InputError: no mirror angles aim the beam there.
    """
    pan_deg = tilt_deg = 0.0
    # A scanner cannot locate points behind its baseline.
    for _ in range(AIM_STEPS if target.ahead or (mechanism_of(values).all_round and target.finite) else 0):
        beam = beam_components(values, pan_deg, tilt_deg, math)
        goal, (x, y, z) = target.seen_from(beam.origin), beam.direction
        azimuth = math.remainder(goal.azimuth_deg - math.degrees(math.atan2(y, x)), 360.0)
        elevation = goal.elevation_deg - math.degrees(math.atan2(z, math.hypot(x, y)))
        if max(abs(azimuth), abs(elevation)) < math.degrees(AIM_RAD):
            return pan_deg, tilt_deg
        pan_deg, tilt_deg = pan_deg + azimuth, tilt_deg + elevation
        if abs(tilt_deg) > 90:
            break
    raise InputError(
        "out-of-reach",
        "no mirror angles send the beam there",
        allowed="points in front of the scanner and farther from it than the mirrors, elevations below 80 deg",
        remedy="check the target's frame: x depth, y along the baseline towards the positioner, z up, mm",
    )


@dataclass(frozen=True)
class Arrival:
    """Approach of an axis to a counter: `via_steps` first, then `steps`, reached on `side`."""

    side: str
    steps: int
    via_steps: int


@dataclass(frozen=True)
class Drive:
    """Conversion of one axis between counters and mirror angles.

    Attributes:
        axis: pan or tilt.
        values_at: best estimates by name, with the errors of the gears at a counter of this axis.
        period_deg: period of its transmission error, None without one.
        overshoot_steps: steps that take up all its play.
    """

    axis: str
    values_at: Callable[[float], Mapping[str, float]]
    period_deg: float | None
    overshoot_steps: int

    @property
    def ratio(self) -> float:
        """Return the mean degrees per step."""
        return self.values_at(0.0)[f"degrees_per_step.{self.axis}"]

    def counter(self, angle_deg: float, side: int) -> int:
        """Compute the counter whose mirror angle is nearest to a given one, reached on a side (+1 left or up, -1)."""
        return round(self.position(angle_deg, side))

    def position(self, angle_deg: float, side: int) -> float:
        """Compute the counter, before rounding, at which the mirror has an angle, reached on a side."""
        ratio, steps = self.ratio, 0.0
        for _ in range(AIM_STEPS):
            at = output_deg(self.values_at(steps), self.axis, steps, side, self.period_deg, math)
            change = float((angle_deg - at) / ratio)
            steps += change
            if abs(change) < 1e-9:
                break
        return steps

    def arrival(self, angle_deg: float, side: str | None, limits: tuple[float, float] | None) -> Arrival:
        """Plan the approach to a mirror angle; the default side is left or up, else the other one within limits.

        Args:
            angle_deg: wanted mirror angle.
            side: wanted side, or None.
            limits: lowest and highest counter, or None.

        Raises:
            InputError: there is no such side, or counters are outside the limits.
        """
        negative, positive = SIDES[self.axis]
        low, high = (-math.inf, math.inf) if limits is None else limits
        for name in (positive, negative) if side is None else (side,):
            if name not in SIDES[self.axis]:
                raise bad_approach(self.axis, name, SIDES[self.axis][::-1])
            sign = APPROACH_SIGN[name]
            steps = self.counter(angle_deg, sign)
            ratio_sign = 1 if self.ratio > 0 else -1
            first = steps - sign * ratio_sign * self.overshoot_steps
            if low <= steps <= high and low <= first <= high:
                return Arrival(name, steps, first)
        raise InputError(
            "outside-limits",
            f"{self.axis}: the target needs counter {steps}, approached from {first}",
            column=self.axis,
            found=f"{steps} and {first}",
            allowed=f"{low:g} to {high:g}",
            remedy="choose a target inside the limits, or widen them in [positioner] if the machine allows",
        )

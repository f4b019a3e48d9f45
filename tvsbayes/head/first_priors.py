"""First priors of a head from its sightings: ratios and zeros by a line over the counters, or by encoders."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np

from tvsbayes.importing.sightings import STEP_DEG
from tvsbayes.instrument.axes import AXES, Axis
from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.sightings import Sighting

ENCODER_U, LINE_U, CONTRAST_U = 0.01, 0.1, 0.003
"""Relative u of a ratio from an encoder's scale, from a line through the table, and of a contrast of directions."""
ZERO_U_DEG, FAR_ZERO_DEG = 10.0, 20.0
"""u of the angle at counter 0 by that line, and the least stated angle: smaller ones are within the default prior."""
OFF_LINE_DEG = 10.0
"""Median distance of sightings from the line over their counters, above which the line gives no ratio."""
BY_LINE = "by a line through the table; correct it in [rig.prior]"
ANGLES = ("azimuth_deg", "elevation_deg")
COUNTERS = ("pan_steps", "tilt_steps")


def first_priors(
    moves: Sequence[Move], sightings: Sequence[Sighting], encoders: Set[str], assumed: list[str]
) -> dict[str, Prior]:
    """Priors of ratios and contrasts from encoders' steps, or from a line through the sightings; zeros far from 0."""
    priors: dict[str, Prior] = {}
    for axis, field, angle in zip(AXES, COUNTERS, ANGLES, strict=True):
        line = _line(moves, sightings, axis)
        if line is not None and line.slope_deg < 0:
            remedy = f"add --flip {field}, or exchange two columns by --column"
            assumed.append(f"{field}: falls where {angle} grows; {remedy}")
        elif line is not None and abs(line.zero_deg) > FAR_ZERO_DEG:
            name = angle.replace("_deg", "_zero_deg")
            priors[name] = Prior(line.zero_deg, ZERO_U_DEG)
            assumed.append(f"{name}: {line.zero_deg:.3g}, u {ZERO_U_DEG:g}, {BY_LINE}")
        ratio, u = STEP_DEG, ENCODER_U
        if axis not in encoders:
            if line is None:
                continue
            ratio, u = abs(line.slope_deg), LINE_U
            assumed.append(f"degrees_per_step.{axis}: {ratio:.3g} deg, u {LINE_U:.0%}, {BY_LINE}")
        priors[f"degrees_per_step.{axis}"] = Prior(ratio, u * ratio)
        priors[f"ratio_contrast_deg_per_step.{axis}"] = Prior(0.0, CONTRAST_U * ratio)
    return priors


def _line(moves: Sequence[Move], sightings: Sequence[Sighting], axis: Axis) -> Line | None:
    """`line_of` the sighted angles over the counters of an axis."""
    field, angle = COUNTERS[AXES.index(axis)], ANGLES[AXES.index(axis)]
    ok = [s for s in sightings if s.status == "ok"]
    counters = np.array([getattr(moves[s.move], field) for s in ok], float)
    return line_of(counters, np.array([getattr(s, angle) for s in ok], float))


def falls(moves: Sequence[Move], sightings: Sequence[Sighting], axis: Axis) -> bool:
    """Whether counters clearly decrease where the angle grows."""
    line = _line(moves, sightings, axis)
    return line is not None and line.slope_deg < 0


@dataclass(frozen=True)
class Line:
    """A line of angles over counters: degrees per step, and the angle at counter 0, -180 to 180."""

    slope_deg: float
    zero_deg: float


def line_of(counters: np.ndarray, angles_deg: np.ndarray) -> Line | None:
    """Fit a line to angles known up to full turns, shape (n,) each; None where no line fits."""
    order = np.argsort(counters, kind="stable")
    steps, angles = counters[order], np.unwrap(angles_deg[order], period=360.0)
    if len(np.unique(steps)) < 3:
        return None
    slope, level = np.polyfit(steps, angles, 1).tolist()
    off = float(np.median(np.abs(angles - slope * steps - level)))
    return Line(slope, math.remainder(level, 360.0)) if off < OFF_LINE_DEG and slope != 0.0 else None

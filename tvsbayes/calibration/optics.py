"""The optics in components: counters to mirror angles, beams, ranges and aperture readings, in NumPy.

The same functions take one pose in Python floats (`m` = `math`) and many parameter sets in arrays (`m` = `numpy`, also
complex, for derivatives). Frame T: origin mid-baseline, x depth, y along the baseline towards the positioner at +a/2, z
up; mm, degrees, steps. Parameters are given by name, in the units of their names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import numpy as np

from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG
from tvsbayes.instrument.chains import chain_of
from tvsbayes.instrument.mechanisms import mechanism_of
from tvsbayes.instrument.parameters import BLOCKS, HARMONIC_ORDERS

ERROR_AT, PLAY_AT = "transmission_error_at_deg", "play_variation_at_deg"
GEAR_INPUTS: tuple[str, ...] = tuple(f"{kind}.{axis}" for kind in (ERROR_AT, PLAY_AT) for axis in AXES)
"""Gear errors of a look: transmission error and change of play at its counters, deg."""
ROUNDING = 1e-12
"""Rounding of coordinates, relative to the range."""
TO_RAD = math.pi / 180
type Number = float | np.ndarray
"""One pose in Python floats, or arrays of one shape."""
type Vector = tuple[Number, Number, Number]
"""x, y, z of frame T."""
type Values = Mapping[str, Number]
"""Parameters by name."""


@dataclass(frozen=True)
class Ray:
    """A beam: it leaves the positioner at `origin_mm` along the unit vector `direction`; shape (3, ...).

    `extrapolated` is whether its counters are outside those of the campaign's looks, `frame` its frame. `covariance`,
    where requested, is that of origin (mm) and direction (no unit) of a single arrival, shape (6, 6).
    """

    origin_mm: np.ndarray
    direction: np.ndarray
    extrapolated: bool = False
    frame: str = "T"
    covariance: np.ndarray | None = None


def _harmonic(values: Values, axis: str, angle_deg: Number, period_deg: float, m: ModuleType) -> Number:
    """Compute the transmission error at an angle, degrees (formulation 3.1)."""
    total: Number = 0.0
    for order in HARMONIC_ORDERS:
        phase = 2 * math.pi * order * angle_deg / period_deg
        total = total + values[f"harmonic_deg.{axis}.{order}.cos"] * m.cos(phase)
        total = total + values[f"harmonic_deg.{axis}.{order}.sin"] * m.sin(phase)
    return total


def output_deg(
    values: Values, axis: str, steps: Number, side: Number, period_deg: float | None, m: ModuleType = np
) -> Number:
    """Compute the mirror angle of an axis after homing: q = k n, play taken up on the approach side (formulation 3.1).

    Args:
        values: parameters by name; floats, or arrays of one shape. With repeating errors, also those at this counter,
            by `GEAR_INPUTS`.
        axis: pan or tilt.
        steps: absolute counter.
        side: +1 reached left or up, -1 right or down, any number between for a position in the play.
        period_deg: period of the transmission error, None without one.
        m: `math` for floats, `numpy` for arrays.
    """
    q = values[f"degrees_per_step.{axis}"] * steps
    if period_deg is not None and period_deg != FULL_TURN_DEG:
        q = q + _harmonic(values, axis, q, period_deg, m)
    output = q - 0.5 * side * values[f"backlash_deg.{axis}"]
    if period_deg == FULL_TURN_DEG:
        output = output + _harmonic(values, axis, output, period_deg, m)
    if (error := values.get(f"{ERROR_AT}.{axis}")) is not None:
        output = output + error - 0.5 * side * values[f"{PLAY_AT}.{axis}"]
    return output if axis == "pan" else output + values[mechanism_of(values).tilt_zero]


def ahead(x_mm: Number) -> bool | np.ndarray:
    """Whether a depth is in front of the baseline, as required for triangulation."""
    return x_mm.real > 0


class Components(NamedTuple):
    """Origin and direction of a beam, in components."""

    origin: Vector
    direction: Vector

    def at(self, range_mm: Number) -> np.ndarray:
        """Compute points at ranges along it, first axis x, y, z."""
        return np.array([o + range_mm * d for o, d in zip(self.origin, self.direction, strict=True)])

    def met(self, range_mm: Number) -> np.ndarray:
        """Compute points at ranges; NaN where the range is invalid or the point is behind the baseline."""
        points = self.at(np.where((np.asarray(range_mm).real > 0) & np.isfinite(range_mm), range_mm, np.nan))
        # Complex numbers carry derivatives: both parts are NaN.
        return np.where(ahead(points[0]), points, complex(np.nan, np.nan) if np.iscomplexobj(points) else np.nan)


def beam_components(values: Values, pan_deg: Number, tilt_deg: Number, m: ModuleType = np) -> Components:
    """Compute origin and unit direction of the beam in frame T for mirror angles (formulation 3.2 and 2)."""
    psi, beta, to_t = pan_deg * TO_RAD, tilt_deg * TO_RAD, (values["pan_zero_emission_deg"] - 90.0) * TO_RAD

    def block(name: str) -> Number | list[Number]:
        names = BLOCKS[name]
        entries = [values[entry] * TO_RAD if "_deg" in name else values[entry] for entry in names]
        return entries if len(entries) > 1 else entries[0]

    beam = chain_of(mechanism_of(values), block).leaving_turned(psi, beta, to_t, m)
    x, y, z = beam.origin_mm
    return Components((x, y + 0.5 * values["baseline_mm"], z), beam.direction)


def range_components(
    origin: Vector, direction: Vector, baseline_mm: Number, aperture_deg: Number, azimuth: bool, m: ModuleType = np
) -> Number:
    """Compute the range along the beam at which the aperture sees it under angle B, mm (formulation 5), in closed form.

    With w the beam's origin seen from the aperture and c = cos B, the in-plane reading requires (w + r d)_y = c |w + r
    d|. Squared this is a quadratic in r whose discriminant is c^2 S^2, S^2 = |m|^2 sin^2 B - m_y^2 with the moment m =
    w x d. The root on B's own nappe is r = (w_y^2 - c^2 |w|^2) / (c S - w_y d_y + c^2 w.d), which has no 0/0 at B = 90
    deg, nor where the beam runs parallel to the cone's opposite side; the denominator vanishes where beam and line of
    sight are parallel. On the baseline's plane it is a sin B / sin(B + C). It is the right root for beams that start on
    the positioner's side of the aperture (w_y > 0).

    It is NaN where the beam misses the cone or half-plane of B, and zero, negative or minus infinite where only its
    backward extension or the other nappe is met.
    """
    x, y, z = origin
    u, v, w = direction
    y = y + 0.5 * baseline_mm
    sin_b, cos_b = m.sin(aperture_deg * TO_RAD), m.cos(aperture_deg * TO_RAD)
    if azimuth:
        closing = u * cos_b - v * sin_b
        if m is math and closing == 0:
            return math.inf
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (y * sin_b - x * cos_b) / closing
            ahead = (x + reach * u) * sin_b + (y + reach * v) * cos_b
        # The other half of B's plane is behind the aperture.
        return (reach if ahead >= 0 else math.nan) if m is math else np.where(ahead >= 0, reach, np.nan)
    mx, my, mz = y * w - z * v, z * u - x * w, x * v - y * u
    inside = (mx * mx + mz * mz) * sin_b * sin_b - my * my * cos_b * cos_b
    root: Number
    if m is math:
        if inside < 0:
            return math.nan
        root = math.sqrt(inside)
    else:
        # For complex numbers NumPy would return a root of a negative number.
        root = np.sqrt(np.where(np.real(inside) < 0, np.nan, inside))
    across = x * u + y * v + z * w
    reach = y * y - cos_b * cos_b * (x * x + y * y + z * z)
    closing = cos_b * root - (y * v - cos_b * cos_b * across)
    if m is math and closing == 0:
        return math.inf
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = reach / closing
        # At B = 90 deg both nappes are one plane, and y is zero except for rounding.
        faces = (y + reach * v) * cos_b >= -ROUNDING * abs(reach * cos_b)
    return (reach if faces else -math.inf) if m is math else np.where(faces | np.isnan(reach), reach, -np.inf)


def aperture_angle_deg(point: Vector, baseline_mm: Number, azimuth: bool, m: ModuleType = np) -> Number:
    """Compute the angle B of a point (x, y, z) of frame T at the aperture, degrees, without the aperture's zero."""
    x, y, z = point
    lateral = x if azimuth else m.hypot(x, z)
    arc_tangent = math.atan2 if m is math else np.arctan2
    return arc_tangent(lateral, y + 0.5 * baseline_mm) / TO_RAD


def unit_vector(azimuth_deg: Number, elevation_deg: Number) -> np.ndarray:
    """Compute unit vectors in frame T, first axis x, y, z; azimuth atan2(y, x), elevation asin(z)."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def beam_angle_deg(values: Values, axis: str, mirror_deg: Number, other_deg: Number) -> np.ndarray:
    """Compute the beam angle about one axis: azimuth less its value C0 - 90 deg, or elevation; full turns are kept.

    Args:
        values: parameters by name.
        axis: pan or tilt.
        mirror_deg: its mirror angles.
        other_deg: mirror angle of the other axis.
    """
    pan, tilt = (mirror_deg, other_deg) if axis == "pan" else (other_deg, mirror_deg)
    _, (u, v, w) = beam_components(values, pan, tilt)
    if axis == "tilt":
        return np.degrees(np.arcsin(w))
    nominal = pan + values["pan_zero_emission_deg"] - 90.0
    off = np.degrees(np.arctan2(v, u)) - nominal
    return pan + (off + 180.0) % 360.0 - 180.0


def beam_deg_per_step(values: Mapping[str, float], axis: str, pose_deg: tuple[float, float]) -> float:
    """Compute both directions' mean effective degrees per step at mirror angles (pan, tilt) (formulation 3.2)."""
    index, half = AXES.index(axis), 1e-3
    pose, other = pose_deg[index], pose_deg[1 - index]
    ends = [beam_angle_deg(values, axis, pose + s * half, other) for s in (1, -1)]
    return float(values[f"degrees_per_step.{axis}"] * (ends[0] - ends[1]) / (2 * half))

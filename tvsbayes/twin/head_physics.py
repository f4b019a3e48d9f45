"""The twin's own optics of a pan-tilt head: successive rotations about the axes.

It shares parameter names with the estimators, but no formula. Degrees and radians by suffix, mm; x at azimuth 0, y at
azimuth 90 deg, z up.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np


def about(axis: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Compute rotation matrices (..., 3, 3) about a unit vector, counter-clockwise seen from its end."""
    c, s = np.cos(angle_rad)[..., None, None], np.sin(angle_rad)[..., None, None]
    x, y, z = axis
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return c * np.eye(3) + s * across + (1 - c) * np.outer(axis, axis)


class Beam(NamedTuple):
    """Origins (..., 3), mm, and directions (..., 3) of a beam."""

    origin: np.ndarray
    direction: np.ndarray


def head_beam(pan_rad: np.ndarray | float, tilt_rad: np.ndarray | float, geometry: Mapping[str, float]) -> Beam:
    """Compute the beam; `tilt_rad` includes the zero of elevation.

    The beam is offset from its axis, bent, rotated about the elevation axis, then about the azimuth axis, then tilted
    with the azimuth axis.
    """
    pan, tilt = np.broadcast_arrays(np.asarray(pan_rad, float), np.asarray(tilt_rad, float))
    skew, off = (np.radians(geometry[f"{name}_not_square_deg"]) for name in ("axes", "beam"))
    elevation_axis = np.array([0.0, np.cos(skew), np.sin(skew)])
    # At elevation 0 the beam is square to its axis and level, except for `beam_not_square_deg`.
    beam = np.array([np.cos(off), 0.0, 0.0]) - np.sin(off) * elevation_axis
    start = np.array([0.0, 0.0, 0.0]) + geometry["beam_offset_mm.y"] * elevation_axis
    start = start + geometry["beam_offset_mm.z"] * np.cross(np.array([1.0, 0.0, 0.0]), elevation_axis)
    bend = np.radians(geometry["flexure_deg"]) * np.cos(tilt)
    tangent = np.radians(geometry["tangent_flexure_deg"])
    if tangent:
        bend = bend + tangent / np.tan(tilt)
    # Upwards is a rotation from x to z, negative about the axis along y.
    raised = about(elevation_axis, -(tilt - bend))
    turned = about(np.array([0.0, 0.0, 1.0]), pan + np.radians(geometry["azimuth_zero_deg"]))
    north, east = (np.radians(geometry[f"azimuth_axis_tilt_deg.{side}"]) for side in ("north", "east"))
    lean = np.hypot(north, east)
    leaning = about(np.array([-east, north, 0.0]) / lean, np.asarray(lean)) if lean else np.eye(3)
    whole = leaning @ turned
    ahead = np.array([geometry["elevation_axis_offset_mm"], 0.0, 0.0])
    return Beam(whole @ ahead + whole @ raised @ start, whole @ raised @ beam)


def sighted_angles(directions: np.ndarray, noise_deg: np.ndarray) -> np.ndarray:
    """Compute azimuth and elevation (n, 2), deg, of directions (n, 3) sighted with noise (n, 2) on the sphere."""
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    side = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=1)
    sighted = directions + np.tan(np.radians(noise_deg[:, :1])) * side
    sighted = sighted + np.tan(np.radians(noise_deg[:, 1:])) * np.cross(directions, side)
    angles = np.stack(
        [np.arctan2(sighted[:, 1], sighted[:, 0]), np.arctan2(sighted[:, 2], np.hypot(sighted[:, 0], sighted[:, 1]))]
    )
    return np.degrees(angles.T)

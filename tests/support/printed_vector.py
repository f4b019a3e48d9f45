"""A rig whose beam the documents print to many digits, and half a unit of the last digit."""

from __future__ import annotations

LAST_12, LAST_9, LAST_7, LAST_6 = 0.5e-12, 0.5e-9, 0.5e-7, 0.5e-6
"""Half a unit of the last digit that formulation prints, each in the unit of what it bounds."""
VECTOR = {
    "mirror_offset_mm": 30.0,
    "mirror1_error_deg": 0.3,
    "mirror2_error_deg": -0.2,
    "laser_tilt_deg.x": 0.25,
    "laser_tilt_deg.y": -0.35,
    "laser_offset_mm.x": 0.2,
    "laser_offset_mm.y": -0.4,
    "tilt_axis_skew_deg": 0.4,
    "tilt_axis_offset_mm.x": 0.5,
    "tilt_axis_offset_mm.z": -0.3,
}

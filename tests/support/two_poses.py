"""Settings of the bent rig that several tests look at."""

from __future__ import annotations

PERIODS_DEG = {"pan": 360.0, "tilt": 40.0}
"""The wheel's error on one axis, the pinion's on the other."""


POSES = ((130.0, 90.0, 66.0), (-60.0, -70.0, 75.0))
"""Counters and readings of two points 300 to 700 mm away."""

"""Every parameter once: name, unit, prior, kind, range, block."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

UNIT_ENDINGS = (
    ("_deg_per_step", "deg/step"),
    ("degrees_per_step", "deg/step"),
    ("_deg", "deg"),
    ("_mm", "mm"),
    ("_rad", "rad"),
)


def unit_of(name: str) -> str:
    """Unit of a contract name (DESIGN 8): `backlash_deg.pan` -> deg; "1" where it has none."""
    stem = name.split(".")[0]
    if name.startswith("extrinsics."):
        stem = name.split(".")[1]
    return next((unit for ending, unit in UNIT_ENDINGS if stem.endswith(ending)), "1")


STEREO_PARAMETER_NAMES: tuple[str, ...] = (
    *(f"stereo.left.{p}" for p in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")),
    *(f"stereo.right.{p}" for p in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")),
    *(f"stereo.rotation_rad.{a}" for a in "xyz"),
    *(f"stereo.translation_mm.{a}" for a in "xyz"),
)
"""The 24 stereo parameters in the order of `parameter_covariance` (DESIGN 7)."""
Distribution = Literal["normal", "half-normal", "log-normal"]


@dataclass(frozen=True, slots=True)
class Prior:
    """One parameter's state of knowledge before the spots (DESIGN 3.2 and 7).

    `value` and `u` mean: normal: mean and standard uncertainty; half-normal: 0 and scale;
    log-normal: median and standard deviation of the logarithm. `u = 0` fixes the parameter.
    """

    value: float
    u: float
    distribution: Distribution = "normal"


DEFAULT_PRIORS: dict[str, Prior] = {
    "degrees_per_step.pan": Prior(0.06, 0.01),
    "degrees_per_step.tilt": Prior(0.07, 0.01),
    "ratio_contrast_deg_per_step.pan": Prior(0.0, 2e-4),
    "ratio_contrast_deg_per_step.tilt": Prior(0.0, 2e-4),
    "backlash_deg.pan": Prior(0.0, 0.5, "half-normal"),
    "backlash_deg.tilt": Prior(0.0, 0.5, "half-normal"),
    "tilt_zero_deg": Prior(0.0, 2.0),
    "mirror_offset_mm": Prior(30.0, 5.0),
    "mirror1_error_deg": Prior(0.0, 0.5),
    "mirror2_error_deg": Prior(0.0, 0.5),
    "laser_tilt_deg.x": Prior(0.0, 0.5),
    "laser_tilt_deg.y": Prior(0.0, 0.5),
    "laser_offset_mm.x": Prior(0.0, 0.5),
    "laser_offset_mm.y": Prior(0.0, 0.5),
    "tilt_axis_skew_deg": Prior(0.0, 0.5),
    "tilt_axis_offset_mm.x": Prior(0.0, 0.5),
    "tilt_axis_offset_mm.z": Prior(0.0, 0.5),
    "extrinsics.rotation_rad.x": Prior(0.0, 0.5),
    "extrinsics.rotation_rad.y": Prior(0.0, 0.5),
    "extrinsics.rotation_rad.z": Prior(0.0, 0.5),
    "extrinsics.translation_mm.x": Prior(0.0, 100.0),
    "extrinsics.translation_mm.y": Prior(0.0, 100.0),
    "extrinsics.translation_mm.z": Prior(0.0, 100.0),
    "stop_sd_deg.left": Prior(0.04, 1.0, "log-normal"),
    "stop_sd_deg.right": Prior(0.04, 1.0, "log-normal"),
    "stop_sd_deg.up": Prior(0.04, 1.0, "log-normal"),
    "stop_sd_deg.down": Prior(0.04, 1.0, "log-normal"),
    "pixel_scale": Prior(1.0, 0.5, "log-normal"),
}
"""Priors that `[rig.prior]` may replace, in the order of the parameter vector (DESIGN 3.2)."""
DECLARED_PRIORS: dict[str, Prior] = {
    "focal_scale": Prior(1.0, 0.002),
    "baseline_mm": Prior(200.0, 0.1),
    "pan_zero_emission_deg": Prior(90.0, 0.2),
    "aperture_zero_deg": Prior(0.0, 0.1),
    "aperture_sd_deg": Prior(0.02, 0.0, "log-normal"),
}
"""Entries of `[rig]` itself, with the defaults of DESIGN 7."""
HARMONIC_ORDERS = (1, 2)
HARMONIC_PRIORS: dict[str, Prior] = {
    f"harmonic_deg.{axis}.{order}.{part}": Prior(0.0, 0.0)
    for axis in ("pan", "tilt")
    for order in HARMONIC_ORDERS
    for part in ("cos", "sin")
}
"""Transmission error by axis, order and phase, part of `[rig.prior]` (DESIGN 3.1); none unless asked for."""
RIG_PRIORS: dict[str, Prior] = {**DEFAULT_PRIORS, **DECLARED_PRIORS, **HARMONIC_PRIORS}
"""Every prior of a rig with its default, in the order of the parameter vector."""
# Lowest and highest value and highest standard uncertainty by the first part of a name. Wide: they catch
# a wrong unit or a slipped key, not an unusual instrument.
RANGES: dict[str, tuple[float, float, float]] = {
    "degrees_per_step": (1e-6, 10.0, 10.0),
    "ratio_contrast_deg_per_step": (-1.0, 1.0, 1.0),
    "backlash_deg": (0.0, 0.0, 45.0),
    "tilt_zero_deg": (-90.0, 90.0, 180.0),
    "mirror_offset_mm": (-1000.0, 1000.0, 1000.0),
    "mirror1_error_deg": (-30.0, 30.0, 30.0),
    "mirror2_error_deg": (-30.0, 30.0, 30.0),
    "laser_tilt_deg": (-30.0, 30.0, 30.0),
    "laser_offset_mm": (-100.0, 100.0, 100.0),
    "tilt_axis_skew_deg": (-30.0, 30.0, 30.0),
    "tilt_axis_offset_mm": (-100.0, 100.0, 100.0),
    "extrinsics": (-1e5, 1e5, 1e5),
    "stop_sd_deg": (1e-6, 10.0, 5.0),
    "pixel_scale": (1e-3, 1e3, 5.0),
    "focal_scale": (0.5, 2.0, 0.5),
    "baseline_mm": (1.0, 1e5, 1e4),
    "pan_zero_emission_deg": (0.0, 180.0, 180.0),
    "aperture_zero_deg": (-180.0, 180.0, 180.0),
    "aperture_sd_deg": (1e-6, 10.0, 5.0),
    "harmonic_deg": (-10.0, 10.0, 10.0),
}

RIG_NAMES: tuple[str, ...] = tuple(RIG_PRIORS)
NAMES: tuple[str, ...] = (*RIG_NAMES, *STEREO_PARAMETER_NAMES)
"""Contract names (DESIGN 8) in the order of the coordinates."""
NOISE_NAMES: tuple[str, ...] = (
    *(f"stop_sd_deg.{direction}" for direction in ("left", "right", "up", "down")),
    "pixel_scale",
    "aperture_sd_deg",
)
"""Scales that the point estimate alternates with geometry and stereo (DESIGN 4.2)."""
RECEIVER_NAMES: tuple[str, ...] = (
    "baseline_mm",
    "pan_zero_emission_deg",
    "aperture_zero_deg",
    "aperture_sd_deg",
)
"""Observable only through aperture readings."""
INDEX: dict[str, int] = {name: index for index, name in enumerate(NAMES)}
KINDS = ("normal", "half-normal", "log-normal")

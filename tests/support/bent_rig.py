"""A bent rig known to a normal distribution, and where its beam meets a reading by the twin's optics alone.

mm, degrees as named. No fit, no JAX: the twin is the outside reference of three test modules.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.instrument.parameters import HARMONIC_NAMES
from tvsbayes.twin.physics import aperture_angle_deg, harmonics_deg, mirror_chain, to_tvs, transmission

BENT: dict[str, float] = {
    "degrees_per_step.pan": 0.0621,
    "degrees_per_step.tilt": 0.0704,
    "backlash_deg.pan": 0.51,
    "backlash_deg.tilt": 0.23,
    **dict.fromkeys(HARMONIC_NAMES, 0.0),
    "tilt_zero_deg": -0.8,
    "mirror_offset_mm": 28.5,
    "mirror1_error_deg": 0.4,
    "mirror2_error_deg": -0.3,
    "laser_tilt_deg.x": 0.35,
    "laser_tilt_deg.y": -0.45,
    "laser_offset_mm.x": 0.3,
    "laser_offset_mm.y": -0.6,
    "tilt_axis_skew_deg": 0.5,
    "tilt_axis_offset_mm.x": 0.7,
    "tilt_axis_offset_mm.z": -0.4,
    "baseline_mm": 201.3,
    "pan_zero_emission_deg": 91.2,
    "aperture_zero_deg": 0.15,
}
WOBBLE: dict[str, float] = {
    f"harmonic_deg.{axis}.{order}.{part}": value
    for (axis, order, part), value in zip(
        [(a, o, p) for a in ("pan", "tilt") for o in (1, 2) for p in ("cos", "sin")],
        (0.08, -0.05, 0.03, 0.06, -0.07, 0.04, 0.05, -0.02),
        strict=True,
    )
}
NOMINAL: dict[str, float] = {
    **dict.fromkeys(INPUT_NAMES, 0.0),
    "degrees_per_step.pan": 0.06,
    "degrees_per_step.tilt": 0.07,
    "mirror_offset_mm": 30.0,
    "baseline_mm": 200.0,
    "pan_zero_emission_deg": 90.0,
}
SD: dict[str, float] = {
    "degrees_per_step": 8e-5,
    "backlash_deg": 0.02,
    "harmonic_deg": 0.0,
    "tilt_zero_deg": 0.1,
    "mirror_offset_mm": 0.8,
    "mirror1_error_deg": 0.1,
    "mirror2_error_deg": 0.1,
    "laser_tilt_deg": 0.1,
    "laser_offset_mm": 0.2,
    "tilt_axis_skew_deg": 0.1,
    "tilt_axis_offset_mm": 0.2,
    "baseline_mm": 0.1,
    "pan_zero_emission_deg": 0.1,
    "aperture_zero_deg": 0.05,
}
"""Standard uncertainties by stem."""
NOISE_DEG: dict[str, float] = dict(zip(NOISE_NAMES, (0.05, 0.03, 0.04, 0.06, 0.02), strict=True))
NO_NOISE_DEG: dict[str, float] = dict.fromkeys(NOISE_NAMES, 0.0)
DRAWS = 1000
AXES = ("pan", "tilt")
PERIODS_DEG = {"pan": 360.0, "tilt": 40.0}
"""The wheel's error on one axis, the pinion's on the other."""
POSES = ((130.0, 90.0, 66.0), (-60.0, -70.0, 75.0))
"""Counters and readings of two points 300 to 700 mm away."""
ROUNDING = 1e-12
"""Of a hundred operations on numbers of order 1."""
ROUNDING_MM = 1e-9
"""Of a hundred operations on lengths up to 1000 mm, magnified tenfold by a grazing line of sight."""


def calibration(
    values: Mapping[str, float] = BENT,
    sd: Mapping[str, float] = SD,
    noise_deg: Mapping[str, float] = NOISE_DEG,
    *,
    draws: int = DRAWS,
    seed: int = 1,
    noise_spread: float = 0.1,
    azimuth: bool = False,
    period_deg: Mapping[str, float] | None = None,
    spread: float = 1.0,
) -> Calibration:
    """Correlated normal draws about `values`, moments taken from the draws as the library does.

    Args:
        values: means by name.
        sd: standard uncertainties by name or stem; 0 where left out.
        noise_deg: of `NOISE_NAMES`.
        draws: number of draws.
        seed: of the draws.
        noise_spread: relative spread of the noise sds between draws.
        azimuth: convention of the aperture.
        period_deg: of the transmission error, by axis.
        spread: scales every uncertainty.
    """
    rng = np.random.default_rng(seed)
    u = np.array([sd.get(name, sd.get(name.split(".")[0], 0.0)) for name in INPUT_NAMES]) * spread
    mean = np.array([values[name] for name in INPUT_NAMES])
    # Neighbours share a fifth of their draws: every correlation has a chance to be forgotten.
    normal = rng.standard_normal((draws, len(INPUT_NAMES) + 1))
    inputs = mean + u * (0.8 * normal[:, 1:] + 0.6 * normal[:, :1])
    scales = 1 + noise_spread * rng.uniform(-1, 1, (draws, len(NOISE_NAMES)))
    noise = np.array([noise_deg[name] for name in NOISE_NAMES]) * scales
    covariance = np.cov(inputs, rowvar=False)
    covariance[u == 0] = covariance[:, u == 0] = 0.0
    column = dict(zip(INPUT_NAMES, inputs.T, strict=True))
    play_steps = {axis: column[f"backlash_deg.{axis}"] / column[f"degrees_per_step.{axis}"] for axis in AXES}
    return Calibration(
        mean=np.where(u > 0, inputs.mean(axis=0), mean),
        covariance=covariance,
        noise_variance=dict(zip(NOISE_NAMES, (noise**2).mean(axis=0).tolist(), strict=True)),
        overshoot_steps={axis: int(np.ceil(np.quantile(steps, 0.99))) for axis, steps in play_steps.items()},
        azimuth=azimuth,
        period_deg=dict(period_deg or {}),
        range_steps=np.array([[-400.0, 400.0], [-300.0, 300.0]]),
        inputs_sha256={"moves": "0" * 64},
        inputs=inputs,
        noise=noise,
    )


TWIN_SIDE = {"left": -0.5, "up": -0.5, "right": 0.5, "down": 0.5, "unknown": 0.0}
"""Where the play stands, as a share of it (`twin.physics`)."""


def twin_angle_deg(values: Mapping[str, float], axis: str, steps: float, start: float, period_deg=None) -> float:
    """Mirror angle of one axis after homing at a counter, by the twin."""
    args = np.array([float(steps)]), np.array([True]), np.array([start]), np.zeros(1)
    ratios = values[f"degrees_per_step.{axis}"], 0.0
    wobble = () if period_deg is None else (harmonics_deg(values, axis), period_deg)
    angle = float(transmission(*args, ratios, values[f"backlash_deg.{axis}"], *wobble)[0])
    return angle + (values["tilt_zero_deg"] if axis == "tilt" else 0.0)


def twin_ray_at(values: Mapping[str, float], pan_deg: float, tilt_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and direction (3,) of the beam in frame T for mirror angles, by the twin."""
    origin, direction = mirror_chain(np.radians(pan_deg), np.radians(tilt_deg), values)
    both = to_tvs(np.stack([origin, origin + direction]), values["baseline_mm"], values["pan_zero_emission_deg"])
    return both[0], both[1] - both[0]


def twin_ray(values, steps, approach, period_deg: Mapping[str, float] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The same for counters that were reached from a side."""
    angles = [
        twin_angle_deg(values, axis, n, TWIN_SIDE[side], (period_deg or {}).get(axis))
        for axis, n, side in zip(AXES, steps, approach, strict=True)
    ]
    return twin_ray_at(values, *angles)


def twin_points(origin: np.ndarray, direction: np.ndarray, baseline_mm, reading_deg, azimuth: bool) -> np.ndarray:
    """Points (n, 3) of beams (n, 3) whose aperture angle is `reading_deg`, by bisection of the twin's angle.

    The angle grows along a beam that comes from the positioner. No closed form is shared with the library.
    """
    low, high = np.zeros(len(origin)), np.full(len(origin), 1e5)
    centre = origin + np.multiply.outer(0.5 * np.broadcast_to(baseline_mm, len(origin)), [0.0, 1.0, 0.0])
    for _ in range(80):
        middle = 0.5 * (low + high)
        angle = aperture_angle_deg(centre + middle[:, None] * direction, 0.0, "azimuth" if azimuth else "in-plane")
        low, high = np.where(angle < reading_deg, middle, low), np.where(angle < reading_deg, high, middle)
    return origin + (0.5 * (low + high))[:, None] * direction

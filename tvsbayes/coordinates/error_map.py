"""Errors over the work space of the nominal, classic and joint calibration, over the draws of a calibration.

Frame T, mm; counters in steps. The beam of each drawn rig is computed to a range, the aperture reads it, and every
calibration locates the spot. NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.calibration.drawn_looks import Drawn, drawn
from tvsbayes.calibration.located_point import DIVERGING_SHARE
from tvsbayes.calibration.optics import Components, aperture_angle_deg
from tvsbayes.calibration.pointing import APERTURE, Calibration, Sides
from tvsbayes.coordinates.simple_calibration import AssumedGeometry, SimpleCalibration, assumed_geometry


@dataclass(frozen=True)
class ErrorMap:
    """Errors over pan, tilt and range; arrays (pan, tilt, range), NaN where nothing can be located.

    Attributes:
        pan_steps, tilt_steps, range_mm: the axes; ranges along the beam.
        rms_mm: root mean square distance from the true point, by estimator.
        valid: whether every estimator finds a point in all but `DIVERGING_SHARE` of the draws.
        distance_mm: 3D errors by estimator, arrays (draws, pan, tilt, range), infinite where there is no point.
    """

    pan_steps: np.ndarray
    tilt_steps: np.ndarray
    range_mm: np.ndarray
    rms_mm: Mapping[str, np.ndarray]
    valid: np.ndarray
    distance_mm: Mapping[str, np.ndarray]


def _truth(
    calibration: Calibration, pan: np.ndarray, tilt: np.ndarray, range_mm: np.ndarray, approach: Sides, rigs: Drawn
) -> tuple[np.ndarray, np.ndarray]:
    """Points reached by every drawn rig (3, draws, points), mm, and the aperture's readings there, deg."""
    values = rigs.values_at(calibration, (pan, tilt))
    noise = rigs.noise.T[..., None]
    points = calibration.noisy_beam(values, noise, (pan, tilt), approach).at(range_mm)
    reading = aperture_angle_deg((points[0], points[1], points[2]), values["baseline_mm"], calibration.azimuth)
    return points, reading + values["aperture_zero_deg"] + values["aperture_sd_deg"] * noise[APERTURE]


@dataclass(frozen=True)
class SimpleError:
    """Error of a simple calibration at counters and a range, split by cause, by the best estimates.

    Attributes:
        azimuth_deg, elevation_deg: its beam's direction less that of the joint calibration.
        by_direction_mm: 3D error due to the direction alone.
        by_place_mm: 3D error due to the positions of beam and aperture and its zero alone.
    """

    azimuth_deg: float
    elevation_deg: float
    by_direction_mm: float
    by_place_mm: float


def simple_error(
    calibration: Calibration, simple: SimpleCalibration, steps: tuple[float, float], range_mm: float
) -> SimpleError:
    """Split the error of a simple calibration by cause, at counters reached from left and up, without noise.

    A part is NaN where beam and reading do not meet.
    """
    best, azimuth = calibration.estimates, calibration.azimuth
    beam = calibration.beam_at(steps, (1.0, 1.0))
    point = np.array(beam.at(range_mm))
    reading = np.array(calibration.reading(point))
    assumed = assumed_geometry(simple, np.array(steps[:1]), np.array(steps[1:]))
    joint = AssumedGeometry(beam, best["baseline_mm"], best["aperture_zero_deg"])
    turned = replace(joint, beam=Components(beam.origin, assumed.beam.direction))
    moved = replace(assumed, beam=Components(assumed.beam.origin, beam.direction))
    parts = [float(np.linalg.norm(np.ravel(b.points(reading, azimuth)) - point)) for b in (turned, moved)]
    directions = [np.ravel(np.array(each.direction)) for each in (assumed.beam, beam)]
    pan, tilt = (np.degrees(np.subtract(*angle)) for angle in zip(*map(_angles, directions), strict=True))
    return SimpleError(float(pan), float(tilt), *parts)


def _angles(direction: np.ndarray) -> tuple[float, float]:
    """Compute azimuth and elevation of a unit vector (3,), rad."""
    x, y, z = direction.tolist()
    return math.atan2(y, x), math.asin(z)


def error_map(
    calibration: Calibration,
    pan_steps: Sequence[float] | np.ndarray,
    tilt_steps: Sequence[float] | np.ndarray,
    range_mm: Sequence[float] | np.ndarray,
    *,
    simple: Mapping[str, SimpleCalibration],
    approach: Sides = (1.0, 1.0),
    draws: int = 500,
) -> ErrorMap:
    """Compute expected errors of the joint calibration and of simple ones, over the draws of the calibration.

    Args:
        calibration: calibration with draws.
        pan_steps: counters, shape (p,).
        tilt_steps: counters, shape (t,).
        range_mm: ranges along the beam, shape (r,).
        simple: further calibrations by name, such as "nominal" and "classic", from `simple_calibration`.
        approach: sides, +1 left or up, -1 right or down.
        draws: number of drawn rigs.

    Returns:
        The map; the joint calibration is "joint".
    """
    axes = [np.asarray(x, dtype=float) for x in (pan_steps, tilt_steps, range_mm)]
    pan, tilt, ranges = (x.ravel() for x in np.meshgrid(*axes, indexing="ij"))
    true_mm, reading_deg = _truth(calibration, pan, tilt, ranges, approach, drawn(calibration, draws, seed=0))
    best = calibration.estimates
    beam = calibration.beam_at((pan, tilt), approach)
    geometries = {"joint": AssumedGeometry(beam, best["baseline_mm"], best["aperture_zero_deg"])}
    geometries |= {name: assumed_geometry(one, pan, tilt) for name, one in simple.items()}
    shape = tuple(len(x) for x in axes)
    rms, distance, valid = {}, {}, np.ones(shape, bool)
    for name, assumed in geometries.items():
        error = assumed.points(reading_deg, calibration.azimuth) - true_mm
        meets = np.isfinite(error[0])
        usable = (~meets).mean(axis=0) <= DIVERGING_SHARE
        square = np.sum(np.where(meets, error, 0.0) ** 2, axis=(0, 1)) / np.maximum(meets.sum(axis=0), 1)
        rms[name] = np.where(usable, np.sqrt(square), np.nan).reshape(shape)
        distance[name] = np.where(meets, np.linalg.norm(error, axis=0), np.inf).reshape(-1, *shape)
        valid &= usable.reshape(shape)
    return ErrorMap(axes[0], axes[1], axes[2], rms, valid, distance)

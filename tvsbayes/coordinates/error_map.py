"""Error over the work space, nominal, classic and joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.optics import aperture_angle_deg, beam_components, range_components
from tvsbayes.calibration.pointing import (
    DIVERGING_SHARE,
    INPUT_NAMES,
    NOISE_NAMES,
    Calibration,
    Ray,
    direction_of,
    drawn,
)
from tvsbayes.estimators.four_point import ClassicResult
from tvsbayes.instrument.parameters import RIG_PRIORS, Prior


@dataclass(frozen=True)
class SimpleCalibration:
    """What a user of published equations knows: C = C0 + k n, beta = k n, no backlash (DESIGN 5).

    Attributes:
        deg_per_step: by direction (left, right, up, down): counters above zero were reached left or up.
        baseline_mm: distance from the aperture to where the beam leaves the positioner, a - L.
        origin_y_mm: where it leaves it in frame T, a/2 - L: the middle between both is moved by -L/2.
        pan_zero_emission_deg: C0.
        aperture_zero_deg: what the aperture's readings are corrected by.
    """

    deg_per_step: Mapping[str, float]
    baseline_mm: float
    origin_y_mm: float
    pan_zero_emission_deg: float
    aperture_zero_deg: float


def simple_calibration(
    priors: Mapping[str, Prior] = RIG_PRIORS, classic: ClassicResult | None = None
) -> SimpleCalibration:
    """The nominal calibration of stated priors, or with the classic estimator's ratios.

    Directions that the classic estimator did not measure keep their nominal ratio.
    """
    nominal = {"left": "pan", "right": "pan", "up": "tilt", "down": "tilt"}
    ratios = {direction: priors[f"degrees_per_step.{axis}"].value for direction, axis in nominal.items()}
    if classic is not None:
        measured = {d: r.mean_deg_per_step for d, r in classic.directions.items() if r is not None}
        ratios |= measured
    a, offset = priors["baseline_mm"].value, priors["mirror_offset_mm"].value
    zeros = (priors["pan_zero_emission_deg"].value, priors["aperture_zero_deg"].value)
    return SimpleCalibration(ratios, a - offset, 0.5 * a - offset, *zeros)


def simple_rays(simple: SimpleCalibration, steps: np.ndarray) -> Ray:
    """Beams, fields of shape (3, points), of a simple calibration at counters (points, 2).

    The azimuth C0 + k n and the elevation k n are turned into a direction, so that either convention of the
    aperture's angle meets it as it should.
    """
    steps = np.asarray(steps, dtype=float)
    k = simple.deg_per_step
    pan = np.where(steps[:, 0] >= 0, k["left"], k["right"]) * steps[:, 0] + simple.pan_zero_emission_deg - 90.0
    tilt = np.where(steps[:, 1] >= 0, k["up"], k["down"]) * steps[:, 1]
    direction = direction_of(pan, tilt)
    origin = np.zeros_like(direction)
    origin[1] = simple.origin_y_mm
    return Ray(origin, direction)


@dataclass(frozen=True)
class ErrorMap:
    """Errors over pan, tilt and range; arrays (pan, tilt, range), not a number where nothing can be located.

    Attributes:
        pan_steps, tilt_steps, range_mm: the axes; ranges along the beam.
        rms_mm: root mean square distance from the true point, by estimator.
        bias_mm: mean error vector, by estimator, shape (pan, tilt, range, 3).
        inside: counters within those of the campaign.
        valid: every estimator asked finds a point in all but `coordinates.DIVERGING_SHARE` of the draws.
        distance_mm: 3D errors by estimator, arrays (draws, pan, tilt, range), infinite where there is no point.
    """

    pan_steps: np.ndarray
    tilt_steps: np.ndarray
    range_mm: np.ndarray
    rms_mm: Mapping[str, np.ndarray]
    bias_mm: Mapping[str, np.ndarray]
    inside: np.ndarray
    valid: np.ndarray
    distance_mm: Mapping[str, np.ndarray]


def error_map(
    calibration: Calibration,
    pan_steps: Sequence[float] | np.ndarray,
    tilt_steps: Sequence[float] | np.ndarray,
    range_mm: Sequence[float] | np.ndarray,
    *,
    simple: Mapping[str, SimpleCalibration],
    approach: tuple[float, float] = (1.0, 1.0),
    draws: int = 500,
    seed: int = 0,
) -> ErrorMap:
    """Expected errors of the joint calibration and of simple ones, over the rigs that the data allow.

    Args:
        calibration: with draws.
        pan_steps: counters, shape (p,).
        tilt_steps: counters, shape (t,).
        range_mm: ranges along the beam, shape (r,).
        simple: further calibrations by name, such as "nominal" and "classic", from `simple_calibration`.
        approach: sides, +1 left or up, -1 right or down.
        draws: rigs.
        seed: of their stop errors and aperture noise.

    Returns:
        The map; the joint calibration is "joint".
    """
    axes = [np.asarray(x, dtype=float) for x in (pan_steps, tilt_steps, range_mm)]
    pan, tilt, ranges = (x.ravel() for x in np.meshgrid(*axes, indexing="ij"))
    steps = np.stack([pan, tilt], axis=1)
    rigs = drawn(calibration, draws, seed)
    # Axes: draws, points.
    values = dict(zip((*INPUT_NAMES, *NOISE_NAMES), rigs.inputs.T[..., None], strict=True))
    noise = rigs.noise.T[..., None]
    origin, direction = beam_components(values, *calibration.noisy_angles(values, noise, (pan, tilt), approach))
    points = np.array([o + ranges * d for o, d in zip(origin, direction, strict=True)])
    reading = aperture_angle_deg(tuple(points), values["baseline_mm"], calibration.azimuth)
    reading = reading + values["aperture_zero_deg"] + values["aperture_sd_deg"] * noise[4]
    best = calibration.estimates
    beam = beam_components(best, *calibration.angles(best, (pan, tilt), approach))
    looks = {"joint": (*beam, best["baseline_mm"], best["aperture_zero_deg"])}
    for name, one in simple.items():
        ray = simple_rays(one, steps)
        # `range_components` puts the aperture at half the distance it is given; a simple user's stands at origin -
        # baseline.
        aperture = 2 * (one.baseline_mm - one.origin_y_mm), one.aperture_zero_deg
        looks[name] = tuple(ray.origin_mm), tuple(ray.direction), *aperture
    shape = tuple(len(x) for x in axes)
    rms, bias, distance, valid = {}, {}, {}, np.ones(shape, dtype=bool)
    for name, (origin, direction, baseline_mm, zero_deg) in looks.items():
        reach = range_components(origin, direction, baseline_mm, reading - zero_deg, calibration.azimuth)
        meets = np.isfinite(reach) & (reach > 0)
        reach = np.where(meets, reach, 0.0)
        error = np.array([o + reach * d for o, d in zip(origin, direction, strict=True)]) - points
        share = (~meets).mean(axis=0)
        kept = np.where(meets, error, 0.0)
        count = np.maximum(meets.sum(axis=0), 1)
        usable = share <= DIVERGING_SHARE
        square = np.sum(kept**2, axis=(0, 1)) / count
        rms[name] = np.where(usable, np.sqrt(square), np.nan).reshape(shape)
        bias[name] = np.where(usable, kept.sum(axis=1) / count, np.nan).T.reshape(*shape, 3)
        valid &= usable.reshape(shape)
        length = np.where(meets, np.linalg.norm(error, axis=0), np.inf)
        distance[name] = length.reshape(-1, *shape)
    (pan_low, pan_high), (tilt_low, tilt_high) = calibration.range_steps
    within = (pan >= pan_low) & (pan <= pan_high) & (tilt >= tilt_low) & (tilt <= tilt_high)
    inside = within.reshape(shape)
    return ErrorMap(*axes, rms_mm=rms, bias_mm=bias, inside=inside, valid=valid, distance_mm=distance)

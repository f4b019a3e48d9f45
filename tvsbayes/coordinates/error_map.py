"""Errors over the work space of the nominal, the classic and the joint calibration, on the rigs that the data allow.

Frame T, mm; counters in steps. The beam of each drawn rig is followed to a range, the aperture reads it, and every
estimator is asked where the spot is. Nominal and classic users are given what is fair: a baseline shortened by the
mirror offset, its middle moved by half of that, and readings in the convention that their equations expect. NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.drawn_looks import Drawn, drawn
from tvsbayes.calibration.optics import Components, Ray, aperture_angle_deg, range_components, unit_vector
from tvsbayes.calibration.pointing import DIVERGING_SHARE, Calibration, Sides
from tvsbayes.estimators.four_point import ClassicResult
from tvsbayes.instrument.axes import SENSES
from tvsbayes.instrument.parameters import RIG_PRIORS, Prior


@dataclass(frozen=True)
class SimpleCalibration:
    """What a user of published equations knows: C = C0 + k n, beta = k n, no backlash (formulation 5).

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
    ratios = {d: priors[f"degrees_per_step.{axis}"].value for axis, pair in SENSES.items() for d in pair}
    if classic is not None:
        ratios |= {d: r.mean_deg_per_step for d, r in classic.directions.items() if r is not None}
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
    direction = unit_vector(pan, tilt)
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
        inside: counters within those at which the campaign looked.
        valid: every estimator asked finds a point in all but `DIVERGING_SHARE` of the draws.
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


@dataclass(frozen=True)
class _Truth:
    """What happened on every rig: points reached (3, draws, points), mm, and what the aperture read there, deg."""

    xyz_mm: np.ndarray
    aperture_deg: np.ndarray


def _truth(
    calibration: Calibration, pan: np.ndarray, tilt: np.ndarray, range_mm: np.ndarray, approach: Sides, rigs: Drawn
) -> _Truth:
    values = rigs.values_at(calibration, (pan, tilt))
    noise = rigs.noise.T[..., None]
    points = calibration.noisy_beam(values, noise, (pan, tilt), approach).at(range_mm)
    reading = aperture_angle_deg((points[0], points[1], points[2]), values["baseline_mm"], calibration.azimuth)
    return _Truth(points, reading + values["aperture_zero_deg"] + values["aperture_sd_deg"] * noise[4])


@dataclass(frozen=True)
class _Belief:
    """What an estimator takes for true: its beams (points,), twice the aperture's distance from y = 0, its zero."""

    beam: Components
    baseline_mm: float
    aperture_zero_deg: float


def _simple_belief(simple: SimpleCalibration, pan: np.ndarray, tilt: np.ndarray) -> _Belief:
    ray = simple_rays(simple, np.stack([pan, tilt], axis=1))
    (x, y, z), (u, v, w) = ray.origin_mm, ray.direction
    # `range_components` puts the aperture at half the distance given; a simple user's stands at origin - baseline.
    aperture_mm = 2 * (simple.baseline_mm - simple.origin_y_mm)
    return _Belief(Components((x, y, z), (u, v, w)), aperture_mm, simple.aperture_zero_deg)


@dataclass(frozen=True)
class _Errors:
    """Errors of one estimator over the points; fields as in `ErrorMap`, `usable` as its `valid`."""

    rms_mm: np.ndarray
    bias_mm: np.ndarray
    distance_mm: np.ndarray
    usable: np.ndarray


def _errors(belief: _Belief, truth: _Truth, azimuth: bool) -> _Errors:
    reading = truth.aperture_deg - belief.aperture_zero_deg
    reach = range_components(*belief.beam, belief.baseline_mm, reading, azimuth)
    meets = np.isfinite(reach) & (reach > 0)
    error = belief.beam.at(np.where(meets, reach, 0.0)) - truth.xyz_mm
    kept, count = np.where(meets, error, 0.0), np.maximum(meets.sum(axis=0), 1)
    usable = (~meets).mean(axis=0) <= DIVERGING_SHARE
    square = np.sum(kept**2, axis=(0, 1)) / count
    return _Errors(
        rms_mm=np.where(usable, np.sqrt(square), np.nan),
        bias_mm=np.where(usable, kept.sum(axis=1) / count, np.nan).T,
        distance_mm=np.where(meets, np.linalg.norm(error, axis=0), np.inf),
        usable=usable,
    )


def error_map(
    calibration: Calibration,
    pan_steps: Sequence[float] | np.ndarray,
    tilt_steps: Sequence[float] | np.ndarray,
    range_mm: Sequence[float] | np.ndarray,
    *,
    simple: Mapping[str, SimpleCalibration],
    approach: Sides = (1.0, 1.0),
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
    truth = _truth(calibration, pan, tilt, ranges, approach, drawn(calibration, draws, seed))
    best = calibration.estimates
    beam = calibration.beam_at((pan, tilt), approach)
    beliefs = {"joint": _Belief(beam, best["baseline_mm"], best["aperture_zero_deg"])}
    beliefs |= {name: _simple_belief(one, pan, tilt) for name, one in simple.items()}
    errors = {name: _errors(belief, truth, calibration.azimuth) for name, belief in beliefs.items()}
    (pan_low, pan_high), (tilt_low, tilt_high) = calibration.range_steps
    inside = (pan >= pan_low) & (pan <= pan_high) & (tilt >= tilt_low) & (tilt <= tilt_high)
    shape = tuple(len(x) for x in axes)
    return ErrorMap(
        pan_steps=axes[0],
        tilt_steps=axes[1],
        range_mm=axes[2],
        rms_mm={name: found.rms_mm.reshape(shape) for name, found in errors.items()},
        bias_mm={name: found.bias_mm.reshape(*shape, 3) for name, found in errors.items()},
        inside=inside.reshape(shape),
        valid=np.all([found.usable for found in errors.values()], axis=0).reshape(shape),
        distance_mm={name: found.distance_mm.reshape(-1, *shape) for name, found in errors.items()},
    )

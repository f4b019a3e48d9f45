"""Calibrations of users of the published equations: counters times degrees per step, and the beam by these.

For a fair comparison, nominal and classic users have a baseline shortened by the mirror offset, with its middle shifted
by half of that. Their readings are in the convention of their equations. Frame T, mm; counters in steps. NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.optics import Components, Ray, range_components, unit_vector
from tvsbayes.estimators.four_point import ClassicResult
from tvsbayes.instrument.axes import SENSES
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import Prior


@dataclass(frozen=True)
class SimpleCalibration:
    """A calibration by the published equations: C = C0 + k n, beta = k n, no backlash (formulation 5).

    Attributes:
        deg_per_step: ratio by direction (left, right, up, down); counters above zero were reached left or up.
        baseline_mm: distance from the aperture to where the beam leaves the positioner, a - L.
        origin_y_mm: y of that point in frame T, a/2 - L; the middle of the baseline is shifted by -L/2.
        pan_zero_emission_deg: C0.
        aperture_zero_deg: correction of the aperture's readings.
    """

    deg_per_step: Mapping[str, float]
    baseline_mm: float
    origin_y_mm: float
    pan_zero_emission_deg: float
    aperture_zero_deg: float


def simple_calibration(
    priors: Mapping[str, Prior] = TWO_MIRROR.priors, classic: ClassicResult | None = None
) -> SimpleCalibration:
    """Build the nominal calibration of stated priors, or with the classic estimator's ratios.

    Directions that the classic estimator did not measure keep their nominal ratio.
    """
    ratios = {d: priors[f"degrees_per_step.{axis}"].value for axis, pair in SENSES.items() for d in pair}
    if classic is not None:
        ratios |= {d: r.mean_deg_per_step for d, r in classic.directions.items() if r is not None}
    a, offset = priors["baseline_mm"].value, priors["mirror_offset_mm"].value
    zeros = (priors["pan_zero_emission_deg"].value, priors["aperture_zero_deg"].value)
    return SimpleCalibration(ratios, a - offset, 0.5 * a - offset, *zeros)


def simple_calibrations(priors: Mapping[str, Prior], classic: ClassicResult | None) -> dict[str, SimpleCalibration]:
    """Return the calibrations by name: nominal, and classic where there is a result."""
    calibrations = {"nominal": simple_calibration(priors)}
    return calibrations if classic is None else {**calibrations, "classic": simple_calibration(priors, classic)}


def simple_rays(simple: SimpleCalibration, steps: np.ndarray) -> Ray:
    """Compute beams, fields of shape (3, points), of a simple calibration at counters (points, 2).

    The azimuth C0 + k n and the elevation k n are converted to a direction, so that it is correct for either convention
    of the aperture's angle.
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
class AssumedGeometry:
    """Geometry assumed by an estimator: beams (points,), twice the aperture's distance from y = 0, its zero."""

    beam: Components
    baseline_mm: float
    aperture_zero_deg: float

    def points(self, aperture_deg: np.ndarray, azimuth: bool) -> np.ndarray:
        """Compute where the beams meet readings (..., points): shape (3, ..., points), mm; NaN where they do not."""
        reach = range_components(*self.beam, self.baseline_mm, aperture_deg - self.aperture_zero_deg, azimuth)
        return self.beam.met(reach)


def assumed_geometry(simple: SimpleCalibration, pan: np.ndarray, tilt: np.ndarray) -> AssumedGeometry:
    """Compute the geometry of a simple calibration at counters (points,)."""
    ray = simple_rays(simple, np.stack([pan, tilt], axis=1))
    (x, y, z), (u, v, w) = ray.origin_mm, ray.direction
    # `range_components` puts the aperture at half the given distance; that of a simple user is at origin - baseline.
    aperture_mm = 2 * (simple.baseline_mm - simple.origin_y_mm)
    return AssumedGeometry(Components((x, y, z), (u, v, w)), aperture_mm, simple.aperture_zero_deg)

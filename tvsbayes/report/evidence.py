"""All inputs of a report: stored results, the classic estimate, errors in 3D, limits with verdicts.

Ratios in deg/step, points and their errors in mm, frame T.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.calibration_file import calibration_json, content_sha256
from tvsbayes.calibration.optics import ERROR_AT, PLAY_AT
from tvsbayes.calibration.pointing import INPUT_NAMES, Calibration
from tvsbayes.coordinates.error_map import ErrorMap, SimpleError, error_map, simple_error
from tvsbayes.coordinates.simple_calibration import simple_calibrations
from tvsbayes.errors import NothingToEstimate
from tvsbayes.estimators.four_point import ClassicResult, classic_of
from tvsbayes.instrument.axes import AXES, DIRECTIONS, HOME_APPROACH, Axis
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.metrology.conformity import CONFORMING_PROBABILITY, CONFORMS, Criterion, Tolerance
from tvsbayes.metrology.look_budget import Budget, budget, coordinate_budget
from tvsbayes.report.spot_pictures import SpotCrop, spot_crops
from tvsbayes.results.comparison_record import CANNOT_TELL, HoldOut, stored_hold_out
from tvsbayes.results.compensation_record import Verification, stored_verification
from tvsbayes.results.fit_record import FitEvidence, FitRecord
from tvsbayes.results.metrology_tables import BudgetTable
from tvsbayes.results.plan_record import PlanRecord, stored_plan
from tvsbayes.statistics.intervals import band95

MET, NOT_MET = "met", "not met"
SATISFIED = (MET, CONFORMS)
"""Verdicts that let `report` end with exit code 0."""
POINT = "xyz"
"""Name of a point's error in 3D for a tolerance."""


def criterion(quantity: str, errors: np.ndarray, limit: float, unit: str) -> Criterion:
    """Compare draws of an error (n,) with a limit (decision rule agreed in advance, ISO/IEC 17025 7.8.6).

    It is "met" for a probability of at least 0.95, "not met" up to 0.05, else "cannot tell".
    """
    probability = float(np.mean(np.abs(errors) <= limit))
    verdict = (
        MET
        if probability >= CONFORMING_PROBABILITY
        else NOT_MET
        if probability <= 1 - CONFORMING_PROBABILITY
        else CANNOT_TELL
    )
    risk = {MET: 1 - probability, NOT_MET: probability}.get(verdict)
    return Criterion(quantity, limit, unit, probability, verdict, risk=risk)


MAP_CELLS = 5
"""Number of cells of a map per axis; odd, so that one is in the middle."""
MAP_DRAWS = 1000
"""Number of draws of the maps: a probability near 0.95 is then known to 0.007."""
BAND_POINTS = 161
"""Number of counters of the curves of the gears' errors."""
MAP_RANGES_MM = (300.0, 2000.0)
"""Ranges of maps in addition to the stated one: the scanner's near and far ends."""


@dataclass(frozen=True)
class GearBand:
    """Errors of one axis' gears over its counters.

    Attributes:
        axis: pan or tilt.
        steps: counters, shape (n,).
        error_deg, play_deg: transmission error and change of play: low, mean, high of 95 %, shape (3, n).
        seen_steps: lowest and highest counter that a look reached.
    """

    axis: Axis
    steps: np.ndarray
    error_deg: np.ndarray
    play_deg: np.ndarray
    seen_steps: tuple[float, float]


def gear_bands(calibration: Calibration) -> tuple[GearBand, ...]:
    """Bands of both axes; none where gears do not vary."""
    curves, columns = [], calibration.inputs[:, len(INPUT_NAMES) :]
    for index, axis in enumerate(AXES if calibration.gears.size else ()):
        nodes = calibration.gears.steps[index]
        steps = np.linspace(nodes[0], nodes[-1], BAND_POINTS)
        values_at = calibration.gears.at(columns, (steps, steps))
        error, play = (band95(values_at[f"{kind}.{axis}"]) for kind in (ERROR_AT, PLAY_AT))
        low_seen, high_seen = calibration.range_steps[index].tolist()
        curves.append(GearBand(axis, steps, error, play, (low_seen, high_seen)))
    return tuple(curves)


@dataclass(frozen=True)
class Evidence:
    """All data of a report.

    Attributes:
        campaign: the data.
        fit: the content of `results/fit.json`.
        classic: the paper's estimator; None without complete experiments.
        held_out: hold-out in `results/compare.json`, None where `compare` was not run on these data.
        planned: plan in `results/plan.json`, None where `plan --given` was not run on these data.
        criteria: limits of the calibration with their verdicts.
        distances_mm: draws of the 3D error by estimator at `range_mm` and the middle of the counters.
        range_mm: stated range.
        simple_errors: errors of simple calibrations there, by their name.
        maps: error maps.
        budget: budget of a point at that range.
        point: budget of its least certain coordinate, by parameter.
        gears: repeated errors over the counters, by axis; none where they do not vary.
        crops: pictures of a few spots, where there are frames.
        doubts: warnings of `check`.
        verified: the last result of `verify` for this calibration; None if none.
    """

    campaign: Campaign
    fit: FitRecord
    classic: ClassicResult | None
    held_out: HoldOut | None
    planned: PlanRecord | None
    criteria: Sequence[Criterion]
    distances_mm: Mapping[str, np.ndarray]
    range_mm: float
    simple_errors: Mapping[str, SimpleError]
    maps: ErrorMap
    budget: Budget
    point: BudgetTable
    gears: tuple[GearBand, ...]
    crops: tuple[SpotCrop, ...] = ()
    doubts: tuple[str, ...] = ()
    verified: Verification | None = None

    @property
    def shown(self) -> FitEvidence:
        """Evidence of the fit besides its estimates."""
        return self.fit.evidence or FitEvidence()


def gather(
    campaign: Campaign,
    fit: FitRecord,
    calibration: Calibration,
    *,
    range_mm: float,
    ratios_deg_per_step: np.ndarray | None = None,
    limit_deg_per_step: float | None = None,
    limit_mm: float | None = None,
    tolerance: Tolerance | None = None,
    doubts: Sequence[str] = (),
) -> Evidence:
    """Compute all data of a report.

    Args:
        campaign: the data.
        fit: its `fit.json`.
        calibration: its draws.
        range_mm: range at which errors in mm are stated.
        ratios_deg_per_step: draws of the effective ratios by direction, shape (draws, 4), for their limit.
        limit_deg_per_step: largest error allowed of every effective ratio.
        limit_mm: largest 3D error allowed at that range, with pan and tilt in the middle of the counters seen.
        tolerance: limit with its decision rule, of the error of a direction's ratio, deg/step, or of `POINT`, mm.
        doubts: warnings of `check`.
    """
    classic_result = classic_of(campaign)
    maps = _maps(campaign, classic_result, calibration, range_mm)
    # With an odd number of cells the middle one is at the middle of the counters.
    cell = MAP_CELLS // 2, MAP_CELLS // 2, maps.range_mm.tolist().index(range_mm)
    distances = {name: distance[:, *cell] for name, distance in maps.distance_mm.items()}
    criteria = []
    if limit_deg_per_step is not None and ratios_deg_per_step is not None:
        criteria += _ratio_criteria(ratios_deg_per_step, fit, limit_deg_per_step)
    if limit_mm is not None:
        errors = _inflation(fit) * distances["joint"]
        criteria.append(criterion(f"3D point at {range_mm:g} mm", errors, limit_mm, "mm"))
    if tolerance is not None:
        errors_mm = _inflation(fit) * distances["joint"]
        criteria.append(_judged(tolerance, fit, ratios_deg_per_step, errors_mm, range_mm))
    pan, tilt = (float(value) for value in calibration.range_steps.mean(axis=1))
    ray = calibration.ray(pan, tilt, HOME_APPROACH)
    point = np.asarray(ray.origin_mm) + range_mm * np.asarray(ray.direction)
    table = budget(calibration, pan, tilt, calibration.reading(point))
    coordinate = "xyz"[int(np.argmax(np.diag(table.covariance_mm2)))]
    return Evidence(
        campaign=campaign,
        fit=fit,
        classic=classic_result,
        held_out=stored_hold_out(campaign, fit.provenance.inputs),
        planned=stored_plan(campaign, fit.provenance.inputs),
        criteria=criteria,
        distances_mm=distances,
        range_mm=range_mm,
        simple_errors={
            name: simple_error(calibration, simple, (pan, tilt), range_mm)
            for name, simple in simple_calibrations(campaign.rig.priors, classic_result).items()
        },
        maps=maps,
        budget=table,
        point=coordinate_budget(table, calibration, point.tolist(), coordinate),
        gears=gear_bands(calibration),
        crops=spot_crops(campaign, fit.summary.suspect_spots),
        doubts=tuple(doubts),
        verified=stored_verification(
            campaign, fit.provenance.inputs, content_sha256(calibration_json(calibration)), "deg"
        ),
    )


def _maps(campaign: Campaign, result: ClassicResult | None, calibration: Calibration, range_mm: float) -> ErrorMap:
    """Errors over the counters seen, at the stated range and the scanner's ends."""
    simple = simple_calibrations(campaign.rig.priors, result)
    pan, tilt = (np.linspace(low, high, MAP_CELLS) for low, high in calibration.range_steps)
    ranges = sorted({*MAP_RANGES_MM, range_mm})
    return error_map(calibration, pan, tilt, ranges, simple=simple, draws=MAP_DRAWS)


def _inflation(fit: FitRecord) -> float:
    """Factor on uncertainties of limits after a failed validation."""
    return 1.0 if fit.summary.validation is None else fit.summary.validation.inflation


def _judged(
    tolerance: Tolerance, fit: FitRecord, ratios_deg_per_step: np.ndarray | None, errors_mm: np.ndarray, range_mm: float
) -> Criterion:
    """A stated tolerance of one direction, or of a point.

    Raises:
        NothingToEstimate: the direction was never moved.
    """
    if tolerance.of == POINT:
        return tolerance.judged_error(f"3D point at {range_mm:g} mm", "mm", errors_mm)
    estimate = fit.summary.effective.get(tolerance.of)
    if estimate is None or ratios_deg_per_step is None:
        message = f"--of {tolerance.of}: the axis was never moved in this direction"
        raise NothingToEstimate("no-motion", message, remedy="name a direction that has looks")
    errors = _inflation(fit) * (ratios_deg_per_step[:, DIRECTIONS.index(tolerance.of)] - estimate.value)
    return tolerance.judged_error(f"ratio {tolerance.of}", "deg/step", errors)


def _ratio_criteria(ratios_deg_per_step: np.ndarray, fit: FitRecord, limit: float) -> list[Criterion]:
    """Every effective ratio against its limit, deg/step."""
    criteria = []
    for direction, draws in zip(DIRECTIONS, ratios_deg_per_step.T, strict=True):
        estimate = fit.summary.effective[direction]
        if estimate is not None:
            errors = _inflation(fit) * (draws - estimate.value)
            criteria.append(criterion(f"ratio {direction}", errors, limit, "deg/step"))
    return criteria

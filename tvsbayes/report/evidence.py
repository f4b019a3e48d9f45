"""What a report shows, gathered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.calibration_file import stored_ratios
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.coordinates.error_map import ErrorMap, error_map, simple_calibration
from tvsbayes.errors import NothingToEstimate
from tvsbayes.estimators.four_point import ClassicResult, classic
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.metrology.budget_tables import BudgetTable
from tvsbayes.metrology.look_budget import Budget, budget, coordinate_budget
from tvsbayes.results.comparison_record import CANNOT_TELL, stored_hold_out, stored_plan

MET, NOT_MET = "met", "not met"
MET_PROBABILITY = 0.95


@dataclass(frozen=True)
class Criterion:
    """Whether an error stays within a limit.

    Attributes:
        quantity: whose error.
        limit: largest error allowed, in `unit`.
        unit: of the limit.
        probability: that the error lies within it.
        verdict: "met" from a probability of 0.95 on, "not met" up to 0.05, else "cannot tell".
    """

    quantity: str
    limit: float
    unit: str
    probability: float
    verdict: str


def criterion(quantity: str, errors: np.ndarray, limit: float, unit: str) -> Criterion:
    """Judge draws of an error (n,) by a limit (decision rule stated beforehand, ISO/IEC 17025 7.8.6)."""
    probability = float(np.mean(np.abs(errors) <= limit))
    verdict = MET if probability >= MET_PROBABILITY else NOT_MET if probability <= 1 - MET_PROBABILITY else CANNOT_TELL
    return Criterion(quantity, limit, unit, probability, verdict)


MAP_CELLS = 5
"""Per axis; odd, so that one lies in the middle."""
MAP_DRAWS = 1000
"""Rigs of the maps: a probability near 0.95 is then known to 0.007."""
MAP_RANGES_MM = (300.0, 2000.0)
"""Ranges mapped besides the stated one: the scanner's near and far ends."""


@dataclass(frozen=True)
class Evidence:
    """Everything a report shows.

    Attributes:
        campaign: what was measured.
        fit: the document of `results/fit.json`.
        classic: the paper's estimator; None without complete experiments.
        held_out: the document of `results/compare.json`, None where `compare` was not run on these data.
        planned: the document of `results/plan.json`, None where `plan --given` was not run on these data.
        criteria: what was asked of the calibration, judged.
        distances_mm: draws of the 3D error by estimator at `range_mm` and the middle of the counters.
        range_mm: stated range.
        maps: error maps.
        budget: of a point at that range.
        point: the same for its least certain coordinate, by parameter.
    """

    campaign: Campaign
    fit: Mapping[str, object]
    classic: ClassicResult | None
    held_out: Mapping[str, object] | None
    planned: Mapping[str, object] | None
    criteria: Sequence[Criterion]
    distances_mm: Mapping[str, np.ndarray]
    range_mm: float
    maps: ErrorMap
    budget: Budget | None
    point: BudgetTable | None


def gather(
    campaign: Campaign,
    fit: Mapping[str, object],
    calibration: Calibration,
    *,
    range_mm: float,
    limit_deg_per_step: float | None = None,
    limit_mm: float | None = None,
) -> Evidence:
    """Ask the library for everything a report shows.

    Args:
        campaign: what was measured.
        fit: its `fit.json`.
        calibration: its draws.
        range_mm: at which millimetres are stated.
        limit_deg_per_step: largest error allowed of every effective ratio.
        limit_mm: largest 3D error allowed at that range, pan and tilt in the middle of the counters seen.
    """
    try:
        classic_result = classic(campaign)
    except NothingToEstimate:
        classic_result = None
    simple = {"nominal": simple_calibration(campaign.rig.priors)}
    if classic_result is not None:
        simple["classic"] = simple_calibration(campaign.rig.priors, classic_result)
    (pan_low, pan_high), (tilt_low, tilt_high) = calibration.range_steps
    middle = 0.5 * (pan_low + pan_high), 0.5 * (tilt_low + tilt_high)
    ranges = sorted({*MAP_RANGES_MM, range_mm})
    pan, tilt = np.linspace(pan_low, pan_high, MAP_CELLS), np.linspace(tilt_low, tilt_high, MAP_CELLS)
    maps = error_map(calibration, pan, tilt, ranges, simple=simple, draws=MAP_DRAWS)
    # The middle cell of an odd number is the middle of the counters.
    cell = MAP_CELLS // 2, MAP_CELLS // 2, ranges.index(range_mm)
    found = {name: distance[:, *cell] for name, distance in maps.distance_mm.items()}
    criteria = []
    # Limits are judged with the uncertainty that a failed validation leaves (`information.Validation`).
    inflation = float((fit.get("validation") or {}).get("inflation", 1.0))
    if limit_deg_per_step is not None:
        draws = stored_ratios(campaign)
        for k, direction in enumerate(DIRECTIONS):
            estimate = fit["effective_deg_per_step"].get(direction)
            if estimate is not None:
                errors = inflation * (draws[:, k] - estimate["value"])
                criteria.append(criterion(f"ratio {direction}", errors, limit_deg_per_step, "deg/step"))
    if limit_mm is not None:
        criteria.append(criterion(f"3D point at {range_mm:g} mm", inflation * found["joint"], limit_mm, "mm"))
    ray = calibration.ray(*middle, ("left", "up"))
    point = np.asarray(ray.origin_mm) + range_mm * np.asarray(ray.direction)
    reading = calibration.reading(point)
    found_budget = budget(calibration, *middle, reading)
    least = "xyz"[int(np.argmax(np.diag(found_budget.covariance_mm2)))]
    return Evidence(
        campaign=campaign,
        fit=fit,
        classic=classic_result,
        held_out=stored_hold_out(campaign, fit),
        planned=stored_plan(campaign, fit),
        criteria=criteria,
        distances_mm=found,
        range_mm=range_mm,
        maps=maps,
        budget=found_budget,
        point=coordinate_budget(found_budget, calibration, point, least),
    )

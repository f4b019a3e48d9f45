"""All inputs of a report: stored results, the classic estimate, errors in 3D, pictures, limits with their verdicts.

Ratios in deg/step, points and their errors in mm, frame T; pictures in px with the integer at the centre of a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.calibration.calibration_file import calibration_json, content_sha256
from tvsbayes.calibration.optics import ERROR_AT, PLAY_AT
from tvsbayes.calibration.pointing import INPUT_NAMES, Calibration
from tvsbayes.coordinates.error_map import ErrorMap, SimpleError, error_map, simple_error
from tvsbayes.coordinates.simple_calibration import simple_calibrations
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.estimators.four_point import ClassicResult, classic_of
from tvsbayes.files.images import read_image
from tvsbayes.instrument.axes import AXES, DIRECTIONS, HOME_APPROACH, SENSES, Axis
from tvsbayes.instrument.campaign import CAMERAS, Campaign, Spot, frame_name, stereo_spots
from tvsbayes.metrology.conformity import CONFORMING_PROBABILITY, CONFORMS, FAILS, UNDECIDED, Criterion, Tolerance
from tvsbayes.metrology.look_budget import Budget, budget, coordinate_budget
from tvsbayes.report.drawing import BLACK, BLUE, DIRECTION_STYLE, ORANGE, PURPLE, RED, SKY, banded, drawing, legend
from tvsbayes.report.tables import TableView, chance_text, optional, table, three_digits, two_digits
from tvsbayes.results.comparison_record import CANNOT_TELL, HoldOut, stored_hold_out
from tvsbayes.results.compensation_record import Verification, stored_verification
from tvsbayes.results.estimates import StopResidual
from tvsbayes.results.fit_record import FitEvidence, FitRecord
from tvsbayes.results.metrology_tables import BudgetTable
from tvsbayes.results.plan_record import PlanRecord, stored_plan
from tvsbayes.statistics.intervals import band95

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MET, NOT_MET = "met", "not met"
SATISFIED = (MET, CONFORMS)
"""Verdicts that let `report` end with exit code 0."""
WORST_FIRST = (FAILS, NOT_MET, UNDECIDED, CANNOT_TELL, CONFORMS, MET)
COLOUR = {
    **dict.fromkeys((FAILS, NOT_MET), "not-met"),
    **dict.fromkeys((UNDECIDED, CANNOT_TELL), "cannot-tell"),
    **dict.fromkeys((CONFORMS, MET), "met"),
}
"""Class of a verdict on the page."""
POINT = "xyz"
"""Name of a point's error in 3D for a tolerance."""
MAP_CELLS = 5
"""Number of cells of a map per axis; odd, so that one is in the middle."""
MAP_DRAWS = 1000
"""Number of draws of the maps: a probability near 0.95 is then known to 0.007."""
BAND_POINTS = 161
"""Number of counters of the curves of the gears' errors."""
MAP_RANGES_MM = (300.0, 2000.0)
"""Ranges of maps in addition to the stated one: the scanner's near and far ends."""
PLAY_SHOWN = 0.1
"""Least variation of the play, over that of the error, for its own panel."""
LOOKS_SHOWN = 4
HALF_PX = 20
"""Half the side of a cut-out."""


def criterion(quantity: str, errors: np.ndarray, limit: float, unit: str) -> Criterion:
    """Compare draws of an error (n,) with a limit (decision rule agreed in advance, ISO/IEC 17025 7.8.6).

    It is "met" for a probability of at least 0.95, "not met" up to 0.05, else "cannot tell".
    """
    probability = float(np.mean(np.abs(errors) <= limit))
    if probability >= CONFORMING_PROBABILITY:
        return Criterion(quantity, limit, unit, probability, MET, risk=1 - probability)
    if probability <= 1 - CONFORMING_PROBABILITY:
        return Criterion(quantity, limit, unit, probability, NOT_MET, risk=probability)
    return Criterion(quantity, limit, unit, probability, CANNOT_TELL, risk=None)


def criterion_text(c: Criterion) -> str:
    """A limit with its verdict, as a line."""
    chance = "" if c.probability is None else f"probability {chance_text(c.probability)}"
    if c.value is None:
        return f"{c.quantity} within {c.limit:g} {c.unit}: {c.verdict} ({chance})"
    guard = "" if c.guard_band is None else f"guard band {two_digits(c.guard_band)} {c.unit}"
    risk = "" if c.risk is None else f"risk {chance_text(c.risk)}"
    basis = ", ".join(filter(None, (f"rule {c.rule}", guard, chance, risk)))
    u = f", u = {two_digits(c.u)}" if c.u else ""
    measured = f" {three_digits(c.value)} {c.unit}{u}:" if c.value else ""
    return f"{c.quantity}:{measured} {c.verdict} to {c.limit:g} {c.unit} ({basis})"


def criteria_table(criteria: Sequence[Criterion]) -> TableView | None:
    """Every limit with its verdict and the rule; None where no limit was stated."""
    if not criteria:
        return None
    if all(c.value is None for c in criteria):
        caption = "Decision rule: met if P(|error| <= limit) >= 0.95, not met if <= 0.05, else cannot tell"
        return table(
            caption,
            criteria,
            {
                "error of": lambda c: c.quantity,
                "limit": lambda c: f"{c.limit:.3g} {c.unit}",
                "probability": _chance,
                "verdict": lambda c: c.verdict,
            },
        )
    return table(
        "Conformity by ISO 14253-1 and JCGM 106: guard band taken off the limit; risk that the verdict is wrong",
        criteria,
        {
            "": lambda c: c.quantity,
            "measured": lambda c: three_digits(c.value) if c.value else "",
            "u": lambda c: two_digits(c.u) if c.u else "",
            "limit": lambda c: f"{c.limit:.3g} {c.unit}",
            "rule": lambda c: c.rule,
            "guard band": lambda c: optional(two_digits, c.guard_band),
            "probability": lambda c: optional(chance_text, c.probability),
            "risk": lambda c: optional(chance_text, c.risk),
            "verdict": lambda c: c.verdict,
        },
    )


def _chance(c: Criterion) -> str:
    """The probability; where the verdict is open, also the number in a hundred beyond the limit."""
    probability = c.probability or 0.0
    beyond = f": {100 - round(100 * probability)} of 100 are off by more"
    return chance_text(probability) + beyond * (c.verdict == CANNOT_TELL)


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


def gear_errors(band: GearBand, stops: Sequence[StopResidual]) -> Figure:
    """Transmission error of an axis over its counters with a 95 % band and the stops; also the play, if it varies."""
    play = np.ptp(band.play_deg, axis=0).max() > PLAY_SHOWN * np.ptp(band.error_deg, axis=0).max()
    with drawing(4.6 if play else 3.2) as figure:
        panels = np.atleast_1d(figure.subplots(1 + play, 1, sharex=True, height_ratios=[2, 1] if play else [1]))
        curves = [(panels[0], band.error_deg, "transmission error", SKY, BLUE)]
        curves += [(panels[1], band.play_deg, "change of play", ORANGE, PURPLE)] if play else []
        for axes, drawn, name, light, dark in curves:
            banded(axes, band.steps, drawn, name, light, dark)
            for side in ((band.steps[0], band.seen_steps[0]), (band.seen_steps[1], band.steps[-1])):
                axes.axvspan(*side, color="#EEEEEE", zorder=0)
            axes.axhline(0.0, color=BLACK, linewidth=0.6)
            axes.set(ylabel=f"{name}, deg")
        for direction in SENSES[band.axis]:
            stops_here = [stop for stop in stops if stop.direction == direction]
            marker, colour = DIRECTION_STYLE[direction]
            steps = np.array([stop.steps for stop in stops_here], dtype=float)
            errors = np.interp(steps, band.steps, band.error_deg[1]) + [stop.deviation_deg for stop in stops_here]
            label = f"stops, moving {direction}"
            panels[0].plot(steps, errors, marker, color=colour, markersize=3.5, rasterized=True, label=label)
        panels[-1].set_xlabel(f"{band.axis} counter, steps")
        legend(figure, 2, panels[0])
    return figure


@dataclass(frozen=True)
class SpotCrop:
    """The region around a spot in one picture.

    Attributes:
        spot: id of the look.
        camera: left or right.
        grey: values, rows from top to bottom, shape (h, w).
        corner_px: pixel (u, v) of the first value.
        centre_px: (u, v) of the spot as the campaign states it.
    """

    spot: int
    camera: str
    grey: np.ndarray
    corner_px: tuple[int, int]
    centre_px: tuple[float, float]


def spot_crops(campaign: Campaign, suspects: Sequence[int]) -> tuple[SpotCrop, ...]:
    """Make cut-outs, of suspect spots first, then of others evenly chosen; none for missing or damaged frames."""
    if campaign.path is None or not (campaign.path / "frames").is_dir():
        return ()
    usable = [spot for spot in stereo_spots(campaign.spots) if spot.status == "ok"]
    suspected = [spot for spot in usable if spot.spot in set(suspects)][:LOOKS_SHOWN]
    others = [spot for spot in usable if spot not in suspected]
    count = min(LOOKS_SHOWN - len(suspected), len(others))
    indices = np.linspace(0, len(others) - 1, count).round().astype(int).tolist()
    return tuple(crop for spot in [*suspected, *(others[k] for k in indices)] for crop in _crops(campaign.path, spot))


def _crops(folder: Path, spot: Spot) -> Iterator[SpotCrop]:
    """Both cameras' cut-outs of a look."""
    for camera in CAMERAS:
        try:
            picture = read_image(folder / frame_name(spot.spot, camera), folder)
        except InputError:
            # A missing picture must not stop the report.
            continue
        u, v = float(getattr(spot, f"u_{camera}_px")), float(getattr(spot, f"v_{camera}_px"))
        left, top = max(round(u) - HALF_PX, 0), max(round(v) - HALF_PX, 0)
        # The centre of a spot cut by the edge may be outside; a negative index would count from the other edge.
        right, bottom = max(round(u) + HALF_PX + 1, 0), max(round(v) + HALF_PX + 1, 0)
        grey = picture[top:bottom, left:right].mean(axis=2)
        if grey.size:
            yield SpotCrop(spot.spot, camera, grey, (left, top), (u, v))


def spot_gallery(crops: Sequence[SpotCrop]) -> Figure:
    """Draw the cut-outs, a column per look, with a cross at each centre."""
    looks = list(dict.fromkeys(crop.spot for crop in crops))
    with drawing(2.9) as figure:
        panels = figure.subplots(len(CAMERAS), len(looks), squeeze=False)
        for axes in panels.flat:
            axes.set_axis_off()
        for crop in crops:
            axes = panels[CAMERAS.index(crop.camera), looks.index(crop.spot)]
            (left, top), (height, width) = crop.corner_px, crop.grey.shape
            extent = (left - 0.5, left + width - 0.5, top + height - 0.5, top - 0.5)
            axes.imshow(crop.grey, cmap="gray", extent=extent, interpolation="nearest")
            axes.plot(*crop.centre_px, "+", color=RED, markersize=9)
            axes.set_title(f"{crop.spot}, {crop.camera}")
    return figure


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

    Raises:
        NothingToEstimate: the tolerance is of a direction that was never moved.
    """
    classic_result = classic_of(campaign)
    simple = simple_calibrations(campaign.rig.priors, classic_result)
    pan, tilt = (np.linspace(low, high, MAP_CELLS) for low, high in calibration.range_steps)
    ranges = sorted({*MAP_RANGES_MM, range_mm})
    maps = error_map(calibration, pan, tilt, ranges, simple=simple, draws=MAP_DRAWS)
    # With an odd number of cells the middle one is at the middle of the counters.
    cell = MAP_CELLS // 2, MAP_CELLS // 2, maps.range_mm.tolist().index(range_mm)
    distances = {name: distance[:, *cell] for name, distance in maps.distance_mm.items()}
    validation = fit.summary.validation
    # A failed validation widens all uncertainties.
    inflation = 1.0 if validation is None else validation.inflation
    criteria, point_name = [], f"3D point at {range_mm:g} mm"
    ratio_errors: dict[str, np.ndarray] = {}
    if ratios_deg_per_step is not None:
        for direction, draws in zip(DIRECTIONS, ratios_deg_per_step.T, strict=True):
            if (estimate := fit.summary.effective.get(direction)) is not None:
                ratio_errors[direction] = inflation * (draws - estimate.value)
    if limit_deg_per_step is not None:
        criteria += [criterion(f"ratio {d}", e, limit_deg_per_step, "deg/step") for d, e in ratio_errors.items()]
    if limit_mm is not None:
        criteria.append(criterion(point_name, inflation * distances["joint"], limit_mm, "mm"))
    if tolerance is not None and tolerance.of == POINT:
        criteria.append(tolerance.judged_error(point_name, "mm", inflation * distances["joint"]))
    elif tolerance is not None:
        if tolerance.of not in ratio_errors:
            message = f"--of {tolerance.of}: the axis was never moved in this direction"
            raise NothingToEstimate("no-motion", message, remedy="name a direction that has looks")
        criteria.append(tolerance.judged_error(f"ratio {tolerance.of}", "deg/step", ratio_errors[tolerance.of]))
    middle = float(calibration.range_steps[0].mean()), float(calibration.range_steps[1].mean())
    ray = calibration.ray(*middle, HOME_APPROACH)
    point = np.asarray(ray.origin_mm) + range_mm * np.asarray(ray.direction)
    point_budget = budget(calibration, *middle, calibration.reading(point))
    coordinate = "xyz"[int(np.argmax(np.diag(point_budget.covariance_mm2)))]
    digest = content_sha256(calibration_json(calibration))
    return Evidence(
        campaign=campaign,
        fit=fit,
        classic=classic_result,
        held_out=stored_hold_out(campaign, fit.provenance.inputs),
        planned=stored_plan(campaign, fit.provenance.inputs),
        criteria=criteria,
        distances_mm=distances,
        range_mm=range_mm,
        simple_errors={name: simple_error(calibration, each, middle, range_mm) for name, each in simple.items()},
        maps=maps,
        budget=point_budget,
        point=coordinate_budget(point_budget, calibration, point.tolist(), coordinate),
        gears=gear_bands(calibration),
        crops=spot_crops(campaign, fit.summary.suspect_spots),
        doubts=tuple(doubts),
        verified=stored_verification(campaign, fit.provenance.inputs, digest, "deg"),
    )

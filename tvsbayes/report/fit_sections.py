"""Sections of the page on a fit: set-up, headlines, parameters, identifiability, residuals, tests.

Ratios in deg/step, other values in the unit of their name; frame S in mm for the picture of the rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.display import concise
from tvsbayes.estimators.four_point import ClassicResult, Experiment
from tvsbayes.instrument.axes import AXES, DIRECTIONS, Axis
from tvsbayes.instrument.experiments import name_of
from tvsbayes.metrology.traceability import header_table, stated_text
from tvsbayes.report import figures
from tvsbayes.report.advice import asks_for_looks
from tvsbayes.report.document import FigureView, Section
from tvsbayes.report.fit_text import agreement_line, sampling_line
from tvsbayes.report.parameter_words import name_in_words, sentence_in_words
from tvsbayes.report.position_figures import gear_errors
from tvsbayes.report.result_tables import (
    ESTIMATE_COLUMNS,
    classic_table,
    estimate_row,
    gap_table,
    gears_table,
    hold_out_table,
    outlier_lines,
    range_text,
    waves_table,
)
from tvsbayes.report.spot_pictures import spot_gallery
from tvsbayes.report.tables import TableView, interval_text, two_digits
from tvsbayes.results.estimates import Cause, StopResidual, Validation

if TYPE_CHECKING:
    from tvsbayes.report.evidence import Evidence, GearBand


CORRELATED = (
    *("degrees_per_step.pan", "degrees_per_step.tilt", "backlash_deg.pan", "backlash_deg.tilt"),
    *("mirror_offset_mm", "tilt_zero_deg", "laser_tilt_deg.x", "laser_tilt_deg.y", "focal_scale"),
)
"""Parameters of the correlation matrix, in order; parameters that are not estimated are omitted."""


LEAST_P = 0.001
"""Least printed probability; smaller ones are printed as "below" it."""
PRIORS_SHOWN = 8
"""Largest number of priors in the table of sensitivities, the most influential first; fit.json has all."""
HEADER_SHOWN = ("method", "notes")
"""Keys of a campaign's header that are not on the first page."""


def fit_sections(e: Evidence) -> list[Section]:
    """The sections in the order of the page."""
    parts = (results_section, classic_section, setup_section, gear_section, identifiability_section, residuals_section)
    sections = (part(e) for part in (*parts, validation_section) if part is not gear_section or e.gears)
    return [section for section in sections if section is not None]


def setup_section(e: Evidence) -> Section:
    """The rig, and the coverage of the data."""
    campaign, header, summary = e.campaign, e.campaign.header, e.fit.summary
    ok = sum(spot.status == "ok" for spot in campaign.spots)
    targets = sorted({spot.target for spot in campaign.spots if spot.target})
    rows = [[key, str(header[key])] for key in HEADER_SHOWN if header.get(key)]
    rows += [
        ["moves, segments", f"{len(campaign.moves)}, {1 + campaign.moves[-1].segment}"],
        ["spots used, in all", f"{ok - len(summary.excluded_spots)}, {len(campaign.spots)}"],
        ["placements of the sheet", ", ".join(targets) or "not named"],
    ]
    rows += [[*stated_text(campaign, "environment", key)] for key in header_table(campaign, "environment")]
    names = [f"extrinsics.translation_mm.{a}" for a in "xyz"]
    known = all(name in summary.parameters for name in names)
    position = [summary.parameters[name].value for name in names] if known else None
    baseline = campaign.rig.priors["baseline_mm"].value
    views = [
        FigureView(
            figures.setup(campaign, position, baseline),
            "Positions of cameras, positioner and spots from above and from the side; the coordinates are in spots.csv "
            "and in the table of results",
            "The rig as estimated, frame S: left camera at the origin, X depth, Y left, Z up.",
        ),
        FigureView(
            figures.coverage(campaign),
            "Counters at which spots were seen, and where the spots lie in both images",
            "Data coverage. What lies outside of it is extrapolated.",
        ),
    ]
    if e.crops:
        ids = ", ".join(dict.fromkeys(str(crop.spot) for crop in e.crops))
        view = FigureView(
            spot_gallery(e.crops),
            f"Cut-outs of the pictures of spots {ids}, a cross at each centre",
            "Spots as the cameras saw them, by number; suspect ones first. Red cross: the centre that was used.",
        )
        views.append(view)
    return Section("Set-up and data", tables=[TableView("What was measured", [], rows)], figures=views)


def results_section(e: Evidence) -> Section:
    """Gap between both estimators, and every parameter."""
    text = [
        "value(u): the digits in brackets are the standard uncertainty in units of the last place, or with their "
        "decimal point the uncertainty itself."
    ]
    if e.classic is None:
        text.append("Classic: not applicable, the campaign has no complete four-point experiment.")
    tables, views = [_parameters(e)], list[FigureView]()
    if e.shown.gap:
        tables.insert(0, gap_table(e.shown.gap))
        view = FigureView(
            figures.gap_terms(e.shown.gap),
            "Terms of the difference between both estimators; values in the table above",
            "Why the classic differs from the joint.",
        )
        views.insert(0, view)
    if e.fit.summary.curves is not None:
        views.append(
            FigureView(
                figures.ratio_curves(e.fit.summary.curves),
                "Local ratios over the range of pan and tilt angles; values in fit.json",
                "Local ratios over the range that was seen: gear ratio times the slope of the mirrors.",
            )
        )
    return Section("Results in full", text, tables=tables, figures=views, opened=True)


def classic_section(e: Evidence) -> Section | None:
    """The paper's Table 1 and Figures 11 to 16; None without a complete experiment."""
    if e.classic is None or not e.classic.experiments:
        return None
    shown = _middle(e.classic)
    name = name_of(shown.direction, shown.experiment)
    views = [
        FigureView(
            figures.points_3d(e.campaign, shown.experiment, shown.direction),
            f"Points 1 to 4 of experiment {name} in space, joined in their order",
            f"Experiment {name}, the median of its direction: its points in frame S (Figure 11 of the paper).",
        ),
        FigureView(
            figures.trajectories(e.campaign, shown.experiment, shown.direction),
            f"Beams of experiment {name} before and after its steps, with the angle of each",
            f"Experiment {name}: the beam before and after, in the plane of its angle (Figure 12).",
        ),
    ]
    for number, direction in enumerate(DIRECTIONS, 13):
        if (result := e.classic.directions[direction]) is None:
            continue
        views.append(
            FigureView(
                figures.direction_scatter(e.classic, direction, e.fit.summary.effective[direction]),
                f"Ratios of {result.n} experiments moving {direction} about their mean; values in the table",
                f"{direction}: experiments in order, mean and bands of 1, 2 and 3 sd; blue: joint (Figure {number}).",
            )
        )
    lines = outlier_lines(e.classic)
    return Section("The classic four-point method", [], lines, [classic_table(e.classic)], views)


def _middle(result: ClassicResult) -> Experiment:
    """The experiment whose ratio is the median of the first direction that has any."""
    direction = next(name for name in DIRECTIONS if result.directions[name] is not None)
    ordered = sorted((e for e in result.experiments if e.direction == direction), key=lambda e: e.deg_per_step)
    return ordered[(len(ordered) - 1) // 2]


def _parameters(e: Evidence) -> TableView:
    """All estimated parameters except those of the cameras and ratios by direction, which have their own table."""
    rows = []
    by_direction = {f"degrees_per_step.{direction}" for direction in DIRECTIONS}
    for name, x in e.fit.summary.parameters.items():
        if name.startswith("stereo.") or name in by_direction or x.sd == 0:
            continue
        rows.append(
            [
                name_in_words(name),
                concise(x.value, x.sd),
                interval_text(*x.interval95, x.sd),
                "" if x.prior_sd is None else two_digits(x.prior_sd),
                "" if x.contraction is None else f"{100 * max(x.contraction, 0.0):.0f}",
                name,
            ]
        )
    columns = ["parameter", "value(u)", "95 % interval", "u of the prior", "set by the data, %", "in files"]
    caption = "Parameters of the joint model; 100 %: the prior no longer matters"
    return TableView(caption, columns, rows)


def gear_section(e: Evidence) -> Section:
    """Errors of the gears that repeat by position."""
    summary = e.fit.summary
    rows = []
    for direction in DIRECTIONS:
        if summary.effective[direction] is not None:
            rows.append(estimate_row(f"{direction}, line", summary.effective[direction], "deg/step"))
            rows.append(estimate_row(f"{direction}, local", summary.local.get(direction), "deg/step"))
    ratios = TableView("Line through the looks, and gear ratio times slope of the mirrors", ESTIMATE_COLUMNS, rows)
    text = [
        f"Effective ratios are slopes of lines through the looks, {range_text(summary)}, errors of the gears included; "
        "at other counters these errors are different. Local ratios are those of gears and mirrors without them, at "
        "the mean angles of the looks.",
        "Where no look reached (grey) nothing is known of the errors but their size: located points there are marked "
        "as extrapolated, and their uncertainty grows.",
    ]
    views = [_view(band, [stop for stop in e.shown.residuals if stop.axis == band.axis]) for band in e.gears]
    tables = [waves_table(summary), gears_table(summary), ratios]
    return Section("Gears: what repeats by position", text, tables=tables, figures=views)


def _view(band: GearBand, stops: Sequence[StopResidual]) -> FigureView:
    alt = f"Transmission error of the {band.axis} axis over its counters as a curve with a band, and stops as markers"
    caption = f"{band.axis} axis: transmission error with its 95 % band, and the stops on it; grey: nothing was seen."
    return FigureView(gear_errors(band, stops), alt, caption)


def identifiability_section(e: Evidence) -> Section:
    """Correlated parameters, and influential stops and priors."""
    names, matrix = e.fit.covariance.names, e.fit.covariance.matrix
    shown = [n for n in CORRELATED if n in names and matrix[names.index(n), names.index(n)] > 0]
    views, rows = [], []
    if len(shown) > 1:
        index = [names.index(n) for n in shown]
        block = matrix[np.ix_(index, index)]
        sd = np.sqrt(np.diag(block))
        correlation = block / np.outer(sd, sd)
        for i in range(len(shown)):
            for j in range(i):
                if abs(correlation[i, j]) > 0.8:
                    rows.append([f"{name_in_words(shown[j])}; {name_in_words(shown[i])}", f"{correlation[i, j]:+.3f}"])
        views.append(
            FigureView(
                figures.correlations(shown, correlation),
                "Correlation matrix; every cell holds its value in per cent",
                "Correlations of the posterior.",
            )
        )
    summary = e.fit.summary
    # Two directions of the same parameters may read alike.
    items = list(dict.fromkeys(weak.text for weak in summary.weak_directions if not asks_for_looks(weak)))
    items = [sentence_in_words(text) for text in (*items, *(entry.text for entry in summary.leverage))]
    sensitive = [
        [
            f"{name_in_words(x.parameter)}: {'twice' if x.factor > 1 else 'half'} its u",
            name_in_words(x.quantity),
            f"{x.shift_sd:+.2f}",
            f"{x.sd_ratio:.2f}",
        ]
        for x in summary.prior_sensitivity[:PRIORS_SHOWN]
    ]
    text = []
    if not items:
        text.append("Every direction that matters is set by the data; no single stop decides a result.")
    caption = "Results that depend on a prior: shift in sds, and factor on the sd"
    columns = ["prior", "result", "shift, sd", "sd, factor"]
    priors = TableView(caption, columns, sensitive) if sensitive else None
    table = TableView("Correlations beyond 0.8", ["parameters", "correlation"], rows) if rows else None
    return Section("What the data determine", text, items, [table, priors], views)


def residuals_section(e: Evidence) -> Section:
    """Whether the deviations of the stops depend on a cause."""
    summary, causes = e.fit.summary, e.shown.residual_causes
    text = [
        f"chi-square {summary.noise.chi2:.1f} for {summary.noise.dof:.1f} degrees of freedom; the pixel noise is "
        f"{summary.parameters['pixel_scale'].value:.2f} times the stated one."
    ]
    views = []
    for axis in AXES:
        # A single group cannot be compared, and has no bar in the figure.
        if any(c.axis == axis and len(c.groups) > 1 for c in causes):
            alt = f"Mean deviation by group, {axis} axis; values in fit.json"
            views.append(FigureView(figures.causes(causes, axis), alt, f"{axis} axis: mean deviation by group."))
        views += stop_views(e.shown.residuals, axis)
    tables = [_causes(causes)] if causes else []
    return Section("Residuals by cause", text, tables=tables, figures=views)


def stop_views(stops: Sequence[StopResidual], axis: Axis) -> list[FigureView]:
    """Deviations of the stops of an axis; none without stops."""
    count = sum(stop.axis == axis for stop in stops)
    alt = f"Deviations of {count} stops of the {axis} axis over time and counter"
    caption = f"Stops of the {axis} axis: observed minus fitted angle."
    return [FigureView(figures.residuals(stops, axis), alt, caption)] if count else []


def _causes(causes: tuple[Cause, ...]) -> TableView:
    rows = [
        [
            f"{c.axis}: {c.name}",
            str(len(c.groups)),
            "not tested" if c.p is None else f"{c.p:.3f}" if c.p >= LEAST_P else f"below {LEAST_P:g}",
            "SUSPICIOUS" if c.suspicious else "" if c.p is None else "no sign",
        ]
        for c in causes
    ]
    return TableView("Do the deviations of the stops depend on ...", ["cause", "groups", "p", "verdict"], rows)


def validation_section(e: Evidence) -> Section:
    """Tests for model errors, diagnosis of the sampler, predictions of the classic and of left-out angles."""
    text, items, validation, sampling = [], [], e.fit.summary.validation, e.fit.summary.sampling
    tables: list[TableView | None] = []
    if validation is None:
        text.append("The results hold no tests for model errors: run the command fit again.")
    else:
        factor = f"Factor on every u: {validation.inflation:.2f}"
        if not (validation.passed or validation.widens):
            factor = "No factor on u covers what failed"
        text.append(
            f"A clean campaign fails the tests below with a probability of {100 * validation.level:g} %, all "
            f"together. {factor}."
        )
        tables.append(_tests(validation))
    if sampling is None:
        text.append("The posterior was not sampled: intervals are those of the Laplace approximation.")
    else:
        checks = sampling_line(sampling), agreement_line(sampling, e.fit.summary.tier)
        text += [f"{line}." for line in checks if line is not None]
        items += [f"not reached: {sentence}" for sentence in sampling.missing]
    tables.append(_predicted(e))
    if e.held_out is None:
        text.append(
            "Held-out experiments: not computed; run the command compare on the campaign and make the report again."
        )
    else:
        text.append(f"Held-out experiments: {e.held_out.verdict}: {e.held_out.reason}.")
        rows = [[d, f"{u:.1e}"] for d, u in e.held_out.unseen.items()]
        caption = "Not tested by a hold-out: u by stereo calibration and focal scale, common to all spots, deg/step"
        tables += [hold_out_table(e.held_out), TableView(caption, ["direction", "u"], rows)]
    return Section("Validation", text, items, tables)


def _predicted(e: Evidence) -> TableView | None:
    """The classic estimates predicted by the model, and as reported."""
    rows = []
    for direction, predicted in e.fit.summary.classic_predicted.items():
        result = None if e.classic is None else e.classic.directions[direction]
        if predicted is None or result is None:
            continue
        u = result.u_type_a_deg_per_step or 0.0
        spread = np.hypot(predicted.sd, u)
        z = (result.mean_deg_per_step - predicted.value) / spread if spread > 0 else 0.0
        cells = [concise(predicted.value, predicted.sd), concise(result.mean_deg_per_step, u), f"{z:+.1f}"]
        rows.append([direction, *cells])
    caption = "What the joint model says the classic estimator should report, and what it reports, deg/step"
    columns = ["direction", "predicted", "reported, type A", "difference / u"]
    return TableView(caption, columns, rows) if rows else None


def _tests(validation: Validation) -> TableView:
    """Every test for a model error, the least p first."""
    rows = [
        [t.name, t.where, f"{t.chi2:.1f}", str(t.dof), f"{t.p:.2g}", "FAILED" if t.failed else "no sign"]
        for t in validation.tests
    ]
    columns = ["sign of", "most at", "chi-square", "degrees of freedom", "p, all places", "verdict"]
    return TableView("Tests for errors that the model does not have", columns, rows)

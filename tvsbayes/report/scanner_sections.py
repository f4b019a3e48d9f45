"""Sections of a scanner's page: results, set-up, residuals, tests, errors in 3D, budgets, plan, method.

Ratios in deg/step, points in mm of frame T, figures of an axis in deg; other values in the unit of their name.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.display import concise
from tvsbayes.estimators.four_point import ClassicResult, Experiment
from tvsbayes.instrument.axes import AXES, DIRECTIONS, SENSES, Axis
from tvsbayes.instrument.experiments import name_of
from tvsbayes.instrument.parameters import REGISTRY
from tvsbayes.metrology.traceability import header_table, stated_text
from tvsbayes.report import figures
from tvsbayes.report.document import FigureView, Section, labelled, sentence
from tvsbayes.report.drawing import SMALLEST_SHARE
from tvsbayes.report.evidence import Evidence, gear_errors, spot_gallery
from tvsbayes.report.fit_text import agreement_line, asks_for_looks, sampling_line
from tvsbayes.report.result_tables import (
    ESTIMATE_COLUMNS,
    classic_table,
    estimate_row,
    gap_table,
    gears_table,
    hold_out_table,
    outlier_lines,
    point_budget_table,
    range_text,
    rig_waves_table,
)
from tvsbayes.report.tables import (
    TableView,
    degrees_of_freedom,
    interval_text,
    made_by,
    name_in_words,
    optional,
    present,
    sentence_in_words,
    sentences,
    share_in_words,
    source_in_words,
    table,
    three_digits,
    to_digits,
    two_digits,
)
from tvsbayes.results.estimates import StopResidual
from tvsbayes.results.metrology_tables import FIGURES, BudgetRow, BudgetTable, Predicted
from tvsbayes.statistics.intervals import NORMAL_95

if TYPE_CHECKING:
    from tvsbayes.results.estimates import Estimate

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
OTHERS = f"others, each below {100 * SMALLEST_SHARE:g} %"
"""Row of all inputs of a budget without their own row."""
END_SHIFT = 0.1
"""Least difference of an end of the linear interval for a note, over U; a quantile of 1000 draws scatters by half."""
ISO_STYLE = "ISO 230-2-style figures"


def fit_sections(e: Evidence) -> list[Section]:
    """Sections on the fit, in the order of the page."""
    return [
        results_section(e),
        *classic_section(e),
        setup_section(e),
        *([gear_section(e)] if e.gears else []),
        identifiability_section(e),
        residuals_section(e),
        validation_section(e),
    ]


def uncertainty_sections(e: Evidence) -> list[Section]:
    """Sections on uncertainty and method, in the order of the page."""
    parts = (maps_section, budgets_section, axes_section, plan_section, method_section)
    return [*(part(e) for part in parts), Section("Limitations", items=sentences("sections")["limits"])]


def results_section(e: Evidence) -> Section:
    """Gap between both estimators, and every parameter."""
    text, tables, views = [sentences("sections")["results"]], [_parameters(e)], list[FigureView]()
    if e.classic is None:
        text.append("Classic: not applicable, the campaign has no complete four-point experiment.")
    if e.shown.gap:
        tables.insert(0, gap_table(e.shown.gap))
        alt = "Terms of the difference between both estimators; values in the table above"
        views.append(FigureView(figures.gap_terms(e.shown.gap), alt, "Why the classic differs from the joint."))
    if e.fit.summary.curves is not None:
        alt = "Local ratios over the range of pan and tilt angles; values in fit.json"
        caption = "Local ratios over the range that was seen: gear ratio times the slope of the mirrors."
        views.append(FigureView(figures.ratio_curves(e.fit.summary.curves), alt, caption))
    return Section("Results in full", text, tables=tables, figures=views, opened=True)


def _parameters(e: Evidence) -> TableView:
    """All estimated parameters except those of the cameras and ratios by direction, which have their own table."""
    by_direction = {f"degrees_per_step.{direction}" for direction in DIRECTIONS}
    shown = [
        (name, x)
        for name, x in e.fit.summary.parameters.items()
        if not (name.startswith("stereo.") or name in by_direction or x.sd == 0)
    ]
    return table(
        "Parameters of the joint model; 100 %: the prior no longer matters",
        shown,
        {
            "parameter": lambda row: name_in_words(row[0]),
            "value(u)": lambda row: concise(row[1].value, row[1].sd),
            "95 % interval": lambda row: interval_text(*row[1].interval95, row[1].sd),
            "u of the prior": lambda row: optional(two_digits, row[1].prior_sd),
            "set by the data, %": lambda row: optional(lambda x: f"{100 * max(x, 0.0):.0f}", row[1].contraction),
            "in files": lambda row: row[0],
        },
    )


def classic_section(e: Evidence) -> list[Section]:
    """The paper's Table 1 and Figures 11 to 16; none without a complete experiment."""
    if e.classic is None or not e.classic.experiments:
        return []
    shown = _middle(e.classic)
    which = shown.experiment, shown.direction
    name = name_of(shown.direction, shown.experiment)
    views = [
        FigureView(
            figures.points_3d(e.campaign, *which),
            f"Points 1 to 4 of experiment {name} in space, joined in their order",
            f"Experiment {name}, the median of its direction: its points in frame S (Figure 11 of the paper).",
        ),
        FigureView(
            figures.trajectories(e.campaign, *which),
            f"Beams of experiment {name} before and after its steps, with the angle of each",
            f"Experiment {name}: the beam before and after, in the plane of its angle (Figure 12).",
        ),
        *(
            FigureView(
                figures.direction_scatter(e.classic, direction, e.fit.summary.effective[direction]),
                f"Ratios of {result.n} experiments moving {direction} about their mean; values in the table",
                f"{direction}: experiments in order, mean and bands of 1, 2 and 3 sd; blue: joint (Figure {number}).",
            )
            for number, direction in enumerate(DIRECTIONS, 13)
            if (result := e.classic.directions[direction]) is not None
        ),
    ]
    tables = [classic_table(e.classic)]
    return [Section("The classic four-point method", [], outlier_lines(e.classic), tables, views)]


def _middle(result: ClassicResult) -> Experiment:
    """The experiment whose ratio is the median of the first direction that has any."""
    direction = next(name for name in DIRECTIONS if result.directions[name] is not None)
    ordered = sorted((e for e in result.experiments if e.direction == direction), key=lambda e: e.deg_per_step)
    return ordered[(len(ordered) - 1) // 2]


def setup_section(e: Evidence) -> Section:
    """The rig, and the coverage of the data."""
    campaign, header, summary = e.campaign, e.campaign.header, e.fit.summary
    ok = sum(spot.status == "ok" for spot in campaign.spots)
    targets = sorted({spot.target for spot in campaign.spots if spot.target})
    rows = [
        *([key, str(header[key])] for key in HEADER_SHOWN if header.get(key)),
        ["moves, segments", f"{len(campaign.moves)}, {1 + campaign.moves[-1].segment}"],
        ["spots used, in all", f"{ok - len(summary.excluded_spots)}, {len(campaign.spots)}"],
        ["placements of the sheet", ", ".join(targets) or "not named"],
        *([*stated_text(campaign, "environment", key)] for key in header_table(campaign, "environment")),
    ]
    names = [f"extrinsics.translation_mm.{a}" for a in "xyz"]
    known = all(name in summary.parameters for name in names)
    position = [summary.parameters[name].value for name in names] if known else None
    views = [
        FigureView(
            figures.setup(campaign, position, campaign.rig.values["baseline_mm"]),
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
        alt = f"Cut-outs of the pictures of spots {', '.join(dict.fromkeys(str(crop.spot) for crop in e.crops))}"
        caption = "Spots as the cameras saw them, by number; suspect ones first. Red cross: the centre that was used."
        views.append(FigureView(spot_gallery(e.crops), f"{alt}, a cross at each centre", caption))
    return Section("Set-up and data", tables=[TableView("What was measured", [], rows)], figures=views)


def gear_section(e: Evidence) -> Section:
    """Errors of the gears that repeat by position."""
    summary, rows, views = e.fit.summary, [], []
    for direction in DIRECTIONS:
        if summary.effective[direction] is not None:
            rows.append(estimate_row(f"{direction}, line", summary.effective[direction], "deg/step"))
            rows.append(estimate_row(f"{direction}, local", summary.local.get(direction), "deg/step"))
    ratios = TableView("Line through the looks, and gear ratio times slope of the mirrors", ESTIMATE_COLUMNS, rows)
    text = [
        f"Effective ratios are slopes of lines through the looks, {range_text(summary)}, errors of the gears included; "
        "at other counters these errors are different. Local ratios are those of gears and mirrors without them, at "
        "the mean angles of the looks.",
        sentences("sections")["gears_unseen"],
    ]
    for band in e.gears:
        axis, stops = band.axis, [stop for stop in e.shown.residuals if stop.axis == band.axis]
        alt = f"Transmission error of the {axis} axis over its counters as a curve with a band, and stops as markers"
        caption = f"{axis} axis: transmission error with its 95 % band, and the stops on it; grey: nothing was seen."
        views.append(FigureView(gear_errors(band, stops), alt, caption))
    tables = [rig_waves_table(summary), gears_table(summary), ratios]
    return Section("Gears: what repeats by position", text, tables=tables, figures=views)


def identifiability_section(e: Evidence) -> Section:
    """Correlated parameters, and influential stops and priors."""
    summary, names, matrix = e.fit.summary, e.fit.covariance.names, e.fit.covariance.matrix
    shown = [n for n in CORRELATED if n in names and matrix[names.index(n), names.index(n)] > 0]
    views, rows = [], []
    if len(shown) > 1:
        index = [names.index(n) for n in shown]
        block = matrix[np.ix_(index, index)]
        sd = np.sqrt(np.diag(block))
        correlation = block / np.outer(sd, sd)
        rows = [
            [f"{name_in_words(shown[j])}; {name_in_words(shown[i])}", f"{correlation[i, j]:+.3f}"]
            for i in range(len(shown))
            for j in range(i)
            if abs(correlation[i, j]) > 0.8
        ]
        alt = "Correlation matrix; every cell holds its value in per cent"
        views.append(FigureView(figures.correlations(shown, correlation), alt, "Correlations of the posterior."))
    # Two directions of the same parameters may read alike.
    weak = dict.fromkeys(weak.text for weak in summary.weak_directions if not asks_for_looks(weak))
    items = [sentence_in_words(text) for text in (*weak, *(entry.text for entry in summary.leverage))]
    priors = table(
        "Results that depend on a prior: shift in sds, and factor on the sd",
        summary.prior_sensitivity[:PRIORS_SHOWN],
        {
            "prior": lambda x: f"{name_in_words(x.parameter)}: {'twice' if x.factor > 1 else 'half'} its u",
            "result": lambda x: name_in_words(x.quantity),
            "shift, sd": lambda x: f"{x.shift_sd:+.2f}",
            "sd, factor": lambda x: f"{x.sd_ratio:.2f}",
        },
    )
    text = [] if items else ["Every direction that matters is set by the data; no single stop decides a result."]
    tables = [present(TableView("Correlations beyond 0.8", ["parameters", "correlation"], rows)), present(priors)]
    return Section("What the data determine", text, items, tables, views)


def residuals_section(e: Evidence) -> Section:
    """Whether the deviations of the stops depend on a cause."""
    summary, causes, views = e.fit.summary, e.shown.residual_causes, []
    for axis in AXES:
        # A single group cannot be compared, and has no bar in the figure.
        if any(c.axis == axis and len(c.groups) > 1 for c in causes):
            alt = f"Mean deviation by group, {axis} axis; values in fit.json"
            views.append(FigureView(figures.causes(causes, axis), alt, f"{axis} axis: mean deviation by group."))
        views += stop_views(e.shown.residuals, axis)
    shown = table(
        "Do the deviations of the stops depend on ...",
        causes,
        {
            "cause": lambda c: f"{c.axis}: {c.name}",
            "groups": lambda c: str(len(c.groups)),
            "p": lambda c: "not tested" if c.p is None else f"{c.p:.3f}" if c.p >= LEAST_P else f"below {LEAST_P:g}",
            "verdict": lambda c: "SUSPICIOUS" if c.suspicious else "" if c.p is None else "no sign",
        },
    )
    text = (
        f"chi-square {summary.noise.chi2:.1f} for {summary.noise.dof:.1f} degrees of freedom; the pixel noise is "
        f"{summary.parameters['pixel_scale'].value:.2f} times the stated one."
    )
    return Section("Residuals by cause", [text], tables=[shown] if causes else [], figures=views)


def stop_views(stops: Sequence[StopResidual], axis: Axis) -> list[FigureView]:
    """Deviations of the stops of an axis; none without stops."""
    count = sum(stop.axis == axis for stop in stops)
    alt = f"Deviations of {count} stops of the {axis} axis over time and counter"
    caption = f"Stops of the {axis} axis: observed minus fitted angle."
    return [FigureView(figures.residuals(stops, axis), alt, caption)] if count else []


def validation_section(e: Evidence) -> Section:
    """Tests for model errors, diagnosis of the sampler, predictions of the classic and of left-out angles."""
    validation, sampling = e.fit.summary.validation, e.fit.summary.sampling
    tables: list[TableView | None] = []
    if validation is None:
        text = ["The results hold no tests for model errors: run the command fit again."]
    else:
        covered = validation.passed or validation.widens
        factor = f"Factor on every u: {validation.inflation:.2f}" if covered else "No factor on u covers what failed"
        text = [
            f"A clean campaign fails the tests below with a probability of {100 * validation.level:g} %, all "
            f"together. {factor}."
        ]
        columns = {
            "sign of": lambda t: t.name,
            "most at": lambda t: t.where,
            "chi-square": lambda t: f"{t.chi2:.1f}",
            "degrees of freedom": lambda t: str(t.dof),
            "p, all places": lambda t: f"{t.p:.2g}",
            "verdict": lambda t: "FAILED" if t.failed else "no sign",
        }
        tables.append(table("Tests for errors that the model does not have", validation.tests, columns))
    if sampling is None:
        text.append("The posterior was not sampled: intervals are those of the Laplace approximation.")
    else:
        checks = sampling_line(sampling), agreement_line(sampling, e.fit.summary.tier)
        text += [f"{line}." for line in checks if line is not None]
    tables.append(_predicted(e))
    if e.held_out is None:
        text.append(sentences("sections")["no_hold_out"])
    else:
        text.append(f"Held-out experiments: {e.held_out.verdict}: {e.held_out.reason}.")
        rows = [[d, f"{u:.1e}"] for d, u in e.held_out.unseen.items()]
        caption = "Not tested by a hold-out: u by stereo calibration and focal scale, common to all spots, deg/step"
        tables += [hold_out_table(e.held_out), TableView(caption, ["direction", "u"], rows)]
    return Section("Validation", text, labelled("not reached", () if sampling is None else sampling.missing), tables)


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
    return present(TableView(caption, ["direction", "predicted", "reported, type A", "difference / u"], rows))


def maps_section(e: Evidence) -> Section:
    """3D errors of each estimator, mm."""

    def cell(value: float) -> str:
        return "no point" if not np.isfinite(value) else two_digits(value) if value < 10 else f"{value:.0f}"

    pan, tilt = len(e.maps.pan_steps) // 2, len(e.maps.tilt_steps) // 2
    at_middle = {name: values[pan, tilt] for name, values in e.maps.rms_mm.items()}
    ranges = [f"{range_mm:g}" for range_mm in e.maps.range_mm]
    rows = [[text, *(cell(values[k]) for values in at_middle.values())] for k, text in enumerate(ranges)]
    view = FigureView(
        figures.error_maps(e.maps, e.maps.range_mm.tolist().index(e.range_mm)),
        f"Root mean square error over pan and tilt at {e.range_mm:g} mm; every cell holds its value in mm",
        f"3D error at {e.range_mm:g} mm, root mean square over the rigs that the data allow.",
    )
    middle = f"pan {e.maps.pan_steps[pan]:.0f}, tilt {e.maps.tilt_steps[tilt]:.0f} steps"
    errors = TableView(f"Root mean square 3D error in mm at {middle}, by range in mm", ["range", *e.maps.rms_mm], rows)
    text = [sentences("sections")["errors_3d"]]
    worse = np.flatnonzero(at_middle["joint"] >= at_middle["nominal"])
    if len(worse):
        largest = int(np.argmax(e.budget.share))
        text.append(
            f"At {', '.join(ranges[k] for k in worse)} mm the joint calibration places points no better than the "
            f"nominal one: {share_in_words(e.budget.causes[largest])} makes up {100 * e.budget.share[largest]:.0f} % "
            f"of its variance at {e.range_mm:g} mm."
        )
    return Section("Errors in 3D", text, tables=[errors], figures=[view])


def budgets_section(e: Evidence) -> Section:
    """Uncertainty budgets of results and of a point."""
    away, named = f"{e.range_mm:g} mm away", e.fit.summary.named
    totals = {each.quantity: _total(each) + _gap_note(each, named.get(each.quantity)) for each in e.shown.budgets}
    notes = list(dict.fromkeys(note for each in e.shown.budgets for note in each.notes))
    notes += labelled(f"a point {away}", [note for note in e.point.notes if note not in notes])
    tables = [
        *(_gum_table(some, "; ".join(totals[one.quantity] for one in some)) for some in _pairs(e.shown.budgets)),
        point_budget_table(e.budget, f"Budget of a point {away}, by cause"),
        _gum_table([e.point], f"{away}: {_total(e.point)}"),
    ]
    view = FigureView(
        figures.shares(e.budget),
        "Shares of the variance by cause; values at the bars and in the table above",
        f"What the uncertainty of a point {away} consists of.",
    )
    text = sentences("sections")["budgets"]
    return Section("Uncertainty budgets", text, [sentence(note) for note in notes], tables, [view])


def _pairs(tables: Sequence[BudgetTable]) -> list[list[BudgetTable]]:
    """Budgets grouped: both directions, or both axes, of one kind of result together; others alone."""
    kinds: dict[str, list[BudgetTable]] = {}
    for one in tables:
        kind, _, part = one.quantity.rpartition(".")
        axis = next((axis for axis, pair in SENSES.items() if part in pair), "")
        kinds.setdefault(f"{kind}.{axis}", []).append(one)
    return [some for group in kinds.values() for some in ([group] if len(group) == 2 else [[one] for one in group])]


def _source_text(row: BudgetRow) -> str:
    """The source of a row in words, with the unit of its u; standardised effects are in sds."""
    words = source_in_words(row.quantity)
    standardised = row.unit == "1" and row.quantity.removeprefix("prior of ") not in REGISTRY
    unit = "in sds" if standardised else row.unit.removesuffix("1")
    return words if row.u is None or not unit or words.endswith(f", {unit}") else f"{words}, {unit}"


def _gum_table(tables: Sequence[BudgetTable], caption: str) -> TableView:
    """Budgets side by side, with every important input of any of them; a single budget has all columns of GUM 7.2.7."""
    is_single = len(tables) == 1
    row_maps = [{row.quantity: row for row in one.rows} for one in tables]
    rows_by_name = {name: [rows[name] for rows in row_maps if name in rows] for rows in row_maps for name in rows}
    # The last row, of correlations, is not an input.
    inputs = [row for one in tables for row in one.rows[:-1]]
    names = list(dict.fromkeys(row.quantity for row in inputs if row.u is not None and row.share >= SMALLEST_SHARE))
    names.sort(key=lambda name: -max(row.share for row in rows_by_name[name]))
    rows = []
    for name in (*names, tables[0].rows[-1].quantity):
        first, stated_rows = rows_by_name[name][0], [row for row in rows_by_name[name] if row.u is not None]
        # Equal numbers appear once.
        cells = ["; ".join(dict.fromkeys(two_digits(row.u) for row in stated_rows if row.u is not None))]
        cells.append("; ".join(dict.fromkeys(degrees_of_freedom(row.dof) for row in stated_rows)))
        if is_single:
            cells = [first.distribution, *cells, optional(three_digits, first.sensitivity)]
        for of_source in row_maps:
            row = of_source.get(name)
            contribution = "" if row is None else optional(two_digits, row.contribution)
            cells += [contribution, "" if row is None else f"{100 * row.share:.1f}"]
        rows.append([_source_text(first), first.kind, *cells])
    columns = ["source", "type", *(["distribution", "u", "dof", "sensitivity"] if is_single else ["u", "dof"])]
    others = [cell for one in tables for cell in _others(one, names)]
    rows.insert(-1, [OTHERS, *[""] * (len(columns) - 1), *others])
    if is_single and any(row.share > 1 for each in rows_by_name.values() for row in each):
        # GUM 5.2.2: correlated inputs have cross terms.
        caption += "; the inputs are correlated: single shares exceed 100 %, the row of correlations compensates for it"
    suffixes = [""] if is_single else [f", {one.quantity.rpartition('.')[2]}" for one in tables]
    columns += [f"{word}{part}" for part in suffixes for word in ("contribution", "share %")]
    return TableView(caption, columns, rows)


def _others(budget: BudgetTable, named: Collection[str]) -> tuple[str, str]:
    """Contribution and share of all inputs without their own row; with them the shares sum to 100 %."""
    share = sum(row.share for row in budget.rows[:-1] if row.quantity not in named)
    return two_digits(budget.u * math.sqrt(share)), f"{100 * share:.1f}"


def _total(budget: BudgetTable) -> str:
    """The result of a budget with its expanded uncertainty (GUM 7.2.4)."""
    name, unit = name_in_words(budget.quantity).removesuffix(f", {budget.unit}"), budget.unit
    return (
        f"{name}: {concise(budget.estimate, budget.u)} {unit}, effective degrees of freedom "
        f"{degrees_of_freedom(budget.dof)}, k = {budget.coverage_factor:.2f}, p = {100 * budget.probability:.0f} %, "
        f"U = {two_digits(budget.expanded)} {unit}"
    )


def _gap_note(budget: BudgetTable, result: Estimate | None) -> str:
    """A note with the valid result where the interval of a budget differs; "" where both agree to their digits."""
    if result is None:
        return ""
    low, high = result.interval95
    half = 0.5 * (high - low)
    linear_low, linear_high = budget.estimate - budget.expanded, budget.estimate + budget.expanded
    parameter = REGISTRY.get(budget.quantity)
    never_below = parameter is not None and parameter.prior.distribution == "half-normal"
    note = ", which extends below 0, where no value is possible" * (never_below and linear_low < 0 <= low)
    rounding = 10.0 ** (math.floor(math.log10(half)) - 1) if half > 0 else 0.0
    shift = max(abs(linear_low - low), abs(linear_high - high))
    if not (note or abs(budget.expanded - half) > rounding or shift > END_SHIFT * half):
        return ""
    interval = f"{interval_text(low, high, result.sd)}, U = {two_digits(half)} {budget.unit}"
    return f"{note} (the first page, which applies: {interval})"


def axes_section(e: Evidence) -> Section:
    """Figures of both axes by ISO 230-2, predicted for standard test cycles."""
    axes = [axis for axis in e.shown.positioning if axis.predicted]
    if not axes:
        return Section(ISO_STYLE, ["Not computed: the fit has not converged."])
    # Notes on the campaign's own stops belong to other figures; fit.json has both.
    items = list(dict.fromkeys(note for axis in axes for note in axis.notes if "plug-in" not in note))
    rows = []
    for name, (symbol, term) in FIGURES.items():
        predictions = [(axis.predicted or {}).get(name) for axis in axes]
        if any(figure is not None for figure in predictions):
            # The standard's up and down are directions of approach, not those of the tilt axis.
            term = term.replace(", up", ", counters growing").replace(", down", ", counters falling")
            symbol = symbol.replace(" up", "\u2191").replace(" down", "\u2193")
            rows.append([f"{term} {symbol}", *(cell for figure in predictions for cell in _figure_cells(figure))])
    columns = ["figure", *(cell for axis in axes for cell in (f"{axis.axis}, median", f"{axis.axis}, 95 % interval"))]
    caption = f"deg, predicted for {axes[0].runs} runs per side at {len(axes[0].target_steps)} targets"
    return Section(ISO_STYLE, items=items, tables=[TableView(caption, columns, rows)])


def _figure_cells(figure: Predicted | None) -> tuple[str, str]:
    """Median and interval to the digits of the interval's uncertainty; empty if there is no figure."""
    if figure is None:
        return "", ""
    low, high = figure.interval95
    sd = (high - low) / (2 * NORMAL_95)
    return to_digits(figure.median, sd), interval_text(low, high, sd)


def plan_section(e: Evidence) -> Section:
    """Gain of further experiments."""
    title, plan = "What to measure next", e.planned
    if plan is None:
        return Section(title, [sentences("sections")["no_plan"]])
    unit, stop = plan.target.unit, plan.stop
    text = [
        f"Wanted: {plan.target.text}; known now to {plan.now:.2g} {unit}. "
        f"{'Stop measuring' if stop.now else 'Go on measuring'}: {stop.reason}. Rule: {stop.rule}.",
        *([plan.limited_by.needed] if plan.limited_by.needed else []),
    ]
    looks = table(
        "Next looks, best first",
        plan.next,
        {
            "four looks": lambda batch: batch.text,
            "minutes": lambda batch: f"{batch.minutes:.1f}",
            f"gain, {unit}": lambda batch: f"{batch.gain:.2g}",
            f"gain a minute, {unit}": lambda batch: f"{batch.gain_per_minute:.2g}",
        },
    )
    return Section(title, text, tables=[looks] if plan.next else [])


def method_section(e: Evidence) -> Section:
    """Method, inputs and versions of the results."""
    origin = e.fit.provenance
    text = [
        sentences("sections")["method"],
        f"Estimator: {made_by(e.fit.summary.tier or e.fit.summary.estimator)}. Intervals are equal-tailed "
        "(JCGM 101:2008, 5.3.3), coverage probability 95 %.",
        f"Command: {origin.command}. Seed {origin.seed}.",
    ]
    declared = header_table(e.campaign, "traceability")
    rows = [
        *(["traceability", *stated_text(e.campaign, "traceability", key)] for key in declared),
        *(["sha256", name, value] for name, value in origin.inputs.items()),
        ["versions", "", ", ".join(f"{name} {value}" for name, value in origin.shown_versions.items())],
    ]
    shown = TableView("Traceability as declared, inputs, versions", ["", "name", "value"], rows)
    return Section("Method, traceability, provenance", text, tables=[shown])

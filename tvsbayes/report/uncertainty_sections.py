"""Sections of the page on uncertainty: errors in 3D, budgets, ISO 230-2-style figures, plan, method, limits.

mm in frame T, deg for figures of an axis; budgets name their unit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.display import concise
from tvsbayes.instrument.axes import SENSES
from tvsbayes.instrument.parameters import parameter_of
from tvsbayes.metrology.traceability import header_table, stated_text
from tvsbayes.report import figures
from tvsbayes.report.document import FigureView, Section, sentence
from tvsbayes.report.drawing import SMALLEST_SHARE
from tvsbayes.report.parameter_words import made_by, name_in_words, share_in_words, source_in_words
from tvsbayes.report.result_tables import point_budget_table
from tvsbayes.report.tables import TableView, interval_text, three_digits, two_digits
from tvsbayes.results.metrology_tables import FIGURES, BudgetRow, BudgetTable, Predicted
from tvsbayes.statistics.intervals import NORMAL_95

if TYPE_CHECKING:
    from tvsbayes.report.evidence import Evidence
    from tvsbayes.results.estimates import Estimate

OTHERS = f"others, each below {100 * SMALLEST_SHARE:g} %"
"""Row of all inputs of a budget without their own row."""
END_SHIFT = 0.1
"""Least difference of an end of the linear interval for a note, over U; a quantile of 1000 draws scatters by half."""


def uncertainty_sections(e: Evidence) -> list[Section]:
    """The sections in the order of the page."""
    parts = (maps_section, budgets_section, axes_section, plan_section, method_section, limits_section)
    return [part(e) for part in parts]


def maps_section(e: Evidence) -> Section:
    """3D errors of each estimator, mm."""
    pan, tilt = len(e.maps.pan_steps) // 2, len(e.maps.tilt_steps) // 2
    at_middle = {name: values[pan, tilt] for name, values in e.maps.rms_mm.items()}
    rows, views = [], []
    for k, range_mm in enumerate(e.maps.range_mm):
        rows.append([f"{range_mm:g}", *(_cell(values[k]) for values in at_middle.values())])
        if range_mm == e.range_mm:
            views.append(
                FigureView(
                    figures.error_maps(e.maps, k),
                    f"Root mean square error over pan and tilt at {range_mm:g} mm; every cell holds its value in mm",
                    f"3D error at {range_mm:g} mm, root mean square over the rigs that the data allow.",
                )
            )
    middle = f"pan {e.maps.pan_steps[pan]:.0f}, tilt {e.maps.tilt_steps[tilt]:.0f} steps"
    table = TableView(f"Root mean square 3D error in mm at {middle}, by range in mm", ["range", *e.maps.rms_mm], rows)
    text = [
        "Nominal and classic users are given a baseline shortened by the mirror offset and moved by half of it; noise "
        "of one look is included for all."
    ]
    worse = np.flatnonzero(at_middle["joint"] >= at_middle["nominal"])
    if len(worse):
        text.append(_no_better(e, [f"{e.maps.range_mm[k]:g}" for k in worse]))
    return Section("Errors in 3D", text, tables=[table], figures=views)


def _no_better(e: Evidence, ranges_mm: Sequence[str]) -> str:
    """Why a calibration may locate points no better than the nominal rig."""
    text = f"At {', '.join(ranges_mm)} mm the joint calibration places points no better than the nominal one"
    largest = int(np.argmax(e.budget.share))
    text += (
        f": {share_in_words(e.budget.causes[largest])} makes up {100 * e.budget.share[largest]:.0f} % of its variance"
    )
    text += f" at {e.range_mm:g} mm"
    return f"{text}."


def _cell(value: float) -> str:
    return "no point" if not np.isfinite(value) else two_digits(value) if value < 10 else f"{value:.0f}"


def budgets_section(e: Evidence) -> Section:
    """Uncertainty budgets of results and of a point."""
    summary, distance_text = e.fit.summary, f"{e.range_mm:g} mm away"
    totals = {
        table.quantity: _total(table) + _gap_note(table, summary.named.get(table.quantity)) for table in e.shown.budgets
    }
    tables = [_gum_table(some, "; ".join(totals[one.quantity] for one in some)) for some in _pairs(e.shown.budgets)]
    tables += [
        point_budget_table(e.budget, f"Budget of a point {distance_text}, by cause"),
        _gum_table([e.point], f"{distance_text}: {_total(e.point)}"),
    ]
    view = FigureView(
        figures.shares(e.budget),
        "Shares of the variance by cause; values at the bars and in the table above",
        f"What the uncertainty of a point {e.range_mm:g} mm away consists of.",
    )
    text = [
        "The rows of a budget are the linear propagation of JCGM 100:2008, clause 5, at the mode: they show where "
        "uncertainty comes from. The results and their coverage intervals are those of the first page; k and U of a "
        "budget take the distribution for a symmetric one.",
        "Sensitivities are contributions over u. fit.json holds every row, with distribution and sensitivity.",
    ]
    return Section("Uncertainty budgets", text, _notes(e), tables, [view])


def _notes(e: Evidence) -> list[str]:
    """Notes on the budgets, without repetition."""
    notes = list(dict.fromkeys(note for table in e.shown.budgets for note in table.notes))
    notes += [f"a point {e.range_mm:g} mm away: {note}" for note in e.point.notes if note not in notes]
    return [sentence(note) for note in notes]


def _pairs(tables: Sequence[BudgetTable]) -> list[list[BudgetTable]]:
    """Budgets grouped: both directions, or both axes, of one kind of result together; others alone."""
    kinds: dict[str, list[BudgetTable]] = {}
    for table in tables:
        kind, _, part = table.quantity.rpartition(".")
        axis = next((axis for axis, pair in SENSES.items() if part in pair), "")
        kinds.setdefault(f"{kind}.{axis}", []).append(table)
    return [some for group in kinds.values() for some in ([group] if len(group) == 2 else [[one] for one in group])]


def _important_rows(table: BudgetTable) -> list[BudgetRow]:
    """Single inputs with their own row; the last row, of correlations, is not an input."""
    return [row for row in table.rows[:-1] if row.u is not None and row.share >= SMALLEST_SHARE]


def _source_text(row: BudgetRow) -> str:
    """The source of a row in words, with the unit of its u; standardised effects are in sds."""
    words = source_in_words(row.quantity)
    standardised = row.unit == "1" and parameter_of(row.quantity.removeprefix("prior of ")) is None
    unit = "in sds" if standardised else row.unit.removesuffix("1")
    return words if row.u is None or not unit or words.endswith(f", {unit}") else f"{words}, {unit}"


def _others(table: BudgetTable, named: Collection[str]) -> tuple[str, str]:
    """Contribution and share of all inputs without their own row; with them the shares sum to 100 %."""
    share = sum(row.share for row in table.rows[:-1] if row.quantity not in named)
    return two_digits(table.u * math.sqrt(share)), f"{100 * share:.1f}"


def _gum_table(tables: Sequence[BudgetTable], caption: str) -> TableView:
    """Budgets side by side, with every important input of any of them; a single budget has all columns of GUM 7.2.7."""
    is_single = len(tables) == 1
    row_maps = [{row.quantity: row for row in table.rows} for table in tables]
    rows_by_name = {name: [rows[name] for rows in row_maps if name in rows] for rows in row_maps for name in rows}
    names = list(dict.fromkeys(row.quantity for table in tables for row in _important_rows(table)))
    names.sort(key=lambda name: -max(row.share for row in rows_by_name[name]))
    rows = []
    for name in (*names, tables[0].rows[-1].quantity):
        first, stated_rows = rows_by_name[name][0], [row for row in rows_by_name[name] if row.u is not None]
        # Equal numbers appear once.
        cells = ["; ".join(dict.fromkeys(two_digits(row.u) for row in stated_rows if row.u is not None))]
        cells.append("; ".join(dict.fromkeys(_freedom(row.dof) for row in stated_rows)))
        if is_single:
            cells = [first.distribution, *cells, "" if first.sensitivity is None else three_digits(first.sensitivity)]
        contributions = [cell for of_source in row_maps for cell in _contribution_cells(of_source.get(name))]
        rows.append([_source_text(first), first.kind, *cells, *contributions])
    columns = ["source", "type", *(["distribution", "u", "dof", "sensitivity"] if is_single else ["u", "dof"])]
    rows.insert(-1, [OTHERS, *[""] * (len(columns) - 1), *(c for table in tables for c in _others(table, names))])
    if is_single and any(row.share > 1 for each in rows_by_name.values() for row in each):
        # GUM 5.2.2: correlated inputs have cross terms.
        caption += "; the inputs are correlated: single shares exceed 100 %, the row of correlations compensates for it"
    suffixes = [""] if is_single else [f", {table.quantity.rpartition('.')[2]}" for table in tables]
    columns += [f"{word}{part}" for part in suffixes for word in ("contribution", "share %")]
    return TableView(caption, columns, rows)


def _contribution_cells(row: BudgetRow | None) -> tuple[str, str]:
    """Contribution and share; empty where the input is not in the budget."""
    if row is None:
        return "", ""
    return "" if row.contribution is None else two_digits(row.contribution), f"{100 * row.share:.1f}"


def _total(table: BudgetTable) -> str:
    """The result of a budget with its expanded uncertainty (GUM 7.2.4)."""
    name = name_in_words(table.quantity).removesuffix(f", {table.unit}")
    return (
        f"{name}: {concise(table.estimate, table.u)} {table.unit}, effective degrees of freedom "
        f"{_freedom(table.dof)}, k = {table.coverage_factor:.2f}, p = {100 * table.probability:.0f} %, "
        f"U = {two_digits(table.expanded)} {table.unit}"
    )


def _gap_note(table: BudgetTable, result: Estimate | None) -> str:
    """A note with the valid result where the interval of a budget differs; "" where both agree to their digits."""
    if result is None:
        return ""
    low, high = result.interval95
    half = 0.5 * (high - low)
    linear_ends = table.estimate - table.expanded, table.estimate + table.expanded
    parameter = parameter_of(table.quantity)
    never_below = parameter is not None and parameter.prior.distribution == "half-normal"
    note = ", which extends below 0, where no value is possible" * (never_below and linear_ends[0] < 0 <= low)
    rounding = 10.0 ** (math.floor(math.log10(half)) - 1) if half > 0 else 0.0
    shift = max(abs(linear_ends[0] - low), abs(linear_ends[1] - high))
    if note or abs(table.expanded - half) > rounding or shift > END_SHIFT * half:
        note += f" (the first page, which applies: {interval_text(low, high, result.sd)}, U = {two_digits(half)} "
        note += f"{table.unit})"
    return note


def _freedom(dof: float | None) -> str:
    return "infinite" if dof is None else f"{dof:.0f}"


def axes_section(e: Evidence) -> Section:
    """Figures of both axes by ISO 230-2, predicted for standard test cycles."""
    axes = [axis for axis in e.shown.positioning if axis.predicted]
    if not axes:
        return Section("ISO 230-2-style figures", ["Not computed: the fit has not converged."])
    items: list[str] = []
    for axis in axes:
        # Notes on the campaign's own stops belong to other figures; fit.json has both.
        items += [note for note in axis.notes if note not in items and "plug-in" not in note]
    rows = []
    for name, (symbol, term) in FIGURES.items():
        predictions = [(axis.predicted or {}).get(name) for axis in axes]
        if any(figure is not None for figure in predictions):
            cells = [cell for figure in predictions for cell in _figure_cells(figure)]
            rows.append([f"{_in_counters(term)} {_arrow(symbol)}", *cells])
    columns = ["figure", *(cell for axis in axes for cell in (f"{axis.axis}, median", f"{axis.axis}, 95 % interval"))]
    first = axes[0]
    caption = f"deg, predicted for {first.runs} runs per side at {len(first.target_steps)} targets"
    return Section("ISO 230-2-style figures", items=items, tables=[TableView(caption, columns, rows)])


def _figure_cells(figure: Predicted | None) -> tuple[str, str]:
    """Median and interval to the digits of the interval's uncertainty; empty if there is no figure."""
    if figure is None:
        return "", ""
    low, high = figure.interval95
    sd = (high - low) / (2 * NORMAL_95)
    return concise(figure.median, sd).partition("(")[0], interval_text(low, high, sd)


def _in_counters(term: str) -> str:
    """The standard's up and down are directions of approach, not those of the tilt axis."""
    return term.replace(", up", ", counters growing").replace(", down", ", counters falling")


def _arrow(symbol: str) -> str:
    return symbol.replace(" up", "\u2191").replace(" down", "\u2193")


def plan_section(e: Evidence) -> Section:
    """Gain of further experiments."""
    plan = e.planned
    if plan is None:
        text = [
            "tvsbayes plan RIG --given CAMPAIGN weighs further experiments; a report made after it shows them here."
        ]
        return Section("What to measure next", text)
    unit, stop = plan.target.unit, plan.stop
    text = [
        f"Wanted: {plan.target.text}; known now to {plan.now:.2g} {unit}. "
        f"{'Stop measuring' if stop.now else 'Go on measuring'}: {stop.reason}. Rule: {stop.rule}."
    ]
    if plan.limited_by.needed:
        text.append(plan.limited_by.needed)
    rows = [
        [batch.text, f"{batch.minutes:.1f}", f"{batch.gain:.2g}", f"{batch.gain_per_minute:.2g}"] for batch in plan.next
    ]
    columns = ["four looks", "minutes", f"gain, {unit}", f"gain a minute, {unit}"]
    tables = [TableView("Next looks, best first", columns, rows)] if rows else []
    return Section("What to measure next", text, tables=tables)


def method_section(e: Evidence) -> Section:
    """Method, inputs and versions of the results."""
    origin = e.fit.provenance
    text = [
        "Joint model: two-mirror positioner with per-direction ratios, backlash, mirror offset and misalignments, seen "
        "by a calibrated stereo pair; all spots at once; stop errors integrated out; stereo calibration and focal "
        "scale uncertain within their stated covariance. Classic: the four-point method of "
        "doi 10.3390/metrology5040058.",
        f"Estimator: {made_by(e.fit.summary.tier or e.fit.summary.estimator)}. Intervals are equal-tailed "
        "(JCGM 101:2008, 5.3.3), coverage probability 95 %.",
        f"Command: {origin.command}. Seed {origin.seed}.",
    ]
    rows = [
        ["traceability", *stated_text(e.campaign, "traceability", key)]
        for key in header_table(e.campaign, "traceability")
    ]
    rows += [["sha256", name, value] for name, value in origin.inputs.items()]
    rows.append(["versions", "", ", ".join(f"{name} {value}" for name, value in origin.shown_versions.items())])
    table = TableView("Traceability as declared, inputs, versions", ["", "name", "value"], rows)
    return Section("Method, traceability, provenance", text, tables=[table])


def limits_section(e: Evidence) -> Section:
    """Limitations of the results."""
    items = [
        "The scale of all angles is that of the stereo calibration; an error of its board or of the focal length at "
        "the laser's wavelength beyond the stated uncertainty is in no residual.",
        "Baseline, emission angle at pan 0 (C0) and the aperture's zero have no effect on spots: without aperture "
        "readings they are the user's statement.",
        "Results hold for the range of counters and depths that was seen, at the temperature of the campaign, moving "
        "slowly enough to lose no step.",
        "Angles are inferred through cameras and model; no angle standard was compared.",
    ]
    return Section("Limitations", items=items)

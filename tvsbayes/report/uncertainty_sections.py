"""Sections of the page on uncertainty: errors in 3D, budgets, ISO 230-2-style figures, plan, method, limits.

mm in frame T, deg for figures of an axis; budgets name their unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.metrology.traceability import header_table
from tvsbayes.report import figures
from tvsbayes.report.result_tables import SHARE_SHOWN, point_budget_table
from tvsbayes.report.tables import Section, TableView, concise, figure_view, two_digits
from tvsbayes.results.metrology_tables import FIGURES, AxisPositioning, BudgetTable

if TYPE_CHECKING:
    from tvsbayes.report.evidence import Evidence


MADE_BY = {
    "laplace": "Laplace approximation at the mode",
    "importance": "posterior by importance sampling",
    **dict.fromkeys(("emcee", "posterior"), "posterior sampled by emcee"),
}
"""By tier, or by estimator where results name no tier."""


def maps_section(e: Evidence) -> Section:
    """Where which estimator errs by how many millimetres."""
    pan, tilt = len(e.maps.pan_steps) // 2, len(e.maps.tilt_steps) // 2
    at_middle = {name: values[pan, tilt] for name, values in e.maps.rms_mm.items()}
    rows, views = [], []
    for k, reach in enumerate(e.maps.range_mm):
        rows.append([f"{reach:g}", *(_cell(values[k]) for values in at_middle.values())])
        views.append(
            figure_view(
                figures.error_maps(e.maps, k),
                f"Root mean square error over pan and tilt at {reach:g} mm; every cell holds its value in mm",
                f"3D error at {reach:g} mm, root mean square over the rigs that the data allow.",
            )
        )
    at = f"pan {e.maps.pan_steps[pan]:.0f}, tilt {e.maps.tilt_steps[tilt]:.0f} steps"
    table = TableView(f"Root mean square 3D error in mm at {at}, by range in mm", ["range", *e.maps.rms_mm], rows)
    text = [
        "Nominal and classic users are given a baseline shortened by the mirror offset and moved by half of it; noise "
        "of one look is included for all."
    ]
    worse = np.flatnonzero(at_middle["joint"] >= at_middle["nominal"])
    if len(worse):
        text.append(_no_better(e, [f"{e.maps.range_mm[k]:g}" for k in worse]))
    return Section("Errors in 3D", text, tables=[table], figures=views)


def _no_better(e: Evidence, ranges_mm: Sequence[str]) -> str:
    """Why a calibration may place points no better than the nominal rig: what the campaign could not tell."""
    text = f"At {', '.join(ranges_mm)} mm the joint calibration places points no better than the nominal one"
    largest = int(np.argmax(e.budget.share))
    text += f": {e.budget.causes[largest]} makes up {100 * e.budget.share[largest]:.0f} % of its variance"
    text += f" at {e.range_mm:g} mm"
    if not any(spot.aperture_deg is not None for spot in e.campaign.spots):
        text += "; the campaign has no aperture readings, which tell the range of a point"
    return f"{text}."


def _cell(value: float) -> str:
    return "no point" if not np.isfinite(value) else two_digits(value) if value < 10 else f"{value:.0f}"


def budgets_section(e: Evidence) -> Section:
    """What the uncertainty of headlines and of a point consists of."""
    tables = [
        *(_gum_table(table) for table in e.shown.budgets),
        point_budget_table(e.budget, f"Budget of a point {e.range_mm:g} mm away, by cause"),
        _gum_table(e.point, f"{e.range_mm:g} mm away: "),
    ]
    view = figure_view(
        figures.shares(e.budget),
        "Shares of the variance by cause; values at the bars and in the table above",
        f"What the uncertainty of a point {e.range_mm:g} mm away consists of.",
    )
    return Section("Uncertainty budgets", tables=tables, figures=[view])


def _gum_table(table: BudgetTable, prefix: str = "") -> TableView:
    """A budget as GUM 7.2.7 asks for it; sources that matter to no digit are counted in one line."""
    shown = [row for row in table.rows if row.u is None or abs(row.share) >= SHARE_SHOWN]
    rows = [
        [
            row.quantity,
            row.kind,
            row.distribution,
            "" if row.u is None else two_digits(row.u),
            "" if row.u is None else _freedom(row.dof),
            "" if row.sensitivity is None else f"{row.sensitivity:.3g}",
            "" if row.contribution is None else two_digits(row.contribution),
            f"{100 * row.share:.1f}",
        ]
        for row in shown
    ]
    if len(shown) < len(table.rows):
        rest = [row.share for row in table.rows if row not in shown]
        rows.insert(-1, [f"{len(rest)} smaller ones", "", "", "", "", "", "", f"{100 * sum(rest):.1f}"])
    caption = (
        f"{prefix}{table.quantity}: {concise(table.estimate, table.u)} {table.unit}; effective degrees of "
        f"freedom {_freedom(table.dof)}, k = {table.coverage_factor:.2f}, "
        f"p = {100 * table.probability:.0f} %, U = {two_digits(table.expanded)} {table.unit}"
    )
    if any(row.share > 1 for row in shown):
        # GUM 5.2.2: with correlated inputs the cross terms are as real as the squares.
        caption += "; the inputs are correlated: single shares exceed 100 %, the row of correlations takes them back"
    columns = ["source", "type", "distribution", "u", "dof", "sensitivity", "contribution", "share %"]
    return TableView(caption, columns, rows)


def _freedom(dof: float | None) -> str:
    return "infinite" if dof is None or np.isinf(dof) else f"{dof:.0f}"


def axes_section(e: Evidence) -> Section:
    """Figures of both axes as ISO 230-2 defines them."""
    tables = [_axis_table(axis) for axis in e.shown.positioning if axis.predicted]
    items = []
    for axis in e.shown.positioning:
        if axis.missing:
            items.append(f"{axis.axis}, own stops: {axis.missing}")
        items += [note for note in axis.notes if note not in items]
    text = [] if tables or items else ["Not computed: the fit has not converged."]
    return Section("ISO 230-2-style figures", text, items, tables)


def _axis_table(axis: AxisPositioning) -> TableView:
    rows = [
        [
            " ".join(reversed(FIGURES[name])),
            f"{p.median:.4f}",
            f"[{p.interval95[0]:.4f}, {p.interval95[1]:.4f}]",
            "" if axis.plug_in is None else f"{getattr(axis.plug_in, name):.4f}",
        ]
        for name, p in (axis.predicted or {}).items()
    ]
    caption = (
        f"{axis.axis} axis, deg: predicted for {axis.runs} runs per side at {len(axis.target_steps)} "
        "targets, and as the campaign's own stops have it"
    )
    return TableView(caption, ["figure", "median", "95 % interval", "own stops"], rows)


def plan_section(e: Evidence) -> Section:
    """What further experiments would bring."""
    items, plan = [weak.text for weak in e.fit.summary.weak_directions], e.planned
    if plan is None:
        text = [
            "tvsbayes plan RIG --given CAMPAIGN weighs further experiments; a report made after it shows them here."
        ]
        return Section("What to measure next", text, items)
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
    tables = [TableView("Next experiments, best first", columns, rows)] if rows else []
    return Section("What to measure next", text, items, tables=tables)


def method_section(e: Evidence) -> Section:
    """How it was computed, from what and by what."""
    made = e.fit.provenance
    text = [
        "Joint model: two-mirror positioner with per-direction ratios, backlash, mirror offset and misalignments, seen "
        "by a calibrated stereo pair; all spots at once; stop errors integrated out; stereo calibration and focal "
        "scale uncertain within their stated covariance. Classic: the four-point method of "
        "doi 10.3390/metrology5040058.",
        f"Estimator: {MADE_BY[e.fit.summary.tier or e.fit.summary.estimator]}. Intervals are equal-tailed "
        "(JCGM 101:2008, 5.3.3), coverage probability 95 %.",
        f"Command: {made.command}. Seed {made.seed}.",
    ]
    rows = [["traceability", k, str(v)] for k, v in header_table(e.campaign, "traceability").items()]
    rows += [["sha256", name, value] for name, value in made.inputs.items()]
    rows += [["version", name, value] for name, value in made.versions.items()]
    table = TableView("Traceability as declared, inputs, versions", ["", "name", "value"], rows)
    return Section("Method, traceability, provenance", text, tables=[table])


def limits_section(e: Evidence) -> Section:
    """What no number above can tell."""
    items = [
        "The scale of all angles is that of the stereo calibration; an error of its board or of the focal length at "
        "the laser's wavelength beyond the stated uncertainty is in no residual.",
        "Baseline, C0 and aperture zero cannot be seen in spots: without aperture readings they are the user's "
        "statement.",
        "Results hold for the range of counters and depths that was seen, at the temperature of the campaign, moving "
        "slowly enough to lose no step.",
        "Angles are inferred through cameras and model; no angle standard was compared.",
    ]
    return Section("Limitations", items=items)

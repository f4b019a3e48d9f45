"""Results of an axis: tables, texts of commands, figures, the document of its page.

Commands and values in the axis' own units; texts of a campaign are `escaped`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.compensation.periodic_error import LIKELY as TABLE_LIKELY
from tvsbayes.compensation.verification import compensation_in
from tvsbayes.display import concise
from tvsbayes.errors import NothingToEstimate, escaped, plural, typed
from tvsbayes.inference.diagnosis import AGREEMENT_LIMIT
from tvsbayes.instrument.campaign import title_of
from tvsbayes.metrology.conformity import Criterion, Tolerance
from tvsbayes.metrology.traceability import performed
from tvsbayes.report.compensation_text import compensation_section
from tvsbayes.report.document import (
    Document,
    FigureView,
    Issue,
    Number,
    Part,
    Section,
    Verdict,
    about_table,
    labelled,
    sentence,
    terminal,
)
from tvsbayes.report.drawing import BLACK, DIRECTION_STYLE, banded, drawing, legend
from tvsbayes.report.evidence import COLOUR, criteria_table, criterion_text
from tvsbayes.report.fit_text import ROUGH, UNSAMPLED
from tvsbayes.report.page import digest_number, numbered
from tvsbayes.report.result_tables import waves_table
from tvsbayes.report.tables import (
    TableView,
    degrees_of_freedom,
    interval_text,
    optional,
    percent,
    sentences,
    table,
    three_digits,
    three_digits_fixed,
    to_digits,
    two_digits,
)
from tvsbayes.results.comparison_record import AxisHoldOut
from tvsbayes.results.compensation_record import stored_verification
from tvsbayes.results.estimates import Estimate, PeriodEstimate
from tvsbayes.results.fit_record import provenance
from tvsbayes.results.metrology_tables import BudgetTable
from tvsbayes.results.tiers import IMPORTANCE
from tvsbayes.single_axis.axis_campaign import axis_hashes
from tvsbayes.single_axis.axis_certificate import axis_traceability
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_parameters import AXIS_QUANTITIES
from tvsbayes.single_axis.axis_periods import WaveSample, wave_samples
from tvsbayes.single_axis.axis_record import AxisResults, AxisSummary, PositionDeviation, deviation_strata
from tvsbayes.single_axis.classic_line import AXIS_SYMBOLS, AXIS_TERMS, ClassicAxis, PositionRuns, target_runs
from tvsbayes.single_axis.next_stops import AxisPlan, unit_of
from tvsbayes.statistics.intervals import band95

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DEVIATIONS_SHOWN = 40
TABLE_ROWS = 60
"""Largest numbers of positions on a terminal, and on the page."""
LIKELY = 0.5
"""Least probability of a wave for a figure."""
CURVE_POINTS = 81
"""Number of points of the curves of an axis' error and waves."""
HELPLESS_SHARE = 0.95
"""Largest useful remaining share of an uncertainty after further stops."""
MORE_HELPS = "many more stops (--minutes) help, or readings of smaller u"
HELPS = {
    "per_command": "a longer travel helps: errors by position then have less effect; the line over the commands "
    "read is known better: --target effective_per_command"
}
"""Alternatives by target where further stops hardly help."""
STOPS_ALONE = ("backlash", "ratio_contrast", "offset")
"""Parameters that a drive at constant rate does not show: it has one direction and no zero of its own."""
BUDGET_WORDS = {
    "effective_per_command": "line through the positions read, mean of both directions",
    "effective_backlash": "mean play over the positions read",
}
"""Results of an axis, by the name of their budget."""
NO_FIGURE = "\u2013"


def is_drive(summary: AxisSummary) -> bool:
    """Whether the readings are of a drive at constant rate."""
    return "seeing_s" in summary.parameters


def _contains_zero(interval95: tuple[float, float]) -> bool:
    return interval95[0] <= 0 <= interval95[1]


def period_table(summary: AxisSummary) -> TableView | None:
    """Every wave with amplitude and period, given that it exists; None where the model has none."""
    unit = escaped(summary.unit)
    gear_unit = "s" if summary.periods_in == "seconds" else unit
    waves = [("gear", wave, gear_unit) for wave in summary.periods]
    return waves_table(
        [*waves, *(("encoder", wave, unit) for wave in summary.encoder_periods)], unit, "position or time"
    )


def _cells(estimate: Estimate) -> list[str]:
    low, high = estimate.interval95
    return [concise(estimate.value, estimate.sd), interval_text(low, high, estimate.sd)]


def ratio_table(summary: AxisSummary) -> TableView:
    """Unit per command by direction: of the gears, of the line through the readings, and from the classic estimate."""
    low, high = summary.range_command
    sides = ("forward",) if is_drive(summary) else tuple(summary.per_command)
    kinds = {"gears": summary.per_command, f"line from {low:.10g} to {high:.10g}": summary.effective_per_command}
    rows = [
        [f"{label}, {side}" if len(sides) > 1 else label, *_cells(estimates[side])]
        for label, estimates in kinds.items()
        for side in sides
    ]
    classic = summary.classic
    rows.append(["classic: least-squares line", concise(classic.per_command, classic.u_per_command or 0.0), ""])
    return TableView(f"{escaped(summary.unit)} per command, value(u)", ["", "value(u)", "95 % interval"], rows)


def parameter_table(summary: AxisSummary) -> TableView:
    """All parameters but the ratio."""
    rows, labels = [], {name: quantity.label for name, quantity in AXIS_QUANTITIES.items()}
    left_out = {"per_command", *(STOPS_ALONE if is_drive(summary) else ())}
    for name, estimate in summary.parameters.items():
        if name not in left_out:
            share = optional(lambda x: f"{100 * max(x, 0.0):.0f} %", estimate.contraction)
            rows.append([labels.get(name, name), *_cells(estimate), share])
        if name == "backlash" and summary.effective_backlash is not None:
            rows.append(["its mean over the positions read", *_cells(summary.effective_backlash), ""])
    caption = f"parameters, {escaped(summary.unit)}; 100 %: set by the readings, 0 %: set by the prior"
    return TableView(caption, ["", "value(u)", "95 % interval", "data"], rows)


def deviation_table(deviations: Sequence[PositionDeviation], unit: str, limit: int) -> TableView:
    """Errors that repeat by position, minus the line; at most `limit` positions, evenly spread."""
    caption, count = f"error that repeats by position, off the line through the stops, {escaped(unit)}", len(deviations)
    if count > limit:
        caption += f"; {limit} of {count} positions, fit.json has all"
        deviations = [deviations[round(k * (count - 1) / (limit - 1))] for k in range(limit)]
    columns = {
        "command": lambda d: f"{d.position:.10g}",
        "value(u)": lambda d: concise(d.value, d.sd),
        "95 % interval": lambda d: interval_text(d.interval95[0], d.interval95[1], d.sd),
    }
    return table(caption, deviations, columns)


def iso230_table(classic: ClassicAxis, unit: str) -> TableView | None:
    """The figures by letter, against the targets and about the line; None where the readings give none."""
    columns = {"actual less target": classic.iso230, "about the line": classic.iso230_about_line}
    shown = {title: f for title, f in columns.items() if f is not None and any(v is not None for v in f.values())}
    rows = [
        [f"{symbol}, {AXIS_TERMS[name]}"]
        + [optional(three_digits_fixed, figures[name], NO_FIGURE) for figures in shown.values()]
        for name, symbol in classic.symbols.items()
    ]
    return TableView(f"ISO 230-2, {escaped(unit)}", ["", *shown], rows) if shown else None


def targets_table(classic: ClassicAxis, unit: str) -> TableView | None:
    """Mean and s by position and side; None without targets."""
    rows = classic.iso230_targets
    if not rows:
        return None
    names = ("mean_forward", "s_forward", "mean_backward", "s_backward", "reversal")
    sizes = {name: [abs(v) for row in rows if (v := getattr(row, name)) is not None] for name in names}
    spread = max((size for of_name in sizes.values() for size in of_name), default=0.0)
    # One number of decimals: three digits of the largest number, at least two of the smallest s.
    smallest = min((s for name in names[1:4:2] for s in sizes[name] if s), default=spread)
    decimals = max(0, 2 - int(f"{min(spread, 30 * smallest) or 1.0:.0e}".split("e")[1]))
    cells = [
        [f"{row.position:.10g}"]
        + [optional(lambda v: f"{v:.{decimals}f}", getattr(row, name), NO_FIGURE) for name in names]
        + [f"{row.runs_forward}, {row.runs_backward}"]
        for row in rows
    ]
    caption = f"actual less target, {escaped(unit)}"
    if len(cells) > TABLE_ROWS:
        caption += f"; {TABLE_ROWS} of {len(cells)} positions, fit.json has all"
        cells = [cells[k] for k in np.linspace(0, len(cells) - 1, TABLE_ROWS).astype(int)]
    columns = ["target", "mean, forward", "s, forward", "mean, backward", "s, backward", "B", "runs"]
    return TableView(caption, columns, cells)


def budget_view(budget: BudgetTable) -> TableView:
    """A budget with its columns by GUM 7.2.7; its caption has the result."""
    caption = (
        f"{BUDGET_WORDS.get(budget.quantity, budget.quantity)}: {budget.estimate:.10g} {escaped(budget.unit)}, "
        f"u = {two_digits(budget.u)}, effective degrees of freedom {degrees_of_freedom(budget.dof)}, "
        f"k = {budget.coverage_factor:.2f}, U = {two_digits(budget.expanded)}"
    )
    columns = {
        "source": lambda row: row.quantity,
        "type": lambda row: row.kind,
        "u": lambda row: optional(lambda u: f"{two_digits(u)} {row.unit}".removesuffix(" 1"), row.u),
        "dof": lambda row: "" if row.u is None else degrees_of_freedom(row.dof),
        "sensitivity": lambda row: optional(three_digits, row.sensitivity),
        "contribution": lambda row: optional(two_digits, None if row.contribution is None else abs(row.contribution)),
        "share %": lambda row: f"{100 * row.share:.1f}",
    }
    return table(caption, budget.rows, columns)


def for_firmware(summary: AxisSummary) -> str:
    """Values for a motion controller: commands per unit on the line read, play in commands."""
    sides = tuple(summary.effective_per_command.values())
    ratio, u_ratio = sum(estimate.value for estimate in sides) / len(sides), max(estimate.sd for estimate in sides)
    play, where = summary.effective_backlash, " on average"
    if play is None:
        play, where = summary.parameters["backlash"], ""

    def in_commands(value: float) -> str:
        return f"{concise(value / abs(ratio), play.sd / abs(ratio))} commands{where}"

    words = f"play of {in_commands(play.value)}"
    if _contains_zero(play.interval95):
        words += " is not significant: its 95 % interval contains 0"
    elif play.value < 0:
        words = f"no play: a reversal overshoots by {in_commands(-play.value)}"
    low, high = summary.range_command
    return (
        f"for your firmware, from {low:.10g} to {high:.10g}: {concise(1 / ratio, u_ratio / ratio**2)} commands per "
        f"{escaped(summary.unit)}, {words}"
    )


def result_lines(summary: AxisSummary) -> list[str]:
    """Main results of a converged fit: numbers for firmware, the worst position, waves; for a drive only waves."""
    waves = [*_waves(summary.periods, summary, summary.periods_in), *_waves(summary.encoder_periods, summary, "")]
    if is_drive(summary):
        return waves
    return [for_firmware(summary), *([worst_place(summary)] if summary.deviations else []), *waves]


def _waves(estimates: Sequence[PeriodEstimate], summary: AxisSummary, periods_in: str) -> list[str]:
    """Probable waves, in words."""
    unit, texts = escaped(summary.unit), []
    for e in estimates:
        if e.probability >= LIKELY:
            period = f"{e.period.value:.10g}" if e.source == "stated" else concise(e.period.value, e.period.sd)
            amplitude, x_unit = concise(e.amplitude.value, e.amplitude.sd), "s" if periods_in == "seconds" else unit
            texts.append(f"a wave of {amplitude} {unit} every {period} {x_unit}, probability {percent(e.probability)}")
    return texts


def worst_place(summary: AxisSummary) -> str:
    """The largest error by position and its possible source."""
    worst = max(summary.deviations, key=lambda d: abs(d.value))
    doubt = ", whose 95 % interval contains 0" * _contains_zero(worst.interval95)
    return (
        f"the error by position is largest at command {worst.position:.10g}: {concise(worst.value, worst.sd)} "
        f"{escaped(summary.unit)} off the line{doubt}; it is the sum of the errors of gears and encoder, which one "
        "encoder cannot separate"
    )


def _scatter(classic: ClassicAxis, unit: str) -> str:
    """Scatter about the line; where no degree of freedom is left, what is not determined."""
    if classic.residual_sd is None:
        unknowns = "offset, unit per command" + ", backlash" * (classic.backlash is not None)
        return f"their u and the scatter are not determined: as many stops as unknowns ({unknowns}); read more stops"
    return f"scatter about the line {two_digits(classic.residual_sd)} {unit}"


def classic_text(classic: ClassicAxis, unit: str) -> str:
    """The classic estimate of an axis as text."""
    unit_text, figures = escaped(unit), iso230_table(classic, unit)
    play = optional(lambda value: f"backlash {concise(value, classic.u_backlash or 0.0)} {unit_text}", classic.backlash)
    return terminal(
        f"{concise(classic.per_command, classic.u_per_command or 0.0)} {unit_text} per command",
        play or None,
        f"{_scatter(classic, unit_text)}; stops taken as independent",
        *(() if figures is None else ("", classic.iso230_basis, figures)),
    )


def warnings_note(summary: AxisSummary) -> str:
    """A reference to doubts and warnings, at the end of a verdict."""
    counts = {"doubt": len(summary.doubts), "warning": len(summary.warnings)}
    named = [f"the {plural(count, word)}" if count > 1 else f"the {word}" for word, count in counts.items() if count]
    return f"; see {' and '.join(named)}" if named else ""


def axis_fit_text(summary: AxisSummary, details: bool = False, written: Sequence[str] = ()) -> str:
    """Main results, remarks, tables, and one line of verdict at the end.

    Args:
        summary: the fit.
        details: also the error by position, ISO 230-2 and weak directions.
        written: files with all results.
    """
    words = {None: "Laplace approximation", IMPORTANCE: "weighted draws"}
    method = words.get(summary.tier, f"chain of {summary.tier}")
    weak, deviations = summary.weak_directions, summary.deviations
    parts: list[Part] = [
        *(result_lines(summary) if summary.explained else []),
        deviation_table(deviations, summary.unit, DEVIATIONS_SHOWN) if details and deviations else None,
        iso230_table(summary.classic, summary.unit) if details else None,
        *labelled("weak (set by the priors, not by the readings)", weak if details else ()),
        f"--details and the report say more: {plural(len(weak), 'weak direction')}" if weak and not details else None,
        *labelled("not accepted" if summary.explained else "NOT CONVERGED", summary.problems),
        *labelled("warning", summary.warnings),
        *labelled("doubt", [doubt.text for doubt in summary.doubts]),
        *labelled("prior conflict", summary.prior_conflicts),
        f"written: {', '.join(written)}" if written else None,
    ]
    return terminal(
        *parts,
        "" if any(part is not None for part in parts) else None,
        f"{summary.readings} readings of {summary.moves} moves at {summary.positions} positions; {method}",
        _agreement(summary),
        *(period_table(summary), parameter_table(summary), ratio_table(summary)),
        f"verdict: {axis_verdict(summary)}",
    )


def _agreement(summary: AxisSummary) -> str | None:
    """Whether a chain and the weighted draws agree; None without a chain."""
    if summary.tier in (None, IMPORTANCE):
        return None
    worst = summary.sampling.get("agreement")
    if worst is None:
        return "the weighted draws were not accepted: results are those of the chain"
    words = "agree" if worst < AGREEMENT_LIMIT else "DISAGREE"
    return f"chain and weighted draws {words}: the largest difference is {worst:.1f} Monte Carlo errors"


def axis_verdict(summary: AxisSummary) -> str:
    """Whether the numbers may be used."""
    if not summary.explained:
        return "NOT CONVERGED, use none of these numbers"
    if summary.prior_conflicts:
        return "PRIOR CONFLICT, the numbers hold only if the readings, not the priors, are wrong"
    verdict = ROUGH if summary.answer == "rough" else "usable"
    if any(not doubt.usable for doubt in summary.doubts):
        verdict = "DOUBTFUL, not usable as it is"
    elif not summary.converged:
        verdict = UNSAMPLED
    return f"{verdict}{warnings_note(summary)}"


def axis_hold_out_text(hold_out: AxisHoldOut, unit: str) -> str:
    """Positions left out, with their predictions."""
    positions = table(
        f"positions left out and predicted, {escaped(unit)}; z in stated uncertainties",
        hold_out.positions,
        {
            "position": lambda p: f"{p.position:.10g}",
            "direction": lambda p: p.direction,
            "n": lambda p: str(p.n),
            "mean": lambda p: to_digits(p.mean, p.u),
            "predicted(u)": lambda p: concise(p.predicted, p.u),
            "z": lambda p: f"{p.z:+.1f}",
            "z classic": lambda p: f"{p.classic_z:+.1f}",
        },
    )
    errors = (
        f"RMS z {hold_out.rms_z:.2f}, classic {hold_out.classic_rms_z:.2f}; {100 * hold_out.inside_share:.0f} % of the "
        "left-out readings in their 95 % intervals"
    )
    return terminal(positions, errors, *labelled("warning", hold_out.warnings))


def axis_plan_text(plan: AxisPlan, unit: str) -> str:
    """A plan as text."""
    if not plan.next:
        return "the time is too short for a single stop"
    stops = table(
        f"stops to read next, in this order; now u = {two_digits(plan.u_now)} {unit_of(plan.target, escaped(unit))}",
        plan.next,
        {
            "command": lambda stop: f"{stop.command:.10g}",
            "direction": lambda stop: stop.direction,
            "go first to": lambda stop: optional(lambda via: f"{via:.10g}", stop.via),
            f"u of {plan.target} afterwards": lambda stop: two_digits(stop.u),
        },
    )
    share = plan.next[-1].u / plan.u_now
    helps = HELPS.get(plan.target, MORE_HELPS)
    warning = f"these stops have little effect: u falls by {100 * (1 - share):.1f} %; {helps}"
    return terminal(stops, f"{plan.minutes:.1f} minutes in all", warning if share > HELPLESS_SHARE else None)


def axis_errors(fit: AxisFit, commands: np.ndarray, values: np.ndarray) -> Figure:
    """The error at commands (t,) with its 95 % band, by values (n, t), and the stops, minus the line through them."""
    rows = fit.rows
    design = np.column_stack([np.ones(len(rows.value)), rows.command - fit.model.middle])
    deviations = rows.value - design @ np.linalg.lstsq(design, rows.value, rcond=None)[0]
    with drawing(3.2) as figure:
        axes = figure.add_subplot()
        banded(axes, commands, band95(values), "error by position")
        for side, name in ((1, "forward"), (-1, "backward"), (0, "")):
            of_side, (marker, colour) = rows.side == side, DIRECTION_STYLE[name]
            if of_side.any():
                label = f"stops, {name or 'side unknown'}"
                axes.plot(rows.command[of_side], deviations[of_side], marker, color=colour, markersize=3.5, label=label)
        axes.set(xlabel="command", ylabel=f"off the line, {fit.campaign.unit}")
        legend(figure, 2)
    return figure


def wave(sample: WaveSample, unit: str) -> Figure:
    """One wave over its mean period, with its 95 % band, given that it exists."""
    turn = np.linspace(0.0, 1.0, CURVE_POINTS)
    period_unit = "s" if sample.wave.clock == "seconds" else unit
    with drawing(2.4) as figure:
        axes = figure.add_subplot()
        banded(axes, turn * float(np.mean(sample.period[sample.likeliest])), band95(sample.curve(turn)), "wave")
        axes.set(xlabel=f"{period_unit}, from {sample.record.middle:.6g} on", ylabel=unit)
        legend(figure, 2)
    return figure


def iso230_plot(runs: PositionRuns, unit: str) -> Figure:
    """Every run, means by side, and means plus and less 2 s."""
    with drawing(3.4) as figure:
        axes = figure.add_subplot()
        axes.axhline(0.0, color=BLACK, linewidth=0.6)
        for name, sides in (("forward", runs.forward), ("backward", runs.backward)):
            read = np.isfinite(sides).sum(axis=1) > 0
            if not read.any():
                continue
            (marker, colour), at, deviations = DIRECTION_STYLE[name], runs.position[read], sides[read]
            mean = np.nanmean(deviations, axis=1)
            axes.plot(at, deviations, color=colour, linewidth=0.5, alpha=0.5, rasterized=True)
            axes.plot(at, mean, marker, linestyle="-", color=colour, markersize=4, linewidth=1.4, label=f"mean, {name}")
            if np.all(np.isfinite(deviations).sum(axis=1) > 1):
                s = np.nanstd(deviations, axis=1, ddof=1)
                for sign, label in ((2, f"mean \u00b1 2 s, {name}"), (-2, None)):
                    axes.plot(at, mean + sign * s, "--", color=colour, linewidth=0.9, label=label)
        axes.set(xlabel="target", ylabel=f"actual less target, {unit}")
        legend(figure, 2)
    return figure


def curve_commands(low: float, high: float) -> np.ndarray:
    """Commands of the figure's curve; `results_for` needs them as `more`."""
    return np.linspace(low, high, CURVE_POINTS)


def _figures(fit: AxisFit) -> list[FigureView]:
    """The error by position, which a drive read in motion has none of, and probable waves."""
    views, unit = [], fit.campaign.unit
    if not fit.rows.in_motion:
        commands = curve_commands(float(fit.rows.command.min()), float(fit.rows.command.max()))
        alt = "The error that repeats by position over the command as a curve with a band, and every stop as a marker."
        caption = "Deviation from the line through the stops: what repeats by position with its 95 % band, and the "
        figure = axis_errors(fit, commands, deviation_strata(fit, commands))
        views.append(FigureView(figure, alt, f"{caption}stops."))
    for sample in wave_samples(fit):
        if sample.probability > LIKELY:
            period_unit = "s" if sample.wave.clock == "seconds" else escaped(unit)
            period = f"{float(np.mean(sample.period[sample.likeliest])):.4g} {period_unit}"
            name = "encoder" if sample.wave.clock == "encoder" else "gear"
            caption = f"Wave of the {name} every {period}: one period, both harmonics, with its 95 % band."
            views.append(FigureView(wave(sample, unit), "A wave over one period as a curve with a band.", caption))
    return views


def axis_sections(results: AxisResults, figures: Sequence[FigureView]) -> list[Section]:
    """Sections in the order of the page; `figures` are those after the first page."""
    summary, campaign, of_drive = results.summary, results.fit.campaign, is_drive(results.summary)
    unit, classic, fixed = summary.unit, summary.classic, sentences("axis_sections")
    line = (
        f"Least-squares line: {concise(classic.per_command, classic.u_per_command or 0.0)} {unit} per command, stops "
        f"independent; {_scatter(classic, unit)}."
    )
    parameters = [ratio_table(summary) if period_table(summary) else None, parameter_table(summary)]
    result_texts = [sentence(text) for text in (result_lines(summary) if summary.explained else ())]
    deviations = [deviation_table(summary.deviations, unit, TABLE_ROWS) if summary.deviations else None]
    compensations = []
    if (compensation := compensation_in(campaign)) is not None:
        verification = stored_verification(campaign, axis_hashes(campaign), compensation.digest, compensation.unit)
        compensations = [compensation_section(compensation, verification)]
    budgets = Section("Uncertainty budgets", [fixed["budgets"]], tables=[*map(budget_view, summary.budgets)])
    return [
        Section("Result", result_texts, tables=parameters, figures=figures, opened=True),
        *([] if of_drive else [Section("What repeats by position", tables=deviations)]),
        *compensations,
        Section("What the readings do not determine", items=summary.weak_directions or ["No remarks."]),
        Section("Classic", [line]),
        *([] if of_drive else [_iso230_section(results)]),
        *([budgets] if summary.budgets else []),
        Section("Method", fixed["method"]),
    ]


def _iso230_section(results: AxisResults) -> Section:
    """The test by ISO 230-2: figures by letter, by position, and the standard's plot."""
    classic, unit, runs = results.summary.classic, results.summary.unit, target_runs(results.fit.rows).runs
    figures = []
    if runs is not None:
        alt = "Deviations of every run over the target, with the mean of either side and lines at two s from it."
        caption = "ISO 230-2: deviations of every run, their means by side, and the means plus and less 2 s."
        figures = [FigureView(iso230_plot(runs, unit), alt, caption)]
    tables = [iso230_table(classic, unit), targets_table(classic, unit)]
    return Section("ISO 230-2", [sentence(classic.iso230_basis)], tables=tables, figures=figures)


def _play_number(summary: AxisSummary) -> Number:
    """The play for the top of the page."""
    play, note = summary.effective_backlash, f"{summary.unit}, mean over the positions read"
    if play is None:
        play, note = summary.parameters["backlash"], summary.unit
    return Number("play", concise(play.value, play.sd), note)


def _step(summary: AxisSummary, folder: str) -> str:
    """What to do next, in a sentence."""
    if not is_drive(summary):
        return f"`tvsbayes plan --given {folder}` says which stops to read next."
    if any(wave.probability >= TABLE_LIKELY for wave in summary.periods):
        return f"`tvsbayes compensate {folder} --to pec -o worm.csv` writes the table of the strongest wave's period."
    return "Log a longer run: of N periods, noise leaves about period / (2 N) times noise over amplitude."


def figures_by_name(unit: str) -> dict[str, tuple[str, str]]:
    """Name and unit of the figures that a tolerance may limit, by their letters in small letters."""
    return {symbol.lower(): (name, unit) for name, symbol in AXIS_SYMBOLS.items()}


def criteria_of(summary: AxisSummary, tolerance: Tolerance | None) -> tuple[Criterion, ...]:
    """The tolerance judged; none where none is stated.

    Raises:
        NothingToEstimate: the readings do not give the figure.
        InputError: the rule needs an uncertainty that is not known.
    """
    if tolerance is None:
        return ()
    classic, symbol = summary.classic, AXIS_SYMBOLS[tolerance.of]
    value, u = ((figures or {}).get(tolerance.of) for figures in (classic.iso230, classic.iso230_u))
    if value is None:
        why = classic.iso230_basis if classic.iso230 is None else "the runs do not give it"
        remedy = "read every position at least twice from both sides, and state command_unit in [axis]"
        raise NothingToEstimate("no-figure", f"--of {symbol}: {why}", remedy=remedy)
    # Rounding of the derivatives is no uncertainty.
    known = u if u is not None and u > 1e-9 * abs(value) else None
    return (tolerance.judged(symbol, summary.unit, value, known),)


def axis_document(results: AxisResults, issue: Issue, criteria: Sequence[Criterion] = ()) -> Document:
    """The report of an axis with its number; `results.fit` must include `curve_commands` of its range."""
    summary, fit = results.summary, results.fit
    campaign, header = fit.campaign, fit.campaign.header
    origin = provenance(axis_hashes(campaign), fit.seed)
    verdict = sentence(axis_verdict(summary))
    if criteria:
        verdict = f"{'. '.join(map(criterion_text, criteria))}. {verdict}"
    elif summary.explained:
        verdict += " No limit was stated."
    colour = "cannot-tell" if summary.explained else "not-met"
    figures = _figures(fit)
    folder = "AXIS" if campaign.path is None else typed(campaign.path.resolve().name)
    return numbered(
        Document(
            results=digest_number(json.dumps([summary.as_json(), origin.inputs], sort_keys=True).encode()),
            name=title_of(header, campaign.path),
            about=about_table(header, str(header.get("created") or ""), issue),
            verdict=Verdict(verdict, COLOUR[criteria[0].verdict] if criteria else colour),
            numbers=[] if is_drive(summary) else [_play_number(summary)],
            answer=period_table(summary) or ratio_table(summary),
            picture=figures[0] if figures else None,
            steps=[_step(summary, folder)],
            criteria=criteria_table(criteria),
            traceable=axis_traceability(campaign, performed(campaign, issue.day)).statement,
            warnings=[
                *summary.problems,
                *labelled("Doubt", [doubt.text for doubt in summary.doubts]),
                *summary.warnings,
                *labelled("Prior conflict", summary.prior_conflicts),
            ],
            versions=origin.shown_versions,
            sections=axis_sections(results, figures[1:]),
            title="Calibration of an axis",
            issue=issue,
        )
    )

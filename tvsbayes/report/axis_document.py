"""Results of an axis: tables, texts of commands, the document of its page.

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
from tvsbayes.errors import NothingToEstimate, escaped, typed
from tvsbayes.inference.diagnosis import AGREEMENT_LIMIT
from tvsbayes.instrument.campaign import title_of
from tvsbayes.metrology.conformity import Criterion, Tolerance
from tvsbayes.metrology.traceability import performed
from tvsbayes.report.advice import ROUGH, UNSAMPLED
from tvsbayes.report.budget_views import budget_view
from tvsbayes.report.compensation_text import compensation_section
from tvsbayes.report.criteria import COLOUR, criteria_table, criterion_text
from tvsbayes.report.document import (
    Document,
    FigureView,
    Issue,
    Number,
    Part,
    Section,
    Verdict,
    about_table,
    sentence,
    terminal,
)
from tvsbayes.report.drawing import DIRECTION_STYLE, drawing, legend
from tvsbayes.report.iso230_views import iso230_figure, iso230_table, targets_table
from tvsbayes.report.page import digest_number, numbered
from tvsbayes.report.position_figures import banded
from tvsbayes.report.result_tables import WAVE_COLUMNS, WAVES, percent, wave_row
from tvsbayes.report.tables import TableView, interval_text, two_digits
from tvsbayes.results.comparison_record import AxisHoldOut
from tvsbayes.results.compensation_record import stored_verification
from tvsbayes.results.estimates import Estimate, PeriodEstimate
from tvsbayes.results.fit_record import provenance
from tvsbayes.results.tiers import IMPORTANCE
from tvsbayes.single_axis.axis_campaign import axis_hashes
from tvsbayes.single_axis.axis_certificate import axis_traceability
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_parameters import AXIS_QUANTITIES
from tvsbayes.single_axis.axis_periods import WaveSample, wave_samples
from tvsbayes.single_axis.axis_record import (
    AxisResults,
    AxisSummary,
    PositionDeviation,
    deviation_strata,
)
from tvsbayes.single_axis.classic_line import AXIS_SYMBOLS, ClassicAxis, target_runs
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
CONFLICT_TEXT = "the numbers hold only if the readings, not the priors, are wrong"
"""Part of the verdict where the readings contradict priors."""
BUDGETS = (
    "Shares are of the variance. An error that all readings of the reference share is never rescaled by their scatter. "
    "The u of a figure of ISO 230-2 is that of its measurement; what the axis does not repeat is in the figure.",
)
METHOD = (
    "Readings = offset + unit per command x command, play taken up on the side of arrival, an error and a play "
    "that repeat by position (Matern processes), waves where periods are asked for, a zero that creeps and drifts, "
    "an error of every stop, noise. What is linear is integrated out exactly; scales are sampled, never maximised.",
    "The ratio of the gears holds beyond the range read; the line through the stops belongs to that range.",
)


MEAN_PLAY = "its mean over the positions read"
STOPS_ALONE = ("backlash", "ratio_contrast", "offset")
"""Parameters that a drive at constant rate does not show: it has one direction and no zero of its own."""


def is_drive(summary: AxisSummary) -> bool:
    """Whether the readings are of a drive at constant rate."""
    return "seeing_s" in summary.parameters


def _row(name: str, estimate: Estimate) -> list[str]:
    return [name, concise(estimate.value, estimate.sd), interval_text(*estimate.interval95, estimate.sd)]


def period_table(summary: AxisSummary) -> TableView | None:
    """Every wave with amplitude and period, given that it exists; None where the model has none."""
    unit, rows = escaped(summary.unit), []
    for source, periods in (("gear", summary.periods), ("encoder", summary.encoder_periods)):
        period_unit = "s" if source == "gear" and summary.periods_in == "seconds" else unit
        rows += [wave_row(source, wave, unit, period_unit) for wave in periods]
    return TableView(f"{WAVES}; phase at position or time 0", WAVE_COLUMNS, rows) if rows else None


def ratio_table(summary: AxisSummary) -> TableView:
    """Unit per command by direction: of the gears, of the line through the readings, and from the classic estimate."""
    unit = escaped(summary.unit)
    low, high = summary.range_command
    sides = ("forward",) if is_drive(summary) else tuple(summary.per_command)
    rows = [_row(_of_side("gears", side, sides), summary.per_command[side]) for side in sides]
    line = f"line from {low:.10g} to {high:.10g}"
    rows += [_row(_of_side(line, side, sides), summary.effective_per_command[side]) for side in sides]
    classic = summary.classic
    rows.append(["classic: least-squares line", concise(classic.per_command, classic.u_per_command or 0.0), ""])
    return TableView(f"{unit} per command, value(u)", ["", "value(u)", "95 % interval"], rows)


def _of_side(label: str, side: str, sides: Sequence[str]) -> str:
    """A label with its direction, where there are two."""
    return f"{label}, {side}" if len(sides) > 1 else label


def parameter_table(summary: AxisSummary) -> TableView:
    """All parameters but the ratio."""
    rows, labels = [], {name: quantity.label for name, quantity in AXIS_QUANTITIES.items()}
    left_out = {"per_command", *(STOPS_ALONE if is_drive(summary) else ())}
    for name, estimate in summary.parameters.items():
        if name not in left_out:
            share = "" if estimate.contraction is None else f"{100 * max(estimate.contraction, 0.0):.0f} %"
            rows.append([labels.get(name, name), *_row(name, estimate)[1:], share])
        if name == "backlash" and summary.effective_backlash is not None:
            rows.append([MEAN_PLAY, *_row(name, summary.effective_backlash)[1:], ""])
    caption = f"parameters, {escaped(summary.unit)}; 100 %: set by the readings, 0 %: set by the prior"
    return TableView(caption, ["", "value(u)", "95 % interval", "data"], rows)


def for_firmware(summary: AxisSummary) -> str:
    """Values for a motion controller: commands per unit on the line read, play in commands."""
    sides = tuple(summary.effective_per_command.values())
    ratio, u_ratio = sum(estimate.value for estimate in sides) / len(sides), max(estimate.sd for estimate in sides)
    low, high = summary.range_command
    text = f"for your firmware, from {low:.10g} to {high:.10g}: {concise(1 / ratio, u_ratio / ratio**2)} commands per "
    text += f"{escaped(summary.unit)}, "
    play, where = summary.effective_backlash, " on average"
    if play is None:
        play, where = summary.parameters["backlash"], ""
    in_commands = concise(play.value / abs(ratio), play.sd / abs(ratio))
    if play.interval95[0] <= 0 <= play.interval95[1]:
        return f"{text}play of {in_commands} commands{where} is not significant: its 95 % interval contains 0"
    if play.value < 0:
        overshoot = concise(-play.value / abs(ratio), play.sd / abs(ratio))
        return f"{text}no play: a reversal overshoots by {overshoot} commands{where}"
    return f"{text}play of {in_commands} commands{where}"


def result_lines(summary: AxisSummary) -> list[str]:
    """Main results of a converged fit: numbers for firmware, the worst position, waves; for a drive only waves."""
    waves = [*_waves(summary.periods, summary, summary.periods_in), *_waves(summary.encoder_periods, summary, "")]
    if is_drive(summary):
        return waves
    return [for_firmware(summary), *([worst_place(summary)] if summary.deviations else []), *waves]


def _waves(estimates: Sequence[PeriodEstimate], summary: AxisSummary, periods_in: str) -> list[str]:
    """Probable waves, in words."""
    unit = escaped(summary.unit)
    texts = []
    for e in estimates:
        if e.probability >= LIKELY:
            period = f"{e.period.value:.10g}" if e.source == "stated" else concise(e.period.value, e.period.sd)
            amplitude = concise(e.amplitude.value, e.amplitude.sd)
            x_unit = "s" if periods_in == "seconds" else unit
            texts.append(f"a wave of {amplitude} {unit} every {period} {x_unit}, probability {percent(e.probability)}")
    return texts


def worst_place(summary: AxisSummary) -> str:
    """The largest error by position and its possible source."""
    worst = max(summary.deviations, key=lambda d: abs(d.value))
    text = f"the error by position is largest at command {worst.position:.10g}: {concise(worst.value, worst.sd)} "
    text += f"{escaped(summary.unit)} off the line"
    if worst.interval95[0] <= 0 <= worst.interval95[1]:
        text += ", whose 95 % interval contains 0"
    return f"{text}; it is the sum of the errors of gears and encoder, which one encoder cannot separate"


def deviation_table(deviations: Sequence[PositionDeviation], unit: str, limit: int) -> TableView:
    """Errors that repeat by position, minus the line; at most `limit` positions, evenly spread."""
    rows = [[f"{d.position:.10g}", concise(d.value, d.sd), interval_text(*d.interval95, d.sd)] for d in deviations]
    caption = f"error that repeats by position, off the line through the stops, {escaped(unit)}"
    if len(rows) > limit:
        caption += f"; {limit} of {len(rows)} positions, fit.json has all"
        rows = [rows[round(k * (len(rows) - 1) / (limit - 1))] for k in range(limit)]
    return TableView(caption, ["command", "value(u)", "95 % interval"], rows)


def _scatter(classic: ClassicAxis, unit: str) -> str:
    """Scatter about the line; where no degree of freedom is left, what is not determined."""
    if classic.residual_sd is None:
        unknowns = "offset, unit per command" + ", backlash" * (classic.backlash is not None)
        return f"their u and the scatter are not determined: as many stops as unknowns ({unknowns}); read more stops"
    return f"scatter about the line {two_digits(classic.residual_sd)} {unit}"


def classic_text(classic: ClassicAxis, unit: str) -> str:
    """The classic estimate of an axis as text."""
    unit_text = escaped(unit)
    play = None
    if classic.backlash is not None:
        play = f"backlash {concise(classic.backlash, classic.u_backlash or 0.0)} {unit_text}"
    table = iso230_table(classic, unit)
    return terminal(
        f"{concise(classic.per_command, classic.u_per_command or 0.0)} {unit_text} per command",
        play,
        f"{_scatter(classic, unit_text)}; stops taken as independent",
        None if table is None else "",
        None if table is None else classic.iso230_basis,
        table,
    )


def _lines(title: str, texts: Sequence[str]) -> list[str]:
    return [f"{title}: {text}" for text in texts]


def warnings_note(summary: AxisSummary) -> str:
    """A reference to doubts and warnings, at the end of a verdict."""
    counts = {"doubt": len(summary.doubts), "warning": len(summary.warnings)}
    named = [f"the {count} {word}s" if count > 1 else f"the {word}" for word, count in counts.items() if count]
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
    parts: list[Part] = []
    if details:
        deviations = deviation_table(summary.deviations, summary.unit, DEVIATIONS_SHOWN)
        parts = [deviations if summary.deviations else None, iso230_table(summary.classic, summary.unit)]
        parts += _lines("weak (set by the priors, not by the readings)", summary.weak_directions)
    elif count := len(summary.weak_directions):
        parts = [f"--details and the report say more: {count} weak direction{'s' * (count > 1)}"]
    title = "not accepted" if summary.explained else "NOT CONVERGED"
    parts += [*_lines(title, summary.problems), *_lines("warning", summary.warnings)]
    parts += _lines("doubt", [doubt.text for doubt in summary.doubts])
    parts += _lines("prior conflict", summary.prior_conflicts)
    parts += [f"written: {', '.join(written)}"] if written else []
    data = f"{summary.readings} readings of {summary.moves} moves at {summary.positions} positions; {method}"
    answer = result_lines(summary) if summary.explained else []
    return terminal(
        *answer,
        *parts,
        "" if answer or any(part is not None for part in parts) else None,
        data,
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
        return f"PRIOR CONFLICT, {CONFLICT_TEXT}"
    if any(not doubt.usable for doubt in summary.doubts):
        return f"DOUBTFUL, not usable as it is{warnings_note(summary)}"
    if not summary.converged:
        return f"{UNSAMPLED}{warnings_note(summary)}"
    return f"{ROUGH if summary.answer == 'rough' else 'usable'}{warnings_note(summary)}"


def hold_out_table(hold_out: AxisHoldOut, unit: str) -> TableView:
    """Positions left out, with their predictions."""
    rows = []
    for p in hold_out.positions:
        # To the digits of u.
        mean = concise(p.mean, p.u).partition("(")[0]
        row = [f"{p.position:.10g}", p.direction, str(p.n), mean, concise(p.predicted, p.u), f"{p.z:+.1f}"]
        rows.append([*row, f"{p.classic_z:+.1f}"])
    caption = f"positions left out and predicted, {escaped(unit)}; z in stated uncertainties"
    return TableView(caption, ["position", "direction", "n", "mean", "predicted(u)", "z", "z classic"], rows)


def axis_hold_out_text(hold_out: AxisHoldOut, unit: str) -> str:
    """A hold-out as text."""
    errors = f"RMS z {hold_out.rms_z:.2f}, classic {hold_out.classic_rms_z:.2f}; "
    errors += f"{100 * hold_out.inside_share:.0f} % of the left-out readings in their 95 % intervals"
    return terminal(hold_out_table(hold_out, unit), errors, *_lines("warning", hold_out.warnings))


def next_table(plan: AxisPlan, unit: str) -> TableView:
    """Stops to be read next."""
    rows = []
    for stop in plan.next:
        over = "" if stop.via is None else f"{stop.via:.10g}"
        rows.append([f"{stop.command:.10g}", stop.direction, over, two_digits(stop.u)])
    u = f"u of {plan.target} afterwards"
    caption = f"stops to read next, in this order; now u = {two_digits(plan.u_now)} "
    caption += unit_of(plan.target, escaped(unit))
    return TableView(caption, ["command", "direction", "go first to", u], rows)


def axis_plan_text(plan: AxisPlan, unit: str) -> str:
    """A plan as text."""
    if not plan.next:
        return "the time is too short for a single stop"
    share = plan.next[-1].u / plan.u_now
    helps = HELPS.get(plan.target, MORE_HELPS)
    warning = f"these stops have little effect: u falls by {100 * (1 - share):.1f} %; {helps}"
    minutes = f"{plan.minutes:.1f} minutes in all"
    return terminal(next_table(plan, unit), minutes, warning if share > HELPLESS_SHARE else None)


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


def _wave_figures(fit: AxisFit) -> list[FigureView]:
    """Figures of probable waves."""
    alt, unit = "A wave over one period as a curve with a band.", escaped(fit.campaign.unit)
    figures = []
    for sample in wave_samples(fit):
        if sample.probability > LIKELY:
            period_unit = "s" if sample.wave.clock == "seconds" else unit
            period = f"{float(np.mean(sample.period[sample.likeliest])):.4g} {period_unit}"
            name = "encoder" if sample.wave.clock == "encoder" else "gear"
            caption = f"Wave of the {name} every {period}: one period, both harmonics, with its 95 % band."
            figures.append(FigureView(wave(sample, fit.campaign.unit), alt, caption))
    return figures


def curve_commands(low: float, high: float) -> np.ndarray:
    """Commands of the figure's curve; `results_for` needs them as `more`."""
    return np.linspace(low, high, CURVE_POINTS)


def _error_figures(fit: AxisFit) -> list[FigureView]:
    """The error by position; a drive read in motion has none."""
    if fit.rows.in_motion:
        return []
    commands = curve_commands(float(fit.rows.command.min()), float(fit.rows.command.max()))
    alt = "The error that repeats by position over the command as a curve with a band, and every stop as a marker."
    caption = "Deviation from the line through the stops: what repeats by position with its 95 % band, and the stops."
    return [FigureView(axis_errors(fit, commands, deviation_strata(fit, commands)), alt, caption)]


def axis_sections(results: AxisResults, figures: Sequence[FigureView]) -> list[Section]:
    """Sections in the order of the page; `figures` are those after the first page."""
    summary, campaign = results.summary, results.fit.campaign
    unit, classic, waves = summary.unit, summary.classic, period_table(summary)
    line = f"Least-squares line: {concise(classic.per_command, classic.u_per_command or 0.0)} {unit} per command, "
    line += f"stops independent; {_scatter(classic, unit)}."
    parameters = [ratio_table(summary) if waves else None, parameter_table(summary)]
    result_texts = [sentence(text) for text in (result_lines(summary) if summary.explained else ())]
    deviations = [deviation_table(summary.deviations, unit, TABLE_ROWS) if summary.deviations else None]
    compensation = compensation_in(campaign)
    compensation_sections = []
    if compensation is not None:
        verification = stored_verification(campaign, axis_hashes(campaign), compensation.digest, compensation.unit)
        compensation_sections = [compensation_section(compensation, verification)]
    return [
        Section("Result", result_texts, tables=parameters, figures=figures, opened=True),
        *([] if is_drive(summary) else [Section("What repeats by position", tables=deviations)]),
        *compensation_sections,
        Section("What the readings do not determine", items=summary.weak_directions or ["No remarks."]),
        Section("Classic", [line]),
        *([] if is_drive(summary) else [iso230_section(results)]),
        *(
            [Section("Uncertainty budgets", BUDGETS, tables=[*map(budget_view, summary.budgets)])]
            if summary.budgets
            else []
        ),
        Section("Method", METHOD),
    ]


def iso230_section(results: AxisResults) -> Section:
    """The test by ISO 230-2."""
    classic, unit = results.summary.classic, results.summary.unit
    runs = target_runs(results.fit.rows).runs
    figures = [] if runs is None else [iso230_figure(runs, unit)]
    tables = [iso230_table(classic, unit), targets_table(classic, unit)]
    return Section("ISO 230-2", [sentence(classic.iso230_basis)], tables=tables, figures=figures)


def _play_number(summary: AxisSummary) -> Number:
    """The play for the top of the page."""
    play, note = summary.effective_backlash, f"{summary.unit}, mean over the positions read"
    if play is None:
        play, note = summary.parameters["backlash"], summary.unit
    return Number("play", concise(play.value, play.sd), note)


def _steps(summary: AxisSummary, folder: str) -> list[str]:
    """What to do next, in sentences."""
    if not is_drive(summary):
        return [f"`tvsbayes plan --given {folder}` says which stops to read next."]
    if any(wave.probability >= TABLE_LIKELY for wave in summary.periods):
        return [f"`tvsbayes compensate {folder} --to pec -o worm.csv` writes the table of the strongest wave's period."]
    return ["Log a longer run: of N periods, noise leaves about period / (2 N) times noise over amplitude."]


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
    origin = provenance(axis_hashes(fit.campaign), fit.seed)
    content = json.dumps([summary.as_json(), origin.inputs], sort_keys=True)
    header = fit.campaign.header
    verdict = sentence(axis_verdict(summary))
    if criteria:
        verdict = f"{'. '.join(map(criterion_text, criteria))}. {verdict}"
    elif summary.explained:
        verdict += " No limit was stated."
    colour = "cannot-tell" if summary.explained else "not-met"
    figures = [*_error_figures(fit), *_wave_figures(fit)]
    folder = "AXIS" if fit.campaign.path is None else typed(fit.campaign.path.resolve().name)
    return numbered(
        Document(
            results=digest_number(content.encode()),
            name=title_of(header, fit.campaign.path),
            about=about_table(header, str(header.get("created") or ""), issue),
            verdict=Verdict(verdict, COLOUR[criteria[0].verdict] if criteria else colour),
            numbers=[] if is_drive(summary) else [_play_number(summary)],
            answer=period_table(summary) or ratio_table(summary),
            picture=figures[0] if figures else None,
            steps=_steps(summary, folder),
            criteria=criteria_table(criteria),
            traceable=axis_traceability(fit.campaign, performed(fit.campaign, issue.day)).statement,
            warnings=[
                *summary.problems,
                *_lines("Doubt", [doubt.text for doubt in summary.doubts]),
                *summary.warnings,
                *_lines("Prior conflict", summary.prior_conflicts),
            ],
            versions=origin.shown_versions,
            sections=axis_sections(results, figures[1:]),
            title="Calibration of an axis",
            issue=issue,
        )
    )

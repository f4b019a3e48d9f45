"""The calibration report of one axis as an HTML page: ratio, what repeats by position, ISO 230-2, what next."""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.compensation.verification import compensation_in, verification_in
from tvsbayes.errors import typed
from tvsbayes.instrument.campaign import title_of
from tvsbayes.report.axis_text import (
    axis_verdict,
    deviation_table,
    iso230_table,
    offered,
    parameter_table,
    period_table,
    ratio_table,
)
from tvsbayes.report.compensation_text import compensation_section
from tvsbayes.report.drawing import BLUE, GREY, RED, SKY, drawing
from tvsbayes.report.first_page import about_table
from tvsbayes.report.page import NUMBER_DIGITS, numbered
from tvsbayes.report.tables import FigureView, Issue, Number, Page, Section, concise, figure_view, two_digits
from tvsbayes.results.fit_record import provenance
from tvsbayes.results.records import plain
from tvsbayes.single_axis.axis_campaign import AxisCampaign, axis_hashes
from tvsbayes.single_axis.axis_periods import WaveSample, wave_samples
from tvsbayes.single_axis.axis_record import AxisResults, drawn_deviations

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tvsbayes.single_axis.axis_fit import AxisFit

CURVE_POINTS = 81
"""Of the figure of the error by position."""
OF_SIDE: dict[int, tuple[str, str, str]] = {
    1: (">", BLUE, "forward"),
    -1: ("<", RED, "backward"),
    0: ("o", GREY, "side unknown"),
}
TABLE_ROWS = 60
LIKELY = 0.5
"""Probability of a wave from which on its curve is drawn."""


def curve_commands(low: float, high: float) -> np.ndarray:
    """Where the figure's curve is asked for; `results_for` wants them beforehand."""
    return np.linspace(low, high, CURVE_POINTS)


def error_figure(fit: AxisFit) -> Figure:
    """The error by position with its 95 % band, and the stops on it, off the line through them."""
    model, rows = fit.model, fit.rows
    commands = curve_commands(float(rows.command.min()), float(rows.command.max()))
    drawn = drawn_deviations(fit, commands, np.random.default_rng([fit.seed, 6]))
    low, high = np.percentile(drawn, (2.5, 97.5), axis=0)
    design = np.column_stack([np.ones(len(rows.value)), rows.command - model.middle])
    off = rows.value - design @ np.linalg.lstsq(design, rows.value, rcond=None)[0]
    with drawing(3.2) as figure:
        axes = figure.add_subplot()
        axes.fill_between(commands, low, high, color=SKY, alpha=0.4, linewidth=0, label="error by position, 95 %")
        axes.plot(commands, drawn.mean(axis=0), color=BLUE, linewidth=1.2, label="its mean")
        for side, (marker, colour, name) in OF_SIDE.items():
            mine = rows.side == side
            if mine.any():
                axes.plot(rows.command[mine], off[mine], marker, color=colour, markersize=3.5, label=f"stops, {name}")
        axes.set(xlabel="command", ylabel=f"off the line, {fit.campaign.unit}")
        figure.legend(loc="outside lower center", ncols=2)
    return figure


def wave_figure(sample: WaveSample, unit: str) -> Figure:
    """One wave over its mean period, with its 95 % band, given that it is there."""
    turn = np.linspace(0.0, 1.0, CURVE_POINTS)
    curve = sample.curve(turn)
    low, high = np.percentile(curve, (2.5, 97.5), axis=0)
    of = "s" if sample.wave.clock == "seconds" else unit
    at = turn * float(np.mean(sample.period))
    with drawing(2.4) as figure:
        axes = figure.add_subplot()
        axes.fill_between(at, low, high, color=SKY, alpha=0.4, linewidth=0, label="wave, 95 %")
        axes.plot(at, curve.mean(axis=0), color=BLUE, linewidth=1.2, label="its mean")
        axes.set(xlabel=f"{of}, from {sample.record.middle:.6g} on", ylabel=unit)
        figure.legend(loc="outside lower center", ncols=2)
    return figure


def _wave_figures(fit: AxisFit) -> list[FigureView]:
    """Every wave that is there more likely than not."""
    found = []
    for sample in wave_samples(fit):
        if sample.probability > LIKELY:
            alt = "A wave over one period as a curve with a band."
            caption = f"Wave of the {'encoder' if sample.wave.clock == 'encoder' else 'gear'} over one period, both "
            caption += "harmonics, with its 95 % band."
            found.append(figure_view(wave_figure(sample, fit.campaign.unit), alt, caption))
    return found


def _figure_of(fit: AxisFit) -> FigureView | None:
    if fit.rows.in_motion:
        return None

    alt = "The error that repeats by position over the command as a curve with a band, and every stop as a marker."
    caption = "Deviation from the line through the stops: what repeats by position with its 95 % band, and the stops."
    return figure_view(error_figure(fit), alt, caption)


def _applied(campaign: AxisCampaign) -> list[Section]:
    """What `compensate` and `verify` left beside the fit."""
    made = compensation_in(campaign)
    return [] if made is None else [compensation_section(made, verification_in(campaign, made))]


def axis_page(results: AxisResults, issue: Issue) -> Page:
    """The page with its number; `results.fit` holds `curve_commands` of its range."""
    summary, fit = results.summary, results.fit
    unit = summary.unit
    made = plain(provenance(axis_hashes(fit.campaign), fit.seed))
    said = json.dumps([summary.as_json(), made["inputs"]], sort_keys=True)
    backlash = summary.parameters["backlash"]
    numbers = [Number("play", concise(backlash.value, backlash.sd), unit)]
    method = [
        "Readings = offset + unit per command x command, play taken up on the side of arrival, an error and a play "
        "that repeat by position (Matern processes), waves where periods are asked for, a zero that creeps and drifts, "
        "an error of every stop, noise. What is linear is "
        "integrated out exactly; scales are sampled, never maximised.",
        "The ratio of the gears holds beyond the range read; the line through the stops belongs to that range.",
    ]
    iso230 = iso230_table(summary.classic, unit)
    classic = summary.classic
    told = f"Least-squares line: {concise(classic.per_command, classic.u_per_command)} {unit} per command, stops "
    told += f"independent, residual scatter {two_digits(classic.residual_sd)} {unit}."
    verdict = axis_verdict(summary)
    verdict = f"{verdict[0].upper()}{verdict[1:]}."
    conflicts = [f"Prior conflict: {text}" for text in summary.prior_conflicts]
    waves, figures = period_table(summary), _wave_figures(fit)
    picture = _figure_of(fit)
    if picture is None and figures:
        picture, figures = figures[0], figures[1:]
    in_words = [f"{text[0].upper()}{text[1:]}." for text in (offered(summary) if summary.explained else ())]
    header = fit.campaign.header
    created = header.get("created")
    folder = "AXIS" if fit.campaign.path is None else typed(fit.campaign.path.resolve().name)
    page = Page(
        results=hashlib.sha256(said.encode()).hexdigest()[:NUMBER_DIGITS].upper(),
        name=title_of(header, fit.campaign.path),
        about=about_table(header, str(created) if created else "", issue),
        verdict=f"{verdict} No limit was stated." if summary.explained else verdict,
        verdict_class="cannot-tell" if summary.explained else "not-met",
        numbers=numbers,
        why=(),
        answer=waves or ratio_table(summary),
        picture=picture,
        steps=[f"`tvsbayes plan --given {folder}` says which stops to read next."],
        criteria=None,
        traceable="The readings are taken as stated.",
        warnings=[*summary.problems, *summary.warnings, *conflicts],
        versions=made["versions"],
        sections=[
            Section(
                "Result",
                text=in_words,
                tables=[ratio_table(summary) if waves else None, parameter_table(summary)],
                figures=figures,
                opened=True,
            ),
            Section(
                "What repeats by position",
                tables=[deviation_table(summary.deviations, unit, TABLE_ROWS) if summary.deviations else None],
            ),
            *_applied(fit.campaign),
            Section("What the readings cannot tell", items=summary.weak_directions or ["Nothing of note."]),
            Section("Classic", text=[told], tables=[iso230]),
            Section("Method", text=method),
        ],
        title="Calibration of an axis",
        issue=issue,
    )
    return numbered(page)

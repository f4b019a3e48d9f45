"""Tables that texts and the page print alike: both estimators, their gap, what they predict, budgets of a point.

Units stand in captions and heads; numbers carry two digits of their uncertainty (GUM 7.2.6).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.display import concise
from tvsbayes.estimators.four_point import ClassicResult
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.parameters import HEAD_TERMS, HEADLINES, QUANTITIES, names_of
from tvsbayes.metrology.look_budget import Budget
from tvsbayes.report.parameter_words import name_in_words, share_in_words
from tvsbayes.report.tables import TableView, interval_text, signed, three_digits, two_digits
from tvsbayes.results.comparison_record import Gap, GapTerm, HoldOut
from tvsbayes.results.estimates import Estimate, FitSummary, PeriodEstimate

if TYPE_CHECKING:
    from tvsbayes.head.pointing_model import PointingModel


def _rows(*names: str) -> tuple[tuple[str, str, str], ...]:
    rows = (QUANTITIES[name] for name in names)
    return tuple((of.name, of.label, "" if of.unit == "1" else of.unit) for of in rows)


KEY_PARAMETERS = _rows(
    *(of.name for of in HEADLINES if of.label and not of.ratio),
    *names_of("stop_sd_deg", "look_scatter_deg", "pixel_scale"),
)
"""Parameters of the table that ends a fit: name, label, unit."""
HEAD_PARAMETERS = _rows(*(term.name for term in HEAD_TERMS.values()))
"""The terms of a head, behind them."""
MORE_PARAMETERS = _rows(*names_of("mirror_offset_mm", "extrinsics.rotation_rad", "extrinsics.translation_mm"))
"""Those of its details."""
SHARE_SHOWN = 5e-4
"""Of a variance: smaller ones print as 0.0 %."""


def classic_table(result: ClassicResult) -> TableView:
    """The classic estimator by direction."""
    rows = []
    for direction in DIRECTIONS:
        r = result.directions[direction]
        if r is None:
            rows.append([direction, "0", "no experiment", "", "", ""])
            continue
        optional = (r.sd_deg_per_step, r.u_type_a_deg_per_step)
        sd, u = ("-" if x is None else f"{x:.6f}" for x in optional)
        # An interval has its u beside it.
        gum = "-" if r.interval95_gum is None else interval_text(*r.interval95_gum, r.u_gum_deg_per_step or 0.0)
        rows.append([direction, str(r.n), f"{r.mean_deg_per_step:.6f}", sd, u, gum])
    columns = ["direction", "n", "mean deg/step", "sd", "u type A", "95 % interval (GUM)"]
    return TableView("classic four-point estimator", columns, rows)


ESTIMATE_COLUMNS = ("quantity", "value(u)", "95 % interval", "set by")
"""Of `estimate_row`."""


def estimate_row(label: str, estimate: Estimate | None, unit: str) -> list[str]:
    """Cells of one quantity: name with unit, value(u), interval, and whether data or prior set it."""
    label = f"{label}, {unit}" if unit else label
    if estimate is None:
        return [label, "never moved", "", ""]
    origin = "fixed" if estimate.contraction is None else ("data" if estimate.informed else "prior")
    interval = interval_text(*estimate.interval95, estimate.sd)
    return [label, concise(estimate.value, estimate.sd), interval, origin]


def headline_table(summary: FitSummary) -> TableView:
    """Ratios, contrasts and key parameters of the joint estimator: what ends a fit."""
    pose = summary.reference_pose_deg
    estimates = {f"effective_deg_per_step.{part}": e for part, e in summary.effective.items()}
    estimates |= {
        f"effective_contrast_deg_per_step.{part}": e for part, e in summary.contrasts.items() if e is not None
    }
    rows = [estimate_row(label, estimates[name], unit) for name, label, unit in _rows(*estimates)]
    there = (row for row in (*KEY_PARAMETERS, *HEAD_PARAMETERS) if row[0] in summary.parameters)
    rows += [estimate_row(label, summary.parameters[name], unit) for name, label, unit in there]
    kind = {"laplace": "Laplace", "posterior": "posterior"}[summary.estimator]
    title = f"joint estimator ({kind}) at pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} deg"
    return TableView(title, ESTIMATE_COLUMNS, rows)


def details_table(summary: FitSummary) -> TableView:
    """Where the positioner stands, and L."""
    there = (row for row in MORE_PARAMETERS if row[0] in summary.parameters)
    rows = [estimate_row(label, summary.parameters[name], unit) for name, label, unit in there]
    return TableView("the positioner in frame S (the left camera's)", ESTIMATE_COLUMNS, rows)


def range_text(summary: FitSummary) -> str:
    """Counters over which the effective ratios hold."""
    return ", ".join(f"{axis} {low} to {high}" for axis, (low, high) in summary.range_steps.items()) + " steps"


GEAR_SCALES = names_of(
    *("transmission_error_deg", "transmission_error_length_deg", "play_variation_deg", "drift_deg_per_root_hour"),
    *("creep_deg", "thermal_deg_per_K", "harmonic_amplitude_deg"),
)
"""Scales of what gears repeat and how zeros drift."""


def gears_table(summary: FitSummary) -> TableView | None:
    """Scales of the gears' errors of both axes; None where they are taken as perfect."""
    there = [name for name in GEAR_SCALES if name in summary.parameters]
    if not any(name.startswith(("transmission", "play", "harmonic")) for name in there):
        return None
    rows = [estimate_row(label, summary.parameters[name], unit) for name, label, unit in _rows(*there)]
    return TableView("gears: what repeats by position", ESTIMATE_COLUMNS, rows)


WAVES = "waves, given that they are there"
WAVE_COLUMNS = [
    *("", "amplitude(u) every period(u)", "amplitude, 95 %", "period, 95 %"),
    *("phase(u), deg", "there is a wave"),
]


def wave_row(what: str, wave: PeriodEstimate, unit: str, of: str) -> list[str]:
    """A row of `WAVE_COLUMNS`; `unit` of the amplitude, `of` the period."""
    stated = wave.source == "stated"
    period = f"{wave.period.value:.10g}" if stated else concise(wave.period.value, wave.period.sd)
    amplitude = concise(wave.amplitude.value, wave.amplitude.sd)
    across = interval_text(*wave.amplitude.interval95, wave.amplitude.sd)
    between = "stated" if stated else interval_text(*wave.period.interval95, wave.period.sd)
    phase = concise(wave.phase_deg.value, wave.phase_deg.sd)
    return [what, f"{amplitude} {unit} every {period} {of}", across, between, phase, percent(wave.probability)]


def percent(probability: float) -> str:
    """Of draws, so that neither 0 nor 100 % is claimed."""
    return "> 99.9 %" if probability > 0.999 else "< 0.1 %" if probability < 0.001 else f"{100 * probability:.1f} %"


def waves_table(summary: FitSummary) -> TableView | None:
    """Waves of the periods that the rig states; None where there are none."""
    rows = [wave_row(wave.axis, wave, "deg", "deg") for wave in summary.periods]
    return TableView(f"{WAVES}; phase at counter 0", WAVE_COLUMNS, rows) if rows else None


def gap_table(gaps: Mapping[str, Gap | None]) -> TableView:
    """The gap between both estimators by its terms, of the directions that have one."""
    stated = {direction: gap for direction, gap in gaps.items() if gap is not None}

    def cell(term: GapTerm) -> str:
        return signed(term.value, term.sd)

    rows = [
        ["classic mean", *(f"{gap.classic:.6f}" for gap in stated.values())],
        ["effective ratio (joint)", *(concise(gap.joint.value, gap.joint.sd) for gap in stated.values())],
        ["classic - joint", *(cell(gap.total) for gap in stated.values())],
    ]
    for number, term in enumerate(next(iter(stated.values())).terms):
        rows.append([f"  {term.name}", *(cell(gap.terms[number]) for gap in stated.values())])
    return TableView("why the classic differs from the joint, deg/step, value(u)", ["", *stated], rows)


def hold_out_table(held: HoldOut) -> TableView | None:
    """How well both estimators predict angles that were left out; None where nothing could be judged."""
    if held.classic is None or held.joint is None:
        return None
    rows = [
        [
            name,
            f"{score.rms_deg:.3f}",
            f"{score.rms_block_deg:.3f}",
            f"{100 * score.coverage:.0f} %",
            f"{score.log_density:+.2f}",
        ]
        for name, score in (("classic", held.classic), ("joint", held.joint))
    ]
    columns = ["", "rms error", "rms of block means", "inside 95 %", "log density"]
    return TableView(f"angles of {len(held.predictions)} experiments left out by {held.by}, deg", columns, rows)


def point_budget_table(budget: Budget, caption: str = "uncertainty by cause") -> TableView:
    """What the uncertainty of a located point consists of, the largest share first."""
    order = np.argsort(-budget.share)
    rows = [
        [
            share_in_words(budget.causes[k]),
            f"{100 * budget.share[k]:.1f}",
            *(three_digits(np.sqrt(v)) for v in budget.variance_mm2[k]),
        ]
        for k in order[budget.share[order] >= SHARE_SHOWN]
    ]
    return TableView(caption, ["cause", "share %", "u(x) mm", "u(y) mm", "u(z) mm"], rows)


def pointing_table(model: PointingModel, joint: Mapping[str, tuple[float, float]] | None = None) -> TableView:
    """The terms of a head by least squares, beside those of a fit, value and sd, where there is one."""
    rows = []
    for name, value, error in zip(model.names, model.value.tolist(), model.standard_error.tolist(), strict=True):
        row = [name_in_words(name), concise(value, error)]
        if joint is not None:
            row += [concise(*joint[name]), f"{error / joint[name][1]:.2g}" if joint[name][1] > 0 else ""]
        rows.append(row)
    columns = ["term", "least squares (se)", *(["joint (sd)", "se / sd"] if joint is not None else [])]
    sizes = f"{two_digits(model.rms_deg)} deg = {two_digits(3600 * model.rms_deg)} arcsec"
    caption = f"pointing model without gears, {len(model.residual_deg)} sightings; RMS on the sphere {sizes}"
    return TableView(caption, columns, rows)

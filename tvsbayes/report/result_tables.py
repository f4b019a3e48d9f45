"""Tables shared by texts and the page: both estimators, their gap, predictions, budgets, limits.

Units are in captions and heads; numbers have two digits of their uncertainty (GUM 7.2.6).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from tvsbayes.display import concise
from tvsbayes.estimators.four_point import ClassicResult
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.experiments import name_of
from tvsbayes.instrument.parameters import HEADLINES, QUANTITIES, TERMS, names_of
from tvsbayes.metrology.look_budget import Budget
from tvsbayes.report.tables import (
    TableView,
    interval_text,
    percent,
    present,
    sentences,
    share_in_words,
    signed,
    table,
    three_digits,
)
from tvsbayes.results.comparison_record import Gap, HoldOut
from tvsbayes.results.estimates import Estimate, FitSummary, PeriodEstimate

KEY_PARAMETERS = (
    *(quantity.name for quantity in HEADLINES if quantity.label and not quantity.ratio),
    *names_of("stop_sd_deg", "look_scatter_deg", "pixel_scale"),
)
"""Parameters of the last table of a fit."""
HEAD_PARAMETERS = tuple(term.name for term in TERMS)
"""The terms of a head, which follow them."""
MORE_PARAMETERS = names_of("mirror_offset_mm", "extrinsics.rotation_rad", "extrinsics.translation_mm", "home_sd_deg")
"""Parameters of the table of details."""
GEAR_SCALES = names_of(
    *("transmission_error_deg", "transmission_error_length_deg", "play_variation_deg", "drift_deg_per_root_hour"),
    *("creep_deg", "thermal_deg_per_K", "harmonic_amplitude_deg"),
)
"""Scales of repeated errors of the gears and of drifts of the zeros."""
SHARE_SHOWN = 5e-4
"""Least share of a variance in a table: smaller shares are printed as 0.0 %."""
ESTIMATE_COLUMNS = ("quantity", "value(u)", "95 % interval", "set by")
"""Columns of `estimate_row`."""
WAVES = "waves, given that they are there"


def classic_table(result: ClassicResult) -> TableView:
    """The classic estimator by direction."""
    rows = []
    for direction in DIRECTIONS:
        r = result.directions[direction]
        if r is None:
            rows.append([direction, "0", "no experiment", "", "", ""])
            continue
        sd, u = ("-" if x is None else f"{x:.6f}" for x in (r.sd_deg_per_step, r.u_type_a_deg_per_step))
        # The digits of the interval follow its own u.
        gum = "-" if r.interval95_gum is None else interval_text(*r.interval95_gum, r.u_gum_deg_per_step or 0.0)
        rows.append([direction, str(r.n), f"{r.mean_deg_per_step:.6f}", sd, u, gum])
    columns = ["direction", "n", "mean deg/step", "sd", "u type A", "95 % interval (GUM)"]
    return TableView("classic four-point estimator", columns, rows)


def outlier_lines(result: ClassicResult) -> list[str]:
    """Every experiment that makes the sd of its direction, and what the sd is without it."""
    lines = []
    for direction, r in result.directions.items():
        if r is not None and r.sd_deg_per_step is not None and (one := r.outlier) is not None:
            lines.append(
                f"Experiment {name_of(direction, one.experiment)} with {one.deg_per_step:.6f} deg/step makes the sd: "
                f"{r.sd_deg_per_step:.6f}, without it {one.sd_without_deg_per_step:.6f} and mean "
                f"{one.mean_without_deg_per_step:.6f} (Grubbs' test, p {one.p:.1g})."
            )
            lines += [sentences("first_beam_alone")[one.play_alone]] if one.play_alone else []
    return lines


def estimate_row(label: str, estimate: Estimate | None, unit: str) -> list[str]:
    """Cells of one quantity: name with unit, value(u), interval, and whether data or prior set it."""
    label = f"{label}, {unit}" if unit else label
    if estimate is None:
        return [label, "never moved", "", ""]
    origin = "fixed" if estimate.contraction is None else "data" if estimate.informed else "prior"
    interval = interval_text(*estimate.interval95, estimate.sd)
    return [label, concise(estimate.value, estimate.sd), interval, origin]


def _estimates(caption: str, estimates: Mapping[str, Estimate | None], names: Iterable[str]) -> TableView:
    """Those of the named quantities that there are."""
    quantities = [QUANTITIES[name] for name in names if name in estimates]
    rows = [estimate_row(quantity.label, estimates[quantity.name], quantity.unit_text) for quantity in quantities]
    return TableView(caption, ESTIMATE_COLUMNS, rows)


def headline_table(summary: FitSummary) -> TableView:
    """Ratios, contrasts and key parameters of the joint estimator: the last table of a fit."""
    pose = summary.reference_pose_deg
    kind = {"laplace": "Laplace", "posterior": "posterior"}[summary.estimator]
    title = f"joint estimator ({kind}) at pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} deg"
    estimates = {f"effective_deg_per_step.{part}": e for part, e in summary.effective.items()}
    estimates |= {
        f"effective_contrast_deg_per_step.{part}": e for part, e in summary.contrasts.items() if e is not None
    }
    estimates |= {n: summary.parameters[n] for n in (*KEY_PARAMETERS, *HEAD_PARAMETERS) if n in summary.parameters}
    in_sums = {name for weak in summary.weak_directions if weak.of_sums for name in weak.loadings}
    view = _estimates(title, estimates, estimates)
    rows = [[*row[:-1], "sum"] if name in in_sums else row for name, row in zip(estimates, view.rows, strict=True)]
    return replace(view, rows=rows)


def details_table(summary: FitSummary) -> TableView | None:
    """Pose of the positioner, and L; None for a head with sightings, which has no camera frame."""
    caption = "the positioner in frame S (the left camera's)"
    return present(_estimates(caption, summary.parameters, MORE_PARAMETERS))


def gears_table(summary: FitSummary) -> TableView | None:
    """Scales of the gears' errors of both axes; None for perfect gears."""
    names = [name for name in GEAR_SCALES if name in summary.parameters]
    if not any(name.startswith(("transmission", "play", "harmonic")) for name in names):
        return None
    return _estimates("gears: what repeats by position", summary.parameters, names)


def range_text(summary: FitSummary) -> str:
    """Range of counters of the effective ratios."""
    return ", ".join(f"{axis} {low} to {high}" for axis, (low, high) in summary.range_steps.items()) + " steps"


def waves_table(waves: Iterable[tuple[str, PeriodEstimate, str]], unit: str, zero: str) -> TableView | None:
    """Waves with name and unit of the period; None where there are none.

    `unit` is that of the amplitude, `zero` where the phase is counted from.
    """

    def period(wave: PeriodEstimate) -> str:
        return f"{wave.period.value:.10g}" if wave.source == "stated" else concise(wave.period.value, wave.period.sd)

    def ends(of: Estimate) -> str:
        return interval_text(*of.interval95, of.sd)

    columns = {
        "": lambda row: row[0],
        "amplitude(u) every period(u)": lambda row: (
            f"{concise(row[1].amplitude.value, row[1].amplitude.sd)} {unit} every {period(row[1])} {row[2]}"
        ),
        "amplitude, 95 %": lambda row: ends(row[1].amplitude),
        "period, 95 %": lambda row: "stated" if row[1].source == "stated" else ends(row[1].period),
        "phase(u), deg": lambda row: concise(row[1].phase_deg.value, row[1].phase_deg.sd),
        "there is a wave": lambda row: percent(row[1].probability),
    }
    return present(table(f"{WAVES}; phase at {zero} 0", waves, columns))


def rig_waves_table(summary: FitSummary) -> TableView | None:
    """Waves of the periods that the rig states; None where there are none."""
    return waves_table([(wave.axis, wave, "deg") for wave in summary.periods], "deg", "counter")


def gap_table(gaps: Mapping[str, Gap | None]) -> TableView:
    """The gap between both estimators by its terms, for the directions that have one."""
    stated = {direction: gap for direction, gap in gaps.items() if gap is not None}
    first = next(iter(stated.values()))
    rows = [
        ["classic mean", *(f"{gap.classic:.6f}" for gap in stated.values())],
        ["effective ratio (joint)", *(concise(gap.joint.value, gap.joint.sd) for gap in stated.values())],
        ["classic - joint", *(signed(gap.total.value, gap.total.sd) for gap in stated.values())],
        *(
            [f"  {term.name}", *(signed(gap.terms[k].value, gap.terms[k].sd) for gap in stated.values())]
            for k, term in enumerate(first.terms)
        ),
    ]
    return TableView("why the classic differs from the joint, deg/step, value(u)", ["", *stated], rows)


def hold_out_table(hold_out: HoldOut) -> TableView | None:
    """Predictions of left-out angles by both estimators; None where there are none."""
    if hold_out.classic is None or hold_out.joint is None:
        return None
    columns = {
        "": lambda row: row[0],
        "rms error": lambda row: f"{row[1].rms_deg:.3f}",
        "rms of block means": lambda row: f"{row[1].rms_block_deg:.3f}",
        "inside 95 %": lambda row: f"{100 * row[1].coverage:.0f} %",
        "log density": lambda row: f"{row[1].log_density:+.2f}",
    }
    caption = f"angles of {len(hold_out.predictions)} experiments left out by {hold_out.by}, deg"
    return table(caption, (("classic", hold_out.classic), ("joint", hold_out.joint)), columns)


def point_budget_table(budget: Budget, caption: str = "uncertainty by cause") -> TableView:
    """Uncertainty of a located point by cause, the largest share first."""
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

"""Tables shared by texts and the page: both estimators, their gap, predictions, budgets of a point.

Units are in captions and heads; numbers have two digits of their uncertainty (GUM 7.2.6).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from tvsbayes.display import concise
from tvsbayes.estimators.four_point import ClassicResult
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.experiments import name_of
from tvsbayes.instrument.parameters import HEAD_TERMS, HEADLINES, QUANTITIES, names_of
from tvsbayes.metrology.look_budget import Budget
from tvsbayes.report.parameter_words import share_in_words
from tvsbayes.report.tables import TableView, interval_text, signed, three_digits
from tvsbayes.results.comparison_record import Gap, GapTerm, HoldOut
from tvsbayes.results.estimates import Estimate, FitSummary, PeriodEstimate

KEY_PARAMETERS = (
    *(quantity.name for quantity in HEADLINES if quantity.label and not quantity.ratio),
    *names_of("stop_sd_deg", "look_scatter_deg", "pixel_scale"),
)
"""Parameters of the last table of a fit."""
HEAD_PARAMETERS = tuple(term.name for term in HEAD_TERMS.values())
"""The terms of a head, which follow them."""
MORE_PARAMETERS = names_of("mirror_offset_mm", "extrinsics.rotation_rad", "extrinsics.translation_mm", "home_sd_deg")
"""Parameters of the table of details."""
SHARE_SHOWN = 5e-4
"""Least share of a variance in a table: smaller shares are printed as 0.0 %."""


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
        # The digits of the interval follow its own u.
        gum = "-" if r.interval95_gum is None else interval_text(*r.interval95_gum, r.u_gum_deg_per_step or 0.0)
        rows.append([direction, str(r.n), f"{r.mean_deg_per_step:.6f}", sd, u, gum])
    columns = ["direction", "n", "mean deg/step", "sd", "u type A", "95 % interval (GUM)"]
    return TableView("classic four-point estimator", columns, rows)


PLAY_ALONE = {
    "cleared": "Its first beam alone was approached in the direction of its steps: they lost no play.",
    "reversed": "Its first beam alone was approached against the direction of its steps: they lost the play.",
    "unknown": "How its first beam alone was approached is not known: its steps may have lost no play.",
}


def outlier_lines(result: ClassicResult) -> list[str]:
    """Every experiment that makes the sd of its direction, and what the sd is without it."""
    lines = []
    for direction, r in result.directions.items():
        if r is None or r.sd_deg_per_step is None or (one := r.outlier) is None:
            continue
        lines.append(
            f"Experiment {name_of(direction, one.experiment)} with {one.deg_per_step:.6f} deg/step makes the sd: "
            f"{r.sd_deg_per_step:.6f}, without it {one.sd_without_deg_per_step:.6f} and mean "
            f"{one.mean_without_deg_per_step:.6f} (Grubbs' test, p {one.p:.1g})."
        )
        lines += [PLAY_ALONE[one.play_alone]] if one.play_alone else []
    return lines


ESTIMATE_COLUMNS = ("quantity", "value(u)", "95 % interval", "set by")
"""Columns of `estimate_row`."""


def estimate_row(label: str, estimate: Estimate | None, unit: str) -> list[str]:
    """Cells of one quantity: name with unit, value(u), interval, and whether data or prior set it."""
    label = f"{label}, {unit}" if unit else label
    if estimate is None:
        return [label, "never moved", "", ""]
    origin = "fixed" if estimate.contraction is None else ("data" if estimate.informed else "prior")
    interval = interval_text(*estimate.interval95, estimate.sd)
    return [label, concise(estimate.value, estimate.sd), interval, origin]


def _estimate_rows(estimates: Mapping[str, Estimate | None], names: Iterable[str]) -> list[list[str]]:
    """Rows of those of the named quantities that there are."""
    quantities = (QUANTITIES[name] for name in names if name in estimates)
    return [estimate_row(quantity.label, estimates[quantity.name], quantity.unit_text) for quantity in quantities]


def headline_table(summary: FitSummary) -> TableView:
    """Ratios, contrasts and key parameters of the joint estimator: the last table of a fit."""
    pose = summary.reference_pose_deg
    estimates = {f"effective_deg_per_step.{part}": e for part, e in summary.effective.items()}
    estimates |= {
        f"effective_contrast_deg_per_step.{part}": e for part, e in summary.contrasts.items() if e is not None
    }
    estimates |= {n: summary.parameters[n] for n in (*KEY_PARAMETERS, *HEAD_PARAMETERS) if n in summary.parameters}
    kind = {"laplace": "Laplace", "posterior": "posterior"}[summary.estimator]
    title = f"joint estimator ({kind}) at pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} deg"
    in_sums = {name for weak in summary.weak_directions if weak.of_sums for name in weak.loadings}
    rows = _estimate_rows(estimates, estimates)
    rows = [[*row[:-1], "sum"] if name in in_sums else row for name, row in zip(estimates, rows, strict=True)]
    return TableView(title, ESTIMATE_COLUMNS, rows)


def details_table(summary: FitSummary) -> TableView:
    """Pose of the positioner, and L."""
    rows = _estimate_rows(summary.parameters, MORE_PARAMETERS)
    return TableView("the positioner in frame S (the left camera's)", ESTIMATE_COLUMNS, rows)


def range_text(summary: FitSummary) -> str:
    """Range of counters of the effective ratios."""
    return ", ".join(f"{axis} {low} to {high}" for axis, (low, high) in summary.range_steps.items()) + " steps"


GEAR_SCALES = names_of(
    *("transmission_error_deg", "transmission_error_length_deg", "play_variation_deg", "drift_deg_per_root_hour"),
    *("creep_deg", "thermal_deg_per_K", "harmonic_amplitude_deg"),
)
"""Scales of repeated errors of the gears and of drifts of the zeros."""


def gears_table(summary: FitSummary) -> TableView | None:
    """Scales of the gears' errors of both axes; None for perfect gears."""
    names = [name for name in GEAR_SCALES if name in summary.parameters]
    if not any(name.startswith(("transmission", "play", "harmonic")) for name in names):
        return None
    return TableView("gears: what repeats by position", ESTIMATE_COLUMNS, _estimate_rows(summary.parameters, names))


WAVES = "waves, given that they are there"
WAVE_COLUMNS = [
    *("", "amplitude(u) every period(u)", "amplitude, 95 %", "period, 95 %"),
    *("phase(u), deg", "there is a wave"),
]


def wave_row(name: str, wave: PeriodEstimate, unit: str, period_unit: str) -> list[str]:
    """A row of `WAVE_COLUMNS`; `unit` is that of the amplitude."""
    stated = wave.source == "stated"
    period = f"{wave.period.value:.10g}" if stated else concise(wave.period.value, wave.period.sd)
    amplitude = f"{concise(wave.amplitude.value, wave.amplitude.sd)} {unit}"
    amplitude95 = interval_text(*wave.amplitude.interval95, wave.amplitude.sd)
    period95 = "stated" if stated else interval_text(*wave.period.interval95, wave.period.sd)
    phase = concise(wave.phase_deg.value, wave.phase_deg.sd)
    return [name, f"{amplitude} every {period} {period_unit}", amplitude95, period95, phase, percent(wave.probability)]


def percent(probability: float) -> str:
    """A probability from draws, never printed as 0 or 100 %."""
    return "> 99.9 %" if probability > 0.999 else "< 0.1 %" if probability < 0.001 else f"{100 * probability:.1f} %"


def waves_table(summary: FitSummary) -> TableView | None:
    """Waves of the periods that the rig states; None where there are none."""
    rows = [wave_row(wave.axis, wave, "deg", "deg") for wave in summary.periods]
    return TableView(f"{WAVES}; phase at counter 0", WAVE_COLUMNS, rows) if rows else None


def gap_table(gaps: Mapping[str, Gap | None]) -> TableView:
    """The gap between both estimators by its terms, for the directions that have one."""
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


def hold_out_table(hold_out: HoldOut) -> TableView | None:
    """Predictions of left-out angles by both estimators; None where there are none."""
    if hold_out.classic is None or hold_out.joint is None:
        return None
    rows = [
        [
            name,
            f"{score.rms_deg:.3f}",
            f"{score.rms_block_deg:.3f}",
            f"{100 * score.coverage:.0f} %",
            f"{score.log_density:+.2f}",
        ]
        for name, score in (("classic", hold_out.classic), ("joint", hold_out.joint))
    ]
    columns = ["", "rms error", "rms of block means", "inside 95 %", "log density"]
    return TableView(f"angles of {len(hold_out.predictions)} experiments left out by {hold_out.by}, deg", columns, rows)


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

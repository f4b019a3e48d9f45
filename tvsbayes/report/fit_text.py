"""What people and programs get to see of an estimate: text tables, `value(u)`, `results/`, the HTML report.

Formats only; every number is computed elsewhere. Units are those of DESIGN 8. The report is one page: no script,
nothing fetched. Text of a campaign reaches it through jinja2's autoescape only; pictures are SVG inside `data:`
images, which browsers open without scripts and without network. Its policy (CSP) allows exactly its own style sheet,
by hash, and such images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

from tvsbayes.errors import listed
from tvsbayes.estimators.four_point import ClassicResult
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.report.tables import concise, interval_text, text_table

if TYPE_CHECKING:
    from tvsbayes.results.estimates import Estimate, FitSummary


SPOTS_LISTED = 20
KEY_PARAMETERS = (
    ("backlash_deg.pan", "backlash pan", "deg"),
    ("backlash_deg.tilt", "backlash tilt", "deg"),
    ("effective_mirror_offset_mm", "mirror offset (effective)", "mm"),
    ("mirror_offset_mm", "mirror offset L", "mm"),
    ("extrinsics.rotation_rad.x", "extrinsics rotation x", "rad"),
    ("extrinsics.rotation_rad.y", "extrinsics rotation y", "rad"),
    ("extrinsics.rotation_rad.z", "extrinsics rotation z", "rad"),
    ("extrinsics.translation_mm.x", "extrinsics translation x", "mm"),
    ("extrinsics.translation_mm.y", "extrinsics translation y", "mm"),
    ("extrinsics.translation_mm.z", "extrinsics translation z", "mm"),
    ("stop_sd_deg.left", "stop sd left", "deg"),
    ("stop_sd_deg.right", "stop sd right", "deg"),
    ("stop_sd_deg.up", "stop sd up", "deg"),
    ("stop_sd_deg.down", "stop sd down", "deg"),
    ("pixel_scale", "pixel noise / stated", ""),
)


def classic_text(result: ClassicResult) -> str:
    """The classic estimator's table."""
    rows = []
    for direction in DIRECTIONS:
        r = result.directions[direction]
        if r is None:
            rows.append([direction, "0", "no experiment", "", "", ""])
            continue
        optional = (r.sd_deg_per_step, r.u_type_a_deg_per_step)
        sd, u = ("-" if x is None else f"{x:.6f}" for x in optional)
        gum = "-" if r.interval95_gum is None else interval_text(*r.interval95_gum, r.u_gum_deg_per_step)
        rows.append([direction, str(r.n), f"{r.mean_deg_per_step:.6f}", sd, u, gum])
    columns = ["direction", "n", "mean deg/step", "sd", "u type A", "95 % interval (GUM)"]
    return text_table("classic four-point estimator", columns, rows)


def estimate_row(label: str, estimate: Estimate | None, unit: str) -> list[str]:
    """Cells of one quantity: value(u), unit, interval, and whether data or prior set it."""
    if estimate is None:
        return [label, "never moved", unit, "", ""]
    origin = "fixed" if estimate.contraction is None else ("data" if estimate.informed else "prior")
    interval = interval_text(*estimate.interval95, estimate.sd)
    return [label, concise(estimate.value, estimate.sd), unit, interval, origin]


def fit_text(summary: FitSummary) -> str:
    """The joint estimator's table and everything the reader must know about it."""
    if not summary.converged and summary.sampling is None:
        return astray_text(summary)
    pose = summary.reference_pose_deg
    rows = [estimate_row(f"effective {d}", summary.effective[d], "deg/step") for d in DIRECTIONS]
    for axis, label in (("pan", "left - right"), ("tilt", "up - down")):
        if summary.contrasts[axis] is not None:
            rows.append(estimate_row(label, summary.contrasts[axis], "deg/step"))
    rows += [estimate_row(label, summary.parameters[name], unit) for name, label, unit in KEY_PARAMETERS]
    kind = {"laplace": "Laplace", "posterior": "posterior"}[summary.estimator]
    title = f"joint estimator ({kind}) at pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} deg"
    lines = [text_table(title, ["quantity", "value(u)", "unit", "95 % interval", "set by"], rows)]
    lines.append(f"chi2 {summary.chi2:.1f} for {summary.dof:.1f} degrees of freedom")
    if summary.validation is not None:
        told = validation_lines(summary.validation.as_json())
        lines += told
        if not summary.validation.passed:
            # Above and below the table: who reads either end of the text must meet it.
            lines.insert(0, told[0])
    predicted = [f"{d} {concise(e.value, e.sd)}" for d, e in summary.classic_predicted.items() if e is not None]
    if predicted:
        lines.append(f"the classic estimator should report, deg/step: {', '.join(predicted)}")
    if summary.sampling is not None:
        lines.append(sampling_line(summary.sampling))
    if summary.curves is not None:
        lines += lost_motion_lines(summary.curves["lost_motion"])
    for entry in summary.prior_sensitivity:
        word = "twice" if entry.factor > 1 else "half"
        lines.append(
            f"prior: with {word} the u of {entry.parameter}, {entry.quantity} moves {entry.shift_sd:+.2f} sd and its "
            f"sd changes by a factor {entry.sd_ratio:.2f}"
        )
    if summary.few_stops:
        lines.append(few_stops_line(summary.few_stops, summary.estimator))
    lines += [f"weak: {weak.text}" for weak in summary.weak_directions]
    lines += [f"leverage: {entry.text}" for entry in summary.leverage]
    lines += [f"prior conflict: {text}" for text in summary.prior_conflicts]
    if summary.excluded_spots:
        lines.append(f"excluded spots: {', '.join(map(str, summary.excluded_spots))}")
    if summary.suspect_spots:
        lines.append(f"{suspect_line(summary.suspect_spots)}; look at them, or fit with --robust")
    return "\n".join(lines)


def astray_text(summary: FitSummary) -> str:
    """Where a fit that did not converge stopped: values without uncertainty, for whoever looks for the reason."""
    rows = [[label, f"{summary.parameters[name].value:.4g}", unit] for name, label, unit in KEY_PARAMETERS]
    table = text_table("where the fit stopped: NOT results", ["quantity", "value", "unit"], rows)
    lines = [f"NOT CONVERGED: {'; '.join(summary.problems)}", table]
    if summary.suspect_spots:
        lines.append(suspect_line(summary.suspect_spots))
    return "\n".join(lines)


def suspect_line(spots: Sequence[int]) -> str:
    """Spots that others foretell badly, at most `SPOTS_LISTED` by their ids."""
    return f"spots that disagree with all others: {listed(spots, SPOTS_LISTED)}"


def few_stops_line(few: Mapping[str, int], estimator: str) -> str:
    """What few stops of a direction do to its intervals."""
    named = ", ".join(f"{direction} {count}" for direction, count in few.items())
    told = f"few stops ({named}): they hardly tell their own scatter"
    if estimator == "posterior":
        return f"{told}; the intervals hold it, more stops would shorten them"
    told += ", and the Laplace intervals of ratio and backlash are too short"
    return f"{told}; sample the posterior (fit without --no-sample), or add stops"


def validation_lines(validation: Mapping[str, object]) -> list[str]:
    """What the residuals say of the model: one line where they agree, else the warning and every test that failed.

    Args:
        validation: the entry of `fit.json`.
    """
    tests = validation["tests"]
    if validation["passed"]:
        if not tests:
            return ["validation: nothing can be asked of so few spots"]
        least = f"least p {tests[0]['p']:.2g} ({tests[0]['name']})"
        return [
            f"validation: no sign of a model error in {len(tests)} tests, {least}; shapes that gears, mirrors and "
            "play can take themselves are not seen"
        ]
    warning = f"VALIDATION FAILED: {validation['cause']} (p {tests[0]['p']:.1e}); the table is as fitted, multiply "
    warning += f"every u and half-width in it by {validation['inflation']:.2f}"
    return [
        warning,
        *(
            f"validation: {t['name']}, {t['where']}: chi2 {t['chi2']:.1f} for {t['dof']}, p {t['p']:.1e}; would move a "
            f"headline by {t['shift_sd']:.1f} of its u"
            for t in tests
            if t["failed"]
        ),
    ]


def sampling_line(sampling: dict[str, object]) -> str:
    """What stands behind a posterior, in one line."""
    rhat, ess, tail = (sampling[k] for k in ("worst_rhat", "least_ess_bulk", "least_ess_tail"))
    text = f"{sampling['walkers']} walkers, {sampling['steps']} steps ({sampling['discarded']} left out); worst R-hat "
    text += f"{rhat['value']:.3f} ({rhat['quantity']}), least effective draws {ess['value']:.0f} "
    text += f"({ess['quantity']}) and {tail['value']:.0f} in the tails ({tail['quantity']})"
    return text if sampling["converged"] else f"UNCONVERGED, the table is Laplace's: {text}"


def lost_motion_lines(lost: dict[str, list[dict[str, float]]]) -> list[str]:
    """Lost motion after a reversal, for the step counts that were used."""
    lines = []
    for direction, entries in lost.items():
        told = []
        for text, group in groupby(entries, lambda e: concise(e["value_deg"], e["sd_deg"])):
            steps = [e["steps"] for e in group]
            told.append(f"{steps[0]} {f'to {steps[-1]} ' * (len(steps) > 1)}steps {text}")
        lines.append(f"lost motion {direction}, deg: {', '.join(told)}")
    return lines


def demo_text(classic_result: ClassicResult, summary: FitSummary, truth: dict[str, float]) -> str:
    """Both estimators beside the truth of a simulated campaign."""

    def holds(interval, true):
        return "-" if interval is None else ("yes" if interval[0] <= true <= interval[1] else "NO")

    rows = []
    for direction in DIRECTIONS:
        c, j = classic_result.directions[direction], summary.effective[direction]
        if c is None or j is None:
            continue
        true = truth[direction]
        shown = concise(c.mean_deg_per_step, c.u_type_a_deg_per_step or 0.0)
        cells = [direction, shown, holds(c.interval95_type_a, true), concise(j.value, j.sd)]
        rows.append([*cells, holds(j.interval95, true), f"{true:.6f}"])
    columns = ["deg/step", "classic, type A", "holds truth", "joint", "holds truth", "truth"]
    ratios = text_table("degrees of beam per motor step, value(u)", columns, rows)
    rows = []
    for name, label, unit in KEY_PARAMETERS[:3]:
        e, true = summary.parameters[name], truth[name]
        rows.append([f"{label}, {unit}", concise(e.value, e.sd), holds(e.interval95, true), f"{true:.4f}"])
    others = text_table("what the classic estimator cannot see", ["", "joint", "holds truth", "truth"], rows)
    return f"{ratios}\n\n{others}"

"""Texts of `compensate` and `verify`: promise or verdict first, then its basis, then the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tvsbayes.compensation.verification import VerifyPlan
from tvsbayes.errors import escaped
from tvsbayes.instrument.axes import SIDES
from tvsbayes.report.document import Part, Section, sentence, terminal
from tvsbayes.report.tables import TableView, three_digits, two_digits
from tvsbayes.results.compensation_record import (
    APPLIED,
    BROKEN,
    CANNOT_TELL,
    CAUSES,
    NOT_APPLIED,
    OTHER_MACHINE,
    TWICE,
    WRONG_SIGN,
    AimedPromise,
    Compensation,
    Verification,
)

if TYPE_CHECKING:
    from tvsbayes.comparison.verified_looks import AimPlan

REMEDIES = {
    NOT_APPLIED: "the controller does not use the table, or not its play: is the file loaded, were the settings saved, "
    "does compensation start only after homing?",
    TWICE: "the table, or its play, acts in two places: remove one of them (a backlash setting beside the table?)",
    WRONG_SIGN: "the controller adds the correction instead of subtracting it, or forward and backward are exchanged",
    OTHER_MACHINE: "the table is of another machine, or this one changed: measure it again and compensate again",
    APPLIED: "readings lie farther off than the table allows: measure again, and compensate again if that persists",
}
"""Remedies by the most probable hypothesis, where the promise is broken."""
SCANNER_REMEDIES = {
    NOT_APPLIED: "counters follow the nominal degrees per step, or come without the run-up that takes up the play: use "
    "those of `tvsbayes steps-for` with `via_pan_steps` and `via_tilt_steps`, or the header's",
    TWICE: "the calibration acts in the host and in the controller: remove one of them",
    WRONG_SIGN: "the correction is subtracted instead of added, or left and right, up and down are exchanged",
    OTHER_MACHINE: "something moved, a counter has the other sign, or the calibration is of another machine: "
    "see `tvsbayes check FRESH` and `tvsbayes watch CAMPAIGN FRESH`",
    APPLIED: "looks lie farther off than the calibration allows: `tvsbayes watch CAMPAIGN FRESH` says what moved",
}
"""Remedies for a scanner."""
HELPS = {
    "homing": "the scatter of homings; read after several homings, or verify without homing in between",
    "stops": "the scatter of single stops; no table corrects that",
    "table": "the table itself; read more, at more positions",
    "format": "what the format cannot hold; csv, linuxcnc and header hold both sides by position",
    "drift": "the walk of the zero; home more often, or guide",
    "creep": "the creep of a zero that warms up; use it warm, or home it again",
    "temperature": "the shift with the temperature; read cold and warm, or keep the room steady",
    "travel": "a contrast of the directions; of gears whose teeth keep step state `ratio_contrast` 0, u 0 in [axis]",
    "readings": "the readings themselves; a better reference",
}
"""Remedies by the largest cause of the remaining error."""
AIMED_HELPS = {
    "homing": "the scatter of homings; look after several homings, or aim without homing in between",
    "table": "the calibration itself; look more, at more counters",
    "format": "what the format cannot hold, and whole steps; the header and `steps-for` hold both sides by counter",
    "travel": "a contrast of the directions; of gears whose teeth keep step state `ratio_contrast_deg_per_step` 0, u 0 "
    "in [rig.prior], else home after less travel",
}
"""The same for a scanner or head, where they differ."""
DRIVE_HELPS = {
    "format": "waves of other periods, which a table of one period does not hold",
    "drift": "the walk of the zero; guide",
}
"""The same for a drive at constant rate, where they differ."""
ABSOLUTE_HELPS = {
    "drift": "the walk of the zero, which no homing sets and a short campaign hardly shows, so that it is the prior's: "
    "read again on another day into the same folder, or state the drift",
}
"""The same for absolute encoders, where they differ."""


def promise_table(result: Compensation | AimedPromise) -> TableView:
    """Remaining error by side, and the error that each cause alone would leave; causes that leave none are left out."""
    sides = result.sides
    causes = [cause for cause in CAUSES if any(promise.causes.get(cause, 0.0) for promise in sides.values())]
    rows = []
    for side, promise in sides.items():
        sizes = [promise.without95, promise.error95, *(promise.causes.get(cause, 0.0) for cause in causes)]
        rows.append([side.removeprefix("arriving "), *map(two_digits, sizes)])
    shift = f", but for one shift common to all{_of_axes(result)}," if _shift_free(result) else ""
    caption = f"95 % of errors{shift} are at most, {escaped(result.unit)}; each cause alone"
    return TableView(caption, ["" if result.in_motion else "arriving", "without", "after", *causes], rows)


def sizes_table(verification: Verification) -> TableView:
    """Errors without the table and with it."""
    rows = [
        [
            "before (expected without the table)",
            two_digits(verification.before.rms),
            two_digits(verification.before.worst),
        ],
        ["after (read)", two_digits(verification.after.rms), two_digits(verification.after.worst)],
    ]
    if (homed := verification.after_with_homing) is not None:
        rows.append(["after, with the shift common to all", two_digits(homed.rms), two_digits(homed.worst)])
    columns = ["", "RMS", "worst"]
    if (points := verification.millimetres) is not None:
        columns += [f"RMS at {points.distance_mm:.10g} mm, mm", "worst, mm"]
        for row, size in zip(rows, (points.before, points.after, None), strict=False):
            row += ["", ""] if size is None else [two_digits(size.rms), two_digits(size.worst)]
    scope = " of both axes" * verification.looks + ", and of points" * (points is not None)
    return TableView(f"errors, {escaped(verification.unit)}{scope}", columns, rows)


def _promise_text(verification: Verification) -> str:
    mm = verification.millimetres
    points = "" if mm is None else f", of points at {mm.distance_mm:.10g} mm {two_digits(mm.promised95)} mm"
    unit, homed = escaped(verification.unit), verification.promised95_with_homing
    shift = "" if homed is None else ", but for one shift common to all,"
    with_homing = "" if homed is None else f"; with the error of a homing, by its prior, {two_digits(homed)} {unit}"
    return f"promised: 95 % of errors{shift} at most {two_digits(verification.promised95)} {unit}{points}{with_homing}"


def compensation_text(result: Compensation, written: Sequence[str] = ()) -> str:
    """A compensation as text."""
    unit, (low, high) = escaped(result.unit), result.range_command
    shift = ", but for one shift common to all" if result.zero_free else ""
    lines: list[Part] = [
        f"compensation for {result.target}: {len(result.table)} commands from {low:.10g} to {high:.10g}, in {unit}",
        f"aim: reading = {result.offset:.6g} + {result.per_command:.9g} x command{shift}",
        "",
        promise_table(result),
        "",
        *_validity(result),
        f"largest remaining error: {_help(result)}",
        *(f"the format: {text}" for text in result.unsaid),
    ]
    lines += _homing_remarks(result)
    lines.append(f"nothing is applied yet; apply it once, in one place, then {result.shown_by}")
    return terminal(*lines, *(f"written: {escaped(path, 200)}" for path in written))


def aimed_text(result: AimedPromise) -> str:
    """The promise of a calibration as text."""
    what = {"header": "header and `steps-for`", "urdf": "URDF"}.get(result.target, result.target)
    counters = [f"{axis} {low:.10g} to {high:.10g}" for axis, (low, high) in result.range_steps.items()]
    travel = " and ".join(f"{steps:.4g} steps of {axis}" for axis, steps in result.travel_steps.items())
    run_up = " and ".join(f"{steps} steps of {axis}" for axis, steps in result.reversal_steps.items())
    return terminal(
        f"aimed by its calibration ({what}), counters {', '.join(counters)}",
        "",
        promise_table(result),
        "",
        f"the promise holds between these counters, within {two_digits(result.hours)} h and {travel} of travel "
        f"{_since(any(result.homings.values()))}{_kelvin(result)}",
        f"arrive with at least {run_up} of travel on a side",
        f"largest remaining error: {_help(result)}",
        *_homing_remarks(result),
    )


def aimed_words(result: AimedPromise) -> str:
    """The promise of a calibration in a sentence."""
    sizes = ", ".join(f"{side} {two_digits(each.error95)}" for side, each in result.sides.items())
    homed = ", ".join(f"{side} {two_digits(each.error95_with_homing or 0.0)}" for side, each in result.sides.items())
    shift = f", but for one shift common to all{_of_axes(result)}," if result.free_axes else ""
    with_homing = f"; with the next homing's error: {homed}" if result.free_axes else ""
    return f"Promise: 95 % of errors{shift} at most, {escaped(result.unit)}, arriving {sizes}{with_homing}."


def _shift_free(result: Compensation | AimedPromise) -> bool:
    return bool(result.free_axes) if isinstance(result, AimedPromise) else result.shift_free


def _of_axes(result: Compensation | AimedPromise) -> str:
    """The axes whose errors are less a shift, where there are two."""
    return f" of {' and of '.join(result.free_axes)}" if isinstance(result, AimedPromise) else ""


def _help(result: Compensation | AimedPromise) -> str:
    """The largest cause of the remaining error, with its remedy."""
    counted = [cause for cause in CAUSES if cause != "homing" or not _shift_free(result)]
    largest = max(counted, key=lambda cause: max(left.causes.get(cause, 0.0) for left in result.sides.values()))
    own = AIMED_HELPS if isinstance(result, AimedPromise) else DRIVE_HELPS if result.in_motion else {}
    homed = any(result.homings.values()) if isinstance(result, AimedPromise) else result.homings
    return (HELPS | own | ({} if homed else ABSOLUTE_HELPS))[largest]


def _since(homed: bool) -> str:
    return "since homing" if homed else "after the campaign, from whose first move on the absolute zero walks"


def _kelvin(result: Compensation | AimedPromise) -> str:
    low, high = result.kelvin or (0.0, 0.0)
    return f", at temperatures as read, over {two_digits(high - low)} K" if result.kelvin else ""


def _homing_remarks(result: Compensation | AimedPromise) -> list[str]:
    """What the promise rests on where one homing alone was read, and what the next one may add."""
    if not (result.free_axes if isinstance(result, AimedPromise) else result.shift_matters):
        return []
    homed = [
        f"{side} {two_digits(promise.error95_with_homing)}"
        for side, promise in result.sides.items()
        if promise.error95_with_homing is not None
    ]
    remark = "one homing was read: the promise is of errors but for one shift common to all, as within one homing"
    where = "home_sd_deg in [rig.prior]" if isinstance(result, AimedPromise) else "home_sd in [axis]"
    prior = f"with the next homing's error, which its prior alone determines, {where}, 95 % are at most: "
    return [f"{remark}; {prior}{', '.join(homed)} {escaped(result.unit)}"]


def _validity(result: Compensation) -> list[str]:
    """Validity of the promise, in words."""
    if result.in_motion:
        travel, added = f"{result.travel_command:.6g}", [row.add_forward for row in result.table]
        size = three_digits(abs(result.per_command) * (max(added) - min(added)))
        seconds = f", {result.settings['period_s']:.5g} s" if "period_s" in result.settings else ""
        return [
            f"the promise holds within {travel} commands, off the drive's own line, but for one shift",
            f"the error that repeats every {result.settings['period_command']:.6g} commands{seconds}: {size} "
            f"{escaped(result.unit)} peak to peak",
        ]
    return [
        f"the promise holds between these commands, within {two_digits(result.hours)} h and "
        f"{result.travel_command:.4g} commands of travel {_since(bool(result.homings))}{_kelvin(result)}",
        f"arrive with at least {result.reversal_command:.4g} commands of travel on a side",
    ]


def verification_text(verification: Verification) -> str:
    """A verification as text."""
    p = "< 0.0003" if verification.p < 3e-4 else f"= {verification.p:.2g}"
    rows = [[name, f"{100 * chance:.1f} %"] for name, chance in verification.worlds.items()]
    what, kind, under, remedies = "table", "readings", "under the table", REMEDIES
    if verification.looks:
        what, kind, under, remedies = "calibration", "looks", "that the calibration aimed", REMEDIES | SCANNER_REMEDIES
    lines: list[Part] = [
        f"{verification.verdict}: {verification.world} (p {p})",
        "",
        TableView(f"{verification.readings} {kind} {under}", [f"the {what} was", "probability"], rows),
        "",
        sizes_table(verification),
        _promise_text(verification),
        *verification.remarks,
    ]
    if verification.verdict == BROKEN:
        lines.append(f"what to do: {remedies[verification.world]}")
    elif verification.verdict == CANNOT_TELL and verification.needed is None:
        lines.append(
            "no number of such readings decides: the correction is smaller than the uncertainty of homing and fit"
        )
    elif verification.verdict == CANNOT_TELL:
        more = f"about {verification.needed} {kind} of this kind" if verification.needed else f"some more {kind}"
        lines.append(f"what to do: take {more}; `tvsbayes plan --verify FOLDER` lists the most informative")
    return terminal(*lines)


APPLIED_TITLE = "Applied correction and remaining error"


def compensation_section(result: Compensation, verification: Verification | None) -> Section:
    """Section of the report: the compensation, its promise, and its verification by fresh readings."""
    low, high = result.range_command
    text = [
        f"Made for {result.target}, to be applied by the {result.applied_by}, for commands from {low:.10g} to "
        f"{high:.10g}; {'; '.join(_validity(result)[: 1 + result.in_motion])}.",
        "No fresh readings have verified it." if verification is None else _verdict(verification),
    ]
    tables = [promise_table(result), *([] if verification is None else [sizes_table(verification)])]
    return Section(APPLIED_TITLE, text, [*result.unsaid, *_homing_remarks(result)], tables)


def verified_section(verification: Verification) -> Section:
    """Section of a scanner's report: verification by fresh looks aimed with its calibration, points in mm."""
    text = "Counters by `tvsbayes steps-for` or the header, held against fresh looks. " + _verdict(verification)
    return Section(APPLIED_TITLE, [text], tables=[sizes_table(verification)])


def _verdict(verification: Verification) -> str:
    kind = "readings" if verification.millimetres is None else "looks"
    text = f"{verification.verdict}: {verification.readings} fresh {kind}, "
    text += f"most probable: {verification.world}, p = {verification.p:.2g}."
    return f"{text} {sentence(_promise_text(verification))}"


def verify_plan_text(plan: VerifyPlan) -> str:
    """A plan of readings that verify a table, as text."""
    rows = [[f"{command:.10g}", "forward" if side > 0 else "backward"] for command, side in plan.stops]
    table = TableView(f"{len(rows)} readings with the table in force, in this order", ["command", "arriving"], rows)
    return terminal(table, f"to arrive on a side, come from at least {plan.run_up:.4g} commands away", _power(plan))


def aim_plan_text(plan: AimPlan) -> str:
    """A plan of looks that verify a calibration, as text."""
    rows = [[str(p), str(t), SIDES["pan"][ps > 0], SIDES["tilt"][ts > 0]] for p, t, ps, ts in plan.stops]
    columns = ["pan", "tilt", "arriving", ""]
    table = TableView(
        f"{len(rows)} looks with the calibration in force, in this order, from a homing on", columns, rows
    )
    pan, tilt = plan.run_up
    run_up = f"to arrive on a side, come from at least {pan} steps of pan and {tilt} of tilt away"
    return terminal(table, run_up, _power(plan))


def _power(plan: VerifyPlan | AimPlan) -> str:
    """Whether a plan separates the hypotheses, in words."""
    if plan.enough:
        return f"they separate the hypotheses in 95 % of cases: {plan.distance:.1f} standard deviations"
    return f"they do not separate the hypotheses: the nearest two are {plan.distance:.1f} standard deviations apart"

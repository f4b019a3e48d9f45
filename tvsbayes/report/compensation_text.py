"""What `compensate` and `verify` print: promise or verdict first, then what stands behind it, then what to do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tvsbayes.compensation.verification import VerifyPlan
from tvsbayes.errors import escaped
from tvsbayes.instrument.axes import SIDES
from tvsbayes.report.document import Part, Section, terminal
from tvsbayes.report.tables import TableView, two_digits
from tvsbayes.results.compensation_record import (
    APPLIED,
    BROKEN,
    CANNOT_TELL,
    CAUSES,
    NOT_APPLIED,
    OTHER_MACHINE,
    TWICE,
    WRONG_SIGN,
    Compensation,
    Verification,
)

if TYPE_CHECKING:
    from tvsbayes.comparison.verified_looks import AimPlan

REMEDIES = {
    NOT_APPLIED: "the controller does not use the table, or not its play: is the file loaded, were the settings saved, "
    "does compensation start only after homing?",
    TWICE: "the table, or its play, acts in two places: take one of them out (a backlash setting beside the table?)",
    WRONG_SIGN: "the controller adds what it is to take off, or holds forward and backward in each other's place",
    OTHER_MACHINE: "the table is of another machine, or this one changed: measure it again and compensate anew",
    APPLIED: "readings lie farther off than the table allows: measure again, and compensate anew if that stays",
}
"""By the world that fits best, where the promise is broken."""
SCANNER_REMEDIES = {
    NOT_APPLIED: "counters follow the nominal degrees per step, or come without the run-up that takes up the play: use "
    "those of `tvsbayes steps-for` with `via_pan_steps` and `via_tilt_steps`, or the header's",
    TWICE: "the calibration acts in the host and in the controller: take one of them out",
    WRONG_SIGN: "the correction is taken off instead of added, or left and right, up and down are exchanged",
    OTHER_MACHINE: "something moved, a counter has the other sign, or the calibration is of another machine: "
    "`tvsbayes check FRESH` and `tvsbayes watch CAMPAIGN FRESH` tell",
    APPLIED: "looks lie farther off than the calibration allows: `tvsbayes watch CAMPAIGN FRESH` says what moved",
}
"""The same of a scanner."""
HELPS = {
    "homing": "the scatter of homings; read after several homings, or verify without homing in between",
    "stops": "the scatter of single stops; no table takes that out",
    "table": "the table itself; read more, at more positions",
    "format": "what the format cannot hold; csv, linuxcnc and header hold both sides by position",
    "drift": "the walk of the zero; home more often, or guide",
    "readings": "the readings themselves; a better reference",
}
"""What the largest cause of what is left is, and what takes it down."""


def promise_table(made: Compensation) -> TableView:
    """What is left by side, and what each cause alone would leave."""
    rows = []
    for side, left in made.promise.items():
        causes = [two_digits(left.causes[cause]) for cause in CAUSES]
        rows.append([side, two_digits(left.without95), two_digits(left.error95), *causes])
    caption = f"95 % of errors are at most, {escaped(made.unit)}; each cause alone"
    return TableView(caption, ["arriving", "without", "after applying", *CAUSES], rows)


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
    columns = ["", "RMS", "worst"]
    if (at := verification.millimetres) is not None:
        columns += [f"RMS at {at.distance_mm:.10g} mm, mm", "worst, mm"]
        for row, size in zip(rows, (at.before, at.after), strict=True):
            row += [two_digits(size.rms), two_digits(size.worst)]
    of = " of both axes" * verification.looks + ", and of points" * (at is not None)
    return TableView(f"errors, {escaped(verification.unit)}{of}", columns, rows)


def _promised(verification: Verification) -> str:
    at = verification.millimetres
    points = "" if at is None else f", of points at {at.distance_mm:.10g} mm {two_digits(at.promised95)} mm"
    return (
        f"promised: 95 % of errors at most {two_digits(verification.promised95)} {escaped(verification.unit)}{points}"
    )


def compensation_text(made: Compensation, written: Sequence[str] = ()) -> str:
    """A compensation for people."""
    unit, (low, high) = escaped(made.unit), made.range_command
    largest = max(CAUSES, key=lambda cause: max(left.causes[cause] for left in made.promise.values()))
    shift = ", but for one shift common to all" if made.zero_free else ""
    lines: list[Part] = [
        f"compensation for {made.target}: {len(made.table)} commands from {low:.10g} to {high:.10g}, in {unit}",
        f"aim: reading = {made.offset:.6g} + {made.per_command:.9g} x command{shift}",
        "",
        promise_table(made),
        "",
        *_where(made),
        f"most of what is left: {HELPS[largest]}",
        *(f"the format: {text}" for text in made.unsaid),
    ]
    if made.homings == 1 and not made.in_motion:
        lines.append("one homing alone was read: how far the next one is off is known by its prior; home_sd in [axis]")
        left = [
            f"{side} {two_digits(p.shift_free95)}" for side, p in made.promise.items() if p.shift_free95 is not None
        ]
        if left and not made.zero_free:
            lines.append(f"but for one shift common to all, as within one homing, at most: {', '.join(left)} {unit}")
    lines.append(f"nothing is applied yet; apply it once, in one place, then {made.shown_by}")
    return terminal(*lines, *(f"written: {escaped(path, 200)}" for path in written))


def _where(made: Compensation) -> list[str]:
    """For which errors the promise is."""
    if made.in_motion:
        travel = f"{made.travel_command:.6g}"
        return [f"the promise holds within {travel} commands, off the drive's own line, but for one shift"]
    return [
        f"the promise holds between these commands, within {two_digits(made.hours)} h and {made.travel_command:.4g} "
        "commands of travel since homing",
        f"arrive with at least {made.reversal_command:.4g} commands of travel on a side",
    ]


def verification_text(verification: Verification) -> str:
    """A verification for people."""
    p = "< 0.0003" if verification.p < 3e-4 else f"= {verification.p:.2g}"
    rows = [[name, f"{100 * chance:.1f} %"] for name, chance in verification.worlds.items()]
    axis = not verification.looks
    what = (
        f"{verification.readings} readings under the table"
        if axis
        else f"{verification.readings} looks that the calibration aimed"
    )
    lines: list[Part] = [
        f"{verification.verdict}: {verification.world} (p {p})",
        "",
        TableView(what, [f"the {'table' if axis else 'calibration'} was", "probability"], rows),
        "",
        sizes_table(verification),
        _promised(verification),
        *verification.remarks,
    ]
    if verification.verdict == BROKEN:
        remedies = REMEDIES if axis else REMEDIES | SCANNER_REMEDIES
        lines.append(f"what to do: {remedies[verification.world]}")
    elif verification.verdict == CANNOT_TELL and verification.needed is None:
        lines.append(
            "no number of such readings tells: what the table corrects is lost in what homing and fit leave open"
        )
    elif verification.verdict == CANNOT_TELL:
        kind = "readings" if axis else "looks"
        more = f"about {verification.needed} {kind} of this kind" if verification.needed else f"some more {kind}"
        lines.append(f"what to do: {more} would tell; `tvsbayes plan --verify FOLDER` names those that tell soonest")
    return terminal(*lines)


APPLIED_TITLE = "Applied, and what is left"


def compensation_section(made: Compensation, verification: Verification | None) -> Section:
    """Report: what was made to be applied, what is left by the promise, and what fresh readings say of it."""
    low, high = made.range_command
    text = [
        f"Made for {made.target}, to be applied by the {made.applied_by}, for commands from {low:.10g} to {high:.10g}; "
        f"{_where(made)[0]}.",
        "No fresh readings have verified it." if verification is None else _verdict(verification),
    ]
    tables = [promise_table(made), *([] if verification is None else [sizes_table(verification)])]
    return Section(APPLIED_TITLE, text, made.unsaid, tables)


def verified_section(verification: Verification) -> Section:
    """Report of a scanner: what fresh looks say that its calibration aimed, with points in mm."""
    text = "Counters by `tvsbayes steps-for` or the header, held against fresh looks. " + _verdict(verification)
    return Section(APPLIED_TITLE, [text], tables=[sizes_table(verification)])


def _verdict(verification: Verification) -> str:
    kind = "readings" if verification.millimetres is None else "looks"
    said = f"{verification.verdict}: {verification.readings} fresh {kind}, "
    said += f"most probable: {verification.world}, p = {verification.p:.2g}."
    promised = _promised(verification)
    return f"{said} {promised[0].upper()}{promised[1:]}."


def verify_plan_text(plan: VerifyPlan) -> str:
    """Readings that tell soonest what became of a table."""
    words = {1: "forward", -1: "backward"}
    rows = [[f"{command:.10g}", words[side]] for command, side in plan.stops]
    table = TableView(f"{len(rows)} readings with the table in force, in this order", ["command", "arriving"], rows)
    return terminal(table, f"to arrive on a side, come from at least {plan.overrun:.4g} commands away", _how_far(plan))


def aim_plan_text(plan: AimPlan) -> str:
    """Looks that tell soonest what became of a calibration."""
    rows = [[str(p), str(t), SIDES["pan"][ps > 0], SIDES["tilt"][ts > 0]] for p, t, ps, ts in plan.stops]
    columns = ["pan", "tilt", "arriving", ""]
    table = TableView(
        f"{len(rows)} looks with the calibration in force, in this order, from a homing on", columns, rows
    )
    pan, tilt = plan.run_up
    come = f"to arrive on a side, come from at least {pan} steps of pan and {tilt} of tilt away"
    return terminal(table, come, _how_far(plan))


def _how_far(plan: VerifyPlan | AimPlan) -> str:
    """Whether a plan tells."""
    if plan.enough:
        return f"they tell the worlds apart in 95 of 100: {plan.distance:.1f} standard deviations"
    return f"they hardly tell: the nearest two worlds are {plan.distance:.1f} standard deviations apart"

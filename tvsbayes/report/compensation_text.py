"""Texts of `compensate` and `verify`: promise or verdict first, then its basis, then the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tvsbayes.compensation.verification import VerifyPlan
from tvsbayes.errors import escaped
from tvsbayes.instrument.axes import SIDES
from tvsbayes.report.document import Section, labelled, sentence, terminal
from tvsbayes.report.tables import TableView, sentences, table, three_digits, two_digits
from tvsbayes.results.compensation_record import (
    BROKEN,
    CANNOT_TELL,
    CAUSES,
    AimedPromise,
    Compensation,
    Verification,
)

if TYPE_CHECKING:
    from tvsbayes.comparison.verified_looks import AimPlan

APPLIED_TITLE = "Applied correction and remaining error"


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
    points, homed = verification.millimetres, verification.after_with_homing
    sizes = [
        ("before (expected without the table)", verification.before, points and points.before),
        ("after (read)", verification.after, points and points.after),
        *([] if homed is None else [("after, with the shift common to all", homed, None)]),
    ]
    columns = {
        "": lambda row: row[0],
        "RMS": lambda row: two_digits(row[1].rms),
        "worst": lambda row: two_digits(row[1].worst),
    }
    if points is not None:
        columns[f"RMS at {points.distance_mm:.10g} mm, mm"] = lambda row: two_digits(row[2].rms) if row[2] else ""
        columns["worst, mm"] = lambda row: two_digits(row[2].worst) if row[2] else ""
    scope = " of both axes" * verification.looks + ", and of points" * (points is not None)
    return table(f"errors, {escaped(verification.unit)}{scope}", sizes, columns)


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
    return terminal(
        f"compensation for {result.target}: {len(result.table)} commands from {low:.10g} to {high:.10g}, in {unit}",
        f"aim: reading = {result.offset:.6g} + {result.per_command:.9g} x command{shift}",
        "",
        promise_table(result),
        "",
        *_validity(result),
        f"largest remaining error: {_largest(result)}",
        *labelled("the format", result.unsaid),
        *_homing_remarks(result),
        f"nothing is applied yet; apply it once, in one place, then {result.shown_by}",
        *labelled("written", [escaped(path, 200) for path in written]),
    )


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
        f"{_conditions(result)}",
        f"arrive with at least {run_up} of travel on a side",
        f"largest remaining error: {_largest(result)}",
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


def _homed(result: Compensation | AimedPromise) -> bool:
    return any(result.homings.values()) if isinstance(result, AimedPromise) else bool(result.homings)


def _of_axes(result: Compensation | AimedPromise) -> str:
    """The axes whose errors are less a shift, where there are two."""
    return f" of {' and of '.join(result.free_axes)}" if isinstance(result, AimedPromise) else ""


def _largest(result: Compensation | AimedPromise) -> str:
    """The largest cause of the remaining error, with its remedy."""
    counted = [cause for cause in CAUSES if cause != "homing" or not _shift_free(result)]
    largest = max(counted, key=lambda cause: max(left.causes.get(cause, 0.0) for left in result.sides.values()))
    kind = "remaining_aim" if isinstance(result, AimedPromise) else "remaining_drive"
    own = sentences(kind) if isinstance(result, AimedPromise) or result.in_motion else {}
    absolute = {} if _homed(result) else sentences("remaining_absolute")
    return str((sentences("remaining") | own | absolute)[largest])


def _conditions(result: Compensation | AimedPromise) -> str:
    """Since when, and at which temperatures, a promise holds."""
    absolute = "after the campaign, from whose first move on the absolute zero walks"
    low, high = result.kelvin or (0.0, 0.0)
    kelvin = f", at temperatures as read, over {two_digits(high - low)} K" if result.kelvin else ""
    return ("since homing" if _homed(result) else absolute) + kelvin


def _homing_remarks(result: Compensation | AimedPromise) -> list[str]:
    """What the promise rests on where one homing alone was read, and what the next one may add."""
    if not (result.free_axes if isinstance(result, AimedPromise) else result.shift_matters):
        return []
    homed = [
        f"{side} {two_digits(promise.error95_with_homing)}"
        for side, promise in result.sides.items()
        if promise.error95_with_homing is not None
    ]
    where = "home_sd_deg in [rig.prior]" if isinstance(result, AimedPromise) else "home_sd in [axis]"
    return [
        "one homing was read: the promise is of errors but for one shift common to all, as within one homing; with the "
        f"next homing's error, which its prior alone determines, {where}, 95 % are at most: {', '.join(homed)} "
        f"{escaped(result.unit)}"
    ]


def _validity(result: Compensation) -> list[str]:
    """Validity of the promise, in words."""
    if result.in_motion:
        added = [row.add_forward for row in result.table]
        size = three_digits(abs(result.per_command) * (max(added) - min(added)))
        seconds = f", {result.settings['period_s']:.5g} s" if "period_s" in result.settings else ""
        return [
            f"the promise holds within {result.travel_command:.6g} commands, off the drive's own line, but for one "
            "shift",
            f"the error that repeats every {result.settings['period_command']:.6g} commands{seconds}: {size} "
            f"{escaped(result.unit)} peak to peak",
        ]
    return [
        f"the promise holds between these commands, within {two_digits(result.hours)} h and "
        f"{result.travel_command:.4g} commands of travel {_conditions(result)}",
        f"arrive with at least {result.reversal_command:.4g} commands of travel on a side",
    ]


def verification_text(verification: Verification) -> str:
    """A verification as text."""
    what, kind, under = "table", "readings", "under the table"
    if verification.looks:
        what, kind, under = "calibration", "looks", "that the calibration aimed"
    helps = None
    if verification.verdict == BROKEN:
        remedies = sentences("broken") | (sentences("broken_aim") if verification.looks else {})
        helps = f"what to do: {remedies[verification.world]}"
    elif verification.verdict == CANNOT_TELL and verification.needed is None:
        helps = "no number of such readings decides: the correction is smaller than the uncertainty of homing and fit"
    elif verification.verdict == CANNOT_TELL:
        more = f"about {verification.needed} {kind} of this kind" if verification.needed else f"some more {kind}"
        helps = f"what to do: take {more}; `tvsbayes plan --verify FOLDER` lists the most informative"
    p = "< 0.0003" if verification.p < 3e-4 else f"= {verification.p:.2g}"
    rows = [[name, f"{100 * chance:.1f} %"] for name, chance in verification.worlds.items()]
    return terminal(
        f"{verification.verdict}: {verification.world} (p {p})",
        "",
        TableView(f"{verification.readings} {kind} {under}", [f"the {what} was", "probability"], rows),
        "",
        sizes_table(verification),
        _promise_text(verification),
        *verification.remarks,
        helps,
    )


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
    text = f"Counters by `tvsbayes steps-for` or the header, held against fresh looks. {_verdict(verification)}"
    return Section(APPLIED_TITLE, [text], tables=[sizes_table(verification)])


def _verdict(verification: Verification) -> str:
    kind = "readings" if verification.millimetres is None else "looks"
    return (
        f"{verification.verdict}: {verification.readings} fresh {kind}, most probable: {verification.world}, "
        f"p = {verification.p:.2g}. {sentence(_promise_text(verification))}"
    )


def verify_plan_text(plan: VerifyPlan) -> str:
    """A plan of readings that verify a table, as text."""
    rows = [[f"{command:.10g}", "forward" if side > 0 else "backward"] for command, side in plan.stops]
    stops = TableView(f"{len(rows)} readings with the table in force, in this order", ["command", "arriving"], rows)
    return terminal(stops, f"to arrive on a side, come from at least {plan.run_up:.4g} commands away", _power(plan))


def aim_plan_text(plan: AimPlan) -> str:
    """A plan of looks that verify a calibration, as text."""
    rows = [[str(p), str(t), SIDES["pan"][ps > 0], SIDES["tilt"][ts > 0]] for p, t, ps, ts in plan.stops]
    title = f"{len(rows)} looks with the calibration in force, in this order, from a homing on"
    pan, tilt = plan.run_up
    run_up = f"to arrive on a side, come from at least {pan} steps of pan and {tilt} of tilt away"
    return terminal(TableView(title, ["pan", "tilt", "arriving", ""], rows), run_up, _power(plan))


def _power(plan: VerifyPlan | AimPlan) -> str:
    """Whether a plan separates the hypotheses, in words."""
    if plan.enough:
        return f"they separate the hypotheses in 95 % of cases: {plan.distance:.1f} standard deviations"
    return f"they do not separate the hypotheses: the nearest two are {plan.distance:.1f} standard deviations apart"

"""Texts of `watch`: the verdict first, then the moved parts, the power of the looks, and the remedy."""

from __future__ import annotations

import math

from tvsbayes.display import concise
from tvsbayes.errors import escaped
from tvsbayes.instrument.homing import scatter_of_prior
from tvsbayes.report.document import terminal
from tvsbayes.report.tables import TableView
from tvsbayes.results.watch_record import CANNOT_TELL, LOOKS_MAX, MOVED, MovedPart, PlannedChange, Watch, WatchPlan

HELPS = {
    "cameras: rotation": "more looks on both sheets, over the whole picture",
    "cameras: shift": "more looks on both sheets, over the whole picture",
    "positioner: rotation": "more homings, each with its looks: the scatter of homings has the same effect",
    "positioner: shift": "looks on both sheets at more counters",
    "zero: azimuth": "more homings, each with its sightings: the scatter of homings has the same effect",
    "zero: elevation": "more homings, each with its sightings: the scatter of homings has the same effect",
    "base: lean": "sightings all round, in opposite azimuths",
    "beam: not square": "sightings low and high, at the same azimuths",
    "ratio: pan": "pan counters further apart, each reached several times",
    "ratio: tilt": "tilt counters further apart, each reached several times",
    "play: pan": "each pan counter from both sides, several times",
    "play: tilt": "each tilt counter from both sides, several times",
    "zero": "more homings, each with its stops: the scatter of homings has the same effect",
    "ratio": "stops further apart, each reached several times",
    "play": "each command from both sides, several times",
}
"""Looks that detect a change better, by change."""
LINEAR = {"deg": 1.0, "mm": 10.0}
"""Largest change whose size is estimated correctly, by unit."""
REMEDIES = {
    "cameras": "calibrate the cameras again, then the rig",
    "positioner": "fasten it and calibrate again; until then coordinates are off by the amount above",
    "zero": "look for a homing switch or a coupling that slipped, then calibrate again",
    "base": "fasten it and calibrate again",
    "beam": "fasten camera or telescope on the head, then calibrate again",
    "ratio": "look for a slipping gear or lost steps, then calibrate again",
    "play": "look for wear or a loose grub screw, then calibrate again",
}
"""Remedies by the first word of the moved part."""


def moved_text(part: MovedPart) -> str:
    """Format a moved part, e.g. `cameras: rotation about y 0.052(6) deg`."""
    return f"{part.what} {concise(part.value, part.u)} {escaped(part.unit)}"


def watch_text(watch: Watch, power_min: float, looks: str = "looks") -> str:
    """A watched calibration as text.

    Args:
        watch: the result.
        power_min: with less power a change counts as undetectable.
        looks: what the new data are.
    """
    rows = [
        [c.what, f"{c.size:g} {escaped(c.unit)}", f"{100 * c.power:.0f} %", "< 1e-9" if c.p < 1e-9 else f"{c.p:.2g}"]
        for c in watch.changes
    ]
    table = TableView(
        f"{watch.looks} new {looks} against the calibration", ["change", "of", "would be noticed by", "p"], rows
    )
    p = "< 1e-9" if watch.p < 1e-9 else f"= {watch.p:.2g}"
    lines = [f"{watch.verdict} (p {p}; false alarms {100 * watch.false_alarm_rate:g} %)"]
    lines += [f"moved: {moved_text(part)}" for part in watch.moved]
    # The readings of an axis are linear in its changes.
    linear = LINEAR if looks == "looks" else {}
    if any(abs(part.value) > linear.get(part.unit, math.inf) for part in watch.moved):
        lines.append(
            "sizes are linearised about the calibration: so large ones are inaccurate by more than the stated u"
        )
    if watch.verdict == MOVED:
        causes = list(dict.fromkeys(part.what.split(":")[0] for part in watch.moved))
        lines.append(f"what to do: {REMEDIES[causes[0]]}")
        if len(causes) > 1:
            others = ", ".join(causes[1:])
            lines.append(f"then watch again: {others} may show residuals of the first cause only")
    unseen = watch.unseen(power_min)
    if watch.verdict == CANNOT_TELL:
        lines += [f"cannot see {c.size:g} {escaped(c.unit)} of {c.what}: {HELPS[c.what]}" for c in unseen]
    if watch.verdict != MOVED and watch.p_all < watch.false_alarm_rate:
        lines.append(f"warning: the {looks} scatter more than the calibration says (p = {watch.p_all:.2g})")
    lines += [scatter_of_prior(watch.home_sd_by_prior)] if watch.home_sd_by_prior else []
    return terminal(*lines, "", table)


def _need(change: PlannedChange) -> str:
    if change.looks_needed is None:
        return "none do"
    return f"{change.looks_needed} after {_homings(change.homings_needed or 1)}, {change.minutes_needed:.0f} min"


def _homings(count: int) -> str:
    return f"{count} homing{'s' * (count != 1)}"


def watch_plan_text(plan: WatchPlan, looks: str = "looks") -> str:
    """A plan for watching a calibration, as text; `looks` is what it takes."""
    rows = [[c.what, f"{c.size:g} {escaped(c.unit)}", f"{100 * c.power:.0f} %", _need(c)] for c in plan.changes]
    power = f"{100 * plan.power_wanted:.0f} %"
    summary = (
        f"{plan.looks} {looks} after {_homings(plan.homings)}, {plan.minutes:.1f} of {plan.minutes_allowed:g} minutes; "
        f"false alarms {100 * plan.false_alarm_rate:g} %"
    )
    table = TableView(
        "What `watch` will notice", ["change", "of", "noticed by this plan", f"{looks} for {power} of it alone"], rows
    )
    lines = [summary, *([scatter_of_prior(plan.home_sd_by_prior)] if plan.home_sd_by_prior else [])]
    for c in plan.changes:
        if c.power >= plan.power_wanted:
            continue
        text = f"{c.size:g} {c.unit} of {c.what} is noticed in {100 * c.power:.0f} % of the cases"
        if c.looks_needed is not None:
            need = f"{c.looks_needed} {looks} after {_homings(c.homings_needed or 1)} ({c.minutes_needed:.0f} minutes)"
            need += " suffice"
            if c.looks_needed > LOOKS_MAX:
                need += f", more than the {LOOKS_MAX} that are planned at most"
            lines.append(f"{text}: {need}; {HELPS[c.what]}")
        else:
            remedy = "; a sufficient number was not found"
            if c.looks_to_add is not None:
                remedy = f": add about {c.looks_to_add} looks to it like those of this plan, homed as often (others, "
                remedy += "after one homing, are less informative), and take as many at every watch"
            lines.append(
                f"{text}, and no number of {looks} improves that: the campaign determines it too poorly{remedy}"
            )
    return terminal(*lines, "", table)

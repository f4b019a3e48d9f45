"""Texts of commands other than `fit`: cameras, coordinates, comparisons, watches, plans, studies."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import UNSET

from tvsbayes.calibration.pointing import Steps
from tvsbayes.display import concise
from tvsbayes.errors import escaped, plural
from tvsbayes.instrument.homing import scatter_of_prior
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT
from tvsbayes.report.document import Part, labelled, terminal
from tvsbayes.report.result_tables import gap_table, hold_out_table, point_budget_table
from tvsbayes.report.tables import (
    TableView,
    made_by,
    name_in_words,
    optional,
    sentences,
    table,
    text_width,
    to_digits,
    two_digits,
)
from tvsbayes.results.comparison_record import Comparison, Gap, HoldOut, PositionHoldOut
from tvsbayes.results.watch_record import CANNOT_TELL, LOOKS_MAX, MOVED, MovedPart, PlannedChange, Watch, WatchPlan
from tvsbayes.statistics.chances import ASSURED, BOUND, LEVELS, binomial_bounds, rms_bounds

if TYPE_CHECKING:
    from tvsbayes.calibration.pointing import Calibration
    from tvsbayes.cameras.detection import Detection
    from tvsbayes.cameras.stereo_calibration import StereoCalibration
    from tvsbayes.coordinates.cloud import LawChecked
    from tvsbayes.coordinates.cloud_files import CloudFile
    from tvsbayes.coordinates.location import Locations
    from tvsbayes.instrument.stereo_pair import Stereo
    from tvsbayes.metrology.look_budget import Budget
    from tvsbayes.planning.planner import PlanResult
    from tvsbayes.studies.study import StudyResult

UNSEEN_SHOWN = 5
"""Largest number of notes on counters without looks, for a file of points."""
PLAN_UNIT = {"contrast": "deg/step", "backlash": "deg", "mirror_offset": "mm"}
"""Units of results in a plan, by the beginning of their names; deg/step for ratios."""
LAW = (
    "values are those of the draws; law: digits of u to which the law of propagation (GUM) agrees, else by how much "
    "an end of its 95 % interval differs"
)
"""Note below a table of points."""
STATED_APERTURE = (
    "the campaign has no aperture readings: distances rest on baseline, emission angle at pan 0 and the aperture's "
    "zero as stated"
)
LAW_SHARE = 0.95
"""Least share of tested points where the law of propagation must hold for reliable sds."""
LINEAR = {"deg": 1.0, "mm": 10.0}
"""Largest change whose size is estimated correctly, by unit."""


def extrapolated_text(unseen: str) -> str:
    """The warning of a result at counters without looks; `unseen` names these counters."""
    return f"EXTRAPOLATED: {unseen}, where looks were; errors of the gears are predicted there from their size only"


def check_text(document: Mapping[str, Any], has_images: bool = True) -> str:
    """The text of `check` for a campaign, rig, plan, axis or journal: a table, and warnings.

    Args:
        document: document of `check --json`.
        has_images: whether looks are spots in images; else sightings.
    """
    omitted = ("kind", "findings", "warnings", "faults", "expected", "contraction", "journal")
    words = sentences("check") | ({} if has_images else sentences("check_sightings"))
    rows = [
        [words.get(key, key), _value_text(value)]
        for key, value in document.items()
        if key not in omitted and words.get(key) != ""
    ]
    journal, expected = document.get("journal"), document.get("expected")
    of_run = [[key, _value_text(value)] for key, value in (journal or {}).items() if key != "kind"]
    count = sum(finding["certain"] for finding in document.get("findings", ()))
    return terminal(
        TableView(document["kind"], [], rows),
        None if expected is None else _expected_table(expected, document["contraction"]),
        None if journal is None else TableView("journal of the run", [], of_run),
        *labelled("warning", document["warnings"]),
        f"certain: {count} of them; `fit` and `calibrate` stop there, --anyway goes on" if count else None,
    )


def _value_text(value: Any) -> str:
    """One value of `check`: numbers, tables and lists as text."""
    if isinstance(value, Mapping):
        return ", ".join(f"{escaped(str(key), 80)} {_value_text(entry)}" for key, entry in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(_value_text, value)) or "none"
    if isinstance(value, float):
        return f"{value:.10g}" if value == round(value) else f"{value:.0f}" if abs(value) >= 1e4 else f"{value:.4g}"
    return "not known" if value is None else escaped(str(value), 400)


def _expected_table(expected: Mapping[str, float], contraction: Mapping[str, float | None]) -> TableView:
    """Expected results of a plan: u, and the reduction of the prior variance."""
    rows = []
    for name, u in expected.items():
        unit = next((unit for prefix, unit in PLAN_UNIT.items() if name.startswith(prefix)), "deg/step")
        share = contraction.get(name)
        # Parameters that the instrument lacks are fixed.
        if u > 0 or share is not None:
            rows.append([name, two_digits(u), unit, "fixed" if share is None else f"{round(100 * share)} %"])
    columns = ["result", "u expected", "unit", "set by the data"]
    return TableView("what the plan will determine (100 %: the priors no longer matter)", columns, rows)


def plan_text(result: PlanResult) -> str:
    """A plan as text."""
    unit = result.target.unit

    def value(number: float | None) -> str:
        return "-" if number is None else f"{number:.3g}"

    def size(experiments: int) -> str:
        return f"{plural(experiments, 'experiment')} ({LOOKS_PER_EXPERIMENT * experiments} looks)"

    # Points of the curve up to the first with the higher assurance, the next one, and the last.
    last = len(result.curve) - 1
    enough = next((k for k, p in enumerate(result.curve) if p.assurance >= ASSURED[1]), last + 1)
    rows = [
        f"{p.experiments:11d}  {LOOKS_PER_EXPERIMENT * p.experiments:5d}  {p.minutes:7.1f}  {value(p.classic):>10}  "
        f"{value(p.joint):>10}  {100 * p.assurance:6.0f} +- {100 * p.assurance_se:.1f} %"
        for k, p in enumerate(result.curve)
        if k <= enough + 1 or k == last
    ]
    largest = f"not reached with up to {size(result.curve[last].experiments)}"
    counts = [largest if n is None else size(n) for n in (result.n80, result.n95)]
    made = "the target is met already: nothing is left to do"
    if result.assurance is not None and result.assurance_se is not None:
        made = f"the plan: {size(result.experiments)} in {result.minutes:.1f} minutes; chance of success "
        made += f"{100 * result.assurance:.0f} +- {100 * result.assurance_se:.1f} %"
    shares = ", ".join(f"{name} {100 * s:.0f} %" for name, s in list(result.shares.items())[:5])
    verdict = "lies below the target" if result.limit.reachable else "NO NUMBER OF LOOKS MEETS THE TARGET"
    classic = None
    if (c := result.classic) is not None:
        low, high = c.experiments_interval95
        classic = (
            f"classic, {c.direction}: n = (t s / E)^2 = {c.experiments} four-point experiments ({low} to {high}) for "
            f"s = {c.sd:.2g} deg/step ({'measured' if c.from_data else 'predicted'}), E = {c.half_width:.2g}; its "
            f"systematic error {c.systematic:+.2g} ({c.systematic_interval95[0]:+.2g} to "
            f"{c.systematic_interval95[1]:+.2g}) does not depend on n"
        )
    onward = [
        "next four looks, best first:",
        *(f"  {b.gain_per_minute:.2g} {unit} a minute ({b.minutes:.1f} min): {b.text}" for b in result.next[:3]),
        f"{'STOP' if result.stop.now else 'go on'}: {result.stop.reason}; {result.stop.rule}",
    ]
    return terminal(
        f"target: {result.target.text}; now {result.now:.3g} {unit}",
        "",
        "experiments  looks  minutes     classic       joint  chance of success",
        *rows,
        f"{result.target.text.partition('(')[0]} in {unit}, medians over {result.draws} drawn instruments; an "
        "experiment is four looks;",
        "chance of success (assurance): that the fit of such a campaign reports the target as met",
        "a row but the plan's takes the first looks of the longest: few may leave a direction without a stop",
        *(f"for a chance of {100 * level:.0f} %: {n}" for level, n in zip(ASSURED, counts, strict=True)),
        made,
        "",
        f"{'plan':10}  spots  in view  minutes  expected {unit}",
        *(f"{b.name:10}  {b.spots:5d}  {b.seen:7d}  {b.minutes:7.1f}  {value(b.joint)}" for b in result.baselines),
        "",
        f"after the plan the variance consists of: {shares}",
        f"floor {result.limit.floor:.3g} {unit}, set by {result.limit.cause}: {verdict}",
        result.limit.needed or None,
        classic,
        *labelled("note", result.notes),
        *(onward if result.next else []),
    )


def stereo_text(stereo: Stereo) -> str:
    """The 24 parameters of a pair with their standard uncertainties, both cameras side by side."""
    sds = np.sqrt(np.diag(stereo.parameter_covariance))
    cells = [concise(float(value), float(sd)) for value, sd in zip(stereo.vector, sds, strict=True)]
    units = dict.fromkeys(("fx", "fy", "cx", "cy"), "px") | dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), "")
    title = f"stereo pair, {stereo.image_width} x {stereo.image_height} px"
    if stereo.right_image_size is not None:
        title += "; right camera {} x {} px, scaled to that".format(*stereo.right_image_size)
    rows = [[name, cells[k], cells[9 + k], unit] for k, (name, unit) in enumerate(units.items())]
    pose = [[axis, cells[18 + k], cells[21 + k]] for k, axis in enumerate("xyz")]
    return terminal(
        TableView(title, ["", "left(u)", "right(u)", "unit"], rows),
        TableView("x_right = R x_left + T", ["", "rotation, rad", "T, mm"], pose),
    )


def stereo_calibration_text(result: StereoCalibration) -> str:
    """A calibration from checkerboards as text: parameters, views, remarks."""

    def px(value: float | None) -> str:
        return "-" if value is None else f"{value:.3f}"

    def named(names: tuple[str, ...]) -> str:
        return escaped(", ".join(names), 400)

    views = table(
        f"{result.pairs} pairs, {len(result.views) - result.pairs} single views",
        result.views,
        {
            "view": lambda view: escaped(view.name) or "-",
            "left rms px": lambda view: px(view.left_rms_px),
            "right rms px": lambda view: px(view.right_rms_px),
            "distance mm": lambda view: f"{view.distance_mm:.0f}",
            "tilt deg": lambda view: f"{view.tilt_deg:.0f}",
            "": lambda view: "OUTLIER" if view.outlier else "",
        },
    )
    pitch_mm, baseline_mm = result.triangulated_pitch_mm, float(np.linalg.norm(result.stereo.T))
    shares = [f"{100 * share:.0f} % of the {side} image" for side, share in result.coverage.items()]
    lists = [(note, getattr(result.pictures, name, ())) for name, note in sentences("pictures").items()]
    return terminal(
        stereo_text(result.stereo),
        views,
        f"rms over corners: both {result.stereo.rms_px:.3f}, left {px(result.left_rms_px)}, right "
        f"{px(result.right_rms_px)} px; one coordinate: sd {result.noise_sd_px:.3f} px, dof {result.dof}",
        "uncertainties hold for corner errors that the corners of a picture share: variances "
        f"{result.correlation_factor:.1f} times those of independent corners",
        f"and for a board whose corners are {result.board_error_mm:.2g} mm off a grid, as the residuals show",
        f"baseline {concise(baseline_mm, result.baseline_sd_mm)} mm; squares, triangulated: {pitch_mm.value:.3f} mm on "
        f"average, sd {pitch_mm.sd:.3f}, stated {result.board.pitch_mm:g}",
        f"boards cover {', '.join(shares)}",
        *(f"{len(names)} {note}: {named(names)}" for note, names in lists if names),
        f"right corners turned to agree: {named(result.reordered)}" if result.reordered else None,
        f"left out: {named(result.excluded)}" if result.excluded else None,
        *labelled("warning", result.warnings),
    )


def detection_text(detection: Detection) -> str:
    """Results of `detect` as a table of statuses."""
    from tvsbayes.cameras.detection import REASONS

    rows = [[status, str(count), REASONS.get(status.split(" ")[0], "")] for status, count in detection.statuses.items()]
    rows += [["undetected", str(detection.missing), "no frames"]] if detection.missing else []
    rows += [["as it was", str(detection.kept), "refused by hand"]] if detection.kept else []
    noise = ", ".join(
        f"{side} contrast {model.speckle_contrast:.2f}, gain {model.gain_dn:.3f} DN"
        for side, model in detection.noise.items()
    )
    sd_px = detection.median_sd_px
    sd = "" if sd_px is None else f"median standard uncertainty of a coordinate {sd_px:.3f} px; "
    return terminal(
        TableView(f"{detection.processed} looks", ["status", "looks", "meaning"], rows),
        f"method {detection.method}; {sd}noise: {noise}",
        *(
            f"{side} camera: odd and even {gap.lines} of {plural(gap.spots, 'spot')} show the beam {gap.apart_px:.2g} "
            "px apart, more than their noise: an interlaced readout, or a beam that moved or flickered while it was "
            "read. Their uncertainty is widened by the difference / sqrt(12); read whole frames at once (progressive, "
            "global shutter), or let the beam come to rest"
            for side, gaps in detection.lines.items()
            for gap in gaps
        ),
        *labelled("warning", detection.warnings),
    )


def locations_text(locations: Locations, aperture_read: bool) -> str:
    """Points with their uncertainty; `aperture_read`: whether the campaign has readings of the aperture."""
    rows: list[list[str]] = []
    for index, error in enumerate(locations.refused):
        if error is not None:
            rows.append([str(index), f"refused: {error.code}", "", "", "", ""])
            continue
        sd = np.sqrt(np.diag(locations.covariance_mm2[index]))
        cells = [concise(float(x), float(u)) for x, u in zip(locations.xyz_mm[index], sd, strict=True)]
        half = " ".join(map(two_digits, locations.u95_mm[index]))
        digits = int(locations.digits_held[index].min())
        difference = two_digits(float(locations.law_off_mm[index]))
        verdict = f"same to {plural(digits, 'digit')}" if digits else f"off by {difference} mm"
        # For an extrapolated point the comparison with the law is irrelevant.
        rows.append([str(index), *cells, half, "EXTRAPOLATED" if locations.extrapolated[index] else verdict])
    columns = ["point", "x(u) mm", "y(u) mm", "z(u) mm", "U95 mm", "law"]
    # The points of a file may be extrapolated for different reasons.
    missing = zip(locations.unseen, locations.refused, strict=True)
    counters = list(dict.fromkeys(words for words, error in missing if words and not error))
    unshown = len(counters) - UNSEEN_SHOWN
    return terminal(
        TableView(f"frame T, {locations.draws} draws ({locations.estimator})", columns, rows),
        *textwrap.wrap(LAW, text_width()),
        *([] if aperture_read else textwrap.wrap(STATED_APERTURE, text_width())),
        *map(extrapolated_text, counters[:UNSEEN_SHOWN]),
        f"and {unshown} more counters that no look reached" if unshown > 0 else None,
    )


def cloud_text(cloud: CloudFile, check: LawChecked, calibration: Calibration) -> str:
    """A written cloud as text: files, refused points, validity of its uncertainties."""
    off = ""
    if check.off_mm is not None and check.most_off_mm is not None:
        off = f"; ends of 95 % intervals differ by {two_digits(check.off_mm)} mm at half of them, at most by "
        off += f"{two_digits(check.most_off_mm)} mm"
    advice = "the sds may be relied on" if check.points else None
    if check.held < LAW_SHARE * check.points:
        advice = "do not rely on the sds of this cloud: `tvsbayes locate` --points without --cloud gives draws"
    extrapolated, refused = None, None
    if cloud.extrapolated:
        ranges = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in calibration.seen_steps.items())
        extrapolated = (
            f"{plural(cloud.extrapolated, 'point')} EXTRAPOLATED: outside {ranges}, where looks were; errors of the "
            "gears are predicted there by their size alone"
        )
    if cloud.refused_file is not None:
        reasons = ", ".join(f"{code} {number}" for code, number in sorted(cloud.reasons.items()))
        verb = "look has" if cloud.refused == 1 else "looks have"
        refused = (
            f"{cloud.refused} {verb} no point ({reasons}): lines and reasons in {escaped(cloud.refused_file, 200)}"
        )
    return terminal(
        f"written: {escaped(cloud.cloud, 200)}, {plural(cloud.written, 'point')}, frame T, mm",
        f"properties: {', '.join(cloud.columns)}",
        f"sds by the law of propagation (GUM): of {plural(check.points, 'point')} carried by draws too it holds to a "
        f"digit or more at {check.held}{off}",
        advice,
        extrapolated,
        refused,
    )


def budget_text(budget: Budget) -> str:
    """Uncertainty budget of a point: causes by share, then the parameters that contribute most."""
    length = np.linalg.norm(budget.contribution_mm, axis=1)
    rows = [
        [name_in_words(budget.parameters[k]), *(f"{v:+.3g}" for v in budget.contribution_mm[k])]
        for k in np.argsort(-length)[:10]
        if length[k] > 0
    ]
    title = "by parameter, one standard uncertainty each (correlated: they do not add up)"
    parts = TableView(title, ["parameter", "x mm", "y mm", "z mm"], rows)
    return terminal(point_budget_table(budget), "", parts)


def steps_text(steps: Steps) -> str:
    """Counters, the approach, and the remaining error."""
    pan, tilt = steps.approach
    mm, deg = (None if half is None else ", ".join(map(two_digits, half)) for half in (steps.u95_mm, steps.u95_deg))
    return terminal(
        f"go to      pan {steps.via_pan_steps}, tilt {steps.via_tilt_steps} steps (takes up the backlash)",
        f"then to    pan {steps.pan_steps}, tilt {steps.tilt_steps} steps, moving {pan} and {tilt}",
        None if mm is None else f"whole steps leave {steps.rounding_mm:.3g} mm; beam there +- ({mm}) mm (95 %)",
        optional(lambda angle: f"the aperture should read {angle:.3f} deg", steps.aperture_deg) or None,
        None
        if deg is None
        else f"whole steps leave {steps.rounding_deg:.3g} deg; azimuth and elevation +- ({deg}) deg (95 %)",
        extrapolated_text(steps.unseen) if steps.extrapolated else None,
    )


def gap_text(gaps: Mapping[str, Gap | None]) -> str:
    """The gap between both estimators by its terms, as text."""
    return gap_table(gaps).text()


def hold_out_text(hold_out: HoldOut) -> str:
    """Both estimators' predictions of left-out angles, and the uncertainty that a hold-out cannot show."""
    u_text = ", ".join(f"{d} {u:.1e}" for d, u in hold_out.unseen.items())
    return terminal(
        hold_out_table(hold_out),
        f"held-out angles: {hold_out.verdict}: {hold_out.reason}",
        f"not seen by any hold-out, common to all spots: u by stereo and focal scale, deg/step: {u_text}",
    )


def positions_text(hold_out: PositionHoldOut) -> str:
    """Counters left out, with their predictions."""
    positions = table(
        "counters left out and predicted, mirror angles in deg; z in stated uncertainties",
        hold_out.positions,
        {
            "axis": lambda p: p.axis,
            "counter": lambda p: str(p.position),
            "direction": lambda p: p.direction,
            "n": lambda p: str(p.n),
            "mean": lambda p: f"{p.mean:.4f}",
            "predicted(u)": lambda p: concise(p.predicted, p.u),
            "z": lambda p: f"{p.z:+.1f}",
        },
    )
    rms = None if hold_out.rms_z is None else f"RMS z {hold_out.rms_z:.2f}"
    return terminal(positions, rms, *labelled("warning", hold_out.warnings))


def changes_text(comparison: Comparison) -> str:
    """Changes between two calibrations of one instrument as text."""
    title = "A and B"
    if comparison.reference_pose_deg is not UNSET:
        pan, tilt = comparison.reference_pose_deg
        title += f" at pan {pan:.2f} deg, tilt {tilt:.2f} deg"
    if comparison.range_command is not UNSET:
        low, high = comparison.range_command
        title += f" from command {low:.10g} to {high:.10g}"
    changes = table(
        title,
        comparison.changes,
        {
            "quantity": lambda c: c.label,
            "A": lambda c: to_digits(c.first, c.u),
            "B": lambda c: to_digits(c.second, c.u),
            "B - A (u)": lambda c: concise(c.difference, c.u),
            "unit": lambda c: escaped(c.unit),
            "normalised": lambda c: "fixed" if c.normalised is None else f"{c.normalised:+.2f}",
            "significant": lambda c: "yes" if c.significant else "no",
        },
    )
    days = "" if comparison.days is None else f" in {comparison.days:.1f} days"
    shared = ""
    if comparison.shared_cameras is not UNSET:
        same = "; the same stereo calibration: its error is left out of u"
        shared = same if comparison.shared_cameras else "; two cameras"
    ratios = [c for c in comparison.changes if "per" in c.quantity and c.u > 0]
    smaller = None
    if ratios and not any(c.significant for c in comparison.changes):
        share = max(comparison.limit * c.u / abs(c.first) for c in ratios)
        smaller = (
            f"smaller changes are not excluded: a ratio may have changed by up to {100 * share:.2g} % undetected; "
            "`tvsbayes watch A B` compares what was seen in B with A and detects smaller changes"
        )
    verdict = f"{comparison.verdict}{days} (limit {comparison.limit:.2f} u for all together{shared})"
    return terminal(changes, verdict, smaller)


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
    changes = table(
        f"{watch.looks} new {looks} against the calibration",
        watch.changes,
        {
            "change": lambda c: c.what,
            "of": lambda c: f"{c.size:g} {escaped(c.unit)}",
            "would be noticed by": lambda c: f"{100 * c.power:.0f} %",
            "p": lambda c: "< 1e-9" if c.p < 1e-9 else f"{c.p:.2g}",
        },
    )
    p = "< 1e-9" if watch.p < 1e-9 else f"= {watch.p:.2g}"
    # The readings of an axis are linear in its changes.
    linear = LINEAR if looks == "looks" else {}
    inaccurate = any(abs(part.value) > linear.get(part.unit, math.inf) for part in watch.moved)
    causes = list(dict.fromkeys(part.what.split(":")[0] for part in watch.moved)) if watch.verdict == MOVED else []
    unseen = watch.unseen(power_min) if watch.verdict == CANNOT_TELL else ()
    scatters = watch.verdict != MOVED and watch.p_all < watch.false_alarm_rate
    return terminal(
        f"{watch.verdict} (p {p}; false alarms {100 * watch.false_alarm_rate:g} %)",
        *labelled("moved", map(moved_text, watch.moved)),
        "sizes are linearised about the calibration: so large ones are inaccurate by more than the stated u"
        if inaccurate
        else None,
        *labelled("what to do", [sentences("moved")[cause] for cause in causes[:1]]),
        f"then watch again: {', '.join(causes[1:])} may show residuals of the first cause only" if causes[1:] else None,
        *(f"cannot see {c.size:g} {escaped(c.unit)} of {c.what}: {sentences('watch_better')[c.what]}" for c in unseen),
        f"warning: the {looks} scatter more than the calibration says (p = {watch.p_all:.2g})" if scatters else None,
        scatter_of_prior(watch.home_sd_by_prior) if watch.home_sd_by_prior else None,
        "",
        changes,
    )


def watch_plan_text(plan: WatchPlan, looks: str = "looks") -> str:
    """A plan for watching a calibration, as text; `looks` is what it takes."""

    def needed(c: PlannedChange) -> str:
        homings = plural(c.homings_needed or 1, "homing")
        return "none do" if c.looks_needed is None else f"{c.looks_needed} after {homings}, {c.minutes_needed:.0f} min"

    changes = table(
        "What `watch` will notice",
        plan.changes,
        {
            "change": lambda c: c.what,
            "of": lambda c: f"{c.size:g} {escaped(c.unit)}",
            "noticed by this plan": lambda c: f"{100 * c.power:.0f} %",
            f"{looks} for {100 * plan.power_wanted:.0f} % of it alone": needed,
        },
    )
    return terminal(
        f"{plan.looks} {looks} after {plural(plan.homings, 'homing')}, {plan.minutes:.1f} of "
        f"{plan.minutes_allowed:g} minutes; false alarms {100 * plan.false_alarm_rate:g} %",
        scatter_of_prior(plan.home_sd_by_prior) if plan.home_sd_by_prior else None,
        *(_hardly_noticed(c, looks) for c in plan.changes if c.power < plan.power_wanted),
        "",
        changes,
    )


def _hardly_noticed(c: PlannedChange, looks: str) -> str:
    """What helps a plan to notice a change that it hardly notices."""
    text = f"{c.size:g} {c.unit} of {c.what} is noticed in {100 * c.power:.0f} % of the cases"
    if c.looks_needed is not None:
        homings = plural(c.homings_needed or 1, "homing")
        most = f", more than the {LOOKS_MAX} that are planned at most" if c.looks_needed > LOOKS_MAX else ""
        need = f"{c.looks_needed} {looks} after {homings} ({c.minutes_needed:.0f} minutes) suffice{most}"
        return f"{text}: {need}; {sentences('watch_better')[c.what]}"
    remedy = "; a sufficient number was not found"
    if c.looks_to_add is not None:
        remedy = (
            f": add about {c.looks_to_add} looks to it like those of this plan, homed as often (others, after one "
            "homing, are less informative), and take as many at every watch"
        )
    return f"{text}, and no number of {looks} improves that: the campaign determines it too poorly{remedy}"


def study_text(result: StudyResult) -> str:
    """A study as text."""
    n, t = result.converged, result.target
    low, high = rms_bounds(n)
    bounds = [f"{100 * low:.0f}-{100 * high:.0f}" for low, high in (binomial_bounds(n, x) for x in LEVELS)]
    rows = [[f"bounds at {BOUND:g}", "", f"{low:.2f}-{high:.2f}", "", *bounds, "", ""]]
    for name, h in result.headlines.items():
        shares = [f"{100 * h.coverage[f'{100 * x:g}']:.1f}" for x in LEVELS]
        numbers = [f"{h.sd:.3g}", f"{h.rms_z:.2f}", f"{h.rms_predicted:.2f}", *shares, f"{h.power:.2f}"]
        rows.append([name, *numbers, "within" if h.within else "OUTSIDE"])
    columns = ["quantity", "median sd", "RMS z", "predicted", *(f"{100 * x:g} %" for x in LEVELS), "power", ""]
    ran = f"{result.campaigns}" if result.campaigns == result.asked else f"{result.campaigns} of {result.asked}"
    title = f"{ran} simulated campaigns, {n} fits converged ({made_by(result.estimator)}); {result.seconds:.1f} s each"
    a, b = result.assurance_interval95
    reported: Part = None
    if result.reported is not None:
        reported = "reported: {:.3g}, {:.3g}, {:.3g}".format(*result.reported) + f" {t.unit} (5, 50, 95 % of fits)"
    return terminal(
        TableView(title, columns, rows),
        f"{t.text}: reported as met by {100 * result.assurance:.1f} % of fits ({100 * a:.1f} to {100 * b:.1f} %)",
        f"too few campaigns to decide whether {100 * ASSURED[0]:.0f} % do: add more with a larger --n"
        if a < ASSURED[0] <= b
        else None,
        f"bounds: exceeded with a probability of {BOUND:g} if the sd is correct; power: share of fits that distinguish "
        "it from 0 or the stated ratio; `tvsbayes plan` gives the number of looks for a target",
        reported,
        f"stopped: {ran} campaigns ran and are kept; the same command goes on from there"
        if result.campaigns < result.asked
        else None,
        *labelled("failed", result.problems[:5]),
    )

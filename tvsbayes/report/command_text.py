"""Texts of commands other than `fit`: cameras, coordinates, comparisons, plans, studies; units in heads and words."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import UNSET

from tvsbayes.calibration.pointing import Steps
from tvsbayes.display import concise
from tvsbayes.errors import escaped
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT
from tvsbayes.report.document import Part, terminal
from tvsbayes.report.parameter_words import made_by, name_in_words
from tvsbayes.report.result_tables import gap_table, hold_out_table, point_budget_table
from tvsbayes.report.tables import TableView, text_width, two_digits
from tvsbayes.results.comparison_record import Comparison, Gap, HoldOut, PositionHoldOut
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
    from tvsbayes.planning.planner import CurveRow, PlanResult
    from tvsbayes.studies.study import StudyResult


def extrapolated_text(unseen: str) -> str:
    """The warning of a result at counters without looks; `unseen` names these counters."""
    return f"EXTRAPOLATED: {unseen}, where looks were; errors of the gears are predicted there from their size only"


KEY_WORDS = {
    "ok_spots": "usable spots",
    "refused": "refused spots, by reason",
    "aperture_readings": "spots with aperture reading",
    "experiments": "four-point experiments",
    "sheets_mm": "sheets, depth in mm",
    "costs_s": "costs, s",
    "look": "looks",
    "move": "moves",
    "home": "homings",
    "place": "placements of the sheet",
    "seen": "looks in view",
    "range_command": "commands, from and to",
}
"""Words of keys in the text of `check`."""
SIGHTING_WORDS = {
    "spots": "sightings",
    "ok_spots": "usable sightings",
    "refused": "refused sightings, by reason",
    **dict.fromkeys(("aperture_readings", "experiments"), ""),
}
"""Words for looks without images; "" omits a key."""
UNSEEN_SHOWN = 5
"""Largest number of notes on counters without looks, for a file of points."""
PLAN_UNIT = {"contrast": "deg/step", "backlash": "deg", "mirror_offset": "mm"}
"""Units of results in a plan, by the beginning of their names; deg/step for ratios."""


def check_text(document: Mapping[str, Any], has_images: bool = True) -> str:
    """The text of `check` for a campaign, rig, plan, axis or journal: a table, and warnings.

    Args:
        document: document of `check --json`.
        has_images: whether looks are spots in images; else sightings.
    """
    omitted = ("kind", "findings", "warnings", "faults", "expected", "contraction", "journal")
    words = KEY_WORDS | ({} if has_images else SIGHTING_WORDS)
    rows = [
        [words.get(key, key), _value_text(value)]
        for key, value in document.items()
        if key not in omitted and words.get(key) != ""
    ]
    parts: list[Part] = [TableView(document["kind"], [], rows)]
    if "expected" in document:
        parts.append(_expected_table(document["expected"], document["contraction"]))
    if (journal := document.get("journal")) is not None:
        rows = [[key, _value_text(value)] for key, value in journal.items() if key != "kind"]
        parts.append(TableView("journal of the run", [], rows))
    parts += [f"warning: {warning}" for warning in document["warnings"]]
    count = sum(finding["certain"] for finding in document.get("findings", ()))
    parts += [f"certain: {count} of them; `fit` and `calibrate` stop there, --anyway goes on"] * bool(count)
    return terminal(*parts)


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


LAW = (
    "values are those of the draws; law: digits of u to which the law of propagation (GUM) agrees, else by how much "
    "an end of its 95 % interval differs"
)
"""Note below a table of points."""
STATED_APERTURE = (
    "the campaign has no aperture readings: distances rest on baseline, emission angle at pan 0 and the aperture's "
    "zero as stated"
)


def plan_text(result: PlanResult) -> str:
    """A plan as text."""
    unit = result.target.unit
    lines = [f"target: {result.target.text}; now {result.now:.3g} {unit}", ""]
    lines.append("experiments  looks  minutes     classic       joint  chance of success")
    for p in _curve_shown(result):
        classic_value, joint = ("-" if value is None else f"{value:.3g}" for value in (p.classic, p.joint))
        lines.append(
            f"{p.experiments:11d}  {LOOKS_PER_EXPERIMENT * p.experiments:5d}  {p.minutes:7.1f}  "
            f"{classic_value:>10}  {joint:>10}  {100 * p.assurance:6.0f} +- {100 * p.assurance_se:.1f} %"
        )
    symbol = result.target.text.partition("(")[0]
    lines.append(f"{symbol} in {unit}, medians over {result.draws} drawn instruments; an experiment is four looks;")
    lines.append("chance of success (assurance): that the fit of such a campaign reports the target as met")
    lines.append("a row but the plan's takes the first looks of the longest: few may leave a direction without a stop")
    largest = result.curve[-1].experiments
    for level, n in zip(ASSURED, (result.n80, result.n95), strict=True):
        count = f"not reached with up to {_size_text(largest)}" if n is None else _size_text(n)
        lines.append(f"for a chance of {100 * level:.0f} %: {count}")
    if result.assurance is None or result.assurance_se is None:
        lines.append("the target is met already: nothing is left to do")
    else:
        lines.append(
            f"the plan: {_size_text(result.experiments)} in {result.minutes:.1f} minutes; chance of success "
            f"{100 * result.assurance:.0f} +- {100 * result.assurance_se:.1f} %"
        )
    lines += ["", f"{'plan':10}  spots  in view  minutes  expected {unit}"]
    lines += [
        f"{b.name:10}  {b.spots:5d}  {b.seen:7d}  {b.minutes:7.1f}  {'-' if b.joint is None else f'{b.joint:.3g}'}"
        for b in result.baselines
    ]
    shares = ", ".join(f"{name} {100 * s:.0f} %" for name, s in list(result.shares.items())[:5])
    lines += ["", f"after the plan the variance consists of: {shares}"]
    verdict = "lies below the target" if result.limit.reachable else "NO NUMBER OF LOOKS MEETS THE TARGET"
    lines.append(f"floor {result.limit.floor:.3g} {unit}, set by {result.limit.cause}: {verdict}")
    if result.limit.needed:
        lines.append(result.limit.needed)
    if result.classic is not None:
        c = result.classic
        low, high = c.experiments_interval95
        source = "measured" if c.from_data else "predicted"
        lines.append(
            f"classic, {c.direction}: n = (t s / E)^2 = {c.experiments} four-point experiments ({low} to {high}) for "
            f"s = {c.sd:.2g} deg/step ({source}), E = {c.half_width:.2g}; its systematic error {c.systematic:+.2g} "
            f"({c.systematic_interval95[0]:+.2g} to {c.systematic_interval95[1]:+.2g}) does not depend on n"
        )
    lines += [f"note: {note}" for note in result.notes]
    if result.next:
        lines.append("next four looks, best first:")
        lines += [f"  {b.gain_per_minute:.2g} {unit} a minute ({b.minutes:.1f} min): {b.text}" for b in result.next[:3]]
        lines.append(f"{'STOP' if result.stop.now else 'go on'}: {result.stop.reason}; {result.stop.rule}")
    return "\n".join(lines)


def _size_text(experiments: int) -> str:
    return f"{experiments} experiment{'s' * (experiments != 1)} ({LOOKS_PER_EXPERIMENT * experiments} looks)"


def _curve_shown(result: PlanResult) -> list[CurveRow]:
    """Points of the curve up to the first with the higher assurance, the next one, and the last."""
    enough = next((k for k, p in enumerate(result.curve) if p.assurance >= ASSURED[1]), len(result.curve))
    return [p for k, p in enumerate(result.curve) if k <= enough + 1 or k == len(result.curve) - 1]


def stereo_text(stereo: Stereo) -> str:
    """The 24 parameters of a pair with their standard uncertainties, both cameras side by side."""
    sds = np.sqrt(np.diag(stereo.parameter_covariance))
    cells = [concise(float(value), float(sd)) for value, sd in zip(stereo.vector, sds, strict=True)]
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    units = ("px",) * 4 + ("",) * 5
    rows = [[name, cells[k], cells[9 + k], unit] for k, (name, unit) in enumerate(zip(names, units, strict=True))]
    title = f"stereo pair, {stereo.image_width} x {stereo.image_height} px"
    if stereo.right_image_size is not None:
        title += "; right camera {} x {} px, scaled to that".format(*stereo.right_image_size)
    cameras = TableView(title, ["", "left(u)", "right(u)", "unit"], rows)
    rows = [[axis, cells[18 + k], cells[21 + k]] for k, axis in enumerate("xyz")]
    return terminal(cameras, TableView("x_right = R x_left + T", ["", "rotation, rad", "T, mm"], rows))


def stereo_calibration_text(result: StereoCalibration) -> str:
    """A calibration from checkerboards as text: parameters, views, remarks."""

    def px(value: float | None) -> str:
        return "-" if value is None else f"{value:.3f}"

    rows = []
    for view in result.views:
        cells = [px(view.left_rms_px), px(view.right_rms_px), f"{view.distance_mm:.0f}", f"{view.tilt_deg:.0f}"]
        rows.append([escaped(view.name) or "-", *cells, "OUTLIER" if view.outlier else ""])
    columns = ["view", "left rms px", "right rms px", "distance mm", "tilt deg", ""]
    board, pitch_mm = result.board, result.triangulated_pitch_mm
    lines: list[Part] = [
        stereo_text(result.stereo),
        TableView(f"{result.pairs} pairs, {len(result.views) - result.pairs} single views", columns, rows),
        f"rms over corners: both {result.stereo.rms_px:.3f}, left {px(result.left_rms_px)}, right "
        f"{px(result.right_rms_px)} px; one coordinate: sd {result.noise_sd_px:.3f} px, dof {result.dof}",
        "uncertainties hold for corner errors that the corners of a picture share: variances "
        f"{result.correlation_factor:.1f} times those of independent corners",
        f"and for a board whose corners are {result.board_error_mm:.2g} mm off a grid, as the residuals show",
        f"baseline {concise(float(np.linalg.norm(result.stereo.T)), result.baseline_sd_mm)} mm; squares, triangulated: "
        f"{pitch_mm.value:.3f} mm on average, sd {pitch_mm.sd:.3f}, stated {board.pitch_mm:g}",
        "boards cover "
        + ", ".join(f"{100 * share:.0f} % of the {side} image" for side, share in result.coverage.items()),
    ]
    if (pictures := result.pictures) is not None:
        names_by_note = {
            "without their counterpart": pictures.unpaired,
            "no camera in the name, not used": pictures.unnamed,
            "no board found": pictures.without_board,
            "another size, not used": pictures.other_size,
            "found by the other finder": pictures.by_fallback,
        }
        lines += [
            f"{len(names)} {note}: {escaped(', '.join(names), 400)}" for note, names in names_by_note.items() if names
        ]
    if result.reordered:
        lines.append(f"right corners turned to agree: {escaped(', '.join(result.reordered), 400)}")
    if result.excluded:
        lines.append(f"left out: {escaped(', '.join(result.excluded), 400)}")
    lines += [f"warning: {warning}" for warning in result.warnings]
    return terminal(*lines)


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
    sd = (
        ""
        if detection.median_sd_px is None
        else f"median standard uncertainty of a coordinate {detection.median_sd_px:.3f} px; "
    )
    title = f"{detection.processed} looks"
    table = TableView(title, ["status", "looks", "meaning"], rows)
    lines = [
        f"{side} camera: odd and even {gap.lines} of {gap.spots} spot{'s' * (gap.spots != 1)} show the beam "
        f"{gap.apart_px:.2g} px apart, more than their noise: an interlaced readout, or a beam that moved or flickered "
        "while it was read. Their uncertainty is widened by the difference / sqrt(12); read whole frames at once "
        "(progressive, global shutter), or let the beam come to rest"
        for side, gaps in detection.lines.items()
        for gap in gaps
    ]
    lines += [f"warning: {text}" for text in detection.warnings]
    return terminal(table, f"method {detection.method}; {sd}noise: {noise}", *lines)


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
        verdict = f"same to {digits} digit{'s' * (digits > 1)}" if digits else f"off by {difference} mm"
        # For an extrapolated point the comparison with the law is irrelevant.
        rows.append([str(index), *cells, half, "EXTRAPOLATED" if locations.extrapolated[index] else verdict])
    columns = ["point", "x(u) mm", "y(u) mm", "z(u) mm", "U95 mm", "law"]
    table = TableView(f"frame T, {locations.draws} draws ({locations.estimator})", columns, rows)
    # The points of a file may be extrapolated for different reasons.
    missing = zip(locations.unseen, locations.refused, strict=True)
    counters = dict.fromkeys(words for words, error in missing if words and not error)
    notes = [extrapolated_text(words) for words in list(counters)[:UNSEEN_SHOWN]]
    if len(counters) > UNSEEN_SHOWN:
        notes.append(f"and {len(counters) - UNSEEN_SHOWN} more counters that no look reached")
    stated = [] if aperture_read else textwrap.wrap(STATED_APERTURE, text_width())
    return terminal(table, *textwrap.wrap(LAW, text_width()), *stated, *notes)


LAW_SHARE = 0.95
"""Least share of tested points where the law of propagation must hold for reliable sds."""


def _points(count: int) -> str:
    return f"{count} point{'s' * (count != 1)}"


def cloud_text(cloud: CloudFile, check: LawChecked, calibration: Calibration) -> str:
    """A written cloud as text: files, refused points, validity of its uncertainties."""
    lines = [f"written: {escaped(cloud.cloud, 200)}, {_points(cloud.written)}, frame T, mm"]
    lines.append(f"properties: {', '.join(cloud.columns)}")
    agreement = (
        f"sds by the law of propagation (GUM): of {_points(check.points)} carried by draws too it holds to a digit or "
    )
    agreement += f"more at {check.held}"
    if check.off_mm is not None and check.most_off_mm is not None:
        agreement += f"; ends of 95 % intervals differ by {two_digits(check.off_mm)} mm at half of them, at most by "
        agreement += f"{two_digits(check.most_off_mm)} mm"
    lines.append(agreement)
    if check.held < LAW_SHARE * check.points:
        lines.append("do not rely on the sds of this cloud: `tvsbayes locate` --points without --cloud gives draws")
    elif check.points:
        lines.append("the sds may be relied on")
    if cloud.extrapolated:
        ranges = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in calibration.seen_steps.items())
        lines.append(
            f"{_points(cloud.extrapolated)} EXTRAPOLATED: outside {ranges}, where looks were; errors of the gears are "
            "predicted there by their size alone"
        )
    if cloud.refused_file is not None:
        reasons = ", ".join(f"{code} {number}" for code, number in sorted(cloud.reasons.items()))
        verb = "look has" if cloud.refused == 1 else "looks have"
        name = escaped(cloud.refused_file, 200)
        lines.append(f"{cloud.refused} {verb} no point ({reasons}): lines and reasons in {name}")
    return "\n".join(lines)


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
    lines = [
        f"go to      pan {steps.via_pan_steps}, tilt {steps.via_tilt_steps} steps (takes up the backlash)",
        f"then to    pan {steps.pan_steps}, tilt {steps.tilt_steps} steps, moving {pan} and {tilt}",
    ]
    if steps.u95_mm is not None:
        half = ", ".join(map(two_digits, steps.u95_mm))
        lines.append(f"whole steps leave {steps.rounding_mm:.3g} mm; beam there +- ({half}) mm (95 %)")
    if steps.aperture_deg is not None:
        lines.append(f"the aperture should read {steps.aperture_deg:.3f} deg")
    if steps.u95_deg is not None:
        half = ", ".join(map(two_digits, steps.u95_deg))
        lines.append(f"whole steps leave {steps.rounding_deg:.3g} deg; azimuth and elevation +- ({half}) deg (95 %)")
    if steps.extrapolated:
        lines.append(extrapolated_text(steps.unseen))
    return "\n".join(lines)


def gap_text(gaps: Mapping[str, Gap | None]) -> str:
    """The gap between both estimators by its terms, as text."""
    return terminal(gap_table(gaps))


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
    rows = []
    for p in hold_out.positions:
        predicted = concise(p.predicted, p.u), f"{p.z:+.1f}"
        rows.append([p.axis, str(p.position), p.direction, str(p.n), f"{p.mean:.4f}", *predicted])
    caption = "counters left out and predicted, mirror angles in deg; z in stated uncertainties"
    table = TableView(caption, ["axis", "counter", "direction", "n", "mean", "predicted(u)", "z"], rows)
    summary = [] if hold_out.rms_z is None else [f"RMS z {hold_out.rms_z:.2f}"]
    return terminal(table, *summary, *(f"warning: {text}" for text in hold_out.warnings))


def changes_text(comparison: Comparison) -> str:
    """Changes between two calibrations of one instrument as text."""
    rows = []
    for c in comparison.changes:
        # To the digits of the difference's u.
        values = [concise(value, c.u).partition("(")[0] for value in (c.first, c.second)]
        cells = [c.label, *values, concise(c.difference, c.u), escaped(c.unit)]
        normalised = "fixed" if c.normalised is None else f"{c.normalised:+.2f}"
        rows.append([*cells, normalised, "yes" if c.significant else "no"])
    title = "A and B"
    if comparison.reference_pose_deg is not UNSET:
        pan, tilt = comparison.reference_pose_deg
        title += f" at pan {pan:.2f} deg, tilt {tilt:.2f} deg"
    if comparison.range_command is not UNSET:
        low, high = comparison.range_command
        title += f" from command {low:.10g} to {high:.10g}"
    table = TableView(title, ["quantity", "A", "B", "B - A (u)", "unit", "normalised", "significant"], rows)
    days = "" if comparison.days is None else f" in {comparison.days:.1f} days"
    cameras = {True: "; the same stereo calibration: its error is left out of u", False: "; two cameras"}
    shared = cameras.get(comparison.shared_cameras is True) if comparison.shared_cameras is not UNSET else ""
    verdict = f"{comparison.verdict}{days} (limit {comparison.limit:.2f} u for all together{shared})"
    ratios = [c for c in comparison.changes if "per" in c.quantity and c.u > 0]
    if ratios and not any(c.significant for c in comparison.changes):
        share = max(comparison.limit * c.u / abs(c.first) for c in ratios)
        verdict += (
            f"\nsmaller changes are not excluded: a ratio may have changed by up to {100 * share:.2g} % undetected; "
            "`tvsbayes watch A B` compares what was seen in B with A and detects smaller changes"
        )
    return terminal(table, verdict)


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
    title = f"{ran} simulated campaigns, {n} fits converged ({made_by(result.estimator)}); "
    lines: list[Part] = [TableView(f"{title}{result.seconds:.1f} s each", columns, rows)]
    a, b = result.assurance_interval95
    share = f"{100 * result.assurance:.1f} % of fits ({100 * a:.1f} to {100 * b:.1f} %)"
    lines.append(f"{t.text}: reported as met by {share}")
    if a < ASSURED[0] <= b:
        lines.append(f"too few campaigns to decide whether {100 * ASSURED[0]:.0f} % do: add more with a larger --n")
    lines.append(
        f"bounds: exceeded with a probability of {BOUND:g} if the sd is correct; power: share of fits that distinguish "
        "it from 0 or the stated ratio; `tvsbayes plan` gives the number of looks for a target"
    )
    if result.reported is not None:
        lines.append("reported: {:.3g}, {:.3g}, {:.3g}".format(*result.reported) + f" {t.unit} (5, 50, 95 % of fits)")
    if result.campaigns < result.asked:
        lines.append(f"stopped: {ran} campaigns ran and are kept; the same command goes on from there")
    lines += [f"failed: {p}" for p in result.problems[:5]]
    return terminal(*lines)

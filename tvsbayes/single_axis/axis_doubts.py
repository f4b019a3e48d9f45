"""Doubts about the data of an axis before any fit: miscounted steps, a wrong stated ratio, outliers."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from tvsbayes.errors import listed
from tvsbayes.instrument.conditions import temperature_doubts
from tvsbayes.instrument.stops import lone_doubts
from tvsbayes.results.estimates import CONFLICT_LIMIT
from tvsbayes.single_axis.axis_campaign import AxisCampaign, Reading
from tvsbayes.single_axis.axis_parameters import axis_priors
from tvsbayes.single_axis.axis_rows import AxisRows
from tvsbayes.single_axis.classic_line import fit_line

SLOPE_SHARE, SLOPE_ERRORS = 0.2, 6.0
"""Least difference of a doubtful segment's slope from the others, as a share and in standard errors: errors by position
change it by some per cent, miscounted steps by a factor of 2 or more."""
PLAYS = 4.0
"""Least shift of the segment's end by that difference, in plays and scatters: stops inside the play change the slope of
short segments."""
WILD = 6.0
"""Least deviation of an outlier among readings at one stop, in standard deviations."""
STOPS_MIN = 5
"""Least number of stops with several readings: with fewer, the scatter is too uncertain for this test."""
WILD_STOP, STOPS_JUDGED_MIN = 12.0, 8
"""Least deviation of a wild stop from the line, in typical deviations, and least number of stops for this test."""
WILD_SHARE = 0.1
"""Least deviation of a wild stop as a share of the travel: errors of gears and scatter of stops are smaller."""
LINE_SLOPE = float(np.sqrt(12.0))
"""Largest sd of a line's slope over a range of 1 from errors of sd 1, for any dependence on position."""


def axis_warnings(campaign: AxisCampaign, rows: AxisRows) -> list[str]:
    """Doubts about the data, in sentences."""
    sentences = temperature_doubts(campaign.moves)
    if campaign.limits is not None:
        low, high = campaign.limits
        beyond = [m.move for m in campaign.moves if not m.assumed and not low <= m.command <= high]
        words = f"commands beyond `limits = [{low:.10g}, {high:.10g}]` of [axis]: moves {listed(beyond, 5)}"
        sentences[:0] = [f"{words}; correct one of both"] if beyond else []
    unread, readings = len(campaign.readings) - int(rows.count.sum()), len(campaign.readings)
    if rows.in_motion:
        if not any(r.u > 0 for r in campaign.readings):
            found = f"{rows.reading_u:.2g} {rows.unit} by differences of neighbours"
            sentences.append(f"no reading has a stated u: {found}")
        if unread:
            sentences.append(f"{unread} of {readings} readings are not used: their status is not ok")
        return sentences
    sentences += lone_doubts(campaign.moves, [move.command for move in campaign.moves], "command")
    unmoved = [int(m) for m in rows.move if rows.legs.step[m] == 0 and not rows.legs.first[m]]
    if unmoved:
        sentences.append(
            f"same command as the move before: moves {listed(unmoved, 5)}; nothing moved, so they are of one stop and "
            "side; list the moves in between if the axis went on and came back"
        )
    if len({m.time_s for m in campaign.moves}) == 1:
        sentences.append("all moves have the same time: drift is not determined")
    if not np.any(rows.variance > 0):
        sentences.append("no reading has a stated u: the scatter of stops includes that of the readings")
    if unread:
        sentences.append(f"{unread} readings are not used: their status is not ok")
    return sentences + data_doubts(campaign, rows)


def data_doubts(campaign: AxisCampaign, rows: AxisRows) -> list[str]:
    """Doubts about commands, readings and the stated ratio."""
    wild = _wild_readings(campaign, rows)
    return [*_odd_segments(rows), *_odd_ratio(campaign, rows), *(wild or _wild_stops(campaign, rows))]


def _odd_segments(rows: AxisRows) -> list[str]:
    """Segments whose slope differs from that of the others."""
    members = {int(segment): rows.segment == segment for segment in np.unique(rows.segment)}
    # Three rows determine offset, slope and play; a fourth their scatter.
    judged = {k: of for k, of in members.items() if of.sum() > 3 and np.ptp(rows.command[of]) > 0}
    lines, sentences = {k: fit_line(rows, of) for k, of in judged.items()}, []
    for segment, line in lines.items():
        # If two segments differ, the data do not show which one is wrong: both are named.
        others = [other for number, other in lines.items() if number != segment or len(lines) > 2]
        if not others:
            continue
        typical = sorted(others, key=lambda other: float(other.solution[1]))[(len(others) - 1) // 2]
        slope, reference = float(line.solution[1]), float(typical.solution[1])
        u = float(np.sqrt(line.covariance[1, 1] + typical.covariance[1, 1]))
        gap, span = abs(slope - reference), float(np.ptp(rows.command[judged[segment]]))
        bound = max(abs(float(fit.solution[2])) + fit.scatter for fit in (line, typical))
        if gap > max(SLOPE_SHARE * min(abs(slope), abs(reference)), SLOPE_ERRORS * u) and gap * span > PLAYS * bound:
            sentences.append(
                f"segment {segment} reads {slope:.5g} {rows.unit} per command, {slope / reference:.3g} times what "
                f"others read ({reference:.5g}): its commands were counted in other steps (full steps among "
                "microsteps?) or its readings have another unit; write moves.csv and readings.csv in the same ones"
            )
    return sentences


def _odd_ratio(campaign: AxisCampaign, rows: AxisRows) -> list[str]:
    """A stated unit per command that is not the slope of the readings."""
    prior = campaign.stated.get("per_command")
    if prior is None:
        return []
    slope = rows.line.slope
    error = axis_priors(campaign.stated, rows.travel, slope)["transmission_error"]
    by_position = LINE_SLOPE * max(error.u, error.value) / float(np.ptp(rows.command))
    u_line = float(np.sqrt(fit_line(rows).covariance[1, 1]))
    if abs(slope - prior.value) <= CONFLICT_LIMIT * float(np.linalg.norm([prior.u, u_line, by_position])):
        return []
    return [
        f"campaign.toml: [axis] states per_command = {prior.value:g} (u = {prior.u:g}), the readings rise by "
        f"{slope:.5g} {rows.unit} per command, {slope / prior.value:.3g} times as much: state the ratio for the steps "
        "that moves.csv counts (microsteps or full steps?) with the sign and unit of the readings, or a wider u, or "
        "leave it out"
    ]


def _wild(reading: int, move: int, rows: AxisRows, distance: str) -> str:
    return (
        f"reading {reading} (move {move}, command {rows.legs.command[move]:.10g}) lies {distance}: look at it in "
        "readings.csv, and if it is wrong give it another status than ok, such as wild"
    )


def _wild_readings(campaign: AxisCampaign, rows: AxisRows) -> list[str]:
    """Readings far from the others at their stop; if two differ, the reading farther from the line."""
    stops: dict[int, list[Reading]] = defaultdict(list)
    for reading in campaign.readings:
        if reading.status == "ok" and reading.value is not None:
            stops[reading.move].append(reading)
    line = fit_line(rows)
    side = {int(move): int(s) for move, s in zip(rows.move, rows.side, strict=True)}
    farthest: list[Reading] = []
    apart, sds = [], []
    for move, readings in stops.items():
        if len(readings) < 2:
            continue
        values, u = (np.array([float(getattr(r, name) or 0.0) for r in readings]) for name in ("value", "u"))
        centre = float(np.median(values))
        if len(readings) == 2:
            # Both are at the same distance from their median.
            design = [1.0, rows.legs.command[move] - rows.command.mean(), -0.5 * np.sign(rows.line.slope) * side[move]]
            centre = float(np.dot(design, line.solution))
        k = int(np.argmax(np.abs(values - centre)))
        others = np.delete(values, k)
        farthest.append(readings[k])
        apart.append(float(values[k] - np.median(others)))
        sds.append(float(np.hypot(u[k], np.linalg.norm(np.delete(u, k)) / len(others))) if all(u) else 0.0)
    if len(farthest) < STOPS_MIN:
        return []
    # Without a stated u, the scale is their typical difference; a stated u may be too small.
    known = all(sd > 0 for sd in sds)
    sizes = np.abs(apart) / (np.array(sds) if known else 1.0)
    typical = float(np.median(sizes)) / 0.6745
    scale = max(typical, 1.0) if known else typical
    return [
        _wild(
            *(reading.reading, reading.move, rows),
            f"{distance:+.3g} {rows.unit}, {size / scale:.0f} sds, off what else was read at its stop",
        )
        for reading, distance, size in zip(farthest, apart, sizes, strict=True)
        if size > WILD * scale > 0
    ]


def _off_robust_line(rows: AxisRows) -> tuple[np.ndarray, float]:
    """Deviations (rows,) from a robust line with a reversal and an offset of each segment, and the reversal, unit.

    Medians: the slope of pairs half the rows apart on one side, then each side of each segment. All pairs (Theil, Sen)
    would determine the slope somewhat better, in a time quadratic in the rows.
    """
    slopes = []
    for side in np.unique(rows.side):
        of_side = np.flatnonzero(rows.side == side)
        of_side = of_side[np.argsort(rows.command[of_side], kind="stable")]
        half = len(of_side) // 2
        near, far = of_side[: len(of_side) - half], of_side[half:]
        spacing = rows.command[far] - rows.command[near]
        slopes += ((rows.value[far] - rows.value[near])[spacing > 0] / spacing[spacing > 0]).tolist()
    deviations = rows.value - float(np.median(slopes or [rows.line.slope])) * rows.command
    reversals = []
    for segment in np.unique(rows.segment):
        centres = {}
        for side in (-1, 0, 1):
            members = (rows.segment == segment) & (rows.side == side)
            if members.any():
                centres[side] = float(np.median(deviations[members]))
                deviations[members] -= centres[side]
        if {-1, 1} <= set(centres):
            reversals.append(abs(centres[1] - centres[-1]))
    return deviations, float(np.median(reversals or [0.0]))


def _wild_stops(campaign: AxisCampaign, rows: AxisRows) -> list[str]:
    """Single readings far from the line through all others, where stops were read once.

    A stop after a short leg may lie inside the play and is not judged.
    """
    if len(rows.value) < STOPS_JUDGED_MIN:
        return []
    deviations, reversal = _off_robust_line(rows)
    typical = float(np.median(np.abs(deviations))) / 0.6745
    wild = np.abs(deviations) > max(WILD_STOP * typical, WILD_SHARE * rows.travel)
    leg = np.abs(rows.legs.step[rows.move] * rows.line.slope)
    reading = {r.move: r.reading for r in campaign.readings if r.status == "ok"}
    off = f"{rows.unit} off the line through the others, typical is {typical:.2g}"
    return [
        _wild(reading[int(rows.move[k])], int(rows.move[k]), rows, f"{deviations[k]:+.3g} {off}")
        for k in np.flatnonzero(wild & (leg > PLAYS * reversal))
    ]

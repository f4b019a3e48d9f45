"""What is odd about the data of an axis before any fit: counts of other steps, a wrong ratio stated, wild readings."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from tvsbayes.errors import listed
from tvsbayes.results.estimates import CONFLICT_LIMIT
from tvsbayes.single_axis.axis_campaign import AxisCampaign, Reading
from tvsbayes.single_axis.axis_parameters import axis_priors
from tvsbayes.single_axis.axis_rows import AxisRows
from tvsbayes.single_axis.classic_line import LineFit, fit_line

SLOPE_SHARE, SLOPE_ERRORS = 0.2, 6.0
"""A segment's own slope is odd from this share of the others' on, and so many standard errors: errors by position make
some per cent, steps miscounted a factor of 2 or more."""
PLAYS = 4.0
"""Plays and scatters by which that must move an end of the segment: stops inside the play bend short segments."""
WILD = 6.0
"""Standard deviations of readings at one stop."""
STOPS_MIN = 5
"""With several readings, below which their scatter is not known well enough to call one wild."""
WILD_STOP, STOPS_JUDGED_MIN = 12.0, 8
"""Typical distances from the line through the others by which a stop is wild, and stops from which on that is asked."""
WILD_SHARE = 0.1
"""Of the travel, which a wild stop is off too: no gear errs and no stop scatters by so much."""
LINE_SLOPE = float(np.sqrt(12.0))
"""Largest sd of the slope that errors of sd 1, however they go with position, give a line over a range of 1."""


def axis_warnings(campaign: AxisCampaign, rows: AxisRows) -> list[str]:
    """What is odd about the data, in sentences."""
    sentences = []
    if rows.in_motion:
        return _warnings_in_motion(campaign, rows)
    legs = rows.legs
    idle = (legs.step == 0) & ~legs.first
    again = [int(m) for m in rows.move if idle[m]]
    if again:
        sentences.append(
            f"same command as the move before: moves {listed(again, 5)}; nothing moved, so they are of one stop and "
            "side; list the moves in between if the axis went on and came back"
        )
    if len({m.time_s for m in campaign.moves}) == 1:
        sentences.append("all moves have the same time: drift is not determined")
    if not np.any(rows.variance > 0):
        sentences.append("no reading has a stated u: the scatter of stops includes that of the readings")
    unread = len(campaign.readings) - int(rows.count.sum())
    if unread:
        sentences.append(f"{unread} readings are not used: their status is not ok")
    return sentences + data_doubts(campaign, rows)


def _warnings_in_motion(campaign: AxisCampaign, rows: AxisRows) -> list[str]:
    """What is odd about a record of a drive that never stops."""
    sentences = []
    if not any(r.u > 0 for r in campaign.readings):
        sentences.append(f"no reading has a stated u: {rows.reading_u:.2g} {rows.unit} by differences of neighbours")
    unread = len(campaign.readings) - int(rows.count.sum())
    if unread:
        sentences.append(f"{unread} of {len(campaign.readings)} readings are not used: their status is not ok")
    return sentences


def data_doubts(campaign: AxisCampaign, rows: AxisRows) -> list[str]:
    """Of its numbers alone."""
    wild = _wild_readings(campaign, rows)
    return [*_odd_segments(rows), *_odd_ratio(campaign, rows), *(wild or _wild_stops(campaign, rows))]


def _odd_segments(rows: AxisRows) -> list[str]:
    """Segments whose own line rises otherwise than those of the others."""
    lines: dict[int, LineFit] = {}
    for segment in np.unique(rows.segment):
        mine = rows.segment == segment
        # Offset, slope and play take three rows; a fourth tells their scatter.
        if mine.sum() > 3 and np.ptp(rows.command[mine]) > 0:
            lines[int(segment)] = fit_line(rows, mine)
    sentences = []
    for segment, line in lines.items():
        # Of two that differ the data cannot say which is wrong: both are named.
        others = [other for number, other in lines.items() if number != segment or len(lines) > 2]
        if not others:
            continue
        typical = sorted(others, key=lambda other: float(other.solved[1]))[(len(others) - 1) // 2]
        slope, reference = float(line.solved[1]), float(typical.solved[1])
        u = float(np.sqrt(line.covariance[1, 1] + typical.covariance[1, 1]))
        off, reach = abs(slope - reference), float(np.ptp(rows.command[rows.segment == segment]))
        loose = max(abs(float(one.solved[2])) + one.scatter for one in (line, typical))
        if off > max(SLOPE_SHARE * min(abs(slope), abs(reference)), SLOPE_ERRORS * u) and off * reach > PLAYS * loose:
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
    slope = rows.line[1]
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


def _wild_readings(campaign: AxisCampaign, rows: AxisRows) -> list[str]:
    """Readings far off the others at their stop; of two that differ, the one farther off the line."""
    stops: dict[int, list[Reading]] = defaultdict(list)
    for reading in campaign.readings:
        if reading.status == "ok" and reading.value is not None:
            stops[reading.move].append(reading)
    line = fit_line(rows)
    side = {int(move): int(s) for move, s in zip(rows.move, rows.side, strict=True)}
    odd: list[tuple[Reading, float, float]] = []
    for move, each in stops.items():
        if len(each) < 2:
            continue
        values = np.array([float(r.value or 0.0) for r in each])
        middle = float(np.median(values))
        if len(each) == 2:
            # Both are as far from their middle.
            design = [1.0, rows.legs.command[move] - rows.command.mean(), -0.5 * np.sign(rows.line[1]) * side[move]]
            middle = float(np.dot(design, line.solved))
        k = int(np.argmax(np.abs(values - middle)))
        others = np.delete(values, k)
        u = [r.u for r in each]
        unit = float(np.hypot(u[k], np.linalg.norm(np.delete(u, k)) / len(others))) if all(u) else 0.0
        odd.append((each[k], float(values[k] - np.median(others)), unit))
    # Where no u is stated all are in one scale, that of their typical difference; a stated one may be too small.
    known = bool(odd) and all(unit > 0 for _, _, unit in odd)
    if len(odd) < STOPS_MIN:
        return []
    sizes = np.array([abs(off) / (unit if known else 1.0) for _, off, unit in odd])
    typical = float(np.median(sizes)) / 0.6745
    scale = max(typical, 1.0) if known else typical
    return [
        f"reading {reading.reading} (move {reading.move}, command {rows.legs.command[reading.move]:.10g}) lies "
        f"{off:+.3g} {rows.unit}, {size / scale:.0f} sds, off what else was read at its stop: look at it in "
        "readings.csv, and if it is wrong give it another status than ok, such as wild"
        for (reading, off, _), size in zip(odd, sizes, strict=True)
        if size > WILD * scale > 0
    ]


@dataclass(frozen=True)
class _MostLine:
    """A line with a reversal and a home of each segment that single rows do not bend.

    Attributes:
        off: distance of every row from it, unit, shape (rows,).
        lost: in the reversal, unit.
    """

    off: np.ndarray
    lost: float


def _line_through_most(rows: AxisRows) -> _MostLine:
    """Medians throughout: the slope of pairs half the rows apart on one side, then each side of each segment.

    All pairs (Theil, Sen) would tell the slope somewhat better, in a time that grows with the square of the rows.
    """
    slopes = []
    for side in np.unique(rows.side):
        of_side = np.flatnonzero(rows.side == side)
        of_side = of_side[np.argsort(rows.command[of_side], kind="stable")]
        half = len(of_side) // 2
        near, far = of_side[: len(of_side) - half], of_side[half:]
        apart = rows.command[far] - rows.command[near]
        slopes += ((rows.value[far] - rows.value[near])[apart > 0] / apart[apart > 0]).tolist()
    off = rows.value - float(np.median(slopes or [rows.line[1]])) * rows.command
    lost = []
    for segment in np.unique(rows.segment):
        sides = [(rows.segment == segment) & (rows.side == side) for side in (-1, 0, 1)]
        middles = [float(np.median(off[mine])) if mine.any() else None for mine in sides]
        if middles[0] is not None and middles[2] is not None:
            lost.append(abs(middles[2] - middles[0]))
        for mine, middle in zip(sides, middles, strict=True):
            off[mine] -= middle or 0.0
    return _MostLine(off, float(np.median(lost or [0.0])))


def _wild_stops(campaign: AxisCampaign, rows: AxisRows) -> list[str]:
    """Single readings far off the line through all others, where stops were read once.

    A stop that a short leg reached may stand inside the play and is not judged.
    """
    if len(rows.value) < STOPS_JUDGED_MIN:
        return []
    line = _line_through_most(rows)
    typical = float(np.median(np.abs(line.off))) / 0.6745
    wild = np.abs(line.off) > max(WILD_STOP * typical, WILD_SHARE * rows.travel)
    way = np.abs(rows.legs.step[rows.move] * rows.line[1])
    reading = {r.move: r.reading for r in campaign.readings if r.status == "ok"}
    return [
        f"reading {reading[int(rows.move[k])]} (move {rows.move[k]}, command {rows.command[k]:.10g}) lies "
        f"{line.off[k]:+.3g} {rows.unit} off the line through the others, typical is {typical:.2g}: look at it in "
        "readings.csv, and if it is wrong give it another status than ok, such as wild"
        for k in np.flatnonzero(wild & (way > PLAYS * line.lost))
    ]

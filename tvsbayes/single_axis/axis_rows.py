"""An axis campaign as arrays: stops with readings, sides of approach, state of the play.

A row is a move with its readings averaged; for a drive at constant rate, it is the mean over a short time
(`_rows_in_motion`). Positions are commands; `unit` is that of the readings. Formulation 8.1.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from tvsbayes.errors import InputError, NothingToEstimate, listed
from tvsbayes.gears.play import rests
from tvsbayes.gears.states import HOUR_S, travelled
from tvsbayes.instrument.conditions import degC_at, kelvin_at
from tvsbayes.single_axis.axis_campaign import TURNS, AxisCampaign, AxisMove, Reading
from tvsbayes.statistics.intervals import WithSd
from tvsbayes.statistics.wrapped import turn_jumps

SIDES = {"forward": 1, "backward": -1, "unknown": 0}
DIRECTIONS = {1: "forward", -1: "backward", 0: "unknown"}
ROWS_MAX = 2000
"""Largest number of moves with readings: a fit with this number takes minutes."""
LONG_LEGS, LONG_ERRORS = 2.0, 10.0
"""No stop lies inside the play where the shortest leg exceeds these numbers of reversals plus standard errors."""


@dataclass(frozen=True)
class Legs:
    """Every move of the campaign, read or not; arrays (moves,).

    Attributes:
        command: command after the move.
        step: change of the command; 0 in the first row of a segment.
        first: whether a segment begins.
        side: 1 arrived forward, -1 backward, 0 unknown; a move without motion keeps that of the previous one.
        segment: number of the segment.
    """

    command: np.ndarray
    step: np.ndarray
    first: np.ndarray
    side: np.ndarray
    segment: np.ndarray


class Line(NamedTuple):
    """The line of positions over commands: `offset`, unit, is that at command 0; `slope` is in unit per command."""

    offset: float
    slope: float


@dataclass(frozen=True)
class AxisRows:
    """Moves with readings; arrays (rows,).

    Attributes:
        unit: unit of the readings.
        legs: all moves.
        move: number of the move.
        command, side, segment: as in `Legs`.
        zero: number of the segment whose homing set the zero; 0 of an encoder that keeps it.
        hours: time since the previous row of the same zero, or since that segment's first move in its first row.
        path: commands travelled since the segment began.
        redrawn: whether the stop's error is new since the previous row.
        value: mean of the readings, unit.
        variance: variance of that mean by the stated u, unit^2; 0 where no u is known.
        within: sum of squares of the readings about their mean, in units of their u.
        count: readings in the mean.
        line: the least-squares line with a reversal.
        time_s: time on the clock of moves.csv.
        warm_s: time since the machine was switched on, or since the first move where that is unknown.
        kelvin: temperature minus that of the first move; None where none was recorded.
        width_s: time over which the readings of a row in motion were averaged; 0 at a stop.
        rate: commands per second of a drive at constant rate; None for stops.
        reading_u: u of a typical reading, unit; 0 where no u is known.
        command_unit: unit of the commands, as the folder states it; None where it does not.
        reference: errors of the rows per standard normal number of each cause of the reference, (rows, causes).
        reference_causes: names of these causes.
    """

    unit: str
    legs: Legs
    move: np.ndarray
    command: np.ndarray
    side: np.ndarray
    segment: np.ndarray
    zero: np.ndarray
    hours: np.ndarray
    path: np.ndarray
    redrawn: np.ndarray
    value: np.ndarray
    variance: np.ndarray
    within: np.ndarray
    count: np.ndarray
    line: Line
    time_s: np.ndarray
    warm_s: np.ndarray
    kelvin: np.ndarray | None
    width_s: np.ndarray
    rate: float | None
    reading_u: float
    command_unit: str | None = None
    reference: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    reference_causes: tuple[str, ...] = ()

    @property
    def in_motion(self) -> bool:
        """Whether the readings were taken on a drive at constant rate."""
        return self.rate is not None

    @property
    def travel(self) -> float:
        """Range of the positions read, unit."""
        return float(np.ptp(self.command)) * abs(self.line.slope)

    @property
    def positions(self) -> np.ndarray:
        """Commands with readings, ascending, without repetition."""
        return np.unique(self.command)

    @property
    def both_sides(self) -> bool:
        """Whether stops were reached forward and backward; stops of unknown side are ignored."""
        return {-1, 1} <= set(self.side.tolist())

    def log_density_within(self, reading_scale: np.ndarray) -> np.ndarray:
        """Log density (n,) of the readings about the means of their rows; constants include only those of u."""
        known = self.variance > 0
        freedom = float(np.sum(self.count[known] - 1))
        return -freedom * np.log(reading_scale) - 0.5 * float(self.within[known].sum()) / reading_scale**2

    @property
    def since_homing(self) -> np.ndarray:
        """Hours since the homing of each row's zero."""
        hours, first = np.cumsum(self.hours), np.searchsorted(self.zero, self.zero)
        return hours - hours[first] + self.hours[first]

    def without(self, left_out: np.ndarray) -> AxisRows:
        """The rows where `left_out` is false; `hours` and `redrawn` are adapted, the line stays."""
        kept = np.flatnonzero(~left_out)
        time_h = np.cumsum(self.hours)
        zero, (_, first) = self.zero[kept], np.unique(self.zero, return_index=True)
        homed_h = (time_h - self.hours)[first[np.searchsorted(self.zero[first], zero)]]
        changes = np.cumsum(self.redrawn)[kept]
        redrawn = np.r_[True, (np.diff(changes) > 0) | (np.diff(zero) > 0)]
        arrays = ("move", "command", "side", "segment", "zero", "path", "value", "variance", "within", "count")
        columns = {name: getattr(self, name)[kept] for name in (*arrays, "time_s", "warm_s", "width_s", "reference")}
        columns["kelvin"] = None if self.kelvin is None else self.kelvin[kept]
        hours = _since_row_before(time_h[kept], zero, homed_h)
        return replace(self, hours=hours, redrawn=redrawn, **columns)


def legs_of(moves: Sequence[AxisMove]) -> Legs:
    """The moves of a campaign."""
    command = np.array([m.command for m in moves])
    segment = np.array([m.segment for m in moves])
    first = np.r_[True, np.diff(segment) > 0]
    step = np.where(first, 0.0, np.r_[0.0, np.diff(command)])
    side = np.sign(step).astype(int)
    for row, move in enumerate(moves):
        if first[row]:
            side[row] = SIDES[move.approach or "unknown"]
        elif side[row] == 0:
            side[row] = side[row - 1]
    return Legs(command, step, first, side, segment)


def rows_of(campaign: AxisCampaign) -> AxisRows:
    """The rows of a campaign.

    Raises:
        NothingToEstimate: fewer than two positions were read, fewer than three moves, or the readings do not change.
        InputError: too many moves, or angles that wrap.
    """
    used = _expanded(campaign, [r for r in campaign.noisy if r.status == "ok" and r.value is not None])
    rows = _rows_at_stops(campaign, used) if campaign.rate is None else _rows_in_motion(campaign, used, campaign.rate)
    errors = reference_errors(campaign, rows.value, rows.time_s, _common_u(campaign, rows))
    reference = np.column_stack(list(errors.values())) if errors else np.zeros((len(rows.value), 0))
    rows = replace(rows, reference=reference, reference_causes=tuple(errors))
    return rows if rows.in_motion or legs_are_long(rows) else _line_with_play(rows)


def _rows(campaign: AxisCampaign, legs: Legs, move: np.ndarray, time_s: np.ndarray, **columns: Any) -> AxisRows:
    """The rows with what follows from their moves and times."""
    clock, segment = np.array([m.time_s for m in campaign.moves], dtype=float), legs.segment[move]
    zero = 0 * segment if campaign.absolute else segment
    of_zero = segment if campaign.rate is not None else zero
    homed_s = clock[np.searchsorted(legs.segment, of_zero)]
    return AxisRows(
        unit=campaign.unit,
        legs=legs,
        move=move,
        segment=segment,
        zero=zero,
        hours=_hours(time_s, zero, homed_s),
        time_s=time_s,
        warm_s=time_s - warm_from(campaign),
        kelvin=kelvin_at(campaign.moves, time_s, clock),
        rate=campaign.rate,
        command_unit=campaign.command_unit,
        **columns,
    )


STANDARD_DEGC = 20.0
"""Temperature at which lengths are stated (ISO 1)."""


def _above_standard(campaign: AxisCampaign, time_s: np.ndarray) -> np.ndarray:
    """Temperatures less 20 degC, (r,); 0 of a reference that does not expand."""
    clock = np.array([move.time_s for move in campaign.moves], dtype=float)
    degC = degC_at(campaign.moves, time_s, clock) if campaign.reference.expands else None
    return np.zeros(len(time_s)) if degC is None else degC - STANDARD_DEGC


def _expanded(campaign: AxisCampaign, readings: list[Reading]) -> list[Reading]:
    """Readings less the stated expansion of the reference: r at T means r (1 + expansion (T - 20 degC))."""
    if not campaign.reference.expands:
        return readings
    times = [campaign.moves[r.move].time_s if r.time_s is None else r.time_s for r in readings]
    value = np.array([r.value for r in readings], dtype=float)
    above = _above_standard(campaign, np.array(times, dtype=float))
    true = value * (1.0 + campaign.reference.expansion_per_K.value * above)
    return [replace(reading, value=v) for reading, v in zip(readings, true.tolist(), strict=True)]


def _common_u(campaign: AxisCampaign, rows: AxisRows) -> np.ndarray:
    """Mean u (r,) of each row's readings where they share their errors, else 0."""
    stated = defaultdict[int, list[float]](list)
    for reading in campaign.readings if campaign.reference.common else ():
        if reading.status == "ok" and reading.value is not None:
            stated[reading.move].append(reading.u)
    return np.array([np.mean(stated.get(int(move), [0.0])) for move in rows.move])


def reference_errors(
    campaign: AxisCampaign, value: np.ndarray, time_s: np.ndarray, common_u: np.ndarray
) -> dict[str, np.ndarray]:
    """Errors of readings (r,) at times (r,), with u in common, per standard normal number of each cause."""
    reference = campaign.reference
    errors = {
        "u": np.full(len(value), reference.u),
        "u_per_unit": reference.u_per_unit * value,
        "expansion_per_K": reference.expansion_per_K.u * value * _above_standard(campaign, time_s),
        "u of readings": common_u,
    }
    return {name: column for name, column in errors.items() if np.any(column != 0)}


def _refused(code: str, found: str, allowed: str, remedy: str, column: str | None = None) -> InputError:
    message = f"readings.csv: {found}; allowed: {allowed}"
    return InputError(code, message, file="readings.csv", column=column, remedy=remedy)


def _rows_at_stops(campaign: AxisCampaign, used: Sequence[Reading]) -> AxisRows:
    """A row for every move with readings, their mean.

    Without a stated u, it comes from repeated readings of one move; without these it is unknown, 0.
    """
    used = sorted(used, key=lambda r: r.move)
    value, u = np.array([r.value for r in used], dtype=float), np.array([r.u for r in used])
    at_move = np.array([r.move for r in used], dtype=int)
    moves, first, count = np.unique(at_move, return_index=True, return_counts=True)
    legs = legs_of(campaign.moves)
    command, side = legs.command[moves], legs.side[moves]
    if len(moves) < 3 or len(np.unique(command)) < 2:
        raise NothingToEstimate(
            "too-few-positions",
            f"readings of {len(moves)} moves at {len(np.unique(command))} positions: nothing to estimate",
            file="readings.csv",
            remedy="read at least three moves at two positions, better at five or more, from both directions",
        )
    if len(moves) > ROWS_MAX:
        remedy = "thin them out, or give readings at one standstill one move: they are averaged exactly"
        raise _refused("too-many", f"readings of {len(moves)} moves", f"at most {ROWS_MAX}", remedy)
    stated = u[u > 0]
    u = np.where(u > 0, u, scatter_within(value[u == 0], at_move[u == 0]))
    known = np.minimum.reduceat(u, first) > 0
    weight = np.where(np.repeat(known, count), 1.0 / np.where(u > 0, u, 1.0) ** 2, 1.0)
    total = np.add.reduceat(weight, first)
    mean = np.add.reduceat(weight * value, first) / total
    within = np.add.reduceat(weight * (value - np.repeat(mean, count)) ** 2, first)
    _check_turns(campaign, command, mean, moves)
    design = np.column_stack([np.ones(len(command)), command - command.mean(), side])
    level, slope, _ = np.linalg.lstsq(design, mean, rcond=None)[0]
    _check_motion(slope, command, mean, "check the columns move and value, and that the reading follows this axis")
    return _rows(
        *(campaign, legs, moves, np.array([m.time_s for m in campaign.moves], dtype=float)[moves]),
        command=command,
        side=side,
        path=travelled(legs.command, legs.segment)[moves],
        redrawn=_redrawn(legs, moves) | ~known,
        value=mean,
        variance=np.where(known, 1.0 / total, 0.0),
        within=np.where(known, within, 0.0),
        count=count,
        line=Line(float(level - slope * command.mean()), float(slope)),
        width_s=np.zeros(len(moves)),
        reading_u=float(np.median(stated)) if len(stated) else 0.0,
    )


def scatter_within(value: np.ndarray, group: np.ndarray) -> float:
    """Pooled sd of values (n,) about the means of their groups, numbers (n,); 0 where none has two."""
    count = np.bincount(group)
    mean = np.bincount(group, value) / np.maximum(count, 1)
    freedom = int(np.maximum(count - 1, 0).sum())
    return float(np.sqrt(np.sum((value - mean[group]) ** 2) / freedom)) if freedom else 0.0


def _check_turns(campaign: AxisCampaign, command: np.ndarray, value: np.ndarray, moves: np.ndarray) -> None:
    """Refuse angles that jump by whole turns."""
    turn = TURNS.get(campaign.unit)
    jumps = turn_jumps(command, value, turn) if turn is not None else {}
    if jumps:
        found = f"the angle jumps by whole turns at move {listed([int(moves[row]) for row in jumps], 5)}"
        remedy = f"unwrap them: add or subtract {turn:g} {campaign.unit}; or are command and value exchanged?"
        raise _refused("wrapped", found, "a continuous angle", remedy, "value")


def _check_motion(slope: float, command: np.ndarray, value: np.ndarray, remedy: str) -> None:
    """Refuse readings that do not follow the command."""
    if not abs(slope) * np.ptp(command) > 1e-9 * max(float(np.max(np.abs(value))), 1e-300):
        found = "the readings do not move with the command: nothing to estimate"
        raise NothingToEstimate("no-motion", found, file="readings.csv", remedy=remedy)


ROWS_IN_MOTION, PER_PERIOD, READINGS_IN_MOTION = 2000, 5.0, 100_000
"""Largest number of rows of a drive, rows in the shortest stated period, largest number of readings."""
WIDE_ROWS = 400
"""Number of rows of a drive without stated periods; fewer readings are not averaged."""
FLOOR_SHARE = 1e-9
"""Least u of a reading in motion, as a share of the travel."""


def _rows_in_motion(campaign: AxisCampaign, used: Sequence[Reading], rate: float) -> AxisRows:
    """The rows of a drive at constant rate: means of the readings of equal short times.

    The model averages a wave over the same times, so that only detail shorter than a fifth of the shortest period is
    lost. Without a stated u, it comes from second differences of neighbouring readings.
    """
    used = sorted((r for r in used if r.time_s is not None), key=lambda r: (r.move, r.time_s or 0.0))
    if len(used) > READINGS_IN_MOTION:
        remedy = "thin them out, or fit one part of the record"
        raise _refused("too-many", f"{len(used)} readings in motion", f"at most {READINGS_IN_MOTION}", remedy)
    if len(used) < 5:
        raise NothingToEstimate(
            "too-few-positions",
            f"{len(used)} readings in motion: nothing to estimate",
            file="readings.csv",
            remedy="read at least five, better several periods long",
        )
    move, legs = np.array([r.move for r in used]), legs_of(campaign.moves)
    time_s, value, u = (np.array([getattr(r, name) for r in used], dtype=float) for name in ("time_s", "value", "u"))
    command = legs.command[move] + rate * (time_s - np.array([m.time_s for m in campaign.moves])[move])
    _check_turns(campaign, command, value, move)
    slope = float(np.polyfit(command - command.mean(), value, 1)[0])
    remedy = "give total positions, not what they are off the drive; check the sign of `rate`"
    _check_motion(slope, command, value, remedy)
    u = np.where(u > 0, u, _neighbours_sd(value - slope * command, move))
    weight = 1.0 / np.maximum(u, FLOOR_SHARE * abs(slope) * np.ptp(command)) ** 2
    width = _width_s(campaign, abs(slope * rate), time_s, move)
    is_first = np.r_[True, np.diff(move) > 0]
    since_move_s = time_s - time_s[is_first][np.cumsum(is_first) - 1]
    bin_of = np.floor(since_move_s / width).astype(int) if width else np.arange(len(used))
    first = np.flatnonzero(np.r_[True, (np.diff(move) > 0) | (np.diff(bin_of) != 0)])
    total, count = np.add.reduceat(weight, first), np.diff(np.r_[first, len(used)])

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(weight * values, first) / total

    at, at_s, position = mean(command), mean(time_s), mean(value)
    design = np.column_stack([np.ones(len(at)), at - at.mean()])
    level, per_command = np.linalg.lstsq(design, position, rcond=None)[0]
    segment = legs.segment[move[first]]
    return _rows(
        *(campaign, legs, move[first], at_s),
        command=at,
        side=np.full(len(at), int(np.sign(rate))),
        path=np.abs(at - legs.command[np.searchsorted(legs.segment, segment)]),
        redrawn=np.r_[True, np.diff(segment) > 0],
        value=position,
        variance=1.0 / total,
        within=np.zeros(len(at)),
        count=count,
        line=Line(float(level - per_command * at.mean()), float(per_command)),
        width_s=np.sqrt(12.0) * np.sqrt(mean((time_s - np.repeat(at_s, count)) ** 2)),
        reading_u=float(np.median(u)),
    )


def _neighbours_sd(deviations: np.ndarray, move: np.ndarray) -> float:
    """Scatter of single readings by the second differences of neighbours, robust: their median is 0.6745 sds."""
    second = deviations[2:] - 2 * deviations[1:-1] + deviations[:-2]
    second = second[move[2:] == move[:-2]]
    return float(np.median(np.abs(second)) / 0.6745 / np.sqrt(6.0)) if len(second) else 0.0


def _width_s(campaign: AxisCampaign, speed: float, time_s: np.ndarray, move: np.ndarray) -> float:
    """Time over which readings (n,) at a speed in units per second are averaged, s; 0 where they are not."""
    if len(time_s) <= WIDE_ROWS:
        return 0.0
    span = sum(float(np.ptp(time_s[move == number])) for number in np.unique(move))
    shortest = campaign.periods.shortest
    if shortest is None:
        return span / WIDE_ROWS
    width = (shortest if campaign.periods.in_seconds else shortest / speed) / PER_PERIOD
    return max(width, span / ROWS_IN_MOTION) if span / width < len(time_s) else 0.0


def warm_from(campaign: AxisCampaign) -> float:
    """Time at which the machine began to warm up, clock of moves.csv, s."""
    return campaign.moves[0].time_s if campaign.powered_on_s is None else campaign.powered_on_s


def _hours(time_s: np.ndarray, zero: np.ndarray, homed_s: np.ndarray) -> np.ndarray:
    """Hours since the previous row of the same zero, in its first row since `homed_s`, (rows,)."""
    return np.maximum(_since_row_before(time_s, zero, homed_s), 0.0) / HOUR_S


def _since_row_before(time: np.ndarray, zero: np.ndarray, homed: np.ndarray) -> np.ndarray:
    return np.where(np.r_[True, np.diff(zero) > 0], time - homed, np.r_[0.0, np.diff(time)])


def _redrawn(legs: Legs, moves: np.ndarray) -> np.ndarray:
    """Whether the axis moved, or homed, since the previous row."""
    changes = np.cumsum(legs.first | (legs.step != 0))
    return np.r_[True, np.diff(changes[moves]) > 0]


class PlayPlaces(NamedTuple):
    """Positions of the output in the play; shapes (n or 1, rows).

    While a leg is lost in the play, the output stays where an earlier move left it. Where the side at the start of a
    segment is unknown, all are means of the two possible ends.

    Attributes:
        anchor, path, side: command of that earlier move, commands travelled up to it, and its position in the play
            then, in halves of the play.
        share: present position of the output in the play, in halves of it, -1 to 1.
        spread: half of the distance between the possible ends, unit.
    """

    anchor: np.ndarray
    path: np.ndarray
    side: np.ndarray
    share: np.ndarray
    spread: np.ndarray


def play_places(rows: AxisRows, backlash: np.ndarray) -> PlayPlaces:
    """The play operator for backlash (n,), unit; the least-squares line's slope decides which legs are lost in it.

    A negative backlash is not play but an overshooting reversal: every stop is on its own side immediately.
    """
    legs, slope = rows.legs, rows.line.slope
    if rows.in_motion:
        # A drive that never reverses: the play is taken up on one side.
        taken_up = (-np.sign(slope) * rows.side)[None].astype(float)
        return PlayPlaces(rows.command[None], rows.path[None], taken_up, taken_up, np.zeros_like(taken_up))
    motion = legs.step * slope
    shortest = np.min(np.abs(motion[motion != 0]), initial=np.inf)
    if np.all(backlash < shortest) and not np.any(legs.first & (legs.side == 0)):
        # Every leg moves the output, for all values of the play.
        backlash = backlash[:1]
    half, wheel = 0.5 * np.maximum(backlash, 0.0), slope * legs.command
    approach = legs.side * np.sign(slope)
    ends = rests(wheel, legs.first, approach, half, set(rows.move.tolist()))
    path = travelled(legs.command, legs.segment)[ends.anchor]
    anchor, path, side, output = (
        each.mean(axis=1).T for each in (legs.command[ends.anchor], path, ends.side, ends.output)
    )
    spread = 0.5 * (ends.output[:, 1] - ends.output[:, 0]).T
    halves = half[:, None]
    share = np.where(halves > 0, (output - wheel[rows.move]) / np.where(halves > 0, halves, 1.0), side)
    return PlayPlaces(anchor, path, side, share, spread)


def line_design(rows: AxisRows) -> np.ndarray:
    """Columns of offset (at the mean command), unit per command and backlash, shape (rows, 3)."""
    sign = np.sign(rows.line.slope)
    return np.column_stack([np.ones(len(rows.value)), rows.command - rows.command.mean(), -0.5 * sign * rows.side])


def reversal_of(rows: AxisRows) -> WithSd[float]:
    """Backlash of the least-squares line with one reversal, unit, and its standard error: infinite if undetermined."""
    design = line_design(rows)
    solved, _, rank, _ = np.linalg.lstsq(design, rows.value, rcond=None)
    if rank < 3:
        return WithSd(0.0, np.inf)
    scatter = float(np.sqrt(np.sum((rows.value - design @ solved) ** 2) / max(len(rows.value) - 3, 1)))
    return WithSd(float(solved[2]), scatter * float(np.sqrt(np.linalg.inv(design.T @ design)[2, 2])))


def legs_are_long(rows: AxisRows) -> bool:
    """Whether every leg certainly takes up the play, so that the backlash is linear as well."""
    reversal = reversal_of(rows)
    motion = np.abs(rows.legs.step * rows.line.slope)
    shortest = np.min(motion[motion > 0], initial=np.inf)
    if np.all(rows.side >= 0) or np.all(rows.side <= 0):
        # With approaches from one side only, the backlash stays at its prior, and the offset absorbs it.
        return True
    return bool(shortest > LONG_LEGS * abs(reversal.value) + LONG_ERRORS * reversal.sd)


LINE_ROUNDS, LINE_PLAYS, LINE_PLAY_MAX = 3, 61, 0.5
"""Rounds, and number of trial plays up to a share of the travel, for the line where stops may lie inside the play."""


def _line_with_play(rows: AxisRows) -> AxisRows:
    """The rows with a least-squares line that includes the play; its slope decides which legs are lost."""
    slope = rows.line.slope
    for _ in range(LINE_ROUNDS):
        play = play_places(rows, np.linspace(0.0, LINE_PLAY_MAX * rows.travel, LINE_PLAYS))
        least, line = np.inf, rows.line
        for anchor, side in zip(play.anchor, play.side, strict=True):
            design = np.column_stack([np.ones(len(anchor)), anchor, side])
            solved = np.linalg.lstsq(design, rows.value, rcond=None)[0]
            sum_of_squares = float(np.sum((rows.value - design @ solved) ** 2))
            if sum_of_squares < least:
                least, line = sum_of_squares, Line(*solved[:2].tolist())
        if not 0.5 < line.slope / slope < 2.0:
            break
        rows = replace(rows, line=line)
    return rows

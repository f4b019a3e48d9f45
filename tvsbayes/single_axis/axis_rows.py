"""An axis campaign as arrays: stops with readings, sides of approach, state of the play.

A row is a move with its readings averaged; for a drive at constant rate, it is the mean over a short time
(`rows_in_motion`). Positions are commands; `unit` is that of the readings. Formulation 8.1.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tvsbayes.errors import InputError, NothingToEstimate, listed
from tvsbayes.instrument.conditions import kelvin_at
from tvsbayes.single_axis.axis_campaign import TURNS, AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.reference import corrected, loadings
from tvsbayes.statistics.intervals import WithSd
from tvsbayes.statistics.wrapped import turn_jumps

SIDES = {"forward": 1, "backward": -1, "unknown": 0}
DIRECTIONS = {1: "forward", -1: "backward", 0: "unknown"}
HOUR_S = 3600.0
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

    def without(self, left_out: np.ndarray) -> AxisRows:
        """The rows where `left_out` is false; `hours` and `redrawn` are adapted, the line stays."""
        rows_kept = np.flatnonzero(~left_out)
        hours, redrawn = np.zeros(len(rows_kept)), np.ones(len(rows_kept), dtype=bool)
        time_h = np.cumsum(self.hours)
        for k, row in enumerate(rows_kept):
            previous = rows_kept[k - 1] if k else -1
            first = np.flatnonzero(self.zero == self.zero[row])[0]
            same = previous >= first
            hours[k] = time_h[row] - time_h[previous] if same else time_h[row] - time_h[first] + self.hours[first]
            redrawn[k] = not same or bool(self.redrawn[previous + 1 : row + 1].any())
        arrays = ("move", "command", "side", "segment", "zero", "path", "value", "variance", "within", "count")
        columns = {
            name: getattr(self, name)[rows_kept] for name in (*arrays, "time_s", "warm_s", "width_s", "reference")
        }
        columns["kelvin"] = None if self.kelvin is None else self.kelvin[rows_kept]
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


def _means(used: Sequence[Reading]) -> dict[int, dict[str, float]]:
    """Means of the readings of every move, by the fields of `AxisRows`.

    Without a stated u, it comes from repeated readings of one move; without these it is unknown, 0.
    """
    by_move: dict[int, list[Reading]] = defaultdict(list)
    for reading in used:
        by_move[reading.move].append(reading)
    unknown = [[float(r.value or 0.0) for r in of_move if r.u == 0] for of_move in by_move.values()]
    repeated = [values for values in unknown if len(values) > 1]
    squares = sum(len(values) * float(np.var(values)) for values in repeated)
    freedom = sum(len(values) - 1 for values in repeated)
    pooled = float(np.sqrt(squares / freedom)) if freedom else 0.0
    means = {}
    for move, of_move in by_move.items():
        values = np.array([r.value for r in of_move], dtype=float)
        u = np.array([r.u or pooled for r in of_move])
        if np.all(u > 0):
            weight = 1 / u**2
            mean = float(weight @ values / weight.sum())
            means[move] = {"value": mean, "variance": float(1 / weight.sum())}
            means[move] |= {"within": float(weight @ (values - mean) ** 2), "count": len(of_move)}
        else:
            means[move] = {"value": float(values.mean()), "variance": 0.0, "within": 0.0, "count": len(of_move)}
    return means


def _check_turns(campaign: AxisCampaign, command: np.ndarray, value: np.ndarray, moves: np.ndarray) -> None:
    """Refuse angles that jump by whole turns.

    Raises:
        InputError: readings of an angle wrap.
    """
    turn = TURNS.get(campaign.unit)
    jumps = turn_jumps(command, value, turn) if turn is not None else {}
    if jumps:
        moves_text = listed([int(moves[row]) for row in jumps], 5)
        raise InputError(
            "wrapped",
            f"readings.csv: the angle jumps by whole turns at move {moves_text}; allowed: a continuous angle",
            file="readings.csv",
            column="value",
            remedy=f"unwrap them: add or subtract {turn:g} {campaign.unit}; or are command and value exchanged?",
        )


def _check_motion(slope: float, command: np.ndarray, value: np.ndarray, remedy: str) -> None:
    """Refuse readings that do not follow the command.

    Raises:
        NothingToEstimate: the readings do not change with the command.
    """
    if not abs(slope) * np.ptp(command) > 1e-9 * max(float(np.max(np.abs(value))), 1e-300):
        found = "the readings do not move with the command: nothing to estimate"
        raise NothingToEstimate("no-motion", found, file="readings.csv", remedy=remedy)


def _used(campaign: AxisCampaign) -> list[Reading]:
    """Readings that count, less the stated expansion of the reference, with the u of their own noise."""
    used = [r for r in campaign.noisy if r.status == "ok" and r.value is not None]
    return corrected(campaign.reference, campaign.moves, used)


def _with_reference(rows: AxisRows, campaign: AxisCampaign) -> AxisRows:
    """The rows with the errors that their readings share."""
    used = [r for r in campaign.readings if r.status == "ok" and r.value is not None]
    known = loadings(campaign.reference, campaign.moves, used, rows.move, rows.time_s, rows.value)
    return replace(rows, reference=known.columns, reference_causes=known.names)


def rows_of(campaign: AxisCampaign) -> AxisRows:
    """The rows of a campaign.

    Raises:
        NothingToEstimate: fewer than two positions were read, fewer than three moves, or the readings do not change.
        InputError: too many moves, or angles that wrap.
    """
    if campaign.rate is not None:
        return _with_reference(rows_in_motion(campaign, campaign.rate), campaign)
    used = _used(campaign)
    means = _means(used)
    moves = np.array(sorted(means), dtype=int)
    legs = legs_of(campaign.moves)
    if len(moves) < 3 or len(np.unique(legs.command[moves])) < 2:
        raise NothingToEstimate(
            "too-few-positions",
            f"readings of {len(moves)} moves at {len(np.unique(legs.command[moves]))} positions: nothing to estimate",
            file="readings.csv",
            remedy="read at least three moves at two positions, better at five or more, from both directions",
        )
    if len(moves) > ROWS_MAX:
        raise InputError(
            "too-many",
            f"readings.csv: readings of {len(moves)} moves; allowed: at most {ROWS_MAX}",
            file="readings.csv",
            remedy="thin them out, or give readings at one standstill one move: they are averaged exactly",
        )
    read = {name: np.array([means[m][name] for m in moves]) for name in ("value", "variance", "within", "count")}
    value = read["value"]
    command = legs.command[moves]
    _check_turns(campaign, command, value, moves)
    design = np.column_stack([np.ones(len(command)), command - command.mean(), legs.side[moves]])
    level, slope, _ = np.linalg.lstsq(design, value, rcond=None)[0]
    remedy = "check the columns move and value, and that the reading follows this axis"
    _check_motion(slope, command, value, remedy)
    times_s = np.array([m.time_s for m in campaign.moves])
    zero = 0 * legs.segment if campaign.absolute else legs.segment
    stated_u = [r.u for r in used if r.u > 0]
    rows = AxisRows(
        unit=campaign.unit,
        legs=legs,
        move=moves,
        command=command,
        side=legs.side[moves],
        segment=legs.segment[moves],
        zero=zero[moves],
        hours=_hours(times_s / HOUR_S, zero, moves),
        path=_path(legs)[moves],
        redrawn=_redrawn(legs, moves) | (read["variance"] == 0),
        value=value,
        variance=read["variance"],
        within=read["within"],
        count=read["count"],
        line=Line(float(level - slope * command.mean()), float(slope)),
        time_s=times_s[moves],
        warm_s=times_s[moves] - warm_from(campaign),
        kelvin=_kelvin(campaign, times_s[moves]),
        width_s=np.zeros(len(moves)),
        rate=None,
        reading_u=float(np.median(stated_u)) if stated_u else 0.0,
        command_unit=campaign.command_unit,
    )
    return _with_reference(rows if legs_are_long(rows) else _line_with_play(rows), campaign)


ROWS_IN_MOTION, PER_PERIOD, READINGS_IN_MOTION = 2000, 5.0, 100_000
"""Largest number of rows of a drive, rows in the shortest stated period, largest number of readings."""
WIDE_ROWS = 400
"""Number of rows of a drive without stated periods; fewer readings are not averaged."""


def rows_in_motion(campaign: AxisCampaign, rate: float) -> AxisRows:
    """The rows of a drive at constant rate: means of the readings of equal short times.

    The model averages a wave over the same times, so that only detail shorter than a fifth of the shortest period is
    lost. Without a stated u, it comes from second differences of neighbouring readings.

    Raises:
        NothingToEstimate, InputError: as `rows_of`.
    """
    used = sorted(
        (r for r in _used(campaign) if r.time_s is not None),
        key=lambda r: (r.move, r.time_s or 0.0),
    )
    if len(used) > READINGS_IN_MOTION:
        raise InputError(
            "too-many",
            f"readings.csv: {len(used)} readings in motion; allowed: at most {READINGS_IN_MOTION}",
            file="readings.csv",
            remedy="thin them out, or fit one part of the record",
        )
    if len(used) < 5:
        raise NothingToEstimate(
            "too-few-positions",
            f"{len(used)} readings in motion: nothing to estimate",
            file="readings.csv",
            remedy="read at least five, better several periods long",
        )
    move = np.array([r.move for r in used])
    time_s, value = np.array([r.time_s for r in used], dtype=float), np.array([r.value for r in used], dtype=float)
    by_move = {name: np.array([getattr(m, name) for m in campaign.moves]) for name in ("segment", "time_s", "command")}
    command = by_move["command"][move] + rate * (time_s - by_move["time_s"][move])
    _check_turns(campaign, command, value, move)
    slope = float(np.polyfit(command - command.mean(), value, 1)[0])
    remedy = "give total positions, not what they are off the drive; check the sign of `rate`"
    _check_motion(slope, command, value, remedy)
    u = np.array([r.u for r in used])
    u = np.where(u > 0, u, _neighbours_sd(value - slope * command, move))
    weight = 1.0 / np.maximum(u, FLOOR_SHARE * abs(slope) * np.ptp(command)) ** 2
    width = _width_s(campaign, abs(slope * rate), time_s, move)
    is_first = np.r_[True, np.diff(move) > 0]
    since_move_s = time_s - time_s[is_first][np.cumsum(is_first) - 1]
    bin_of = np.floor(since_move_s / width).astype(int) if width else np.arange(len(used))
    first_readings = np.flatnonzero(np.r_[True, (np.diff(move) > 0) | (np.diff(bin_of) != 0)])
    weight_sum = np.add.reduceat(weight, first_readings)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(weight * values, first_readings) / weight_sum

    count = np.diff(np.r_[first_readings, len(used)])
    rows_move, rows_time, rows_command, rows_value = move[first_readings], mean(time_s), mean(command), mean(value)
    spread = np.sqrt(mean((time_s - np.repeat(rows_time, count)) ** 2))
    segment = by_move["segment"][rows_move]
    first = np.r_[True, np.diff(segment) > 0]
    zero = 0 * segment if campaign.absolute else segment
    starts_s = np.array([by_move["time_s"][np.flatnonzero(by_move["segment"] == s)[0]] for s in segment])
    gaps = np.where(np.r_[True, np.diff(zero) > 0], rows_time - starts_s, np.r_[0.0, np.diff(rows_time)])
    design = np.column_stack([np.ones(len(rows_command)), rows_command - rows_command.mean()])
    level, per_command = np.linalg.lstsq(design, rows_value, rcond=None)[0]
    starts_command = np.array([by_move["command"][np.flatnonzero(by_move["segment"] == s)[0]] for s in segment])
    return AxisRows(
        unit=campaign.unit,
        legs=legs_of(campaign.moves),
        move=rows_move,
        command=rows_command,
        side=np.full(len(rows_move), int(np.sign(rate))),
        segment=segment,
        zero=zero,
        hours=np.maximum(gaps, 0.0) / HOUR_S,
        path=np.abs(rows_command - starts_command),
        redrawn=first,
        value=rows_value,
        variance=1.0 / weight_sum,
        within=np.zeros(len(count)),
        count=count,
        line=Line(float(level - per_command * rows_command.mean()), float(per_command)),
        time_s=rows_time,
        warm_s=rows_time - warm_from(campaign),
        kelvin=_kelvin(campaign, rows_time),
        width_s=np.sqrt(12.0) * spread,
        rate=rate,
        reading_u=float(np.median(u)),
        command_unit=campaign.command_unit,
    )


FLOOR_SHARE = 1e-9
"""Least u of a reading in motion, as a share of the travel."""


def _neighbours_sd(deviations: np.ndarray, move: np.ndarray) -> float:
    """Scatter of single readings by the second differences of neighbours, robust: their median is 0.6745 sds."""
    second = deviations[2:] - 2 * deviations[1:-1] + deviations[:-2]
    second = second[move[2:] == move[:-2]]
    return float(np.median(np.abs(second)) / 0.6745 / np.sqrt(6.0)) if len(second) else 0.0


def _width_s(campaign: AxisCampaign, speed: float, time_s: np.ndarray, move: np.ndarray) -> float:
    """Time over which readings are averaged, s; 0 where they are not averaged.

    Args:
        campaign: campaign with the stated periods.
        speed: unit per second.
        time_s: times of the readings, s.
        move: moves of the readings.
    """
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


def _kelvin(campaign: AxisCampaign, times_s: np.ndarray) -> np.ndarray | None:
    return kelvin_at(campaign.moves, times_s, np.array([move.time_s for move in campaign.moves], dtype=float))


def _hours(times_h: np.ndarray, zero: np.ndarray, moves: np.ndarray) -> np.ndarray:
    hours = np.zeros(len(moves))
    for row, move in enumerate(moves):
        first = int(np.flatnonzero(zero == zero[move])[0])
        previous = int(moves[row - 1]) if row and zero[moves[row - 1]] == zero[move] else first
        hours[row] = times_h[move] - times_h[previous]
    return hours


def _path(legs: Legs) -> np.ndarray:
    """Commands travelled since the segment began."""
    total = np.cumsum(np.abs(legs.step))
    return total - total[legs.first][np.cumsum(legs.first) - 1]


def _redrawn(legs: Legs, moves: np.ndarray) -> np.ndarray:
    """Whether the axis moved, or homed, since the previous row."""
    changes = np.cumsum(legs.first | (legs.step != 0))
    return np.array([True, *(changes[after] > changes[before] for before, after in pairwise(moves))])


@dataclass(frozen=True)
class PlayPlaces:
    """Positions of the output in the play; shapes (n or 1, rows).

    While a leg is lost in the play, the output stays where an earlier move left it. `anchor` is the command of that
    move, `path` the commands travelled up to it, `side` its position in the play then, in halves of the play. Where
    the side at the start of a segment is unknown, all are means of the two possible ends.

    Attributes:
        anchor, path, side: values of the last move that moved the output.
        share: present position of the output in the play, in halves of it, -1 to 1.
        spread: half of the distance between the possible ends, unit.
    """

    anchor: np.ndarray
    path: np.ndarray
    side: np.ndarray
    share: np.ndarray
    spread: np.ndarray


class _PlayEnd:
    """One possible position of the output, for every draw of the backlash; arrays (n,)."""

    def __init__(self, command: float, path: float, side: float, n: int):
        self.anchor, self.path, self.side = np.full(n, command), np.full(n, path), np.full(n, side)

    def place(self, slope: float, half: np.ndarray) -> np.ndarray:
        return slope * self.anchor + self.side * half

    def follow(self, command: float, path: float, slope: float, half: np.ndarray) -> None:
        """Apply a move: the wheel moves the output once the play is taken up."""
        output, wheel = self.place(slope, half), slope * command
        # Without play the side is that of the leg, and both sides coincide.
        for side, is_moved in ((-1.0, output < wheel - half), (1.0, output > wheel + half)):
            self.anchor = np.where(is_moved, command, self.anchor)
            self.path = np.where(is_moved, path, self.path)
            self.side = np.where(is_moved, side, self.side)


def _places_in_motion(rows: AxisRows) -> PlayPlaces:
    """Positions of a drive that never reverses: the play is taken up on one side."""
    side = (-float(np.sign(rows.line.slope)) * rows.side)[None].astype(float)
    return PlayPlaces(rows.command[None], rows.path[None], side, side, np.zeros_like(side))


def play_places(rows: AxisRows, backlash: np.ndarray) -> PlayPlaces:
    """The play operator for backlash (n,), unit; the least-squares line's slope decides which legs are lost in it.

    A negative backlash is not play but an overshooting reversal: every stop is on its own side immediately.
    """
    if rows.in_motion:
        return _places_in_motion(rows)
    legs, slope = rows.legs, rows.line.slope
    motion = legs.step * slope
    shortest = np.min(np.abs(motion[motion != 0]), initial=np.inf)
    if np.all(backlash < shortest) and not np.any(legs.first & (legs.side == 0)):
        # Every leg moves the output, for all values of the play.
        backlash = backlash[:1]
    half = 0.5 * np.maximum(backlash, 0.0)
    n, count, slope_sign = len(half), len(rows.move), float(np.sign(slope))
    places = PlayPlaces(*(np.empty((n, count)) for _ in range(5)))
    path = _path(legs)
    ends: list[_PlayEnd] = []
    row = 0
    for move in range(len(legs.command)):
        command, travelled = float(legs.command[move]), float(path[move])
        if legs.first[move]:
            side = -float(legs.side[move]) * slope_sign
            ends = [_PlayEnd(command, travelled, s, n) for s in ((side,) if side else (-1.0, 1.0))]
        elif motion[move]:
            for end in ends:
                end.follow(command, travelled, slope, half)
        if row < count and rows.move[row] == move:
            low, high = ends[0], ends[-1]
            lowest, highest = low.place(slope, half), high.place(slope, half)
            offset = 0.5 * (lowest + highest) - slope * command
            middle_side = 0.5 * (low.side + high.side)
            places.anchor[:, row] = 0.5 * (low.anchor + high.anchor)
            places.path[:, row] = 0.5 * (low.path + high.path)
            places.side[:, row] = middle_side
            places.share[:, row] = np.where(half > 0, offset / np.where(half > 0, half, 1.0), middle_side)
            places.spread[:, row] = 0.5 * (highest - lowest)
            row += 1
    return places


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

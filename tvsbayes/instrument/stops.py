"""Rests of an axis between its moves, and the parameters that its stops can determine before any fit.

Counters in steps; signs +1 left or up, -1 right or down. An axis rests until its own counter changes or a homing sets
it; looks during one rest share its stop error, also when the other axis moves.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from tvsbayes.instrument.axes import APPROACH_SIGN, AXES, DIRECTIONS, direction_of
from tvsbayes.instrument.campaign import Move

SECONDS_PER_HOUR = 3600.0


class SegmentMove(Protocol):
    """A row of `moves.csv`, of a scanner or an axis."""

    @property
    def segment(self) -> int:
        """Number of the homing before it."""


@dataclass(frozen=True, slots=True)
class Stop:
    """A rest of one axis at which a usable spot was seen; `sign` is the sense of the preceding move."""

    segment: int
    steps: int
    sign: int


@dataclass(frozen=True, slots=True)
class Rest(Stop):
    """The position of an axis after a move, and the approach to it.

    Attributes:
        move: number of the move that reached it.
        homing: number of the homing from which its counter counts.
        distance: steps of that move with their sign, 0 after homing.
        leg: steps since the sense of motion last changed, infinite after homing, which takes up the play.
    """

    move: int
    homing: int
    distance: int
    leg: float


def rests_of(moves: Sequence[Move], axis: str) -> list[Rest]:
    """The rest of an axis after every move: a new rest whenever its counter changed (formulation 3.1).

    Args:
        moves: all moves in order, the first after a homing.
        axis: "pan" or "tilt".
    """
    rests: list[Rest] = []
    for move in moves:
        steps, approach = getattr(move, f"{axis}_steps"), getattr(move, f"{axis}_approach")
        if approach:
            rest = Rest(move.segment, steps, APPROACH_SIGN[approach], move.move, move.move, 0, math.inf)
        elif steps != rests[-1].steps:
            previous = rests[-1]
            distance = steps - previous.steps
            sign = 1 if distance > 0 else -1
            # Further moves in the same sense leave the play taken up.
            leg = abs(distance) + (previous.leg if previous.sign == sign else 0.0)
            rest = Rest(move.segment, steps, sign, move.move, previous.homing, distance, leg)
        else:
            rest = rests[-1]
        rests.append(rest)
    return rests


def legs_of(moves: Sequence[Move]) -> dict[str, list[int]]:
    """Lengths of the moves in each direction, steps, in order; directions without moves are absent."""
    legs: dict[str, list[int]] = {}
    for axis in AXES:
        for rest in dict.fromkeys(rests_of(moves, axis)):
            if rest.distance:
                legs.setdefault(direction_of(axis, rest.distance), []).append(abs(rest.distance))
    return legs


def observed_stops(moves: Sequence[Move], observed: Collection[int], axis: str) -> tuple[Stop, ...]:
    """Rests of one axis, in order, at which a usable spot was seen.

    Args:
        moves: all moves in order.
        observed: numbers of the moves after which a usable spot was seen.
        axis: "pan" or "tilt".
    """
    rests = zip(moves, rests_of(moves, axis), strict=True)
    observed_rests = dict.fromkeys(rest for move, rest in rests if move.move in observed)
    return tuple(Stop(rest.segment, rest.steps, rest.sign) for rest in observed_rests)


LONE_RANGES, LONE_MOVES_MIN = 4.0, 8
"""Distance of a lone command from all others, in their range, and least number of moves to judge it."""


def lone_commands(moves: Sequence[SegmentMove], commands: Sequence[float]) -> list[int]:
    """Moves to a command that is far from all others, as by a digit too many: one at most, and not that of a homing.

    Args:
        moves: all moves in order.
        commands: command or counter of each.
    """
    if len(commands) < LONE_MOVES_MIN:
        return []
    values = np.array(commands, dtype=float)
    far = int(np.argmax(np.abs(values - np.median(values))))
    others = np.delete(values, far)
    gap = max(others.min() - values[far], values[far] - others.max())
    homed = far == 0 or moves[far].segment != moves[far - 1].segment
    return [far] if gap > LONE_RANGES * np.ptp(others) > 0 and not homed else []


def lone_doubts(moves: Sequence[SegmentMove], commands: Sequence[float], column: str) -> list[str]:
    """The moves of `lone_commands` in sentences."""
    near = np.delete(np.array(commands, dtype=float), lone := lone_commands(moves, commands))
    return [
        f"{column} of move {k} is {commands[k]:.10g}, all others lie within {near.min():.10g} to {near.max():.10g}: "
        "a digit too many? correct the cell in moves.csv, or take the move out with what was read at it"
        for k in lone
    ]


FEW_STOPS = 12
"""With fewer stops, the scatter is so uncertain that 1.96 standard deviations contain less than 93 % (Student's t)."""


def too_few(stops: Mapping[str, int]) -> dict[str, int]:
    """Numbers of stops by direction below `FEW_STOPS`."""
    return {direction: count for direction, count in stops.items() if count < FEW_STOPS}


def few_stops(moves: Sequence[Move], observed: Collection[int]) -> dict[str, int]:
    """Directions of moves with too few observed stops, and their number; see `observed_stops`."""
    counts = Counter(direction_of(axis, stop.sign) for axis in AXES for stop in observed_stops(moves, observed, axis))
    legs = legs_of(moves)
    return too_few({direction: counts[direction] for direction in DIRECTIONS if direction in legs})


INSEPARABLE = 0.5
"""Correlation of an effective ratio and its backlash, in a fit or predicted for a plan: from here on they share a
quarter of the ratio's variance."""
ALONE, ALONE_ONE_LENGTH = 0.9, 0.7
"""Thresholds of the correlation from the moves alone. Cameras and priors do not add to the ratio's variance there, so
that the correlation is larger: a pair inseparable here is inseparable in the fit. Equal numbers of cleared and reversed
legs of one length give 0.55."""


def inseparable(correlation: float) -> bool:
    """Whether a ratio and its backlash are hard to separate, by their correlation in a fit or predicted for a plan."""
    return abs(correlation) >= INSEPARABLE


def one_sided(stops: Sequence[Stop], axis: str) -> str | None:
    """The stops still needed to separate a ratio from its backlash, in words; None if none."""
    if len({stop.steps for stop in stops}) < 2:
        return f"the {axis} axis was seen at one counter only; look before and after moves of that axis"
    if not {1, -1} <= {stop.sign for stop in stops}:
        return f"every stop of the {axis} axis was reached from one side; reach some from the other"
    return None


def separation(stops: Sequence[Stop], axis: str) -> str | None:
    """Why a ratio and its backlash cannot be separated well, and the simplest remedy.

    With equal errors at every stop the angle is zero(segment) + k n - b sign / 2. The correlation of k and b in this
    straight line predicts, before any fit, whether the stops separate them.

    Returns:
        A sentence, or None if they can.
    """
    reason = one_sided(stops, axis)
    if reason is not None:
        return reason
    steps = np.array([stop.steps for stop in stops], dtype=float)
    signs = np.array([stop.sign for stop in stops], dtype=float)
    segments = np.array([stop.segment for stop in stops])
    zeros = (segments[:, None] == np.unique(segments)).astype(float)
    design = np.column_stack([steps / np.ptp(steps), -signs / 2, zeros])
    information = design.T @ design
    if np.linalg.matrix_rank(information) < len(information):
        correlation = 1.0
    else:
        covariance = np.linalg.inv(information)
        correlation = abs(covariance[0, 1]) / np.sqrt(covariance[0, 0] * covariance[1, 1])
    # No leg connects two segments: homing set the counter.
    legs = [(a, b) for a, b in pairwise(stops) if a.segment == b.segment and a.steps != b.steps]
    lengths = Counter(abs(b.steps - a.steps) for a, b in legs)
    if not lengths:
        return f"no leg of the {axis} axis was seen at both ends; look before and after moves of that axis"
    if correlation < (ALONE_ONE_LENGTH if len(lengths) == 1 else ALONE):
        return None
    common = lengths.most_common(1)[0][0]
    text = f"only one |N| = {common}" if len(lengths) == 1 else f"nearly every leg has |N| = {common} and reverses"
    return f"{text}; add N = {max(common // 2, 1)} or a cleared approach"


@dataclass(frozen=True)
class Redraws:
    """Which errors are new at each look since the previous look, arrays over looks; fields as in `SpotArrays`.

    Attributes:
        redraw: whether the stop error of (pan, tilt) is new, shape (n, 2).
        redraw_mix: shares of the (negative, positive) direction in its variance, shape (n, 2, 2); one half each where
            the direction is unknown.
        new_segment: whether a segment began, and with it the play's position, shape (n,).
        new_zero: whether the zero of (pan, tilt) is that of a homing; of an absolute encoder only at the first look,
            shape (n, 2).
        homed: whether it has an unknown home offset, shape (n, 2).
        hours: time over which it walked: since the previous look, or since a homing after it, shape (n, 2).
    """

    redraw: np.ndarray
    redraw_mix: np.ndarray
    new_segment: np.ndarray
    new_zero: np.ndarray
    homed: np.ndarray
    hours: np.ndarray


def redraws(
    moves: Sequence[Move], looks: Sequence[int], homed_from: int = 1, absolute: Collection[str] = ()
) -> Redraws:
    """Mark new stop errors: an axis draws one when its own counter changes or homing sets it (formulation 3.1).

    Args:
        moves: all moves in order.
        looks: number of the move before each look, in order.
        homed_from: first segment with an unknown home offset.
        absolute: axes whose encoder keeps the zero: a homing draws none.
    """
    rests_at = [[rests[move] for move in looks] for rests in (rests_of(moves, axis) for axis in AXES)]
    move_numbers = np.array([[rest.move for rest in rests] for rests in rests_at]).T.reshape(-1, 2)
    redraw = np.diff(move_numbers, axis=0, prepend=-1) != 0
    sign = np.array([[rest.sign for rest in rests] for rests in rests_at]).T.reshape(-1, 2)
    mix = (1 + sign[..., None] * np.array([-1, 1])) / 2
    new_segment = np.diff([rest.homing for rest in rests_at[0]], prepend=-1) != 0
    segment = np.array([rest.segment for rest in rests_at[0]], dtype=int)
    seen_s = np.array([moves[move].time_s for move in looks], dtype=float)
    homed_s = np.array([moves[rest.homing].time_s for rest in rests_at[0]], dtype=float)
    new_zero = new_segment[:, None] & ~np.isin(AXES, list(absolute))
    new_zero[:1] = True
    before_s = np.concatenate([homed_s[:1], seen_s[:-1]])
    since_s = seen_s[:, None] - np.where(new_zero, homed_s[:, None], before_s[:, None])
    homed = new_zero & ~np.isin(AXES, list(absolute)) & (segment >= homed_from)[:, None]
    return Redraws(
        redraw, np.where(redraw[..., None], mix, 0.0), new_segment, new_zero, homed, since_s / SECONDS_PER_HOUR
    )


def counters_made(moves: Sequence[Move]) -> dict[str, tuple[int, int]]:
    """Return the lowest and highest counter by axis that were made; moves that an import has added are no limit."""
    made = [move for move in moves if not move.assumed]
    counters = {axis: [getattr(move, f"{axis}_steps") for move in made] for axis in AXES}
    return {axis: (min(of_axis), max(of_axis)) for axis, of_axis in counters.items()}

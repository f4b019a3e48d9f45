"""Where the moves came to rest."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tvsbayes.instrument.axes import APPROACH_SIGN
from tvsbayes.instrument.campaign import Move, Spot


@dataclass(frozen=True)
class StopReadings:
    """Mirror angles at the stops of one axis, as the spots told them and the fitted geometry reads them.

    Attributes:
        axis: pan or tilt.
        steps: counter of each stop, shape (n,).
        side: +1 reached left or up, -1 right or down, shape (n,).
        mirror_deg: mirror angle, shape (n,); stop errors and home offsets are in it.
        u_deg: its standard uncertainty from pixel noise alone, shape (n,).
        play_left_out: stops whose last move may not have taken up the play.
        reference_pose_deg: pan and tilt of the fit's reference pose.
        values: parameters at the mode, by name.
    """

    axis: str
    steps: np.ndarray
    side: np.ndarray
    mirror_deg: np.ndarray
    u_deg: np.ndarray
    play_left_out: int
    reference_pose_deg: tuple[float, float]
    values: Mapping[str, float]


@dataclass(frozen=True)
class _Rest:
    """Where an axis stands after a move; `leg` is the distance of the last move, infinite after homing."""

    number: int
    steps: int
    side: int
    leg: float


def rests_of(moves: Sequence[Move], axis: str) -> list[_Rest]:
    """The stop at which an axis stands after every move: a new one whenever its counter changed (DESIGN 3.1)."""
    rests: list[_Rest] = []
    for move in moves:
        steps, approach = getattr(move, f"{axis}_steps"), getattr(move, f"{axis}_approach")
        if approach:
            last = _Rest(move.move, steps, APPROACH_SIGN[approach], math.inf)
        elif steps != rests[-1].steps:
            distance = steps - rests[-1].steps
            # Moves on in the same sense keep the play taken up.
            same = rests[-1].side * distance > 0
            leg = abs(distance) + (rests[-1].leg if same else 0.0)
            last = _Rest(move.move, steps, 1 if distance > 0 else -1, leg)
        else:
            last = rests[-1]
        rests.append(last)
    return rests


INSEPARABLE, INSEPARABLE_ONE_LENGTH = 0.9, 0.7
"""Correlation of ratio and backlash above which four fifths (half, where every leg has one length) of the ratio's
variance is exchange with the backlash. Equal numbers of cleared and reversed legs of one length give 0.55."""


@dataclass(frozen=True)
class Stop:
    """A rest of one axis at which a usable spot was seen; `sign` is the sense of the move that led there."""

    segment: int
    steps: int
    sign: int


def observed_stops(moves: Sequence[Move], observed: Collection[int], axis: str) -> tuple[Stop, ...]:
    """Rests of one axis, in order, that the spots tell of.

    Args:
        moves: all moves in order.
        observed: numbers of the moves after which a usable spot was seen.
        axis: "pan" or "tilt".
    """
    stops: list[Stop] = []
    current, seen, previous = Stop(0, 0, 0), False, 0
    for move in moves:
        steps = move.pan_steps if axis == "pan" else move.tilt_steps
        approach = move.pan_approach if axis == "pan" else move.tilt_approach
        if approach:
            current, seen = Stop(move.segment, steps, APPROACH_SIGN[approach]), False
        elif steps != previous:
            current, seen = Stop(move.segment, steps, 1 if steps > previous else -1), False
        if move.move in observed and not seen:
            stops.append(current)
            seen = True
        previous = steps
    return tuple(stops)


def separation(stops: Sequence[Stop], axis: str) -> str | None:
    """Why a ratio and its backlash cannot be told apart well, and the smallest cure.

    With equal errors at every stop the angle is zero(segment) + k n - b sign / 2: the correlation of k and b in
    this straight line tells before any fit whether the stops separate them.

    Returns:
        A sentence, or None if nothing stands in the way.
    """
    steps = np.array([stop.steps for stop in stops], dtype=float)
    signs = np.array([stop.sign for stop in stops], dtype=float)
    if len({stop.steps for stop in stops}) < 2:
        return f"the {axis} axis was seen at one counter only; look before and after moves of that axis"
    if not (np.any(signs > 0) and np.any(signs < 0)):
        return f"every stop of the {axis} axis was reached from one side; reach some from the other"
    segments = np.array([stop.segment for stop in stops])
    zeros = (segments[:, None] == np.unique(segments)).astype(float)
    design = np.column_stack([steps / np.ptp(steps), -signs / 2, zeros])
    information = design.T @ design
    if np.linalg.matrix_rank(information) < len(information):
        correlation = 1.0
    else:
        covariance = np.linalg.inv(information)
        correlation = abs(covariance[0, 1]) / np.sqrt(covariance[0, 0] * covariance[1, 1])
    # No leg leads from one segment to the next: the counter was set by homing.
    legs = [(a, b) for a, b in pairwise(stops) if a.segment == b.segment and a.steps != b.steps]
    lengths = Counter(abs(b.steps - a.steps) for a, b in legs)
    if not lengths:
        return f"no leg of the {axis} axis was seen at both ends; look before and after moves of that axis"
    if correlation < (INSEPARABLE_ONE_LENGTH if len(lengths) == 1 else INSEPARABLE):
        return None
    common = lengths.most_common(1)[0][0]
    only = f"only one |N| = {common}" if len(lengths) == 1 else f"nearly every leg has |N| = {common} and reverses"
    return f"{only}; add N = {max(common // 2, 1)} or a cleared approach"


def _stop_mix(sign: int) -> tuple[float, float]:
    """Share of each direction's variance in a stop error: one of them, or half of both where unknown."""
    return (0.5, 0.5) if sign == 0 else (float(sign < 0), float(sign > 0))


@dataclass(frozen=True)
class Redraws:
    """Which states are new at each spot, arrays over spots; fields as in `SpotArrays`."""

    redraw: np.ndarray
    redraw_mix: np.ndarray
    new_segment: np.ndarray
    homed: np.ndarray


def redraws(moves: tuple[Move, ...], spots: list[Spot]) -> Redraws:
    """Follow the moves between spots: an axis' stop error is new once its own counter has changed (DESIGN 3.1)."""
    count = len(spots)
    new = Redraws(
        redraw=np.zeros((count, 2), dtype=bool),
        redraw_mix=np.zeros((count, 2, 2)),
        new_segment=np.zeros(count, dtype=bool),
        homed=np.zeros(count, dtype=bool),
    )
    seen = -1
    for row, spot in enumerate(spots):
        for index in range(seen + 1, spot.move + 1):
            move = moves[index]
            if move.pan_approach:
                signs = (APPROACH_SIGN[move.pan_approach], APPROACH_SIGN[move.tilt_approach])
                new.redraw[row], new.redraw_mix[row] = True, [_stop_mix(s) for s in signs]
                new.new_segment[row], new.homed[row] = True, move.segment > 0
                continue
            previous = moves[index - 1]
            deltas = (move.pan_steps - previous.pan_steps, move.tilt_steps - previous.tilt_steps)
            for axis, delta in enumerate(deltas):
                if delta:
                    new.redraw[row, axis], new.redraw_mix[row, axis] = True, _stop_mix(delta)
        seen = spot.move
    return new

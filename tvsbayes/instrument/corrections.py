"""Corrections of whole tables that `check` suggests: opposite sign of a counter, shifted rows, exchanged cameras.

Input and output are moves and spots; steps and px. An approach is the observed direction of the beam's motion: it does
not change with the sign of a counter.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

from tvsbayes.errors import InputError, escaped
from tvsbayes.importing.counters import COUNTERS
from tvsbayes.instrument.axes import AXES, Axis
from tvsbayes.instrument.campaign import CAMERAS, PIXELS, Look, Move, Spot, stereo_spots

_SHIFT = re.compile(r"([+-]?[0-9]{1,9})(?:@([0-9]{1,9}))?")


@dataclass(frozen=True)
class Shift:
    """A number to be added to the move of looks: of all, or of those from a spot on."""

    moves: int
    spot: int | None = None


@dataclass(frozen=True)
class Correction:
    """Changes to be made in the tables of a scanner.

    Attributes:
        flipped: axes whose counter changes its sign.
        shifts: numbers to be added to the moves of looks.
        swapped: left and right centres are exchanged.
        pixels_from: coordinate of the centre of the first pixel so far; it becomes 0.
        relative: counters are the steps of each move so far; they become absolute.
    """

    flipped: tuple[Axis, ...] = ()
    shifts: tuple[Shift, ...] = ()
    swapped: bool = False
    pixels_from: int = 0
    relative: bool = False


@dataclass(frozen=True)
class CorrectedTables:
    """Corrected tables.

    Attributes:
        moves, spots: rows of `moves.csv` and of the looks; None where the table is missing.
        changes: the changes, in words.
    """

    moves: tuple[Move, ...] | None
    spots: tuple[Look, ...] | None
    changes: tuple[str, ...]


def flipped_axis(text: str) -> Axis:
    """The axis of an option `--flip`.

    Raises:
        InputError: no counter has this name.
    """
    if text in COUNTERS:
        return AXES[COUNTERS.index(text)]
    allowed, remedy = ", ".join(COUNTERS), f"write --flip {COUNTERS[0]}, --flip {COUNTERS[1]}, or both"
    raise InputError("usage", f"--flip {escaped(text)}; allowed: {allowed}", allowed=allowed, remedy=remedy)


def shift_of(text: str) -> Shift:
    """The value of an option `--shift-moves`: N, or N@SPOT.

    Raises:
        InputError: anything else, or 0.
    """
    match = _SHIFT.fullmatch(text)
    if match is None or int(match[1]) == 0:
        allowed, remedy = "N or N@SPOT, N not 0", "write --shift-moves 1, or --shift-moves 1@60 from spot 60 on"
        raise InputError("usage", f"--shift-moves {escaped(text)}; allowed: {allowed}", allowed=allowed, remedy=remedy)
    return Shift(int(match[1]), None if match[2] is None else int(match[2]))


def corrected(
    moves: Sequence[Move] | None, spots: Sequence[Look] | None, correction: Correction, count: int | None = None
) -> CorrectedTables:
    """Apply a correction to tables.

    Args:
        moves: rows of `moves.csv`; None where they are not to be written.
        spots: rows of `spots.csv` or `sightings.csv`, in the order of the file; None where they are not to be written.
        correction: the changes.
        count: number of moves, where `moves` is None.

    Raises:
        InputError: moves, spots, or the spot of a shift are missing.
    """
    changes: list[str] = []
    if moves is None and (correction.flipped or correction.relative):
        remedy = "correct the table that lists the moves"
        raise InputError("usage", "the table has no counters: --flip and --relative change nothing", remedy=remedy)
    if spots is None and (correction.shifts or correction.swapped or correction.pixels_from):
        remedy = "correct the table that lists the looks"
        raise InputError("usage", "the table has no looks: --shift-moves and --swap change nothing", remedy=remedy)
    new_moves = None if moves is None else tuple(moves)
    if new_moves is not None and correction.relative:
        new_moves = _absolute(new_moves)
        changes.append("counters: summed up, because --relative says that each is the steps of its move")
    for axis in correction.flipped if new_moves is not None else ():
        name = f"{axis}_steps"
        new_moves = tuple(replace(move, **{name: -getattr(move, name)}) for move in new_moves or ())
        changes.append(f"{name}: written with the other sign; approaches stay, they say how the beam moved")
    looks: tuple[Look, ...] | None = None if spots is None else tuple(spots)
    for shift in correction.shifts if looks is not None else ():
        looks, sentence = _shifted(looks or (), shift, count if new_moves is None else len(new_moves))
        changes.append(sentence)
    if looks is not None and correction.swapped:
        looks = tuple(map(_swapped, stereo_spots(looks)))
        changes.append("left and right: centres exchanged, with their uncertainties")
    if looks is not None and correction.pixels_from:
        looks = tuple(_from_zero(spot, correction.pixels_from) for spot in stereo_spots(looks))
        changes.append(f"pixels: {correction.pixels_from} taken from all centres")
    return CorrectedTables(new_moves, looks, tuple(changes))


def _absolute(moves: tuple[Move, ...]) -> tuple[Move, ...]:
    """Absolute counters from the steps of each move; the first row of a segment has those after homing."""
    absolute = list(moves[:1])
    for previous, move in pairwise(moves):
        names = COUNTERS if move.segment == previous.segment else ()
        absolute.append(replace(move, **{name: getattr(absolute[-1], name) + getattr(move, name) for name in names}))
    return tuple(absolute)


def _shifted(spots: tuple[Look, ...], shift: Shift, count: int | None) -> tuple[tuple[Look, ...], str]:
    """Assign looks to other moves; a look whose new move is missing keeps its number and is excluded by its status."""
    first_key = (-1, -1)
    if shift.spot is not None:
        keys = [(spot.move, spot.spot) for spot in spots if spot.spot == shift.spot]
        if not keys:
            remedy = "name a number of the column spot"
            raise InputError("usage", f"--shift-moves {shift.moves}@{shift.spot}: no such spot", remedy=remedy)
        first_key = keys[0]
    last = max((spot.move for spot in spots), default=0) if count is None else count - 1
    shifted, lost = list[Look](), 0
    for spot in spots:
        if (spot.move, spot.spot) < first_key:
            shifted.append(spot)
        elif 0 <= spot.move + shift.moves <= last:
            shifted.append(replace(spot, move=spot.move + shift.moves))
        else:
            lost += 1
            shifted.append(replace(spot, status=f"refused: move {spot.move + shift.moves} is not listed"))
    sentence = f"move: {shift.moves:+d} for {'all looks' if shift.spot is None else f'looks from spot {shift.spot} on'}"
    return tuple(shifted), sentence + f"; {lost} left out, whose move is not listed" * bool(lost)


def _swapped(spot: Spot) -> Spot:
    """Exchange the centres of both cameras in a look, with their uncertainties and correlations."""
    left, right = CAMERAS
    names = [f.name for f in fields(Spot) if f"_{left}" in f.name]
    right_of = {name: name.replace(f"_{left}", f"_{right}") for name in names}
    exchanged = {a: getattr(spot, b) for a, b in right_of.items()} | {b: getattr(spot, a) for a, b in right_of.items()}
    return replace(spot, **exchanged)


def _from_zero(spot: Spot, first: int) -> Spot:
    """Count the centres of a look from 0."""
    centre = {name: getattr(spot, name) for name in PIXELS}
    shifted: dict[str, Any] = {name: None if value is None else value - first for name, value in centre.items()}
    return replace(spot, **shifted)

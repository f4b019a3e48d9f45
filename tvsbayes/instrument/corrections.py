"""Corrections of whole tables that `check` names: the other sign of a counter, rows shifted, cameras exchanged.

Moves and spots in, moves and spots out; steps and px. An approach is the direction in which the beam moved, in words of
the person who saw it, so it stays where a counter gets the other sign.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

from tvsbayes.errors import InputError, escaped
from tvsbayes.instrument.axes import AXES, Axis
from tvsbayes.instrument.campaign import CAMERAS, PIXELS, Move, Spot

_SHIFT = re.compile(r"([+-]?[0-9]{1,9})(?:@([0-9]{1,9}))?")


@dataclass(frozen=True)
class Shift:
    """A number to be added to the move of looks: of all, or of those from a spot on."""

    moves: int
    spot: int | None = None


@dataclass(frozen=True)
class Correction:
    """What is to be changed in the tables of a scanner.

    Attributes:
        flipped: axes whose counter gets the other sign.
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
class Corrected:
    """Tables as corrected.

    Attributes:
        moves, spots: rows of `moves.csv` and `spots.csv`; None of a table that there is not.
        changes: what was changed, in words.
    """

    moves: tuple[Move, ...] | None
    spots: tuple[Spot, ...] | None
    changes: tuple[str, ...]


def flipped_axis(text: str) -> Axis:
    """The axis of an option `--flip`.

    Raises:
        InputError: no counter is called so.
    """
    for axis in AXES:
        if text == f"{axis}_steps":
            return axis
    allowed = ", ".join(f"{axis}_steps" for axis in AXES)
    remedy = f"write --flip {AXES[0]}_steps, --flip {AXES[1]}_steps, or both"
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
    moves: Sequence[Move] | None, spots: Sequence[Spot] | None, correction: Correction, count: int | None = None
) -> Corrected:
    """Tables with a correction applied.

    Args:
        moves: rows of `moves.csv`; None where there are none to write.
        spots: rows of `spots.csv`, in the order of the file; likewise.
        correction: what is to be changed.
        count: moves that there are, where `moves` is None.

    Raises:
        InputError: a counter of moves that are not there, or a spot that is not there.
    """
    changes: list[str] = []
    if moves is None and (correction.flipped or correction.relative):
        remedy = "correct the table that lists the moves"
        raise InputError("usage", "the table has no counters: --flip and --relative change nothing", remedy=remedy)
    if spots is None and (correction.shifts or correction.swapped or correction.pixels_from):
        remedy = "correct the table that lists the looks"
        raise InputError("usage", "the table has no looks: --shift-moves and --swap change nothing", remedy=remedy)
    changed = None if moves is None else tuple(moves)
    if changed is not None and correction.relative:
        changed = _absolute(changed)
        changes.append("counters: summed up, because --relative says that each is the steps of its move")
    for axis in correction.flipped if changed is not None else ():
        name = f"{axis}_steps"
        changed = tuple(replace(move, **{name: -getattr(move, name)}) for move in changed or ())
        changes.append(f"{name}: written with the other sign; approaches stay, they say how the beam moved")
    looks = None if spots is None else tuple(spots)
    for shift in correction.shifts if looks is not None else ():
        looks, sentence = _shifted(looks or (), shift, count if changed is None else len(changed))
        changes.append(sentence)
    if looks is not None and correction.swapped:
        looks = tuple(map(_swapped, looks))
        changes.append("left and right: centres exchanged, with their uncertainties")
    if looks is not None and correction.pixels_from:
        looks = tuple(_from_zero(spot, correction.pixels_from) for spot in looks)
        changes.append(f"pixels: {correction.pixels_from} taken from all centres")
    return Corrected(changed, looks, tuple(changes))


def _absolute(moves: tuple[Move, ...]) -> tuple[Move, ...]:
    """Counters after each move of counters that are its steps; a segment begins with where homing ended."""
    absolute = list(moves[:1])
    for before, move in pairwise(moves):
        start = absolute[-1] if move.segment == before.segment else None
        added = {} if start is None else {n: getattr(start, n) + getattr(move, n) for n in _COUNTERS}
        absolute.append(replace(move, **added))
    return tuple(absolute)


_COUNTERS = tuple(f"{axis}_steps" for axis in AXES)


def _shifted(spots: tuple[Spot, ...], shift: Shift, count: int | None) -> tuple[tuple[Spot, ...], str]:
    """Looks with other moves; one whose move is not listed keeps its number and is left out by its status."""
    begin = (-1, -1)
    if shift.spot is not None:
        first = [(spot.move, spot.spot) for spot in spots if spot.spot == shift.spot]
        if not first:
            remedy = "name a number of the column spot"
            raise InputError("usage", f"--shift-moves {shift.moves}@{shift.spot}: no such spot", remedy=remedy)
        begin = first[0]
    last = max((spot.move for spot in spots), default=0) if count is None else count - 1
    shifted, lost = [], 0
    for spot in spots:
        if (spot.move, spot.spot) < begin:
            shifted.append(spot)
        elif 0 <= spot.move + shift.moves <= last:
            shifted.append(replace(spot, move=spot.move + shift.moves))
        else:
            lost += 1
            shifted.append(replace(spot, status=f"refused: move {spot.move + shift.moves} is not listed"))
    sentence = f"move: {shift.moves:+d} for {'all looks' if shift.spot is None else f'looks from spot {shift.spot} on'}"
    return tuple(shifted), sentence + f"; {lost} left out, whose move is not listed" * bool(lost)


def _swapped(spot: Spot) -> Spot:
    """A look with the centres of both cameras exchanged, and all that is stated of them."""
    left, right = CAMERAS
    names = [f.name for f in fields(Spot) if f"_{left}" in f.name]
    others = {name: name.replace(f"_{left}", f"_{right}") for name in names}
    exchanged = {a: getattr(spot, b) for a, b in others.items()} | {b: getattr(spot, a) for a, b in others.items()}
    return replace(spot, **exchanged)


def _from_zero(spot: Spot, first: int) -> Spot:
    """A look with centres counted from 0."""
    centre = {name: getattr(spot, name) for name in PIXELS}
    moved: dict[str, Any] = {name: None if value is None else value - first for name, value in centre.items()}
    return replace(spot, **moved)

"""Rows of moves.csv and spots.csv as they stand in the files: cells in the order of the columns."""

from __future__ import annotations

from typing import Any

from tvsbayes.instrument.campaign import MOVES, SPOTS, Move, Spot


def move_row(*cells: Any) -> Move:
    """A row of moves.csv."""
    return Move(**dict(zip(MOVES.columns, cells, strict=False)))


def spot_row(*cells: Any, **named: Any) -> Spot:
    """A row of spots.csv."""
    return Spot(**dict(zip(SPOTS.columns, cells, strict=False)), **named)

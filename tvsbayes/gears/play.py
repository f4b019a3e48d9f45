"""The play of a joint: the output rests until its wheel has taken the play up. NumPy or JAX (formulation 3.1, 8.1).

Positions of wheel and output share one unit. The output lies in a band about the wheel, half the play to either side;
where the side is unknown at a homing, two ends bound the positions that it may have.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np


def band_begun(wheel: Any, half: Any, approach: Any, xp: ModuleType = np) -> tuple[Any, Any]:
    """Compute the lowest and highest output after a homing.

    Args:
        wheel: position of the wheel.
        half: half of the play.
        approach: 1 arrived rising, -1 falling, 0 unknown.
        xp: numpy or jax.numpy.
    """
    below, above = wheel - half, wheel + half
    return xp.where(approach < 0, above, below), xp.where(approach > 0, below, above)


def band_moved(band: Any, wheel: Any, half: Any, xp: ModuleType = np) -> tuple[Any, Any]:
    """Compute the lowest and highest output after a move.

    Play is monotone in its state, so that the two ends bound all states between.
    """
    low, high = band
    return xp.clip(low, wheel - half, wheel + half), xp.clip(high, wheel - half, wheel + half)


class Rests(NamedTuple):
    """Both ends of the band after some moves, shapes (moves, 2, n).

    `output` is `wheel[anchor] + side * half`: `anchor` is the number of the last move that moved the output.
    """

    output: np.ndarray
    anchor: np.ndarray
    side: np.ndarray


def rests(wheel: np.ndarray, first: np.ndarray, approach: np.ndarray, half: np.ndarray, kept: set[int]) -> Rests:
    """Follow all moves, for many plays at once. NumPy.

    Args:
        wheel: positions of the wheel (moves,).
        first: whether a homing precedes the move, (moves,).
        approach: as in `band_begun`, (moves,); read where `first`.
        half: halves of the play, (n,).
        kept: numbers of the moves in the result.
    """
    found = []
    band, anchor, side = np.zeros((2, len(half))), np.zeros((2, len(half)), dtype=int), np.zeros((2, len(half)))
    for move, position in enumerate(wheel.tolist()):
        if first[move]:
            band = np.array(band_begun(position, half, approach[move]))
            anchor = np.full(band.shape, move)
            # Without play the side is that of the leg, and both ends coincide.
            side = np.repeat(np.array(band_begun(0.0, 1.0, approach[move]))[:, None], len(half), axis=1)
        else:
            before, band = band, np.array(band_moved(band, position, half))
            pushed = np.sign(before - band)
            anchor, side = np.where(pushed, move, anchor), np.where(pushed, pushed, side)
        if move in kept:
            found.append((band, anchor, side))
    return Rests(*map(np.array, zip(*found, strict=True)))

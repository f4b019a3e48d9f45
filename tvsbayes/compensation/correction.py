"""What is added to a command so that the reading comes where it should: a two-sided table, as a controller holds it.

Commands as the campaign counts them; forward is a rising command. No JAX.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.results.compensation_record import Compensation
from tvsbayes.single_axis.axis_campaign import AxisMove
from tvsbayes.single_axis.axis_rows import legs_of


@dataclass(frozen=True)
class Correction:
    """Corrections by side, linear between commands, constant beyond the ends.

    Attributes:
        command: ascending, shape (n,).
        forward, backward: what is added to the command, shape (n,).
        resolution: least command that is carried out; 0 where it is fine.
    """

    command: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    resolution: float = 0.0

    @classmethod
    def of(cls, made: Compensation) -> Correction:
        """That of a compensation."""
        command, forward, backward = np.array([(r.command, r.add_forward, r.add_backward) for r in made.table]).T
        return cls(command, forward, backward, made.resolution)

    def sent(self, command: np.ndarray, side: np.ndarray, common: float = 1.0, play: float = 1.0) -> np.ndarray:
        """What the mechanics get for commands (m,) that are arrived at from sides (m,), 1, -1 or 0 for unknown.

        Args:
            command: asked for.
            side: of the arrival.
            common: factor of what both sides have in common.
            play: factor of half of what they differ by.
        """
        ahead, back = (np.interp(command, self.command, add) for add in (self.forward, self.backward))
        found = command + 0.5 * common * (ahead + back) + 0.5 * play * side * (ahead - back)
        return np.round(found / self.resolution) * self.resolution if self.resolution else found

    def moved(self, moves: Sequence[AxisMove], common: float = 1.0, play: float = 1.0) -> list[AxisMove]:
        """Moves as the mechanics get them."""
        legs = legs_of(moves)
        sent = self.sent(legs.command, legs.side, common, play)
        return [replace(move, command=float(to)) for move, to in zip(moves, sent, strict=True)]


@dataclass(frozen=True)
class Cycle:
    """A run up and down through some commands.

    Attributes:
        moves: in order of time.
        read: numbers of those that are read, ascending, shape (r,).
        index, side: of each its command's number, and 1 or -1, shape (r,).
    """

    moves: tuple[AxisMove, ...]
    read: np.ndarray
    index: np.ndarray
    side: np.ndarray


def cycle(commands: np.ndarray, overrun: float, hours: float) -> Cycle:
    """Up through ascending commands (m,), beyond the last by `overrun`, and down again, within so many hours."""
    m = len(commands)
    path = [float(c) for c in (*commands, commands[-1] + overrun, *commands[::-1])]
    seconds = 3600.0 * hours / (len(path) - 1)
    moves = tuple(AxisMove(k, 0, k * seconds, c, "" if k else "forward") for k, c in enumerate(path))
    read = np.r_[np.arange(m), np.arange(m + 1, 2 * m + 1)]
    return Cycle(moves, read, np.r_[np.arange(m), np.arange(m)[::-1]], np.repeat([1, -1], m))

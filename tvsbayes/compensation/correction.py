"""Corrections added to commands so that readings meet their aim: a two-sided table, as a controller holds it.

Commands in the campaign's unit; forward is a rising command. No JAX.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.results.compensation_record import Compensation
from tvsbayes.single_axis.axis_campaign import AxisMove
from tvsbayes.single_axis.axis_rows import legs_of

ROUNDING = 1e-9
"""Of commands in a file, relative."""


@dataclass(frozen=True)
class Correction:
    """Corrections by side, linear between commands, constant outside the table, or periodic.

    Attributes:
        command: commands of the table, ascending, shape (n,).
        forward, backward: corrections added to the command, shape (n,).
        resolution: resolution of executed commands; 0 where it is negligible.
        period: that of the corrections, over which the table goes; 0 where they do not repeat.
    """

    command: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    resolution: float = 0.0
    period: float = 0.0

    @classmethod
    def of(cls, made: Compensation) -> Correction:
        """Return the correction of a compensation."""
        command, forward, backward = np.array([(r.command, r.add_forward, r.add_backward) for r in made.table]).T
        period = made.settings.get("period_command", 0.0)
        # A table over the range read has its own end.
        once = np.ptp(command) <= (1 + ROUNDING) * period
        return cls(command, forward, backward, made.resolution, period if once else 0.0)

    def sent(self, command: np.ndarray, side: np.ndarray, common: float = 1.0, play: float = 1.0) -> np.ndarray:
        """Compute the corrected commands for commands (m,) reached from sides (m,), 1, -1 or 0 for unknown.

        Args:
            command: command before the correction.
            side: side of the arrival.
            common: factor on the mean correction of both sides.
            play: factor on half of their difference.
        """
        first = self.command[0]
        at = first + np.mod(command - first, self.period) if self.period else command
        ahead, back = (np.interp(at, self.command, add) for add in (self.forward, self.backward))
        command_sent = command + 0.5 * common * (ahead + back) + 0.5 * play * side * (ahead - back)
        return np.round(command_sent / self.resolution) * self.resolution if self.resolution else command_sent

    def moved(self, moves: Sequence[AxisMove], common: float = 1.0, play: float = 1.0) -> list[AxisMove]:
        """Return the moves with corrected commands."""
        legs = legs_of(moves)
        sent = self.sent(legs.command, legs.side, common, play)
        return [replace(move, command=float(to)) for move, to in zip(moves, sent, strict=True)]

"""Readings that wrap by whole turns."""

from __future__ import annotations

import numpy as np

WRAP_SHARE = 0.7
"""Least deviation of a step from the line that is a jump, turns."""


def turn_jumps(command: np.ndarray, value: np.ndarray, turn: float) -> dict[int, float]:
    """Jumps of the readings by row, turns; empty where there are none.

    Args:
        command: commands of the readings in time order, shape (rows,).
        value: readings, shape (rows,).
        turn: one turn in the unit of the readings.
    """
    step = np.diff(command)
    moving = step != 0
    if moving.sum() < 3:
        return {}
    rise = np.diff(value)
    slope = float(np.median(rise[moving] / step[moving]))
    deviation = rise - slope * step
    jumps = np.flatnonzero(np.abs(deviation) > WRAP_SHARE * turn)
    # With a slope wrong by a turn per step, all steps or none jump; only rare jumps are wraps.
    return {int(k) + 1: float(deviation[k] / turn) for k in jumps} if 2 * len(jumps) < len(step) else {}

"""Rows of telemetry at which an axis rests."""

from __future__ import annotations

import numpy as np

ROWS_MIN = 4
"""Rows of one command, in the median of all commands, from which a table is telemetry."""
TAIL_SHARE = 1 / 3
"""Last share of the rows of a command, in which the axis should rest."""
QUIET_SHARE = 0.8
"""Share of the commands, the quieter ones, whose last rows give the noise at rest."""
MOVING_SHARE = 0.3
"""Least share of commands with rows in motion: with fewer, rows of a command are readings of one stop."""
NOISE_SDS, DIGITS = 5.0, 3.0
"""Largest distance from rest of a row at rest: standard deviations of last rows, and digits of the readings."""
STEP_SHARE = 0.02
"""Least distance of the first row of a command from rest, as a share of its step, at which the axis was under way."""


def at_rest(command: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Whether the axis rests at each row, by the readings of each command, shape (rows,).

    The first rows of a command are left out while they differ from the last ones by more than the noise of these; all
    rows of a command, where the last ones still differ. A table with few rows a command rests everywhere.

    Args:
        command: commands in time order, nan where missing, shape (rows,).
        value: readings, nan where missing.
    """
    rests = np.ones(len(command), bool)
    starts = np.flatnonzero(np.r_[True, command[1:] != command[:-1]]) if len(command) else np.array([], int)
    blocks = [np.arange(a, b) for a, b in zip(starts, [*starts[1:], len(command)], strict=True)]
    blocks = [block[np.isfinite(value[block])] for block in blocks]
    if len(blocks) < 2 or np.median([len(block) for block in blocks]) < ROWS_MIN:
        return rests
    tails = [block[-max(3, round(TAIL_SHARE * len(block))) :] for block in blocks]
    levels = [float(np.median(value[tail])) if len(tail) else np.nan for tail in tails]
    variances = sorted(float(np.var(value[tail], ddof=1)) for tail in tails if len(tail) > 1)
    # An axis that never came to rest adds nothing to the noise at rest.
    noise = np.sqrt(np.mean(variances[: max(1, round(QUIET_SHARE * len(variances)))]))
    steps = np.diff(np.unique(value[np.isfinite(value)]))
    resolution = float(steps.min()) if len(steps) else 0.0
    tolerance = max(NOISE_SDS * float(noise), DIGITS * resolution)
    for k, (block, level) in enumerate(zip(blocks, levels, strict=True)):
        if len(block) < 2:
            continue
        off = np.abs(value[block] - level) > tolerance
        before = levels[k - 1] if k else np.nan
        way = abs(level - before) if np.isfinite(before) else np.inf
        if off[0] and (k == 0 or abs(value[block[0]] - level) > STEP_SHARE * way):
            settled = int(np.argmax(~off)) if (~off).any() else len(block)
            last = np.flatnonzero(off)
            # Beyond a single outlier the axis came back: only the rows on its way count.
            run = last[: np.argmax(np.diff(np.r_[last, len(block) + 1]) > 1) + 1]
            rests[block[: max(settled, int(run[-1]) + 1)]] = False
        if len(block) >= ROWS_MIN and abs(value[block[-1]] - value[block[-2]]) > tolerance and off.mean() > 0.5:
            rests[block] = False
    under_way = np.mean([not rests[block].all() for block in blocks[1:]])
    return rests if under_way >= MOVING_SHARE else np.ones(len(command), bool)

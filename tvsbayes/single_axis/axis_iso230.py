"""The positioning test of an axis by ISO 230-2: runs at the positions read, actual less target, and the figures.

Deviations in the folder's unit; forward is the standard's "up".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tvsbayes.metrology.iso230 import RUNS_MIN, SYMBOLS, iso230
from tvsbayes.results.metrology_tables import FIGURES, IsoTarget
from tvsbayes.single_axis.axis_rows import AxisRows

SLOPE_SHARE = 0.05
"""Largest deviation from 1 of the slope at which commands without a unit are taken in that of the readings."""


def of_sides(name: str) -> str:
    """A figure's name with the sides of an axis."""
    return name.removesuffix("_deg").replace("_up", "_forward").replace("_down", "_backward")


AXIS_SYMBOLS = {
    of_sides(name): symbol.replace("up", "forward").replace("down", "backward") for name, symbol in SYMBOLS.items()
}
"""Letter of the standard by the name of a figure of an axis."""
AXIS_TERMS = {of_sides(name): term.partition(",")[0] for name, (_, term) in FIGURES.items()}
"""Its term, without the side."""


class PositionRuns(NamedTuple):
    """Positions (m,) and deviations (m, runs) of their readings by side, NaN where there are fewer runs.

    `rows` has the row of the axis for each deviation, by side, -1 for none.
    """

    position: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    rows: tuple[np.ndarray, np.ndarray]

    @property
    def figures(self) -> dict[str, float | None]:
        """Figures by name; None for what the runs do not give."""
        values = iso230(self.forward, self.backward)
        return {of_sides(name): _number(values[name]) for name in SYMBOLS}


def _number(value: np.ndarray) -> float | None:
    return float(value) if np.isfinite(value) else None


def position_runs(rows: AxisRows, deviation: np.ndarray) -> PositionRuns:
    """The runs of a test: positions read at least twice from both sides, else once, else from one side alone."""
    at = [[np.flatnonzero((rows.command == p) & (rows.side == side)) for side in (1, -1)] for p in rows.positions]
    counts = np.array([[len(side) for side in pair] for pair in at]).reshape(-1, 2)
    fewest = counts.min(axis=1)
    if not fewest.any():
        # Of one side alone: that which was read at more positions, or oftener.
        other = int(np.argmin((counts > 0).sum(axis=0) + 1e-9 * counts.sum(axis=0)))
        counts[:, other] = 0
        fewest = counts[:, 1 - other]
    chosen = np.flatnonzero(fewest >= min(RUNS_MIN, fewest.max()))
    numbers = []
    for side in (0, 1):
        table = np.full((len(chosen), counts[chosen, side].max(initial=0)), -1)
        for line, place in enumerate(chosen):
            table[line, : counts[place, side]] = at[place][side]
        numbers.append(table)
    forward, backward = (np.where(table >= 0, deviation[table], np.nan) for table in numbers)
    return PositionRuns(rows.positions[chosen], forward, backward, (numbers[0], numbers[1]))


def runs_about_line(rows: AxisRows) -> PositionRuns | None:
    """Deviations from the least-squares line; None for a drive that never stops."""
    line = rows.line
    return None if rows.in_motion else position_runs(rows, rows.value - rows.command * line.slope - line.offset)


class TargetRuns(NamedTuple):
    """Deviations from targets, None where commands are no targets; in words how targets are known, or why not."""

    runs: PositionRuns | None
    basis: str


def target_runs(rows: AxisRows) -> TargetRuns:
    """Deviations actual less target."""
    slope, unit = rows.line.slope, rows.command_unit
    if rows.in_motion:
        return TargetRuns(None, "no test by ISO 230-2: the drive never stops")
    if unit is not None and unit != rows.unit:
        return TargetRuns(None, f"no figures against targets: commands are in {unit}, readings in {rows.unit}")
    if slope < 0:
        why = "readings fall where commands rise: turn their sign round"
        return TargetRuns(None, f"no figures against targets: {why}")
    if unit is None and abs(slope - 1.0) > SLOPE_SHARE:
        why = f"a command is {slope:.6g} {rows.unit}; commands in {rows.unit} are targets: `command_unit` in [axis]"
        return TargetRuns(None, f"no figures against targets: {why}")
    how = "as campaign.toml states" if unit else f"since the slope is {slope:.6g}; `command_unit` in [axis] states it"
    return TargetRuns(position_runs(rows, rows.value - rows.command), f"targets are the commands in {rows.unit}, {how}")


def iso_targets(runs: PositionRuns) -> tuple[IsoTarget, ...]:
    """The table by position."""
    at = iso230(runs.forward, runs.backward)
    up, down = (np.isfinite(side).sum(axis=1) for side in (runs.forward, runs.backward))
    return tuple(
        IsoTarget(
            position=float(position),
            mean_forward=_number(at["mean_up"][k]),
            s_forward=_number(at["sd_up"][k]),
            mean_backward=_number(at["mean_down"][k]),
            s_backward=_number(at["sd_down"][k]),
            reversal=_number(at["reversal_at"][k]),
            runs_forward=int(up[k]),
            runs_backward=int(down[k]),
        )
        for k, position in enumerate(runs.position)
    )


STEP = 1e-4
"""Step of derivatives of figures, in standard uncertainties: far below the distance of two positions' deviations."""


class FigureParts(NamedTuple):
    """Contributions to a figure: of each cause of the reference, signed, and of the readings' own noise together."""

    reference: np.ndarray
    noise: float

    @property
    def u(self) -> float | None:
        """Standard uncertainty; None where there is no figure."""
        return _number(np.sqrt(np.sum(self.reference**2) + self.noise**2))


def figure_parts(runs: PositionRuns, rows: AxisRows) -> dict[str, FigureParts]:
    """First-order uncertainty of every figure of these runs (GUM 5.1.2): of how they were read, not of the axis."""
    u = np.sqrt(rows.variance)
    noisy = np.flatnonzero(u > 0)
    errors = np.concatenate([rows.reference.T, u[noisy, None] * np.eye(len(u))[noisy]]) if len(u) else np.zeros((0, 0))
    moved = np.stack([sign * STEP * errors for sign in (1.0, -1.0)])
    sides = [side + moved[..., np.maximum(table, 0)] for side, table in zip(runs[1:3], runs.rows, strict=True)]
    figures = iso230(*sides)
    parts, causes = {}, len(rows.reference_causes)
    for name in SYMBOLS:
        by_error = (figures[name][0] - figures[name][1]) / (2 * STEP)
        parts[of_sides(name)] = FigureParts(by_error[:causes], float(np.sqrt(np.sum(by_error[causes:] ** 2))))
    return parts

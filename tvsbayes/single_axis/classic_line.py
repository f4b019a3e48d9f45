"""What `classic` says of an axis: least-squares line with one reversal and independent stops; the test by ISO 230-2.

Deviations in the folder's unit; forward is the standard's "up".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from msgspec import field

from tvsbayes.display import Shown, View
from tvsbayes.metrology.iso230 import RUNS_MIN, SYMBOLS, iso230
from tvsbayes.results.metrology_tables import FIGURES, IsoTarget
from tvsbayes.results.records import Record
from tvsbayes.single_axis.axis_rows import AxisRows, line_design

SLOPE_SHARE = 0.05
"""Largest deviation from 1 of the slope at which commands without a unit are taken in that of the readings."""
STEP = 1e-4
"""Step of derivatives of figures, in standard uncertainties: far below the distance of two positions' deviations."""


def of_sides(name: str) -> str:
    """A figure's name with the sides of an axis."""
    return name.removesuffix("_deg").replace("_up", "_forward").replace("_down", "_backward")


AXIS_SYMBOLS = {
    of_sides(name): symbol.replace("up", "forward").replace("down", "backward") for name, symbol in SYMBOLS.items()
}
"""Letter of the standard by the name of a figure of an axis."""
AXIS_TERMS = {of_sides(name): term.partition(",")[0] for name, (_, term) in FIGURES.items()}
"""Its term, without the side."""


class ClassicAxis(Shown, Record, frozen=True):
    """The least-squares line with one reversal and independent stops, and the ISO 230-2 table.

    Attributes:
        per_command: slope of the line.
        backlash: reversal; None where stops were reached from one side only.
        u_per_command, u_backlash: standard uncertainties, the reference's included; None where no degree of freedom is
            left.
        residual_sd: scatter of the rows about the line; None likewise.
        iso230: figures by name, actual less target; null where commands are no targets. R and A are null with fewer
            than two runs a side, figures of a side, or of both, where it was not read.
        degrees_of_freedom: rows less unknowns of the line; None in results of 0.3.0.
        iso230_about_line: the same figures of the deviations from the least-squares line.
        iso230_targets: the positions of `iso230`.
        iso230_basis: how targets are known, or why there are no figures.
        symbols: letters of the standard by the names of the figures.
        iso230_u: standard uncertainty of each figure of `iso230` by reference and readings; 0 where neither states one.
    """

    per_command: float
    u_per_command: float | None
    backlash: float | None
    u_backlash: float | None
    residual_sd: float | None
    iso230: dict[str, float | None] | None
    degrees_of_freedom: int | None = None
    iso230_about_line: dict[str, float | None] | None = None
    iso230_targets: tuple[IsoTarget, ...] = ()
    iso230_basis: str = ""
    symbols: dict[str, str] = field(default_factory=dict)
    iso230_u: dict[str, float | None] | None = None

    def shown(self) -> View:
        """Show slope, backlash, scatter and ISO 230-2 figures."""
        rows: list[tuple[str, float | None, float | None]] = [
            ("per_command", self.per_command, self.u_per_command),
            ("backlash", self.backlash, self.u_backlash),
            ("residual_sd", self.residual_sd, None),
        ]
        rows += [(name, value, None) for name, value in (self.iso230 or {}).items()]
        return View("ClassicAxis: least-squares line with one reversal", ("quantity", "value", "u"), rows)


@dataclass(frozen=True)
class LineFit:
    """The line through some rows.

    Attributes:
        solution: offset, unit per command, backlash; undetermined values are 0.
        covariance: shape (3, 3); 0 for undetermined values.
        scatter: scatter of the rows about the line, unit.
        freedom: degrees of freedom; with none, scatter and covariance are 0 and say nothing.
    """

    solution: np.ndarray
    covariance: np.ndarray
    scatter: float
    freedom: int


def fit_line(rows: AxisRows, included: np.ndarray | None = None) -> LineFit:
    """Fit a line by least squares to the `included` rows (None: all)."""
    used = np.ones(len(rows.value), dtype=bool) if included is None else included
    determined = np.array([True, np.ptp(rows.command[used]) > 0, np.ptp(rows.side[used]) > 0])
    design = line_design(rows)[used][:, determined]
    solution, covariance = np.zeros(3), np.zeros((3, 3))
    solution[determined] = np.linalg.lstsq(design, rows.value[used], rcond=None)[0]
    freedom = max(int(used.sum()) - int(determined.sum()), 0)
    square = float(np.sum((rows.value[used] - design @ solution[determined]) ** 2))
    # Without freedom the residuals are rounding errors.
    scatter = float(np.sqrt(square / freedom)) if freedom else 0.0
    covariance[np.ix_(determined, determined)] = scatter**2 * np.linalg.pinv(design.T @ design)
    return LineFit(solution, covariance, scatter, freedom)


def reference_errors(rows: AxisRows) -> np.ndarray:
    """Errors of the line's solution by each cause of the reference, (3, causes); 0 for undetermined values."""
    errors = np.zeros((3, len(rows.reference_causes)))
    determined = np.array([True, np.ptp(rows.command) > 0, np.ptp(rows.side) > 0])
    errors[determined] = np.linalg.lstsq(line_design(rows)[:, determined], rows.reference, rcond=None)[0]
    return errors


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


class TargetRuns(NamedTuple):
    """Deviations from targets, None where commands are no targets; in words how targets are known, or why not."""

    runs: PositionRuns | None
    basis: str


def target_runs(rows: AxisRows) -> TargetRuns:
    """Deviations actual less target."""
    slope, unit = rows.line.slope, rows.command_unit
    if rows.in_motion:
        return TargetRuns(None, "no test by ISO 230-2: the drive never stops")
    why = None
    if unit is not None and unit != rows.unit:
        why = f"commands are in {unit}, readings in {rows.unit}"
    elif slope < 0:
        why = "readings fall where commands rise: turn their sign round"
    elif unit is None and abs(slope - 1.0) > SLOPE_SHARE:
        why = f"a command is {slope:.6g} {rows.unit}; commands in {rows.unit} are targets: `command_unit` in [axis]"
    if why is not None:
        return TargetRuns(None, f"no figures against targets: {why}")
    how = "as campaign.toml states" if unit else f"since the slope is {slope:.6g}; `command_unit` in [axis] states it"
    return TargetRuns(position_runs(rows, rows.value - rows.command), f"targets are the commands in {rows.unit}, {how}")


def _iso_targets(runs: PositionRuns) -> tuple[IsoTarget, ...]:
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


def classic_axis(rows: AxisRows) -> ClassicAxis:
    """Compute the least-squares line with a reversal, and the ISO 230-2 figures."""
    line = fit_line(rows)
    variance = np.diag(line.covariance) + np.sum(reference_errors(rows) ** 2, axis=1)
    u = np.sqrt(np.maximum(variance, 0.0)).tolist() if line.freedom else [None] * 3
    has_backlash = rows.both_sides
    targets, basis = target_runs(rows)
    off_line = rows.value - rows.command * rows.line.slope - rows.line.offset
    return ClassicAxis(
        per_command=float(line.solution[1]),
        u_per_command=u[1],
        backlash=float(line.solution[2]) if has_backlash else None,
        u_backlash=u[2] if has_backlash else None,
        residual_sd=line.scatter if line.freedom else None,
        iso230=None if targets is None else targets.figures,
        degrees_of_freedom=line.freedom,
        iso230_about_line=None if rows.in_motion else position_runs(rows, off_line).figures,
        iso230_targets=() if targets is None else _iso_targets(targets),
        iso230_basis=basis,
        symbols=AXIS_SYMBOLS,
        iso230_u=None if targets is None else {name: parts.u for name, parts in figure_parts(targets, rows).items()},
    )

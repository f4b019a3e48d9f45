"""The classic estimate of an axis: least-squares line with one reversal and independent stops, ISO 230-2 table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.metrology.iso230 import RUNS_MIN, figures_of
from tvsbayes.results.metrology_tables import FIGURES, Positioning
from tvsbayes.results.records import Record
from tvsbayes.single_axis.axis_rows import AxisRows, line_design


class ClassicAxis(Shown, Record, frozen=True):
    """The least-squares line with one reversal and independent stops, and the ISO 230-2 table.

    Attributes:
        per_command: slope of the line.
        backlash: reversal; None where stops were reached from one side only.
        u_per_command, u_backlash: standard errors; None where no degree of freedom is left.
        residual_sd: scatter of the rows about the line; None likewise.
        iso230: figures by name; None where positions were not read twice from both sides.
        degrees_of_freedom: rows less unknowns of the line; None in results of 0.3.0.
    """

    per_command: float
    u_per_command: float | None
    backlash: float | None
    u_backlash: float | None
    residual_sd: float | None
    iso230: dict[str, float] | None
    degrees_of_freedom: int | None = None

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


def classic_axis(rows: AxisRows) -> ClassicAxis:
    """Compute the least-squares line with a reversal, and the ISO 230-2 figures."""
    line = fit_line(rows)
    u = np.sqrt(np.maximum(np.diag(line.covariance), 0.0)).tolist() if line.freedom else [None] * 3
    has_backlash = rows.both_sides
    return ClassicAxis(
        per_command=float(line.solution[1]),
        u_per_command=u[1],
        backlash=float(line.solution[2]) if has_backlash else None,
        u_backlash=u[2] if has_backlash else None,
        residual_sd=line.scatter if line.freedom else None,
        iso230=iso230_figures(rows),
        degrees_of_freedom=line.freedom,
    )


@dataclass(frozen=True)
class PositionRuns:
    """Positions (m,) read twice from both sides, and the deviations of their readings from the least-squares line.

    `forward` and `backward` have shape (m, runs), NaN where there are fewer runs.
    """

    position: np.ndarray
    forward: np.ndarray
    backward: np.ndarray


def position_runs(rows: AxisRows) -> PositionRuns:
    """The runs for ISO 230-2."""
    deviations = rows.value - rows.command * rows.line.slope - rows.line.offset
    by_side = [[deviations[(rows.command == p) & (rows.side == side)] for p in rows.positions] for side in (1, -1)]
    complete = [k for k in range(len(rows.positions)) if min(len(by_side[0][k]), len(by_side[1][k])) >= RUNS_MIN]
    tables = []
    for runs in by_side:
        table = np.full((len(complete), max((len(runs[k]) for k in complete), default=0)), np.nan)
        for row, k in enumerate(complete):
            table[row, : len(runs[k])] = runs[k]
        tables.append(table)
    return PositionRuns(rows.positions[complete], *tables)


def positioning_of(rows: AxisRows) -> Positioning | None:
    """ISO 230-2 figures of the deviations from the line; None where no position was read twice from both sides.

    Fields named `_deg` are in the folder's unit; "up" is forward.
    """
    runs = position_runs(rows)
    return figures_of(runs.forward, runs.backward) if len(runs.position) else None


def iso230_figures(rows: AxisRows) -> dict[str, float] | None:
    """ISO 230-2 figures of the axis, by name, in the folder's unit."""
    positioning = positioning_of(rows)
    if positioning is None:
        return None
    field_of = {name.replace("_up", "_forward").replace("_down", "_backward"): name for name in FIGURES}
    return {name.removesuffix("_deg"): float(getattr(positioning, field)) for name, field in field_of.items()}

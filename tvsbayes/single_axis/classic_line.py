"""The classic estimate of an axis: least-squares line with one reversal and independent stops, ISO 230-2 table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from msgspec import field

from tvsbayes.display import Shown, View
from tvsbayes.results.metrology_tables import IsoTarget
from tvsbayes.results.records import Record
from tvsbayes.single_axis.axis_iso230 import AXIS_SYMBOLS, figure_parts, iso_targets, runs_about_line, target_runs
from tvsbayes.single_axis.axis_rows import AxisRows, line_design


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


def classic_axis(rows: AxisRows) -> ClassicAxis:
    """Compute the least-squares line with a reversal, and the ISO 230-2 figures."""
    line = fit_line(rows)
    variance = np.diag(line.covariance) + np.sum(reference_errors(rows) ** 2, axis=1)
    u = np.sqrt(np.maximum(variance, 0.0)).tolist() if line.freedom else [None] * 3
    has_backlash = rows.both_sides
    (targets, basis), about_line = target_runs(rows), runs_about_line(rows)
    return ClassicAxis(
        per_command=float(line.solution[1]),
        u_per_command=u[1],
        backlash=float(line.solution[2]) if has_backlash else None,
        u_backlash=u[2] if has_backlash else None,
        residual_sd=line.scatter if line.freedom else None,
        iso230=None if targets is None else targets.figures,
        degrees_of_freedom=line.freedom,
        iso230_about_line=None if about_line is None else about_line.figures,
        iso230_targets=() if targets is None else iso_targets(targets),
        iso230_basis=basis,
        symbols=AXIS_SYMBOLS,
        iso230_u=None if targets is None else {name: parts.u for name, parts in figure_parts(targets, rows).items()},
    )

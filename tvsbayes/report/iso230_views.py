"""The test of an axis by ISO 230-2: its figures, the table by position, the standard's plot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.errors import escaped
from tvsbayes.report.document import FigureView
from tvsbayes.report.drawing import BLACK, DIRECTION_STYLE, drawing, legend
from tvsbayes.report.tables import TableView, three_digits_fixed
from tvsbayes.single_axis.classic_line import AXIS_TERMS, ClassicAxis, PositionRuns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NO_FIGURE = "\u2013"
TARGETS_SHOWN = 60
"""Largest number of positions in the table."""


def iso230_table(classic: ClassicAxis, unit: str) -> TableView | None:
    """The figures by letter, against the targets and about the line; None where the readings give none."""
    columns = {"actual less target": classic.iso230, "about the line": classic.iso230_about_line}
    shown = {title: figures for title, figures in columns.items() if figures is not None and any_of(figures)}
    if not shown:
        return None
    rows = []
    for name, symbol in classic.symbols.items():
        values = [figures[name] for figures in shown.values()]
        cells = [NO_FIGURE if value is None else three_digits_fixed(value) for value in values]
        rows.append([f"{symbol}, {AXIS_TERMS[name]}", *cells])
    return TableView(f"ISO 230-2, {escaped(unit)}", ["", *shown], rows)


def any_of(figures: dict[str, float | None]) -> bool:
    """Whether there is a figure."""
    return any(value is not None for value in figures.values())


def targets_table(classic: ClassicAxis, unit: str) -> TableView | None:
    """Mean and s by position and side; None without targets."""
    rows = classic.iso230_targets
    if not rows:
        return None
    numbers = ("mean_forward", "s_forward", "mean_backward", "s_backward", "reversal")
    values = [abs(v) for row in rows for name in numbers if (v := getattr(row, name)) is not None]
    spread = max(values, default=0.0)
    # One number of decimals: three digits of the largest number, at least two of the smallest s.
    smallest = min((v for row in rows for n in numbers[1:4:2] if (v := getattr(row, n))), default=spread)
    decimals = max(0, 2 - int(f"{min(spread, 30 * smallest) or 1.0:.0e}".split("e")[1]))
    cells = [
        [f"{row.position:.10g}"]
        + [NO_FIGURE if (v := getattr(row, name)) is None else f"{v:.{decimals}f}" for name in numbers]
        + [f"{row.runs_forward}, {row.runs_backward}"]
        for row in rows
    ]
    caption = f"actual less target, {escaped(unit)}"
    if len(cells) > TARGETS_SHOWN:
        caption += f"; {TARGETS_SHOWN} of {len(cells)} positions, fit.json has all"
        cells = [cells[k] for k in np.linspace(0, len(cells) - 1, TARGETS_SHOWN).astype(int)]
    columns = ["target", "mean, forward", "s, forward", "mean, backward", "s, backward", "B", "runs"]
    return TableView(caption, columns, cells)


def iso230_plot(runs: PositionRuns, unit: str) -> Figure:
    """Every run, means by side, and means plus and less 2 s."""
    with drawing(3.4) as figure:
        axes = figure.add_subplot()
        axes.axhline(0.0, color=BLACK, linewidth=0.6)
        for name, sides in (("forward", runs.forward), ("backward", runs.backward)):
            read = np.isfinite(sides).sum(axis=1) > 0
            if not read.any():
                continue
            (marker, colour), at, deviations = DIRECTION_STYLE[name], runs.position[read], sides[read]
            mean = np.nanmean(deviations, axis=1)
            axes.plot(at, deviations, color=colour, linewidth=0.5, alpha=0.5, rasterized=True)
            axes.plot(at, mean, marker, linestyle="-", color=colour, markersize=4, linewidth=1.4, label=f"mean, {name}")
            if np.all(np.isfinite(deviations).sum(axis=1) > 1):
                s = np.nanstd(deviations, axis=1, ddof=1)
                for sign, label in ((2, f"mean \u00b1 2 s, {name}"), (-2, None)):
                    axes.plot(at, mean + sign * s, "--", color=colour, linewidth=0.9, label=label)
        axes.set(xlabel="target", ylabel=f"actual less target, {unit}")
        legend(figure, 2)
    return figure


def iso230_figure(runs: PositionRuns, unit: str) -> FigureView:
    """The plot with its texts."""
    alt = "Deviations of every run over the target, with the mean of either side and lines at two s from it."
    caption = "ISO 230-2: deviations of every run, their means by side, and the means plus and less 2 s."
    return FigureView(iso230_plot(runs, unit), alt, caption)

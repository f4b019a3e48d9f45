"""Figures of errors that repeat by position: an error with its band and the stops on it, a wave over its period.

Gears over their counters in deg, an axis over its commands in its unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.instrument.axes import SENSES
from tvsbayes.report.drawing import BLACK, BLUE, DIRECTION_STYLE, ORANGE, PURPLE, SKY, drawing, legend
from tvsbayes.statistics.intervals import band95

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tvsbayes.report.evidence import GearBand
    from tvsbayes.results.estimates import StopResidual
    from tvsbayes.single_axis.axis_fit import AxisFit
    from tvsbayes.single_axis.axis_periods import WaveSample

CURVE_POINTS = 81
"""Number of points of the curves of an axis' error and waves."""
PLAY_SHOWN = 0.1
"""Least variation of the play, over that of the error, for its own panel."""


def _banded(axes: Axes, x: np.ndarray, band: np.ndarray, name: str, light: str = SKY, dark: str = BLUE) -> None:
    """A curve with its 95 % band; `band` has low, mean, high, shape (3, n)."""
    axes.fill_between(x, band[0], band[2], color=light, alpha=0.4, linewidth=0, label=f"{name}, 95 %")
    axes.plot(x, band[1], color=dark, linewidth=1.2, label="its mean")


def gear_errors(band: GearBand, stops: Sequence[StopResidual]) -> Figure:
    """Transmission error of an axis over its counters with a 95 % band and the stops; also the play, if it varies."""
    play = np.ptp(band.play_deg, axis=0).max() > PLAY_SHOWN * np.ptp(band.error_deg, axis=0).max()
    with drawing(4.6 if play else 3.2) as figure:
        panels = np.atleast_1d(figure.subplots(1 + play, 1, sharex=True, height_ratios=[2, 1] if play else [1]))
        curves = [(panels[0], band.error_deg, "transmission error", SKY, BLUE)]
        curves += [(panels[1], band.play_deg, "change of play", ORANGE, PURPLE)] if play else []
        for axes, drawn, name, light, dark in curves:
            _banded(axes, band.steps, drawn, name, light, dark)
            for side in ((band.steps[0], band.seen_steps[0]), (band.seen_steps[1], band.steps[-1])):
                axes.axvspan(*side, color="#EEEEEE", zorder=0)
            axes.axhline(0.0, color=BLACK, linewidth=0.6)
            axes.set(ylabel=f"{name}, deg")
        for direction in SENSES[band.axis]:
            stops_here = [stop for stop in stops if stop.direction == direction]
            marker, colour = DIRECTION_STYLE[direction]
            steps = np.array([stop.steps for stop in stops_here], dtype=float)
            errors = np.interp(steps, band.steps, band.error_deg[1]) + [stop.deviation_deg for stop in stops_here]
            label = f"stops, moving {direction}"
            panels[0].plot(steps, errors, marker, color=colour, markersize=3.5, rasterized=True, label=label)
        panels[-1].set_xlabel(f"{band.axis} counter, steps")
        legend(figure, 2, panels[0])
    return figure


def axis_errors(fit: AxisFit, commands: np.ndarray, values: np.ndarray) -> Figure:
    """The error of an axis by position with its 95 % band, and the stops, minus the line through them.

    Args:
        fit: fit of the axis.
        commands: shape (t,).
        values: equally probable values of the error at the commands, in the axis' unit, shape (n, t).
    """
    rows = fit.rows
    design = np.column_stack([np.ones(len(rows.value)), rows.command - fit.model.middle])
    deviations = rows.value - design @ np.linalg.lstsq(design, rows.value, rcond=None)[0]
    with drawing(3.2) as figure:
        axes = figure.add_subplot()
        _banded(axes, commands, band95(values), "error by position")
        for side, name in ((1, "forward"), (-1, "backward"), (0, "")):
            of_side, (marker, colour) = rows.side == side, DIRECTION_STYLE[name]
            if of_side.any():
                label = f"stops, {name or 'side unknown'}"
                axes.plot(rows.command[of_side], deviations[of_side], marker, color=colour, markersize=3.5, label=label)
        axes.set(xlabel="command", ylabel=f"off the line, {fit.campaign.unit}")
        legend(figure, 2)
    return figure


def wave(sample: WaveSample, unit: str) -> Figure:
    """One wave over its mean period, with its 95 % band, given that it exists."""
    turn = np.linspace(0.0, 1.0, CURVE_POINTS)
    period_unit = "s" if sample.wave.clock == "seconds" else unit
    with drawing(2.4) as figure:
        axes = figure.add_subplot()
        _banded(axes, turn * float(np.mean(sample.period[sample.likeliest])), band95(sample.curve(turn)), "wave")
        axes.set(xlabel=f"{period_unit}, from {sample.record.middle:.6g} on", ylabel=unit)
        legend(figure, 2)
    return figure

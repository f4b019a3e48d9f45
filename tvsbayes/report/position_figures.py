"""Figures of errors that repeat by position, of gears over their counters: an error with its band, the stops on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.instrument.axes import SENSES
from tvsbayes.report.drawing import BLACK, BLUE, DIRECTION_STYLE, ORANGE, PURPLE, SKY, drawing, legend

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tvsbayes.report.evidence import GearBand
    from tvsbayes.results.estimates import StopResidual

PLAY_SHOWN = 0.1
"""Least variation of the play, over that of the error, for its own panel."""


def banded(axes: Axes, x: np.ndarray, band: np.ndarray, name: str, light: str = SKY, dark: str = BLUE) -> None:
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
            banded(axes, band.steps, drawn, name, light, dark)
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

"""Section of the page on what the gears repeat by position: errors over the counters, their scales, where ratios hold.

deg of the output's angle, counters in steps, ratios in deg/step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.instrument.axes import DIRECTIONS, SENSES
from tvsbayes.report.drawing import BLACK, BLUE, OF_DIRECTION, ORANGE, PURPLE, SKY, drawing
from tvsbayes.report.result_tables import ESTIMATE_COLUMNS, estimate_row, gears_table, range_text
from tvsbayes.report.tables import FigureView, Section, TableView, figure_view

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tvsbayes.report.evidence import Evidence, GearBand
    from tvsbayes.results.estimates import StopResidual

PLAY_SHOWN = 0.1
"""Of the width of the error's band: play that varies less has no band of its own."""


def gear_section(e: Evidence) -> list[Section]:
    """What the gears repeat; nothing where they are taken as perfect."""
    if not e.gears:
        return []
    summary = e.fit.summary
    rows = []
    for direction in DIRECTIONS:
        if summary.effective[direction] is not None:
            rows.append(estimate_row(f"{direction}, line", summary.effective[direction], "deg/step"))
            rows.append(estimate_row(f"{direction}, local", summary.local.get(direction), "deg/step"))
    ratios = TableView("Line through the looks, and gear ratio times slope of the mirrors", ESTIMATE_COLUMNS, rows)
    text = [
        f"Effective ratios are slopes of lines through the looks, {range_text(summary)}, errors of the gears included; "
        "over other counters these errors count anew. Local ratios are those of gears and mirrors without them, at the "
        "mean angles of the looks.",
        "Where no look reached (grey) nothing is known of the errors but their size: located points there are marked "
        "as extrapolated, and their uncertainty grows.",
    ]
    views = [_view(band, [stop for stop in e.shown.residuals if stop.axis == band.axis]) for band in e.gears]
    return [Section("Gears: what repeats by position", text, tables=[gears_table(summary), ratios], figures=views)]


def _view(band: GearBand, stops: Sequence[StopResidual]) -> FigureView:
    alt = f"Transmission error of the {band.axis} axis over its counters as a curve with a band, and stops as markers"
    caption = f"{band.axis} axis: transmission error with its 95 % band, and the stops on it; grey: nothing was seen."
    return figure_view(gear_errors(band, stops), alt, caption)


def gear_errors(band: GearBand, stops: Sequence[StopResidual]) -> Figure:
    """Transmission error of an axis over its counters with a 95 % band, the stops on it; the play, where it varies."""
    play = np.ptp(band.play_deg, axis=0).max() > PLAY_SHOWN * np.ptp(band.error_deg, axis=0).max()
    with drawing(4.6 if play else 3.2) as figure:
        panels = np.atleast_1d(figure.subplots(1 + play, 1, sharex=True, height_ratios=[2, 1] if play else [1]))
        shown = [(panels[0], band.error_deg, "transmission error", SKY, BLUE)]
        shown += [(panels[1], band.play_deg, "change of play", ORANGE, PURPLE)] if play else []
        for axes, (low, middle, high), name, light, dark in shown:
            axes.fill_between(band.steps, low, high, color=light, alpha=0.4, linewidth=0, label=f"{name}, 95 %")
            axes.plot(band.steps, middle, color=dark, linewidth=1.2, label="its mean")
            for side in ((band.steps[0], band.seen_steps[0]), (band.seen_steps[1], band.steps[-1])):
                axes.axvspan(*side, color="#EEEEEE", zorder=0)
            axes.axhline(0.0, color=BLACK, linewidth=0.6)
            axes.set(ylabel=f"{name}, deg")
        for direction in SENSES[band.axis]:
            mine = [stop for stop in stops if stop.direction == direction]
            marker, colour = OF_DIRECTION[direction]
            at = np.array([stop.steps for stop in mine], dtype=float)
            found = np.interp(at, band.steps, band.error_deg[1]) + [stop.deviation_deg for stop in mine]
            label = f"stops, moving {direction}"
            panels[0].plot(at, found, marker, color=colour, markersize=3.5, rasterized=True, label=label)
        panels[-1].set_xlabel(f"{band.axis} counter, steps")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure

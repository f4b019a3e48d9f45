"""The paper's figures for any campaign, and the pictures of a calibration report, as matplotlib figures.

Every function takes results and returns a `matplotlib.figure.Figure` without a window. Global settings of matplotlib do
not change, and importing the module does not load it. Frame S (X depth, Y left, Z up) in mm; ratios in deg/step; angles
in deg. `drawing` defines the common style.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.errors import listed
from tvsbayes.estimators.four_point import ClassicResult, DirectionResult, Selection, select_experiments
from tvsbayes.instrument.axes import DIRECTIONS, SENSES, Axis
from tvsbayes.instrument.campaign import Campaign, stereo_spots
from tvsbayes.instrument.experiments import name_of
from tvsbayes.report.drawing import (
    BLACK,
    BLUE,
    DIRECTION_STYLE,
    DIVERGING,
    ESTIMATOR_STYLE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    SEQUENTIAL,
    SKY,
    SMALLEST_SHARE,
    colour_map,
    drawing,
    legend,
)
from tvsbayes.report.tables import share_in_words, three_digits

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tvsbayes.coordinates.error_map import ErrorMap
    from tvsbayes.metrology.look_budget import Budget
    from tvsbayes.results.comparison_record import ComparisonRecord, Gap
    from tvsbayes.results.estimates import Cause, Curves, Estimate, FitSummary, StopResidual

__all__ = [
    *("causes", "correlations", "coverage", "direction_scatter", "error_maps", "gap_terms"),
    *("intervals", "points_3d", "ratio_curves", "residuals", "setup", "shares", "trajectories"),
]

EXPERIMENT = "experiment of this direction"
FAR_SD = 8.0
"""Distance of the joint estimate from the experiments' mean, in their sd, at which it would press them into a line."""


def __dir__() -> list[str]:
    """The names of the figures, completed at a prompt after `tvsbayes.plots.`."""
    return __all__


def _row_of(selection: Selection, experiment: int, direction: str | None) -> int:
    """The row of a complete experiment."""
    wanted = (selection.experiments == experiment) & np.isin(selection.direction, direction or DIRECTIONS)
    rows = np.flatnonzero(wanted)
    if len(rows) == 1:
        return int(rows[0])
    if len(rows):
        there = ", ".join(selection.direction[rows])
        raise ValueError(f"experiment {experiment} is there for {there}: give its direction too")
    named = zip(selection.direction.tolist(), selection.experiments.tolist(), strict=True)
    known = listed([name_of(*key) for key in named], 10)
    raise ValueError(f"experiment {name_of(direction, experiment)} is not complete; complete are {known or 'none'}")


def trajectories(campaign: Campaign, experiment: int, direction: str | None = None) -> Figure:
    """Draw the beam before and after the steps of one experiment, in the plane of its angle (paper, Figures 10 and 12).

    Args:
        campaign: the campaign.
        experiment: number of the experiment.
        direction: left, right, up or down, where several directions have that number.

    Raises:
        ValueError: the experiment is not complete, or several have that number.
    """
    selection = select_experiments(campaign)
    row = _row_of(selection, experiment, direction)
    points, axis, steps = campaign.points_mm[selection.spot_rows[row]], selection.axis[row], selection.steps[row]
    coordinate = 1 if axis == "pan" else 2
    before, after = points[[0, 1]], points[[3, 2]]
    with drawing(3.6) as figure:
        axes = figure.add_subplot()
        for pair, name, colour, marker in ((before, "before", BLUE, "o"), (after, "after", RED, "^")):
            along = pair[1] - pair[0]
            start, end = pair[0] - 0.6 * along, pair[1] + 0.2 * along
            axes.plot([start[0], end[0]], [start[coordinate], end[coordinate]], color=colour, linewidth=1)
            angle = np.degrees(np.arctan2(along[coordinate], along[0]))
            label = f"{name}: {angle:.2f} deg".replace("-", "\u2212")
            axes.plot(pair[:, 0], pair[:, coordinate], marker, color=colour, label=label, linestyle="none")
        for number, point in enumerate(points, start=1):
            axes.annotate(f"P{number}", (point[0], point[coordinate]), (4, 5), textcoords="offset points")
        title = f"experiment {name_of(selection.direction[row], experiment)}: {axis} by {steps:+d} steps"
        title = title.replace("-", "\u2212")
        axes.set(xlabel="X (depth), mm", ylabel=f"{'Y (left)' if coordinate == 1 else 'Z (up)'}, mm", title=title)
        # Equal scales keep angles true.
        axes.set_aspect("equal", adjustable="datalim")
        legend(figure, 2)
    return figure


def points_3d(campaign: Campaign, experiment: int | None = None, direction: str | None = None) -> Figure:
    """Draw spots in frame S: the four of one experiment, or all of a campaign (paper, Figure 11).

    Raises:
        ValueError: the experiment is not complete, or several have that number.
    """
    if experiment is None:
        points = campaign.usable_points_mm
    else:
        selection = select_experiments(campaign)
        points = campaign.points_mm[selection.spot_rows[_row_of(selection, experiment, direction)]]
    with drawing(4.0) as figure:
        axes = figure.add_subplot(projection="3d")
        axes.scatter(*points.T, s=12 if experiment is None else 40, color=BLUE, depthshade=False, rasterized=True)
        if experiment is not None:
            axes.plot(*points.T, color=GREY, linewidth=0.8)
            for number, point in enumerate(points, start=1):
                axes.text(*point, f"  P{number}")
        axes.set(xlabel="X (depth), mm", ylabel="Y (left), mm", zlabel="Z (up), mm")
        axes.locator_params(nbins=4)
        axes.set_box_aspect(None, zoom=0.82)
    return figure


def direction_scatter(result: ClassicResult, direction: str, joint: Estimate | None = None) -> Figure:
    """Draw one direction's experiments with mean and bands of 1, 2, 3 sigma (paper, Figures 13 to 16).

    Args:
        result: result of the classic estimator.
        direction: left, right, up or down.
        joint: estimate of the joint model, for comparison.

    Raises:
        ValueError: there is no such direction, or it has no experiment.
    """
    if direction not in DIRECTIONS:
        raise ValueError(f"direction {direction!r}; allowed: {', '.join(DIRECTIONS)}")
    summary = result.directions[direction]
    if summary is None:
        raise ValueError(f"no complete experiment moves {direction}")
    experiments = [e for e in result.experiments if e.direction == direction]
    mean, sd = summary.mean_deg_per_step, summary.sd_deg_per_step
    with drawing(3.4) as figure:
        axes = figure.add_subplot()
        if sd is not None:
            for k, grey in ((3, "#F0F0F0"), (2, "#E0E0E0"), (1, "#CCCCCC")):
                axes.axhspan(mean - k * sd, mean + k * sd, color=grey, label=f"{k} sigma", zorder=0)
        axes.axhline(mean, color=RED, label=f"mean {mean:.6f}")
        if joint is not None:
            label, away = f"joint {joint.value:.6f}, 2 u", joint.value - mean
            last = len(experiments) + 1.5
            if sd is None or abs(away) <= FAR_SD * sd:
                axes.errorbar(last, joint.value, 2 * joint.sd, fmt="o", color=BLUE, capsize=3, label=label)
            else:
                axes.plot([], [], "o", color=BLUE, label=f"{label}, {'above' if away > 0 else 'below'}")
        axes.plot(range(1, len(experiments) + 1), [e.deg_per_step for e in experiments], "^", color=BLACK, markersize=4)
        if (one := summary.outlier) is not None:
            place = 1 + [e.experiment for e in experiments].index(one.experiment)
            # Inwards, where there is room.
            side = "left" if place <= len(experiments) / 2 else "right"
            offset = (6 if side == "left" else -6, 0)
            text, at = f"experiment {one.experiment}", (place, one.deg_per_step)
            axes.annotate(text, at, offset, textcoords="offset points", ha=side, va="center")
        scatter = "" if sd is None else f", sd {sd:.6f}, u of the mean {summary.u_type_a_deg_per_step:.6f}"
        axes.set(xlabel=EXPERIMENT, ylabel="deg/step", title=f"{direction}, n = {summary.n}{scatter}")
        legend(figure, 3)
    return figure


def setup(
    campaign: Campaign, translation_mm: Sequence[float] | None = None, baseline_mm: float | None = None
) -> Figure:
    """Draw the rig from above and from the side in frame S: cameras, positioner, spots.

    Args:
        campaign: gives spots and cameras.
        translation_mm: estimated origin of the positioner's frame P in S, (3,); None omits it.
        baseline_mm: baseline of the TVS, for the caption of the positioner.
    """
    points = campaign.usable_points_mm
    right = -campaign.stereo_pair.R.T @ campaign.stereo_pair.T
    right_s = np.array([right[2], -right[0], -right[1]])
    with drawing(5.4) as figure:
        panels = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for axes, index, name in ((panels[0], 1, "Y (left), mm"), (panels[1], 2, "Z (up), mm")):
            axes.plot(points[:, 0], points[:, index], ".", color=RED, markersize=3, label="spots", rasterized=True)
            for centre, label in ((np.zeros(3), "left camera"), (right_s, "right camera")):
                marker = "s" if label.startswith("left") else "D"
                axes.plot(centre[0], centre[index], marker, color=GREEN, label=label, linestyle="none")
            if translation_mm is not None:
                origin = np.asarray(translation_mm, dtype=float)
                axes.plot(origin[0], origin[index], "^", color=BLUE, markersize=8, label="positioner", linestyle="none")
                for point in points[np.unique(np.round(points, -1), axis=0, return_index=True)[1][:24]]:
                    axes.plot([origin[0], point[0]], [origin[index], point[index]], color=ORANGE, linewidth=0.5)
            axes.set_ylabel(name)
            axes.set_aspect("equal", adjustable="datalim")
        panels[0].set_title("from above" + ("" if baseline_mm is None else f"; TVS baseline {baseline_mm:.4g} mm"))
        panels[1].set(xlabel="X (depth), mm", title="from the side")
        legend(figure, 2)
    return figure


def coverage(campaign: Campaign) -> Figure:
    """Draw the coverage of the data: counters seen, and spots in both images."""
    from matplotlib.patches import Rectangle

    spots = [spot for spot in stereo_spots(campaign.spots) if spot.status == "ok"]
    moves = {move.move: move for move in campaign.moves}
    counters = np.array([(moves[s.move].pan_steps, moves[s.move].tilt_steps) for s in spots]).reshape(-1, 2)
    with drawing(5.6) as figure:
        panels = figure.subplots(2, 1)
        poses, counts = np.unique(counters, axis=0, return_counts=True)
        panels[0].scatter(*poses.T, s=8 + 4 * np.sqrt(counts), color=BLUE, marker="o")
        panels[0].set(xlabel="pan counter, steps", ylabel="tilt counter, steps", title="poses; area grows with spots")
        for side, colour, marker in (("left", GREEN, "s"), ("right", RED, "^")):
            u, v = ([getattr(s, f"{c}_{side}_px") for s in spots] for c in "uv")
            panels[1].plot(u, v, marker, color=colour, markersize=2.5, label=f"{side} image", rasterized=True)
        width, height = campaign.stereo_pair.image_width, campaign.stereo_pair.image_height
        panels[1].add_patch(Rectangle((0, 0), width, height, fill=False, color=GREY))
        panels[1].set(xlabel="u, px", ylabel="v, px", title="spots in the images; frame: the sensor")
        panels[1].set(xlim=(-0.02 * width, 1.02 * width), ylim=(1.02 * height, -0.02 * height))
        panels[1].set_aspect("equal")
        legend(figure, 2)
    return figure


def intervals(
    joint: FitSummary | Mapping[str, Estimate | None],
    classic: ClassicResult | Mapping[str, DirectionResult | None] | None = None,
) -> Figure:
    """Draw the ratios of both estimators with their 95 % intervals by direction, deg/step.

    Args:
        joint: summary of a fit (`results.record.summary`, `read_fit(path).summary`), or estimates by direction.
        classic: result of the classic estimator; None draws the joint one alone.
    """
    ratios: object = getattr(joint, "effective", joint)
    if not isinstance(ratios, Mapping):
        usage = "takes what a fit says: tvsbayes.calibrate(campaign, sampled=False).record.summary"
        raise TypeError(f"intervals {usage}, or read_fit(path).summary; not a {type(joint).__name__}")
    classic = {} if classic is None else classic if isinstance(classic, Mapping) else classic.directions
    fitted = {d: (x.value, x.interval95) for d, x in ratios.items() if x is not None}
    four_point = {
        d: (x.mean_deg_per_step, x.interval95_gum or (x.mean_deg_per_step,) * 2) for d, x in classic.items() if x
    }
    with drawing(3.2) as figure:
        distance = 0.12 if four_point and fitted else 0.0
        # Ratios of pan and tilt differ by more than the length of their intervals, so each has its scale.
        for axes, pair in zip(figure.subplots(len(SENSES), 1), SENSES.values(), strict=True):
            for offset, name, results in ((-distance, "classic", four_point), (distance, "joint", fitted)):
                colour, marker = ESTIMATOR_STYLE[name]
                for row, direction in enumerate(pair):
                    if direction not in results:
                        continue
                    value, (low, high) = results[direction]
                    bars = [[max(value - low, 0.0)], [max(high - value, 0.0)]]
                    axes.errorbar(value, row + offset, xerr=bars, fmt=marker, color=colour, capsize=3, label=name)
            axes.set(yticks=range(len(pair)), yticklabels=pair, ylim=(len(pair) - 0.5, -0.5))
            axes.locator_params(axis="x", nbins=5)
        axes.set_xlabel("deg/step, 95 % intervals")
        legend(figure, 2)
    return figure


def gap_terms(gaps: ComparisonRecord | Mapping[str, Gap | None]) -> Figure:
    """Draw the terms of (classic - joint), deg/step, by direction; `gaps` come from `compare`, or are its record.

    Raises:
        ValueError: no direction has a gap.
    """
    gaps = gaps if isinstance(gaps, Mapping) else gaps.directions
    present = {direction: gap for direction, gap in gaps.items() if gap is not None}
    if not present:
        raise ValueError("no direction has a gap: the campaign has no complete experiment")
    names = [term.name for term in next(iter(present.values())).terms]
    with drawing(3.6) as figure:
        axes = figure.add_subplot()
        for shift, (direction, gap) in zip(np.linspace(-0.24, 0.24, len(present)), present.items(), strict=True):
            values = np.array([term.value for term in gap.terms])
            ends = np.array([term.interval95 for term in gap.terms])
            marker, colour = DIRECTION_STYLE[direction]
            y, bars = np.arange(len(names)) + shift, np.abs(ends.T - values)
            axes.errorbar(values, y, xerr=bars, fmt=marker, color=colour, capsize=2, label=direction, markersize=4)
        axes.axvline(0.0, color=BLACK, linewidth=0.8)
        wrapped = [name.replace(" and ", "\nand ", 1).replace(" over", "\nover") for name in names]
        axes.set(yticks=range(len(names)), yticklabels=wrapped, xlabel="classic - joint, deg/step, 95 % intervals")
        axes.invert_yaxis()
        axes.tick_params(axis="x", labelrotation=30)
        legend(figure, 4)
    return figure


def correlations(names: Sequence[str], matrix: np.ndarray) -> Figure:
    """Draw correlations with their values in the cells."""
    count = len(names)
    with drawing(0.9 + 0.42 * count) as figure:
        axes = figure.add_subplot()
        axes.imshow(matrix, cmap=colour_map(DIVERGING), vmin=-1, vmax=1)
        for row in range(count):
            for column in range(count):
                text_colour = "white" if abs(matrix[row, column]) > 0.8 else "black"
                text = f"{round(100 * matrix[row, column])}".replace("-", "\u2212")
                axes.text(column, row, text, ha="center", va="center", color=text_colour)
        axes.set(xticks=range(count), yticks=range(count), yticklabels=names, title="correlation, %")
        axes.set_xticklabels(names, rotation=60, ha="right", rotation_mode="anchor")
        axes.grid(False)
    return figure


def residuals(stops: Sequence[StopResidual], axis: Axis) -> Figure:
    """Draw the deviations of one axis' stops over time and over their counters."""
    axis_stops = [stop for stop in stops if stop.axis == axis]
    directions = SENSES[axis]
    with drawing(4.6) as figure:
        panels = figure.subplots(2, 1, sharey=True)
        for direction in (*directions, ""):
            marker, colour = DIRECTION_STYLE[direction]
            group = [stop for stop in axis_stops if stop.direction == direction]
            if not group:
                continue
            scaled = [stop.deviation_deg / stop.u_deg for stop in group]
            label = f"moving {direction}" if direction else "unknown approach"
            for axes, x in zip(panels, ([stop.time_s for stop in group], [stop.steps for stop in group]), strict=True):
                axes.plot(
                    x, scaled, marker, color=colour, markersize=3.5, linestyle="none", rasterized=True, label=label
                )
        for axes, name in zip(panels, ("time, s", f"{axis} counter, steps"), strict=True):
            axes.axhspan(-2, 2, color="#EEEEEE", zorder=0)
            axes.axhline(0.0, color=BLACK, linewidth=0.8)
            axes.set(xlabel=name, ylabel="deviation / u")
        panels[0].set_title(f"stops of the {axis} axis, {len(axis_stops)}; band: 2 standard deviations")
        legend(figure, 3)
    return figure


def causes(shares: Sequence[Cause], axis: str) -> Figure:
    """Draw the mean deviation by group of each cause, with two standard errors."""
    axis_causes = [cause for cause in shares if cause.axis == axis and len(cause.groups) > 1]
    rows = sum(len(cause.groups) for cause in axis_causes)
    with drawing(1.2 + 0.22 * max(rows, 2)) as figure:
        axes = figure.add_subplot()
        labels: list[str] = []
        for cause in axis_causes:
            colour, marker = (RED, "D") if cause.suspicious else (BLUE, "o")
            for group in cause.groups:
                bar = 2 * group.standard_error
                axes.errorbar(group.mean, len(labels), xerr=bar, fmt=marker, color=colour, markersize=4)
                labels.append(f"{cause.name}: {group.label}")
            axes.axhline(len(labels) - 0.5, color="#CCCCCC", linewidth=0.6)
        axes.axvline(0.0, color=BLACK, linewidth=0.8)
        axes.set(yticks=range(len(labels)), yticklabels=labels, xlabel="mean deviation / u, two standard errors")
        axes.invert_yaxis()
        axes.tick_params(axis="y", labelsize=8)
    return figure


def error_maps(maps: ErrorMap, range_index: int) -> Figure:
    """Draw the root mean square 3D error of each estimator over pan and tilt at one range, mm."""
    names = [name for name in ESTIMATOR_STYLE if name in maps.rms_mm]
    with drawing(0.5 + 1.75 * len(names)) as figure:
        panels = np.atleast_1d(figure.subplots(len(names), 1, sharex=True))
        # All panels have one scale: equal colours are equal errors.
        values_all = np.concatenate([maps.rms_mm[name][:, :, range_index].ravel() for name in names])
        finite = values_all[np.isfinite(values_all)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
        for axes, name in zip(panels, names, strict=True):
            values = maps.rms_mm[name][:, :, range_index].T
            colours = colour_map(SEQUENTIAL)
            mesh = axes.pcolormesh(
                maps.pan_steps, maps.tilt_steps, values, cmap=colours, vmin=low, vmax=high, rasterized=True
            )
            figure.colorbar(mesh, ax=axes, label="mm")
            _cells(axes, maps.pan_steps, maps.tilt_steps, values, low + 0.55 * (high - low))
            axes.set(ylabel="tilt, steps", title=f"{name}, range {maps.range_mm[range_index]:.4g} mm")
            axes.grid(False)
        panels[-1].set_xlabel("pan, steps")
    return figure


def _cells(axes: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, dark_above: float) -> None:
    """Write values into the cells of a map, white on dark cells."""
    for row, yy in enumerate(y):
        for column, xx in enumerate(x):
            value = values[row, column]
            if np.isfinite(value):
                colour = "white" if value > dark_above else "black"
                axes.text(xx, yy, three_digits(value), ha="center", va="center", color=colour)


def shares(budget: Budget) -> Figure:
    """Draw the shares of a point's variance by cause, largest first; shares below `SMALLEST_SHARE` form one bar."""
    order = np.argsort(-budget.share)
    shown = [k for k in order if budget.share[k] >= SMALLEST_SHARE]
    names = [share_in_words(budget.causes[k]) for k in shown]
    values = [100 * budget.share[k] for k in shown]
    remainder = 100 - sum(values)
    if remainder > 0.05:
        names.append("all others")
        values.append(remainder)
    with drawing(0.9 + 0.26 * len(names)) as figure:
        axes = figure.add_subplot()
        bars = axes.barh(range(len(names)), values, color=SKY, edgecolor=BLACK, linewidth=0.5)
        axes.bar_label(bars, labels=[f"{value:.1f} %" for value in values], padding=3)
        axes.set(yticks=range(len(names)), yticklabels=names, xlabel="share of the variance, %")
        axes.set_xlim(0, 1.2 * max(values))
        axes.invert_yaxis()
    return figure


def ratio_curves(curves: Curves) -> Figure:
    """Draw local ratios along both axes with 95 % intervals."""
    with drawing(5.4) as figure:
        panels = figure.subplots(2, 1)
        for axes, axis, directions in zip(panels, SENSES, SENSES.values(), strict=True):
            points = curves.ratios[axis]
            angle = np.array([point.pan_deg if axis == "pan" else point.tilt_deg for point in points])
            for shift, direction in zip((-0.02, 0.02), directions, strict=True):
                if any(direction not in point.ratios for point in points):
                    continue
                value = np.array([point.ratios[direction].value for point in points])
                ends = np.array([point.ratios[direction].interval95 for point in points])
                marker, colour = DIRECTION_STYLE[direction]
                x, bars = angle + shift * np.ptp(angle), np.abs(ends.T - value)
                axes.errorbar(
                    x, value, yerr=bars, label=direction, fmt=f"{marker}-", color=colour, capsize=2, markersize=4
                )
            axes.set(xlabel=f"{axis} angle, deg", ylabel="deg/step")
        legend(figure, 4)
    return figure

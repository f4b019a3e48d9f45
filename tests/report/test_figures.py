"""The paper's figures for any campaign."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from support.small_results import estimate

from tvsbayes.estimators.four_point import classic
from tvsbayes.instrument.axes import SENSES
from tvsbayes.instrument.stereo_pair import triangulate
from tvsbayes.report import figures
from tvsbayes.report.drawing import WIDTH_IN
from tvsbayes.report.figures import (
    direction_scatter,
    intervals,
    points_3d,
    ratio_curves,
    trajectories,
)
from tvsbayes.report.scanner_sections import residuals_section
from tvsbayes.results.estimates import Cause, CauseGroup, CurvePoint, Curves, Measured


def test_the_papers_figures_for_any_campaign(evidence):
    campaign, result = evidence.campaign, classic(evidence.campaign)
    number = result.experiments[0].experiment
    for figure in (
        trajectories(campaign, number),
        points_3d(campaign, number),
        points_3d(campaign),
        direction_scatter(result, "left", estimate(0.062, 1e-4)),
    ):
        assert figure.get_axes() and figure.get_size_inches()[0] == WIDTH_IN
    angles = trajectories(campaign, number).axes[0].get_legend_handles_labels()[1]
    first = result.experiments[0]
    assert angles == [f"before: {first.theta_i_deg:.2f} deg", f"after: {first.theta_f_deg:.2f} deg"]
    with pytest.raises(ValueError, match="not complete"):
        trajectories(campaign, 10_000)
    # A book that counts anew in each direction: the number alone names several.
    same = next(e for e in result.experiments if e.direction != first.direction)
    spots = tuple(
        replace(s, experiment=number) if s.experiment in (number, same.experiment) else s for s in campaign.spots
    )
    with pytest.raises(ValueError, match="give its direction"):
        trajectories(replace(campaign, spots=spots), number)
    drawn = trajectories(replace(campaign, spots=spots), number, same.direction).axes[0]
    assert drawn.get_title().startswith(f"experiment {number} ({same.direction})")
    # A joint estimate far away leaves the scatter its room.
    mean, sd = result.directions["left"].mean_deg_per_step, result.directions["left"].sd_deg_per_step
    far = direction_scatter(result, "left", estimate(mean + 30 * sd, sd)).axes[0]
    assert far.get_ylim()[1] < mean + 5 * sd
    assert any(label.endswith("above") for label in far.get_legend_handles_labels()[1])
    with pytest.raises(ValueError, match="allowed: left, right, up, down"):
        direction_scatter(result, "Left")


def lines_of(figure):
    return [line for axes in figure.axes for line in axes.lines]


def test_figures_take_what_the_estimators_return(evidence):
    """A summary and a classic result are accepted as returned."""
    result = classic(evidence.campaign)
    whole = intervals(evidence.fit.summary, result)
    parts = intervals(evidence.fit.summary.effective, result.directions)
    drawn = [[line.get_xydata().tolist() for line in lines_of(figure)] for figure in (whole, parts)]
    assert drawn[0] == drawn[1] and len(drawn[0]) >= 8
    assert len(lines_of(intervals(evidence.fit.summary))) < len(drawn[0])
    # Alone an estimate stands at its tick, two stand beside it.
    alone = {float(y) for line in lines_of(intervals(evidence.fit.summary)) for y in line.get_ydata()}
    both = {float(y) for line in lines_of(whole) for y in line.get_ydata()}
    assert alone == {0.0, 1.0} and not alone & both
    # The widest interval of an axis takes a quarter of its panel at least: pan and tilt on one scale hid all of them.
    for axes in intervals(evidence.fit.summary).axes:
        low, high = axes.get_xlim()
        ends = [float(x) for line in axes.lines for x in line.get_xdata()]
        assert max(ends) - min(ends) > 0.25 * (high - low)
    with pytest.raises(TypeError, match=r"record\.summary.* not a ClassicResult"):
        intervals(result)


def test_spots_are_triangulated_once_for_classic_and_figures(evidence, monkeypatch):
    """A copy of a campaign is triangulated on first use; the stored points are read-only."""
    calls = []
    monkeypatch.setattr(
        "tvsbayes.instrument.campaign.triangulate", lambda *args: calls.append(args) or triangulate(*args)
    )
    campaign = replace(evidence.campaign)
    number = classic(campaign).experiments[0].experiment
    figures.setup(campaign)
    figures.coverage(campaign)
    trajectories(campaign, number)
    points_3d(campaign)
    assert len(calls) == 1 and not hasattr(figures, "triangulate")
    with pytest.raises(ValueError, match="read-only"):
        campaign.points_mm[0] = 0.0


def test_completion_lists_figures_alone():
    names = [name for name, value in vars(figures).items() if getattr(value, "__module__", "") == figures.__name__]
    assert dir(figures) == sorted(name for name in names if not name.startswith("_")) and len(dir(figures)) > 10


def test_no_text_of_the_ratios_is_cut_or_covers_points(evidence):
    """Labels end inside of the figure; legends stand beside the axes."""
    at = Measured(0.062, 1e-4, (0.0618, 0.0622))
    places = (0.0, 5.0, 9.0)
    along = {a: tuple(CurvePoint(x, x, **dict.fromkeys(pair, at)) for x in places) for a, pair in SENSES.items()}
    curves = ratio_curves(Curves(along, {}))
    for figure in (direction_scatter(classic(evidence.campaign), "left"), curves):
        # The layout is found by drawing.
        FigureCanvasAgg(figure).draw()
        assert [axes for axes in figure.axes if axes.get_legend()] == []
        texts = [text for axes in figure.axes for text in (axes.xaxis.label, axes.title) if text.get_text()]
        for box in (text.get_window_extent() for text in texts):
            assert 0 <= box.x0 and box.x1 <= figure.bbox.x1
    (legend,) = curves.legends
    assert [text.get_text() for text in legend.get_texts()] == ["left", "right", "up", "down"]


def test_gaps_of_no_direction_are_refused_in_words():
    with pytest.raises(ValueError, match="no complete experiment"):
        figures.gap_terms({"left": None, "up": None})


def test_a_cause_with_one_group_has_no_empty_figure():
    """A pan axis whose stops were all seen at one depth; of tilt two depths can be compared."""
    group = CauseGroup("near", 8, 0.1, 0.3)
    one, two = Cause("depth", "pan", (group,), None, False), Cause("depth", "tilt", (group, group), 0.4, False)
    noise = SimpleNamespace(chi2=1.0, dof=1.0)
    summary = SimpleNamespace(noise=noise, parameters={"pixel_scale": SimpleNamespace(value=1.0)})
    shown = SimpleNamespace(residual_causes=(one, two), residuals=())
    section = residuals_section(SimpleNamespace(fit=SimpleNamespace(summary=summary), shown=shown))
    assert [view.caption for view in section.figures] == ["tilt axis: mean deviation by group."]

"""The paper's figures for any campaign."""

from __future__ import annotations

import pytest
from support.small_results import estimate

from tvsbayes.estimators.four_point import classic
from tvsbayes.report.figures import WIDTH_IN, direction_scatter, points_3d, trajectories


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

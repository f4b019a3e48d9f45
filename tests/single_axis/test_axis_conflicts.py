"""Priors of an axis that the readings contradict are named with the value of the readings; correct priors are not."""

from __future__ import annotations

import numpy as np
import pytest
from support.axes import campaign, drawn, random_moves, runs

from tvsbayes.report.axis_document import axis_fit_text
from tvsbayes.single_axis.axis_campaign import AxisCampaign
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import summarise_axis

pytestmark = pytest.mark.thorough

PLAY, RATIO, SCATTER = 0.2, 0.01, 0.003


def played(ratio: float = RATIO, **stated: AxisPrior) -> AxisCampaign:
    """Three runs over an axis with play, independent stops."""
    moves = runs(3)
    side = [-1.0, *np.sign(np.diff([m.command for m in moves]))]
    rng = np.random.default_rng(2)
    values = [
        ratio * m.command - 0.5 * PLAY * s + SCATTER * rng.standard_normal() for m, s in zip(moves, side, strict=True)
    ]
    return campaign(moves, values, **stated)


@pytest.mark.parametrize(
    ("name", "prior", "value"),
    [
        ("backlash", AxisPrior(0.0, 0.005), PLAY),
        ("backlash", AxisPrior(0.0, 0.0), PLAY),
        ("per_command", AxisPrior(0.0099, 1e-6), RATIO),
    ],
)
def test_a_prior_that_the_readings_contradict_is_named(name, prior, value):
    """Error and play by position absorb a wrong prior, so the posterior alone does not show it."""
    summary = summarise_axis(fit_axis(played(**{name: prior}), tier="importance"))
    [conflict] = [text for text in summary.prior_conflicts if text.startswith(f"{name} = ")]
    assert float(conflict.split(" = ")[1].split("(")[0]) == pytest.approx(value, rel=0.1)
    assert f"{prior.value:g}" in conflict and "from its prior's centre" in conflict and "[axis]" in conflict
    text = axis_fit_text(summary)
    assert f"prior conflict: {conflict}" in text
    assert "verdict: usable\n" not in text + "\n"


def test_a_prior_that_prevents_convergence_is_named():
    """The ratio is stated per full step, commands are counted in microsteps."""
    fit = fit_axis(played(per_command=AxisPrior(16 * RATIO, 0.001), creep=AxisPrior(0.0, 0.0)), tier="importance")
    assert fit.error is not None
    assert "per_command = 0.0100" in fit.error.remedy and "value = 0.16" in fit.error.remedy
    assert "microsteps" in fit.error.remedy and "--quick" not in fit.error.remedy


def test_scales_far_beyond_their_priors_are_named():
    """A stop scatter of five hundred times the one that was stated."""
    rng = np.random.default_rng(1)
    moves = runs(3)
    values = [RATIO * m.command + 2.0 * rng.standard_normal() for m in moves]
    tight = {"stop_sd": AxisPrior(0.004, 1.0), "transmission_error": AxisPrior(0.0, 0.01)}
    summary = summarise_axis(fit_axis(campaign(moves, values, **tight), sampled=False))
    assert any(text.startswith("stop_sd.forward = ") for text in summary.prior_conflicts)


@pytest.mark.parametrize("seed", range(4))
def test_correct_priors_are_not_named(seed):
    """A false alarm occurs once in thousands of axes with correct priors."""
    moves = (runs(2), random_moves(seed, 40, 2))[seed % 2]
    tight = {"per_command": AxisPrior(0.01, 1e-6), "backlash": AxisPrior(0.1, 0.005)}
    axis = drawn(seed, moves, **tight).campaign
    assert fit_axis(axis, sampled=False).conflicts == ()

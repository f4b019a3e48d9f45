"""Fits of simulated axes: the truth is recovered, both tiers agree, all parameters may be fixed."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.axes import FIRST_EDITION, campaign, drawn, random_moves, runs

from tvsbayes.inference import ensemble
from tvsbayes.inference.chain import run_of
from tvsbayes.inference.importance import weighted_run
from tvsbayes.results.tiers import CHAIN, IMPORTANCE, RUNS
from tvsbayes.single_axis.axis_campaign import AxisMove
from tvsbayes.single_axis.axis_density import AxisDensity, find_mode
from tvsbayes.single_axis.axis_fit import fit_axis, model_of
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import summarise_axis


@pytest.mark.thorough
def test_truths_lie_within_the_stated_uncertainty():
    """Six simulated axes of two protocols; the bound on the sum of squares is exceeded by 1 in 1e4 sets of normal z."""
    z = []
    for seed in range(3):
        for moves in (runs(3), random_moves(seed, 40, 2)):
            simulated = drawn(seed, moves, backlash=AxisPrior(0.0, 0.1))
            fit = fit_axis(simulated.campaign, tier="importance", seed=seed)
            assert fit.error is None
            z += [
                (draws.mean() - simulated.truth.parameters[name]) / draws.std()
                for name in ("per_command", "backlash")
                for draws in [fit.draws[name]]
            ]
    # 12 numbers: chi-square at 1e-4 is 39.1, at 1 - 1e-4 1.4.
    assert 1.4 < np.sum(np.square(z)) < 39.1


@pytest.mark.thorough
def test_both_tiers_agree_and_a_seed_gives_the_same():
    axis = drawn(3, runs(2), backlash=AxisPrior(0.0, 0.1)).campaign
    one = fit_axis(axis, tier=CHAIN, seed=1)
    assert one.tier == "emcee" and one.error is None
    agreement = one.sample.convergence.agreement
    assert agreement is not None and agreement.agrees
    quick, again = (fit_axis(axis, tier="importance", seed=1) for _ in range(2))
    np.testing.assert_array_equal(quick.draws["backlash"], again.draws["backlash"])
    json.dumps(summarise_axis(one).as_json(), allow_nan=False)


@pytest.mark.parametrize(("refused", "tier"), [(False, IMPORTANCE), (True, CHAIN)])
def test_a_chain_runs_where_weighted_draws_are_not_accepted(monkeypatch, refused, tier):
    """And nowhere else, without being asked for; under these limits it answers in a few steps."""
    if refused:
        monkeypatch.setattr("tvsbayes.inference.importance.K_MAX", -9.0)
        monkeypatch.setattr("tvsbayes.inference.importance.ROUNDS_MAX", 4)
    chains = []
    monkeypatch.setattr("tvsbayes.single_axis.axis_fit.run_of", lambda name: chains.append(name) or run_of(name))
    fit = fit_axis(drawn(3, runs(2), backlash=AxisPrior(0.0, 0.1)).campaign, seed=1)
    assert (fit.tier, fit.answer) == (tier, "accepted") and chains == [CHAIN] * refused


def test_the_seed_is_that_of_the_line_which_is_integrated_out():
    model = model_of(drawn(3, runs(1)).campaign)
    density = AxisDensity(model, find_mode(model))
    one, again, other = (weighted_run(density, seed).drawn.parts["linear"] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    # Independent normal numbers; those of one stream correlate by 0.4 and 0.7 in the first and third column.
    count = min(len(one), len(other))
    correlation = [np.corrcoef(one[:count, k], other[:count, k])[0, 1] for k in range(one.shape[1])]
    assert np.abs(correlation).max() < 5 / np.sqrt(count)


class OtherRun(ensemble.Run):
    """The chain of emcee under the name of another tier."""

    tier = "other"


@pytest.mark.thorough
def test_another_tier_is_an_entry_of_runs(monkeypatch):
    monkeypatch.setitem(RUNS, OtherRun.tier, "ensemble:OtherRun")
    monkeypatch.setattr(ensemble, "OtherRun", OtherRun, raising=False)
    axis = drawn(3, runs(2), backlash=AxisPrior(0.0, 0.1)).campaign
    one, other = (fit_axis(axis, tier=tier, seed=1) for tier in (CHAIN, OtherRun.tier))
    assert (one.tier, other.tier) == (CHAIN, OtherRun.tier)
    np.testing.assert_array_equal(one.draws["backlash"], other.draws["backlash"])


def test_play_swallows_short_legs():
    """Backlash of five legs, stops inside it."""
    commands = [*range(0, 12), *range(12, 0, -1), *range(0, 12)]
    moves = [AxisMove(k, 0, 0.0, float(c), "" if k else "forward") for k, c in enumerate(commands)]
    rng = np.random.default_rng(8)
    y, values = -2.5, []
    for c in commands:
        y = min(max(y, c - 2.5), c + 2.5)
        values.append(y + 0.05 * rng.standard_normal())
    fit = fit_axis(campaign(moves, values, backlash=AxisPrior(0.0, 10.0)), tier="importance")
    assert fit.model.play_is_sampled
    draws = fit.draws["backlash"]
    # Scatter 0.05 over ten stops on either side would give 0.02; play and error vary by position besides.
    assert draws.mean() == pytest.approx(5.0, abs=3 * draws.std())
    assert draws.std() < 0.2


def test_a_search_that_ends_elsewhere_is_not_converged():
    """Legs of a few commands, a play of three: a search ended at half of the true ratio, 26 in log density too low."""
    rng = np.random.default_rng(5)
    commands = rng.integers(0, 5, 30).tolist()
    moves = [AxisMove(k, 0, 0.0, float(c), "" if k else "forward") for k, c in enumerate(commands)]
    y, values = -1.5, []
    for c in commands:
        y = min(max(y, c - 1.5), c + 1.5)
        values.append(y + 0.05 * rng.standard_normal())
    fit = fit_axis(campaign(moves, values, backlash=AxisPrior(0.0, 10.0)), sampled=False)
    # In either case: an approximation reported as converged covers the truth.
    ratio = fit.draws["per_command"]
    assert fit.error is not None or abs(ratio.mean() - 1.0) < 4 * ratio.std()
    assert fit.mode.missing == fit.missing == summarise_axis(fit).problems


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("scales", [FIRST_EDITION, {}], ids=["held", "free"])
def test_readings_without_a_density_are_not_converged(scales):
    """A scale of readings of zero, which no folder may state."""
    moves = runs(2)
    values = [0.01 * m.command + 0.002 * (k % 3) for k, m in enumerate(moves)]
    fit = fit_axis(campaign(moves, values, 0.001, **{**scales, "reading_scale": AxisPrior(0.0, 0.0)}), sampled=False)
    assert fit.error is not None and fit.error.exit_code == 4 and fit.error.remedy
    assert "no density" in fit.error.message and not summarise_axis(fit).converged


def test_a_reversal_of_the_wrong_sign_is_reported():
    moves = runs(3)
    side = [-1.0, *np.sign(np.diff([m.command for m in moves]))]
    rng = np.random.default_rng(2)
    values = [0.01 * m.command + 0.1 * s + 0.003 * rng.standard_normal() for m, s in zip(moves, side, strict=True)]
    summary = summarise_axis(fit_axis(campaign(moves, values), sampled=False))
    assert summary.parameters["backlash"].value == pytest.approx(-0.2, abs=0.05)
    assert any("negative" in text for text in summary.warnings)


def test_places_read_one_after_the_other_are_weak():
    """Place and time are confounded, which is reported until equal ratios and no creep are stated."""
    commands = [c + beside for c in (0.0, 1000.0, 2000.0, 3000.0) for beside in (-300.0, 0.0, 300.0, 0.0) * 2]
    moves = [AxisMove(k, 0, 120.0 * k, c, "" if k else "forward") for k, c in enumerate(commands)]
    values = [0.01 * m.command + 0.003 * (k % 3) for k, m in enumerate(moves)]
    steady = {"ratio_contrast": AxisPrior(0.0, 0.0), "creep": AxisPrior(0.0, 0.0)}
    for stated, weak in (({}, True), (steady, False)):
        summary = summarise_axis(fit_axis(campaign(moves, values, 0.001, **stated), sampled=False))
        assert any("one after the other" in text for text in summary.weak_directions) is weak

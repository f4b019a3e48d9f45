"""Chains are repeatable, resumable and judged; quantities are carried with their Monte Carlo error."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from support.small_posterior import ROUNDING, SEED, mapped_already, small_fit
from support.waits import check_forward, doings

from tvsbayes.errors import InputError, NotConverged
from tvsbayes.inference.diagnosis import diagnose
from tvsbayes.posterior.chain import stored_chain
from tvsbayes.posterior.sampling import DRAWING, sample, walking
from tvsbayes.posterior.target import Target, importance_run
from tvsbayes.results.tiers import CHAIN

LONG, SHORT, BLOCK = 96, 12, 6
INTERRUPTED_CALL = 14
"""Of the density: after the rounds of importance sampling and some steps."""


def limits(patch: pytest.MonkeyPatch, steps: int) -> None:
    """Stop after so many steps, whatever they are worth."""
    anything = {"RHAT_LIMIT": np.inf, "ESS_LIMIT": 0, "TAU_LIMIT": 0, "AGREEMENT_LIMIT": np.inf}
    for name, value in {**anything, "STUCK_ACCEPTANCE": 0.0, "STUCK_DEVIATION": np.inf}.items():
        patch.setattr(f"tvsbayes.inference.diagnosis.{name}", value)
    for name, value in {"BLOCK": BLOCK, "FIRST_CHECK": steps}.items():
        patch.setattr(f"tvsbayes.inference.ensemble.{name}", value)
    for name in ("MEAN_ERROR_MAX", "END_ERROR_MAX"):
        patch.setattr(f"tvsbayes.inference.importance.{name}", np.inf)
    quickly(patch)


def quickly(patch: pytest.MonkeyPatch) -> None:
    """Three small rounds are enough for a start."""
    mapped_already(patch)
    patch.setattr("tvsbayes.inference.importance.ROUND", 512)
    patch.setattr("tvsbayes.inference.importance.ROUNDS_LEAST", 1)
    patch.setattr("tvsbayes.posterior.sampling.importance_run", partial(importance_run, rounds_max=3))


def only_when_long(patch: pytest.MonkeyPatch) -> None:
    """`sample` looks at a resumed chain at once, and under `limits` any chain has converged."""
    judge = diagnose

    def strict(start, chain, tier):
        result = judge(start, chain, tier)
        missing = () if len(chain.w) >= SHORT else ("too short",)
        return replace(result, convergence=replace(result.convergence, missing=missing))

    patch.setattr("tvsbayes.inference.ensemble.diagnose", strict)


@pytest.fixture(scope="module")
def fitted():
    return small_fit()[0]


@pytest.fixture(scope="module")
def long(fitted, tmp_path_factory):
    """(posterior, its checkpoint as stored)."""
    file = tmp_path_factory.mktemp("chain") / "long.npz"
    with pytest.MonkeyPatch.context() as patch:
        limits(patch, LONG)
        result = sample(fitted, CHAIN, seed=SEED, checkpoint=file)
    return result, file


def stored(file):
    with np.load(file) as chain:
        return {key: chain[key] for key in chain.files}


@pytest.mark.thorough
def test_a_seed_gives_one_chain_also_when_interrupted(fitted, long, tmp_path, monkeypatch):
    limits(monkeypatch, SHORT)
    whole_wait, stages = [], []
    unbroken = sample(fitted, CHAIN, seed=SEED, checkpoint=tmp_path / "unbroken.npz", progress=whole_wait.append)
    assert unbroken.convergence.steps == SHORT
    check_forward(whole_wait)
    assert doings(whole_wait) == [DRAWING, walking(CHAIN)] and len(whole_wait) > SHORT // BLOCK

    def interrupt(state):
        stages.append(state.doing)
        # Reported once when the chain begins, then after every block.
        if stages.count(walking(CHAIN)) == 2:
            raise KeyboardInterrupt

    broken = tmp_path / "broken.npz"
    with pytest.raises(KeyboardInterrupt):
        sample(fitted, CHAIN, seed=SEED, checkpoint=broken, progress=interrupt)
    assert len(stored(broken)["w"]) == BLOCK
    only_when_long(monkeypatch)
    resumed = sample(fitted, CHAIN, seed=SEED, checkpoint=broken, resume=True)
    np.testing.assert_array_equal(resumed.z, unbroken.z)
    np.testing.assert_array_equal(resumed.log_density, unbroken.log_density)
    # What importance sampling found is restored, not drawn again, and compared with again.
    assert resumed.convergence.importance == unbroken.convergence.importance
    assert resumed.convergence.agreement == unbroken.convergence.agreement
    whole, parts, longer = stored(tmp_path / "unbroken.npz"), stored(broken), stored(long[1])
    for key in ("w", "log_density", "accepted", "random_keys", "random_rest"):
        np.testing.assert_array_equal(parts[key], whole[key])
    for key in ("w", "log_density"):
        np.testing.assert_array_equal(whole[key], longer[key][:SHORT])


@pytest.mark.thorough
def test_ctrl_c_in_the_middle_of_a_step_is_quiet_and_loses_no_step(fitted, tmp_path, monkeypatch, capfd):
    limits(monkeypatch, SHORT)
    unbroken = sample(fitted, CHAIN, seed=SEED)
    whole, calls = Target.__call__, []

    def interrupted(target, w):
        calls.append(len(w))
        if len(calls) == INTERRUPTED_CALL:
            raise KeyboardInterrupt
        return whole(target, w)

    broken = tmp_path / "broken.npz"
    with monkeypatch.context() as patch:
        patch.setattr(Target, "__call__", interrupted)
        with pytest.raises(KeyboardInterrupt):
            sample(fitted, CHAIN, seed=SEED, checkpoint=broken)
    assert 0 < len(stored(broken)["w"]) < SHORT
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""
    only_when_long(monkeypatch)
    resumed = sample(fitted, CHAIN, seed=SEED, checkpoint=broken, resume=True)
    np.testing.assert_array_equal(resumed.z, unbroken.z)


def test_resume_refuses_what_is_no_chain(fitted, long, tmp_path):
    file = tmp_path / "chain.npz"
    with pytest.raises(InputError) as caught:
        sample(fitted, CHAIN, seed=SEED, checkpoint=file, resume=True)
    assert caught.value.code == "no-chain"
    whole = long[1].read_bytes()
    for size in (0, 100, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:size])
        with pytest.raises(InputError) as caught:
            sample(fitted, CHAIN, seed=SEED, checkpoint=file, resume=True)
        assert caught.value.code == "damaged-chain", size


def test_resume_refuses_the_chain_of_other_data_priors_or_seed(fitted, long):
    spot = fitted.campaign.spots[0]
    spots = (replace(spot, u_left_px=spot.u_left_px + 1e-6), *fitted.campaign.spots[1:])
    data = replace(fitted, campaign=replace(fitted.campaign, spots=spots))
    with jax.enable_x64(True):
        prior = replace(fitted, space=replace(fitted.space, u=fitted.space.u * 1.01))
    for other, seed in ((data, SEED), (prior, SEED), (fitted, SEED + 1)):
        with pytest.raises(InputError) as caught:
            sample(other, seed=seed, checkpoint=long[1], resume=True)
        assert caught.value.code == "other-chain"


def test_only_a_converged_fit_is_sampled(fitted):
    with pytest.raises(NotConverged, match="no maximum"):
        sample(replace(fitted, converged=False, problems=("no maximum",)))


@pytest.mark.thorough
def test_what_is_missing_when_the_time_is_over_is_reported(fitted, monkeypatch):
    monkeypatch.setattr("tvsbayes.inference.ensemble.BLOCK", BLOCK)
    quickly(monkeypatch)
    # What weighted draws say is then no answer either: it would be given instead.
    for limit in ("K_MAX", "ROUGH_K_MAX"):
        monkeypatch.setattr(f"tvsbayes.inference.importance.{limit}", -1.0)
    result = sample(fitted, max_minutes=1e-9, seed=SEED)
    assert result.convergence.answer != "accepted" and result.convergence.steps == BLOCK
    missing = "; ".join(result.convergence.missing)
    for word in ("R-hat", "autocorrelation times"):
        assert word in missing


@pytest.mark.thorough
def test_a_chain_of_another_tier_is_not_resumed(fitted, long):
    with pytest.raises(InputError, match="sampled from other data"):
        stored_chain(long[1], fitted, SEED, "other")


def test_a_linear_function_is_propagated(long):
    draws = long[0].by_name
    result = long[0].propagate(lambda p: 200 * p["degrees_per_step.left"] - p["backlash_deg.pan"])
    values = 200 * draws["degrees_per_step.left"] - draws["backlash_deg.pan"]
    np.testing.assert_allclose(result.mean, values.mean(), rtol=len(values) * ROUNDING)
    np.testing.assert_allclose(result.sd, values.std(), rtol=len(values) * ROUNDING)
    np.testing.assert_array_equal(result.interval95, np.quantile(values, (0.025, 0.975)))
    # Bulk effective draws are those of ranks, the error of the mean goes by values: equal for a normal.
    assert result.mcse_mean == pytest.approx(result.sd / np.sqrt(result.ess), rel=0.2)


def test_functions_of_another_shape_or_without_value_are_refused(long):
    with pytest.raises(ValueError, match="first axis"):
        long[0].propagate(lambda p: p["degrees_per_step.left"].mean())
    with pytest.raises(ValueError, match="first axis"):
        long[0].propagate(lambda p: p["degrees_per_step.left"][1:])
    with pytest.raises(ValueError, match="no finite value"):
        long[0].propagate(lambda p: np.full_like(p["degrees_per_step.left"], np.nan))

"""Importance sampling: pooled weights, moments and evidence that are known, and weights that must not be used."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.special import gamma
from support.small_posterior import SIGMAS, small_fit, small_path
from support.tabulated import no_followers
from support.two_parameters import no_places
from support.varying_gears import perfect_gears

from tvsbayes.errors import NotConverged
from tvsbayes.estimators.campaign_arrays import spot_constants
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.parameters import BLOCKS, Prior
from tvsbayes.posterior import importance
from tvsbayes.posterior.importance import Pool, Weighing, empty_pool, importance_run, lacking
from tvsbayes.posterior.proposal import Independence, Target, Valued
from tvsbayes.posterior.sampling import sample
from tvsbayes.posterior.tables import Tables
from tvsbayes.posterior.transport import Mapped
from tvsbayes.statistics.weighted_draws import smoothed_weights, weighted_summary

SEED = 3


def normal(mean: float, sd: float, dimension: int) -> Independence:
    """Without tabulated or coupled coordinates."""
    nothing, tables = np.zeros(0, int), Tables(np.zeros((0, 41)))
    straight = np.zeros(dimension), np.eye(dimension)
    mean, sd = np.full(dimension, mean), np.full(dimension, sd)
    return Independence(mean, sd, nothing, tables, nothing, no_followers(), *straight)


class Skewed:
    """A target of mass e^1.7: Gumbel's density in the first coordinate, whom the second follows, the rest normal."""

    path = SimpleNamespace(mode=np.zeros(5), dimension=5, heavy=np.arange(5) == 0, coupled=np.arange(5) >= 3, pairs=())
    fit = SimpleNamespace(arrays=no_places())
    invalid = 0

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Log density of w (n, 5)."""
        first = stats.gumbel_r.logpdf(w[:, 0])
        second = stats.norm.logpdf(w[:, 1], 0.3 * w[:, 0], np.exp(0.05 * w[:, 0]))
        return first + second + stats.norm.logpdf(w[:, 2:], 0.2, 1.1).sum(axis=1) + 1.7

    def valued(self, w: np.ndarray, normal: np.ndarray) -> Valued:
        """With errors at no places."""
        return Valued(self(w), normal, Mapped(w, np.zeros(len(w))))


def skewed_pool(rounds: int = 5) -> Pool:
    target, generator = Skewed(), np.random.RandomState(SEED)
    pool = empty_pool(target)
    for number in range(rounds):
        pool = pool.extended(target, generator, fitted=number < 3)
    return pool


def test_weights_are_the_target_over_the_mixture_of_all_proposals():
    """By hand, for two proposals of other numbers of draws; by each draw's own proposal alone they are others."""
    one, other = normal(0.0, 1.0, 2), normal(0.8, 1.5, 2)
    w = np.random.default_rng(1).standard_normal((6, 2))
    pool = Pool(w, np.arange(6.0), np.zeros((6, 0)), Mapped(w, np.zeros(6)), (one, other), (2, 4), other)
    densities = np.exp([q.log_density(w) for q in (one, other)])
    expected = np.exp(np.arange(6.0)) / (densities[0] * 2 / 6 + densities[1] * 4 / 6)
    np.testing.assert_allclose(np.exp(pool.log_weights), expected, rtol=1e-12)
    own = np.exp(np.arange(6.0)) / np.where(np.arange(6) < 2, *densities)
    assert np.abs(np.log(own / expected)).max() > 0.1


def test_moments_ends_and_mass_of_a_skewed_target():
    pool = skewed_pool()
    found = weighted_summary(pool.w, smoothed_weights(pool.log_weights).weights)
    first = stats.gumbel_r
    exact_mean = [first.mean(), 0.3 * first.mean(), 0.2, 0.2, 0.2]
    # E exp(0.1 w) of Gumbel's is the gamma function at 0.9.
    second = 0.09 * first.var() + gamma(0.9)
    exact_sd = [first.std(), np.sqrt(second), 1.1, 1.1, 1.1]
    np.testing.assert_array_less(np.abs(found.mean - exact_mean), SIGMAS * found.mcse_mean)
    np.testing.assert_array_less(np.abs(found.sd - exact_sd), SIGMAS * found.mcse_sd)
    ends = first.ppf([0.025, 0.975])
    np.testing.assert_array_less(np.abs(found.interval95[:, 0] - ends), SIGMAS * found.mcse_interval95[:, 0])
    assert found.mcse_mean.max() < 0.04 and found.mcse_interval95[:, 0].max() < 0.2, "no error would be seen"
    weights = np.exp(pool.log_weights)
    assert np.log(weights.mean()) == pytest.approx(
        1.7, abs=SIGMAS * weights.std() / weights.mean() / np.sqrt(len(weights))
    )
    # The proposal that the rounds arrived at follows the target: most of its draws count.
    assert weights.sum() ** 2 / np.sum(weights**2) > 0.7 * len(weights)


@pytest.fixture(params=[True, False], ids=["whole", "table"])
def normal_fit(request, monkeypatch):
    """The small fit, its map without bends, and a density in z that is exactly the Laplace approximation's."""
    fitted, path = small_fit()[0], small_path(request.param).straight()
    free = np.flatnonzero(fitted.free)
    precision = np.linalg.inv(fitted.covariance[np.ix_(free, free)])

    def evaluate(z, normal, space, arrays):
        away = np.asarray(z)[:, free] - fitted.z[free]
        value = fitted.log_density - 0.5 * np.sum(away @ precision * away, axis=1)
        return SimpleNamespace(log_density=value, place_errors_rad=normal)

    monkeypatch.setattr("tvsbayes.posterior.proposal.evaluate", evaluate)
    return fitted, path


def test_the_evidence_of_a_normal_posterior_is_laplaces(normal_fit):
    """L + ln |C| / 2 + constants: the normal integral over the coordinates against their normal priors."""
    fitted, path = normal_fit
    target, generator = Target(fitted, path), np.random.RandomState(SEED)
    pool = empty_pool(target)
    for number in range(4):
        pool = pool.extended(target, generator, fitted=number < 3)
    found = Weighing(fitted, path, pool).importance
    free = np.flatnonzero(fitted.free)
    log_volume = 0.5 * np.linalg.slogdet(fitted.covariance[np.ix_(free, free)])[1]
    expected = fitted.log_density + log_volume + spot_constants(fitted.campaign).sum()
    assert found.log_evidence_mcse < 0.05, "no error would be seen"
    assert found.log_evidence == pytest.approx(expected, abs=SIGMAS * found.log_evidence_mcse)


@pytest.fixture(scope="module")
def sampled():
    """(fit, its run) with the map of the shared fit."""
    fitted, path = small_fit()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importance, "transport", lambda fit: path)
        return fitted, importance_run(fitted, SEED)


def test_a_campaign_is_sampled_in_few_rounds_and_accepted(sampled):
    fitted, run = sampled
    found = run.posterior.convergence.importance
    assert found.accepted and found.missing == () and run.posterior.tier == "importance"
    assert found.least_ess.value >= importance.ESS_WANTED and found.draws == importance.ROUND * found.rounds
    assert found.effective_share > 0.5 and found.pareto_k < 0.6 and found.heaviest_share < 0.01
    weights = run.posterior.weights
    assert weights.shape == run.posterior.z.shape[:2] == (1, found.draws)
    assert weights.sum() == pytest.approx(1.0, rel=1e-12)
    # The stored density is that of the stored draws.
    z = run.posterior.z[0, :64]
    again = (
        Target(fitted, run.path)(run.path.to_w(z)) + fitted.log_density - run.path.mapped(run.path.to_w(z)).log_jacobian
    )
    np.testing.assert_allclose(run.posterior.log_density[0, :64], again, atol=1e-6)


def test_the_same_seed_gives_the_same_draws(sampled, monkeypatch):
    fitted, run = sampled
    monkeypatch.setattr(importance, "transport", lambda fit: run.path)
    again = sample(fitted, "importance", seed=SEED)
    np.testing.assert_array_equal(again.z, run.posterior.z)
    np.testing.assert_array_equal(again.weights, run.posterior.weights)
    assert again.convergence == run.posterior.convergence


def test_draws_of_the_same_weight_say_what_weighted_ones_say(sampled):
    """Moments of 4000 resampled draws, and of the walkers' starts without replacement."""
    posterior = sampled[1].posterior
    known = posterior.propagate(lambda p: p["backlash_deg.pan"])
    equal = posterior.resampled(4, 1000)
    assert equal.z.shape[:2] == (4, 1000) and np.ptp(equal.weights) == 0
    values = equal.by_name["backlash_deg.pan"]
    # Systematic resampling adds less than a multinomial's scatter to the error there was.
    allowed = SIGMAS * np.hypot(known.mcse_mean, known.sd / np.sqrt(4000))
    assert abs(values.mean() - known.mean) < allowed
    thinned = posterior.thinned(1000)
    chosen = posterior.by_name["backlash_deg.pan"][posterior.chosen(1000)]
    from tvsbayes.instrument.parameters import INDEX

    np.testing.assert_array_equal(np.asarray(thinned.physical)[:, INDEX["backlash_deg.pan"]], chosen)
    np.testing.assert_array_equal(posterior.coordinates(1000), posterior.z[0, posterior.chosen(1000)])
    starts = sampled[1].starts(64)
    assert len(np.unique(starts, axis=0)) == 64


def test_a_proposal_made_too_narrow_is_not_accepted(sampled, monkeypatch):
    fitted, run = sampled
    monkeypatch.setattr(importance, "transport", lambda fit: run.path)
    monkeypatch.setattr(importance, "ROUNDS_MAX", 4)
    for name, value in {"INFLATION": 0.6, "HEAVY_SHARE": 1e-12, "COUPLED_SHARE": 1e-12}.items():
        monkeypatch.setattr(f"tvsbayes.posterior.proposal.{name}", value)
    posterior = sample(fitted, "importance", seed=SEED)
    found = posterior.convergence.importance
    assert not posterior.converged and not found.accepted and found.rounds == 4
    assert found.pareto_k > importance.K_LIMIT
    said = "; ".join(posterior.convergence.missing)
    assert f"Pareto k {found.pareto_k:.2f}, wanted below 0.7" in said


def test_every_limit_is_said(sampled):
    sound = sampled[1].posterior.convergence.importance
    assert lacking(sound) == ()
    few = replace(sound.least_ess, quantity="backlash_deg.tilt", value=importance.ESS_LIMIT - 0.6)
    for changed, words in (
        ({"pareto_k": 0.71}, "the weights of importance sampling have Pareto k 0.71, wanted below 0.7"),
        (
            {"worst_pareto_k": replace(few, value=0.9)},
            "those of backlash_deg.tilt have Pareto k 0.90, wanted below 0.7",
        ),
        ({"heaviest_share": 0.031}, "one draw holds 3.1 % of the weight, wanted at most 2 %"),
        (
            {"least_ess": few},
            f"backlash_deg.tilt has {importance.ESS_LIMIT - 1} effective draws, wanted {importance.ESS_LIMIT}",
        ),
        ({"pareto_k": np.nan}, "Pareto k nan"),
    ):
        (sentence,) = lacking(replace(sound, **changed))
        assert words in sentence


def test_a_density_without_values_is_refused(sampled, monkeypatch):
    fitted, run = sampled
    monkeypatch.setattr(importance, "transport", lambda fit: run.path)

    def valued(target, w, normal):
        return Valued(np.where(np.abs(w).max(axis=1) > 0, -np.inf, 0.0), normal, target.path.mapped(w))

    monkeypatch.setattr(Target, "valued", valued)
    with pytest.raises(NotConverged, match="not finite"):
        importance_run(fitted, SEED)


def test_no_chain_is_kept_or_resumed_without_one(sampled, tmp_path):
    for options in ({"checkpoint": tmp_path / "chain.npz"}, {"resume": True}):
        with pytest.raises(ValueError, match=r"chain|checkpoint"):
            sample(sampled[0], "importance", **options)
    with pytest.raises(ValueError, match="allowed: importance, emcee"):
        sample(sampled[0], "nested")


def test_the_paper_twin_against_nuts(paper_fit):
    """The reference of `experiments/sampler/nuts_reference.py`, of perfect gears, which shares no sampling code."""
    campaign = paper_fit.campaign
    # Errors of a nanodegree are none, and need no functions of other shapes than gears that err.
    table = perfect_gears(campaign.rig)
    nearly = dict.fromkeys(BLOCKS["transmission_error_deg"], Prior(1e-9, 0.0, "half-normal"))
    perfect = fit(replace(campaign, rig=replace(table, priors={**table.priors, **nearly})))
    reference = json.loads((shipped_data() / "reference" / "posterior_paper.json").read_text())["quantities"]
    posterior = sample(perfect, "importance")
    assert posterior.converged
    columns = posterior.by_name
    found = posterior.summarised(np.stack([columns[name] for name in reference], axis=-1)[None])
    there = {key: np.array([row[key] for row in reference.values()]) for key in ("mean", "sd", "sd_mcse")}
    # Both know a mean to some 0.02 sd, an sd to 2 %; of 61 quantities one may lie three of these out.
    np.testing.assert_array_less(np.abs(found.mean - there["mean"]), 0.1 * there["sd"])
    np.testing.assert_array_less(np.abs(found.sd / there["sd"] - 1), 0.06)
    # All together they scatter as their errors say.
    z = (found.sd - there["sd"]) / np.hypot(found.mcse_sd, there["sd_mcse"])
    assert np.mean(z**2) < 2.0

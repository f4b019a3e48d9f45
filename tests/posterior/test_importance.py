"""Importance sampling: pooled weights, moments and evidence that are known, and weights that must not be used."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.special import gamma
from support.small_posterior import SEED, SIGMAS, mapped_already, small_fit, small_run
from support.tabulated import no_followers
from support.varying_gears import perfect_gears

from tvsbayes.assessment.summary import summarise
from tvsbayes.errors import NotConverged
from tvsbayes.estimators.campaign_arrays import spot_constants
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.files.disk import shipped_data
from tvsbayes.inference import importance
from tvsbayes.inference.density import Points
from tvsbayes.inference.importance import Acceptance, Pool, k_max, uncertain
from tvsbayes.inference.proposal import Independence, first_proposal
from tvsbayes.inference.tables import Tables
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import BLOCKS, Prior
from tvsbayes.pipeline import unusable
from tvsbayes.posterior.draws import Posterior, headline_names
from tvsbayes.posterior.sampling import sample
from tvsbayes.posterior.target import Target, importance_run
from tvsbayes.results.convergence import MonteCarloError
from tvsbayes.statistics.weighted_draws import smoothed_weights, weighted_summary


def normal(mean: float, sd: float, dimension: int) -> Independence:
    """Without tabulated or coupled coordinates."""
    nothing, tables = np.zeros(0, int), Tables(np.zeros((0, 41)))
    straight = np.zeros(dimension), np.eye(dimension)
    mean, sd = np.full(dimension, mean), np.full(dimension, sd)
    return Independence(mean, sd, nothing, tables, nothing, no_followers(), *straight)


class Skewed:
    """A target of mass e^1.7: Gumbel's density in the first coordinate, whom the second follows, the rest normal."""

    invalid = 0

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Log density of w (n, 5)."""
        first = stats.gumbel_r.logpdf(w[:, 0])
        second = stats.norm.logpdf(w[:, 1], 0.3 * w[:, 0], np.exp(0.05 * w[:, 0]))
        return first + second + stats.norm.logpdf(w[:, 2:], 0.2, 1.1).sum(axis=1) + 1.7

    def valued(self, w: np.ndarray, generator: np.random.Generator) -> Points:
        """Nothing was integrated out."""
        return Points(w, self(w), {})

    def first_proposal(self) -> Independence:
        """With one tabulated coordinate and two that are coupled."""
        return first_proposal(self, 5, np.arange(5) == 0, np.arange(5) >= 3)


def in_rounds(pool: Pool, generator: np.random.RandomState, rounds: int) -> Pool:
    """After the first three of which the proposal is fitted to all."""
    for number in range(rounds):
        pool = pool.extended(generator)
        pool = replace(pool, next_proposal=pool.proposal) if number < 3 else pool
    return pool


def skewed_pool(rounds: int = 5) -> Pool:
    target, generator = Skewed(), np.random.RandomState(SEED)
    return in_rounds(Pool(target, SEED, target.first_proposal(), 0.0), generator, rounds)


def test_weights_are_the_target_over_the_mixture_of_all_proposals():
    """By hand, for two proposals of other numbers of draws; by each draw's own proposal alone they are others."""
    one, other = normal(0.0, 1.0, 2), normal(0.8, 1.5, 2)
    w = np.random.default_rng(1).standard_normal((6, 2))
    pool = Pool(Skewed(), SEED, other, 0.0, Points(w, np.arange(6.0), {}), (one, other), (2, 4))
    densities = np.exp([q.log_density(w) for q in (one, other)])
    expected = np.exp(np.arange(6.0)) / (densities[0] * 2 / 6 + densities[1] * 4 / 6)
    np.testing.assert_allclose(np.exp(pool.log_weights), expected, rtol=1e-12)
    weights = np.exp(np.arange(6.0)) / np.where(np.arange(6) < 2, *densities)
    assert np.abs(np.log(weights / expected)).max() > 0.1


def test_moments_ends_and_mass_of_a_skewed_target():
    pool = skewed_pool()
    summary = weighted_summary(pool.drawn.w, smoothed_weights(pool.log_weights).weights)
    first = stats.gumbel_r
    exact_mean = [first.mean(), 0.3 * first.mean(), 0.2, 0.2, 0.2]
    # E exp(0.1 w) of Gumbel's is the gamma function at 0.9.
    second = 0.09 * first.var() + gamma(0.9)
    exact_sd = [first.std(), np.sqrt(second), 1.1, 1.1, 1.1]
    np.testing.assert_array_less(np.abs(summary.mean - exact_mean), SIGMAS * summary.mcse_mean)
    np.testing.assert_array_less(np.abs(summary.sd - exact_sd), SIGMAS * summary.mcse_sd)
    ends = first.ppf([0.025, 0.975])
    np.testing.assert_array_less(np.abs(summary.interval95[:, 0] - ends), SIGMAS * summary.mcse_interval95[:, 0])
    assert summary.mcse_mean.max() < 0.04 and summary.mcse_interval95[:, 0].max() < 0.2, "no error would be seen"
    weights = np.exp(pool.log_weights)
    assert np.log(weights.mean()) == pytest.approx(
        1.7, abs=SIGMAS * weights.std() / weights.mean() / np.sqrt(len(weights))
    )
    # The proposal that the rounds arrived at follows the target: most of its draws count.
    assert weights.sum() ** 2 / np.sum(weights**2) > 0.7 * len(weights)


@pytest.fixture
def normal_fit(monkeypatch):
    """The small fit, a map that is the same at all noise scales, and a density that is the Laplace approximation's."""
    fitted, path = small_fit()
    straight = replace(path, narrow=0, bend=path.bend[:, :0, :0], slope=0 * path.slope, half=np.zeros_like(path.half))
    free = np.flatnonzero(fitted.free)
    precision = np.linalg.inv(fitted.covariance[np.ix_(free, free)])

    def evaluate(z, normal, space, arrays):
        away = np.asarray(z)[:, free] - fitted.z[free]
        value = fitted.log_density - 0.5 * np.sum(away @ precision * away, axis=1)
        return SimpleNamespace(log_density=value, place_errors_rad=normal)

    monkeypatch.setattr("tvsbayes.posterior.target.evaluate", evaluate)
    return fitted, straight


def test_the_evidence_of_a_normal_posterior_is_laplaces(normal_fit):
    """L + ln |C| / 2 + constants: the normal integral over the coordinates against their normal priors."""
    fitted, path = normal_fit
    target, generator = Target(fitted, path), np.random.RandomState(SEED)
    judged = in_rounds(Pool(target, SEED, target.first_proposal(), 0.0), generator, 4).importance
    free = np.flatnonzero(fitted.free)
    log_volume = 0.5 * np.linalg.slogdet(fitted.covariance[np.ix_(free, free)])[1]
    expected = fitted.log_density + log_volume + spot_constants(fitted.campaign).sum()
    assert judged.log_evidence_mcse < 0.05, "no error would be seen"
    assert judged.log_evidence == pytest.approx(expected, abs=SIGMAS * judged.log_evidence_mcse)


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    """Of the shared run."""
    return small_run().density.posterior(small_run().sample, SEED)


@pytest.fixture
def fitted(monkeypatch) -> JointFit:
    """The shared fit."""
    mapped_already(monkeypatch)
    return small_fit()[0]


@pytest.fixture
def proposed(monkeypatch) -> None:
    """The first proposal is that of the shared run: it is not looked for again."""
    monkeypatch.setattr(Target, "first_proposal", lambda target: small_run().proposals[0])


def test_a_campaign_is_sampled_in_few_rounds_and_accepted(fitted, posterior):
    judged = posterior.convergence.importance
    assert judged.accepted and judged.missing == () and posterior.tier == "importance"
    every = posterior.convergence.monte_carlo_error
    assert set(every) == set(headline_names(fitted)) and all(error.within(0.1, 0.2) for error in every.values())
    assert judged.draws == importance.ROUND * judged.rounds and judged.rounds <= 2 * importance.ROUNDS_LEAST
    assert judged.effective_share > 0.3 and judged.pareto_k < 0.6 and judged.heaviest_share < 0.01
    weights = posterior.weights
    assert weights.shape == posterior.z.shape[:2] == (1, judged.draws)
    assert weights.sum() == pytest.approx(1.0, rel=1e-12)
    # The stored density is that of the stored draws.
    path, z = small_run().density.path, posterior.z[0, :64]
    w = path.to_w(z)
    again = Target(fitted, path)(w) + fitted.log_density - path.mapped(w).log_jacobian
    np.testing.assert_allclose(posterior.log_density[0, :64], again, atol=1e-6)


@pytest.mark.usefixtures("proposed")
def test_the_same_seed_gives_the_same_draws(fitted, monkeypatch):
    monkeypatch.setattr(importance, "ROUND", 512)
    one, again = (importance_run(fitted, SEED, rounds_max=2) for _ in range(2))
    np.testing.assert_array_equal(again.sample.points.w, one.sample.points.w)
    np.testing.assert_array_equal(again.sample.weights, one.sample.weights)
    assert again.sample.convergence == one.sample.convergence


def test_draws_of_the_same_weight_say_what_weighted_ones_say(posterior):
    """Moments of 4000 resampled draws, and of the walkers' starts without replacement."""
    known = posterior.propagate(lambda p: p["backlash_deg.pan"])
    equal = posterior.resampled(4, 1000)
    assert equal.z.shape[:2] == (4, 1000) and np.ptp(equal.weights) == 0
    values = equal.by_name["backlash_deg.pan"]
    # Systematic resampling adds less than a multinomial's scatter to the error there was.
    allowed = SIGMAS * np.hypot(known.mcse_mean, known.sd / np.sqrt(4000))
    assert abs(values.mean() - known.mean) < allowed
    thinned = posterior.thinned(1000)
    chosen = posterior.by_name["backlash_deg.pan"][posterior.chosen(1000)]
    np.testing.assert_array_equal(np.asarray(thinned.physical)[:, TWO_MIRROR.index["backlash_deg.pan"]], chosen)
    np.testing.assert_array_equal(posterior.coordinates(1000), posterior.z[0, posterior.chosen(1000)])
    starts = small_run().starts(64)
    assert len(np.unique(starts, axis=0)) == 64


def narrowed(proposal: Independence, factor: float) -> Independence:
    """Of narrower normal coordinates."""
    plain = ~np.isin(np.arange(len(proposal.sd)), proposal.places)
    return replace(proposal, sd=np.where(plain, factor, 1.0) * proposal.sd)


@pytest.fixture
def too_narrow(fitted, monkeypatch):
    """Without heavy tails and with a first proposal of half the width."""
    for name in ("HEAVY_SHARE", "COUPLED_SHARE"):
        monkeypatch.setattr(f"tvsbayes.inference.proposal.{name}", 1e-12)
    first = small_run().density.first_proposal()
    monkeypatch.setattr(Target, "first_proposal", lambda target: narrowed(first, 0.5))
    return fitted


@pytest.fixture
def begun(monkeypatch) -> list[Independence]:
    """The proposals that pools are begun with anew."""
    proposals, refitted = [], Pool.refitted.fget

    def recorded(pool):
        fresh = refitted(pool)
        proposals.append(fresh.next_proposal)
        return fresh

    monkeypatch.setattr(Pool, "refitted", property(recorded))
    return proposals


@pytest.mark.thorough
def test_a_proposal_that_is_too_narrow_is_fitted_again(too_narrow, posterior, begun):
    """Its draws adapt the next one; they take no part in the answer, which is that of the right proposal."""
    run = importance_run(too_narrow, SEED)
    again = run.density.posterior(run.sample, SEED)
    judged, other = again.convergence, posterior.convergence
    assert judged.answer == "accepted" and judged.missing == ()
    # After the narrowed one come refitted proposals.
    assert begun and run.proposals == (begun[-1],)
    assert run.counts == (judged.importance.draws,), "draws of the narrow proposal are in the answer"
    # Fitted to draws of a bad proposal it is worth less than a good one, but no tenth of it.
    assert judged.importance.effective_share > 0.1 * other.importance.effective_share
    name = other.importance.least_ess.quantity
    one, two = (each.propagate(lambda p: p[name]) for each in (again, posterior))
    assert abs(one.mean - two.mean) < SIGMAS * np.hypot(one.mcse_mean, two.mcse_mean)


@pytest.mark.usefixtures("proposed")
def test_a_heavy_tail_is_answered_by_another_proposal(fitted, begun, monkeypatch):
    """More draws hardly change its index. With a limit that no weights meet: 3 rounds and 3 more, then 6 and 6."""
    monkeypatch.setattr(importance, "K_MAX", -1.0)
    monkeypatch.setattr(importance, "ROUND", 256)
    again = importance_run(fitted, SEED, rounds_max=6 + 12)
    assert again.proposals == (begun[-1],) and again.counts == (12 * 256,)
    assert again.sample.convergence.answer != "accepted"


@pytest.mark.thorough
def test_a_budget_that_is_used_up_leaves_a_worse_answer(too_narrow):
    """Rounds of the narrow proposal: none is left for another."""
    run = importance_run(too_narrow, SEED, rounds_max=importance.ROUNDS_LEAST)
    posterior, judged = run.density.posterior(run.sample, SEED), run.sample.convergence.importance
    assert judged.rounds == importance.ROUNDS_LEAST and judged.answer == "laplace" and not posterior.converged
    assert judged.pareto_k > importance.K_MAX
    missing = "; ".join(posterior.convergence.missing)
    assert f"Pareto k {judged.pareto_k:.2f}, wanted below 0.70" in missing
    # The result is stated to be Laplace's, with what is missing; commands end with 0.
    summary = summarise(too_narrow, posterior)
    assert (summary.estimator, summary.answer, summary.converged) == ("laplace", "laplace", False)
    assert summary.explained and unusable(summary) is None
    assert summary.problems == tuple(f"LAPLACE: {sentence}" for sentence in posterior.convergence.missing)


@pytest.mark.thorough
def test_few_draws_of_a_good_proposal_are_a_rough_answer(fitted, monkeypatch):
    """Weights are sound and the mean is known to a tenth of an sd or two; the posterior's numbers are given."""
    monkeypatch.setattr(importance, "ROUNDS_LEAST", 1)
    monkeypatch.setattr(importance, "ROUND", 512)
    run = importance_run(fitted, SEED, rounds_max=1)
    posterior = run.density.posterior(run.sample, SEED)
    judged = posterior.convergence
    assert (judged.importance.draws, judged.answer, posterior.converged) == (512, "rough", True), judged.missing
    assert all(error.within(0.3, 0.6) for error in judged.monte_carlo_error.values())
    summary = summarise(fitted, posterior)
    assert (summary.estimator, summary.answer, summary.converged) == ("posterior", "rough", True)
    assert summary.monte_carlo_error == judged.monte_carlo_error and summary.problems[0].startswith("ROUGH: ")
    assert unusable(summary) is None


def errors(mean: float = 0.05, low: float = 0.1, high: float = 0.1) -> dict[str, MonteCarloError]:
    """Of two headlines, the second better known."""
    return {"backlash_deg.tilt": MonteCarloError(mean, (low, high)), "other": MonteCarloError(0.01, (0.01, 0.01))}


def test_every_limit_is_reported():
    """Each is crossed alone, from just inside."""
    inside = {"pareto_k": 0.69, "heaviest": 0.05, "draws": 4096, "errors": errors(0.1, 0.2, 0.2)}
    assert Acceptance(**inside).missing == ()
    for changed, words in (
        ({"pareto_k": 0.71}, "the weights of importance sampling have Pareto k 0.71, wanted below 0.70"),
        ({"pareto_k": np.nan}, "Pareto k nan"),
        ({"draws": 1000}, "Pareto k 0.69, wanted below 0.67"),
        ({"heaviest": 0.061}, "one draw holds 6.1 % of the weight, wanted at most 5 %"),
        ({"errors": errors(mean=0.13)}, "backlash_deg.tilt: 0.13 sd of its mean, 0.10 sd of its interval's ends"),
        ({"errors": errors(low=0.25)}, "0.25 sd of its interval's ends, wanted at most 0.1 and 0.2"),
        ({"errors": errors(high=np.nan)}, "backlash_deg.tilt"),
    ):
        (sentence,) = Acceptance(**{**inside, **changed}).missing
        assert words in sentence
    assert uncertain(errors()) == ()


def test_the_tail_index_that_draws_can_bear_grows_with_their_number():
    """Vehtari et al. (2024), 3.2: 1 - 1 / log10 S, at most 0.7."""
    assert k_max(100) == pytest.approx(0.5) and k_max(1000) == pytest.approx(2 / 3)
    assert k_max(2000) < 0.7 == k_max(2200) == k_max(10**6)


def test_the_draws_that_an_accepted_answer_takes_follow_from_the_worst_error():
    """Errors fall with the root of the number of draws."""
    assert MonteCarloError(0.2, (0.1, 0.2)).rounds_factor == pytest.approx(4.0)
    assert MonteCarloError(0.1, (0.1, 0.6)).rounds_factor == pytest.approx(9.0)
    assert MonteCarloError(0.1, (0.2, 0.2)).within(0.1, 0.2) and not MonteCarloError(0.1, (0.2, 0.21)).within(0.1, 0.2)


def test_a_density_without_values_is_refused(fitted, monkeypatch):
    def valued(target, w, generator):
        return Points(w, np.where(np.abs(w).max(axis=1) > 0, -np.inf, 0.0), {})

    monkeypatch.setattr(Target, "valued", valued)
    with pytest.raises(NotConverged, match="not finite"):
        importance_run(fitted, SEED)


def test_no_chain_is_kept_or_resumed_without_one(fitted, tmp_path):
    for options in ({"checkpoint": tmp_path / "chain.npz"}, {"resume": True}):
        with pytest.raises(ValueError, match=r"chain|checkpoint"):
            sample(fitted, "importance", **options)
    with pytest.raises(ValueError, match="allowed: importance, emcee"):
        sample(fitted, "nested")


@pytest.mark.thorough
def test_the_paper_twin_against_nuts(monkeypatch):
    """The reference of `experiments/sampler/nuts_reference.py`, of perfect gears, which shares no sampling code."""
    campaign = read_campaign(shipped_data() / "twins" / "paper_twin")
    # Errors of a nanodegree are none, and need no functions of other shapes than gears that err.
    table = perfect_gears(campaign.rig)
    nearly = dict.fromkeys(BLOCKS["transmission_error_deg"], Prior(1e-9, 0.0, "half-normal"))
    # The reference has no scatter of looks, and the twin has none.
    nearly |= dict.fromkeys(BLOCKS["look_scatter_deg"], Prior(0.0, 0.0, "half-normal"))
    perfect = fit(replace(campaign, rig=replace(table, priors={**table.priors, **nearly})))
    reference = json.loads((shipped_data() / "reference" / "posterior_paper.json").read_text())["quantities"]
    # Accepted draws determine an sd to 4 %; the reference is more precise.
    monkeypatch.setattr(importance, "ROUNDS_LEAST", 6)
    posterior = sample(perfect, "importance")
    assert posterior.converged
    columns = posterior.by_name
    summary = posterior.summarised(np.stack([columns[name] for name in reference], axis=-1)[None])
    there = {key: np.array([row[key] for row in reference.values()]) for key in ("mean", "sd", "sd_mcse")}
    # Both determine a mean to some 0.02 sd, an sd to 2 %; of 61 quantities one may lie three of these out.
    np.testing.assert_array_less(np.abs(summary.mean - there["mean"]), 0.1 * there["sd"])
    np.testing.assert_array_less(np.abs(summary.sd / there["sd"] - 1), 0.06)
    # All together they scatter as their errors say.
    z = (summary.sd - there["sd"]) / np.hypot(summary.mcse_sd, there["sd_mcse"])
    assert np.mean(z**2) < 2.0

"""Mixture over homing hypotheses: draws shared or of a way's own, and rounds where the error comes from."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from support.small_posterior import SEED, SIGMAS, small_run

from tvsbayes.estimators.joint_fit import Alternative
from tvsbayes.inference.importance import ROUND, Pool
from tvsbayes.posterior import homing_mixture
from tvsbayes.posterior.homing_mixture import Mixture, Way
from tvsbayes.posterior.target import Target


@pytest.fixture(scope="module", autouse=True)
def double():
    """As commands compute."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def first():
    """The draws of the most probable way: those of the shared run, whose homings are recorded."""
    return Way(small_run())


def shared(first: Way, rounds: int = 1) -> Way:
    """Draws reweighted for another way, which has the same density here."""
    target = Target(first.pool.density.fit, first.pool.density.path)
    way = Way(Pool(target, SEED, first.pool.next_proposal, 0.0), (1, 0), shared=True)
    return way.extended(rounds, first.pool)


@pytest.fixture(scope="module")
def second():
    """Two rounds of a way's own draws, by the proposal fitted for the most probable one."""
    run = small_run()
    target = Target(run.density.fit, run.density.path)
    return Way(Pool(target, SEED, run.proposals[-1], 0.0), (1, 0)).extended(2, run)


def test_the_same_density_reweighted_has_the_same_weights(first):
    """Only the errors at places are drawn again; the density of w has them integrated out."""
    again = shared(first, first.pool.rounds)
    np.testing.assert_allclose(again.pool.log_weights, first.pool.log_weights, atol=1e-9)
    assert again.log_evidence == pytest.approx(first.log_evidence, abs=1e-9)


def test_draws_of_its_own_give_the_same_evidence(first, second):
    assert second.pool.rounds == 2 and not second.shared and second.reliable
    error = np.hypot(*(way.pool.importance.log_evidence_mcse for way in (first, second)))
    assert error < 0.05 and second.log_evidence == pytest.approx(first.log_evidence, abs=SIGMAS * error)


def test_a_way_that_shares_all_draws_adds_no_knowledge(first):
    """Two ways of one density are equally probable, and their mixture has the errors of one."""
    mixture = Mixture((first, shared(first, first.pool.rounds)), 0)
    np.testing.assert_allclose(mixture.probabilities, 0.5)
    one = Mixture((first,), 0)
    for name, error in one.errors.items():
        assert mixture.errors[name].mean == pytest.approx(error.mean, rel=1e-9)
    assert mixture.acceptance.missing == one.acceptance.missing == () and mixture.improved() is None


def test_independent_draws_add_their_squared_errors(first, second, monkeypatch):
    """Shares of the error of a mean are those of the variance of a sum; an end's error comes from few draws."""
    monkeypatch.setattr(homing_mixture, "END_ERROR_MAX", 1e9)
    mixture = Mixture((first, second), 0)
    shares = mixture.shares_of_error
    assert shares.sum() == pytest.approx(1) and shares[1] > shares[0], "two rounds are less than three or more"
    column = mixture.headlines.index("backlash_deg.pan")
    each = [Mixture((way,), 0).summary.mcse_mean[column] for way in (first, second)]
    together = np.hypot(*(p * error for p, error in zip(mixture.probabilities, each, strict=True)))
    assert mixture.summary.mcse_mean[column] == pytest.approx(together, rel=0.05)


def test_shares_of_the_error_of_a_mean_do_not_depend_on_its_origin(first, second, monkeypatch):
    monkeypatch.setattr(homing_mixture, "END_ERROR_MAX", 1e9)
    shares = Mixture((first, second), 0).shares_of_error
    moved = tuple(replace(way, pool=replace(way.pool)) for way in (first, second))
    for way, each in zip(moved, (first, second), strict=True):
        way.pool.__dict__["columns"] = {name: 1.0 + x for name, x in each.pool.columns.items()}
    # Rounding of numbers of 1e-4 beside 1.
    np.testing.assert_allclose(Mixture(moved, 0).shares_of_error, shares, rtol=1e-9)
    monkeypatch.undo()
    assert not np.allclose(Mixture((first, second), 0).shares_of_error, shares, rtol=1e-3), "ends weigh draws otherwise"


def with_density(way: Way, **changes) -> Way:
    """Its draws under a fit of which something differs."""
    density = way.pool.density
    return replace(way, pool=replace(way.pool, density=Target(replace(density.fit, **changes), density.path)))


def test_a_way_is_as_probable_as_firmware_homes_that_way(first):
    """Of equal evidence: always from one side 0.45, from anywhere 0.1 (formulation 3.1)."""
    ways = (with_density(first, sides={"pan": side}) for side in ("left", "anywhere"))
    np.testing.assert_allclose(Mixture(tuple(ways), 0).probabilities, [0.45 / 0.55, 0.1 / 0.55])


def few(way: Way) -> Way:
    """The first 128 draws alone."""
    return replace(way, pool=replace(way.pool, drawn=way.pool.drawn.taken(slice(0, 128)), counts=(128,)))


def test_rounds_go_to_the_way_that_the_error_comes_from(first, second, monkeypatch):
    """Of an equally probable way there are a few draws only: it is extended, as far as rounds are left."""
    mixture = Mixture((first, few(second)), 5)
    assert mixture.acceptance.missing and mixture.shares_of_error[1] > 0.9
    monkeypatch.setattr(Way, "reliable", True)
    better = mixture.improved()
    assert better is not None and better.ways[0] is first and better.left == 4
    assert len(better.ways[1].pool.drawn) >= ROUND
    worst, least = (max(e.rounds_factor for e in each.errors.values()) for each in (mixture, better))
    assert least < worst / 2
    assert replace(mixture, left=0).improved() is None, "no rounds are left"


def test_weights_that_cannot_be_trusted_are_replaced(first, monkeypatch):
    """First by all shared draws, then by draws of the way's own, then by a proposal fitted to those."""
    monkeypatch.setattr(Way, "reliable", False)
    monkeypatch.setattr(homing_mixture, "ALONE_ROUNDS", 1)
    mixture = Mixture((first, shared(first)), 2)
    every = mixture.improved()
    assert every.ways[1].shared and every.ways[1].pool.rounds == first.pool.rounds and every.left == 2
    alone = every.improved()
    assert not alone.ways[1].shared and alone.ways[1].pool.rounds == 1 and alone.left == 1
    refitted = alone.improved()
    assert refitted.ways[1].pool.proposals[0] is not alone.ways[1].pool.proposals[0] and refitted.left == 0
    assert refitted.ways[1].pool.counts == (ROUND,), "draws that a proposal was fitted to are in the answer"
    assert refitted.improved() is None


def test_an_improbable_way_need_not_be_reliable(first, second, monkeypatch):
    """Its tail index is not that of the mixture."""
    heavy = replace(second, pool=replace(second.pool))
    heavy.pool.__dict__["smoothed"] = replace(second.pool.smoothed, pareto_k=0.9)
    for chance, k in ((0.05, first.pool.smoothed.pareto_k), (0.2, 0.9)):
        mixture = Mixture((first, heavy), 0)
        mixture.__dict__["probabilities"] = np.array([1 - chance, chance])
        assert mixture.acceptance.pareto_k == k
        assert bool(mixture.acceptance.missing) == (k == 0.9)


def test_the_posterior_says_how_probable_each_way_is(first, second):
    """All draws, by the weight of their way; the diagnosis is that of the mixture."""
    ways = tuple(Alternative({}, 0.5, first.pool.density.fit) for _ in range(2))
    mixture = Mixture((with_density(first, alternatives=ways), second), 0)
    posterior = mixture.posterior()
    assert posterior.weights.sum() == pytest.approx(1) and posterior.seconds > 0
    by_way = [posterior.weights[posterior.way == k].sum() for k in range(2)]
    np.testing.assert_allclose(by_way, mixture.probabilities)
    np.testing.assert_allclose([way.probability for way in posterior.fit.mixture], mixture.probabilities)
    assert posterior.convergence.monte_carlo_error == mixture.errors and posterior.convergence.answer == "accepted"

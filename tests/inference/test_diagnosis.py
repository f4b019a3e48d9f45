"""Verdicts on chains whose quality is known (formulation 4.3): every limit is crossed alone."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from support.two_parameters import AT_MODE, BACKLASH, RATIO, STRETCH, autoregressive, route

from tvsbayes.inference.chain import GROUPS, Chain, better
from tvsbayes.inference.density import Points
from tvsbayes.inference.diagnosis import AGREEMENT_LIMIT, autocorrelation_steps, diagnose
from tvsbayes.inference.importance import Sample
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.results.convergence import Convergence, Importance, NamedValue, Reweighted

WALKERS, STEPS = 64, 400


def log_normal_density(z: np.ndarray) -> np.ndarray:
    """The target in z: standard normal in both coordinates, `AT_MODE` at the mode."""
    return AT_MODE - 0.5 * (z[..., RATIO] ** 2 + z[..., BACKLASH] ** 2)


def chain_of(z: np.ndarray) -> Chain:
    """A chain (steps, walkers, 2) of z as the sampler would hold it: w, and the density that `Target` gives it."""
    log_factor = STRETCH * z[..., 0]
    w = np.stack([z[..., 0], z[..., 1] * np.exp(-log_factor)], axis=-1)
    log_density = -0.5 * np.sum(z**2, axis=-1) + log_factor
    accepted = np.full(z.shape[1], 0.4 * len(z))
    return Chain(w, log_density, accepted, (), 0, 1.0, len(z))


def independent(steps: int = STEPS) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((steps, WALKERS, 2))


class TwoNormals:
    """A density of the two parameters, mapped by hand; nothing was integrated out."""

    headlines = (TWO_MIRROR.names[RATIO], TWO_MIRROR.names[BACKLASH])
    fixed = frozenset()

    def valued(self, w, generator):
        """With the map of `route`; the density is the chain's."""
        mapped = route().mapped(w)
        return Points(w, np.zeros(len(w)), {"z": mapped.z, "log_jacobian": mapped.log_jacobian})

    def log_density(self, points):
        """In z."""
        return points.log_target + AT_MODE - points.parts["log_jacobian"]

    def quantities(self, points):
        """By their names, and one that no draw changes."""
        z = points.parts["z"]
        return {TWO_MIRROR.names[k]: z[:, k] for k in (RATIO, BACKLASH)} | {
            "effective_mirror_offset_mm": np.zeros(len(z))
        }


@pytest.fixture
def judged():
    """Diagnosis of a chain, by default after importance sampling that was not accepted: it is judged alone."""
    refused = SimpleNamespace(convergence=SimpleNamespace(importance=None, answer="laplace"))

    def judge(chain: Chain, first: object = refused) -> Sample:
        return diagnose(SimpleNamespace(density=TwoNormals(), sample=first, seed=0), chain)

    return judge


def test_independent_draws_have_converged_and_keep_their_density(judged):
    sample = judged(chain_of(independent()))
    assert sample.convergence.converged, sample.convergence.missing
    assert sample.convergence.stuck_walkers == ()
    points = sample.points
    np.testing.assert_allclose(TwoNormals().log_density(points), log_normal_density(points.parts["z"]), rtol=1e-12)


def test_groups_of_other_means_are_told_by_r_hat(judged):
    """Halves of four groups count as eight chains: of means +-0.25 their variance is 8/7 of 1/16, R-hat 1.035."""
    z = independent()
    z[..., 1] += 0.25 * np.repeat([1.0, -1.0] * (GROUPS // 2), WALKERS // GROUPS)
    missing = "; ".join(judged(chain_of(z)).convergence.missing)
    value = float(re.search(r"R-hat of \S+ is ([\d.]+), wanted 1.01", missing)[1])
    # The 500 draws of half a group determine its mean to 0.045: 0.25 +- 0.045 is 1.035 +- 0.012.
    assert value == pytest.approx(1.035, abs=0.02)


def test_too_few_effective_draws_are_reported(judged):
    """54 of 60 steps of 64 walkers with memory 0.9, nineteen steps to an independent draw: 180, of the tails more."""
    missing = "; ".join(judged(chain_of(autoregressive(60, WALKERS, 0.9))).convergence.missing)
    for kind in ("bulk", "tail"):
        value = int(re.search(rf"has (\d+) {kind} effective draws, wanted 400", missing)[1])
        assert 100 < value < 400


def test_a_chain_of_few_autocorrelation_times_is_reported(judged):
    """Memory 0.9: 19 steps to an independent draw, 16 of them in the chain, known badly from so few."""
    missing = "; ".join(judged(chain_of(autoregressive(STEPS, WALKERS, 0.9))).convergence.missing)
    value = int(re.search(r"steps are (\d+) autocorrelation times, wanted 50", missing)[1])
    assert 8 < value < 40


def test_a_walker_that_kept_a_coordinate_is_left_out_of_its_autocorrelation():
    """New values of some coordinates leave the others as they were, in a short chain all the time."""
    w = np.random.default_rng(31).standard_normal((200, 8, 2))
    for step in range(1, len(w)):
        w[step, :, 1] = 0.8 * w[step - 1, :, 1] + 0.6 * w[step, :, 1]
    others = autocorrelation_steps(np.delete(w, 3, axis=1))
    # (1 + 0.8) / (1 - 0.8), known to a fifth from seven walkers of 22 times each.
    assert others == pytest.approx(9.0, rel=0.6)
    w[:, 3, 1] = w[0, 3, 1]
    assert autocorrelation_steps(w) == pytest.approx(others, rel=1e-12)
    w[:, :, 0] = w[0, :, 0]
    assert autocorrelation_steps(w) == np.inf


def test_a_walker_is_stuck_that_hardly_moves_or_lives_at_another_density(judged):
    chain = chain_of(independent())
    idle, away = chain.accepted.copy(), chain.log_density.copy()
    idle[7] *= 0.2
    away[:, 9] -= 40.0
    for changed, stuck in ((replace(chain, accepted=idle), 7), (replace(chain, log_density=away), 9)):
        convergence = judged(changed).convergence
        assert convergence.stuck_walkers == (stuck,)
        assert convergence.missing[-1] == f"stuck walkers: {stuck}"


def weighted(shift: float = 0.0) -> Sample:
    """The same two normals by 8000 draws of twice their variance, accepted; the ratio shifted by so many sds."""
    draws = np.sqrt(2) * np.random.default_rng(7).standard_normal((8000, 2))
    weights = np.exp(-0.25 * np.sum(draws**2, axis=1))
    weights /= weights.sum()
    z = np.zeros((8000, len(TWO_MIRROR.names)))
    z[:, [BACKLASH, RATIO]] = draws + np.array([0.0, shift])
    worst = NamedValue(TWO_MIRROR.names[RATIO], 0.1)
    importance = Importance(True, (), 8, 8000, 0.5, worst, 0.1, worst, 0.001, 0.0, 0.01, 0, "accepted")
    points = Points(draws, np.zeros(8000), {"z": z})
    quantities = TwoNormals().quantities(points)
    return Sample(points, quantities, weights[None], Reweighted(importance, {}, {}, {}), 0.0)


def test_a_chain_that_says_the_same_as_importance_sampling_agrees(judged):
    sample = judged(chain_of(independent()), weighted())
    assert sample.convergence.converged and sample.convergence.agreement.agrees
    assert sample.convergence.agreement.worst.value < AGREEMENT_LIMIT
    assert sample.convergence.importance.draws == 8000


@pytest.mark.parametrize(("shift", "answer"), [(-0.15, "rough"), (-1.0, "laplace")])
def test_a_chain_that_says_something_else_is_known_no_better_than_both_agree(judged, shift, answer):
    """The chain's 5000 draws have a mean to 0.014 sd, the weighted 8000, worth 3600, to 0.017: 0.15 is seven errors."""
    sample = judged(chain_of(independent()), weighted(shift))
    agreement = sample.convergence.agreement
    assert sample.convergence.answer == answer and not agreement.agrees
    error = sample.convergence.monte_carlo_error[TWO_MIRROR.names[RATIO]]
    assert error.mean == pytest.approx(abs(shift), abs=5 * 0.022)
    assert agreement.worst.quantity.startswith(TWO_MIRROR.names[RATIO]) and agreement.worst.value > AGREEMENT_LIMIT
    (message,) = sample.convergence.missing
    words = f"emcee and importance sampling differ on {agreement.worst.quantity} by {agreement.worst.value:.1f} Monte"
    assert message.startswith(words)


def test_where_every_headline_is_fixed_the_others_must_agree(judged, monkeypatch):
    """A rig whose geometry is stated as known: the campaign determines its noise."""
    monkeypatch.setattr(TwoNormals, "headlines", ("effective_mirror_offset_mm",))
    assert judged(chain_of(independent()), weighted()).convergence.converged
    sample = judged(chain_of(independent()), weighted(-0.15))
    assert sample.convergence.missing and TWO_MIRROR.names[RATIO] in sample.convergence.agreement.worst.quantity


@pytest.mark.parametrize(
    ("weighted", "chain", "agrees", "chosen"),
    [
        ("accepted", "accepted", True, "chain"),
        ("accepted", "rough", None, "weighted"),
        ("rough", "laplace", None, "weighted"),
        ("laplace", "rough", None, "chain"),
        ("accepted", "rough", False, "chain"),
    ],
)
def test_the_better_answer_is_kept(weighted, chain, agrees, chosen):
    """The chain where both are equally good, and where it contradicts the weighted draws."""
    agreement = None if agrees is None else SimpleNamespace(agrees=agrees)
    early = SimpleNamespace(convergence=SimpleNamespace(answer=weighted))
    walked = SimpleNamespace(convergence=Mock(spec=Convergence, answer=chain, agreement=agreement))
    assert better(early, walked) is {"weighted": early, "chain": walked}[chosen]

"""The proposal of few coordinates: its density is that of its draws, it follows a bent target and is never lost."""

from __future__ import annotations

import emcee
import numpy as np
import pytest
from support.small_posterior import SIGMAS

from tvsbayes.errors import NotConverged
from tvsbayes.inference.density import Points
from tvsbayes.inference.ensemble import moves
from tvsbayes.inference.importance import weighted_run
from tvsbayes.inference.students import StudentMixture
from tvsbayes.inference.summaries import reweighted


class Toy:
    """A log density of two coordinates that starts about a narrow guess of its mode at the origin."""

    dimension, walkers, invalid, log_constant = 2, 16, 0, 0.0
    headlines, fixed = ("first", "second"), frozenset()

    def __init__(self, log_density, width=1.0):
        self.function, self.width = log_density, width

    def __call__(self, w):
        """Log density."""
        return self.function(w)

    def valued(self, w, generator):
        """Nothing was integrated out."""
        return Points(w, self(w), {})

    def log_density(self, points):
        """The same."""
        return points.log_target

    def quantities(self, points):
        """Both coordinates."""
        return dict(zip(self.headlines, points.w.T, strict=True))

    def first_proposal(self):
        """About the guess."""
        return StudentMixture.about(np.zeros(2), self.width**2 * np.eye(2))


def bent(w):
    """Normal along the first coordinate, the second follows its square."""
    return -0.5 * w[:, 0] ** 2 - 0.5 * ((w[:, 1] - 0.5 * w[:, 0] ** 2) / 0.5) ** 2


def test_the_density_is_normalised_and_has_the_moments_of_its_draws():
    """Weights of an independent normal density over the mixture have mean one."""
    mixture = StudentMixture.about(np.array([0.3, -0.2]), np.array([[1.0, 0.4], [0.4, 0.5]]))
    w = mixture.draw(200_000, np.random.RandomState(1))
    log_normal = -0.5 * np.sum(w**2, axis=1) - np.log(2 * np.pi)
    weights = np.exp(log_normal - mixture.log_density(w))
    assert abs(weights.mean() - 1) < SIGMAS * weights.std() / np.sqrt(len(w))


def test_a_bent_target_is_followed_from_a_guess_that_is_far_too_narrow():
    run = weighted_run(Toy(bent, 0.1), 2)
    judged = run.sample.convergence
    assert judged.answer == "accepted", judged.missing
    second = reweighted(run.sample.quantities["second"][None], run.sample.weights)
    # E x^2 / 2 = 0.5; its variance is 0.5 + 0.25.
    assert abs(second.mean - 0.5) < SIGMAS * second.mcse_mean and abs(second.sd**2 - 0.75) < SIGMAS * 2 * second.mcse_sd
    evidence = judged.importance
    # Integral of the density: 2 pi times 0.5.
    assert evidence.log_evidence == pytest.approx(np.log(np.pi), abs=SIGMAS * evidence.log_evidence_mcse)


class Integrating(Toy):
    """Draws a number for every point as a quantity that is integrated out."""

    def valued(self, w, generator):
        """A standard normal number beside."""
        return Points(w, self(w), {"beside": generator.standard_normal(len(w))})


def test_numbers_of_what_is_integrated_out_are_of_the_seed_and_of_no_other_round(monkeypatch):
    """Over three seeds, pilot and final rounds, and rounds after another fit of the proposal."""
    begun, ordinary = [], Integrating.valued

    def recorded(self, w, generator):
        points = ordinary(self, w, generator)
        begun.append(points.parts["beside"][:2].tolist())
        return points

    monkeypatch.setattr(Integrating, "valued", recorded)
    for seed in (0, 1, 2):
        weighted_run(Integrating(bent, 0.1), seed, pilots_max=3)
    numbers = [number for pair in begun for number in pair]
    assert len(begun) > 3 * 6 and len(set(numbers)) == len(numbers)


@pytest.mark.parametrize("which", [0, 1])
def test_its_steps_keep_the_target(which):
    mixture = StudentMixture.about(np.zeros(2), np.eye(2))
    step, _ = mixture.steps[which]
    assert sum(share for _, share in mixture.steps) == 1 and len(moves(mixture)) == 2
    generator = np.random.RandomState(3)
    exact = generator.standard_normal((64, 2))
    exact[:, 1] = 0.5 * exact[:, 0] ** 2 + 0.5 * exact[:, 1]
    sampler = emcee.EnsembleSampler(64, 2, bent, moves=emcee.moves.MHMove(step), vectorize=True)
    sampler.run_mcmc(emcee.State(exact, random_state=generator.get_state()), 2000, skip_initial_state_check=True)
    chain = sampler.get_chain()
    tau = float(np.max(emcee.autocorr.integrated_time(chain, tol=0, quiet=True)))
    assert abs(chain[..., 1].mean() - 0.5) < SIGMAS * np.sqrt(0.75 * tau / chain[..., 1].size)


def test_a_density_without_values_is_refused_in_words():
    with pytest.raises(NotConverged, match="not finite"):
        weighted_run(Toy(lambda w: np.full(len(w), -np.inf)), 1)


def test_all_weight_in_one_far_corner_is_no_answer():
    far = np.array([40.0, -35.0])
    run = weighted_run(Toy(lambda w: -0.5 * np.sum(((w - far) / 1e-4) ** 2, axis=1), 1e-3), 1, rounds_max=8)
    judged = run.sample.convergence
    assert judged.answer == "laplace" and judged.missing and run.sample.weights.sum() == pytest.approx(1)
    assert np.isfinite(run.proposal.log_density(run.sample.points.w)).all()

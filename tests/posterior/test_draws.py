"""Verdicts on chains whose quality is known, and summaries of draws whose distribution is (formulation 4.3).

No fit: chains are drawn, so that every limit is crossed alone, and nothing is compiled but a batch or two.
"""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from tvsbayes.instrument.parameters import INDEX, NAMES
from tvsbayes.posterior.chain import Chain
from tvsbayes.posterior.diagnosis import GROUPS, diagnose
from tvsbayes.posterior.draws import Posterior, propagated
from tvsbayes.posterior.proposal import Target
from tvsbayes.posterior.ridges import by_width
from tvsbayes.posterior.transport import STRETCH_NODES, Transport

WALKERS, STEPS = 64, 400
RATIO, BACKLASH = INDEX["degrees_per_step.pan"], INDEX["backlash_deg.pan"]
STRETCH = 0.3
"""Log of the factor on the second coordinate per unit of the first, which counts from -2 on."""
AT_MODE = 7.0
SIGMAS = 5.0


def route() -> Transport:
    """The map z_1 = w_1, z_2 = w_2 exp(0.3 max(w_1, -2)) at two of the parameters."""
    empty = {"variance": (0, 1), "constant": (0,), "load": (1, 0), "states": (0, 0), "state_score": (0,)}
    return Transport(
        mode=np.zeros(len(NAMES)),
        free=np.array([BACKLASH, RATIO]),
        root=np.eye(2),
        noise=np.array([0]),
        narrow=np.zeros(0, int),
        bend=np.zeros((0, 2, 2)),
        slope=np.zeros((1, 1)),
        pixels=np.zeros(1),
        prior=np.zeros((1, 1)),
        known=np.ones((1, 1)),
        score=np.zeros(1),
        stretch=STRETCH * np.array([[[0.0, node] for node in STRETCH_NODES]]),
        **{name: np.zeros(shape) for name, shape in empty.items()},
    )


def test_a_ratio_follows_the_degrees_of_a_backlash():
    """Along the ridge of both the ratio is linear in b, and b = halfnorm.ppf(Phi(z)) by SciPy's own law."""
    at = 0.4
    mode = np.zeros(len(NAMES))
    mode[BACKLASH] = at
    ridge = replace(route(), mode=mode, root=np.array([[1.2, 0.0], [-0.6, 0.05]]))
    y = np.column_stack([np.linspace(-3.0, 3.0, 13), np.zeros(13)])
    z = ridge.from_whitened(y)

    def play(z):
        return stats.halfnorm.ppf(stats.norm.cdf(z))

    np.testing.assert_allclose(z[:, BACKLASH], at + 1.2 * y[:, 0], rtol=1e-12)
    slope = (play(at + 1e-5) - play(at - 1e-5)) / 2e-5
    # A central difference of 1e-5 is good to 1e-10 of the slope, SciPy's two laws to 1e-12.
    np.testing.assert_allclose(z[:, RATIO], -0.5 * (play(z[:, BACKLASH]) - play(at)) / slope, atol=1e-8)
    apart = ridge.from_whitened(y + np.array([0.0, 1.0])) - z
    np.testing.assert_allclose(apart[:, RATIO], 0.05, rtol=1e-9)


def fit() -> SimpleNamespace:
    """What a diagnosis reads of a fit."""
    free = np.isin(np.arange(len(NAMES)), [RATIO, BACKLASH])
    return SimpleNamespace(free=free, log_density=AT_MODE, reference_pose_rad=np.zeros(2), space=None, arrays=None)


def log_normal_density(z: np.ndarray) -> np.ndarray:
    """The target in z: standard normal in both coordinates, `AT_MODE` at the mode."""
    return AT_MODE - 0.5 * (z[..., RATIO] ** 2 + z[..., BACKLASH] ** 2)


def chain_of(z: np.ndarray) -> Chain:
    """A chain (steps, walkers, 2) of z as the sampler would hold it: w, and the density that `Target` gives it."""
    log_factor = STRETCH * np.maximum(z[..., 0], STRETCH_NODES[0])
    w = np.stack([z[..., 0], z[..., 1] * np.exp(-log_factor)], axis=-1)
    log_density = -0.5 * np.sum(z**2, axis=-1) + log_factor
    accepted = np.full(z.shape[1], 0.4 * len(z))
    return Chain(w, log_density, accepted, (), 0, 1.0, len(z))


def independent(steps: int = STEPS) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((steps, WALKERS, 2))


def autoregressive(steps: int, walkers: int, memory: float) -> np.ndarray:
    """Standard normal with autocorrelation `memory`^lag along the first axis, shape (steps, walkers, 2)."""
    fresh = np.random.default_rng(2).standard_normal((steps, walkers, 2))
    values = [fresh[0]]
    for one in fresh[1:]:
        values.append(memory * values[-1] + np.sqrt(1 - memory**2) * one)
    return np.array(values)


@pytest.fixture
def judged(monkeypatch):
    """Diagnosis of a chain, its headlines those of the two parameters alone."""

    def derived_at(fit, z, pose):
        zero = np.zeros(z.shape[:2])
        return SimpleNamespace(
            physical=z, effective_deg_per_step=np.zeros((*z.shape[:2], 4)), effective_mirror_offset_mm=zero
        )

    monkeypatch.setattr("tvsbayes.posterior.draws.derived_at", derived_at)
    monkeypatch.setattr("tvsbayes.posterior.diagnosis.derived_at", derived_at)
    # Importance sampling that was not accepted: the chain is judged alone.
    first = SimpleNamespace(converged=False, seed=0, convergence=SimpleNamespace(importance=None))

    def judge(chain: Chain) -> Posterior:
        return diagnose(fit(), SimpleNamespace(path=route(), posterior=first), chain)

    return judge


def test_the_density_of_walkers_is_the_models_times_the_jacobian(x64, monkeypatch):
    def evaluate(z, space, arrays):
        return SimpleNamespace(log_density=AT_MODE - 0.5 * (z[:, RATIO] ** 2 + z[:, BACKLASH] ** 2))

    monkeypatch.setattr("tvsbayes.posterior.proposal.evaluate", evaluate)
    monkeypatch.setattr("tvsbayes.posterior.ridges.evaluate", evaluate)
    w = np.random.default_rng(4).standard_normal((50, 2))
    value = Target(fit(), route())(w)
    log_factor = STRETCH * np.maximum(w[:, 0], STRETCH_NODES[0])
    y = w[:, 1] * np.exp(log_factor)
    np.testing.assert_allclose(value, -0.5 * (y**2 + w[:, 0] ** 2) + log_factor, rtol=1e-12, atol=1e-12)
    # As a density of w it has the mass of the density of z: 2 pi, on a grid that reaches 6 sds of the first.
    one, two = np.meshgrid(np.linspace(-6, 6, 25), np.linspace(-40, 40, 161), indexing="ij")
    value = Target(fit(), route())(np.column_stack([one.ravel(), two.ravel()]))
    assert np.exp(value).sum() * 0.5 * 0.5 == pytest.approx(2 * np.pi, rel=1e-3)


def test_independent_draws_have_converged_and_keep_their_density(judged):
    found = judged(chain_of(independent()))
    assert found.converged, found.convergence.missing
    assert found.convergence.stuck_walkers == ()
    np.testing.assert_allclose(found.log_density, log_normal_density(found.z), rtol=1e-12)


def test_groups_of_other_means_are_told_by_r_hat(judged):
    """Halves of four groups count as eight chains: of means +-0.25 their variance is 8/7 of 1/16, R-hat 1.035."""
    z = independent()
    z[..., 1] += 0.25 * np.repeat([1.0, -1.0] * (GROUPS // 2), WALKERS // GROUPS)
    missing = "; ".join(judged(chain_of(z)).convergence.missing)
    value = float(re.search(r"R-hat of \S+ is ([\d.]+), wanted 1.01", missing)[1])
    # The 500 draws of half a group tell its mean to 0.045: 0.25 +- 0.045 is 1.035 +- 0.012.
    assert value == pytest.approx(1.035, abs=0.02)


def test_too_few_effective_draws_are_told(judged):
    """80 of 100 steps of 64 walkers with memory 0.9, nineteen steps to an independent draw: 270, of the tails more."""
    missing = "; ".join(judged(chain_of(autoregressive(100, WALKERS, 0.9))).convergence.missing)
    for kind in ("bulk", "tail"):
        value = int(re.search(rf"has (\d+) {kind} effective draws, wanted 1000", missing)[1])
        assert 100 < value < 1000


def test_a_chain_of_few_autocorrelation_times_is_told(judged):
    """Memory 0.9: 19 steps to an independent draw, 16 of them in the chain, known badly from so few."""
    missing = "; ".join(judged(chain_of(autoregressive(STEPS, WALKERS, 0.9))).convergence.missing)
    value = int(re.search(r"steps are (\d+) autocorrelation times, wanted 50", missing)[1])
    assert 8 < value < 40


def test_a_walker_is_stuck_that_hardly_moves_or_lives_at_another_density(judged):
    chain = chain_of(independent())
    idle, away = chain.accepted.copy(), chain.log_density.copy()
    idle[7] *= 0.2
    away[:, 9] -= 40.0
    for changed, stuck in ((replace(chain, accepted=idle), 7), (replace(chain, log_density=away), 9)):
        convergence = judged(changed).convergence
        assert convergence.stuck_walkers == (stuck,)
        assert convergence.missing[-1] == f"stuck walkers: {stuck}"


def test_monte_carlo_errors_are_those_of_draws_with_memory():
    """AR(1) of memory 0.6: a mean of n draws is as good as one of n / 4; ends of the interval are +-1.96."""
    memory, draws, chains = 0.6, 1000, 32
    found = propagated(autoregressive(draws, chains, memory)[..., 0].T)
    expected = np.sqrt((1 + memory) / (1 - memory) / (draws * chains))
    assert found.mcse_mean == pytest.approx(expected, rel=0.15)
    assert abs(found.mean) < SIGMAS * expected and found.sd == pytest.approx(1.0, abs=SIGMAS * float(found.mcse_sd))
    np.testing.assert_allclose(found.interval95, [-1.959964, 1.959964], atol=SIGMAS * found.mcse_interval95.max())
    assert found.mcse_interval95.max() < 0.05, "no error would be seen"


def test_the_longer_tail_is_the_worse_known():
    """Independent exponentials: a quantile q of n draws has the sd sqrt(p (1 - p) / n) e^q."""
    draws = np.random.default_rng(6).exponential(size=(20, 1000))
    found = propagated(draws)
    p = np.array([0.025, 0.975])
    exact = -np.log1p(-p)
    expected = np.sqrt(p * (1 - p) / draws.size) * np.exp(exact)
    np.testing.assert_allclose(found.mcse_interval95, expected, rtol=0.4)
    np.testing.assert_array_less(np.abs(found.interval95 - exact), SIGMAS * expected)


def test_no_coordinates_have_an_order():
    """Where only the noise is estimated, nothing is left to whiten."""
    order = by_width(np.zeros((0, 0)))
    assert order.shape == (0,) and np.zeros(3)[order].shape == (0,)


def test_lost_motion_takes_ratio_and_backlash_of_its_own_axis():
    """200 steps of 0.06 deg take up 0.3 deg of play, two take 0.12 deg of it; every direction, by hand."""
    physical = np.zeros((2, 3, len(NAMES)))
    values = {"degrees_per_step.pan": 0.06, "ratio_contrast_deg_per_step.pan": 0.002, "backlash_deg.pan": 0.3}
    values |= {"degrees_per_step.tilt": 0.07, "ratio_contrast_deg_per_step.tilt": 0.004, "backlash_deg.tilt": 0.5}
    for name, value in values.items():
        physical[..., INDEX[name]] = value
    shape = physical.shape[:2]
    draws = SimpleNamespace(
        physical=physical, effective_deg_per_step=np.zeros((*shape, 4)), effective_mirror_offset_mm=np.zeros(shape)
    )
    known = Posterior(None, physical, np.zeros(shape), draws, np.full(shape, 1 / 6), None, 0, 0.0)
    expected = {"left": (0.122, 0.3), "right": (0.118, 0.3), "up": (0.144, 0.5), "down": (0.136, 0.5)}
    for direction, lost in expected.items():
        found = known.lost_motion_deg(direction, np.array([2, 200]))
        np.testing.assert_allclose(found.mean, lost, rtol=1e-12)
        np.testing.assert_allclose(found.interval95, [lost, lost], rtol=1e-12)

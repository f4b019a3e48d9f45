"""The ensemble leaves its target alone, and its coordinates are what they say: of known Jacobian (DESIGN 4.3).

emcee 3.1.6 ships moves that narrow the posterior by up to a quarter without any sign of it, so every move that is
used is tried on a target whose moments are known, from exact draws of it: whatever moves away then is a bias.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import emcee
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.estimators.linear_spots import linear_spots, stop_information
from tvsbayes.instrument.parameters import INDEX
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.instrument.rig import read_rig
from tvsbayes.posterior import proposal
from tvsbayes.posterior.proposal import WALKERS, Independence, Target, walkers_for
from tvsbayes.posterior.ridges import by_width, stop_states, transport
from tvsbayes.posterior.transport import BATCH, STRETCH_NODES, Transport, in_batches
from tvsbayes.twin.simulated_campaign import simulate

SIGMAS = 5.0
"""Standard errors: a right value lies farther out in 6 of 10 million runs, and the runs are seeded."""
RESOLVED = 0.05
"""Five standard errors of E[x.x]/d have to be below this, or the run could not see a bias of sd x0.97."""
STOP_NAMES = (("stop_sd_deg.right", "stop_sd_deg.left"), ("stop_sd_deg.down", "stop_sd_deg.up"))
"""By axis, in the order of `redraw_mix`."""
ROUNDING = 2.0**-52
"""Relative spacing of float64."""
INDEPENDENT_STEPS = {1: 1500, 5: 600, 20: 600, 40: 900}
EVOLUTION_STEPS = {1: 1500, 5: 1600, 20: 1000, 40: 900}
"""Steps by dimension: autocorrelation times (quoted from runs of 2000 steps) are 1.3 to 27 steps with independence
proposals and 5, 18, 59, 87 with differential evolution alone."""


@cache
def small_fit() -> tuple[JointFit, Transport]:
    """64 spots seen by cameras that are known exactly: 29 free parameters; shared with test_posterior.

    With the 21 of the cameras the pairs of second differences would be three times as many.
    """
    rig = read_rig(Path(__file__).resolve().parents[2] / "data" / "rigs" / "mounted" / "rig.toml")
    rig = replace(rig, stereo=replace(rig.stereo, parameter_covariance=np.zeros((24, 24))))
    fitted = fit(simulate(rig, four_point_protocol(repeats=4, steps=(100, 200)), seed=21).campaign)
    assert fitted.converged, fitted.problems
    return fitted, transport(fitted)


@cache
def small_table() -> Transport:
    """The map of the same fit as with too many stops to follow each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tvsbayes.posterior.ridges.STATES_MAX", 0)
        return transport(small_fit()[0])


def small_path(whole: bool) -> Transport:
    path = small_fit()[1] if whole else small_table()
    assert (len(path.states) > 0) == whole == (not path.stretch.any())
    return path


def run(moves: object, dimension: int, steps: int, walkers: int, seed: int = 1) -> np.ndarray:
    """Chain (steps, walkers, d) on N(0, I), from exact draws of it."""
    generator = np.random.RandomState(seed)
    start = generator.standard_normal((walkers, dimension))
    target = lambda x: -0.5 * np.sum(x * x, axis=1)  # noqa: E731
    sampler = emcee.EnsembleSampler(walkers, dimension, target, moves=moves, vectorize=True)
    state = emcee.State(start, random_state=generator.get_state())
    sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    return sampler.get_chain()


def bias(chain: np.ndarray) -> str:
    """What is wrong with a chain on N(0, I), or nothing."""
    steps, walkers, dimension = chain.shape
    square = np.sum(chain**2, axis=2) / dimension
    # A walker that never moves has no autocorrelation time: the bound is nan and nothing passes.
    with np.errstate(invalid="ignore"):
        tau = float(emcee.autocorr.integrated_time(square[:, :, None], tol=0, quiet=True)[0])
    # x.x/d has variance 2/d under the target.
    bound = SIGMAS * np.sqrt(2 / dimension * tau / (steps * walkers))
    # Walkers are independent of each other under the product target. The d T/tau means per run number 200 or more,
    # so the scatter of this variance is below 0.1, a fifth of the way to the nearer limit.
    together = walkers * float(np.mean(chain.mean(axis=1) ** 2))
    wrong = [] if bound < RESOLVED else [f"unresolved: {bound:.3f}"]
    wrong += [] if abs(square.mean() - 1) < bound else [f"E[x.x]/d = {square.mean():.4f}, bound {bound:.4f}"]
    wrong += [] if 0.5 < together < 1.6 else [f"n Var(mean of ensemble) = {together:.2f}"]
    return "; ".join(wrong)


def off_target(dimension: int) -> Independence:
    """A proposal whose mean and sds are not the target's."""
    return Independence(np.full(dimension, 0.3), np.linspace(1.0, 1.2, dimension), np.arange(dimension) % 3 == 1)


@pytest.mark.parametrize("dimension", INDEPENDENT_STEPS)
@pytest.mark.parametrize("which", ["independence", "mixture"])
def test_independence_and_the_mixture_keep_the_target(which, dimension):
    mixture = proposal.moves(off_target(dimension))
    moves = mixture[0][0] if which == "independence" else mixture
    assert bias(run(moves, dimension, INDEPENDENT_STEPS[dimension], walkers_for(dimension))) == ""


# Full steps (gamma0 = 1) are accepted less than once in 150 steps from d = 20 on: alone they show nothing there.
@pytest.mark.parametrize(
    ("which", "dimension"), [*[(1, d) for d in EVOLUTION_STEPS], *[(2, d) for d in EVOLUTION_STEPS if d < 20]]
)
def test_differential_evolution_keeps_the_target(which, dimension):
    move, _ = proposal.moves(off_target(dimension))[which]
    assert isinstance(move, emcee.moves.DEMove)
    assert bias(run(move, dimension, EVOLUTION_STEPS[dimension], max(64, 2 * dimension))) == ""


def test_the_moves_are_the_three_that_are_tried_here():
    mixture = proposal.moves(off_target(3))
    assert [type(move) for move, _ in mixture] == [emcee.moves.MHMove, emcee.moves.DEMove, emcee.moves.DEMove]
    assert [move.gamma0 for move, _ in mixture[1:]] == [None, 1.0]
    assert sum(share for _, share in mixture) == pytest.approx(1.0, abs=len(mixture) * ROUNDING)


@pytest.mark.parametrize("dimension", [5, 20])
def test_a_wrong_sign_of_the_factor_is_seen(dimension):
    right = off_target(dimension)

    def wrong(w, generator):
        proposed, factor = right(w, generator)
        return proposed, -factor

    chain = run(emcee.moves.MHMove(wrong), dimension, INDEPENDENT_STEPS[dimension], walkers_for(dimension))
    assert "E[x.x]/d" in bias(chain)
    # statistics.md: sd x0.52 and x0.44.
    assert np.mean(chain**2) < 0.6


def test_walkers_that_move_together_are_seen():
    # emcee 3.1.6 adds one vector to all walkers when a Gaussian move has a full covariance.
    assert "Var(mean of ensemble)" in bias(run(emcee.moves.GaussianMove(np.eye(1)), 1, INDEPENDENT_STEPS[1], 64))


def test_walkers_outnumber_the_dimensions_in_whole_batches():
    for dimension in range(1, 200):
        walkers = walkers_for(dimension)
        assert walkers > dimension and walkers >= WALKERS
        assert walkers % (2 * BATCH) == 0


@pytest.mark.parametrize("heavy", [False, True])
def test_the_proposal_density_is_normalised_and_has_the_moments_of_its_draws(heavy):
    proposal = Independence(np.array([0.7]), np.array([1.3]), np.array([heavy]))
    # A t with 5 degrees of freedom has 1e-12 of its mass beyond 400 sds.
    x = np.linspace(-600.0, 600.0, 600_001)
    density = np.exp(proposal.log_density(x[:, None]))
    step = x[1] - x[0]
    tail = 1e-9
    assert step * density.sum() == pytest.approx(1.0, abs=tail)
    draws = proposal.draw(200_000, np.random.RandomState(3))[:, 0]
    for moment in (lambda v: v, lambda v: np.abs(v - 0.7), lambda v: (v - 0.7) ** 2, lambda v: np.abs(v - 0.7) > 4):
        expected = step * np.sum(density * moment(x))
        scatter = np.sqrt(step * np.sum(density * (moment(x) - expected) ** 2) / len(draws))
        # A step of 0.002 blurs the edge of the last indicator by less than 1e-6.
        assert abs(moment(draws).mean() - expected) < SIGMAS * scatter + 1e-6


def test_the_proposal_density_and_draws_agree_in_many_dimensions():
    dimension = 8
    proposal = Independence(
        np.linspace(-1, 1, dimension), np.linspace(0.5, 2.0, dimension), np.arange(dimension) % 2 == 1
    )
    w = proposal.draw(100_000, np.random.RandomState(4))
    for shrink in (0.7, 0.9):
        other = -0.5 * np.sum(((w - proposal.mean) / (shrink * proposal.sd)) ** 2, axis=1)
        other -= np.sum(np.log(shrink * proposal.sd)) + 0.5 * dimension * np.log(2 * np.pi)
        weights = np.exp(other - proposal.log_density(w))
        assert abs(weights.mean() - 1) < SIGMAS * weights.std() / np.sqrt(len(w))
    old = w[:5]
    proposed, factor = proposal(old, np.random.RandomState(5))
    np.testing.assert_array_equal(proposed, proposal.draw(5, np.random.RandomState(5)))
    np.testing.assert_array_equal(factor, proposal.log_density(old) - proposal.log_density(proposed))


@pytest.mark.parametrize("count", [1, BATCH - 1, BATCH, BATCH + 1, 2 * BATCH + 6])
def test_batches_give_what_one_call_gives(x64, count):
    points = np.random.default_rng(6).normal(size=(count, 3))
    sizes = []

    def function(block):
        sizes.append(block.shape)
        return {"double": 2 * block, "first": block[:, 0] ** 2}

    joined = in_batches(function, points)
    assert set(sizes) == {(BATCH, 3)} and len(sizes) == -(-count // BATCH)
    np.testing.assert_array_equal(joined["double"], 2 * points)
    np.testing.assert_array_equal(joined["first"], points[:, 0] ** 2)


def test_coordinates_are_ordered_by_the_variance_left_to_them():
    root = np.random.default_rng(7).normal(size=(9, 9)) * np.geomspace(1e-3, 1.0, 9)
    covariance = root @ root.T
    order = by_width(covariance)
    assert sorted(order) == list(range(9))
    for place in range(9):
        before, after = order[:place], order[place:]
        cross = covariance[np.ix_(before, after)]
        explained = cross * np.linalg.solve(covariance[np.ix_(before, before)], cross)
        left = np.diag(covariance)[after] - explained.sum(axis=0)
        assert np.argmax(left) == 0, place


@pytest.mark.parametrize("whole", [True, False])
def test_to_w_undoes_the_map(whole):
    fitted, path = small_fit()[0], small_path(whole)
    assert path.dimension == fitted.free.sum() and len(path.narrow) > 0
    w = np.random.default_rng(8).normal(size=(50, path.dimension))
    back = path.to_w(path.mapped(w).z)
    # A triangular solve amplifies rounding by the condition of the root; the shear adds terms as large as itself.
    sheared = np.abs(path.to_w(path.from_whitened(w))).max()
    assert np.abs(back - w).max() < ROUNDING * np.linalg.cond(path.root) * sheared * path.dimension
    fixed = ~fitted.free
    np.testing.assert_array_equal(path.mapped(w).z[:, fixed], np.repeat(fitted.z[None, fixed], 50, axis=0))
    np.testing.assert_array_equal(path.mapped(np.zeros((1, path.dimension))).z[0], fitted.z)


@pytest.mark.parametrize("whole", [True, False])
def test_the_jacobian_of_the_map_is_what_it_says(whole):
    path = small_path(whole)
    step = 1e-3
    for w in np.random.default_rng(9).normal(size=(3, path.dimension)):
        steps = step * np.eye(path.dimension)
        slopes = (path.mapped(w + steps).z - path.mapped(w - steps).z)[:, path.free].T / (2 * step)
        straight = np.linalg.solve(path.root, slopes)
        assert np.abs(straight - np.eye(path.dimension)).max() > 0.1, "nothing is bent"
        sign, log_volume = np.linalg.slogdet(slopes)
        # Central differences of an exponential of at most 0.5 w, and rounding amplified by the solve.
        error = (step**2 + ROUNDING / step * np.linalg.cond(path.root)) * np.abs(straight).sum()
        assert error < 1e-2
        assert sign == 1
        expected = np.sum(np.log(np.diag(path.root))) + path.mapped(w[None]).log_jacobian[0]
        assert abs(log_volume - expected) < error


def test_the_shear_straightens_the_posterior():
    fitted, path = small_fit()
    straight = replace(path, narrow=path.narrow[:0], bend=path.bend[:0])
    w = np.random.default_rng(10).normal(size=(8 * BATCH, path.dimension))
    with jax.enable_x64(True):
        spread = [np.std(Target(fitted, p)(w) + 0.5 * np.sum(w**2, axis=1)) for p in (path, straight)]
    assert spread[0] < spread[1] / 3, spread


def test_the_precision_at_other_noise_scales_is_the_smoothers():
    """Woodbury's identity over all stop errors against the Fisher information of the filter and smoother."""
    fitted, path = small_fit()
    count = len(path.slope)
    others = path.free[count:]
    wide = path.root[count:, count:]
    for w in np.random.default_rng(12).normal(size=(4, count)):
        z = path.from_whitened(np.concatenate([w, np.zeros(len(others))])[None])[0]
        with jax.enable_x64(True):
            scales, mode = (np.asarray(fitted.space.physical(jnp.asarray(x))) for x in (z, fitted.z))
        pixels = scales[INDEX["pixel_scale"]] / mode[INDEX["pixel_scale"]]
        ratio = np.array([[scales[INDEX[n]] / mode[INDEX[n]] for n in sides] for sides in STOP_NAMES])
        linear = linear_spots(fitted.linearised, fitted.arrays, -fitted.linearised.residual_jacobian)
        spots = len(linear.residual)
        mix = np.asarray(fitted.arrays.spots.redraw_mix)[:spots]
        stops = np.radians(mode[[INDEX[n] for sides in STOP_NAMES for n in sides]]).reshape(2, 2) * ratio
        variance = linear.variance.copy()
        variance[:, :2] = np.sum(mix * stops**2, axis=2)
        scaled = replace(linear, load=linear.load / pixels, jacobian=linear.jacobian / pixels, variance=variance)
        expected = wide.T @ (np.eye(len(others)) + stop_information(scaled).fisher[np.ix_(others, others)]) @ wide
        factor = path.conditional(w[None]).factor[0]
        # The information spans ten decades in z; in y it is of order 1.
        np.testing.assert_allclose(factor @ factor.T, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
        assert np.abs(expected - np.eye(len(others))).max() > 0.1, "the scales are those of the mode"


def test_too_many_stop_errors_get_no_columns(monkeypatch):
    """A campaign of ten thousand spots would need gigabytes for them."""
    fitted, path = small_fit()
    linear = linear_spots(fitted.linearised, fitted.arrays, -fitted.linearised.residual_jacobian)
    count = len(path.constant)
    assert stop_states(fitted, linear).load.shape == (4 * len(linear.residual), count)
    monkeypatch.setattr("tvsbayes.posterior.ridges.STATES_MAX", count - 1)
    found = stop_states(fitted, linear)
    assert found.load.shape == (4 * len(linear.residual), 0)
    assert found.variance.shape == (0, 4) and found.constant.shape == (0,)


def test_w_keeps_the_curvature_far_from_the_mode():
    """Where a stop scatters by four of its posterior sds more than at the mode, ratios are far wider; not in w."""
    fitted, path = small_fit()
    count = len(path.slope)
    for which in np.flatnonzero(path.pixels == 0):
        w = np.zeros((3, path.dimension))
        w[:, which] = 4.0
        factor = path.conditional(w[:1, :count]).factor[0]
        # Along the direction of y that this stop sd widens most.
        values, vectors = np.linalg.eigh(factor @ factor.T)
        assert values[0] < 0.3
        aside, curvature = 0.25 * vectors[:, 0], []
        with jax.enable_x64(True):
            for route, step in ((path, factor.T @ aside), (path.straight(), aside)):
                moved = w.copy()
                moved[:, count:] = np.outer([-1, 0, 1], step)
                curvature.append(-(np.array([1, -2, 1]) @ Target(fitted, route)(moved)) / (step @ step))
        # Of the linearised campaign; the true one is bent.
        assert 0.5 < curvature[0] < 2, (which, curvature)
        assert curvature[1] < 0.5, (which, curvature)


def test_the_table_keeps_the_curvature_far_from_the_mode():
    """The same, coordinate by coordinate."""
    fitted, path = small_fit()[0], small_path(False)
    node = len(STRETCH_NODES) - 2
    which, place = np.unravel_index(np.argmax(path.stretch[:, node]), path.stretch[:, node].shape)
    step = 0.5 * np.eye(path.dimension)[place]
    w = np.stack([-step, np.zeros(path.dimension), step])
    w[:, path.noise[which]] = STRETCH_NODES[node]
    with jax.enable_x64(True):
        curvature = [-(np.array([1, -2, 1]) @ Target(fitted, p)(w)) / 0.5**2 for p in (path, path.straight())]
    # The information at the node comes from one-sided steps as long: halves of their error are left.
    assert curvature[0] == pytest.approx(1.0, abs=0.3) and curvature[1] < 0.5, curvature


def test_a_density_without_value_is_refused_and_counted(x64, monkeypatch):
    dimension, count = 3, BATCH + 5
    path = replace(small_fit()[1].straight(), mode=np.zeros(4), free=np.array([0, 1, 3]), root=np.eye(3))
    path = replace(path, noise=np.zeros(0, int), stretch=np.zeros((0, len(STRETCH_NODES), 3)))
    w = np.random.default_rng(11).normal(size=(count, dimension))
    without = np.array([0, 7, count - 1])
    w[without, 2] = 100.0

    def evaluate(z, space, arrays):
        return SimpleNamespace(log_density=jnp.where(z[:, 3] > 50, jnp.nan, 5.0 - z[:, 0]))

    monkeypatch.setattr("tvsbayes.posterior.proposal.evaluate", evaluate)
    monkeypatch.setattr("tvsbayes.posterior.ridges.evaluate", evaluate)
    target = Target(SimpleNamespace(space=None, arrays=None, log_density=2.0), path)
    value = target(w)
    expected = (5.0 - w[:, 0]) - 2.0
    expected[without] = -np.inf
    np.testing.assert_array_equal(value, expected)
    assert target.invalid == len(without), "the filling of the last batch is no evaluation"
    target(w)
    assert target.invalid == 2 * len(without)

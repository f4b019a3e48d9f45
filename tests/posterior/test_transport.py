"""The map of the posterior and the ridges it was measured from: coordinates are what they say, of known Jacobian."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from support.small_posterior import ROUNDING, small_fit, small_path
from support.two_parameters import BACKLASH, RATIO, no_places, route
from tvsbayes.posterior.ridges import by_width, stop_states

from tvsbayes.estimators.linear_spots import linear_spots, stop_information
from tvsbayes.instrument.parameters import INDEX, NAMES
from tvsbayes.model.compiled import BATCH, in_batches
from tvsbayes.posterior.proposal import Target
from tvsbayes.posterior.transport import STRETCH_NODES

STOP_NAMES = (("stop_sd_deg.right", "stop_sd_deg.left"), ("stop_sd_deg.down", "stop_sd_deg.up"))
"""By axis, in the order of `redraw_mix`."""


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
    # At the mode two slopes cancel, each as large as the scores it is made of, by the root's units at most.
    rounded = ROUNDING * path.dimension * max(1.0, np.abs(path.score).max())
    np.testing.assert_allclose(path.mapped(np.zeros((1, path.dimension))).z[0], fitted.z, rtol=0, atol=rounded)


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

    def evaluate(z, normal, space, arrays):
        value = jnp.where(z[:, 3] > 50, jnp.nan, 5.0 - z[:, 0])
        return SimpleNamespace(log_density=value, place_errors_rad=normal)

    monkeypatch.setattr("tvsbayes.posterior.proposal.evaluate", evaluate)
    monkeypatch.setattr("tvsbayes.posterior.ridges.evaluate", evaluate)
    target = Target(SimpleNamespace(space=None, arrays=no_places(), log_density=2.0), path)
    value = target(w)
    expected = (5.0 - w[:, 0]) - 2.0
    expected[without] = -np.inf
    np.testing.assert_array_equal(value, expected)
    assert target.invalid == len(without), "the filling of the last batch is no evaluation"
    target(w)
    assert target.invalid == 2 * len(without)


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


def test_no_coordinates_have_an_order():
    """Where only the noise is estimated, nothing is left to whiten."""
    order = by_width(np.zeros((0, 0)))
    assert order.shape == (0,) and np.zeros(3)[order].shape == (0,)

"""The map of the posterior: coordinates are what they say, of known Jacobian, and nearly normal."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from support.small_posterior import ROUNDING, small_fit
from support.two_parameters import (
    BACKLASH,
    CURVE,
    NARROW_SD,
    RATIO,
    TURN,
    no_places,
    play_density,
    play_near_zero,
    ridge,
    ridge_density,
    route,
)

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.model.compiled import BATCH
from tvsbayes.posterior.linear_campaign import FAR_ABOVE, positive_factor
from tvsbayes.posterior.target import Target
from tvsbayes.posterior.transport import BLOCK_ROWS, Transport, by_width

FLOOR = 1e-9
"""Of a centred map, in y: Gauss and Newton take differences of residuals of 1e4 units of noise."""


def uncentred(path: Transport) -> Transport:
    """The map whose narrow coordinates stay where the linearised campaign has them."""
    return replace(path, narrow=0, bend=path.bend[:, :0, :0])


def test_no_coordinates_have_an_order():
    """Where only the noise is estimated, nothing is left to whiten."""
    order = by_width(np.zeros((0, 0)))
    assert order.shape == (0,) and np.zeros(3)[order].shape == (0,)


def test_to_w_undoes_the_map():
    """Points on both sides of a block's end; what is held stays; whitened, the mode is the origin."""
    fitted, path = small_fit()
    assert path.dimension == fitted.free.sum() and 0 < path.narrow < path.dimension - path.noise
    w = np.random.default_rng(8).normal(size=(BLOCK_ROWS + 6, path.dimension))
    with jax.enable_x64(True):
        z = path.mapped(w).z
        back, origin = path.to_w(z), path.to_whitened(fitted.z[None])
        widest = np.abs(path.to_whitened(z)).max()
    # A triangular solve amplifies rounding by the condition of the root.
    amplified = ROUNDING * np.linalg.cond(path.root) * widest * path.dimension
    assert np.abs(back - w).max() < amplified + FLOOR
    fixed = ~fitted.free
    np.testing.assert_array_equal(z[:, fixed], np.repeat(fitted.z[None, fixed], len(w), axis=0))
    np.testing.assert_allclose(origin, 0, atol=amplified)


def test_centring_makes_a_curved_ridge_normal():
    """Where a narrow coordinate follows a wide one along a parabola, its conditional density is the normal one of w."""
    path = ridge()
    assert path.bend[0, 0, 0] == pytest.approx(TURN, rel=1e-3) and abs(path.bend[1, 0, 0]) < 1e-6
    w = np.random.default_rng(10).normal(size=(400, 2))
    points, centre = path.mapped(w), path.mapped(w * [1.0, 0.0])
    wide = np.abs(w[:, 0])
    # Of z_1 alone: the map keeps the wide coordinate.
    np.testing.assert_array_equal(points.z[:, path.free[0]], w[:, 0])
    along = ridge_density(points.z) + points.log_jacobian - (ridge_density(centre.z) + centre.log_jacobian)
    # The prior's pull on the narrow one is taken at the mode's slope: off by z_2 sd / slope^2 standard deviations.
    pull = CURVE * wide**2 * NARROW_SD / (1 - TURN * wide) ** 2
    np.testing.assert_array_less(np.abs(along + 0.5 * w[:, 1] ** 2), (1 + np.abs(w[:, 1])) * pull + 1e-3)
    apart = uncentred(path).mapped(w)
    assert np.std(ridge_density(apart.z) + apart.log_jacobian) > 100, "the ridge would be none"
    np.testing.assert_allclose(path.to_w(points.z), w, atol=FLOOR)


def test_centring_straightens_the_posterior_of_a_campaign():
    fitted, path = small_fit()
    w = np.random.default_rng(10).normal(size=(4 * BATCH, path.dimension))
    with jax.enable_x64(True):
        spread = [np.std(Target(fitted, p)(w) + 0.5 * np.sum(w**2, axis=1)) for p in (path, uncentred(path))]
    assert spread[0] < spread[1] / 3 and spread[0] < 2, spread


def test_w_keeps_the_curvature_far_from_the_mode():
    """Where a stop scatters by four of its posterior sds more than at the mode, ratios are far wider; not in w."""
    fitted, path = small_fit()
    names = np.array(TWO_MIRROR.names)[path.free[: path.noise]]
    plain, count = uncentred(path), path.noise
    for which in np.flatnonzero(np.char.startswith(names, "stop_sd_deg")):
        w = np.zeros((1, count))
        w[:, which] = 4.0
        conditional = plain.conditional(w)
        # Along the direction of y that this stop sd widens most.
        factor = conditional.own[0][::-1, ::-1]
        values, vectors = np.linalg.eigh(factor @ factor.T)
        assert values[0] < 0.3
        aside, curvature = 0.25 * vectors[:, 0], []
        centre = conditional.located(np.zeros((1, path.dimension - count)))[0]
        y = np.concatenate([np.repeat(w, 3, axis=0), centre + np.outer([-1, 0, 1], aside)], axis=1)
        with jax.enable_x64(True):
            inside = plain.to_w(plain.from_whitened(y))
            step = np.diff(inside, axis=0)[0]
            value = Target(fitted, plain)(inside)
        curvature = -(np.array([1, -2, 1]) @ value)
        # Of the linearised campaign; the true one is bent.
        assert 0.5 < curvature / (step @ step) < 2, (which, curvature)
        assert curvature / (aside @ aside) < 0.5, (which, curvature)


def test_a_density_without_value_is_refused_and_counted(x64, monkeypatch):
    dimension, count = 2, BATCH + 5
    path = route()
    w = np.random.default_rng(11).normal(size=(count, dimension))
    without = np.array([0, 7, count - 1])
    w[without, 1] = 1000.0

    def evaluate(z, normal, space, arrays):
        value = jnp.where(z[:, RATIO] > 50, jnp.nan, 5.0 - z[:, BACKLASH])
        return SimpleNamespace(log_density=value, place_errors_rad=normal)

    monkeypatch.setattr("tvsbayes.posterior.target.evaluate", evaluate)
    target = Target(SimpleNamespace(space=None, arrays=no_places(), log_density=2.0), path)
    value = target(w)
    expected = (5.0 - w[:, 0]) - 2.0 + path.mapped(w).log_jacobian
    expected[without] = -np.inf
    np.testing.assert_array_equal(value, expected)
    assert target.invalid == len(without), "the filling of the last batch is no evaluation"
    target(w)
    assert target.invalid == 2 * len(without)


def test_the_map_of_a_play_near_zero_is_exact():
    """Measured below zero, where none is: a normal cut at zero, and what follows it. In w it is standard normal."""
    path = play_near_zero()
    w = np.random.default_rng(17).normal(size=(400, 2))
    w[:4, 0] = -5.0, -4.0, 4.0, 5.0
    points = path.mapped(w)
    assert stats.norm.cdf(path.mode[BACKLASH]) < 0.1, "the play is not near zero"
    density = play_density(points.z) + points.log_jacobian + 0.5 * np.sum(w**2, axis=1)
    # The mode is good to 1e-7, with slopes of 1 / sd = 12; laws of tails to 1e-9.
    assert np.ptp(density) < 1e-5, np.ptp(density)
    np.testing.assert_allclose(path.to_w(points.z), w, atol=1e-7)


def test_an_indefinite_precision_is_raised_and_the_others_stay():
    """The map exists at every draw; draws beside one far out are those without it, to the last bit."""
    root = np.random.default_rng(8).standard_normal((4, 5, 5))
    precisions = root @ np.swapaxes(root, 1, 2) + np.eye(5)
    precisions[1] -= 20 * np.eye(5)
    precisions[:, -1, -1] = FAR_ABOVE
    precisions[3, 2, 0] = np.nan
    factors = positive_factor(precisions)
    assert np.array_equal(factors[::2], np.linalg.cholesky(precisions[::2]))
    assert np.array_equal(factors[3], np.eye(5))
    raised = (factors[1] @ factors[1].T)[:-1, :-1] - precisions[1, :-1, :-1]
    assert raised == pytest.approx(raised[0, 0] * np.eye(4), abs=1e-12)
    assert np.linalg.eigvalsh(precisions[1, :-1, :-1])[0] + raised[0, 0] == pytest.approx(1.0)

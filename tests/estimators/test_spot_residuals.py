"""Reflections keep lengths and products; whitening is that of the stated covariance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tvsbayes.estimators.campaign_arrays import pixel_covariance
from tvsbayes.estimators.spot_residuals import NoiseScales, Reflection, ToStates
from tvsbayes.instrument.campaign import ordered_spots

pytestmark = pytest.mark.usefixtures("x64")

ROUNDING = 1e-13
"""Of a few dozen operations on numbers of order ten."""


def numbers(rows: np.ndarray) -> tuple:
    """Components (k, n) as the library takes them."""
    return tuple(jnp.asarray(row) for row in rows)


def drawn(components: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((components, 40))


def test_a_reflection_takes_its_direction_to_the_first_axis_and_keeps_products():
    direction, first, second = drawn(5, 1), drawn(5, 2), drawn(5, 3)
    with jax.enable_x64(True):
        reflection = Reflection.of(numbers(direction))
        turned, a, b = (np.stack(reflection.of_many(numbers(v))) for v in (direction, first, second))
    np.testing.assert_allclose(turned[1:], 0.0, atol=ROUNDING)
    np.testing.assert_allclose(turned[0], reflection.first, atol=ROUNDING)
    np.testing.assert_allclose(np.abs(turned[0]), np.linalg.norm(direction, axis=0), rtol=ROUNDING)
    np.testing.assert_allclose(np.sum(a * b, axis=0), np.sum(first * second, axis=0), atol=10 * ROUNDING)


def test_without_a_direction_a_reflection_is_finite_and_still_one():
    """Padding has no slopes: lengths stay, the load is zero, and so is every derivative by the direction."""
    vector = drawn(4, 4)
    with jax.enable_x64(True):
        reflection = Reflection.of(numbers(np.zeros((4, 40))))
        turned = np.stack(reflection.of_many(numbers(vector)))

        def total(direction):
            mirror = Reflection.of(tuple(direction))
            return sum(jnp.sum(part) for part in mirror.of_many(numbers(vector))) + jnp.sum(mirror.first)

        slope = np.asarray(jax.grad(total)(jnp.zeros((4, 40))))
    np.testing.assert_allclose(np.linalg.norm(turned, axis=0), np.linalg.norm(vector, axis=0), rtol=ROUNDING)
    assert np.all(np.asarray(reflection.first) == 0)
    assert np.isfinite(slope).all()


def test_only_two_components_see_the_mirror_angles():
    by_pan, by_tilt, residual = drawn(4, 5), drawn(4, 6), drawn(4, 7)
    with jax.enable_x64(True):
        turn = ToStates.of(numbers(by_pan), numbers(by_tilt))
        slope = np.asarray(turn.slope)
        pan, tilt, turned = (np.stack(turn.of_many(numbers(v))) for v in (by_pan, by_tilt, residual))
    for part, column in ((pan, 0), (tilt, 1)):
        np.testing.assert_allclose(part[:2].T, slope[:, :, column], atol=ROUNDING)
        np.testing.assert_allclose(part[2:], 0.0, atol=ROUNDING)
    # What is left has the length of two components.
    np.testing.assert_allclose(np.sum(turned**2, axis=0), np.sum(residual**2, axis=0), rtol=ROUNDING)


def test_looks_that_scatter_have_unit_noise_in_both_components():
    """Squares are the quadratic form of 1 + slopes diag(variances) slopes^T, whose log determinant is stated."""
    by_pan, by_tilt, residual = drawn(4, 5), drawn(4, 6), drawn(4, 7)
    variance = np.random.default_rng(12).exponential(3.0, (40, 2))
    with jax.enable_x64(True):
        turn = ToStates.of(numbers(by_pan), numbers(by_tilt), jnp.asarray(variance))
        pan, tilt, turned = (np.stack(turn.of_many(numbers(v))) for v in (by_pan, by_tilt, residual))
        in_place = np.stack(turn.in_place(numbers(residual)))
        slope, log_scale = np.asarray(turn.slope), np.asarray(turn.log_scale)
    for part, column in ((pan, 0), (tilt, 1)):
        np.testing.assert_allclose(part[:2].T, slope[:, :, column], atol=ROUNDING)
        np.testing.assert_allclose(part[2:], 0.0, atol=ROUNDING)
    for k in range(40):
        slopes = np.stack([by_pan[:, k], by_tilt[:, k]], axis=1)
        covariance = np.eye(4) + slopes @ np.diag(variance[k]) @ slopes.T
        expected = residual[:, k] @ np.linalg.solve(covariance, residual[:, k])
        # Slopes and variances of order ten lose two digits of the solution.
        assert np.sum(turned[:, k] ** 2) == pytest.approx(expected, rel=100 * ROUNDING)
        assert np.sum(in_place[:, k] ** 2) == pytest.approx(expected, rel=100 * ROUNDING)
        assert log_scale[k] == pytest.approx(-0.5 * np.linalg.slogdet(covariance)[1], rel=100 * ROUNDING)


def test_without_scatter_nothing_changes():
    """Bit for bit."""
    by_pan, by_tilt, residual = (numbers(drawn(4, seed)) for seed in (5, 6, 7))
    with jax.enable_x64(True):
        plain, still = ToStates.of(by_pan, by_tilt), ToStates.of(by_pan, by_tilt, jnp.zeros((40, 2)))
        for one, two in zip(plain.of_many(residual), still.of_many(residual), strict=True):
            np.testing.assert_array_equal(one, two)
        np.testing.assert_array_equal(np.stack(still.in_place(residual)), np.stack(residual))
        np.testing.assert_array_equal(plain.slope, still.slope)
        assert not np.any(still.log_scale)


def test_whitened_differences_have_the_stated_covariance(dozen):
    """D' C^-1 d of pixels is the squared length after whitening, for correlated centres too."""
    spots = ordered_spots(dozen.campaign)
    difference = np.zeros((5, len(dozen.arrays.spots.valid)))
    difference[:4, : len(spots)] = np.random.default_rng(8).standard_normal((4, len(spots)))
    with jax.enable_x64(True):
        unit = jnp.ones(difference.shape[1])
        whitened = np.stack(NoiseScales(unit, unit).whitened(numbers(difference), dozen.arrays.spots))
    for k, spot in enumerate(spots):
        d = difference[:4, k]
        expected = d @ np.linalg.solve(pixel_covariance(spot), d)
        assert np.sum(whitened[:4, k] ** 2) == pytest.approx(expected, rel=1e-12)


def test_what_the_filter_sees_is_smooth_where_a_slope_changes_its_sign():
    """Second differences of the innovations measure the posterior's ridges: a basis that flips would ruin them."""
    by_tilt, residual = drawn(4, 9), drawn(4, 10)
    step = 1e-6
    turned = []
    with jax.enable_x64(True):
        for small in (-step, step):
            by_pan = drawn(4, 11)
            by_pan[0] = small
            turned.append(np.stack(ToStates.of(numbers(by_pan), numbers(by_tilt)).of_many(numbers(residual))))
    # Ten units of a residual per unit of slope: slopes are of order one here, none is shorter than a tenth.
    assert np.max(np.abs(turned[1] - turned[0])) < 100 * 2 * step

"""Reflections keep lengths and products; whitening is that of the stated covariance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tvsbayes.estimators.spot_residuals import NoiseScales, Reflection, ToStates
from tvsbayes.instrument.campaign import ordered_spots

pytestmark = pytest.mark.usefixtures("x64")

ROUNDING = 1e-13
"""Of a few dozen operations on numbers of order ten."""


def numbers(rows) -> tuple:
    """Components (k, n) as the library takes them."""
    return tuple(jnp.asarray(row) for row in rows)


def reflected(direction, *vectors):
    """The first component of the reflected direction, and reflected vectors."""
    reflection = Reflection.of(numbers(direction))
    return reflection.first, *(jnp.stack(reflection.of_many(numbers(v))) for v in vectors)


def turned(by_pan, by_tilt, residual, variance=None):
    """(states, by_pan, by_tilt and residual in their components, residual in place)."""
    states = ToStates.of(numbers(by_pan), numbers(by_tilt), variance)
    components = (jnp.stack(states.of_many(numbers(v))) for v in (by_pan, by_tilt, residual))
    return states, *components, jnp.stack(states.in_place(numbers(residual)))


def drawn(components: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((components, 40))


def check_loads(states, pan, tilt) -> None:
    """Only two components see the mirror angles."""
    for part, column in ((pan, 0), (tilt, 1)):
        np.testing.assert_allclose(part[:2].T, states.slope[:, :, column], atol=ROUNDING)
        np.testing.assert_allclose(part[2:], 0.0, atol=ROUNDING)


def test_a_reflection_takes_its_direction_to_the_first_axis_and_keeps_products():
    direction, one, other = drawn(5, 1), drawn(5, 2), drawn(5, 3)
    first, along, a, b = reflected(direction, direction, one, other)
    np.testing.assert_allclose(along[1:], 0.0, atol=ROUNDING)
    np.testing.assert_allclose(along[0], first, atol=ROUNDING)
    np.testing.assert_allclose(np.abs(along[0]), np.linalg.norm(direction, axis=0), rtol=ROUNDING)
    np.testing.assert_allclose(np.sum(a * b, axis=0), np.sum(one * other, axis=0), atol=10 * ROUNDING)


def test_without_a_direction_a_reflection_is_finite_and_still_one():
    """Padding has no slopes: lengths stay, the load is zero, and so is every derivative by the direction."""
    vector, none = drawn(4, 4), np.zeros((4, 40))
    first, image = reflected(none, vector)
    slope = jax.grad(lambda direction: sum(map(jnp.sum, reflected(direction, vector))))(none)
    np.testing.assert_allclose(np.linalg.norm(image, axis=0), np.linalg.norm(vector, axis=0), rtol=ROUNDING)
    assert np.all(np.asarray(first) == 0)
    assert np.isfinite(slope).all()


def test_only_two_components_see_the_mirror_angles():
    by_pan, by_tilt, residual = drawn(4, 5), drawn(4, 6), drawn(4, 7)
    states, pan, tilt, left, _ = turned(by_pan, by_tilt, residual)
    check_loads(states, pan, tilt)
    # What is left has the length of two components.
    np.testing.assert_allclose(np.sum(left**2, axis=0), np.sum(residual**2, axis=0), rtol=ROUNDING)


def test_looks_that_scatter_have_unit_noise_in_both_components():
    """Squares are the quadratic form of 1 + slopes diag(variances) slopes^T, whose log determinant is stated."""
    by_pan, by_tilt, residual = drawn(4, 5), drawn(4, 6), drawn(4, 7)
    variance = np.random.default_rng(12).exponential(3.0, (40, 2))
    states, pan, tilt, *both = turned(by_pan, by_tilt, residual, jnp.asarray(variance))
    check_loads(states, pan, tilt)
    for k in range(40):
        slopes = np.stack([by_pan[:, k], by_tilt[:, k]], axis=1)
        covariance = np.eye(4) + slopes @ np.diag(variance[k]) @ slopes.T
        expected = residual[:, k] @ np.linalg.solve(covariance, residual[:, k])
        # Slopes and variances of order ten lose two digits of the solution.
        for part in both:
            assert np.sum(part[:, k] ** 2) == pytest.approx(expected, rel=100 * ROUNDING)
        assert states.log_scale[k] == pytest.approx(-0.5 * np.linalg.slogdet(covariance)[1], rel=100 * ROUNDING)


def test_without_scatter_nothing_changes():
    """Bit for bit."""
    drawn_ones = [drawn(4, seed) for seed in (5, 6, 7)]
    plain, still = turned(*drawn_ones), turned(*drawn_ones, jnp.zeros((40, 2)))
    for one, two in zip(plain[1:], still[1:], strict=True):
        np.testing.assert_array_equal(two, one)
    np.testing.assert_array_equal(still[-1], drawn_ones[-1])
    assert not np.any(still[0].log_scale)


def test_whitened_differences_have_the_stated_covariance(dozen):
    """D' C^-1 d of pixels is the squared length after whitening, for correlated centres too."""
    spots = ordered_spots(dozen.campaign)
    difference = np.zeros((5, len(dozen.arrays.spots.valid)))
    difference[:4, : len(spots)] = np.random.default_rng(8).standard_normal((4, len(spots)))
    unit = jnp.ones(difference.shape[1])
    whitened = np.stack(NoiseScales(unit, unit).whitened(numbers(difference), dozen.arrays.spots))
    for k, spot in enumerate(spots):
        d = difference[:4, k]
        expected = d @ np.linalg.solve(spot.pixel_covariance(), d)
        assert np.sum(whitened[:4, k] ** 2) == pytest.approx(expected, rel=1e-12)


def test_what_the_filter_sees_is_smooth_where_a_slope_changes_its_sign():
    """Second differences of the innovations measure the posterior's ridges: a basis that flips would ruin them."""
    by_tilt, residual = drawn(4, 9), drawn(4, 10)
    step = 1e-6
    sides = []
    for small in (-step, step):
        by_pan = drawn(4, 11)
        by_pan[0] = small
        sides.append(np.asarray(turned(by_pan, by_tilt, residual)[3]))
    # Ten units of a residual per unit of slope: slopes are of order one here, none is shorter than a tenth.
    assert np.max(np.abs(sides[1] - sides[0])) < 100 * 2 * step

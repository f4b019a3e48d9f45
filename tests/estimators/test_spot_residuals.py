"""Reflections keep lengths and products; whitening is that of the stated covariance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tvsbayes.estimators.spot_residuals import Reflection, ToStates

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


def test_without_a_direction_a_reflection_is_finite_and_still_one():
    """Padding has no slopes: lengths stay, the load is zero, and so is every derivative by the direction."""
    vector, none = drawn(4, 4), np.zeros((4, 40))
    first, image = reflected(none, vector)
    slope = jax.grad(lambda direction: sum(map(jnp.sum, reflected(direction, vector))))(none)
    np.testing.assert_allclose(np.linalg.norm(image, axis=0), np.linalg.norm(vector, axis=0), rtol=ROUNDING)
    assert np.all(np.asarray(first) == 0)
    assert np.isfinite(slope).all()


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

"""A stage's reduced residuals against all of them, and where a stage without a step ends."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tvsbayes.estimators.annealed_stage import NO_STEP, Fixed, innovations, reduced_residuals, stage
from tvsbayes.estimators.likelihood import innovations as innovations_of
from tvsbayes.estimators.likelihood import no_draw
from tvsbayes.estimators.linear_spots import linear_spots, linearise, stop_information
from tvsbayes.instrument.parameters import NAMES, NOISE_NAMES

pytestmark = pytest.mark.usefixtures("x64")

NOISE = np.isin(NAMES, NOISE_NAMES)
ALGEBRA = 1e-9
"""Relative: products of a dozen spots, of numbers up to 1e4, in another order."""


@pytest.fixture(scope="module")
def point(dozen):
    """A point beside the truth with the noise scales held there."""
    z = dozen.z + 0.3 * np.random.default_rng(62).standard_normal(len(NAMES))
    return z, Fixed(NOISE, z, np.array(1.0))


def test_innovations_are_those_of_the_density(dozen, point):
    """The same filter as the density's: its standardised errors, at the mean errors of the gears' places."""
    z, _ = point
    with jax.enable_x64(True):
        lin = jax.jit(linearise)(jnp.asarray(z), dozen.space, dozen.arrays)
        found = np.asarray(jax.jit(innovations)(lin, dozen.arrays))
        model, still = dozen.space.model(jnp.asarray(z)), no_draw(1, dozen.arrays)[0]
        seen = jax.tree.map(np.asarray, jax.jit(innovations_of)(model, dozen.arrays, still))
    found = found[:, 0] + found[:, 1 + len(z) :] @ seen.places
    np.testing.assert_allclose(found, seen.standardised.ravel(), atol=ALGEBRA * np.abs(seen.standardised).max())


def test_reduced_residuals_have_length_slope_and_curvature_of_all(dozen, point):
    """Against the smoother in NumPy: r'C^-1 r + z'z, J'C^-1 r and J'C^-1 J + 1, held coordinates without a part."""
    z, fixed = point
    moved = z + np.where(NOISE, 0.0, 0.1)
    with jax.enable_x64(True):
        found = jax.jit(reduced_residuals)(jnp.asarray(moved), (dozen.space, dozen.arrays, fixed))
        lin = found.also.of_spots(len(dozen.campaign.spots))
    jacobian = np.where(NOISE, 0.0, -lin.residual_jacobian)
    whole = stop_information(linear_spots(lin, dozen.arrays, jacobian))
    residual = lin.residual.reshape(-1)
    solved = np.concatenate([group.residual for group in whole.groups])
    prior = np.where(NOISE, 0.0, moved)
    value, root = np.asarray(found.value), np.asarray(found.jacobian)
    assert value @ value == pytest.approx(residual @ solved + prior @ prior, rel=ALGEBRA)
    slope = -jacobian.reshape(-1, len(NAMES)).T @ solved + prior
    np.testing.assert_allclose(root.T @ value, slope, atol=ALGEBRA * np.abs(slope).max())
    curvature = whole.fisher + np.eye(len(NAMES))
    np.testing.assert_allclose(root.T @ root, curvature, atol=ALGEBRA * np.abs(curvature).max())


def test_a_stage_without_a_step_is_the_linearisation(dozen, point):
    z, fixed = point
    stayed = stage(z, dozen.space, dozen.arrays, fixed, np.array(NO_STEP))
    with jax.enable_x64(True):
        here = jax.jit(linearise)(jnp.asarray(z), dozen.space, dozen.arrays)
    assert np.array_equal(stayed.z, z)
    for name in ("residual", "slope", "residual_jacobian", "predicted_jacobian", "stop_variance"):
        expected = np.asarray(getattr(here, name))
        np.testing.assert_allclose(getattr(stayed, name), expected, atol=1e-12 * max(np.abs(expected).max(), 1e-30))

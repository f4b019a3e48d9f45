"""A stage's reduced residuals against all of them, and where a stage without a step ends."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from support.dense_likelihood import angle_covariances, physical, residual_covariance
from support.dozen_algebra import NOISE, found_at
from support.varying_gears import perfect_gears

from tvsbayes.estimators.annealed_stage import linearised_at
from tvsbayes.estimators.campaign_arrays import campaign_arrays
from tvsbayes.estimators.linear_spots import linear_spots, stop_information
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.parameters import LOOK_SCATTER_NAMES, NAMES

pytestmark = [pytest.mark.thorough, pytest.mark.usefixtures("x64")]

ALGEBRA = 1e-9
"""Relative: products of a dozen spots, of numbers up to 1e4, in another order."""


def beside(dozen) -> np.ndarray:
    """A point beside the truth, where looks scatter."""
    z = dozen.z + 0.3 * np.random.default_rng(62).standard_normal(len(NAMES))
    return np.where(np.isin(NAMES, LOOK_SCATTER_NAMES), 1.0, z)


@pytest.fixture(scope="module")
def point(dozen, evaluate):
    with jax.enable_x64(True):
        return SimpleNamespace(z=beside(dozen), **vars(found_at(evaluate, dozen, beside(dozen))))


def test_squares_are_the_quadratic_form_of_the_dense_gaussian(dozen, point):
    """And the prior's: with stop errors, scatter of looks and errors at places, as in the density."""
    count = len(ordered_spots(dozen.campaign))
    residual, slope = point.terms.residual[:count].ravel(), point.terms.slope[:count]
    covariance = residual_covariance(angle_covariances(dozen.campaign, physical(point)), slope)
    value, prior = point.reduced.value, np.where(NOISE, 0.0, point.z)
    squares = residual @ np.linalg.solve(covariance, residual) + prior @ prior
    # Dense solves of a covariance of condition 1e8.
    assert value @ value == pytest.approx(squares, rel=1e-7)


def test_reduced_residuals_have_length_slope_and_curvature_of_all(dozen, point):
    """Against the smoother in NumPy: r'C^-1 r + z'z, J'C^-1 r and J'C^-1 J + 1, held coordinates without a part."""
    lin = point.reduced.also
    jacobian = np.where(NOISE, 0.0, -lin.residual_jacobian)
    whole = stop_information(linear_spots(lin, dozen.arrays, jacobian))
    residual = lin.residual.reshape(-1)
    solved = np.concatenate([group.residual for group in whole.groups])
    prior = np.where(NOISE, 0.0, point.z)
    value, root = point.reduced.value, point.reduced.jacobian
    assert value @ value == pytest.approx(residual @ solved + prior @ prior, rel=ALGEBRA)
    slope = -jacobian.reshape(-1, len(NAMES)).T @ solved + prior
    np.testing.assert_allclose(root.T @ value, slope, atol=ALGEBRA * np.abs(slope).max())
    curvature = whole.fisher + np.eye(len(NAMES))
    np.testing.assert_allclose(root.T @ root, curvature, atol=ALGEBRA * np.abs(curvature).max())


def test_gears_that_repeat_no_error_leave_residuals_and_derivatives_alone(dozen, point):
    arrays = campaign_arrays(dozen.campaign, perfect_gears(dozen.campaign.rig))
    stayed = linearised_at(point.z, dozen.space, arrays)
    assert np.array_equal(stayed.z, point.z)
    for name in ("residual", "slope", "residual_jacobian", "predicted_jacobian", "stop_variance"):
        expected = getattr(point.reduced.also, name)
        np.testing.assert_allclose(getattr(stayed, name), expected, atol=1e-12 * max(np.abs(expected).max(), 1e-30))

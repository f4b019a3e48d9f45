"""Noise scales with geometry and cameras integrated out: against a dense Gaussian, beside the joint mode."""

from __future__ import annotations

import numpy as np
import pytest
from support.dense_spots import dense_covariance

from tvsbayes.estimators.annealed_stage import linearised_at
from tvsbayes.estimators.linear_spots import linear_spots
from tvsbayes.estimators.noise_scales import MarginalScales, noise_draws
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import LOOK_SCATTER_NAMES, names_of
from tvsbayes.model.parameter_space import physical_at
from tvsbayes.statistics.weighted_draws import effective_draws

STOPS = [TWO_MIRROR.index[name] for name in names_of("stop_sd_deg")]
PIXEL = TWO_MIRROR.index["pixel_scale"]
SCATTER = [TWO_MIRROR.index[name] for name in LOOK_SCATTER_NAMES]


def dense_density(fit, z: np.ndarray) -> float:
    """Log density of the looks at noise scales, up to a constant: one Gaussian of all their residuals."""
    count, lin = len(fit.linearised.residual), linearised_at(z, fit.space, fit.arrays)
    jacobian = lin.by_coordinates(fit.held)
    spots = linear_spots(lin, fit.arrays, jacobian)
    columns = jacobian.reshape(4 * count, -1)
    residual = spots.residual.ravel() + columns @ np.where(fit.held, 0.0, z)
    covariance = dense_covariance(spots) + columns @ columns.T
    # Residuals are in units of the pixel noise; of four components of a look its range takes one.
    scale = 3 * count * np.log(physical_at(z, fit.space).value[PIXEL])
    # These units have the scatter of looks in them: of the unit covariance the pixels have 1 - slope D slope^T.
    slope = np.asarray(lin.slope)
    pixels = np.eye(4) - np.einsum("nia,na,nja->nij", slope, np.asarray(lin.scatter_variance), slope)
    scale -= 0.5 * float(np.sum(np.linalg.slogdet(pixels)[1]))
    prior = 0.5 * float(np.sum(z[fit.held & fit.free] ** 2))
    return -0.5 * (np.linalg.slogdet(covariance)[1] + residual @ np.linalg.solve(covariance, residual)) - scale - prior


@pytest.mark.parametrize("column", [*STOPS, PIXEL, *SCATTER])
def test_the_density_is_that_of_a_dense_gaussian(mixed_fit, column):
    other = mixed_fit.z.copy()
    other[column] += 0.4
    change = np.diff(MarginalScales(mixed_fit)(np.stack([mixed_fit.z, other])))[0]
    # Priors of 1e5 sds of the looks: the dense determinant keeps that many digits.
    assert change == pytest.approx(dense_density(mixed_fit, other) - dense_density(mixed_fit, mixed_fit.z), abs=1e-4)


def test_what_geometry_took_is_given_back(mixed_fit):
    """The centre is a maximum along every scale, and its pixel noise larger than at the mode of everything."""
    draws, alone = noise_draws(mixed_fit, 32, seed=0), MarginalScales(mixed_fit)
    sd = np.sqrt(np.diag(mixed_fit.covariance))
    assert draws.centre[PIXEL] - mixed_fit.z[PIXEL] > 0.3 * sd[PIXEL]
    columns = [*STOPS, PIXEL]
    points = np.repeat(draws.centre[None], 1 + 2 * len(columns), axis=0)
    for row, column in enumerate(columns):
        points[1 + 2 * row : 3 + 2 * row, column] += np.array([0.5, -0.5]) * sd[column]
    values = alone(points)
    assert np.all(values[1:] < values[0])
    assert draws.weights.sum() == pytest.approx(1) and effective_draws(draws.weights) > 8
    still = ~np.isin(np.arange(len(sd)), alone.columns)
    assert np.all(draws.z[:, still] == mixed_fit.z[still])


@pytest.mark.thorough
def test_the_mean_is_that_of_many_more_draws(mixed_fit):
    """A proposal narrower or askew is made good by the weights: within four standard errors of the few."""
    few, many = noise_draws(mixed_fit, 32, seed=1), noise_draws(mixed_fit, 64, seed=2)
    means = [draws.weights @ draws.z[:, PIXEL] for draws in (few, many)]
    sd = np.sqrt(many.weights @ (many.z[:, PIXEL] - means[1]) ** 2)
    assert abs(means[0] - means[1]) < 4 * sd * np.sqrt(sum(1 / effective_draws(draws.weights) for draws in (few, many)))

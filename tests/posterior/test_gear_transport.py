"""The map of a posterior whose gears repeat errors: at any scales the linearised campaign's mean and covariance.

A dozen spots linearised at their truth stand for a fit; the dense side is `support.dense_likelihood`.
"""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.dense_likelihood import angle_covariances, residual_covariance
from support.small_posterior import ROUNDING
from support.varying_gears import PERIODS_DEG, coordinates_with, varying_gears
from tvsbayes.posterior.ridges import unbent

from tvsbayes.estimators.campaign_arrays import campaign_arrays
from tvsbayes.estimators.linear_spots import linear_spots, linearise, stop_information
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.parameters import INDEX, NAMES, NOISE_NAMES, names_of
from tvsbayes.model.parameter_space import coordinates_of, free_mask, parameter_space, physical_at
from tvsbayes.posterior.transport import GEAR_SCALES, Transport

VALUES = {
    **{"transmission_error_deg.pan": 0.04, "transmission_error_deg.tilt": 0.02, "play_variation_deg.pan": 0.03},
    **{"transmission_error_length_deg.pan": 5.0, "transmission_error_length_deg.tilt": 10.0},
    **{"play_variation_deg.tilt": 0.05, "harmonic_amplitude_deg.pan.1": 0.03, "harmonic_amplitude_deg.pan.2": 0.02},
    **{"harmonic_amplitude_deg.tilt.1": 0.04, "drift_deg_per_root_hour.pan": 0.0, "drift_deg_per_root_hour.tilt": 0.0},
}
"""Without drift: few coordinates see it, and the map leaves it out."""


@pytest.fixture(scope="module")
def fitted(dozen) -> SimpleNamespace:
    """What the map reads of a fit."""
    table = varying_gears(dozen.campaign.rig)
    count = len(ordered_spots(dozen.campaign))
    with jax.enable_x64(True):
        space = jax.tree.map(jnp.asarray, parameter_space(table, dozen.campaign.stereo))
        arrays = jax.tree.map(jnp.asarray, campaign_arrays(dozen.campaign, table))
        z = coordinates_of(space, physical_at(dozen.z, dozen.space).value)
        z = coordinates_with(space, z, VALUES)
        lin = jax.jit(linearise)(jnp.asarray(z), space, arrays).of_spots(count)
        information = stop_information(linear_spots(lin, arrays, -lin.residual_jacobian))
    free = free_mask(space, has_aperture=True)
    free[[INDEX[name] for name in names_of("drift_deg_per_root_hour")]] = False
    covariance = np.linalg.inv(np.eye(len(NAMES)) + information.fisher)
    noise = np.isin(NAMES, NOISE_NAMES)
    # Noise scales as wide as a dozen spots leave them.
    covariance[noise], covariance[:, noise] = 0.0, 0.0
    covariance[noise, noise] = 0.3**2
    return SimpleNamespace(
        campaign=dozen.campaign,
        space=space,
        arrays=arrays,
        z=z,
        free=free,
        linearised=lin,
        information=information,
        covariance=covariance,
        mode=SimpleNamespace(physical=physical_at(z, space).value),
    )


@pytest.fixture(scope="module", params=[True, False], ids=["whole", "table"])
def path(request, fitted) -> Transport:
    with pytest.MonkeyPatch.context() as patch:
        if not request.param:
            patch.setattr("tvsbayes.posterior.ridges.STATES_MAX", 0)
        with jax.enable_x64(True):
            found = unbent(fitted)
    places = len(fitted.arrays.gears.places.steps)
    assert (len(found.constant) > 0) == request.param and len(found.states) == len(found.constant) + 2 * places
    return found


def values_at(fitted: SimpleNamespace, z: np.ndarray) -> dict[str, float]:
    """Parameters by name, and the periods, deg."""
    values = dict(zip(NAMES, physical_at(z, fitted.space).value.tolist(), strict=True))
    for axis, periods in PERIODS_DEG.items():
        for number in (1, 2, 3):
            values[f"period_deg.{axis}.{number}"] = (*periods, 360.0, 360.0)[number - 1]
    return values


def dense_density(fitted: SimpleNamespace, path: Transport, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Precision and score of the coordinates y that are no noise scales, by the covariance of all residuals at z."""
    values, mode = values_at(fitted, z), values_at(fitted, fitted.z)
    pixels = values["pixel_scale"] / mode["pixel_scale"]
    others = path.free[len(path.noise) :]
    wide = path.root[len(path.noise) :, len(path.noise) :]
    slope = fitted.linearised.slope / pixels
    covariance = residual_covariance(angle_covariances(fitted.campaign, values), slope)
    jacobian = -fitted.linearised.residual_jacobian.reshape(len(covariance), -1)[:, others] @ wide / pixels
    solved = np.linalg.solve(covariance, jacobian)
    return wide.T @ wide + jacobian.T @ solved, solved.T @ fitted.linearised.residual.ravel() / pixels


def test_the_map_has_mean_and_covariance_of_the_dense_campaign_at_any_scales(fitted, path):
    """Of a map with a table only the gears' scales are followed: stop sds and pixels stay those of the mode."""
    count = len(path.noise)
    followed = np.isin(path.free[path.noise], GEAR_SCALES) | (len(path.constant) > 0)
    at_mode = dense_density(fitted, path, fitted.z)
    for w in 1.5 * np.random.default_rng(13).standard_normal((4, count)) * followed:
        z = path.from_whitened(np.concatenate([w, np.zeros(path.dimension - count)])[None])[0]
        precision, score = dense_density(fitted, path, z)
        found = path.conditional(w[None])
        factor = found.factor[0]
        largest = np.abs(precision).max()
        # Weights of spots span eight decades, and errors at places have a floor of 1e-10 of their variance.
        np.testing.assert_allclose(factor @ factor.T, precision, rtol=0, atol=1e-5 * largest)
        moved = score - at_mode[1]
        np.testing.assert_allclose(factor @ found.shift[0], moved, rtol=0, atol=1e-5 * np.abs(moved).max())
        assert np.abs(precision - at_mode[0]).max() > 0.01 * largest, "the scales are those of the mode"


def test_to_w_undoes_the_map(fitted, path):
    w = np.random.default_rng(14).standard_normal((40, path.dimension))
    mapped = path.mapped(w)
    back = path.to_w(mapped.z)
    widest = np.abs(path.to_w(path.from_whitened(w))).max()
    assert np.abs(back - w).max() < ROUNDING * np.linalg.cond(path.root) * widest * path.dimension
    # At the mode two slopes cancel, each as large as the scores it is made of, by the root's units at most.
    rounded = ROUNDING * path.dimension * np.abs(path.score).max()
    at_mode = path.mapped(np.zeros((1, path.dimension))).z[0][path.free]
    np.testing.assert_allclose(at_mode, fitted.z[path.free], rtol=0, atol=rounded)


def test_the_jacobian_of_the_map_is_what_it_says(path):
    step = 1e-3
    for w in np.random.default_rng(15).standard_normal((2, path.dimension)):
        steps = step * np.eye(path.dimension)
        slopes = (path.mapped(w + steps).z - path.mapped(w - steps).z)[:, path.free].T / (2 * step)
        straight = np.linalg.solve(path.root, slopes)
        sign, log_volume = np.linalg.slogdet(straight)
        found = path.mapped(w[None]).log_jacobian[0]
        # Central differences are good to step^2 of the third derivatives, a few units each.
        assert sign == 1 and log_volume == pytest.approx(found, abs=1e-3)
        assert abs(found) > 1e-2, "nothing is wider than at the mode"

"""Errors that gears repeat by position, and drift: likelihood, draws and normal equations against dense Gaussians.

A dozen spots, linearised; the dense side is written from formulation 3.1 (`support.dense_likelihood`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.dense_likelihood import (
    SENSES,
    RepeatedCovariances,
    angle_covariances,
    dense_log_density,
    physical,
    residual_covariance,
    side,
    stop_labels,
)
from support.varying_gears import PERIODS_DEG, coordinates_with, varying_gears

from tvsbayes.estimators import likelihood
from tvsbayes.estimators.annealed_stage import Fixed, linear_campaign
from tvsbayes.estimators.campaign_arrays import campaign_arrays
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import NOISE_NAMES, names_of
from tvsbayes.model.parameter_space import coordinates_of, parameter_space, physical_at

pytestmark = pytest.mark.usefixtures("x64")

NOISE = np.isin(TWO_MIRROR.names, NOISE_NAMES)
LOG_UNIT = 1.0
"""One unit of log density; a covariance of nearly equal places, factored, leaves 1e-8 of it."""
FINE_UNIT = 1e-8 * LOG_UNIT
ALGEBRA = 1e-7
"""Relative: dense solves of a covariance of condition 1e8."""
BY_AXIS = names_of(
    *("transmission_error_deg", "transmission_error_length_deg", "play_variation_deg", "drift_deg_per_root_hour"),
    "look_scatter_deg",
)
AMPLITUDES_DEG = {
    **{"harmonic_amplitude_deg.pan.1": 0.08, "harmonic_amplitude_deg.pan.2": 0.03},
    **{"harmonic_amplitude_deg.tilt.1": 0.05},
}
SCALES = {
    kind: {name: value * (kind == "periodic") for name, value in AMPLITUDES_DEG.items()}
    | dict(zip(BY_AXIS, values, strict=True))
    for kind, values in {
        "rough": (0.06, 0.03, 1.5, 0.4, 0.04, 0.02, 0.1, 0.3, 0.01, 0.015),
        "smooth": (0.01, 0.2, 40.0, 12.0, 0.15, 0.001, 0.02, 0.0, 0.03, 0.002),
        "periodic": (0.02, 0.02, 5.0, 8.0, 0.03, 0.03, 0.05, 0.05, 0.004, 0.02),
    }.items()
}
"""Pan and tilt of each of `BY_AXIS`, and the amplitudes."""


@dataclass(frozen=True)
class Varying:
    """The dozen spots with gears of which all is estimated; arrays of JAX."""

    campaign: Any
    space: Any
    arrays: Any
    z: np.ndarray


@pytest.fixture(scope="module")
def varying(dozen) -> Varying:
    table = varying_gears(dozen.campaign.rig)
    assert table.harmonic_period_deg == PERIODS_DEG
    with jax.enable_x64(True):
        space = jax.tree.map(jnp.asarray, parameter_space(table, dozen.campaign.stereo))
        arrays = jax.tree.map(jnp.asarray, campaign_arrays(dozen.campaign, table))
        true = physical_at(dozen.z, dozen.space).value
        return Varying(dozen.campaign, space, arrays, coordinates_of(space, true))


def found_at(evaluate, varying: Varying, z: np.ndarray) -> SimpleNamespace:
    """Density and normal equations at a point, whose noise scales are held."""
    reduced = linear_campaign(z, varying.space, varying.arrays, Fixed(NOISE, z, np.array(1.0)))
    return SimpleNamespace(**vars(evaluate(z, varying.space, varying.arrays)), reduced=reduced)


@pytest.fixture(scope="module", params=SCALES)
def point(request, varying, evaluate) -> SimpleNamespace:
    moved = varying.z + np.where(NOISE, 0.0, 0.3 * np.random.default_rng(33).standard_normal(len(TWO_MIRROR.names)))
    with jax.enable_x64(True):
        z = coordinates_with(varying.space, moved, SCALES[request.param])
        evaluated = found_at(evaluate, varying, z)
    values = physical(evaluated)
    for name, value in SCALES[request.param].items():
        assert values[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name
    return SimpleNamespace(z=z, values=values, **vars(evaluated))


def test_log_density_is_that_of_the_dense_gaussian(varying, point):
    dense = dense_log_density(varying.campaign, point)
    assert point.log_likelihood == pytest.approx(dense, abs=FINE_UNIT, rel=1e-10)


def dense_places(varying: Varying, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Prior covariance of errors at the places, rad^2, and what each does to the angles of spots, (2, spots, errors).

    Transmission errors of all places first, then plays, without padding.
    """
    places = jax.tree.map(np.asarray, varying.arrays.gears.places)
    steps, on_tilt = places.steps[places.valid], places.on_tilt[places.valid]
    spots, moves = ordered_spots(varying.campaign), varying.campaign.moves
    size = len(steps)
    covariance, angles = np.zeros((2 * size, 2 * size)), np.zeros((2, len(spots), 2 * size))
    for axis, name in enumerate(SENSES):
        repeated, labels = RepeatedCovariances(values, name), stop_labels(moves, name)
        at_axis = np.flatnonzero(on_tilt == bool(axis))
        for i in at_axis:
            for j in at_axis:
                covariance[i, j] = np.radians(np.radians(repeated.error(steps[i], steps[j])))
                covariance[size + i, size + j] = np.radians(np.radians(repeated.play(steps[i], steps[j])))
            for row, spot in enumerate(spots):
                if getattr(moves[spot.move], f"{name}_steps") == steps[i]:
                    angles[axis, row, i] = 1.0
                    angles[axis, row, size + i] = -side(labels[spot.move][1]) / 2
    return covariance, angles


def test_draws_of_errors_at_places_have_the_conditional_gaussians_moments(varying, point):
    """Mean, and covariance from what each normal number moves: no draw is left to chance."""
    count, places = len(ordered_spots(varying.campaign)), varying.arrays.gears.places
    filled, valid = varying.arrays.gears.filled, np.asarray(places.valid)
    residual, slope = point.terms.residual[:count], point.terms.slope[:count]
    prior, angles = dense_places(varying, point.values)
    load = np.einsum("iua,aie->iue", slope, angles).reshape(4 * count, -1)
    whole = residual_covariance(angle_covariances(varying.campaign, point.values), slope)
    gain = np.linalg.solve(whole, load @ prior).T
    normals = np.concatenate([np.zeros((1, 2 * filled)), np.eye(2 * filled)])
    points = np.repeat(point.z[None], len(normals), axis=0)
    drawn = likelihood.evaluate(points, normals, varying.space, varying.arrays).place_errors_rad
    valid_places = np.tile(valid[:filled], 2)
    mean, moved = drawn[0][valid_places], (drawn[1:] - drawn[0])[:, valid_places]
    scale = np.sqrt(np.diag(prior)) + 1e-12
    np.testing.assert_allclose(mean / scale, gain @ residual.ravel() / scale, atol=ALGEBRA * 100)
    left = prior - gain @ load @ prior
    # Covariances by prior sds; of a scale of zero the floor of 1e-12 rad is left.
    np.testing.assert_allclose(moved.T @ moved / np.outer(scale, scale), left / np.outer(scale, scale), atol=1e-6)
    gears = varying.arrays.gears
    assert gears.columns == 2 * valid.sum() and not np.asarray(gears.share)[:, gears.columns :].any()


def test_a_stage_has_the_normal_equations_of_the_dense_marginal_problem(varying, point):
    """r'C^-1 r + z'z, J'C^-1 r and J'C^-1 J + 1, held coordinates without a part."""
    lin = point.reduced.also
    # The scatter of looks is in the unit noise of the linearised campaign.
    values = {n: 0.0 if n.startswith("look_scatter") else value for n, value in point.values.items()}
    covariance = residual_covariance(angle_covariances(varying.campaign, values), lin.slope)
    residual, jacobian = (
        lin.residual.ravel(),
        np.where(NOISE, 0.0, -lin.residual_jacobian).reshape(-1, len(TWO_MIRROR.names)),
    )
    solved = np.linalg.solve(covariance, np.column_stack([residual, jacobian]))
    prior = np.where(NOISE, 0.0, point.z)
    value, root = point.reduced.value, point.reduced.jacobian
    assert value @ value == pytest.approx(residual @ solved[:, 0] + prior @ prior, rel=ALGEBRA)
    # Of residuals in units of the pixel noise alone, with the scatter in the covariance, the squares are the same.
    count = len(lin.slope)
    pixels, slope = point.terms.residual[:count].ravel(), point.terms.slope[:count]
    covariance = residual_covariance(angle_covariances(varying.campaign, point.values), slope)
    assert value @ value == pytest.approx(pixels @ np.linalg.solve(covariance, pixels) + prior @ prior, rel=ALGEBRA)
    slope = -jacobian.T @ solved[:, 0] + prior
    np.testing.assert_allclose(root.T @ value, slope, atol=ALGEBRA * np.abs(slope).max())
    curvature = jacobian.T @ solved[:, 1:] + np.eye(len(TWO_MIRROR.names))
    np.testing.assert_allclose(root.T @ root, curvature, atol=ALGEBRA * np.abs(curvature).max())


def test_errors_that_the_priors_fix_have_no_column(varying, evaluate):
    """Pan with the same play everywhere, tilt without a transmission error: the density is that of scales of 0."""
    fixed = ("play_variation_deg.pan", "transmission_error_deg.tilt", *names_of("harmonic_amplitude_deg"))
    table = varying_gears(varying.campaign.rig, periods=False)
    exact = {name: replace(table.priors[name], value=0.0, u=0.0) for name in fixed}
    table = replace(table, priors={**table.priors, **exact})
    with jax.enable_x64(True):
        arrays = jax.tree.map(jnp.asarray, campaign_arrays(varying.campaign, table))
        z = coordinates_with(varying.space, varying.z, {**SCALES["rough"], **dict.fromkeys(fixed, 0.0)})
        some, every = (evaluate(z, varying.space, each).log_likelihood for each in (arrays, varying.arrays))
    pan = int(np.sum(arrays.gears.places.valid & ~arrays.gears.places.on_tilt))
    tilt = int(np.sum(arrays.gears.places.valid & arrays.gears.places.on_tilt))
    assert arrays.gears.columns == pan + tilt < varying.arrays.gears.columns == 2 * (pan + tilt)
    # What is left is the floor of 1e-12 rad under every place.
    assert some == pytest.approx(every, abs=1e-9 * LOG_UNIT, rel=1e-12)

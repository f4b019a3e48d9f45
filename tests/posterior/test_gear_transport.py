"""The map of a posterior whose gears repeat errors: at any scales the linearised campaign's mean and covariance.

A dozen spots linearised at their truth stand for a fit; the dense side is `support.dense_likelihood`.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.dense_likelihood import angle_covariances, drawn_at_every_move, residual_covariance
from support.small_posterior import ROUNDING, play_priors
from support.varying_gears import PERIODS_DEG, coordinates_with, varying_gears

from tvsbayes.estimators.annealed_stage import linearised_at
from tvsbayes.estimators.campaign_arrays import campaign_arrays
from tvsbayes.estimators.linear_spots import linear_spots, stop_information
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import LOOK_SCATTER_NAMES, names_of
from tvsbayes.model.parameter_space import coordinates_of, free_mask, parameter_space, physical_at
from tvsbayes.posterior.transport import SCALE_NAMES, WALK_INFORMATION, Transport, transport

pytestmark = pytest.mark.usefixtures("x64")

VALUES = {
    **{"transmission_error_deg.pan": 0.04, "transmission_error_deg.tilt": 0.02, "play_variation_deg.pan": 0.03},
    **{"transmission_error_length_deg.pan": 5.0, "transmission_error_length_deg.tilt": 10.0},
    **{"play_variation_deg.tilt": 0.05, "harmonic_amplitude_deg.pan.1": 0.03, "harmonic_amplitude_deg.pan.2": 0.02},
    **{"harmonic_amplitude_deg.tilt.1": 0.04, "drift_deg_per_root_hour.pan": 0.0, "drift_deg_per_root_hour.tilt": 0.0},
}
"""Without drift, of which the map has no more than the terms that the spots see."""
SCATTER = dict(zip(LOOK_SCATTER_NAMES, (0.01, 0.015), strict=True))
"""Less than the stops' own errors: a variance that scatter of the mode leaves is never below none."""
CREEP = {"creep_deg.pan": 2e-4, "creep_deg.tilt": -1e-4, "creep_minutes": 3.0}
"""So little that the slopes of the model are the same wherever the zeros have crept to: to 1e-5."""


def fit_of(dozen, campaign: Campaign, values: dict[str, float], held: tuple[str, ...], redraw: bool) -> SimpleNamespace:
    """What the map reads of a fit, at values; `redraw`: every look has stop errors of its own."""
    table = varying_gears(campaign.rig)
    with jax.enable_x64(True):
        space = jax.tree.map(jnp.asarray, parameter_space(table, campaign.stereo))
        arrays = jax.tree.map(jnp.asarray, campaign_arrays(campaign, table))
        if redraw:
            arrays = drawn_at_every_move(campaign, arrays)
        z = coordinates_of(space, physical_at(dozen.z, dozen.space).value)
        z = coordinates_with(space, z, values)
        lin = linearised_at(z, space, arrays)
        information = stop_information(linear_spots(lin, arrays, -np.asarray(lin.residual_jacobian)))
    free = free_mask(space, has_aperture=True)
    free[[TWO_MIRROR.index[name] for name in held]] = False
    covariance = np.linalg.inv(np.eye(len(TWO_MIRROR.names)) + information.fisher)
    noise = np.isin(TWO_MIRROR.names, SCALE_NAMES)
    # Scales as wide as a dozen spots leave them.
    covariance[noise], covariance[:, noise] = 0.0, 0.0
    covariance[noise, noise] = 0.3**2
    return SimpleNamespace(
        campaign=campaign,
        names=TWO_MIRROR.names,
        space=space,
        arrays=arrays,
        z=z,
        free=free,
        linearised=lin,
        information=information,
        covariance=covariance,
        mode=SimpleNamespace(physical=physical_at(z, space).value),
        persistent=not redraw,
    )


@pytest.fixture(scope="module")
def fitted(dozen) -> SimpleNamespace:
    """Of looks that do not scatter."""
    values = VALUES | CREEP | dict.fromkeys(LOOK_SCATTER_NAMES, 0.0)
    held = (*names_of("drift_deg_per_root_hour"), *LOOK_SCATTER_NAMES)
    return fit_of(dozen, dozen.campaign, values, held, redraw=False)


@pytest.fixture(scope="module")
def path(fitted) -> Transport:
    chart = transport(fitted)
    assert (
        chart.noise > 10
        and chart.narrow
        and chart.linear.places.shape[1] == fitted.arrays.gears.without_padding().columns > 0
    )
    return chart


@pytest.fixture(scope="module")
def scattered(dozen) -> SimpleNamespace:
    """Of looks that scatter, each at a stop of its own; pixel noise held, no creep."""
    first = {spot.move: spot for spot in reversed(dozen.campaign.spots)}
    campaign = replace(dozen.campaign, spots=tuple(first[move] for move in sorted(first)))
    held = (*names_of("drift_deg_per_root_hour", "creep_deg", "creep_minutes"), "pixel_scale")
    return fit_of(dozen, campaign, VALUES | SCATTER, held, redraw=True)


def values_at(fitted: SimpleNamespace, z: np.ndarray) -> dict[str, float]:
    """Parameters by name, and the periods, deg."""
    values = dict(zip(TWO_MIRROR.names, physical_at(z, fitted.space).value.tolist(), strict=True))
    for axis, periods in PERIODS_DEG.items():
        for number in (1, 2, 3):
            values[f"period_deg.{axis}.{number}"] = (*periods, 360.0, 360.0)[number - 1]
    return values


def dense_density(fitted: SimpleNamespace, path: Transport, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Precision and score of the coordinates y that are no scales, by the covariance of all residuals at z."""
    values, mode, at = values_at(fitted, z), values_at(fitted, fitted.z), fitted.linearised
    if fitted.free[TWO_MIRROR.index["creep_minutes"]]:
        # The model itself at another time constant.
        only = np.where(np.arange(len(TWO_MIRROR.names)) == TWO_MIRROR.index["creep_minutes"], z, fitted.z)
        at = linearised_at(only, fitted.space, fitted.arrays)
    pixels = values["pixel_scale"] / mode["pixel_scale"]
    others = path.free[path.noise :]
    wide = path.root[path.noise :, path.noise :]
    slope = fitted.linearised.slope / pixels
    without = values | dict.fromkeys(LOOK_SCATTER_NAMES, 0.0)
    angles = angle_covariances(fitted.campaign, without, persistent=fitted.persistent)
    # Slopes are in units of a look's noise at the mode, its scatter included: what the scatter is more there comes on.
    for axis, name in enumerate(LOOK_SCATTER_NAMES):
        angles[axis] += np.radians(np.radians(values[name] ** 2 - mode[name] ** 2)) * np.eye(len(slope))
    covariance = residual_covariance(angles, slope)
    jacobian = -np.asarray(at.residual_jacobian).reshape(len(covariance), -1)[:, others] @ wide / pixels
    solved = np.linalg.solve(covariance, jacobian)
    prior = (wide.T * play_priors(path)[0]) @ wide
    return prior + jacobian.T @ solved, solved.T @ np.asarray(at.residual).ravel() / pixels


def check_dense(fitted: SimpleNamespace, path: Transport, least: float) -> None:
    """Precision and mean of the map at drawn noise scales; they move the former by `least` of its largest entry."""
    count, wide = path.noise, path.root[path.noise :, path.noise :]
    at_mode = dense_density(fitted, path, fitted.z)
    for w in 1.5 * np.random.default_rng(13).standard_normal((4, count)):
        z = path.from_whitened(np.concatenate([w, np.zeros(path.dimension - count)])[None])[0]
        precision, score = dense_density(fitted, path, z)
        conditional = path.conditional(w[None])
        # From the narrowest on, in the map.
        factor, shift = conditional.own[0], conditional.shift[0]
        largest = np.abs(precision).max()
        # Weights of spots span eight decades, and errors at places have a floor of 1e-10 of their variance.
        np.testing.assert_allclose((factor @ factor.T)[::-1, ::-1], precision, rtol=0, atol=1e-5 * largest)
        moved = score - at_mode[1] + wide.T @ play_priors(path)[1]
        np.testing.assert_allclose((factor @ shift)[::-1], moved, rtol=0, atol=1e-5 * np.abs(moved).max())
        assert np.abs(precision - at_mode[0]).max() > least * largest, "the scales are those of the mode"


def test_the_map_has_mean_and_covariance_of_the_dense_campaign_at_any_scales(fitted, path):
    """Scales of pixels, stops, gears, play and the time constant of a creep together."""
    assert path.linear.pixels.sum() == 1 and np.isin(LOOK_SCATTER_NAMES, path.names).sum() == 0
    check_dense(fitted, path, 0.01)


def test_a_creep_moves_the_map_with_its_time_constant(fitted, path):
    """Of the time constant alone."""
    one, other = (
        path.conditional(w[None]).own[0] for w in (2.0 * path.linear.creep.scaled, 0.0 * path.linear.creep.scaled)
    )
    precision, at_mode = one @ one.T, other @ other.T
    assert path.linear.creep.scaled.sum() == 1 and np.abs(precision - at_mode).max() > 0.01 * np.abs(at_mode).max()


def test_looks_that_scatter_more_or_less_than_at_the_mode(scattered):
    """Where every look has a stop of its own the scatter adds to its error: the map is exact."""
    path = transport(scattered)
    names = path.names[: path.noise]
    assert set(LOOK_SCATTER_NAMES) <= set(names) and path.linear.pixels.sum() == 0
    check_dense(scattered, path, 0.01)
    # Of scatter alone.
    for axis, name in zip(AXES, LOOK_SCATTER_NAMES, strict=True):
        w = np.where(names == name, 3.0, 0.0)[None]
        one, other = (path.conditional(each).own[0] for each in (w, 0 * w))
        assert np.abs(one @ one.T - other @ other.T).max() > 1e-3, axis


@pytest.mark.parametrize(("information", "share"), [(1e-6, 1e-5), (WALK_INFORMATION, 0.2)])
def test_a_drift_takes_from_the_map_what_it_takes_from_the_dense_campaign(dozen, monkeypatch, information, share):
    """All of it by all terms; but for a fifth by those that the spots see."""
    monkeypatch.setattr("tvsbayes.posterior.transport.WALK_INFORMATION", information)
    drift = dict.fromkeys(names_of("drift_deg_per_root_hour"), 0.3)
    held = (*LOOK_SCATTER_NAMES, *CREEP)
    fitted = fit_of(dozen, dozen.campaign, VALUES | dict.fromkeys(LOOK_SCATTER_NAMES, 0.0) | drift, held, redraw=False)
    path = transport(fitted)
    dense, _ = dense_density(fitted, path, fitted.z)
    without = np.array(fitted.mode.physical)
    without[TWO_MIRROR.columns("drift_deg_per_root_hour")] = 0.0
    still = transport(SimpleNamespace(**{**vars(fitted), "mode": SimpleNamespace(physical=without)}))
    paths = (path, replace(path, linear=replace(path.linear, place_root=still.linear.place_root)))
    factors = [each.conditional(np.zeros((1, path.noise))).own[0] for each in paths]
    drifting, still = ((factor @ factor.T)[::-1, ::-1] for factor in factors)
    assert np.abs(drifting - dense).max() < share * np.abs(still - dense).max()


def test_products_of_a_creep_are_those_of_the_covariance_of_all_others(dozen):
    """Scatter of looks and creep at once: of two covariances the Schur complement need not be positive."""
    held = names_of("drift_deg_per_root_hour")
    path = transport(fit_of(dozen, dozen.campaign, VALUES | SCATTER | CREEP, held, redraw=False))
    linear, noise = path.linear, 1.5 * np.random.default_rng(15).standard_normal((3, path.noise))
    inner = linear.looks.inner(np.exp(noise[:, :2]))
    later = linear.creep.later(noise)
    spanned = (linear.looks.shares(inner) @ linear.looks.basis).reshape(inner.shape)
    load, (gram, by_states, _) = linear.looks.load, linear.products(inner, later)
    for one, k in enumerate(spanned):
        moved = load @ (later[one][:, None, None] * linear.creep.rows)
        columns = (linear.columns.reshape(*load.shape[:2], -1) + moved).reshape(len(linear.columns), -1)
        weight = np.eye(4) - load @ k @ np.swapaxes(load, 1, 2)
        weighted = (weight @ columns.reshape(*load.shape[:2], -1)).reshape(columns.shape)
        for product, rows in ((gram[one], columns), (by_states[one], linear.states.load)):
            bound = ROUNDING * len(columns) * np.abs(rows).T @ np.abs(weighted)
            assert (np.abs(product - rows.T @ weighted) <= bound).all()


def test_the_jacobian_of_the_map_is_what_it_says(path):
    step = 1e-3
    for w in np.random.default_rng(15).standard_normal((2, path.dimension)):
        steps = step * np.eye(path.dimension)
        slopes = (path.mapped(w + steps).z - path.mapped(w - steps).z)[:, path.free].T / (2 * step)
        straight = np.linalg.solve(path.root, slopes)
        sign, log_volume = np.linalg.slogdet(straight)
        log_jacobian = path.mapped(w[None]).log_jacobian[0]
        # Central differences are good to step^2 of the third derivatives, a few units each.
        assert sign == 1 and log_volume == pytest.approx(log_jacobian, abs=1e-3)
        assert abs(log_jacobian) > 1e-2, "nothing is wider than at the mode"

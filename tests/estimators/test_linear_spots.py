"""Stop-by-stop information against dense matrices and brute-force removal."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from support.dense_spots import dense_covariance

from tvsbayes.estimators.likelihood import evaluate, no_draw
from tvsbayes.estimators.linear_spots import (
    LinearSpots,
    leave_one_out_chi2,
    standard_deviations_without,
    stop_information,
)
from tvsbayes.model.compiled import BATCH
from tvsbayes.posterior.predictive import move_log_density

DENSE = 1e-8
"""Relative agreement with dense algebra: condition numbers of 1e4 leave 1e-12."""
PARAMETERS = 5


def stop_of_looks(stops: int = 7) -> np.ndarray:
    """Stop of each look of `campaign`: one, two, three looks at a stop in turn, shape (n,)."""
    return np.repeat(np.arange(stops), 1 + np.arange(stops) % 3)


def campaign(seed: int = 1, stops: int = 7, places: int = 0) -> LinearSpots:
    """Random loads and Jacobians in two segments; looks share stops, stop errors outlive moves of the other axis.

    Zeros walk between stops; errors at places are seen by all looks.
    """
    rng = np.random.default_rng(seed)
    renewed, variance = [], []
    stop_of_look = stop_of_looks(stops)
    for stop in range(stops):
        segment = stop in (0, 4)
        row = np.zeros(6, bool)
        # Pan and tilt take turns: the stop error of the axis at rest is held.
        row[:2] = True if segment else (stop % 2 == 0, stop % 2 == 1)
        row[2:] = segment
        # Home offsets only after the first segment; unknown play as unit states.
        values = np.array([*rng.uniform(0.5, 3.0, 2), *([0.4, 0.4] if stop >= 4 else [0.0, 0.0]), 1.0, 1.0])
        values = np.where(row, values, 0.0)
        values[2:4] += rng.uniform(0.05, 0.2, 2)
        for look in range(np.sum(stop_of_look == stop)):
            renewed.append(row if look == 0 else np.zeros(6, bool))
            variance.append(values if look == 0 else np.zeros(6))
    n = len(stop_of_look)
    slope = 3.0 * rng.standard_normal((n, 4, 2))
    play_sd = np.where(stop_of_look >= 4, rng.uniform(0.1, 0.5, n), 0.0)
    return LinearSpots(
        residual=2.0 * rng.standard_normal((n, 4)),
        load=np.concatenate([slope, slope, slope * play_sd[:, None, None]], axis=2),
        renewed=np.array(renewed),
        variance=np.array(variance),
        jacobian=rng.standard_normal((n, 4, PARAMETERS)),
        places=rng.standard_normal((n, 4, places)),
    )


def rows_of(part: slice) -> slice:
    return slice(4 * part.start, 4 * part.stop)


@pytest.mark.parametrize(("seed", "places"), [(1, 0), (2, 1), (3, 6)])
def test_groups_hold_the_dense_quantities(seed, places):
    """Residual u = [C^-1 r], [C^-1 J], the diagonal blocks of C^-1, and J^T C^-1 J."""
    spots = campaign(seed, places=places)
    precision = np.linalg.inv(dense_covariance(spots))
    jacobian = spots.jacobian.reshape(-1, PARAMETERS)
    information = stop_information(spots)
    np.testing.assert_allclose(information.fisher, jacobian.T @ precision @ jacobian, rtol=DENSE, atol=DENSE)
    stops = stop_of_looks()
    assert [g.rows for g in information.groups] == [
        slice(*(np.flatnonzero(stops == stop)[[0, -1]] + [0, 1])) for stop in np.unique(stops)
    ]
    for group in information.groups:
        rows = rows_of(group.rows)
        np.testing.assert_allclose(group.residual, precision[rows] @ spots.residual.ravel(), rtol=DENSE, atol=DENSE)
        np.testing.assert_allclose(group.jacobian, precision[rows] @ jacobian, rtol=DENSE, atol=DENSE)
        np.testing.assert_allclose(group.precision, precision[rows, rows], rtol=DENSE, atol=DENSE)


def test_leave_one_out_is_the_prediction_by_all_others():
    """Conditional mean and covariance of each spot given the rest, computed by brute force."""
    spots = campaign(places=3)
    covariance, residual = dense_covariance(spots), spots.residual.ravel()
    expected = []
    for k in range(len(spots.residual)):
        one = np.arange(4 * k, 4 * k + 4)
        rest = np.setdiff1d(np.arange(residual.size), one)
        gain = np.linalg.solve(covariance[np.ix_(rest, rest)], covariance[np.ix_(rest, one)]).T
        error = residual[one] - gain @ residual[rest]
        spread = covariance[np.ix_(one, one)] - gain @ covariance[np.ix_(rest, one)]
        expected.append(error @ np.linalg.solve(spread, error))
    np.testing.assert_allclose(
        leave_one_out_chi2(stop_information(spots), np.ones(len(expected))), expected, rtol=DENSE
    )


def test_leave_one_out_of_weighted_spots_is_that_of_full_weight():
    """Robust weights scale a spot's noise; its distance is that at its full weight again."""
    spots = campaign()
    weight = np.random.default_rng(11).uniform(0.2, 1.0, len(spots.residual))
    root = np.sqrt(weight)[:, None]
    weighted = replace(spots, residual=root * spots.residual, load=root[..., None] * spots.load)
    chi2 = leave_one_out_chi2(stop_information(weighted), weight)
    for k in range(len(weight)):
        alone = root.copy()
        alone[k] = 1.0
        full = replace(spots, residual=alone * spots.residual, load=alone[..., None] * spots.load)
        expected = leave_one_out_chi2(stop_information(full), np.ones(len(weight)))[k]
        assert chi2[k] == pytest.approx(expected, rel=DENSE)


def test_standard_deviations_without_a_stop_are_those_of_a_fit_without_it():
    """Priors N(0, 1) on every coordinate; each stop is taken out of the dense problem in turn."""
    spots = campaign(places=3)
    jacobian, covariance_spots = spots.jacobian.reshape(-1, PARAMETERS), dense_covariance(spots)
    information = stop_information(spots)
    posterior = np.linalg.inv(information.fisher + np.eye(PARAMETERS))
    gradients = np.random.default_rng(9).standard_normal((3, PARAMETERS))
    for group in information.groups:
        rows = rows_of(group.rows)
        kept = np.setdiff1d(np.arange(len(jacobian)), np.arange(rows.start, rows.stop))
        rest = jacobian[kept].T @ np.linalg.solve(covariance_spots[np.ix_(kept, kept)], jacobian[kept])
        without = np.linalg.inv(rest + np.eye(PARAMETERS))
        expected = np.sqrt(np.einsum("qi,ij,qj->q", gradients, without, gradients))
        sds = standard_deviations_without(group, posterior, gradients)
        np.testing.assert_allclose(sds, expected, rtol=DENSE)
        assert np.all(sds >= np.sqrt(np.einsum("qi,ij,qj->q", gradients, posterior, gradients)))


def test_sd_is_infinite_where_nothing_else_informs():
    """One stop alone informs a parameter that has no prior."""
    spots = campaign(stops=2)
    jacobian = np.zeros_like(spots.jacobian[..., :1])
    jacobian[stop_of_looks(2) == 1] = 1.0
    spots = replace(spots, jacobian=jacobian)
    information = stop_information(spots)
    sds = standard_deviations_without(information.groups[1], np.linalg.inv(information.fisher), np.ones((1, 1)))
    assert sds[0] > 1e6  # infinite up to rounding of the information, 1e-15


@pytest.mark.parametrize("blamed", [0, 1])
@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_outlier_of_a_stop_is_assigned_to_its_spot(seed, blamed):
    """Two looks at one stop, one of them wrong by 12 sds: the wrong one has the largest distance.

    One-step innovations would name the second look where the first is wrong: the stop error follows the first.
    """
    spots = campaign(seed)
    rng = np.random.default_rng(100 + seed)
    walked = np.cumsum(rng.standard_normal(spots.variance.shape) * np.sqrt(spots.variance), axis=0)
    before = np.concatenate([np.zeros((1, 6)), walked[:-1]])
    last = np.maximum.accumulate(np.where(spots.renewed, np.arange(len(walked))[:, None], 0), axis=0)
    held = walked - np.take_along_axis(before, last, axis=0)
    clean = np.einsum("nks,ns->nk", spots.load, held) + rng.standard_normal(spots.residual.shape)
    pair = np.flatnonzero(stop_of_looks() == 1)
    assert len(pair) == 2
    direction = rng.standard_normal(4)
    direction /= np.linalg.norm(direction)
    wrong = clean.copy()
    wrong[pair[blamed]] += 12.0 * direction
    distance, usual = (
        leave_one_out_chi2(stop_information(replace(spots, residual=each)), np.ones(len(each)))
        for each in (wrong, clean)
    )
    assert np.argmax(distance) == pair[blamed]
    # Median of chi2 with 4 degrees of freedom is 3.4; a clean spot exceeds 30 once in 2e5.
    assert distance[pair[blamed]] > 30 > np.median(usual)


@pytest.mark.thorough
def test_log_density_of_a_move_is_what_the_campaign_loses_without_it(x64, dozen):
    """The log density log p(all) - log p(all but the spots of one move), by taking each move out of the filter in turn.

    Home offsets, unknown play, stop errors that outlive moves of the other axis, two looks at one stop.
    """
    rng = np.random.default_rng(5)
    # As many as a fit evaluates at once: that is compiled.
    z = jnp.asarray(dozen.z + 0.1 * rng.standard_normal((BATCH, dozen.z.size)))
    # Errors at places are given: what others say of them would be lost with a move.
    none = jnp.zeros_like(dozen.arrays.gears.valid)
    dozen = replace(dozen, arrays=eqx.tree_at(lambda a: a.gears.valid, dozen.arrays, none))
    spots = dozen.arrays.spots
    count = int(np.sum(np.asarray(spots.valid)))
    index = np.asarray(spots.move_index)[:count]
    still = no_draw(len(z), dozen.arrays)
    logs = np.asarray(move_log_density(z, still, dozen.space, dozen.arrays))
    assert logs.shape == (len(z), count)
    whole = np.asarray(evaluate(z, still, dozen.space, dozen.arrays).log_density)
    assert len(set(index)) < count
    for move in set(index):
        valid = np.asarray(spots.valid).copy()
        valid[:count][index == move] = 0.0
        rest = eqx.tree_at(lambda a: a.spots.valid, dozen.arrays, jnp.asarray(valid))
        lost = whole - np.asarray(evaluate(z, still, dozen.space, rest).log_density)
        # Sums of a few hundred terms of order 100: rounding leaves 1e-9.
        np.testing.assert_allclose(logs[:, index == move].sum(axis=1), lost, atol=1e-7)

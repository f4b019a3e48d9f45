"""The density of an axis against dense matrices, with held-out rows too; the model without processes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.axes import FIRST_EDITION, campaign, drawn, random_moves, runs

from tvsbayes.gears import places
from tvsbayes.single_axis import axis_model
from tvsbayes.single_axis.axis_campaign import AxisCampaign
from tvsbayes.single_axis.axis_fit import model_of
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_rows import play_places
from tvsbayes.statistics.gaussian_process import JITTER, matern52


def a_campaign(seed: int = 1) -> AxisCampaign:
    """Short legs, stops held, two homings, readings with u, a contrast of the directions that is not about 0."""
    return drawn(seed, random_moves(seed, 36, 3), ratio_contrast=AxisPrior(3e-6, 1e-6)).campaign


def dense(model, w, absolute=False):
    """Covariance and residual of all rows, term by term; an absolute zero walks from the first move on."""
    rows, at = model.rows, {k: float(v[0]) for k, v in model.coordinates.values(w).items()}
    sampled = model.play_is_sampled
    play = play_places(rows, np.array([at["backlash"] if sampled else 0.0]))
    anchor, side, share, path = play.anchor[0], play.side[0], play.share[0], play.path[0]
    slope = rows.line.slope
    x = abs(slope) * rows.command
    same = x[:, None] == x
    k = matern52(x[:, None] - x, at["transmission_error_length"]) + JITTER * same
    total = at["transmission_error"] ** 2 * k + 0.25 * at["play_variation"] ** 2 * k * np.outer(share, share)
    for i in range(len(x)):
        for j in range(len(x)):
            if rows.segment[i] != rows.segment[j] and not absolute:
                continue
            hours = np.cumsum(np.where(rows.segment == rows.segment[i], rows.hours, 0.0))
            hours = rows.time_s / 3600.0 if absolute else hours
            total[i, j] += at["drift_per_root_hour"] ** 2 * min(hours[i], hours[j])
            low, high = sorted((i, j))
            if not rows.redrawn[low + 1 : high + 1].any():
                total[i, j] += at["stop_sd.forward" if rows.side[i] > 0 else "stop_sd.backward"] ** 2
            if rows.segment[i] > 0 and not absolute:
                total[i, j] += at["home_sd"] ** 2
    total += np.diag(at["reading_scale"] ** 2 * rows.variance + (axis_model.FLOOR * rows.travel) ** 2)
    g = anchor - model.middle
    total += rows.travel**2 * axis_model.OFFSET_TRAVELS**2 + model.priors["per_command"].u ** 2 * np.outer(g, g)
    contrast = model.priors["ratio_contrast"]
    total += contrast.u**2 * np.outer(path, path) / 4
    if not sampled:
        total += model.priors["backlash"].u ** 2 * np.outer(side, side) / 4
    if "creep" in model.shifts:
        warmed = 1 - np.exp(-rows.time_s / 60 / at["creep_minutes"])
        total += model.priors["creep"].u ** 2 * np.outer(warmed, warmed)
    residual = rows.value - rows.line.offset - slope * model.middle - model.priors["per_command"].value * g
    residual = residual - 0.5 * contrast.value * path
    return total, residual - (0.5 * side * at["backlash"] if sampled else 0.0)


@pytest.mark.parametrize(("seed", "absolute"), [(1, False), (2, False), (3, False), (1, True), (2, True)])
def test_the_filter_is_the_dense_gaussian(seed, absolute):
    model = model_of(replace(a_campaign(seed), absolute=absolute))
    assert ("home_sd" in model.coordinates.names) is not absolute
    w = 0.4 * np.random.default_rng(seed).standard_normal((4, len(model.coordinates.names)))
    values = model.log_likelihood(w)
    for k in range(4):
        total, residual = dense(model, w[k : k + 1], absolute)
        sign, log_det = np.linalg.slogdet(2 * np.pi * total)
        wanted = -0.5 * (log_det + residual @ np.linalg.solve(total, residual))
        # 36 rows of condition 1e10: the two solutions differ by rounding.
        assert sign > 0 and values[k] == pytest.approx(wanted, rel=1e-8, abs=1e-5)


def test_rows_left_out_are_the_conditional_of_the_dense_gaussian():
    model = model_of(a_campaign(2))
    w = np.zeros((1, len(model.coordinates.names)))
    left = np.array([3, 11, 12, 30])
    predicted = model.left_out(w, left)
    mean, covariance = predicted.mean, predicted.covariance
    total, residual = dense(model, w)
    others = np.setdiff1d(np.arange(len(residual)), left)
    gain = np.linalg.solve(total[np.ix_(others, others)], total[np.ix_(others, left)]).T
    wanted = total[np.ix_(left, left)] - gain @ total[np.ix_(others, left)]
    np.testing.assert_allclose(covariance[0], wanted, rtol=1e-5, atol=1e-10)
    predicted = model.rows.value[left] - residual[left] + gain @ residual[others]
    np.testing.assert_allclose(mean[0], predicted, atol=1e-6)


def test_places_without_rows_are_predicted_from_places_with_rows():
    """Against the conditional of the process, given the posterior at the places of the rows."""
    commands = np.array([-1500.0, 37.0, 1200.0])
    plain, model = model_of(a_campaign()), model_of(a_campaign(), commands)
    w = 0.4 * np.random.default_rng(4).standard_normal((3, len(model.coordinates.names)))
    line, wider_line = plain.linear(w), model.linear(w)
    count, slope = len(plain.places.command), abs(plain.rows.line.slope)
    assert len(model.informed) == plain.columns < model.columns == plain.columns + 2 * len(commands)
    both = np.concatenate((plain.places.command, commands))
    for k, length in enumerate(model.coordinates.values(w)["transmission_error_length"]):
        scale = model.coordinates.values(w)["transmission_error"][k] ** 2
        prior = scale * (matern52(slope * (both[:, None] - both), length) + JITTER * np.eye(len(both)))
        block = slice(plain.processes, plain.processes + count)
        by = np.linalg.solve(prior[:count, :count], prior[:count, count:]).T
        mean = by @ line.mean[k, block]
        left = prior[count:, count:] - by @ prior[:count, count:]
        sd = np.sqrt(np.diag(left + by @ line.covariance[k, block, block] @ by.T))
        functionals = model.functional(commands)
        values, spread = wider_line.mean_of(functionals), wider_line.sd_of(functionals)
        # The nearest places make the prior's matrix nearly singular: its condition is 1 over the jitter at most.
        np.testing.assert_allclose(values[k], mean, atol=1e-6 * sd.max())
        np.testing.assert_allclose(spread[k], sd, rtol=1e-6)
        across = wider_line.covariance[k][: plain.processes, : plain.processes]
        np.testing.assert_allclose(across, line.covariance[k][: plain.processes, : plain.processes], rtol=1e-6)


def test_without_processes_it_is_the_least_squares_line():
    moves = runs(3)
    rng = np.random.default_rng(4)
    side = np.array([-1.0, *np.sign(np.diff([m.command for m in moves]))])
    commands = np.array([m.command for m in moves])
    values = 0.2 + 0.01 * commands - 0.05 * side + 0.004 * rng.standard_normal(len(moves))
    model = model_of(campaign(moves, list(values), ratio_contrast=AxisPrior(0.0, 0.0), **FIRST_EDITION))
    assert model.coordinates.names == ()
    linear = model.linear(np.zeros((1, 0)))
    design = np.column_stack([np.ones(len(side)), commands - model.middle, -0.5 * side])
    solved = np.linalg.lstsq(design, values, rcond=None)[0]
    columns = [axis_model.OFFSET, axis_model.SLOPE, axis_model.BACKLASH]
    sd = 0.004 * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    # The priors of travel and ratio shift the result by less than a hundredth of an sd.
    np.testing.assert_allclose(linear.mean[0, columns], solved, atol=float(0.01 * sd.max()), rtol=1e-6)
    u = np.sqrt(np.diag(linear.covariance[0])[columns])
    np.testing.assert_allclose(u, sd, rtol=0.01)


def test_nodes_agree_with_all_positions(monkeypatch):
    axis = drawn(5).campaign
    exact = model_of(axis)
    w = np.zeros((1, len(exact.coordinates.names)))
    monkeypatch.setattr(places, "PLACES_MAX", 3)
    rough = model_of(axis)
    assert exact.places.exact and not rough.places.exact
    # 41 nodes over a travel of five lengths: 0.3 of 4296, where the scatter is held far too small.
    assert rough.log_likelihood(w)[0] == pytest.approx(exact.log_likelihood(w)[0], rel=2e-4)


def test_a_negated_reading_negates_the_answer():
    axis = drawn(6).campaign
    turned = campaign(axis.moves, [-float(r.value or 0.0) for r in axis.readings], axis.readings[0].u)
    straight = campaign(axis.moves, [float(r.value or 0.0) for r in axis.readings], axis.readings[0].u)
    one, other = model_of(straight), model_of(turned)
    w = np.zeros((1, len(one.coordinates.names)))
    assert one.log_likelihood(w)[0] == pytest.approx(other.log_likelihood(w)[0], abs=1e-6)
    columns = [axis_model.SLOPE, axis_model.BACKLASH]
    np.testing.assert_allclose(one.linear(w).mean[0, columns], other.linear(w).mean[0, columns] * [-1, 1], rtol=1e-6)

"""Predicted readings of an axis: of another campaign, at one state, over a use; by its draws and by cause."""

from __future__ import annotations

import numpy as np
import pytest
from support.compensated import driven, results, to_and_fro, true_axis

from tvsbayes.single_axis.axis_campaign import AxisMove
from tvsbayes.single_axis.axis_rows import rows_of
from tvsbayes.single_axis.predicted_stops import PredictedAxis, longest_use
from tvsbayes.statistics.predicted_readings import State, Use


def test_further_readings_agree_with_their_prediction():
    fit = results().fit
    commands, read = to_and_fro(np.linspace(-17.3, 17.3, 6))
    prediction = PredictedAxis(fit).read(driven(true_axis(), commands, read, 0))
    mean, covariance = prediction.pooled()
    squares = []
    for seed in range(20):
        value = np.array([r.value for r in driven(true_axis(), commands, read, seed).readings])
        off = value - mean
        squares.append(off @ np.linalg.solve(covariance, off) / len(off))
    # Twenty runs share the errors of one table: about 1, within a factor of two.
    assert 0.5 < np.mean(squares) < 2.0
    assert np.all(np.sqrt(np.diag(covariance)) < 0.04)


def test_draws_have_the_moments_of_the_mixture_and_its_density():
    fit = results().fit
    commands, read = to_and_fro(np.array([-5.0, 5.0]))
    prediction = PredictedAxis(fit).read(driven(true_axis(), commands, read, 0))
    mean, covariance = prediction.pooled()
    drawn = prediction.drawn(16000, np.random.default_rng(0))
    sd = np.sqrt(np.diag(covariance))
    # Means of 16000 to a few hundredths of their sd, standard deviations to a few per cent.
    np.testing.assert_allclose(drawn.mean(axis=0), mean, atol=0.04 * sd.min())
    np.testing.assert_allclose(drawn.std(axis=0), sd, rtol=0.05)
    assert prediction.log_density(mean) > prediction.log_density(mean + 3 * sd)
    flat = 1e4 * np.ones((4, 4))
    shifts = prediction.log_density(mean, flat) - prediction.log_density(mean + 1.0, flat)
    assert shifts == pytest.approx(0.0, abs=1e-3)


def test_time_and_travel_since_homing_are_those_of_the_longest_segment():
    moves = [
        AxisMove(0, 0, 0.0, 0.0),
        AxisMove(1, 0, 3600.0, 5.0),
        AxisMove(2, 1, 9000.0, 0.0),
        AxisMove(3, 1, 9001.0, 9.0),
    ]
    assert longest_use(moves) == (1.0, 9.0)


def test_the_parts_of_a_reading_are_those_of_a_whole_campaign():
    """A run predicted stop by stop, and as expected readings at its states plus what does not repeat."""
    machine = PredictedAxis(results().fit)
    commands, read = to_and_fro(np.linspace(-17.3, 17.3, 6))
    whole = machine.read(driven(true_axis(), commands, read, 0))
    rows = rows_of(driven(true_axis(), commands, read, 0))
    use = State(rows.time_s / 3600, rows.path, rows.warm_s / 3600, 0.0)
    parts = machine.expected(rows.command, rows.side, use)
    parts = parts.plus(sum(machine.scatter(rows.side, use, 0.002).values()))
    np.testing.assert_allclose(parts.mean, whole.mean, atol=1e-9)
    np.testing.assert_allclose(parts.covariance, whole.covariance, atol=1e-12)


def test_what_a_state_adds_is_said_by_cause():
    """The sum of all causes is the change of the expected reading, whatever its place."""
    machine = PredictedAxis(results().fit)
    later = State(1.0, 400.0, 2.0, 0.0)
    command, side = np.array([-3.0, 3.0]), np.array([1, -1])
    added = machine.expected(command, side, later).mean - machine.expected(command, side).mean
    shifts = machine.shifts(later, machine.state)
    # In mm there is no contrast of the directions.
    assert set(shifts) == {"creep"}
    np.testing.assert_allclose(sum(each.mean for each in shifts.values()) * np.ones(2), added, atol=1e-9)


def test_states_of_a_use_fill_its_ranges():
    states = Use(2.0, 50.0, np.array([0.0, 5.0]), (-1.0, 3.0)).states(4, 100, np.random.default_rng(0))
    assert np.ptp(states.hours) == pytest.approx(1.98) and np.ptp(states.travel) == pytest.approx(49.5)
    assert np.ptp(states.kelvin) == pytest.approx(3.96) and states.warm_hours.shape == (4, 100)
    np.testing.assert_allclose(states.warm_hours[1] - states.warm_hours[0], 5.0)

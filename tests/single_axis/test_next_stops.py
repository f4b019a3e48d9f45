"""Plans of further stops, and simulated axes."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.axes import campaign, drawn, runs

from tvsbayes.cli.main import run
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.single_axis.axis_campaign import AxisMove, Reading, read_axis
from tvsbayes.single_axis.axis_density import HEADLINE_DRAWS, deviation_functionals, headline_functionals
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_rows import SIDES, reversal_of, rows_of
from tvsbayes.single_axis.next_stops import TARGETS, plan_next
from tvsbayes.twin.simulated_axis import draw_axis, simulate_axis


@pytest.fixture(scope="module")
def fitted():
    return fit_axis(drawn(4, runs(2), backlash=AxisPrior(0.0, 0.1)).campaign, tier="importance")


def test_every_stop_lowers_u_and_stays_within_the_commands(fitted):
    plan = plan_next(fitted, "position", count=3)
    u = [plan.u_now, *(stop.u for stop in plan.next)]
    assert len(plan.next) == 3 and all(after < before for before, after in pairwise(u))
    for stop in plan.next:
        for command in (stop.command, stop.via):
            assert command is None or -2300 <= command <= 2300
    assert plan.plan_bytes().startswith(b"step,command,direction,read\n0,")
    json.dumps(plan.as_json(), allow_nan=False)


LOG = "position_mm,direction,dial_mm\n" + "".join(
    f"{at},{word},{at + (0.1 if word == 'backward' else 0.0) + 0.01 * np.sin(7 * at + run):.4f}\n"
    for run in range(2)
    for word, places in (("forward", range(0, 101, 10)), ("backward", range(100, -1, -10)))
    for at in places
)
"""A log of runs whose turns lie where it does not say: `import` adds moves past both ends."""


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "log.csv"
    path.write_text(LOG)
    assert run(["import", str(path), "--axis", "--to", str(path.parent / "axis"), "--yes"]) == 0
    return read_axis(path.parent / "axis")


def asked(plan) -> list[float]:
    """All commands of a plan."""
    return [command for stop in plan.next for command in (stop.command, stop.via) if command is not None]


def test_no_plan_goes_where_an_import_thought_that_the_axis_was(imported):
    added = [move.command for move in imported.moves if move.assumed]
    assert added and not any(0 <= command <= 100 for command in added)
    fit = fit_axis(imported, tier="importance")
    for target in ("per_command", "position"):
        assert min(asked(plan := plan_next(fit, target))) >= 0 and max(asked(plan)) <= 100 and len(plan.next) == 8


def test_a_plan_stays_within_stated_limits_wherever_the_axis_was(fitted):
    """Whole commands stay whole between limits that are not."""
    fit = replace(fitted, campaign=replace(fitted.campaign, limits=(-1500.4, 900.7)))
    commands = asked(plan_next(fit, "per_command"))
    assert -1500 <= min(commands) < -1300 and max(commands) <= 900
    assert all(command == round(command) for command in commands)


@pytest.mark.thorough
def test_stops_lower_a_play_that_is_sampled_and_none_that_is_held():
    """The play is no linear quantity where moves may be shorter than it."""
    axis = drawn(4, runs(1)).campaign
    fit = fit_axis(axis, tier="importance")
    assert fit.model.play_is_sampled
    plan = plan_next(fit, "backlash", count=2)
    u = [plan.u_now, *(stop.u for stop in plan.next)]
    assert u[0] == pytest.approx(fit.draws["backlash"].std(), rel=0.05)
    assert u[0] > u[1] > u[2] > 0
    held = fit_axis(replace(axis, stated=axis.stated | {"backlash": AxisPrior(0.1, 0.0)}), sampled=False)
    with pytest.raises(NothingToEstimate, match="held"):
        plan_next(held, "backlash", count=1)


def test_a_plan_keeps_its_time(fitted):
    assert plan_next(fitted, minutes=2.0).minutes <= 2.0
    with pytest.raises(InputError):
        plan_next(fitted, "speed")


@pytest.fixture(scope="module")
def turned():
    """A rotary table over a whole turn; read from both sides, 0.4 deg apart."""
    moves = runs(1, (0.0, 90.0, 180.0, 270.0, 360.0), 20.0)
    side = [-1.0, *np.sign(np.diff([m.command for m in moves]))]
    values = [m.command - 0.2 * s + 0.003 * (k % 3) for k, (m, s) in enumerate(zip(moves, side, strict=True))]
    return campaign(moves, values, u=0.002)


@pytest.fixture(scope="module")
def homed(fitted):
    """The same axis, homed since its last reading."""
    moves, last = fitted.campaign.moves, fitted.campaign.moves[-1]
    again = AxisMove(last.move + 1, last.segment + 1, last.time_s + 600.0, last.command)
    return fit_axis(replace(fitted.campaign, moves=(*moves, again)), tier="importance")


@pytest.mark.parametrize("axis", ["fitted", "homed"])
@pytest.mark.parametrize("target", TARGETS)
def test_stops_are_worth_what_the_model_with_their_readings_says(request, axis, target):
    """Of all readings and those before, on the line: a line over the commands read, the drift, the path, a new zero."""
    fitted = request.getfixturevalue(axis)
    campaign, rows = fitted.campaign, fitted.rows
    gap_s = np.median([b.time_s - a.time_s for a, b in pairwise(campaign.moves) if b.time_s > a.time_s])
    moves, readings = list(campaign.moves), list(campaign.readings)
    places = np.unique(np.r_[np.linspace(*campaign.range_allowed, 17).round(), rows.command.min()])

    def variances(rows, w) -> tuple[float, float]:
        """Mean variance given the scales, and that of the means."""
        model = AxisModel.of(replace(rows, line=fitted.rows.line), fitted.model.priors, places)
        model = replace(model, coordinates=fitted.model.coordinates)
        if target == "position":
            functionals = deviation_functionals(model, w, places)
        else:
            functionals = headline_functionals(model, w)[[HEADLINE_DRAWS.index(target)]]
        linear = model.linear(w)
        return np.mean(linear.sd_of(functionals) ** 2), np.mean(linear.mean_of(functionals).var(axis=0))

    few = fitted.w[np.linspace(0, len(fitted.w) - 1, 24).astype(int)]
    (given, between), (before, _) = variances(rows, fitted.w), variances(rows, few)
    for stop in plan_next(fitted, target, count=2).next:
        for command in (stop.command,) if stop.via is None else (stop.via, stop.command):
            moves.append(AxisMove(len(moves), moves[-1].segment, moves[-1].time_s + gap_s, command))
        value = rows.line.offset + rows.line.slope * stop.command
        value -= 0.5 * SIDES[stop.direction] * reversal_of(rows).value
        readings.append(Reading(len(readings), len(moves) - 1, value, readings[0].u))
        after, _ = variances(rows_of(replace(campaign, moves=tuple(moves), readings=tuple(readings))), few)
        # The prior of the offset is at the mean of the commands, which moves with the stop.
        assert stop.u == pytest.approx(np.sqrt(between + given * after / before), rel=1e-9)


def test_simulated_axes_round_trip_and_repeat_by_seed(tmp_path):
    one, other = drawn(9), drawn(9)
    assert one.campaign.readings == other.campaign.readings != drawn(10).campaign.readings
    one.write(tmp_path / "a")
    assert read_axis(tmp_path / "a").readings == one.campaign.readings
    truth = json.loads((tmp_path / "a" / "truth.json").read_text())
    assert truth["parameters"]["per_command"] == 0.01 and len(truth["command"]) == len(truth["error"])


def test_an_axis_without_a_ratio_is_refused():
    moves = runs(1)
    empty = campaign(moves, [0.0] * len(moves))
    with pytest.raises(InputError) as caught:
        simulate_axis(type(empty)("deg", moves, ()))
    assert "per_command" in caught.value.remedy


def test_exact_readings_give_the_distance_of_a_command():
    moves = runs(1, (0.0, 100.0), 0.0)
    simulated = simulate_axis(campaign(moves, [0.02 * m.command for m in moves]))
    # A line through points that lie on it.
    assert simulated.truth.parameters["per_command"] == pytest.approx(0.02, rel=1e-9)


def test_true_play_has_the_stated_mean_and_is_never_negative():
    def true(value, u):
        stated = {"backlash": AxisPrior(value, u)}
        axes = (draw_axis([0.0, 100.0], stated, 0.01, 1.0, np.random.default_rng(seed)) for seed in range(400))
        return np.array([axis.parameters["backlash"] for axis in axes])

    far, near = true(0.5, 0.1), true(0.0, 0.1)
    # Means of 400 numbers of sd 0.1, 0.06 where folded at zero: five standard errors.
    assert far.mean() == pytest.approx(0.5, abs=0.025) and far.std() == pytest.approx(0.1, rel=0.2)
    assert near.mean() == pytest.approx(0.1 * np.sqrt(2 / np.pi), abs=0.015) and near.min() >= 0


def test_without_errors_the_stops_are_the_play_operator():
    still = {
        name: AxisPrior(0.0, 0.0)
        for name in ("transmission_error", "play_variation", "drift_per_root_hour", "stop_sd", "home_sd", "backlash")
    }
    simulated = drawn(1, runs(1), reading_scale=AxisPrior(0.0, 0.0), **still)
    values = np.array([r.value for r in simulated.campaign.readings])
    commands = np.array([m.command for m in simulated.campaign.moves])
    # Without play or any error only the contrast is left, 1e-4 of the path.
    np.testing.assert_allclose(values, 0.01 * commands, atol=0.05)

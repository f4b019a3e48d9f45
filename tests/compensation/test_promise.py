"""The promise: kept by its axis, wider for formats that hold less, refused without an accepted result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from support.compensated import absolute_results, driven, results, table, to_and_fro, true_axis

from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import Wish
from tvsbayes.compensation.promise import compensate, compensation_of
from tvsbayes.errors import InputError, NotConverged
from tvsbayes.report.compensation_text import compensation_text
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_record import AxisResults, summarise_axis
from tvsbayes.single_axis.predicted_stops import PredictedAxis
from tvsbayes.statistics.predicted_readings import State


def errors_after(result, seed: int) -> np.ndarray:
    """Errors of 28 stops between the positions of the campaign, under a table."""
    commands, read = to_and_fro(np.linspace(-18.7, 18.7, 14))
    fresh = driven(true_axis(), commands, read, seed, by=Correction.of(result))
    at = np.array([commands[r.move].command for r in fresh.readings])
    return np.array([r.value for r in fresh.readings]) - result.offset - result.per_command * at


def test_errors_after_applying_lie_within_the_promise():
    result = table()
    bound = np.repeat([result.promise["forward"].error95, result.promise["backward"].error95], 14)
    inside = np.mean([np.mean(np.abs(errors_after(result, seed)) <= bound) for seed in range(12)])
    # 95 % of 336 errors that share twelve homings and one table: a few per cent either way.
    assert 0.88 <= inside <= 1.0
    before = min(left.without95 for left in result.promise.values())
    assert bound.max() < 0.2 * before


def test_within_one_homing_errors_lie_within_the_promise_but_for_a_shift():
    result = table()
    bound = np.repeat([result.promise[side].shift_free95 for side in ("forward", "backward")], 14)
    errors = [errors_after(result, seed) for seed in range(12)]
    # 95 % of 336 errors that share one table.
    assert 0.88 <= np.mean([np.abs(each - each.mean()) <= bound for each in errors]) <= 1.0
    assert all(left.shift_free95 < left.error95 for left in result.promise.values())


@pytest.mark.thorough
def test_a_format_that_holds_less_leaves_more():
    left = {name: max(p.error95 for p in table(name, **w).promise.values()) for name, w in CASES.items()}
    assert left["csv"] < left["grblhal"] < left["grbl"]
    # grbl leaves half of the play to each side.
    assert table("grbl", in_force=250.0).promise["forward"].causes["format"] == pytest.approx(0.3, rel=0.3)


CASES = {"csv": {}, "grblhal": {"in_force": 250.0}, "grbl": {"in_force": 250.0}}


def test_rounding_is_in_the_promise():
    fine, coarse = table(), table("csv", resolution=0.05)
    for side in ("forward", "backward"):
        # A rounding of 0.05 mm scatters by 0.05 / sqrt(12) = 0.014 mm.
        assert coarse.promise[side].error95 > fine.promise[side].error95 + 0.003
    sent = Correction.of(coarse).sent(np.array([3.0]), np.array([1]))[0]
    assert sent / 0.05 == pytest.approx(round(sent / 0.05), abs=1e-9)


def test_nominal_is_what_is_stated_or_one_or_the_fit():
    assert table().per_command == 1.0
    result = table("csv", per_command=1.01)
    assert result.per_command == 1.01
    # The table then corrects the ratio too: 0.8 % of 40 mm.
    assert result.table[-1].add_forward - result.table[0].add_forward == pytest.approx(0.32, abs=0.1)


@pytest.mark.parametrize(
    ("wish", "message"),
    [
        (Wish("step7"), "unknown"),
        (Wish("grbl"), "$100"),
        (Wish("grbl", in_force=-250.0), "-250"),
        (Wish("csv", in_force=3.0), "--in-force"),
        (Wish("csv", per_command=-1.0), "--per-command"),
        (Wish("csv", resolution=float("nan")), "--resolution"),
        (Wish("pec"), "needs a period"),
        (Wish("pec", period=4.0), "eight positions"),
    ],
)
def test_impossible_options_of_a_table_are_refused(wish, message):
    with pytest.raises(InputError) as refused:
        compensation_of(results(), wish)
    assert message in f"{refused.value.message} {refused.value.allowed}"


def test_a_play_that_was_never_read_is_no_setting():
    """With stops from one side alone grblHAL's play is unchanged, and the promise states the reason."""
    whole = results().fit.campaign
    first = [move for move in whole.moves if move.segment == 0]
    turn = int(np.argmax([move.command for move in first]))
    moves = tuple(first[: turn + 1])
    campaign = replace(whole, moves=moves, readings=tuple(r for r in whole.readings if r.move < len(moves)))
    result = compensate(campaign, "grblhal", in_force=250.0)
    assert set(result.settings) == {"$100"} and any("one side" in text for text in result.unsaid)


def test_no_table_is_made_of_what_is_not_accepted():
    campaign = results().fit.campaign
    fit = fit_axis(campaign, sampled=False)
    with pytest.raises(NotConverged, match="Laplace"):
        compensation_of(AxisResults(summarise_axis(fit), fit), Wish())
    rough = structs.replace(results().summary, answer="rough")
    with pytest.raises(NotConverged, match="rough"):
        compensation_of(AxisResults(rough, results().fit), Wish())


def test_python_makes_the_file_in_one_call(monkeypatch):
    def fitted_before(campaign, **_):
        return replace(results(), fit=replace(results().fit, campaign=campaign))

    monkeypatch.setattr("tvsbayes.compensation.promise.results_for", fitted_before)
    result = compensate(replace(results().fit.campaign, header={"serial": "A 7"}), "linuxcnc")
    assert result.machine == "A 7" and "machine: A 7" in result.text and result.text.startswith("-20.0")


def test_an_absolute_encoder_promises_of_all_errors():
    """No homing sets its zero: no shift is free. It walks from the first move on, and a use follows the last."""
    homed, fit = results().fit, absolute_results().fit
    made = compensation_of(absolute_results(), Wish("csv"))
    assert made.homings == 0 and not made.shift_free and not made.shift_matters
    for promise in made.promise.values():
        assert promise.error95 == promise.error95_with_homing > promise.shift_free95 and promise.causes["homing"] == 0
    text = compensation_text(made)
    assert "but for one shift" not in text and "since homing" not in text and "homing was read" not in text
    side, once = np.array([1, -1]), State(0.0, 0.0, 0.0, 0.0)
    hours = fit.campaign.moves[-1].time_s / 3600.0
    walked = PredictedAxis(fit)
    drift = walked.scatter(side, once, 0.0)["drift"][:, 0, 0]
    np.testing.assert_allclose(drift, walked.scales["drift_per_root_hour"] ** 2 * hours)
    assert not PredictedAxis(homed).scatter(side, once, 0.0)["drift"].any()
    assert PredictedAxis(homed).homings == 3 == table().homings


def growing_screw(seed: int = 1) -> AxisCampaign:
    """Eleven positions read up and down in five cycles, while the zero grows by 1 um a cycle and it gets warmer."""
    rng = np.random.default_rng(seed)
    places = np.linspace(3.2, 401.1, 11)
    error = 0.008 * np.sin(2 * np.pi * places / 390 + 1.0) + 0.004 * np.cos(2 * np.pi * places / 150)
    path = [1.0, *[c for _ in range(5) for c in (*places, 403.0, *places[::-1], 1.0)]]
    moves, readings = [], []
    for k, command in enumerate(path):
        moves.append(AxisMove(k, 0, 30.0 * k, command, "" if k else "backward", 20 + 1.5 * (1 - np.exp(-k / 80))))
        if command in places:
            play = -0.003 * np.sign(command - path[k - 1])
            value = command + np.interp(command, places, error) + play + 0.001 * k / 24
            readings.append(Reading(len(readings), k, value + 0.0004 * float(rng.standard_normal()), 0.0003))
    return AxisCampaign("mm", tuple(moves), tuple(readings))


def test_a_table_is_of_one_state_while_the_zero_grows():
    """Node k in run k would hold the growth as a saw-tooth of some um over the positions."""
    fit = fit_axis(growing_screw(), sampled=False)
    results = AxisResults(structs.replace(summarise_axis(fit), answer="accepted"), fit)
    made, rows = compensation_of(results, Wish("csv")), fit.rows
    at = [row for row in made.table if row.command in rows.positions]
    for side, number in (("forward", 1), ("backward", -1)):
        means = [rows.value[(rows.command == row.command) & (rows.side == number)].mean() for row in at]
        off = np.array([getattr(row, side) for row in at]) - means
        # Means of a cycle hold half a um of growth between both ends, and a fifth of the scatter of stops.
        assert np.ptp(off) < 1e-3 and np.std(off) < 3e-4
    for promise in made.promise.values():
        # One homing: its prior, 0.1 % of the travel, is not in the first figure.
        assert promise.error95 == promise.shift_free95 < 0.05 < promise.error95_with_homing
        assert promise.causes["creep"] > 0 and promise.causes["temperature"] > 0 and made.kelvin is not None
    # Run-up: the play and the scatter of stops.
    assert 0.006 < made.reversal_command < 0.012


def test_creep_and_temperature_are_drawn_together_and_their_sum_is_stated():
    """Both grow with time: apart they are known to tens of um, their sum to a fraction of one."""
    fit = fit_axis(growing_screw(), sampled=False)
    draws, rows, minutes = fit.draws, fit.rows, fit.model.coordinates.values(fit.w)["creep_minutes"]
    creep = draws["creep"] * -np.expm1(-rows.warm_s[-1] / (60 * minutes))
    warming = draws["thermal_per_K"] * rows.kelvin[-1]
    assert creep.std() > 20 * (creep + warming).std() and abs((creep + warming).mean() - 0.005) < 0.001
    assert np.all(draws["ratio_contrast"] == 0.0)
    (weak,) = [text for text in summarise_axis(fit).weak_directions if "one thing" in text]
    assert "a shift with the temperature and a creep of the zero" in weak and "their sum moved the zero by 0.00" in weak

"""Verdict on a table by twelve readings; cases without a verdict; choice of the readings."""

from __future__ import annotations

import datetime
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from support.compensated import absolute_results, driven, fresh, results, table, to_and_fro, true_axis

from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import Wish
from tvsbayes.compensation.promise import compensation_of
from tvsbayes.compensation.verification import plan_verification, stored_compensation, verify_axis, verify_readings
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.report.compensation_text import compensation_section, verification_text
from tvsbayes.results.compensation_record import (
    APPLIED,
    BROKEN,
    CANNOT_TELL,
    KEPT,
    NOT_APPLIED,
    OTHER_MACHINE,
    TWICE,
    WRONG_SIGN,
)
from tvsbayes.single_axis.predicted_stops import PredictedAxis


@pytest.mark.parametrize(
    ("factors", "world"),
    [
        ((1.0, 1.0), APPLIED),
        ((0.0, 0.0), NOT_APPLIED),
        ((1.0, 0.0), NOT_APPLIED),
        ((2.0, 2.0), TWICE),
        ((1.0, 2.0), TWICE),
        ((-1.0, -1.0), WRONG_SIGN),
        ((1.0, -1.0), WRONG_SIGN),
    ],
)
def test_every_world_is_named(factors, world):
    """Also for the play alone, as by a lost reversal or a backlash setting besides the table."""
    check = verify_readings(results().fit, table(), fresh(3, factors))
    assert check.world == world and check.worlds[world] > 0.95
    assert check.verdict == (KEPT if world == APPLIED else BROKEN)
    assert (check.p > 0.01) == (world == APPLIED)
    assert sum(check.worlds.values()) == pytest.approx(1.0)


def test_sizes_are_those_of_the_readings():
    new = fresh(3)
    check = verify_readings(results().fit, table(), new)
    aim = table().offset + np.array([new.moves[r.move].command for r in new.readings])
    errors = np.array([r.value for r in new.readings]) - aim
    assert check.after.rms == pytest.approx(np.sqrt(np.mean(errors**2)))
    assert check.after.worst == pytest.approx(np.max(np.abs(errors)))
    assert check.before.rms > 5 * check.after.rms and check.promised95 < 0.1 and check.readings == 12


def test_with_one_homing_errors_are_less_one_shift():
    """The prior of the next homing would dominate all others; the zero of a dial gauge is reset as well."""
    new, once = fresh(3), structs.replace(table(), homings=1)
    several = verify_readings(results().fit, table(), new)
    assert several.shift_free is None and several.promised95_with_homing is None
    shifted = replace(new, readings=tuple(replace(reading, value=reading.value + 0.5) for reading in new.readings))
    check = verify_readings(results().fit, once, shifted)
    aim = table().offset + np.array([new.moves[r.move].command for r in new.readings])
    assert check.verdict == KEPT and check.after.rms == pytest.approx(np.std([r.value for r in new.readings] - aim))
    assert check.shift_free.after == check.after and check.shift_free.promised95 == check.promised95
    assert check.after_with_homing.rms > 0.4 and check.promised95 < check.promised95_with_homing
    assert check.promised95_with_homing == pytest.approx(several.promised95)
    assert verify_readings(results().fit, table(), shifted).verdict == BROKEN
    text = verification_text(check)
    assert "but for one shift common to all" in text and "with the error of a homing" in text
    page = compensation_section(once, check)
    assert "as within one homing" in page.items[-1]
    assert "one homing" not in " ".join(compensation_section(table(), None).items)


def test_an_absolute_zero_walks_on_between_the_folders():
    """Nothing is taken off; a day later the zero may lie where the drift of a day takes it."""
    fit, new = absolute_results().fit, replace(fresh(3), absolute=True)
    made = compensation_of(absolute_results(), Wish("csv"))
    begun = datetime.datetime(2026, 3, 1, 12, 0)
    dated = replace(fit.campaign, header={"created": begun})
    fit = replace(fit, campaign=dated)
    later = [replace(new, header={"created": begun + datetime.timedelta(hours=hours)}) for hours in (1.0, 1.0 + 24.0)]
    checks = [verify_readings(fit, made, each) for each in later]
    assert all(check.shift_free is None and check.after_with_homing is None for check in checks)
    drift = float(np.mean(PredictedAxis(fit).scales["drift_per_root_hour"] ** 2))
    assert checks[1].promised95 ** 2 - checks[0].promised95 ** 2 > 24.0 * drift


def test_another_axis_is_none_of_the_worlds():
    commands, read = to_and_fro(np.array([-15.0, -7.0, 1.0, 6.0, 12.0, 18.0]))
    other = driven(true_axis(8, 1.004), commands, read, 9, by=Correction.of(table()))
    check = verify_readings(results().fit, table(), other)
    assert (check.verdict, check.world) == (BROKEN, OTHER_MACHINE)


def test_a_table_below_the_noise_has_no_verdict():
    """Three readings of 0.5 mm uncertainty: every world explains them."""
    new = fresh(3)
    blurred = replace(new, readings=tuple(replace(r, u=0.5) for r in new.readings[:3]))
    check = verify_readings(results().fit, table(), blurred)
    assert check.verdict == CANNOT_TELL and check.needed != 0


def test_readings_outside_and_long_times_are_reported():
    commands, read = to_and_fro(np.array([-15.0, 1.0, 23.0]))
    slow = tuple(replace(m, time_s=100 * m.time_s) for m in commands)
    check = verify_readings(results().fit, table(), driven(true_axis(), slow, read, 4, by=Correction.of(table())))
    assert "outside" in check.remarks[0] and "larger errors are expected" in check.remarks[1]


def test_other_units_and_missing_tables_are_refused(tmp_path):
    with pytest.raises(InputError, match="'deg'"):
        verify_readings(results().fit, table(), replace(fresh(3), unit="deg"))
    with pytest.raises(InputError, match="no compensation"):
        stored_compensation(replace(results().fit.campaign, path=tmp_path))


@pytest.mark.thorough
def test_grblhal_may_begin_in_either_half_of_the_play():
    """A shift of all readings by half the play is allowed for a format without a defined zero."""
    result = table("grblhal", in_force=250.0)
    commands, read = to_and_fro(np.array([-15.0, -7.0, 1.0, 6.0, 12.0, 18.0]))
    new = driven(true_axis(), commands, read, 5, by=Correction.of(result))
    shifted = replace(new, readings=tuple(replace(r, value=float(r.value or 0) + 0.15) for r in new.readings))
    assert verify_readings(results().fit, result, shifted).verdict == KEPT
    assert verify_readings(results().fit, structs.replace(result, zero_free=False), shifted).verdict == BROKEN


def test_python_verifies_in_one_call(monkeypatch):
    monkeypatch.setattr("tvsbayes.compensation.verification.results_for", lambda *_, **__: results())
    assert verify_axis(results().fit.campaign, fresh(3), made=table()).verdict == KEPT


def test_a_verification_stays_within_the_limits():
    """A table to +-20 of commands to +-24; where limits end at the table, its ends are reached from one side alone."""
    for limits, (low, high) in ((None, (-24.0, 24.0)), ((-20.0, 20.0), (-20.0, 20.0)), ((-20.0, 7.0), (-20.0, 7.0))):
        fit = replace(results().fit, campaign=replace(results().fit.campaign, limits=limits))
        plan = plan_verification(fit, table())
        rows = [line.split(",") for line in plan.plan_bytes().decode().splitlines()[1:]]
        commands = [float(row[1]) for row in rows]
        assert low <= min(commands) and max(commands) <= high and {side for _, side in plan.stops} == {-1, 1}
    narrow = replace(results().fit, campaign=replace(results().fit.campaign, limits=(30.0, 40.0)))
    with pytest.raises(NothingToEstimate, match="no stop has room"):
        plan_verification(narrow, table())


def test_a_table_says_where_its_run_up_leaves_the_limits():
    assert not [words for words in table().unsaid if "run-up" in words]
    fit = replace(results().fit, campaign=replace(results().fit.campaign, limits=(-20.0, 24.0)))
    made = compensation_of(replace(results(), fit=fit), Wish("csv"))
    (words,) = [words for words in made.unsaid if "run-up" in words]
    assert words.startswith("arriving forward below -19.") and "backward" not in words and "`limits` of [axis]" in words


def test_plan_spreads_its_stops_and_states_whether_they_are_enough():
    plan = plan_verification(results().fit, table())
    assert plan.enough and len(plan.stops) >= 6 and {side for _, side in plan.stops} == {-1, 1}
    assert np.ptp([command for command, _ in plan.stops]) > 30
    rows = [line.split(",") for line in plan.plan_bytes().decode().splitlines()[1:]]
    at = [float(row[1]) for row in rows]
    for k, row in enumerate(rows):
        if row[3] == "1":
            assert (at[k] > at[k - 1]) == (row[2] == "forward") and abs(at[k] - at[k - 1]) >= plan.run_up - 1e-9
    tiny = [structs.replace(r, add_forward=1e-5, add_backward=-1e-5) for r in table().table]
    assert not plan_verification(results().fit, structs.replace(table(), table=tuple(tiny))).enough

"""A drive at constant rate: the table removes the wave of its worm, and the promise states the remainder."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest

from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import FORMATS, Origin, Wish
from tvsbayes.compensation.promise import compensation_of
from tvsbayes.compensation.verification import refuse_drive
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.report.compensation_text import compensation_text
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_record import AxisResults, results_for
from tvsbayes.single_axis.waves import WavePeriods

RATE, WORM_S, U = 15.0, 200.0, 0.3
PERIOD = RATE * WORM_S
TIME_S = 4.0 * np.arange(300)


def wave(time_s: np.ndarray) -> np.ndarray:
    """Once a turn of the worm, and three times a turn; arcsec."""
    turn = 2 * np.pi * time_s / WORM_S
    return 3.0 * np.cos(turn - 0.7) + np.cos(3 * turn + 1.1)


@cache
def results() -> AxisResults:
    """Six turns of the worm, read every 4 s."""
    value = 7.0 + RATE * TIME_S + wave(TIME_S) + U * np.random.default_rng(4).standard_normal(len(TIME_S))
    readings = tuple(
        Reading(k, 0, float(v), U, time_s=float(t)) for k, (v, t) in enumerate(zip(value, TIME_S, strict=True))
    )
    periods = WavePeriods(stated=(WORM_S, WORM_S / 3), in_seconds=True)
    moves = (AxisMove(0, 0, 0.0, 0.0, "forward"),)
    return results_for(AxisCampaign("arcsec", moves, readings, {}, {"rate": RATE}, periods))


@pytest.mark.thorough
def test_the_table_removes_the_wave_within_the_promise():
    result = compensation_of(results(), Wish("pec"))
    assert result.settings["period_command"] == pytest.approx(PERIOD)
    command = RATE * np.linspace(100.0, 1100.0, 500)
    begins = result.table[0].command
    phase = begins + (command - begins) % PERIOD
    added = Correction.of(result).sent(phase, np.zeros(len(phase))) - phase
    left, before = wave(command / RATE) + result.per_command * added, wave(command / RATE)
    promise = result.promise["forward"]
    # 95 % of a wave's errors: the table's cause is the bound of its own error alone.
    assert np.quantile(np.abs(left), 0.95) <= promise.causes["table"] + promise.causes["format"]
    assert np.std(left) < 0.1 * np.std(before)
    assert promise.error95 < 0.4 * promise.without95
    # Besides the wave there are noise of 0.3, seeing, walk and creep of the zero.
    assert promise.without95 == pytest.approx(float(np.quantile(np.abs(before), 0.95)), rel=0.2)


def test_a_part_of_the_period_is_folded_alone_and_another_period_refused():
    fast = compensation_of(results(), Wish("pec", period=PERIOD / 3))
    # The slow wave stays: 3 arcsec, of which 95 % lie within 2.99.
    assert fast.promise["forward"].causes["format"] == pytest.approx(1.96 * 3.0 / np.sqrt(2), rel=0.05)
    with pytest.raises(NothingToEstimate, match="no wave"):
        compensation_of(results(), Wish("pec", period=0.6 * PERIOD))
    with pytest.raises(InputError, match="commands long"):
        compensation_of(results(), Wish("pec", period=7 * PERIOD))


def test_other_formats_need_stops_and_a_rate_is_not_in_the_table():
    with pytest.raises(InputError, match="drive at constant rate"):
        compensation_of(results(), Wish("csv"))
    with pytest.raises(InputError, match="not its rate"):
        compensation_of(results(), Wish("pec", per_command=1.0))


def test_the_file_is_periodic_and_names_the_verification():
    result = compensation_of(results(), Wish("pec"))
    text = FORMATS["pec"].write(result, Origin("tvsbayes of a mount", "0" * 64))
    rows = np.array([line.split(",") for line in text.splitlines() if line[0].isdigit()], dtype=float)
    expected = -wave(rows[:, 0] * WORM_S) / result.per_command
    # 300 readings of u 0.3 know a wave to 0.3 sqrt(2 / 300) = 0.024 in each of four columns; 0.3 is 6 of their sums.
    np.testing.assert_allclose(rows[:, 1], expected, atol=0.3)
    assert "run tvsbayes fit" in text and "homing" not in text
    assert ", 200 s; phase 0 at command 0, 0 s after the log begins" in text and text.count("promise, ") == 1


def test_the_text_states_the_periodic_error_and_the_verification():
    """A drive has no sides and no stops: neither a row for each nor a verification by them."""
    result = compensation_of(results(), Wish("pec"))
    text = compensation_text(result)
    size = float(re.search(r"3000 commands, 200 s: (\S+) arcsec peak to peak", text)[1])
    assert size == pytest.approx(np.ptp(wave(np.linspace(0, WORM_S, 1000))), abs=0.3)
    assert "backward" not in text and text.count("while it drives") == 1
    with pytest.raises(NothingToEstimate, match="not verified by stops") as refused:
        refuse_drive(result)
    assert "`periods = [200]`" in refused.value.remedy

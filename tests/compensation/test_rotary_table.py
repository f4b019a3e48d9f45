"""A rotary axis with a wave per turn and play: the table by phase takes both out, in every turn, and is verified."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msgspec import structs

from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import Wish, is_table_of
from tvsbayes.compensation.promise import compensation_of, file_text
from tvsbayes.compensation.verification import verify_readings
from tvsbayes.errors import InputError
from tvsbayes.report.compensation_text import compensation_text
from tvsbayes.results.compensation_record import BROKEN, KEPT, NOT_APPLIED
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import AxisResults, results_for
from tvsbayes.single_axis.waves import WavePeriods

RATIO, TURN, PLAY, WAVE, U = 0.6, 600.0, 0.24, 0.15, 0.004
STATED = {"home_sd": AxisPrior(0.004, 0.3)}

pytestmark = pytest.mark.thorough


def moved(first: float, last: float, step: float, homings: int) -> tuple[tuple[AxisMove, ...], list[int]]:
    """Up and down with a run-up beyond both ends, after each homing; and which moves are read."""
    places = np.arange(first, last + 1e-9, step)
    path = [first - 30, *places, last + 30, *places[::-1], first - 30]
    moves = [
        AxisMove(h * len(path) + k, h, 5.0 * (h * len(path) + k), float(c), "" if k else "backward")
        for h in range(homings)
        for k, c in enumerate(path)
    ]
    return tuple(moves), [m.move for m in moves if first <= m.command <= last]


def read(moves: tuple[AxisMove, ...], which: list[int], seed: int, sent: tuple[AxisMove, ...] = ()) -> AxisCampaign:
    """Readings of a worm's wheel with a wave per turn; play is taken up from the side of arrival."""
    rng, driven = np.random.default_rng(seed), sent or moves
    homed = 0.004 * rng.standard_normal(1 + moves[-1].segment)
    at, values = RATIO * driven[0].command + 0.5 * PLAY, {}
    for move in driven:
        at = float(np.clip(at, RATIO * move.command - 0.5 * PLAY, RATIO * move.command + 0.5 * PLAY))
        error = WAVE * np.cos(np.radians(at) - 0.7)
        values[move.move] = at + error + homed[move.segment] + U * rng.standard_normal()
    readings = tuple(Reading(k, m, values[m], U) for k, m in enumerate(which))
    return AxisCampaign("deg", moves, readings, dict(STATED), periods=WavePeriods(stated=(360.0,)))


@cache
def results() -> AxisResults:
    """Two turns, 12 positions in each, from both sides, after two homings."""
    return results_for(read(*moved(0.0, 2 * TURN, TURN / 12, 2), seed=1))


@cache
def table(**wish):
    return compensation_of(results(), Wish("csv", period=TURN, **wish))


def fresh(applied: tuple[float, float], seed: int = 5) -> AxisCampaign:
    moves, which = moved(40.0, 1160.0, 80.0, 1)
    return read(moves, which, seed, tuple(Correction.of(table()).moved(moves, *applied)))


def test_both_sides_are_in_the_table_by_phase():
    made = table()
    first, last = made.table[0], made.table[-1]
    assert (last.command - first.command, made.settings["period_command"]) == (TURN, TURN)
    assert (first.add_forward, first.add_backward) == pytest.approx((last.add_forward, last.add_backward))
    apart = [row.add_forward - row.add_backward for row in made.table]
    np.testing.assert_allclose(apart, PLAY / RATIO, atol=0.05)
    middle = np.array([0.5 * (row.add_forward + row.add_backward) for row in made.table])
    angle = np.radians(RATIO * np.array([row.command for row in made.table]))
    wave = -WAVE * np.cos(angle - 0.7) / RATIO
    np.testing.assert_allclose(middle, wave, atol=0.04)
    assert any("by phase" in text for text in made.unsaid)


def test_the_correction_repeats_with_the_period():
    by = Correction.of(table())
    command, side = np.array([10.0, 333.0, 599.0]), np.array([1, -1, 1])
    for turns in (-2, 1, 5):
        np.testing.assert_allclose(by.sent(command + turns * TURN, side) - by.sent(command, side), turns * TURN)


def test_fresh_errors_lie_within_the_promise_and_the_play_is_out():
    new, made = fresh((1.0, 1.0)), table()
    check = verify_readings(results().fit, made, new)
    assert check.verdict == KEPT and check.before.rms > 5 * check.after.rms
    error = np.array([r.value - made.offset - made.per_command * new.moves[r.move].command for r in new.readings])
    bound = max(each.error95 for each in made.promise.values())
    assert np.mean(np.abs(error) <= bound) >= 0.85 and bound < 0.2 * PLAY
    for each in made.promise.values():
        assert each.without95 > 4 * each.error95


@pytest.mark.parametrize("factors", [(0.0, 0.0), (1.0, 0.0)])
def test_a_table_or_its_play_that_is_not_applied_is_named(factors):
    check = verify_readings(results().fit, table(), fresh(factors))
    assert (check.verdict, check.world) == (BROKEN, NOT_APPLIED)


def test_a_table_by_position_names_the_one_by_phase():
    text = compensation_of(results(), Wish("csv")).unsaid[0]
    assert text.startswith("the axis goes round") and "about 600" in text


def test_pec_leaves_the_play():
    one_sided = compensation_of(results(), Wish("pec", period=TURN))
    for side, each in one_sided.promise.items():
        assert each.error95 > 0.4 * PLAY > table().promise[side].error95
    assert "no play" in one_sided.unsaid[0]


def test_the_file_says_its_period_and_is_known_again():
    text = file_text(table(), results().fit.campaign)
    header, first = [line for line in text.splitlines() if not line.startswith("#")][:2]
    assert header == "phase,add_forward,add_backward,u_forward,u_backward"
    assert [float(cell) for cell in first.split(",")[1:3]] == pytest.approx(
        [table().table[0].add_forward, table().table[0].add_backward]
    )
    assert "# period: 600 commands" in text and is_table_of(text, table(), "")
    assert not is_table_of(text, structs.replace(table(), offset=table().offset + 1), "")
    assert "by phase" in compensation_text(table())


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_header_by_phase_adds_the_same_in_every_turn(tmp_path):
    made = compensation_of(results(), Wish("header", period=TURN))
    (tmp_path / "axis.h").write_text(file_text(made, results().fit.campaign))
    at = [-1800.0, -700.5, -0.001, 0.0, 300.0, 599.9, 600.0, 1234.0]
    calls = "".join(f'printf("%.9f %.9f\\n", axis_sent({c}, 1), axis_sent({c}, -1));' for c in at)
    (tmp_path / "try.c").write_text(f'#include <stdio.h>\n#include "axis.h"\nint main(void) {{ {calls} return 0; }}\n')
    subprocess.run(["cc", "-std=c99", "-Wall", "-Werror", "-o", "try", "try.c"], cwd=tmp_path, check=True)
    out = subprocess.run([tmp_path / "try"], capture_output=True, text=True, check=True).stdout
    cells = np.array([[float(cell) for cell in line.split()] for line in out.splitlines()])
    for column, side in enumerate((1, -1)):
        # Nine decimals printed; the table of the file has nine digits.
        expected = Correction.of(made).sent(np.array(at), np.full(len(at), side))
        np.testing.assert_allclose(cells[:, column], expected, atol=2e-8)
    assert made.promise == table().promise and any("by phase" in text for text in made.unsaid)


@pytest.mark.parametrize(("period", "message"), [(300.0, "eight positions"), (2000.0, "whole period")])
def test_a_period_that_was_not_read_is_refused(period, message):
    with pytest.raises(InputError) as refused:
        compensation_of(results(), Wish("csv", period=period))
    assert message in refused.value.allowed


def test_other_formats_take_no_period():
    with pytest.raises(InputError, match="takes no --period"):
        compensation_of(results(), Wish("linuxcnc", period=TURN))


def test_one_homing_is_verified_but_for_one_shift():
    new = fresh((1.0, 1.0))
    raised = replace(new, readings=tuple(replace(reading, value=reading.value + 0.5) for reading in new.readings))
    assert verify_readings(results().fit, structs.replace(table(), homings=1), raised).verdict == KEPT

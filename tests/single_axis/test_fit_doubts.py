"""Doubts about fits: each where its cause is there, none about a clean axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from support.axes import campaign, drawn, runs

from tvsbayes.report.axis_document import axis_fit_text
from tvsbayes.results.estimates import Estimate, Measured, PeriodEstimate
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_record import AxisSummary, summarise_axis
from tvsbayes.single_axis.fit_doubts import RULES, WithoutProcesses, doubts_of
from tvsbayes.single_axis.waves import WavePeriods
from tvsbayes.statistics.intervals import WithSd

PLATE_RATIO, PLATE_PLAY, WAVE = 0.6, 0.25, 0.15
"""Of a turntable, deg per command and deg; the wave of its pulley has 120 deg."""


def estimate(value: float, sd: float) -> Estimate:
    return Estimate(value, sd, (value - 2 * sd, value + 2 * sd), 10 * sd, 0.99)


@pytest.fixture(scope="module")
def clean() -> AxisSummary:
    """With a play of 0.2 deg; its other numbers are those of the fit."""
    summary = summarise_axis(fit_axis(drawn(7, runs(2)).campaign, sampled=False))
    return structs.replace(summary, effective_backlash=estimate(0.2, 0.01))


def names(summary: AxisSummary, without: WithoutProcesses | None = None) -> list[str]:
    return [doubt.name for doubt in doubts_of(summary, without)]


def changed(summary: AxisSummary, **parameters: Estimate) -> AxisSummary:
    return structs.replace(summary, parameters={**summary.parameters, **parameters})


def test_a_wave_on_an_error_as_large_and_as_short_is_doubted(clean):
    period, amplitude = Measured(10.0, 0.0, (10.0, 10.0)), Measured(0.1, 0.01, (0.08, 0.12))
    wave = PeriodEstimate(period, amplitude, Measured(0.0, 1.0, (-2.0, 2.0)), "stated", 1.0)
    error, short, long = estimate(0.15, 0.02), estimate(4.0, 1.0), estimate(6.0, 1.0)
    claimed = structs.replace(clean, periods=(wave,))
    on_error = changed(claimed, transmission_error=error, transmission_error_length=short)
    assert names(on_error) == ["wave"] and "every 10 " in doubts_of(on_error)[0].text
    assert names(changed(claimed, transmission_error=error, transmission_error_length=long)) == []
    smaller = changed(claimed, transmission_error=estimate(0.05, 0.01), transmission_error_length=short)
    assert names(smaller) == []
    unlikely = structs.replace(wave, probability=0.4)
    assert names(structs.replace(on_error, periods=(unlikely,))) == []


def test_processes_that_explain_nothing_are_named_with_what_stating_them_0_gives(clean):
    now = changed(clean, per_command=estimate(0.6, 1e-4), backlash=estimate(0.2, 0.05))
    [doubt] = doubts_of(now, WithoutProcesses(20.0, WithSd(0.6001, 2e-5), WithSd(0.21, 0.01)))
    assert doubt.name == "idle processes" and doubt.usable
    assert "odds 20 : 1" in doubt.text and "0.600100(20)" in doubt.text and "0.210(10) (now 0.200(50))" in doubt.text
    assert names(now, WithoutProcesses(2.0, WithSd(0.6001, 2e-5), WithSd(0.21, 0.01))) == []
    assert names(now, WithoutProcesses(20.0, WithSd(0.6001, 9e-5), WithSd(0.21, 0.045))) == []


def test_three_readings_are_not_usable():
    """Whatever was fitted to them."""
    moves = [AxisMove(k, 0, 60.0 * k, float(k), "" if k else "forward") for k in range(3)]
    summary = summarise_axis(fit_axis(campaign(moves, [0.0, 1.0, 2.1]), sampled=False))
    assert [doubt.name for doubt in summary.doubts] == ["few readings"]
    lines = axis_fit_text(summary).splitlines()
    assert lines[-1].startswith("verdict: DOUBTFUL, not usable as it is; see the doubt")
    assert any(line.startswith("doubt: 3 stops leave 1 of at least 5 degrees of freedom") for line in lines)
    assert len({rule.name for rule in RULES}) == len(RULES)


def plate(reader_deg: float) -> AxisCampaign:
    """A turntable seen by a camera whose pose is assumed: it errs by so much, once and twice a turn.

    Places on the way back lie between those on the way there.
    """
    rng = np.random.default_rng(3)
    commands = [-40.0]
    for k in range(4):
        commands += [48.0 * j for j in range(16)] if k % 2 == 0 else [48.0 * j - 24.0 for j in reversed(range(16))]
    moves = [AxisMove(k, 0, 6.0 * k, c, "" if k else "backward") for k, c in enumerate(commands)]
    command = np.array(commands)
    side = np.r_[-1.0, np.sign(np.diff(command))]
    stands = PLATE_RATIO * command + WAVE * np.cos(2 * np.pi * command / 200.0 - 1.0) - 0.5 * PLATE_PLAY * side
    turn = np.radians(stands)
    reader = reader_deg * (np.sin(turn + 0.4) + 0.8 * np.sin(2.0 * turn - 1.0))
    values = stands + reader + 0.02 * rng.standard_normal(len(moves)) + 0.02 * rng.standard_normal(len(moves))
    return replace(campaign(moves, values.tolist(), 0.02), periods=WavePeriods((120.0,)))


@pytest.mark.thorough
def test_an_assumed_pose_of_the_camera_is_doubted_and_a_right_one_is_not():
    wrong = summarise_axis(fit_axis(plate(0.6), sampled=False))
    assert "error by position" in [doubt.name for doubt in wrong.doubts]
    right = summarise_axis(fit_axis(plate(0.0), sampled=False))
    [doubt] = right.doubts
    # The wave is stated, and no error or play by position stands beside it.
    assert doubt.name == "idle processes" and doubt.usable
    assert axis_fit_text(structs.replace(right, converged=True)).splitlines()[-1] == "verdict: usable; see the doubt"

"""Texts of an axis: plan, fit, firmware, drive."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from msgspec import structs
from support.axes import drawn, runs

from tvsbayes.report.axis_document import (
    axis_document,
    axis_fit_text,
    axis_plan_text,
    deviation_table,
    for_firmware,
    worst_place,
)
from tvsbayes.report.document import Issue
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_record import PositionDeviation, results_for, summarise_axis
from tvsbayes.single_axis.next_stops import AxisPlan, NextStop
from tvsbayes.single_axis.waves import WavePeriods


@pytest.mark.parametrize(("after", "remark"), [(0.99, True), (0.96, True), (0.94, False), (0.3, False)])
def test_a_plan_of_little_effect_is_marked(after, remark):
    stop = NextStop(1_250_000.0, "forward", None, after, 1.0 - after, 0.1)
    text = axis_plan_text(AxisPlan("per_command", 1.0, (stop,), 0.5), "mm")
    assert ("these stops have little effect: u falls by" in text) is remark
    assert "1250000 " in text, "a counter is no power of ten"


@pytest.mark.parametrize(("count", "kept"), [(1, 1), (40, 40), (41, 40), (900, 40)])
def test_a_long_table_keeps_both_ends_and_says_what_it_leaves_out(count, kept):
    deviations = [PositionDeviation(float(k), 0.0, 1.0, (-2.0, 2.0)) for k in range(count)]
    table = deviation_table(deviations, "mm", 40)
    positions = [float(row[0]) for row in table.rows]
    assert len(positions) == len(set(positions)) == kept and (positions[0], positions[-1]) == (0, count - 1)
    # Evenly: rounding to whole rows makes neighbouring gaps differ by one.
    gaps = {b - a for a, b in pairwise(positions)}
    assert not gaps or max(gaps) - min(gaps) <= 1
    assert (f"{kept} of {count}" in table.caption) is ("fit.json" in table.caption) is (kept < count)


@pytest.fixture(scope="module")
def clean():
    summary = summarise_axis(fit_axis(drawn(7, runs(2)).campaign, sampled=False))
    return structs.replace(summary, converged=True, problems=(), prior_conflicts=(), warnings=())


@pytest.mark.parametrize(
    ("warnings", "verdict"),
    [
        ((), "usable"),
        (("segment 2 reads 16 times what others read",), "usable; see the warning"),
        (("reading 5 lies 9 sds off", "all moves have the same time"), "usable; see the 2 warnings"),
    ],
)
def test_the_verdict_counts_the_warnings(clean, warnings, verdict):
    text = axis_fit_text(structs.replace(clean, warnings=warnings))
    assert text.splitlines()[-1] == f"verdict: {verdict}"
    assert text.count("warning: ") == len(warnings)


@pytest.mark.parametrize(
    ("tier", "worst", "words"),
    [
        ("importance", None, None),
        ("emcee", 2.04, "chain and weighted draws agree: the largest difference is 2.0 Monte Carlo errors"),
        ("emcee", 7.0, "chain and weighted draws DISAGREE: the largest difference is 7.0 Monte Carlo errors"),
        ("emcee", None, "the weighted draws were not accepted: results are those of the chain"),
    ],
)
def test_a_fit_says_whether_its_chain_agrees(clean, tier, worst, words):
    lines = axis_fit_text(structs.replace(clean, tier=tier, sampling={"agreement": worst})).splitlines()
    assert [line for line in lines if "weighted draws" in line and "readings of" not in line] == (
        [words] if words else []
    )


def test_a_fit_states_the_numbers_for_firmware(clean):
    sides = {name: structs.replace(of, value=-0.05, sd=0.0005) for name, of in clean.effective_per_command.items()}
    clean = structs.replace(clean, effective_per_command=sides, range_command=(0.0, 1250000.0))

    def text(value, low, high):
        play = structs.replace(clean.parameters["backlash"], value=value, sd=0.01, interval95=(low, high))
        mean = for_firmware(structs.replace(clean, effective_backlash=play))
        of_one = structs.replace(clean, effective_backlash=None, parameters={**clean.parameters, "backlash": play})
        assert mean.replace(" on average", "") == for_firmware(of_one) != mean
        return for_firmware(of_one)

    # 1/0.05 = 20, u 0.0005/0.05^2 = 0.2; 0.15/0.05 = 3, u 0.01/0.05 = 0.2.
    begun = f"for your firmware, from 0 to 1250000: -20.00(20) commands per {clean.unit}, "
    assert text(0.15, 0.13, 0.17) == f"{begun}play of 3.00(20) commands"
    assert text(-0.15, -0.17, -0.13) == f"{begun}no play: a reversal overshoots by 3.00(20) commands"
    assert (
        text(0.015, -0.01, 0.04) == f"{begun}play of 0.30(20) commands is not significant: its 95 % interval contains 0"
    )


def test_a_fit_states_place_and_possible_cause_of_the_largest_error_by_position(clean):
    deviations = (
        PositionDeviation(0.0, 0.02, 0.01, (0.0, 0.04)),
        PositionDeviation(1250000.0, -0.05, 0.01, (-0.07, -0.03)),
        PositionDeviation(2500000.0, 0.03, 0.01, (0.01, 0.05)),
    )
    sentence = worst_place(structs.replace(clean, deviations=deviations))
    assert (
        f"at command 1250000: -0.050(10) {clean.unit} off the line; it is the sum of the errors of gears and encoder"
        in sentence
    )
    assert "contains 0; it is" in worst_place(structs.replace(clean, deviations=deviations[:1]))


def test_numbers_that_must_not_be_used_are_not_offered_to_firmware(clean):
    first, second, *_ = axis_fit_text(clean).splitlines()
    assert first.startswith("for your firmware, from ") and "largest at command" in second
    broken = axis_fit_text(structs.replace(clean, converged=False, sampling={}, problems=("no mode",)))
    assert "for your firmware" not in broken and "largest at command" not in broken


def test_the_text_of_a_drive_has_no_play_directions_or_stops():
    """Numbers and advice for an axis with stops are left out."""
    rate, time_s = 15.0, 5.0 * np.arange(200)
    value = rate * time_s + 4.0 * np.sin(2 * np.pi * time_s / 200.0) + 0.3 * np.random.default_rng(1).normal(size=200)
    readings = tuple(
        Reading(k, 0, float(v), 0.3, time_s=float(t)) for k, (v, t) in enumerate(zip(value, time_s, strict=True))
    )
    periods = WavePeriods(stated=(200.0,), in_seconds=True)
    campaign = AxisCampaign("arcsec", (AxisMove(0, 0, 0.0, 0.0, "forward"),), readings, {}, {"rate": rate}, periods)
    results = results_for(campaign)
    document = axis_document(results, Issue.today())
    text = axis_fit_text(results.summary)
    assert not document.numbers and "compensate AXIS --to pec" in document.steps[0]
    assert "What repeats by position" not in [section.title for section in document.sections]
    assert "backward" not in text and "play" not in text and "a wave of" in text
    assert document.picture is not None and "every 200 s" in document.picture.caption

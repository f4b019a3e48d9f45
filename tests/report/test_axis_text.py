"""An axis in words."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
from support.axes import drawn, runs

from tvsbayes.report.axis_text import axis_fit_text, axis_plan_text, deviation_table
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_record import PositionDeviation, summarise_axis
from tvsbayes.single_axis.next_stops import AxisPlan, NextStop


@pytest.mark.parametrize(("after", "said"), [(0.99, True), (0.96, True), (0.94, False), (0.3, False)])
def test_a_plan_that_hardly_helps_says_so(after, said):
    stop = NextStop(1_250_000.0, "forward", None, after, 1.0 - after, 0.1)
    text = axis_plan_text(AxisPlan("per_command", 1.0, (stop,), 0.5), "mm")
    assert ("they hardly help" in text) is said
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
    return replace(summary, converged=True, problems=(), prior_conflicts=(), warnings=())


@pytest.mark.parametrize(
    ("warnings", "said"),
    [
        ((), "usable"),
        (("segment 2 reads 16 times what others read",), "usable; mind the warning"),
        (("reading 5 lies 9 sds off", "all moves have the same time"), "usable; mind the 2 warnings"),
    ],
)
def test_the_verdict_alone_says_that_warnings_stand_beside_it(clean, warnings, said):
    text = axis_fit_text(replace(clean, warnings=warnings))
    assert text.splitlines()[-1] == f"verdict: {said}"
    assert text.count("warning: ") == len(warnings)

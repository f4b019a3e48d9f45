"""An axis whose stops were all reached from one side: its play is that of the prior and is marked as such."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec import structs
from support.axes import campaign

from tvsbayes.report.axis_document import axis_fit_text, axis_plan_text
from tvsbayes.single_axis.axis_campaign import AxisMove
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import AxisSummary, summarise_axis
from tvsbayes.single_axis.next_stops import AxisPlan, NextStop


@pytest.fixture(scope="module")
def summary() -> AxisSummary:
    """Forward moves only, from a start of unknown side."""
    moves = [AxisMove(k, 0, 60.0 * k, 400.0 * k, "" if k else "unknown") for k in range(20)]
    rng = np.random.default_rng(3)
    values = [0.0125 * m.command - 0.04 * (k > 0) + 0.004 * rng.standard_normal() for k, m in enumerate(moves)]
    return summarise_axis(fit_axis(campaign(moves, values, 0.003, backlash=AxisPrior(0.1, 2.0)), sampled=False))


def test_weak_directions_are_counted_in_words(summary):
    for count, phrase in ((1, "1 weak direction\n"), (2, "2 weak directions\n")):
        assert f": {phrase}" in axis_fit_text(structs.replace(summary, weak_directions=("so",) * count))


@pytest.mark.parametrize(
    ("target", "unit"),
    [("per_command", "mm per command"), ("effective_per_command", "mm per command"), ("backlash", "mm")],
)
def test_a_plan_prints_its_target_with_unit_and_two_digits(target, unit):
    stop = NextStop(100.0, "forward", None, 0.000005, 0.000002, 0.000002)
    text = axis_plan_text(AxisPlan(target, 0.000007, (stop,), 1.0), "mm")
    assert f"now u = 0.0000070 {unit}\n" in text and "0.0000050" in text

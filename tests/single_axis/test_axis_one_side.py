"""An axis whose stops were all reached from one side: its play is that of the prior and is marked as such."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec import structs
from support.axes import campaign

from tvsbayes.report.axis_document import axis_fit_text, axis_plan_text, parameter_table
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


def test_an_undetermined_play_is_its_prior(summary):
    play = summary.parameters["backlash"]
    assert (play.value, play.sd, play.contraction) == (0.1, 2.0, 0.0)
    assert play.interval95 == pytest.approx((0.1 - 3.92, 0.1 + 3.92), abs=0.01)
    assert summary.classic.backlash is None
    assert any("backlash is not determined" in text for text in summary.weak_directions)


def test_printed_shares_lie_between_zero_and_one_hundred(summary):
    wider = structs.replace(summary.parameters["ratio_contrast"], contraction=-1.0)
    hardly = structs.replace(wider, contraction=-0.001)
    shown = parameter_table(
        structs.replace(summary, parameters={"a": wider, "b": hardly, "c": structs.replace(wider, contraction=1.0)})
    )
    assert [row[3] for row in shown.rows] == ["0 %", "0 %", "100 %"]


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

"""An axis in words."""

from __future__ import annotations

import pytest

from tvsbayes.report.axis_text import axis_plan_text
from tvsbayes.single_axis.next_stops import AxisPlan, NextStop


@pytest.mark.parametrize(("after", "said"), [(0.99, True), (0.96, True), (0.94, False), (0.3, False)])
def test_a_plan_that_hardly_helps_says_so(after, said):
    stop = NextStop(1_250_000.0, "forward", None, after, 1.0 - after, 0.1)
    text = axis_plan_text(AxisPlan("per_command", 1.0, (stop,), 0.5), "mm")
    assert ("they hardly help" in text) is said
    assert "1250000 " in text, "a counter is no power of ten"

"""Parts of planning that need no search: run-up within the limits, the smallest number that meets, minutes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tvsbayes.campaign import PlanStep
from tvsbayes.design import _sided, plan_minutes
from tvsbayes.planning import _smallest

LIMITS = np.array([[0, 100], [-50, 50]])
OVERSHOOT = np.array([10, 20])


@pytest.mark.parametrize(
    ("position", "sides"),
    [
        ((50, 0), {(1, 1), (1, -1), (-1, 1), (-1, -1)}),
        # From the left the run-up begins 10 steps below, from the right 10 above; up 20 below, down 20 above.
        ((5, 0), {(-1, 1), (-1, -1)}),
        ((95, 0), {(1, 1), (1, -1)}),
        ((50, 40), {(1, 1), (-1, 1)}),
        ((50, -40), {(1, -1), (-1, -1)}),
        ((10, -30), {(1, 1), (1, -1), (-1, 1), (-1, -1)}),
        ((9, -31), {(-1, -1)}),
        ((101, 0), set()),
    ],
)
def test_a_side_is_offered_where_its_run_up_stays_inside(position, sides):
    looks = _sided(np.array([position]), np.array([3]), LIMITS, OVERSHOOT)
    assert {tuple(side) for side in looks.side.tolist()} == sides and len(looks) == len(sides)
    assert all(tuple(steps) == position for steps in looks.steps.tolist()) and set(looks.sheet.tolist()) <= {3}


def test_the_smallest_number_that_meets_is_found():
    ladder = (1, 2, 3, 5, 8, 12, 20, 40)
    for answer in range(1, 41):
        assert _smallest(lambda n, answer=answer: n >= answer, ladder) == answer
    assert _smallest(lambda n: n >= 41, ladder) is None


def test_minutes_of_a_plan_by_hand(mounted_rig):
    """A homing counts as a move: 2 + 60 + 2 + 3 + 3 = 70 s."""
    rig = replace(mounted_rig, costs_s={"move_s": 2.0, "look_s": 3.0, "placement_s": 60.0})
    steps = [PlanStep(0, "home", 0, 0), PlanStep(1, "place", target="d1"), PlanStep(2, "move", 50, 0)]
    steps += [PlanStep(3, "look"), PlanStep(4, "look")]
    assert plan_minutes(steps, rig) == pytest.approx(70 / 60, rel=1e-12)

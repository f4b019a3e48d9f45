"""What a plan leaves inseparable, its remedy, and the one rule by which plan and fit judge."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.coarse_planning import with_priors
from support.commands import steps
from support.waits import check_forward, doings

from tvsbayes.assessment import weaknesses
from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import AXES, DIRECTION_SIGNS, SENSES
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.instrument.plan import PlanStep, describe_looks, run_plan
from tvsbayes.instrument.protocols import four_point_protocol, grid_protocol, paper_protocol
from tvsbayes.instrument.stops import INSEPARABLE, inseparable, separation
from tvsbayes.planning.expectation import prior_knowledge
from tvsbayes.planning.looks import Looks
from tvsbayes.planning.plan_check import CURING, JUDGING, appended, beyond_limits, check_plan, evaluated
from tvsbayes.results.plan_record import steps_of

pytestmark = pytest.mark.usefixtures("small_searches")


def test_where_a_plan_stands_follows_the_twin(mounted_rig):
    """Empty counters keep an axis, homing ends left and up, and an axis that rests keeps its side."""
    plan = steps(("home", 0, 0), ("place", "d1"), ("look",), ("move", 100, 40), ("move", 50, None), ("look",))
    assert describe_looks(mounted_rig, plan) == "d1: (0, 0) by left, up; (50, 40) by right, up"
    looks = Looks(np.array([[50, 60]]), np.array([[1, 1]]), np.array([0]))
    addition = appended(plan, looks, prior_knowledge(mounted_rig), np.array([30, 10]))
    # Tilt stands at 40: 20 steps up take up its play without a run-up; pan stands at its goal and needs one.
    assert [(s.action, s.pan_steps, s.tilt_steps) for s in addition[:-1]] == [("move", 20, 40), ("move", 50, 60)]
    assert describe_looks(mounted_rig, addition, plan) == "d1: (50, 60) by left, up"
    moves = run_plan((*plan, *addition), mounted_rig, ("left", "up")).moves
    assert [(m.pan_steps, m.tilt_steps) for m in moves] == [(0, 0), (100, 40), (50, 40), (20, 40), (50, 60)]


@pytest.mark.parametrize("fixed", ["ratio_contrast_deg_per_step", "backlash_deg"])
def test_what_the_rig_holds_fixed_has_no_contraction(mounted_rig, fixed):
    """The model with one ratio per axis (formulation 3.1) is such a rig."""
    priors = mounted_rig.table.priors
    rig = with_priors(mounted_rig, **{f"{fixed}__{a}": replace(priors[f"{fixed}.{a}"], u=0.0) for a in ("pan", "tilt")})
    waits = []
    check = check_plan(rig, grid_protocol(pan_steps=(0, 120, 240), tilt_steps=(-90, 0, 90)), progress=waits.append)
    check_forward(waits)
    assert doings(waits) == [JUDGING, CURING]
    name = "contrast" if fixed.startswith("ratio") else "backlash"
    document = json.loads(json.dumps(check.as_json(), allow_nan=False))
    assert {k for k, share in document["contraction"].items() if share is None} == {f"{name}.pan", f"{name}.tilt"}
    assert document["expected"][f"{name}.pan"] == 0 and not check.faults


def test_the_papers_protocol_leaves_ratio_and_backlash_inseparable_with_a_remedy(mounted_rig, monkeypatch):
    # Of three levels of tilt only the middle one leaves room for a run-up.
    monkeypatch.setattr("tvsbayes.planning.candidates.TILT_LEVELS", 5)
    plan = paper_protocol(12)
    check = check_plan(mounted_rig, plan)
    assert {fault.axis for fault in check.faults} == {"pan", "tilt"}
    for fault in check.faults:
        assert "add N = 100 or a cleared approach" in fault.text
        before = max(check.expected[direction] for direction in SENSES[fault.axis])
        assert fault.addition and fault.u_deg_per_step < 0.9 * before
        again = check_plan(mounted_rig, (*plan, *steps_of(fault.addition, len(plan))))
        assert fault.axis not in {f.axis for f in again.faults}
    json.dumps(check.as_json(), allow_nan=False)


def test_a_grid_has_no_finding(mounted_rig):
    check = check_plan(mounted_rig, grid_protocol(pan_steps=(0, 120, 240), tilt_steps=(-90, -30, 30, 90)))
    assert check.faults == () and check.warnings == ()


def test_one_depth_and_one_side_are_named(mounted_rig):
    looks = [order for pan in (40, 80, 120, 160, 200) for order in (("move", pan, pan // 2 - 60), ("look",))]
    text = "\n".join(check_plan(mounted_rig, steps(("home", 0, 0), ("place", "d1"), *looks)).warnings)
    assert "reached from one side" in text
    assert "one depth" in text and "place d2, d3" in text


def test_a_plan_beyond_the_limits_is_named(mounted_rig):
    rig = replace(mounted_rig, positioner={"pan_min_steps": 0, "pan_max_steps": 150})
    text = "\n".join(check_plan(rig, grid_protocol(pan_steps=(0, 240), tilt_steps=(-90, 90))).warnings)
    assert "[positioner] allows 0 to 150" in text


def test_limits_of_each_axis_and_end_count_where_they_are_stated(mounted_rig):
    plan = grid_protocol(pan_steps=(0, 240), tilt_steps=(-190, 190))
    moves = run_plan(plan, mounted_rig, ("left", "up")).moves

    def warned(**positioner) -> list[str]:
        return beyond_limits(CounterLimits.of(positioner), moves)

    assert warned() == []
    assert warned(pan_min_steps=-1000, pan_max_steps=1000) == [], "tilt is not limited"
    (tilt,) = warned(tilt_min_steps=-30, tilt_max_steps=30)
    assert tilt.startswith("tilt moves from ") and tilt.endswith("[positioner] allows -30 to 30")
    (pan,) = warned(pan_max_steps=100, tilt_min_steps=-1000)
    assert pan.endswith("[positioner] allows up to 100")


def test_a_plan_without_a_look_is_refused(mounted_rig):
    with pytest.raises(InputError, match="looks at nothing"):
        check_plan(mounted_rig, steps(("home", 0, 0)))


def partly_cleared(repeats: int, cleared: int) -> tuple[PlanStep, ...]:
    """One |N| = 200; so many of every twelve starts are cleared, the others reversed."""
    turns = tuple("cleared" if 5 * turn % 12 < cleared else "reversed" for turn in range(12))
    return four_point_protocol(repeats, approaches=dict.fromkeys(DIRECTION_SIGNS, turns))


def test_plan_and_fit_judge_by_one_rule(mounted_rig):
    """At the edge: a plan is judged like a fit of its expected correlation; moves alone add nothing.

    With 2 of 12 starts cleared the ratio and the backlash of both axes correlate by 0.51 to 0.56, with 4 by 0.37 to
    0.44. A fit at the very instrument of the plan, whose covariance is the plan's, judges the same numbers.
    """
    for plan, together in ((partly_cleared(24, 2), True), (partly_cleared(24, 4), False)):
        planned, check = evaluated(plan, prior_knowledge(mounted_rig)), check_plan(mounted_rig, plan)
        assert {fault.axis for fault in check.faults} == ({"pan", "tilt"} if together else set())
        for axis in AXES:
            correlation = planned.exchange(axis)
            assert inseparable(correlation) == together and abs(correlation - INSEPARABLE) < 0.2
            if separation(planned.stops(axis), axis) is not None:
                assert together
    assert weaknesses.inseparable is inseparable

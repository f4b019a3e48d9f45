"""Plans: round trip, refusals with their place, effect of their actions."""

from __future__ import annotations

import dataclasses

import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.own_outputs import require_own
from tvsbayes.instrument.plan import PlanStep, continued, read_plan, run_plan, write_plan

PLAN = (
    PlanStep(0, "home", 0, 0),
    PlanStep(1, "place", target="d1"),
    PlanStep(2, "look", target="d1", experiment=0, point=1),
    PlanStep(3, "move", 200, -5),
    PlanStep(4, "look"),
    PlanStep(5, "home", -100, 20),
    PlanStep(6, "look", experiment=0, point=2),
)


def test_a_plan_states_its_target_in_the_first_row(tmp_path):
    """Plans without a target have no such column; it stands behind those by which readers know a plan."""
    path, text = tmp_path / "plan.csv", "u(left) <= 1e-4 deg/step"
    stated = (dataclasses.replace(PLAN[0], made_for=text), *PLAN[1:])
    write_plan(stated, path)
    assert read_plan(path) == stated and path.read_text().splitlines()[0].endswith("point,made_for")
    require_own(path, "plan")
    with pytest.raises(InputError, match=r"made_for.*first row only"):
        write_plan((PLAN[0], dataclasses.replace(PLAN[1], made_for=text), *PLAN[2:]), path)
    write_plan(PLAN, path)
    assert "made_for" not in path.read_text()


def test_a_plan_is_known_by_its_columns_and_lines_are_counted_with_remarks(tmp_path):
    path = tmp_path / "plan.csv"
    write_plan(PLAN, path)
    require_own(path, "plan")
    names, *rest = path.read_text().splitlines()
    path.write_text("\n".join(["# bench 3", names, rest[0], rest[1].replace("place", "wait"), *rest[2:]]))
    with pytest.raises(InputError) as refused:
        read_plan(path)
    assert refused.value.line == 4
    with pytest.raises(InputError, match="would be replaced"):
        require_own(path, "plan")


PLAN_REFUSED = {
    "no home": (1, {"action": "move"}, 2, "action"),
    "unknown action": (4, {"action": "wait"}, 5, "action"),
    "gap": (4, {"step": 9}, 5, "step"),
    "place without target": (2, {"target": ""}, 3, "target"),
    "place with counters": (2, {"pan_steps": 1}, 3, "pan_steps"),
    "move without tilt": (4, {"tilt_steps": None}, 5, "tilt_steps"),
    "move with target": (4, {"target": "d1"}, 5, "target"),
    "look with counters": (3, {"tilt_steps": 1}, 4, "tilt_steps"),
    "look at another": (3, {"target": "d2"}, 4, "target"),
    "point alone": (5, {"point": 2}, 6, "experiment"),
    "point 5": (3, {"point": 5}, 4, "point"),
    "point twice": (7, {"point": 1}, 8, "point"),
    "home with target": (1, {"target": "d1"}, 2, "target"),
    "far": (4, {"pan_steps": 10**9}, 5, "pan_steps"),
}


@pytest.mark.parametrize("name", PLAN_REFUSED)
def test_plan_refusals(tmp_path, name):
    row, change, line, column = PLAN_REFUSED[name]
    steps = list(PLAN)
    steps[row - 1] = dataclasses.replace(steps[row - 1], **change)
    with pytest.raises(InputError) as caught:
        write_plan(steps, tmp_path / "plan.csv")
    assert (caught.value.file, caught.value.line, caught.value.column) == ("plan.csv", line, column)
    assert not (tmp_path / "plan.csv").exists()


def test_plan_without_steps_and_look_before_place(tmp_path):
    with pytest.raises(InputError, match="no rows"):
        write_plan([], tmp_path / "plan.csv")
    with pytest.raises(InputError, match="place the target first"):
        write_plan([PlanStep(0, "home"), PlanStep(1, "look")], tmp_path / "plan.csv")


def test_actions_of_a_plan_have_their_effect(mounted_rig):
    """Empty counters are 0 after homing and keep the axis elsewhere; without `home` a plan begins as homed at 0, 0."""
    steps = (PlanStep(0, "place", target="d1"), PlanStep(1, "look"), PlanStep(2, "move", 50, None))
    steps = (*steps, PlanStep(3, "look"), PlanStep(4, "home", None, 7), PlanStep(5, "place", target="d2"))
    log = run_plan(steps, mounted_rig)
    assert [(m.segment, m.pan_steps, m.tilt_steps, m.pan_approach) for m in log.moves] == [
        *((0, 0, 0, "left"), (0, 50, 0, ""), (1, 0, 7, "left"))
    ]
    assert [(look.move, look.placement) for look in log.looks] == [(0, 0), (1, 0)]
    assert (log.at, log.sheet, log.targets) == ((0, 7), "d2", ["d1", "d2"])
    with pytest.raises(InputError, match="which the rig does not have"):
        run_plan((PlanStep(0, "place", target="d9"),), mounted_rig)
    with pytest.raises(InputError, match="before a target is placed"):
        run_plan((PlanStep(0, "look"),), mounted_rig)


def test_a_plan_does_not_place_the_present_sheet_again():
    looks = PlanStep(1, "move", 10, 0), PlanStep(2, "look")
    steps = (PlanStep(0, "place", target="d1"), *looks)
    assert continued(steps, 7, "d1") == (PlanStep(7, "move", 10, 0), PlanStep(8, "look"))
    assert [(step.step, step.action) for step in continued(steps, 7, "d2")] == [(7, "place"), (8, "move"), (9, "look")]
    # A head places no sheet: its first step is a move.
    assert continued(looks, 1, "") == looks and continued((), 1, "") == ()

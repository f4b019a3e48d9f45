"""The standard plans: approaches of starts, and sides of looks."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.instrument.axes import DIRECTION_SIGNS
from tvsbayes.instrument.plan import read_plan, write_plan
from tvsbayes.instrument.protocols import PROTOCOLS, RUN_UP_STEPS, grid_protocol


@pytest.mark.parametrize("name", ["paper", "mixed", "paper_twin"])
def test_four_point_plans(name: str):
    """24 experiments per direction, of each size in turn, of four looks in the paper's order: d1, d2, move, d2, d1."""
    plan = PROTOCOLS[name]()
    looks, counters, target = {}, (0, 0), ""
    for step in plan:
        if step.action == "place":
            target = step.target
        elif step.action in ("home", "move"):
            counters = (step.pan_steps, step.tilt_steps)
        else:
            looks.setdefault(step.experiment, []).append((step.point, target, counters))
    assert len(looks) == 96 and [step.step for step in plan] == list(range(len(plan)))
    differences = []
    for four in looks.values():
        assert [look[:2] for look in four] == [(1, "d1"), (2, "d2"), (3, "d2"), (4, "d1")]
        assert four[0][2] == four[1][2] and four[2][2] == four[3][2]
        differences.append(tuple(np.subtract(four[2][2], four[1][2])))
    for direction, (axis, sign) in DIRECTION_SIGNS.items():
        mine = [s[axis == "tilt"] for s in differences if np.sign(s[axis == "tilt"]) == sign and s[axis == "pan"] == 0]
        assert len(mine) == 24, direction
        sizes = (100, 200) if name == "mixed" else (200,)
        assert [abs(s) for s in mine] == list(sizes) * (24 // len(sizes))


def test_grid_sees_every_pose_from_both_sides():
    """At each of three sheets each pose once per side of pan and of tilt, with one placement per sheet."""
    plan = grid_protocol()
    assert sum(step.action == "place" for step in plan) == 3
    approach, counters, target = [0, 0], [0, 0], ""
    approaches: dict[tuple, list] = {}
    for step in plan:
        if step.action == "place":
            target = step.target
        elif step.action in ("home", "move"):
            for axis, value in enumerate((step.pan_steps, step.tilt_steps)):
                if value != counters[axis]:
                    approach[axis], counters[axis] = int(np.sign(value - counters[axis])), value
        else:
            approaches.setdefault((target, *counters), []).append(tuple(approach))
    assert len(approaches) == 3 * 24
    for pose, sides in approaches.items():
        assert [sorted(of_axis) for of_axis in zip(*sides, strict=True)] == [[-1, 1], [-1, 1]], pose


@pytest.mark.parametrize("name", PROTOCOLS)
def test_protocols_are_valid_plans_within_their_range(name, tmp_path):
    steps = PROTOCOLS[name]()
    write_plan(steps, tmp_path / "plan.csv")
    assert read_plan(tmp_path / "plan.csv") == steps
    # Grid: poses -60 ... 240 and their run-up; the others: 0 ... 200 and theirs.
    furthest = 240 + RUN_UP_STEPS
    assert all(abs(s.pan_steps) <= furthest and abs(s.tilt_steps) <= furthest for s in steps if s.action == "move")
    assert any(s.action == "look" for s in steps)

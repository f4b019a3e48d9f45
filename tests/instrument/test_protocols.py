"""The standard plans: approaches of starts, and sides of looks."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.instrument.axes import DIRECTION_SIGNS
from tvsbayes.instrument.plan import PlanStep, read_plan, write_plan
from tvsbayes.instrument.protocols import PROTOCOLS, RUN_UP_STEPS, four_point_protocol, grid_protocol
from tvsbayes.twin.simulated_campaign import simulate


def _approach_signs(plan: tuple[PlanStep, ...]) -> dict[str, set[bool]]:
    """Direction -> whether its starts were reached along the experiment (cleared), as the set of cases."""
    history: list[tuple[int, int]] = []
    arrived: dict[int, int] = {}
    cases: dict[str, set[bool]] = {}
    for step in plan:
        if step.action in ("home", "move"):
            history.append((step.pan_steps, step.tilt_steps))
        elif step.action == "look" and step.point == 1:
            arrived[step.experiment] = len(history) - 1
        elif step.action == "look" and step.point == 3:
            start = arrived[step.experiment]
            delta = np.subtract(history[start + 1], history[start])
            axis = int(np.flatnonzero(delta)[0])
            before = next(h for h in reversed(history[:start]) if h[axis] != history[start][axis])
            direction = [["right", "left"], ["down", "up"]][axis][int(delta[axis] > 0)]
            cases.setdefault(direction, set()).add((history[start][axis] - before[axis]) * delta[axis] > 0)
    return cases


@pytest.mark.parametrize("name", ["paper", "mixed", "paper_twin"])
def test_four_point_plans(name: str):
    """96 experiments of four looks in the paper's order: d1, d2, move, d2, d1; 24 per direction."""
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
    sizes = {(200,), (100, 200)}
    for direction, (axis, sign) in DIRECTION_SIGNS.items():
        mine = [s[axis == "tilt"] for s in differences if np.sign(s[axis == "tilt"]) == sign and s[axis == "pan"] == 0]
        assert len(mine) == 24, direction
        assert tuple(sorted({abs(s) for s in mine})) in sizes


def test_approaches_of_the_protocols():
    """Reversed as requested; right and up cleared in the twin's plan; both kinds in the mixed one."""
    plan = four_point_protocol(repeats=3, approaches={name: ("reversed",) for name in DIRECTION_SIGNS})
    assert _approach_signs(plan) == {name: {False} for name in DIRECTION_SIGNS}
    twin = _approach_signs(PROTOCOLS["paper_twin"]())
    assert twin == {"left": {False}, "right": {True}, "up": {True}, "down": {False}}
    assert _approach_signs(PROTOCOLS["mixed"]()) == {name: {True, False} for name in DIRECTION_SIGNS}


def test_the_papers_protocol_is_plain_go_and_return():
    """Pan 0, 200, 0, ... from the homing on, without overshoot; tilt likewise."""
    counters = [(s.pan_steps, s.tilt_steps) for s in PROTOCOLS["paper"]() if s.action in ("home", "move")]
    assert counters[:4] == [(0, 0), (200, 0), (0, 0), (200, 0)]
    assert {pan for pan, _ in counters} == {0, 100, 200} and {tilt for _, tilt in counters} == {-100, 0, 100}
    # Left: 24 out, 23 back; right the same; to mid pan and the low start; up and down likewise.
    assert len(counters) == 1 + 47 + 47 + 2 + 47 + 47


def test_grid_sees_every_pose_from_both_sides():
    """At each of three sheets each pose once per side of pan and of tilt, with one placement per sheet."""
    plan = grid_protocol()
    assert sum(step.action == "place" for step in plan) == 3
    approach, counters, target = [0, 0], [0, 0], ""
    approaches: dict[tuple, set] = {}
    for step in plan:
        if step.action == "place":
            target = step.target
        elif step.action in ("home", "move"):
            for axis, value in enumerate((step.pan_steps, step.tilt_steps)):
                if value != counters[axis]:
                    approach[axis], counters[axis] = int(np.sign(value - counters[axis])), value
        else:
            approaches.setdefault((target, *counters), set()).add(tuple(approach))
    assert len(approaches) == 3 * 24
    for pose, sides in approaches.items():
        assert {pan for pan, _ in sides} == {-1, 1} and {tilt for _, tilt in sides} == {-1, 1}, pose


@pytest.mark.parametrize("name", PROTOCOLS)
def test_protocols_are_valid_plans_within_their_range(name, tmp_path):
    steps = PROTOCOLS[name]()
    write_plan(steps, tmp_path / "plan.csv")
    assert read_plan(tmp_path / "plan.csv") == steps
    # Grid: poses -60 ... 240 and their run-up; the others: 0 ... 200 and theirs.
    furthest = 240 + RUN_UP_STEPS
    assert all(abs(s.pan_steps) <= furthest and abs(s.tilt_steps) <= furthest for s in steps if s.action == "move")
    assert any(s.action == "look" for s in steps)


@pytest.mark.parametrize("how", ["reversed", "cleared"])
def test_starts_have_the_ordered_approach(how):
    """The last move of the axis before point 1 runs against (reversed) or along (cleared) the experiment."""
    plan = four_point_protocol(3, approaches=dict.fromkeys(DIRECTION_SIGNS, (how,)))
    directions = [name for name in DIRECTION_SIGNS for _ in range(3)]
    counters, last_sign, count = {"pan": 0, "tilt": 0}, {"pan": 0, "tilt": 0}, 0
    for step in plan:
        if step.action == "move":
            for moved, value in (("pan", step.pan_steps), ("tilt", step.tilt_steps)):
                if value != counters[moved]:
                    last_sign[moved], counters[moved] = np.sign(value - counters[moved]), value
        if step.action == "look" and step.point == 1:
            axis, sign = DIRECTION_SIGNS[directions[step.experiment]]
            assert last_sign[axis] == (sign if how == "cleared" else -sign)
            count += 1
        if step.action == "look" and step.point == 4:
            assert last_sign[axis] == sign
    assert count == 12


def test_step_counts_alternate(mounted_rig):
    campaign = simulate(mounted_rig, four_point_protocol(2, steps=(100, 200)), seed=1).campaign
    ends = {s.experiment: campaign.moves[s.move] for s in campaign.spots if s.point == 3}
    starts = {s.experiment: campaign.moves[s.move] for s in campaign.spots if s.point == 2}
    lengths = [
        abs(ends[e].pan_steps - starts[e].pan_steps) + abs(ends[e].tilt_steps - starts[e].tilt_steps) for e in range(8)
    ]
    assert lengths == [100, 200] * 4


def test_grid_sees_each_pose_from_either_side_of_both_axes(mounted_rig):
    campaign = simulate(mounted_rig, grid_protocol(targets=("d1",)), seed=1).campaign
    observed = {s.move for s in campaign.spots}
    sides: dict[tuple[int, int], list[tuple[int, int]]] = {}
    sign, previous = {"pan": 1, "tilt": 1}, campaign.moves[0]
    for move in campaign.moves[1:]:
        for axis, now, before in (
            ("pan", move.pan_steps, previous.pan_steps),
            ("tilt", move.tilt_steps, previous.tilt_steps),
        ):
            sign[axis] = sign[axis] if now == before else int(np.sign(now - before))
        if move.move in observed:
            sides.setdefault((move.pan_steps, move.tilt_steps), []).append((sign["pan"], sign["tilt"]))
        previous = move
    assert len(sides) == 24
    for pan_signs, tilt_signs in (zip(*signs, strict=True) for signs in sides.values()):
        assert sorted(pan_signs) == [-1, 1]
        assert sorted(tilt_signs) == [-1, 1]

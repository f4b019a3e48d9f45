"""What a sequence of moves can tell before any fit, and that the shipped protocols are plans."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tvsbayes.cli.main import run
from tvsbayes.estimators.plausibility import check_campaign
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.axes import DIRECTION_SIGNS
from tvsbayes.instrument.campaign import Campaign, Move, read_campaign, write_campaign
from tvsbayes.instrument.plan import read_plan, write_plan
from tvsbayes.instrument.protocols import OVERSHOOT_STEPS, PROTOCOLS, four_point_protocol, grid_protocol
from tvsbayes.instrument.stops import Stop, observed_stops, separation
from tvsbayes.twin.simulated_campaign import simulate


def pan_moves(*counters: int, approach: str = "left") -> tuple[Move, ...]:
    """One segment that visits these pan counters; the tilt axis rests."""
    return tuple(Move(i, 0, float(i), n, 0, *((approach, "up") if i == 0 else ())) for i, n in enumerate(counters))


def pan_separation(*counters: int) -> str | None:
    """Verdict where every move is followed by a look."""
    moves = pan_moves(*counters)
    return separation(observed_stops(moves, range(len(moves)), "pan"), "pan")


@pytest.fixture(scope="module")
def paper_twin() -> Campaign:
    return read_campaign(shipped_data() / "twins" / "paper_twin")


def warnings_of(campaign: Campaign) -> str:
    return "\n".join(check_campaign(campaign).warnings)


def test_stops_have_the_sense_of_the_last_move_of_their_axis():
    moves = pan_moves(0, 200, 150, 150, 180)
    assert observed_stops(moves, {0, 1, 2, 4}, "pan") == (
        Stop(0, 0, 1),
        Stop(0, 200, 1),
        Stop(0, 150, -1),
        Stop(0, 180, 1),
    )
    assert observed_stops(moves, {0, 1, 2, 4}, "tilt") == (Stop(0, 0, 1),)


def test_two_looks_at_one_rest_are_one_stop():
    """Moves that order the same counters again, or move the other axis, end no rest."""
    moves = (*pan_moves(0, 200, 200), Move(3, 0, 3.0, 200, 50), Move(4, 0, 4.0, 0, 50))
    assert observed_stops(moves, {1, 2, 3, 4}, "pan") == (Stop(0, 200, 1), Stop(0, 0, -1))
    assert observed_stops(moves, {1, 2, 3, 4}, "tilt") == (Stop(0, 0, 1), Stop(0, 50, 1))


def test_unobserved_stops_are_left_out_but_set_the_sense():
    assert observed_stops(pan_moves(0, 240, 200), {2}, "pan") == (Stop(0, 200, -1),)


def test_a_homing_begins_a_new_stop_at_the_same_counter():
    moves = (*pan_moves(0, 200), Move(2, 1, 2.0, 200, 0, "right", "unknown"), Move(3, 1, 3.0, 0, 0))
    assert observed_stops(moves, range(4), "pan") == (
        Stop(0, 0, 1),
        Stop(0, 200, 1),
        Stop(1, 200, -1),
        Stop(1, 0, -1),
    )
    assert observed_stops(moves, range(4), "tilt") == (Stop(0, 0, 1), Stop(1, 0, 0))


def test_going_and_returning_by_one_step_count_is_named_with_its_cure():
    text = pan_separation(*[0, 200] * 12)
    assert "only one |N| = 200" in text
    assert "add N = 100 or a cleared approach" in text


def test_one_odd_leg_among_many_is_not_enough():
    """The first start, reached by the homing, tells a little; one leg of another length hardly more."""
    assert "nearly every leg has |N| = 200" in pan_separation(*[0, 200] * 24, 100)


def test_two_step_counts_separate():
    assert pan_separation(*[0, 200, 0, 100] * 6) is None


def test_cleared_starts_separate():
    """Both ends of one |N| seen from both sides: run-ups beyond either end."""
    cycle = [-OVERSHOOT_STEPS, 0, 200, 200 + OVERSHOOT_STEPS, 200, 0]
    moves = pan_moves(*cycle * 4)
    observed = [m.move for m in moves if m.pan_steps in (0, 200)]
    assert separation(observed_stops(moves, observed, "pan"), "pan") is None


def test_homing_is_no_leg():
    """A second segment homed at counter 40 says no more of a leg's length than the first did."""
    one = pan_moves(*[0, 200] * 12)
    homed = Move(len(one), 1, 100.0, 40, 0, "left", "up")
    both = (*one, homed)
    assert "only one |N| = 200" in separation(observed_stops(both, range(len(both)), "pan"), "pan")
    # Two homings from either side, and nothing driven.
    alone = (Move(0, 0, 0.0, 0, 0, "left", "up"), Move(1, 1, 1.0, 40, 0, "right", "up"))
    assert "no leg of the pan axis" in separation(observed_stops(alone, range(2), "pan"), "pan")


@pytest.mark.parametrize("counters", [(0, 50, 100, 200), (0, 0, 0, 200)])
def test_one_side_only_is_named(counters):
    assert "reached from one side" in pan_separation(*counters)


def test_one_counter_only_is_named():
    assert "one counter only" in pan_separation(100, 100, 100)
    assert "one counter only" in separation((), "pan")


def test_every_segment_has_its_own_zero():
    """Two segments, each seen from one side only, cannot tell backlash from home offset; one segment can."""
    stops = [Stop(segment, n, sign) for segment, sign in ((0, 1), (1, -1)) for n in (0, 100, 200)]
    assert separation(stops, "tilt") is not None
    assert separation([replace(stop, segment=0) for stop in stops], "tilt") is None


@pytest.mark.parametrize("name", PROTOCOLS)
def test_protocols_are_valid_plans_within_their_range(name, tmp_path):
    steps = PROTOCOLS[name]()
    write_plan(steps, tmp_path / "plan.csv")
    assert read_plan(tmp_path / "plan.csv") == steps
    # Grid: poses -60 ... 240 and their run-up; the others: 0 ... 200 and theirs.
    furthest = 240 + OVERSHOOT_STEPS
    assert all(abs(s.pan_steps) <= furthest and abs(s.tilt_steps) <= furthest for s in steps if s.action == "move")
    assert any(s.action == "look" for s in steps)


@pytest.mark.parametrize("how", ["reversed", "cleared"])
def test_starts_are_reached_as_ordered(how):
    """The last move of the axis before point 1 runs against (reversed) or along (cleared) the experiment."""
    plan = four_point_protocol(3, approaches=dict.fromkeys(DIRECTION_SIGNS, (how,)))
    directions = [name for name in DIRECTION_SIGNS for _ in range(3)]
    counters, last_sign, seen = {"pan": 0, "tilt": 0}, {"pan": 0, "tilt": 0}, 0
    for step in plan:
        if step.action == "move":
            for moved, value in (("pan", step.pan_steps), ("tilt", step.tilt_steps)):
                if value != counters[moved]:
                    last_sign[moved], counters[moved] = np.sign(value - counters[moved]), value
        if step.action == "look" and step.point == 1:
            axis, sign = DIRECTION_SIGNS[directions[step.experiment]]
            assert last_sign[axis] == (sign if how == "cleared" else -sign)
            seen += 1
        if step.action == "look" and step.point == 4:
            assert last_sign[axis] == sign
    assert seen == 12


def test_step_counts_are_taken_in_turn(mounted_rig):
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
    for pan_signs, tilt_signs in (zip(*seen, strict=True) for seen in sides.values()):
        assert sorted(pan_signs) == [-1, 1]
        assert sorted(tilt_signs) == [-1, 1]


@pytest.mark.parametrize(("name", "experiments", "readings"), [("paper_twin", 96, 0), ("grid_twin", 0, 144)])
def test_shipped_twins_have_no_warning(name, experiments, readings):
    found = check_campaign(read_campaign(shipped_data() / "twins" / name))
    assert found.warnings == ()
    assert (found.experiments, found.aperture_readings, found.refused) == (experiments, readings, {})
    assert found.ok_spots == found.spots


def test_the_papers_protocol_is_warned_of_on_both_axes(mounted_rig):
    text = warnings_of(simulate(mounted_rig, PROTOCOLS["paper"](), seed=2).campaign)
    # Not "only one": between pan and tilt experiments each axis goes to its middle once.
    for axis in ("pan", "tilt"):
        reason = "nearly every leg has |N| = 200 and reverses"
        assert f"{axis} ratio and {axis} backlash are hard to tell apart: {reason}" in text


def test_swapped_cameras_are_suspected(paper_twin):
    spots = tuple(
        replace(
            s,
            u_left_px=s.u_right_px,
            v_left_px=s.v_right_px,
            u_right_px=s.u_left_px,
            v_right_px=s.v_left_px,
        )
        for s in paper_twin.spots
    )
    text = warnings_of(replace(paper_twin, spots=spots))
    assert "are left and right swapped" in text
    assert "spots 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 374 more triangulate outside" in text


def test_lengths_in_metres_and_angles_in_radians_are_suspected(paper_twin):
    metres = replace(paper_twin.stereo, T=paper_twin.stereo.T / 1000)
    assert "is it in metres?" in warnings_of(replace(paper_twin, stereo=metres))
    reversed_pair = replace(paper_twin.stereo, T=-paper_twin.stereo.T)
    assert "second camera" in warnings_of(replace(paper_twin, stereo=reversed_pair))
    grid = read_campaign(shipped_data() / "twins" / "grid_twin")
    for change, words in (
        (np.radians, "are they in radians?"),
        (lambda reading: -reading, "outside 0 to 180 deg"),
        (lambda reading: 180.0 + reading, "outside 0 to 180 deg"),
    ):
        spots = tuple(replace(s, aperture_deg=float(change(s.aperture_deg))) for s in grid.spots)
        assert words in warnings_of(replace(grid, spots=spots))


def test_a_status_that_misses_its_word_is_named(paper_twin):
    first, second, *rest = paper_twin.spots
    spots = (replace(first, status="OK"), replace(second, status="undetected"), *rest)
    text = warnings_of(replace(paper_twin, spots=spots))
    assert "spots 0 are left out: their status is not spelt ok" in text
    assert "spots 1 are undetected and have pixels" in text


def test_commands_that_estimate_repeat_what_no_rig_can_have_measured(paper_twin, tmp_path, capfd):
    """Nothing makes a user run `check` first; stdout stays the document."""
    spots = tuple(replace(s, u_left_px=s.u_right_px, u_right_px=s.u_left_px) for s in paper_twin.spots)
    write_campaign(replace(paper_twin, spots=spots), tmp_path / "swapped")
    run(["classic", str(tmp_path / "swapped"), "--json"])
    printed = capfd.readouterr()
    assert "warning: spots 0, 1" in printed.err and "swapped" in printed.err
    json.loads(printed.out)


def test_one_depth_is_named_and_two_are_not(paper_twin):
    near = tuple(replace(s, experiment=None, point=None) for s in paper_twin.spots if s.target == "d1")
    assert "all spots lie at one depth" in warnings_of(replace(paper_twin, spots=near))
    assert "depth" not in warnings_of(paper_twin)
    # Another warning does not hide it.
    misspelt = (replace(near[0], status="OK"), *near[1:])
    assert "all spots lie at one depth" in warnings_of(replace(paper_twin, spots=misspelt))


def test_zero_and_assumed_stereo_covariance_are_named(paper_twin):
    zero = replace(paper_twin.stereo, parameter_covariance=np.zeros((24, 24)))
    assert "stereo covariance is zero" in warnings_of(replace(paper_twin, stereo=zero))
    assumed = replace(paper_twin.stereo, assumed=True)
    assert "stereo covariance is assumed" in warnings_of(replace(paper_twin, stereo=assumed))


def test_unknown_approach_is_named_with_its_segment(paper_twin):
    first = replace(paper_twin.moves[0], tilt_approach="unknown")
    moves = (first, *paper_twin.moves[1:])
    assert "segment 0 begins with an unknown approach" in warnings_of(replace(paper_twin, moves=moves))


def test_incomplete_experiments_and_refused_spots_are_counted(paper_twin):
    spots = list(paper_twin.spots)
    spots[5] = replace(spots[5], status="saturated")
    found = check_campaign(replace(paper_twin, spots=tuple(spots)))
    assert found.refused == {"saturated": 1}
    assert (found.ok_spots, found.experiments) == (383, 95)
    assert [w for w in found.warnings if w.startswith("experiment 1 is not complete")]


def test_a_campaign_without_usable_spots_is_told_once(paper_twin):
    spots = tuple(replace(s, status="too dim", experiment=None, point=None) for s in paper_twin.spots)
    found = check_campaign(replace(paper_twin, spots=spots))
    assert found.ok_spots == 0
    assert found.warnings == ("no spot has status ok: there is nothing to estimate from",)

"""A plan from beginning to end: its curve, its document, its notes."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from msgspec import structs
from support.coarse_planning import with_priors
from support.waits import check_forward, doings

from tvsbayes.errors import InputError
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT, plan_minutes, read_plan, write_plan
from tvsbayes.instrument.protocols import paper_protocol
from tvsbayes.instrument.stops import FEW_STOPS
from tvsbayes.planning.drawn_rigs import alike
from tvsbayes.planning.expectation import information_of, prior_knowledge
from tvsbayes.planning.looks import Looks
from tvsbayes.planning.plan_check import JUDGING
from tvsbayes.planning.planner import CHOOSING, COUNTING, EXCHANGING, LOOKING, few_looks, plan_from
from tvsbayes.planning.search import Scope
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target
from tvsbayes.report.command_text import plan_text
from tvsbayes.statistics.chances import share_error
from tvsbayes.twin.simulated_campaign import simulate

pytestmark = pytest.mark.usefixtures("small_searches")


@pytest.fixture(scope="module")
def result(knowledge):
    target = parse_target("u(worst) <= 5e-4 deg/step")
    scope = Scope(largest=12)
    waits = []
    plan = plan_from(knowledge, target, scope=scope, draws=20, seed=1, progress=waits.append)
    check_forward(waits)
    assert doings(waits) == [LOOKING, CHOOSING, COUNTING, EXCHANGING, JUDGING]
    return plan


def test_the_curve_is_monotone(result):
    curve = result.curve
    assert [p.experiments for p in curve] == sorted({p.experiments for p in curve})
    for before, after in pairwise(curve):
        assert after.minutes > before.minutes
        assert after.joint <= before.joint
        assert after.assurance >= before.assurance
        assert before.classic is None or after.classic < before.classic
    assert curve[-1].classic is not None
    assert all(p.assurance_se == share_error(p.assurance, 20) for p in curve)
    assert result.n80 <= result.n95 <= 12
    reached = {p.experiments: p.assurance for p in curve}
    assert reached[result.n80] >= 0.8 and reached[result.n95] >= 0.95


def test_the_plan_runs_through_the_twin(result, mounted_rig, tmp_path):
    write_plan(result.steps, tmp_path / "plan.csv")
    steps = read_plan(tmp_path / "plan.csv")
    assert steps == result.steps
    assert sum(s.action == "look" for s in steps) == result.looks == 4 * result.experiments
    assert result.minutes == pytest.approx(plan_minutes(mounted_rig, steps))
    run = simulate(mounted_rig, steps, 3)
    assert sum(s.status == "ok" for s in run.campaign.spots) >= 0.9 * result.looks


def test_the_plan_beats_the_baselines(result):
    by_name = {b.name: b for b in result.baselines}
    assert set(by_name) == {"planned", "paper", "mixed", "grid"}
    assert by_name["planned"].minutes < 0.1 * by_name["paper"].minutes
    assert by_name["planned"].joint < by_name["paper"].joint
    assert result.met and result.assurance >= 0.8


def test_a_plan_has_one_number(result):
    """In its row of the curve, in its line, beside the protocols: the median over the drawn instruments."""
    (row,) = (row for row in result.curve if row.experiments == result.experiments)
    planned = result.baselines[0]
    assert planned.name == "planned" and planned.joint == result.expected == row.joint <= result.target.limit
    assert (result.assurance, result.assurance_se) == (row.assurance, row.assurance_se)
    assert planned.spots == result.looks and result.steps[0].made_for == result.target.text
    text = plan_text(result)
    assert f"{result.experiments:11d}  {result.looks:5d}  " in text


def test_before_any_data_there_is_no_next_look(result):
    assert result.next == () and not result.stop.now and "nothing is measured yet" in result.stop.reason
    assert "next four looks" not in plan_text(result)


def test_a_rig_that_may_stand_anywhere_is_said_and_one_of_its_build_helps(mounted_rig, knowledge):
    """Placed to 20 deg, most drawn instruments see little of the plan; like a known one they see it."""
    wide = {f"extrinsics__rotation_rad__{a}": Prior(0.0, 0.35) for a in "xyz"}
    unplaced = prior_knowledge(with_priors(mounted_rig, **wide))
    known = replace(knowledge, precision=1e4 * knowledge.precision, after_data=True)
    target, scope = parse_target("u(left) <= 1e-3 deg/step"), Scope(largest=2)
    lost, found = (plan_from(at, target, scope=scope, draws=20, seed=1) for at in (unplaced, alike(unplaced, known)))
    assert any("half of the drawn instruments see at most" in note for note in lost.notes)
    assert lost.baselines[0].seen < 0.9 * lost.looks and found.baselines[0].seen == found.looks
    assert "half of" not in " ".join(found.notes) and found.assurance >= lost.assurance


def test_the_document_has_the_contracts_keys(result):
    document = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert {"target", "curve", "n80", "n95", "limited_by", "next", "stop"} <= set(document)
    assert set(document["curve"][0]) == {"experiments", "minutes", "classic", "joint", "assurance", "assurance_se"}
    assert sum(document["variance_shares"].values()) == pytest.approx(1.0, abs=1e-6)
    assert "floor" in plan_text(result)


def test_the_text_names_the_plan_and_what_was_not_reached(result):
    text = plan_text(result)
    size = f"{result.experiments} experiments ({result.looks} looks)"
    assert (
        f"the plan: {size} in" in text
        and f"for a chance of 95 %: {result.n95} experiment" in text
        and "few may leave a direction without a stop" in text
    )
    last = result.curve[-1].experiments
    not_reached = f"not reached with up to {last} experiments ({LOOKS_PER_EXPERIMENT * last} looks)"
    assert f"for a chance of 95 %: {not_reached}" in plan_text(structs.replace(result, n95=None))


def test_a_plan_for_one_ratio_says_what_it_leaves_open():
    side = np.array([[1, 1]] * FEW_STOPS + [[-1, 1]] * (FEW_STOPS - 1))
    notes = few_looks(
        Looks(np.zeros_like(side), side, np.zeros(len(side), dtype=int)), parse_target("u(left) <= 1 deg/step")
    )
    assert [note.split(":")[0] for note in notes] == [f"only {FEW_STOPS - 1} stops right", "only 0 stops down"]


def test_after_data_the_next_session_starts_from_what_is_known(knowledge):
    """A campaign of the paper's kind leaves the tilt: the next looks help most, and more than the first would again."""
    taught = information_of(paper_protocol(4), knowledge)
    known = replace(knowledge, precision=knowledge.precision + taught.fisher, after_data=True)
    target = parse_target("u(worst) <= 2e-4 deg/step")
    scope = Scope(largest=4, minutes=6.0)
    result = plan_from(known, target, None, taught.pose_rad, scope=scope, draws=20, seed=2)
    assert result.now > target.limit and not result.stop.now
    assert result.expected < 0.7 * result.now
    gains = [batch.gain_per_minute for batch in result.next]
    assert gains == sorted(gains, reverse=True) and gains[0] > 0 and "next four looks, best first" in plan_text(result)
    assert all(b.gain_per_minute == pytest.approx(b.gain / b.minutes) for b in result.next)
    assert {action.action for action in result.next[0].actions} == {"home", "place", "move", "look"}
    assert result.minutes <= 6.0
    assert "the campaign and its priors" in result.shares
    assert result.steps[0].action == "home"
    enough = plan_from(known, structs.replace(target, limit=1.0), None, taught.pose_rad, scope=scope, draws=20, seed=2)
    assert enough.stop.now and enough.met and enough.steps == ()
    assert enough.assurance is None and "nothing is left to do" in plan_text(enough)


def test_too_few_minutes_are_refused(knowledge):
    scope = Scope(largest=2, minutes=0.5)
    with pytest.raises(InputError, match="one experiment of four looks takes"):
        plan_from(knowledge, parse_target(DEFAULT_TARGET), scope=scope, draws=20, seed=0)


def test_a_quantity_held_fixed_is_no_target(mounted_rig):
    known = prior_knowledge(with_priors(mounted_rig, backlash_deg__pan=Prior(0.0, 0.0, "half-normal")))
    with pytest.raises(InputError, match=r"backlash.pan is held fixed"):
        plan_from(known, parse_target("u(backlash.pan) <= 0.1 deg"), scope=Scope(largest=1), draws=20, seed=0)

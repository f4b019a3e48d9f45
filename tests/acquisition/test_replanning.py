"""Looks chosen while a run goes on: followed, written down with their reasons, kept by a resumed run, within limits."""

from __future__ import annotations

import sys

import pytest
from support.bench_runs import Run, small_plan

from tvsbayes.acquisition.journal import read_journal
from tvsbayes.acquisition.operator import Terminal
from tvsbayes.acquisition.recorder import recorded
from tvsbayes.acquisition.replanning import AdaptWish, Replanning, adapted_plan
from tvsbayes.acquisition.running_estimate import EstimateWish
from tvsbayes.acquisition.session import acquire
from tvsbayes.cli.main import run
from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.plan import plan_seconds

NEXT = """
import json, sys
from pathlib import Path
looks = len((Path(sys.argv[2]) / "spots.csv").read_text().splitlines()) - 1
count, sheet, step = int(sys.argv[sys.argv.index("--next") + 1]), "SHEET", STEP
steps = [{"action": "place", "target": sheet}]
for n in range(count):
    steps += [{"action": "move", "pan_steps": step * n + looks, "tilt_steps": -10}, {"action": "look"}]
entry = {"value": 0.06, "sd": 0.012 / looks}
document = {"steps": steps, "now": 0.012 / looks, "after_each": [0.012 / (looks + n + 1) for n in range(count)]}
document["effective_deg_per_step"] = {d: entry for d in ("left", "right", "up", "down")}
print(json.dumps({**document, "why": f"{count} looks at {sheet} help most"}))
"""


def command(sheet: str = "d2", step: int = 5) -> tuple[str, ...]:
    """A stand-in for `tvsbayes plan RIG`, whose u falls as 0.012 / looks."""
    return sys.executable, "-c", NEXT.replace("SHEET", sheet).replace("STEP", str(step))


def changes(folder) -> list[dict]:
    return [record.data for record in read_journal(folder).records if record.event == "adapted"]


def test_the_looks_left_are_those_proposed(mounted_rig, tmp_path):
    """Proposals at 12, 15, 18, 22 and 27 looks; 4.6e-4 is met at the last."""
    plan = small_plan(20)
    with Replanning(tmp_path / "c", command(), 4.6e-4, 60.0, wait=True) as estimate:
        run_ = Run(mounted_rig, tmp_path / "c", plan, estimate=estimate)
        outcome = run_.engine.run()
    assert (outcome.reason, outcome.looks) == ("target met", 27) and run_.dark() and not outcome.warnings
    told = changes(tmp_path / "c")
    assert [event["looks"] for event in told] == [12, 15, 18, 22]
    assert told[0]["why"] == "8 looks at d2 help most"
    looks = [step for step in told[0]["steps"] if step["action"] == "look"]
    assert [look["u_before_deg_per_step"] for look in looks[1:]] == [
        look["u_after_deg_per_step"] for look in looks[:-1]
    ]
    assert looks[0]["u_before_deg_per_step"] == pytest.approx(1e-3)
    campaign = read_campaign(tmp_path / "c")
    after = [campaign.moves[spot.move].pan_steps for spot in campaign.spots[12:]]
    # Each proposal counts from the looks that it knew; its sheet is placed once.
    assert after == [12, 17, 22, 15, 20, 25, 18, 23, 28, 33, 22, 27, 32, 37, 42]
    assert {spot.target for spot in campaign.spots[12:]} == {"d2"}
    records = read_journal(tmp_path / "c").records
    events = [record.event for record in records]
    assert events[events.index("adapted") :].count("placed") == 1
    assert adapted_plan(plan, records) == run_.engine.plan


@pytest.mark.parametrize(("sheet", "step"), [("d9", 5), ("d2", 5000)])
def test_a_proposal_that_the_rig_cannot_run_is_not_followed(mounted_rig, tmp_path, sheet, step):
    with Replanning(tmp_path / "c", command(sheet, step), 1e-9, 60.0, wait=True) as estimate:
        outcome = Run(mounted_rig, tmp_path / "c", small_plan(4), estimate=estimate).engine.run()
    assert (outcome.reason, outcome.looks) == ("done", 16) and not changes(tmp_path / "c")
    assert "proposed looks were not followed" in outcome.warnings[0]


def test_the_time_ends_a_run_before_it_is_over(mounted_rig, tmp_path):
    """Also one that goes on beyond the end of its plan."""
    plan = small_plan(3)
    minutes = plan_seconds(mounted_rig, plan) / 60 + 2
    with Replanning(tmp_path / "c", command(), 1e-9, minutes, wait=True) as estimate:
        run_ = Run(mounted_rig, tmp_path / "c", plan, estimate=estimate)
        assert run_.engine.run().reason == "time over"
    record = recorded(read_journal(tmp_path / "c").records)
    done = plan_seconds(mounted_rig, run_.engine.plan[: record.next_step]) / 60
    assert len(record.spots) > 12 and minutes - 0.1 < done <= minutes and record.unverified == ()


def test_a_resumed_run_has_the_plan_of_the_interrupted_one(mounted_rig, tmp_path):
    def go(folder, stop_at=None, **options):
        def show(progress):
            if progress.looks == stop_at and progress.doing == "looking":
                raise KeyboardInterrupt

        wish, adapt = EstimateWish((), 5.5e-4), AdaptWish(command(), 60.0)
        terminal = Terminal(show=show)
        return acquire(
            mounted_rig, small_plan(20), folder, simulate=True, seed=4, estimate=wish, adapt=adapt, terminal=terminal,
            **options,
        )  # fmt: skip

    with pytest.raises(KeyboardInterrupt):
        go(tmp_path / "c", stop_at=17)
    before = adapted_plan(small_plan(20), read_journal(tmp_path / "c").records)
    outcome = go(tmp_path / "c", resume=True)
    assert outcome.reason == "target met" and len(changes(tmp_path / "c")) > 2
    after = adapted_plan(small_plan(20), read_journal(tmp_path / "c").records)
    done = changes(tmp_path / "c")[2]["row"]
    assert after[:done] == before[:done] and before != tuple(small_plan(20))
    targets = [spot.target for spot in read_campaign(tmp_path / "c").spots]
    assert len(targets) == outcome.looks and targets[17:] == ["d2"] * (outcome.looks - 17)


def test_a_damaged_change_of_plan_is_refused(mounted_rig, tmp_path):
    from types import SimpleNamespace

    with pytest.raises(InputError, match="changed plan"):
        adapted_plan(
            small_plan(1), [SimpleNamespace(event="adapted", line=7, data={"row": 3, "steps": [{"action": "fly"}]})]
        )


def test_options_that_do_not_fit(capsys):
    assert run(["acquire", "rig.toml", "plan.csv", "out", "--simulate", "--adapt"]) == 2
    assert "--adapt needs a target" in capsys.readouterr().err
    assert run(["acquire", "rig.toml", "plan.csv", "out", "--simulate", "--minutes", "5"]) == 2
    assert "--minutes is for --adapt" in capsys.readouterr().err

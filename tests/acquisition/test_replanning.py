"""Looks chosen while a run goes on: followed, written down with their reasons, kept by a resumed run, within limits."""

from __future__ import annotations

import json
from contextlib import closing
from functools import partial

import pytest
from support.bench_runs import RIG_FILE, Run, events, small_plan
from support.fits_beside import given_rig, proposing, two_directions

from tvsbayes.acquisition.journal import Journal, Record, read_journal
from tvsbayes.acquisition.operator import Terminal
from tvsbayes.acquisition.replanning import (
    AdaptOptions,
    Proposal,
    Replanning,
    adapted_entries,
    adapted_plan,
    looks_next,
)
from tvsbayes.acquisition.running_estimate import EstimateOptions
from tvsbayes.acquisition.session import acquire
from tvsbayes.cli.main import run
from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.plan import PlanStep, plan_minutes, write_plan


def ahead(sheet: str = "d2", step: int = 5, ratio: float = 1.0, accepted: bool = True):
    """See `support.fits_beside.proposing`."""
    return partial(proposing, sheet, step, ratio, accepted)


def test_the_looks_left_are_those_proposed(mounted_rig, tmp_path):
    """Proposals at 12, 15, 18, 22 and 27 looks; 4.6e-4 is met at the last."""
    plan = small_plan(20)
    with Replanning(tmp_path / "c", ahead(), 4.6e-4, 60.0, wait=True) as estimate:
        run_ = Run(mounted_rig, tmp_path / "c", plan, estimate=estimate)
        outcome = run_.engine.run()
    assert (outcome.reason, outcome.looks) == ("target met", 27) and run_.dark() and not outcome.warnings
    changed = events(tmp_path / "c", "adapted")
    assert [event["looks"] for event in changed] == [12, 15, 18, 22]
    assert changed[0]["why"] == "8 looks at d2 help most"
    looks = [step for step in changed[0]["steps"] if step["action"] == "look"]
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
    names = [record.event for record in records]
    assert names[names.index("adapted") :].count("placed") == 1
    assert adapted_plan(plan, records) == run_.engine.plan


def test_the_sampled_posterior_has_the_last_word(mounted_rig, tmp_path):
    """Half as much again as Laplace: 27 looks (4.4e-4) are not enough, 33 (3.6e-4) not worth sampling, 40 are."""
    with Replanning(tmp_path / "c", ahead(ratio=1.5), 4.6e-4, 60.0, wait=True) as estimate:
        outcome = Run(mounted_rig, tmp_path / "c", small_plan(20), estimate=estimate).engine.run()
    assert (outcome.reason, outcome.looks) == ("target met", 40)
    confirmed = events(tmp_path / "c", "confirmed")
    assert [(event["looks"], event["reached"]) for event in confirmed] == [(27, False), (40, True)]
    assert confirmed[0]["importance_u_deg_per_step"] == pytest.approx(1.5 * confirmed[0]["laplace_u_deg_per_step"])
    assert [event["looks"] for event in events(tmp_path / "c", "adapted")] == [12, 15, 18, 22, 27, 33]
    assert outcome.as_json()["estimate"]["tier"] == "importance"
    assert outcome.estimate.looks == 40 and set(outcome.estimate.deg_per_step.values()) == {0.061}


def test_weights_that_cannot_be_used_end_no_run(mounted_rig, tmp_path):
    minutes = plan_minutes(mounted_rig, small_plan(3)) + 2.5
    with Replanning(tmp_path / "c", ahead(accepted=False), 4.6e-4, minutes, wait=True) as estimate:
        outcome = Run(mounted_rig, tmp_path / "c", small_plan(3), estimate=estimate).engine.run()
    confirmed = events(tmp_path / "c", "confirmed")
    assert outcome.reason == "time over" and outcome.looks > 33 and outcome.estimate.tier == "laplace"
    assert [event["looks"] for event in confirmed][:2] == [27, 33] and not any(event["reached"] for event in confirmed)


def test_a_proposal_of_many_looks_fits_into_the_journal(tmp_path):
    """The largest request, with the longest counters and u."""
    assert (looks_next(12), looks_next(100)) == (8, 30)
    count = looks_next(100_000)
    pairs = [(PlanStep(0, "move", -12345, -12345), PlanStep(0, "look")) for _ in range(count)]
    steps = tuple(step for pair in pairs for step in pair)
    u = tuple(0.00012345678901234567 + n * 1e-17 for n in range(count))
    proposal = Proposal(steps, u, u[0], 100_000, "80 looks at d1, d2 lower u(worst) most per minute" + 80 * ".")
    with closing(Journal.create(tmp_path / "c", created="2026-01-01T00:00:00+00:00")) as journal:
        entries = adapted_entries(proposal, 99_999, steps).entries()
        assert journal.append(entries.pop("event"), **entries).event == "adapted"


def test_the_command_says_by_what_it_ended(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("tvsbayes.cli.acquire_command.propose_looks", partial(given_rig, "d2", 5, 1.0, True))
    write_plan(small_plan(4), tmp_path / "plan.csv")
    words = [
        "acquire",
        RIG_FILE,
        tmp_path / "plan.csv",
        tmp_path / "c",
        "--simulate",
        "--centroids",
        "--adapt",
        "--target-u",
        "8e-4",
    ]
    assert run([*map(str, words), "--json"]) == 0
    estimate = json.loads(capsys.readouterr().out)["estimate"]
    assert (estimate["tier"], estimate["looks"]) == ("importance", 15)
    assert estimate["effective_deg_per_step"]["up"] == {"value": 0.061, "sd": pytest.approx(8e-4)}
    assert run([*map(str, [*words[:3], tmp_path / "d", *words[4:]])]) == 0
    line = "deg/step by the sampled posterior of 15 looks: left 0.06100(80)"
    assert line in capsys.readouterr().out


@pytest.mark.parametrize(("sheet", "step"), [("d9", 5), ("d2", 5000)])
def test_a_proposal_that_the_rig_cannot_run_is_not_followed(mounted_rig, tmp_path, sheet, step):
    with Replanning(tmp_path / "c", ahead(sheet, step), 1e-9, 60.0, wait=True) as estimate:
        outcome = Run(mounted_rig, tmp_path / "c", small_plan(4), estimate=estimate).engine.run()
    assert (outcome.reason, outcome.looks) == ("done", 16) and not events(tmp_path / "c", "adapted")
    assert "proposed looks were not followed" in outcome.warnings[0]


def test_a_resumed_run_has_the_plan_of_the_interrupted_one(mounted_rig, tmp_path):
    def go(folder, stop_at=None, **options):
        def show(progress):
            if progress.looks == stop_at and progress.doing == "looking":
                raise KeyboardInterrupt

        wish, adapt = EstimateOptions(two_directions, 5.5e-4), AdaptOptions(ahead(), 60.0)
        terminal = Terminal(show=show)
        return acquire(
            mounted_rig, small_plan(20), folder, simulate=True, seed=4, estimate=wish, adapt=adapt, terminal=terminal,
            **options,
        )  # fmt: skip

    with pytest.raises(KeyboardInterrupt):
        go(tmp_path / "c", stop_at=17)
    before = adapted_plan(small_plan(20), read_journal(tmp_path / "c").records)
    outcome = go(tmp_path / "c", resume=True)
    assert outcome.reason == "target met" and len(events(tmp_path / "c", "adapted")) > 2
    after = adapted_plan(small_plan(20), read_journal(tmp_path / "c").records)
    done = events(tmp_path / "c", "adapted")[2]["row"]
    assert after[:done] == before[:done] and before != tuple(small_plan(20))
    targets = [spot.target for spot in read_campaign(tmp_path / "c").spots]
    assert len(targets) == outcome.looks and targets[17:] == ["d2"] * (outcome.looks - 17)


def test_a_damaged_change_of_plan_is_refused(mounted_rig, tmp_path):
    data = {"row": 3, "looks": 4, "why": "", "steps": [{"action": "fly"}]}
    without = {**data, "steps": [{"action": "move", "pan_steps": 3}]}
    for entries, fault in ((data, "fly"), (without, "move"), ({**data, "row": "3"}, "row")):
        with pytest.raises(InputError, match=f"line 7: .*{fault}.*entries of the event adapted"):
            adapted_plan(small_plan(1), [Record(0, "adapted", entries, 7)])


def test_options_that_do_not_fit(capsys):
    assert run(["acquire", "rig.toml", "plan.csv", "out", "--simulate", "--adapt"]) == 2
    assert "--adapt needs a target" in capsys.readouterr().err
    assert run(["acquire", "rig.toml", "plan.csv", "out", "--simulate", "--minutes", "5"]) == 2
    assert "--minutes is for --adapt" in capsys.readouterr().err

"""`plan`, `check RIG PLAN` and `study` as commands."""

from __future__ import annotations

import pytest
from msgspec import structs
from support.commands import MOUNTED

from tvsbayes.instrument.plan import read_plan
from tvsbayes.planning import planner

pytestmark = pytest.mark.usefixtures("small_searches", "own_compilation_cache")


@pytest.mark.thorough
def test_plan_writes_a_plan_and_its_exit_code_states_whether_the_target_is_met(ask, say, tmp_path, monkeypatch):
    whole, plans = planner.plan, []
    small = ("--draws", 20, "--minutes", 3, "-o", tmp_path / "plan.csv")
    monkeypatch.setattr(planner, "plan", lambda *args, **options: plans.append(whole(*args, **options)) or plans[0])
    code, document = ask("plan", MOUNTED / "rig.toml", "--target", "u(left) <= 1e-7 deg/step", *small)
    assert code == 1 and not document["met"] and document["n80"] is None
    assert document["limited_by"]["reachable"] is False and document["limited_by"]["needed"]
    assert sum(s.action == "look" for s in read_plan(tmp_path / "plan.csv")) == document["looks"]
    assert document["minutes"] <= 3 and plans[0].draws == 20
    monkeypatch.setattr(planner, "plan", lambda *_, **__: plans[0])
    code, document = ask("plan", MOUNTED / "rig.toml", *small)
    assert code == 0 and not document["met"], "the default target is nobody's demand"
    monkeypatch.setattr(planner, "plan", lambda *_, **__: structs.replace(plans[0], met=True))
    code, document = ask("plan", MOUNTED / "rig.toml", "--target", "u(left) <= 5e-3 deg/step", *small)
    assert code == 0 and document["met"]
    # Nothing is left to measure.
    monkeypatch.setattr(planner, "plan", lambda *_, **__: structs.replace(plans[0], steps=()))
    place = tmp_path / "none.csv"
    code, text, _ = say("plan", MOUNTED / "rig.toml", "-o", place)
    assert code == 0 and not place.exists() and f"nothing written to {place}" in text


@pytest.mark.usefixtures("quick")
def test_study_states_the_assurance_of_the_users_target(ask, tmp_path):
    rows = ("--n", 8, "--rows", tmp_path / "rows.jsonl")
    target = ("--target", "u(worst) <= 1e-3 deg/step")
    code, document = ask("study", MOUNTED / "rig.toml", MOUNTED / "grid.csv", *rows, *target)
    assert code == 1 and document["assurance"] == 0.75, "three of four invented fits meet it, 80 % are asked"
    assert document["campaigns"] == 8 and (tmp_path / "rows.jsonl").read_bytes().count(b"\n") == 8
    code, _ = ask("study", MOUNTED / "rig.toml", MOUNTED / "grid.csv", *rows)
    assert code == 0
    assert ask("study", MOUNTED / "rig.toml", MOUNTED / "grid.csv", *rows)[1]["target"]["limit"] == 2e-4
    # A plan that states its target is judged by it.
    plan = tmp_path / "plan.csv"
    names, first, *others = (MOUNTED / "grid.csv").read_text().splitlines()
    for made_for, expected in (("u(left) <= 3e-4 deg/step", 3e-4), ("u(left) <= 3 mm", None)):
        rest = [f"{line}," for line in others]
        plan.write_text("\n".join([f"{names},made_for", f"{first},{made_for}", *rest]) + "\n")
        code, document = ask("study", MOUNTED / "rig.toml", plan, "--n", 2)
        if expected is None:
            assert code == 2 and (document["error"]["column"], document["error"]["file"]) == ("made_for", "plan.csv")
        else:
            assert code == 0 and document["target"]["limit"] == expected
            assert ask("study", MOUNTED / "rig.toml", plan, *rows, *target)[1]["target"]["limit"] == 1e-3
    code, document = ask("study", MOUNTED / "rig.toml", MOUNTED / "grid.csv", "--engine", "cloud")
    assert code == 2 and document["error"]["column"] == "--engine"

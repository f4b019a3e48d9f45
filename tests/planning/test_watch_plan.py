"""Looks planned for a watch: powers are those of the looks taken, the budget holds, what is out of reach is named."""

from __future__ import annotations

from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from support.commands import MOUNTED
from support.fit_documents import shipped_schema

from tvsbayes.comparison.departures import POWER_MIN, null_distribution, powers
from tvsbayes.comparison.watched_looks import CHANGES, WatchedLooks
from tvsbayes.errors import InputError
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.plan import plan_minutes, read_plan
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.instrument.rig import read_rig
from tvsbayes.planning import watch_plan as plans
from tvsbayes.planning.watch_plan import WatchDesigns, watch_plan
from tvsbayes.twin.simulated_campaign import simulate

pytestmark = pytest.mark.thorough

RIG = MOUNTED / "rig.toml"
NAMES = [change.what for change in CHANGES]


@pytest.fixture(scope="module")
def measured():
    """A first day on the shipped rig, whose gears repeat errors and drift."""
    return simulate(read_rig(RIG), four_point_protocol(repeats=3, steps=(100, 200)), seed=2)


@pytest.fixture(scope="module")
def watched_fit(measured):
    return fit(measured.campaign)


@pytest.fixture(scope="module")
def planned(watched_fit):
    return watch_plan(watched_fit)


@pytest.fixture(scope="module")
def designs(watched_fit):
    return WatchDesigns(watched_fit, None, 0)


def test_the_plan_notices_what_it_states(planned, measured, watched_fit, designs):
    """Its looks, taken on the twin and watched: the powers of `watch` are those of the plan."""
    taken = simulate(read_rig(RIG), planned.steps, seed=5, truth=measured.truth).campaign
    assert len(taken.spots) == planned.looks <= 384 and planned.minutes <= planned.minutes_allowed == 10
    assert sum(step.action == "home" for step in planned.steps) == planned.homings
    departure = WatchedLooks(watched_fit, taken).departure(designs.z)
    shares = powers(departure, null_distribution(departure, 0).limit, 0)
    # Pixels elsewhere by their noise and by stops change slopes by a percent.
    np.testing.assert_allclose(shares, [change.power for change in planned.changes], atol=0.03)


def test_what_is_out_of_reach_is_reported(planned):
    by_name = {change.what: change for change in planned.changes}
    assert list(by_name) == NAMES and not planned.met
    # 0.3 % of a ratio over 200 steps is 0.036 deg, and the first day determines it to 0.4 %.
    ratio = by_name["ratio: pan"]
    assert ratio.power < POWER_MIN and ratio.looks_needed is None and ratio.looks_to_add > 100
    cameras = by_name["cameras: shift"]
    assert cameras.power >= POWER_MIN and 4 <= cameras.looks_needed <= planned.looks and cameras.looks_to_add is None


def test_independent_stops_add_up_to_the_plan_itself(designs):
    """The information that patterns are searched by, against the moves through the filter."""
    pattern = designs.grown(("d1", "d2"), 4.0)[2]
    limit = np.log(0.01 / len(CHANGES))
    for homings in (1, 3):
        np.testing.assert_allclose(designs.powers(pattern, homings), designs.own_powers(pattern, homings), atol=0.06)
    # More homings with the same looks, never less seen; a turned positioner gains most.
    few, many = (designs.powers(pattern, homings) for homings in (1, 7))
    assert np.all(many >= few - 1e-9) and limit < 0
    one_homing = {sheet: looks * 7 for sheet, looks in pattern.items()}
    turned = NAMES.index("positioner: rotation")
    assert designs.powers(one_homing, 1)[turned] < many[turned]


def test_candidates_keep_to_the_limits(designs, watched_fit, monkeypatch):
    reached = {axis: [getattr(m, f"{axis}_steps") for m in watched_fit.campaign.moves] for axis in ("pan", "tilt")}
    steps = designs.steps(designs.grown(("d2",), 1.0)[-1], 2)
    for axis, counters in reached.items():
        moved = [getattr(step, f"{axis}_steps") for step in steps if step.action in ("home", "move")]
        assert min(counters) <= min(moved) and max(moved) <= max(counters)
    # A run-up longer than the travel leads beyond it, whatever the look.
    monkeypatch.setitem(designs.__dict__, "_run_up", np.array([1000, 1000]))
    assert not any(map(designs._reachable, designs.candidates))


def test_looks_keep_to_the_sheets_of_the_rig(watched_fit):
    """The campaign looked at d1 and d2."""
    rig = read_rig(RIG)
    designs = WatchDesigns(watched_fit, replace(rig, sheets_mm={"d2": 275.0}), 0)
    assert {one.spot.target for one in designs.candidates} == {"d2"}
    with pytest.raises(InputError, match="sheets that the rig does not have"):
        WatchDesigns(watched_fit, replace(rig, sheets_mm={"wall": 275.0}), 0)


def test_a_short_budget_is_kept_or_refused(watched_fit, monkeypatch):
    tried, kept = plans._Trials, []
    monkeypatch.setattr(plans, "_Trials", lambda designs: (kept or kept.append(tried(designs)) or kept)[0])
    short = watch_plan(watched_fit, read_rig(RIG), minutes=2.0)
    assert short.minutes <= 2 and short.looks >= 4
    with pytest.raises(InputError, match="4 looks take"):
        watch_plan(watched_fit, read_rig(RIG), minutes=0.5)  # a placement alone takes one


def test_the_command_writes_the_plan(ask, say, watched_fit, planned, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(
        "tvsbayes.planning.watch_plan.watch_plan", lambda *rest, **named: calls.append((rest[1], named)) or planned
    )
    monkeypatch.setattr("tvsbayes.pipeline.StoredOrFitted.fit", watched_fit)
    monkeypatch.setattr("tvsbayes.instrument.campaign.read_campaign", lambda _: watched_fit.campaign)
    out, rig = tmp_path / "looks.csv", read_rig(RIG)
    code, document = ask("plan", RIG, "--given", "mine", "--watch", "--minutes", "3", "-o", out)
    jsonschema.validate(document, shipped_schema("watch-plan-1"))
    steps = read_plan(out)
    assert (code, document["plan"]) == (0, str(out))
    assert sum(step.action == "look" for step in steps) == document["looks"]
    assert plan_minutes(rig, steps) == pytest.approx(document["minutes"], abs=1e-9)
    code, text, _ = say("plan", "mine", "--watch")
    assert code == 0 and calls[0][0].costs_s == rig.costs_s and calls[1][0] is None
    assert [named["minutes"] for _, named in calls] == [3, 10]
    assert "no number of looks improves that: the campaign determines it too poorly: add about" in text
    code, _, log = say("plan", "mine", "--watch", "--target", "u(worst) <= 1e-4 deg/step")
    assert code == 2 and "--target is for targets" in log

"""The next looks of a running campaign: predicted is what a fit of them reports, and they stay in reach."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.commands import MOUNTED

from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.plan import PlanStep, run_plan
from tvsbayes.instrument.protocols import grid_protocol
from tvsbayes.instrument.stops import counters_made, rests_of
from tvsbayes.planning.candidates import counter_range, expected_run_up
from tvsbayes.planning.expectation import Knowledge, information_of, knowledge_of
from tvsbayes.planning.next_looks import Confirmation, next_looks
from tvsbayes.planning.target import parse_target, sensitivity
from tvsbayes.posterior.draws import Draws
from tvsbayes.results.estimates import Measured
from tvsbayes.results.plan_record import steps_of
from tvsbayes.statistics.optimal_design import covariance_of
from tvsbayes.twin.simulated_campaign import SimulatedCampaign, simulate

SAMPLED = Confirmation("importance", False, dict.fromkeys(DIRECTIONS, Measured(0.06, 3e-4, (0.0594, 0.0606))))
TARGET = parse_target("u(worst) <= 1e-4 deg/step")


def begun(rig, looks: int) -> tuple[PlanStep, ...]:
    """The grid up to so many looks on the first sheet."""
    plan = grid_protocol(targets=("d1",), pan_steps=(-60, 60, 180), tilt_steps=(-90, 30))
    rows = [step.step for step in plan if step.action == "look"]
    return plan[: rows[looks - 1] + 1]


@pytest.fixture(scope="module")
def first(mounted_rig) -> SimulatedCampaign:
    return simulate(mounted_rig, begun(mounted_rig, 12), seed=8)


@pytest.fixture(scope="module")
def begun_fit(first):
    return fit(first.campaign)


@pytest.fixture(scope="module")
def proposal(begun_fit, mounted_rig):
    return next_looks(begun_fit, mounted_rig, TARGET, 12)


def whole_plan(rig, proposal) -> tuple[PlanStep, ...]:
    """The plan so far with the proposal behind it."""
    before = begun(rig, 12)
    return (*before, *steps_of(proposal.steps, len(before)))


def laplace_sds(proposal) -> list[float]:
    return [ratio.sd for ratio in proposal.effective_deg_per_step.values()]


def test_what_is_promised_is_the_information_of_the_whole_run(proposal, mounted_rig, begun_fit):
    """The plan so far and the proposal through the filter, move by move, at the point of the fit."""
    assert proposal.now == pytest.approx(max(laplace_sds(proposal)), rel=0.1)
    assert proposal.expected == proposal.after_each[-1] < 0.7 * proposal.now
    assert np.all(np.diff([proposal.now, *proposal.after_each]) < 1e-12)
    after = knowledge_of(begun_fit, mounted_rig)
    before = Knowledge(after.rig, after.space, after.z, np.eye(after.size))
    information = information_of(whole_plan(mounted_rig, proposal), before)
    at = sensitivity(TARGET, after.z, after.space, after.rig.table, begun_fit.reference_pose_rad, before.gears)
    value = at.value(covariance_of(before.precision + information.fisher), TARGET.factor)
    # The fit's Hessian beside Fisher's information of the first looks: a few percent.
    assert proposal.expected == pytest.approx(value, rel=0.1)


def test_every_look_is_reached_with_a_run_up_inside_the_limits(proposal, mounted_rig, begun_fit):
    """Limits are not stated: what was commanded is the limit."""
    limits, _ = counter_range(mounted_rig.limits, counters_made(begun_fit.campaign.moves))
    least = expected_run_up(knowledge_of(begun_fit, mounted_rig))
    assert proposal.steps[0].action == "place" and sum(step.action == "look" for step in proposal.steps) == 12
    log = run_plan(whole_plan(mounted_rig, proposal), mounted_rig)
    for axis, (low, high), needed in zip(AXES, limits, least, strict=True):
        rests = rests_of(log.moves, axis)
        for look in log.looks[12:]:
            assert low <= rests[look.move].steps <= high and rests[look.move].leg >= needed
    first_move = next(step for step in proposal.steps if step.action == "move")
    after = proposal.steps[proposal.steps.index(first_move) + 1]
    run_up = np.abs(np.array([after.pan_steps, after.tilt_steps]) - [first_move.pan_steps, first_move.tilt_steps])
    assert np.all(run_up >= least), "wherever the axes stood"


def counters(proposal, axis: str) -> list[int]:
    return [c for step in steps_of(proposal.steps) if (c := getattr(step, f"{axis}_steps")) is not None]


def test_looks_go_on_to_what_a_running_plan_allows_and_never_by_an_added_move(begun_fit, mounted_rig):
    made = counters_made(begun_fit.campaign.moves)
    wider = {axis: (low - 40, high + 40) for axis, (low, high) in made.items()}
    planned = next_looks(begun_fit, mounted_rig, TARGET, 8, planned=wider)
    for axis, (low, high) in made.items():
        assert low - 40 <= min(counters(planned, axis)) and max(counters(planned, axis)) <= high + 40
    assert any(not low <= counter <= high for axis, (low, high) in made.items() for counter in counters(planned, axis))
    far = replace(begun_fit.campaign.moves[-1], pan_steps=5000, tilt_steps=-5000, assumed=1)
    assert counters_made((*begun_fit.campaign.moves, far)) == made


def test_a_sheet_that_stands_there_costs_nothing(proposal):
    """Of equally good looks those without a placement come first: minutes say so."""
    placements = [step.target for step in proposal.steps if step.action == "place"]
    seconds = 60 * proposal.minutes
    cost_s = sum({"place": 60.0, "move": 1.5, "look": 1.0}[step.action] for step in proposal.steps)
    assert seconds == pytest.approx(cost_s - 60.0 * (placements[0] == "d1"))


def test_the_posterior_confirms_on_request(begun_fit, mounted_rig, proposal, monkeypatch):
    """In place of draws of the posterior those of Laplace, spread by half as much again."""
    tiers = []

    def sample(fit, tier):
        def propagate(quantity):
            values = quantity(Draws(fit.draws, fit.space.mechanism))
            mean, sd = values.mean(axis=0), 1.5 * values.std(axis=0)
            return SimpleNamespace(mean=mean, sd=sd, interval95=np.stack([mean - 2 * sd, mean + 2 * sd]))

        tiers.append(tier)
        return SimpleNamespace(converged=True, propagate=propagate)

    monkeypatch.setattr("tvsbayes.planning.next_looks.sample", sample)
    worst = max(laplace_sds(proposal))
    assert proposal.confirmed is None
    assert next_looks(begun_fit, mounted_rig, TARGET, 2, confirm_below=0.99 * worst).confirmed is None and not tiers
    confirmed = next_looks(begun_fit, mounted_rig, TARGET, 2, confirm_below=1.01 * worst).confirmed
    assert confirmed.accepted and tiers == ["importance"]
    for direction, ratio in proposal.effective_deg_per_step.items():
        sampled = confirmed.effective_deg_per_step[direction]
        assert sampled.sd == pytest.approx(1.5 * ratio.sd)
        low, high = sampled.interval95
        assert high - low == pytest.approx(6 * ratio.sd) and low < ratio.value < high


def test_the_command_prints_them(ask, say, begun_fit, monkeypatch):
    rig = MOUNTED / "rig.toml"
    monkeypatch.setattr("tvsbayes.pipeline.StoredOrFitted.fit", begun_fit)
    monkeypatch.setattr("tvsbayes.instrument.campaign.read_campaign", lambda _: begun_fit.campaign)
    code, document = ask("plan", rig, "--given", "mine", "--next", 8)
    assert code == 0 and sum(step["action"] == "look" for step in document["steps"]) == len(document["after_each"]) == 8
    assert document["steps"][0]["action"] == "place" and "most per minute" in document["why"]
    assert document["confirmed"] is None
    monkeypatch.setattr("tvsbayes.planning.next_looks.confirmation", lambda _: SAMPLED)
    confirmed = ("plan", rig, "--given", "mine", "--next", 2, "--confirm", 1)
    code, document = ask(*confirmed)
    assert (code, document["confirmed"]) == (0, SAMPLED.as_json())
    code, text, _ = say(*confirmed)
    assert code == 0
    assert "u by importance sampling, whose weights must not be used, deg/step: left 3.00e-04" in text
    for wrong, word in (
        (("--confirm", 1), "for --next"),
        (("--next", 8), "--given"),
        (("--given", "mine", "--next", 8, "-o", "x.csv"), "-o"),
    ):
        code, _, log = say("plan", rig, *wrong)
        assert code == 2 and word in log

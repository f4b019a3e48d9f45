"""Information of a plan is that of its fit, move by move."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from support.coarse_planning import ROUNDING
from support.commands import steps
from support.dozen_spots import dozen_plan

from tvsbayes.estimators.mode_search import Problem
from tvsbayes.gears.priors import half_normal_coordinate
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.plan import PlanBuilder, PlanStep, plan_minutes, run_plan
from tvsbayes.instrument.protocols import four_point_protocol, paper_protocol
from tvsbayes.planning.drawn_rigs import instruments_in
from tvsbayes.planning.expectation import (
    design_arrays,
    expect,
    information_of,
)
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth, draw_truth

pytestmark = pytest.mark.usefixtures("small_searches")


def test_a_plans_information_is_the_fits_own(mounted_rig, knowledge, monkeypatch):
    """Same point, same looks: segments with home offsets, shared stops, half-open play (the dozen)."""
    monkeypatch.setattr("tvsbayes.twin.simulated_campaign.SHEET_DEPTH_SD_MM", 0.0)
    monkeypatch.setattr("tvsbayes.twin.simulated_campaign.SHEET_TILT_SD_DEG", 0.0)
    # Cameras as stated: a campaign is triangulated with the stated ones, a plan's sheets stand where they stand.
    drawn = draw_truth(mounted_rig, np.random.default_rng(3)).parameters | {"focal_scale": 1.0}
    z = instruments_in(knowledge, [Truth(drawn, mounted_rig.stereo)]).z[0]
    # Homings of this run leave the zeros where they are; fit and plan do not know it.
    quiet = {name: 0.0 for name in drawn if name.startswith(("stop_sd_deg", "home_sd_deg"))} | {"pixel_scale": 0.0}
    run = simulate(mounted_rig, dozen_plan(), 4, Truth({**drawn, **quiet}, mounted_rig.stereo), aperture=True)
    assert all(spot.status == "ok" for spot in run.campaign.spots)
    problem = Problem(run.campaign, mounted_rig.table)
    with jax.enable_x64(True):
        of_fit = problem.information(problem.linearised(z)).fisher
    planned = information_of(dozen_plan(), knowledge, aperture=True, z=z).fisher
    scale = np.sqrt(np.diag(of_fit))
    safe = np.where(scale > 0, scale, 1.0)
    # The spots are triangulated from pixels without noise: linear triangulation is exact to 1e-9 of its point.
    assert np.abs(planned / np.outer(safe, safe) - of_fit / np.outer(safe, safe)).max() < 1e-6
    assert (scale[~knowledge.noise] > 0).sum() > 40


def test_looks_that_scatter_tell_a_plan_less(knowledge):
    """Every stop looked at once: information follows the sum of both variances, and falls with it."""
    plan = PlanBuilder()
    plan.home(0, 0)
    plan.place("d1")
    for pan, tilt in ((0, 0), (60, 40), (100, -20), (20, 60), (140, 10)):
        plan.move(pan, tilt)
        plan.look()
    fishers = {}
    for stop_deg, scatter_deg in ((0.05, 0.0), (0.03, 0.04), (0.03, 0.0)):
        z, space = knowledge.z.copy(), knowledge.space
        for name, index in TWO_MIRROR.index.items():
            if name.startswith("stop_sd_deg"):
                z[index] = np.log(stop_deg / float(space.value[index])) / float(space.u[index])
            if name.startswith("look_scatter_deg"):
                z[[index]] = half_normal_coordinate(np.array([scatter_deg / float(space.u[index])]))
        fishers[stop_deg, scatter_deg] = information_of(plan.steps, knowledge, z=z).fisher
    both, sum_alone, less = fishers[0.03, 0.04], fishers[0.05, 0.0], fishers[0.03, 0.0]
    np.testing.assert_allclose(both, sum_alone, atol=1e-9 * np.abs(sum_alone).max())
    ratio = TWO_MIRROR.index["degrees_per_step.pan"]
    assert both[ratio, ratio] < 0.9 * less[ratio, ratio]


@pytest.mark.parametrize("moves", [256, 257])
def test_arrays_hold_every_move_of_a_plan(mounted_rig, moves):
    """One move more than twice the smallest number of looks: a homing and two moves per look, 128 times."""
    orders = (("home", 0, 0), ("place", "d1"), *(("move", n, 0) for n in range(2, moves + 1)), ("look",))
    log = run_plan(steps(*orders), mounted_rig, ("left", "up"))
    arrays = design_arrays(log.moves, [moves - 1], mounted_rig, homed_from=1, aperture=False)
    assert len(log.moves) == moves and np.array_equal(arrays.moves.steps[:moves, 0], [m.pan_steps for m in log.moves])


def test_plans_of_any_ordinary_size_share_one_trace(knowledge):
    information_of(paper_protocol(1), knowledge)
    traces = expect.traces
    for plan in (paper_protocol(1)[:7], four_point_protocol(30), paper_protocol()):
        information_of(plan, knowledge)
    assert expect.traces == traces


def test_looks_that_miss_an_image_tell_nothing(knowledge):
    """1000 steps turn the beam by 60 degrees, out of the images."""
    steps = list(paper_protocol(1))
    more = (*steps, PlanStep(len(steps), "move", 1000, 0), PlanStep(len(steps) + 1, "look"))
    information = information_of(more, knowledge)
    assert not information.expectation.seen[-1]
    assert information.expectation.seen[:-1].all()
    assert information.fisher == pytest.approx(information_of(steps, knowledge).fisher, rel=ROUNDING)


def test_minutes_of_a_plan_by_hand(mounted_rig):
    """A homing counts as a move: 2 + 60 + 2 + 3 + 3 = 70 s."""
    rig = replace(mounted_rig, costs_s={"move_s": 2.0, "look_s": 3.0, "placement_s": 60.0})
    plan = steps(("home", 0, 0), ("place", "d1"), ("move", 50, 0), ("look",), ("look",))
    assert plan_minutes(rig, plan) == pytest.approx(70 / 60, rel=1e-12)

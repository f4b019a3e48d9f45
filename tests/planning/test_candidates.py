"""Looks that a rig can make: limits, run-ups, full turns; they add up to the plan they make."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.coarse_planning import with_priors
from support.commands import steps

from tvsbayes.errors import InputError
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import Prior
from tvsbayes.planning.candidates import candidates, from_all_sides, run_up_steps
from tvsbayes.planning.expectation import information_of, prior_knowledge
from tvsbayes.planning.looks import Looks, arrange
from tvsbayes.planning.plan_check import check_plan
from tvsbayes.planning.target import parse_target, sensitivity
from tvsbayes.statistics.optimal_design import covariance_of

pytestmark = pytest.mark.usefixtures("small_searches")


def test_a_run_up_takes_up_play_and_stops_of_its_own_axis():
    """By hand: 1.5 (0.3 + 4 x 0.05) / 0.06 = 12.5 steps of pan, 1.5 (0.1 + 4 x 0.02) / 0.07 = 3.9 of tilt."""
    physical = np.zeros(len(TWO_MIRROR.names))
    values = {"degrees_per_step.pan": -0.06, "degrees_per_step.tilt": 0.07}
    values |= {"stop_sd_deg.left": 0.01, "stop_sd_deg.right": 0.05, "stop_sd_deg.up": 0.02, "stop_sd_deg.down": 0.01}
    for name, value in values.items():
        physical[TWO_MIRROR.index[name]] = value
    np.testing.assert_array_equal(run_up_steps(physical, TWO_MIRROR, np.array([0.3, 0.1])), [13, 4])


def test_limits_are_kept(mounted_rig, pool):
    """Stated limits bind every counter of a plan, run-ups included; without them the grid's own range does."""
    tight = {"pan_min_steps": 0, "pan_max_steps": 150, "tilt_min_steps": -70, "tilt_max_steps": 90}
    known = prior_knowledge(replace(mounted_rig, positioner=tight))
    inside = candidates(known)
    arranged = arrange(inside.looks, known.sheets, inside.run_up)
    moves = np.array([(s.pan_steps, s.tilt_steps) for s in arranged.steps if s.action == "move"])
    low, high = np.array([0, -70]), np.array([150, 90])
    # The images reach beyond these limits: the outermost looks stand on them, and no run-up goes past.
    for counters in (moves, inside.looks.steps):
        assert (counters.min(axis=0) == low).all() and (counters.max(axis=0) == high).all()
    assert not inside.notes
    assert "pan_min_steps" in pool.notes[0] and "pan -100 to 280" in pool.notes[0]
    assert np.abs(pool.looks.steps).max() <= 280


@pytest.mark.thorough
def test_a_full_turn_waits_until_the_ratio_is_known(mounted_rig):
    """Two stops over 360 deg hold k to a stop error over 6000 steps, whatever the cameras; once the spot is found."""
    limits = {"pan_min_steps": -100, "pan_max_steps": 6100, "tilt_min_steps": -130, "tilt_max_steps": 130}
    wide = replace(mounted_rig, positioner=limits)
    unknown = candidates(prior_knowledge(wide))
    assert not unknown.turned.any()
    assert "not yet known well enough" in " ".join(unknown.notes)
    sharp = prior_knowledge(with_priors(wide, degrees_per_step__pan=Prior(0.06, 1e-5)))
    turned = candidates(sharp)
    assert np.array_equal(turned.turned, turned.looks.steps[:, 0] > 3000)
    assert turned.turned.any() and turned.looks.steps.max() <= 6100
    vague = prior_knowledge(with_priors(wide, degrees_per_step__pan=Prior(0.06, 1e-3)))
    away = np.flatnonzero(turned.looks.steps[:, 0] > 3000)[:2]
    twins = turned.looks.steps[away] - np.array([6000, 0])
    looks = Looks(
        np.concatenate([turned.looks.steps[away], twins]),
        np.tile(turned.looks.side[away], (2, 1)),
        np.tile(turned.looks.sheet[away], 2),
    )
    steps = arrange(looks, vague.sheets, turned.run_up).steps
    ratio = parse_target("u(left) <= 1e-5 deg/step")
    information = information_of(steps, vague)
    covariance = covariance_of(vague.precision + information.fisher)
    # The whole way out went left: it is k_left = k + c / 2 that the turn measures.
    left = np.zeros(len(TWO_MIRROR.names))
    left[[TWO_MIRROR.index["degrees_per_step.pan"], TWO_MIRROR.index["ratio_contrast_deg_per_step.pan"]]] = 1e-3, 1e-4
    k = math.sqrt(left @ covariance @ left)
    stop_deg = 0.04
    assert k < 2 * stop_deg / 6000
    at = sensitivity(ratio, vague.z, vague.space, vague.rig.table, information.pose_rad)
    assert at.value(covariance) > 10 * k, "the slope of the beam still depends on the mirrors"


def test_limits_too_narrow_for_a_run_up_are_refused_with_its_length(mounted_rig):
    narrow = {"pan_min_steps": 0, "pan_max_steps": 20, "tilt_min_steps": -10, "tilt_max_steps": 10}
    rig = replace(mounted_rig, positioner=narrow)
    with pytest.raises(InputError, match="no look has room for a run-up of") as refused:
        candidates(prior_knowledge(rig))
    assert "[positioner]" in refused.value.remedy
    check = check_plan(rig, steps(("place", "d1"), ("look",)))
    assert [f.addition for f in check.faults] == [(), ()]
    assert any("no looks can be added on this rig" in w for w in check.warnings)


def test_a_rig_without_sheets_is_refused(mounted_rig):
    with pytest.raises(InputError, match="no sheets"):
        candidates(prior_knowledge(replace(mounted_rig, sheets_mm={})))


LIMITS = np.array([[0, 100], [-50, 50]])
OVERSHOOT = np.array([10, 20])


@pytest.mark.parametrize(
    ("position", "sides"),
    [
        ((50, 0), {(1, 1), (1, -1), (-1, 1), (-1, -1)}),
        # From the left the run-up begins 10 steps below, from the right 10 above; up 20 below, down 20 above.
        ((5, 0), {(-1, 1), (-1, -1)}),
        ((95, 0), {(1, 1), (1, -1)}),
        ((50, 40), {(1, 1), (-1, 1)}),
        ((50, -40), {(1, -1), (-1, -1)}),
        ((10, -30), {(1, 1), (1, -1), (-1, 1), (-1, -1)}),
        ((9, -31), {(-1, -1)}),
        ((101, 0), set()),
    ],
)
def test_a_side_is_offered_where_its_run_up_stays_inside(position, sides):
    looks = from_all_sides(Looks(np.array([position]), np.ones((1, 2)), np.array([3])), LIMITS, OVERSHOOT)
    assert {tuple(side) for side in looks.side.tolist()} == sides and len(looks) == len(sides)
    assert all(tuple(steps) == position for steps in looks.steps.tolist()) and set(looks.sheet.tolist()) <= {3}

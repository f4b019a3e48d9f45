"""Looks that a rig can make: limits, run-ups, full turns; they add up to the plan they make."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.coarse_planning import ROUNDING, with_priors

from tvsbayes.errors import InputError
from tvsbayes.instrument.parameters import INDEX, Prior
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.planning.candidates import (
    Looks,
    Positions,
    arrange,
    candidates,
    covariance_of,
    information_of_looks,
    sided,
)
from tvsbayes.planning.expectation import PARAMETERS, information_of, prior_knowledge
from tvsbayes.planning.plan_check import check_plan
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target, sensitivity

pytestmark = pytest.mark.usefixtures("small_searches")


def test_looks_add_up_to_the_plan_they_make(knowledge, found, seen):
    """The fast sum equals the filter's pass over the arranged plan, with and without an unknown home offset."""
    picks = np.random.default_rng(5).integers(0, len(found.looks), 24)
    arranged = arrange(found.looks[picks], knowledge.sheets, found.overshoot)
    for after_data in (False, True):
        known = replace(knowledge, after_data=after_data)
        exact = information_of(arranged.steps, known).fisher
        quick = information_of_looks(seen, picks, arranged.path, knowledge.space, after_data)
        assert np.abs(quick - exact).max() < ROUNDING * np.abs(exact).max()


def test_order_of_experiments_does_not_matter(knowledge, found, seen):
    generator = np.random.default_rng(6)
    picks = generator.permutation(len(found.looks))[:16]
    at = sensitivity(
        parse_target(DEFAULT_TARGET),
        knowledge.z,
        knowledge.space,
        knowledge.rig.table,
        seen.mirror_angles_rad.mean(axis=0),
    )
    values = []
    for order in (picks, generator.permutation(picks)):
        path = arrange(found.looks[order], knowledge.sheets, found.overshoot).path
        information = information_of_looks(seen, order, path, knowledge.space, False)
        values.append(at.value(covariance_of(knowledge.precision + information)))
    assert values[1] == pytest.approx(values[0], rel=ROUNDING)


def test_limits_are_kept(mounted_rig, found):
    """Stated limits bind every counter of a plan, run-ups included; without them the grid's own range does."""
    tight = {"pan_min_steps": 0, "pan_max_steps": 150, "tilt_min_steps": -70, "tilt_max_steps": 90}
    known = prior_knowledge(replace(mounted_rig, positioner=tight))
    inside = candidates(known)
    arranged = arrange(inside.looks, known.sheets, inside.overshoot)
    moves = np.array([(s.pan_steps, s.tilt_steps) for s in arranged.steps if s.action == "move"])
    low, high = np.array([0, -70]), np.array([150, 90])
    # The images reach beyond these limits: the outermost looks stand on them, and no run-up goes past.
    for counters in (moves, inside.looks.steps):
        assert (counters.min(axis=0) == low).all() and (counters.max(axis=0) == high).all()
    assert not inside.notes
    assert "pan_min_steps" in found.notes[0] and "pan -100 to 280" in found.notes[0]
    assert np.abs(found.looks.steps).max() <= 280


def test_every_look_is_reached_from_its_side(found, knowledge):
    arranged = arrange(found.looks, knowledge.sheets, found.overshoot)
    assert [s.target for s in arranged.steps if s.action == "place"] == list(knowledge.sheets)
    counters, last, row = np.zeros(2, dtype=int), np.zeros(2, dtype=int), 0
    for step in arranged.steps:
        if step.action == "move":
            last = np.array([step.pan_steps, step.tilt_steps]) - counters
            counters = counters + last
        elif step.action == "look":
            look = arranged.order[row]
            assert (counters == found.looks.steps[look]).all()
            assert (last * found.looks.side[look] >= found.overshoot).all()
            row += 1
    assert row == len(found.looks)


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
    steps = arrange(looks, vague.sheets, turned.overshoot).steps
    ratio = parse_target("u(left) <= 1e-5 deg/step")
    information = information_of(steps, vague)
    covariance = covariance_of(vague.precision + information.fisher)
    # The whole way out went left: it is k_left = k + c / 2 that the turn measures.
    left = np.zeros(PARAMETERS)
    left[[INDEX["degrees_per_step.pan"], INDEX["ratio_contrast_deg_per_step.pan"]]] = 1e-3, 1e-4
    k = math.sqrt(left @ covariance @ left)
    stop_deg = 0.04
    assert k < 2 * stop_deg / 6000
    at = sensitivity(ratio, vague.z, vague.space, vague.rig.table, information.pose_rad)
    assert at.value(covariance) > 10 * k, "the slope of the beam still hangs on the mirrors"


def test_limits_too_narrow_for_a_run_up_are_refused_with_its_length(mounted_rig):
    narrow = {"pan_min_steps": 0, "pan_max_steps": 20, "tilt_min_steps": -10, "tilt_max_steps": 10}
    rig = replace(mounted_rig, positioner=narrow)
    with pytest.raises(InputError, match="no look has room for a run-up of") as refused:
        candidates(prior_knowledge(rig))
    assert "[positioner]" in refused.value.remedy
    check = check_plan(rig, (PlanStep(0, "place", target="d1"), PlanStep(1, "look")))
    assert [f.addition for f in check.faults] == [(), ()]
    assert any("no cure can be sought on this rig" in w for w in check.warnings)


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
    looks = sided(Positions(np.array([position]), np.array([3])), LIMITS, OVERSHOOT)
    assert {tuple(side) for side in looks.side.tolist()} == sides and len(looks) == len(sides)
    assert all(tuple(steps) == position for steps in looks.steps.tolist()) and set(looks.sheet.tolist()) <= {3}

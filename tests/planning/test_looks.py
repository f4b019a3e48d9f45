"""Looks that stand for themselves: they add up to the plan they make, whatever their order, repeats and blocks."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from support.coarse_planning import ROUNDING

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.plan import plan_minutes
from tvsbayes.planning.drawn_rigs import draw_instruments
from tvsbayes.planning.expectation import information_of, prior_knowledge
from tvsbayes.planning.looks import (
    CONTRAST_COLUMNS,
    LookArrays,
    Looks,
    Seen,
    arrange,
    information_of_looks,
)

pytestmark = pytest.mark.usefixtures("small_searches")


def test_looks_add_up_to_the_plan_they_make(knowledge, pool, seen):
    """The fast sum equals the filter's pass over the arranged plan, with and without an unknown home offset.

    Of both axes, or of one beside an absolute encoder.
    """
    picks = np.random.default_rng(5).integers(0, len(pool.looks), 24)
    arranged = arrange(pool.looks[picks], knowledge.sheets, pool.run_up)
    kept = replace(knowledge.rig, table=replace(knowledge.rig.table, absolute=("pan",)))
    for after_data, rig in ((False, knowledge.rig), (True, knowledge.rig), (True, kept)):
        known = replace(prior_knowledge(rig), after_data=after_data)
        variances = known.home_variances_rad2
        exact = information_of(arranged.steps, known).fisher
        quick = information_of_looks(
            seen, picks, arranged.path, knowledge.space, variances, arranged.warm_minutes(knowledge.rig)
        )
        assert np.abs(quick - exact).max() < ROUNDING * np.abs(exact).max()


def test_every_look_is_reached_from_its_side(pool, knowledge):
    arranged = arrange(pool.looks, knowledge.sheets, pool.run_up)
    assert [s.target for s in arranged.steps if s.action == "place"] == list(knowledge.sheets)
    counters, last, row = np.zeros(2, dtype=int), np.zeros(2, dtype=int), 0
    for step in arranged.steps:
        if step.action == "move":
            last = np.array([step.pan_steps, step.tilt_steps]) - counters
            counters = counters + last
        elif step.action == "look":
            look = arranged.order[row]
            assert (counters == pool.looks.steps[look]).all()
            assert (last * pool.looks.side[look] >= pool.run_up).all()
            row += 1
    assert row == len(pool.looks)


@pytest.mark.parametrize("home", [(0, 0), (120, -40)])
def test_an_arranged_plan_travels_and_costs_what_its_steps_do(knowledge, pool, home):
    """Step by step; with a look that is taken twice running, and one where the homing ends."""
    picks = np.random.default_rng(2).integers(0, len(pool.looks), 30)
    looks = pool.looks[np.concatenate([picks, picks[:1]])]
    looks.steps[5], looks.side[5], looks.sheet[5] = home, (1, 1), 0
    arranged = arrange(looks, knowledge.sheets, pool.run_up, home)
    at, far, travelled = np.array(home), np.zeros(2, dtype=int), []
    for step in arranged.steps[1:]:
        if step.action == "move":
            goal = np.array([step.pan_steps, step.tilt_steps])
            at, far = goal, far + np.abs(goal - at)
        elif step.action == "look":
            travelled.append(far)
    assert np.array_equal(arranged.path[arranged.order], travelled)
    assert arranged.actions == Counter(step.action for step in arranged.steps)
    assert arranged.minutes(knowledge.rig) == pytest.approx(plan_minutes(knowledge.rig, arranged.steps), rel=1e-12)


def test_looks_taken_again_count_as_often_as_they_are_taken():
    """Row by row with the contrast's column written out, at two points of parameter space."""
    generator = np.random.default_rng(7)
    rows = generator.standard_normal((2, 5, 4, len(TWO_MIRROR.names) + 2))
    seen = Seen(rows, rows[..., :2], np.ones((2, 5), dtype=bool), np.zeros((2, 5, 2)))
    chosen, path = np.array([3, 0, 3, 3, 1, 0]), generator.integers(0, 900, (6, 2))

    class Space:
        u = generator.uniform(0.5, 1.0, len(TWO_MIRROR.names))

    for homed in (None, np.radians([0.05, 0.1]) ** 2):
        informations = information_of_looks(seen, chosen, path, Space, homed)
        for one, information in zip(rows, informations, strict=True):
            every = one[chosen].copy()
            for axis, column in enumerate(CONTRAST_COLUMNS):
                every[:, :, column] = every[:, :, len(TWO_MIRROR.names) + axis] * path[:, axis, None]
                every[:, :, column] *= Space.u[column] * np.pi / 360
            whole = np.einsum("kia,kib->ab", every, every)
            if homed is not None:
                whole[len(TWO_MIRROR.names) :, len(TWO_MIRROR.names) :] += np.diag(1 / homed)
                # Beside a prior that is taken off again: few looks leave most directions open.
                prior = np.diag([1.0] * len(TWO_MIRROR.names) + [0.0] * 2)
                covariance = np.linalg.inv(whole + prior)[: len(TWO_MIRROR.names), : len(TWO_MIRROR.names)]
                whole = np.linalg.inv(covariance) - np.eye(len(TWO_MIRROR.names))
            whole = whole[: len(TWO_MIRROR.names), : len(TWO_MIRROR.names)]
            assert np.abs(information - whole).max() < ROUNDING * np.abs(whole).max()


def test_a_position_is_visible_to_the_share_of_instruments_that_see_it(knowledge):
    z = draw_instruments(knowledge, 4, seed=1).z
    looks = Looks(np.array([[0, 0], [240, 0], [900, 0]]), np.ones((3, 2), dtype=int), np.array([0, 0, 1]))
    shown = [LookArrays(looks, knowledge, False).at(point, knowledge.space).seen for point in z]
    share = LookArrays(looks, knowledge, False).in_images(z).mean(axis=0)
    assert share == pytest.approx(np.mean(shown, axis=0), abs=1e-12) and share[2] == 0 < share[0]

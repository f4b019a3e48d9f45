"""The gap between classic and joint: its terms add up and name the true causes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from support.dozen_spots import coordinates

from tvsbayes.assessment.summary import summarise
from tvsbayes.comparison.gap import BACKLASH, CHANCE, PROJECTION, STEREO_SCALE, explain_gap
from tvsbayes.estimators.four_point import classic
from tvsbayes.estimators.joint_fit import Alternative, JointFit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD
from tvsbayes.instrument.plan import PlanBuilder
from tvsbayes.instrument.rig import Rig, RigTable
from tvsbayes.posterior import predictive
from tvsbayes.posterior.draws import Posterior
from tvsbayes.results.comparison_record import Gap
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth, read_truth

TWIN = Path(__file__).resolve().parents[2] / "data" / "twins" / "paper_twin"


@pytest.fixture(scope="module")
def paper_truth(paper_fit) -> Truth:
    return read_truth(TWIN / "truth.json", paper_fit.campaign.stereo)


@pytest.fixture(scope="module")
def paper_gaps(paper_fit) -> dict[str, Gap]:
    return explain_gap(paper_fit)


def true_terms(joint: JointFit, truth: Truth) -> dict[str, dict[str, float]]:
    """Terms on the true rig: the first row of the Laplace draws is where the fit stands."""
    space = jax.tree.map(np.asarray, joint.space)
    gaps = explain_gap(replace(joint, z=coordinates(space, truth)), draws=2)
    return {d: {t.name: t.value for t in g.terms} for d, g in gaps.items() if g is not None}


def test_terms_add_up_to_the_gap(paper_fit, paper_gaps):
    measured = classic(paper_fit.campaign)
    for direction, gap in paper_gaps.items():
        mean = measured.directions[direction].mean_deg_per_step
        assert gap.classic == mean
        # Sums of five doubles of 0.06 deg/step.
        rounding = 5 * np.finfo(float).eps * 0.06
        assert sum(term.value for term in gap.terms) == pytest.approx(gap.total.value, abs=10 * rounding)
        assert gap.total.value == pytest.approx(mean - gap.joint.value, abs=rounding)
    # One ratio, one uncertainty: what the fit's own table states.
    for direction, ratio in summarise(paper_fit).effective.items():
        joint = paper_gaps[direction].joint
        assert (joint.value, joint.sd, joint.interval95) == (ratio.value, ratio.sd, ratio.interval95)


def test_terms_of_a_posterior_add_up_to_the_ratio_of_all_its_draws(paper_fit):
    """64 of 2048 draws carry the terms; the ratio's mean over all of them is a control variate."""
    chains = jax.tree.map(lambda x: x.reshape(2, len(x) // 2, *x.shape[1:]), paper_fit.draws)
    z = paper_fit.draws_z.reshape(2, -1, paper_fit.draws_z.shape[1])
    weights = np.full(z.shape[:2], 1 / len(paper_fit.draws_z))
    posterior = Posterior(paper_fit, z, np.zeros(z.shape[:2]), chains, weights, None, 0, 0.0)
    for k, (direction, gap) in enumerate(explain_gap(paper_fit, posterior, draws=64).items()):
        ratio = paper_fit.draws.effective_deg_per_step[:, k]
        assert gap.joint.value == pytest.approx(ratio.mean(), rel=1e-12), direction
        assert gap.total.value == pytest.approx(gap.classic - ratio.mean(), abs=1e-12)
        # Covariances of 64 numbers of 1e-4 about 0.06: cancellation leaves 1e-16 / 1e-4 of a mean's shift of 1e-5.
        assert sum(term.value for term in gap.terms) == pytest.approx(gap.total.value, abs=1e-12)


def test_draws_of_several_ways_of_homing_see_the_spots_of_their_own(paper_fit, monkeypatch):
    """Half of the draws came from another way: their spots are those of its fit, in the order of the draws."""
    z = paper_fit.draws_z[None]
    chains = jax.tree.map(lambda x: x[None], paper_fit.draws)
    weights = np.full(z.shape[:2], 1 / z.shape[1])
    other = replace(paper_fit, campaign=replace(paper_fit.campaign, header={"name": "the other way"}))
    ways = tuple(Alternative({"pan": side}, 0.5, fit) for side, fit in (("left", paper_fit), ("right", other)))
    both = replace(paper_fit, alternatives=ways)
    way = np.random.default_rng(5).integers(0, 2, z.shape[:2])
    posterior = Posterior(both, z, np.zeros(z.shape[:2]), chains, weights, None, 0, 0.0, way=way)
    points_of, looked = {}, predictive.looks

    def looks(fit, points, *others):
        points_of.setdefault(fit.campaign.title, []).append(points)
        return looked(fit, points, *others)

    monkeypatch.setattr(predictive, "looks", looks)
    gaps, places = explain_gap(both, posterior, draws=64), posterior.chosen(64)
    for number, title in enumerate((paper_fit.campaign.title, "the other way")):
        assert len(points_of[title]) == 4
        for points in points_of[title]:
            np.testing.assert_array_equal(points, z[0, places[way[0, places] == number]])
    alone = explain_gap(paper_fit, replace(posterior, fit=paper_fit, way=None), draws=64)
    assert {d: gap.terms for d, gap in gaps.items()} == {d: gap.terms for d, gap in alone.items()}


def test_terms_name_the_true_causes_with_sign_and_size(paper_fit, paper_gaps, paper_truth):
    """The twin's truth lies inside every 95 % interval; the backlash's size is b/N by hand."""
    gaps, true = paper_gaps, true_terms(paper_fit, paper_truth)
    for direction, gap in gaps.items():
        for term in gap.terms:
            low, high = term.interval95
            # A term that the truth fixes to rounding has an interval as narrow as that.
            slack = 1e-9
            assert low - slack <= true[direction][term.name] <= high + slack, (direction, term.name)
    by = {d: {t.name: t.value for t in g.terms} for d, g in gaps.items()}
    lost = {axis: paper_truth.parameters[f"backlash_deg.{axis}"] / 200 for axis in ("pan", "tilt")}
    # Left and down start against their direction and lose the play, right and up start cleared (the twin's notes).
    assert true["left"][BACKLASH] == pytest.approx(-lost["pan"], rel=0.05)
    assert abs(true["right"][BACKLASH]) < 0.02 * lost["pan"]
    assert by["left"][BACKLASH] < -0.9 * lost["pan"] < 0
    # Equal gears read as 1.12 in tilt: an azimuth near 27 deg (formulation 1.2).
    for direction in ("up", "down"):
        assert by[direction][PROJECTION] == pytest.approx(0.0064, abs=0.0008)
    assert abs(by["left"][PROJECTION]) < 1e-4


def test_stereo_term_follows_the_focal_scale(mixed_fit):
    """Cameras whose focal length is 1 % longer than stated: angles seem about 1 % larger, with distortion up to 2 %."""
    index = list(mixed_fit.names).index("focal_scale")
    shifted = np.array(mixed_fit.z)
    shifted[index] += 0.01 / float(mixed_fit.space.u[index])
    plain, longer = (explain_gap(replace(mixed_fit, z=z), draws=2) for z in (mixed_fit.z, shifted))
    for direction in DIRECTIONS:
        first, second = ({t.name: t.value for t in g[direction].terms}[STEREO_SCALE] for g in (plain, longer))
        assert 0.003 < (second - first) / 0.065 < 0.02


def test_terms_and_chance_are_about_what_the_classic_saw(mixed_fit):
    """Chance is what its own stop errors and pixels add: within 4 of its standard uncertainties (type A)."""
    measured = classic(mixed_fit.campaign)
    for direction, gap in explain_gap(mixed_fit, draws=64).items():
        chance = {t.name: t for t in gap.terms}[CHANCE]
        spread = np.hypot(chance.sd, measured.directions[direction].u_type_a_deg_per_step)
        assert abs(chance.value) < 4 * spread


def test_a_head_with_sightings_has_no_gap():
    """It has no four-point experiments, and no cameras to see any."""
    table, plan = RigTable(mechanism=SIGHTING_HEAD), PlanBuilder()
    plan.home(0, 0)
    plan.move(100, 100)
    plan.look()
    campaign = simulate(Rig(table, None, table.priors, {}, {}, {}, {}), plan.steps, 7).campaign
    assert explain_gap(SimpleNamespace(campaign=campaign)) == dict.fromkeys(DIRECTIONS)

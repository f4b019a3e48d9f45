"""Classic against joint: the gap term by term, left-out experiments, two calibrations, residuals by cause."""

from __future__ import annotations

import datetime
import json
from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT, coordinates
from scipy import stats

from tvsbayes.assessment.residuals import CAUSE_LIMIT, residual_causes, stop_residuals
from tvsbayes.assessment.score_tests import _Answer, _holm
from tvsbayes.assessment.summary import summarise
from tvsbayes.comparison.changes import compare
from tvsbayes.comparison.gap import BACKLASH, CHANCE, PROJECTION, STEREO_SCALE, explain_gap
from tvsbayes.comparison.held_out import folds_of, foretell_classic, hold_out
from tvsbayes.comparison.scores import judge, ratio_interval
from tvsbayes.errors import NotConverged
from tvsbayes.estimators.four_point import Selection, classic, select_experiments
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import ordered_spots, read_campaign
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.report.evidence import criterion
from tvsbayes.results.comparison_record import BETTER_CLASSIC, BETTER_JOINT, CANNOT_TELL, Gap, Prediction
from tvsbayes.results.estimates import StopResidual
from tvsbayes.statistics.intervals import log_chance, recursive_residuals
from tvsbayes.twin.simulated_campaign import Truth, read_truth, simulate

TWIN = ROOT / "data" / "twins" / "paper_twin"


@pytest.fixture(scope="module")
def paper_fit() -> JointFit:
    """The shipped twin of the paper: equal gears, |N| = 200."""
    return fit(read_campaign(TWIN))


@pytest.fixture(scope="module")
def paper_truth(paper_fit) -> Truth:
    return read_truth(TWIN / "truth.json", paper_fit.campaign.stereo)


@pytest.fixture(scope="module")
def mixed_fit(mounted_rig) -> JointFit:
    """Two step counts, reversed and cleared starts: the play is seen."""
    protocol = four_point_protocol(repeats=6, steps=(100, 200))
    return fit(simulate(mounted_rig, protocol, seed=3).campaign)


@pytest.fixture(scope="module")
def paper_gaps(paper_fit) -> dict[str, Gap]:
    return explain_gap(paper_fit)


def true_terms(found: JointFit, truth: Truth) -> dict[str, dict[str, float]]:
    """Terms on the true rig: the first row of the Laplace draws is where the fit stands."""
    space = jax.tree.map(np.asarray, found.space)
    gaps = explain_gap(replace(found, z=coordinates(space, truth)), draws=2)
    return {d: {t.name: t.value for t in g.terms} for d, g in gaps.items() if g is not None}


def test_a_rest_whose_first_spot_is_left_out_keeps_its_stop_error(paper_fit):
    """The stop's variance belongs to the rest, not to whichever spot of it is used first."""
    whole = {stop.spots: stop for stop in stop_residuals(paper_fit)}
    spots = max(whole, key=len)
    row = [spot.spot for spot in ordered_spots(paper_fit.campaign)].index(spots[0])
    valid = np.array(paper_fit.arrays.spots.valid)
    valid[row] = 0.0
    without = replace(paper_fit, arrays=eqx.tree_at(lambda a: a.spots.valid, paper_fit.arrays, valid))
    left = {stop.spots: stop for stop in stop_residuals(without)}
    # A spot less adds pixel noise only.
    assert whole[spots].u_deg <= left[spots[1:]].u_deg < 1.1 * whole[spots].u_deg


def test_a_refit_that_failed_judges_nobody(mixed_fit, monkeypatch):
    lost = replace(mixed_fit, converged=False, problems=("it went astray",))
    monkeypatch.setattr("tvsbayes.comparison.held_out.refit", lambda *_: lost)
    held = hold_out(mixed_fit)
    assert held.verdict == CANNOT_TELL and "went astray" in held.reason


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
    for direction, told in summarise(paper_fit).effective.items():
        joint = paper_gaps[direction].joint
        assert (joint.value, joint.sd, joint.interval95) == (told.value, told.sd, told.interval95)


def test_terms_of_a_posterior_add_up_to_the_ratio_of_all_its_draws(paper_fit):
    """64 of 2048 draws carry the terms; the ratio's mean over all of them is a control variate."""
    chains = jax.tree.map(lambda x: x.reshape(2, -1, *x.shape[1:]), paper_fit.draws)
    posterior = SimpleNamespace(z=paper_fit.draws_z.reshape(2, -1, paper_fit.draws_z.shape[1]), draws=chains)
    for k, (direction, gap) in enumerate(explain_gap(paper_fit, posterior, draws=64).items()):
        ratio = paper_fit.draws.effective_deg_per_step[:, k]
        assert gap.joint.value == pytest.approx(ratio.mean(), rel=1e-12), direction
        assert gap.total.value == pytest.approx(gap.classic - ratio.mean(), abs=1e-12)
        # Covariances of 64 numbers of 1e-4 about 0.06: cancellation leaves 1e-16 / 1e-4 of a mean's shift of 1e-5.
        assert sum(term.value for term in gap.terms) == pytest.approx(gap.total.value, abs=1e-12)


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
    # Equal gears read as 1.12 in tilt: an azimuth near 27 deg (DESIGN 1.2).
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


def test_a_single_step_count_cannot_tell(paper_fit):
    held = hold_out(paper_fit)
    assert held.verdict == CANNOT_TELL and "|N| = 200" in held.reason and not held.predictions
    assert set(held.unseen) == set(DIRECTIONS)
    # Common uncertainty by cameras is a part of the ratio's.
    for k, direction in enumerate(DIRECTIONS):
        assert 0 < held.unseen[direction] < paper_fit.draws.effective_deg_per_step[:, k].std()


def test_joint_foretells_a_step_count_it_never_saw(mixed_fit):
    held = hold_out(mixed_fit)
    assert held.verdict == BETTER_JOINT and held.interval95[0] > 1
    assert held.joint.rms_block_deg < held.classic.rms_block_deg
    assert len(held.predictions) == len(select_experiments(mixed_fit.campaign).experiments)
    # 48 predictions whose stop errors pairs share: half of them count, 1e-4 two-sided.
    least = stats.binom.ppf(1e-4, 24, 0.95) / 24
    assert held.joint.coverage >= least
    seen = {p.experiment: p.angle_deg / p.steps for p in held.predictions}
    for experiment in classic(mixed_fit.campaign).experiments:
        assert seen[experiment.experiment] == pytest.approx(experiment.deg_per_step, rel=1e-12)
    json.dumps(held.as_json(), allow_nan=False)


def test_scores_of_predictions_by_hand():
    """Two folds of two: errors of the classic 3, 1, -2, -4 (3 degrees of freedom), of the joint a tenth; all u = 1."""
    told = []
    for e, (fold, direction, error) in enumerate(
        (("a", "left", 3), ("a", "left", 1), ("b", "up", -2), ("b", "up", -4))
    ):
        told.append(Prediction(e, fold, direction, 100, 6.0 + error, 6.0, 1.0, 3, 6.0 + 0.9 * error, 1.0))
    held = judge("steps", told, np.array([100, 200]), {})
    assert held.classic.rms_deg == pytest.approx(np.sqrt(30 / 4)) and held.joint.rms_deg == pytest.approx(
        np.sqrt(0.075)
    )
    # Means of the blocks: 2 and -3, a tenth of them for the joint.
    assert held.classic.rms_block_deg == pytest.approx(np.sqrt(6.5)) and held.ratio == pytest.approx(10.0)
    # t(0.975, 3) = 3.18.
    assert (held.classic.coverage, held.joint.coverage) == (0.75, 1.0)
    # Student's density with 3 degrees of freedom is 6 sqrt 3 / (pi (3 + x^2)^2).
    student = [6 * np.sqrt(3) / np.pi / (3 + x * x) ** 2 for x in (3, 1, -2, -4)]
    normal = [np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi) for x in (0.3, 0.1, -0.2, -0.4)]
    for score, density in ((held.classic, student), (held.joint, normal)):
        assert score.log_density == pytest.approx(np.mean(np.log(density)))
    assert held.verdict == CANNOT_TELL and "2 blocks" in held.reason


@pytest.mark.parametrize("verdict", [BETTER_JOINT, BETTER_CLASSIC])
def test_the_better_predictor_is_named(verdict):
    """Eight blocks; the joint's errors are a tenth of the classic's, or the reverse."""
    errors = np.random.default_rng(1).normal(size=8)
    near, far = 6.0 + 0.9 * errors, np.full(8, 6.0)
    if verdict == BETTER_CLASSIC:
        near, far = far, near
    told = [
        Prediction(e, f"fold {e}", "left", 100, 6.0 + error, float(far[e]), 1.0, 3, float(near[e]), 1.0)
        for e, error in enumerate(errors)
    ]
    held = judge("steps", told, np.array([100, 200]), {})
    assert held.verdict == verdict
    assert held.ratio == pytest.approx(10.0 if verdict == BETTER_JOINT else 0.1)
    # Proportional errors leave no doubt about their ratio; the correlation is 1 but for rounding.
    assert held.interval95 == pytest.approx((held.ratio, held.ratio), rel=1e-6)


def test_left_out_spots_teach_nothing(mixed_fit):
    """Spoiling experiments that a fit was told to leave out changes no bit of it."""
    campaign = mixed_fit.campaign
    selection = select_experiments(campaign)
    out = frozenset(campaign.spots[r].spot for r in selection.spot_rows[np.abs(selection.steps) == 100].ravel())
    spoiled = tuple(replace(s, u_left_px=s.u_left_px + 3.0) if s.spot in out else s for s in campaign.spots)
    plain, other = fit(campaign, without=out), fit(replace(campaign, spots=spoiled), without=out)
    assert set(plain.excluded_spots) == out
    # Triangulated points of spots without weight still steer where their range is evaluated, nothing else.
    np.testing.assert_allclose(other.z, plain.z, atol=1e-6)


def test_folds_leave_every_experiment_out_once(mixed_fit):
    selection = select_experiments(mixed_fit.campaign)
    for by in ("steps", "regions"):
        masks = np.array(list(folds_of(mixed_fit.campaign, selection, by).values()))
        assert np.all(masks.sum(axis=0) == 1)
    with pytest.raises(ValueError, match="regions"):
        folds_of(mixed_fit.campaign, selection, "weeks")


def test_regions_of_a_campaign_that_moved_one_axis(mounted_rig):
    """Experiments of pan alone, as a maker's first try: the other axis has no regions."""
    steps = [s for s in four_point_protocol(repeats=2, steps=(100, 200)) if s.experiment is None or s.experiment < 4]
    campaign = simulate(mounted_rig, steps, seed=3).campaign
    selection = select_experiments(campaign)
    assert set(selection.axis) == {"pan"}
    folds = folds_of(campaign, selection, "regions")
    assert folds and all(name.startswith("pan from ") for name in folds)
    assert np.all(np.sum(list(folds.values()), axis=0) == 1)


def test_experiments_beyond_the_lens_model_neither_teach_nor_are_asked():
    rows, nothing = np.zeros((4, 4), dtype=int), np.zeros((4, 4, 4))
    selection = Selection(np.arange(4), rows, nothing, np.full(4, 200), np.full(4, "pan"), ())
    angle = np.array([12.0, 12.1, 11.9, np.nan])
    told = foretell_classic(angle, selection, np.array([True, False, False, False]))
    assert told[0][0] == pytest.approx(12.0) and np.isfinite(told[0][1]) and told[0][2] == 1
    assert foretell_classic(angle, selection, np.array([False, False, False, True])) == {}


def test_a_fold_without_a_fit_decides_nothing(mixed_fit, monkeypatch):
    def lost(*_arguments):
        raise NotConverged("diverged", "NOT CONVERGED: the fit ran away")

    monkeypatch.setattr("tvsbayes.comparison.held_out.refit", lost)
    held = hold_out(mixed_fit)
    assert held.verdict == CANNOT_TELL and "the fit ran away" in held.reason and not held.predictions


def test_few_experiments_foretell_with_the_width_of_their_own_scatter():
    """Two others of known ratio and normal scatter: Student's t with 1 dof covers 95 %, the normal would 71 %."""
    sets = 4000
    generator = np.random.default_rng(21)
    rows, nothing = np.zeros((3, 4), dtype=int), np.zeros((3, 4, 4))
    selection = Selection(np.arange(3), rows, nothing, np.full(3, 200), np.full(3, "pan"), ())
    predictions = []
    for index in range(sets):
        angle = 12.0 + 0.05 * generator.standard_normal(3)
        ((_, told),) = foretell_classic(angle, selection, np.array([True, False, False])).items()
        assert told[2] == 1
        predictions.append(Prediction(index, "one", "left", 200, float(angle[0]), *told, 12.0, 0.05))
    held = judge("steps", predictions, np.array([100, 200]), {})
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], sets, 0.95) / sets
    assert low <= held.classic.coverage <= high
    assert low <= held.joint.coverage <= high


@pytest.mark.parametrize(("correlation", "true"), [(0.0, 1.0), (0.7, 1.0), (0.6, 3.0)])
def test_interval_of_the_ratio_of_errors_covers(correlation, true):
    """Exact for normal pairs with mean 0: 4000 seeded sets of 8 blocks, binomial bounds at 1e-4."""
    sets = 4000
    generator = np.random.default_rng([8, round(10 * correlation)])
    first = generator.standard_normal((sets, 8))
    second = correlation * first + np.sqrt(1 - correlation**2) * generator.standard_normal((sets, 8))
    inside = 0
    for a, b in zip(true * first, second, strict=True):
        low, high = ratio_interval(a, b)
        inside += low <= true <= high
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], sets, 0.95)
    assert low <= inside <= high


def test_a_calibration_has_not_changed_from_itself(mixed_fit):
    same = compare(mixed_fit, mixed_fit)
    assert same.shared_cameras and same.verdict == "no significant change" and same.days is None
    for change in same.changes:
        assert change.difference == 0.0 and change.normalised == 0.0 and change.u > 0
    # A second pair of cameras: nothing is shared, every u grows.
    stereo = replace(
        mixed_fit.campaign.stereo, parameter_covariance=mixed_fit.campaign.stereo.parameter_covariance * 1.01
    )
    apart = compare(mixed_fit, replace(mixed_fit, campaign=replace(mixed_fit.campaign, stereo=stereo)))
    assert not apart.shared_cameras
    for one, other in zip(same.changes[:4], apart.changes[:4], strict=True):
        assert other.u > 1.05 * one.u


def test_what_both_hold_fixed_is_compared_as_stated(mixed_fit):
    """A backlash fixed in both fits has no u: equal statements are no change, others are one; JSON takes both."""
    row = list(mixed_fit.names).index("backlash_deg.tilt")
    fits = []
    for value in (0.1, 0.1, 0.2):
        stated, u, kind = (np.array(x) for x in (mixed_fit.space.value, mixed_fit.space.u, mixed_fit.space.kind))
        stated[row], u[row], kind[row] = value, 0.0, 0
        with jax.enable_x64(True):
            space = replace(mixed_fit.space, value=jnp.asarray(stated), u=jnp.asarray(u), kind=jnp.asarray(kind))
        fits.append(replace(mixed_fit, space=space))
    same, other = (compare(fits[0], second).changes[-1] for second in fits[1:])
    assert (same.normalised, same.significant) == (None, False)
    assert (other.normalised, other.significant) == (None, True)
    json.dumps(compare(fits[0], fits[2]).as_json(), allow_nan=False)


def test_a_changed_gear_is_named(mounted_rig, mixed_fit):
    """The same rig with 2 % more degrees per pan step, measured again 30 days later."""
    protocol = four_point_protocol(repeats=6, steps=(100, 200))
    first = simulate(mounted_rig, protocol, seed=3)
    parameters = dict(first.truth.parameters)
    parameters["degrees_per_step.pan"] *= 1.02
    second = simulate(mounted_rig, protocol, seed=4, truth=replace(first.truth, parameters=parameters)).campaign
    made = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    dated = [
        replace(campaign, header={**campaign.header, "created": made + datetime.timedelta(days=30 * k)})
        for k, campaign in enumerate((mixed_fit.campaign, second))
    ]
    found = compare(replace(mixed_fit, campaign=dated[0]), replace(fit(second), campaign=dated[1]))
    moved = {c.quantity for c in found.changes if c.significant}
    assert moved == {"effective_deg_per_step.left", "effective_deg_per_step.right"}
    assert found.days == 30.0 and found.verdict.startswith("changed: effective_deg_per_step.left by +")
    for change in found.changes[:2]:
        assert change.difference == pytest.approx(0.02 * change.first, abs=4 * change.u)


@pytest.mark.parametrize(
    ("share", "verdict"), [(1.0, "met"), (0.95, "met"), (0.94, "cannot tell"), (0.06, "cannot tell"), (0.05, "not met")]
)
def test_criterion_follows_its_rule(share, verdict):
    errors = np.where(np.arange(1000) < 1000 * share, 0.5, -2.0)
    judged = criterion("x", errors, 1.0, "mm")
    assert (judged.probability, judged.verdict) == (pytest.approx(share), verdict)


def test_residuals_of_a_clean_campaign_scatter_as_stated(paper_fit):
    residuals = stop_residuals(paper_fit)
    spots = [spot for r in residuals if r.axis == "pan" for spot in r.spots]
    assert sorted(spots) == sorted(s.spot for s in paper_fit.campaign.spots if s.status == "ok")
    scaled = np.array([r.deviation_deg / r.u_deg for r in residuals])
    n, determined = len(scaled), len(scaled) // 8
    # A little is lost to the fit: fewer degrees of freedom below, none above; 1e-4 on either side.
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], [n - determined, n])
    assert low <= np.sum(scaled**2) <= high
    assert not any(cause.suspicious for cause in residual_causes(residuals))
    assert {r.direction for r in residuals} == set(DIRECTIONS)


def stops(generator: np.random.Generator, count: int = 60) -> list[StopResidual]:
    """Stops of one axis whose deviations depend on nothing."""
    found = []
    for k in range(count):
        noise, looks = generator.standard_normal(), generator.standard_normal(2)
        within = recursive_residuals(looks, np.ones(2), backwards=k % 2 == 1)
        direction = ("left", "right")[k % 2]
        places = (175.0 + 0.1 * generator.random(), 275.0 + 0.1 * generator.random())
        leg = int(generator.choice([50, 100, 200]))
        found.append(
            StopResidual("pan", (2 * k, 2 * k + 1), k, direction, leg, places, within, 10.0 * k, 0.03 * noise, 0.03)
        )
    return found


PLANTED = {
    "depth": lambda r: replace(r, within=tuple(w and w + s for w, s in zip(r.within, (-1.0, 1.0), strict=True))),
    "direction": lambda r: replace(r, deviation_deg=r.deviation_deg + (0.03 if r.direction == "left" else -0.03)),
    "N": lambda r: replace(r, deviation_deg=r.deviation_deg + (0.06 if r.leg_steps == 200 else 0.0)),
    "step phase": lambda r: replace(r, deviation_deg=r.deviation_deg + 0.045 * np.cos(np.pi * r.steps / 2)),
    "time": lambda r: replace(r, deviation_deg=r.deviation_deg + 2e-4 * (r.time_s - 300)),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_cause_is_found_and_no_other_blamed_alone(name):
    found = residual_causes([PLANTED[name](r) for r in stops(np.random.default_rng(6), 120)])
    assert {c.name for c in found if c.suspicious} >= {name}
    # Counters alternate with directions here: a phase of two steps is a direction as well.
    related = {"step phase": {"direction"}, "direction": {"step phase"}}.get(name, set())
    assert {c.name for c in found if c.suspicious} <= {name} | related


def test_false_alarms_of_causes_stay_rare():
    """500 clean campaigns; at most as many alarms as 1 % allows at 1e-4, and every p as common as any other."""
    chances, alarms = {}, 0
    for seed in range(500):
        causes = residual_causes(stops(np.random.default_rng([1, seed])))
        alarms += any(c.suspicious for c in causes)
        for cause in causes:
            chances.setdefault(cause.name, []).append(cause.p)
    assert alarms <= stats.binom.ppf(1 - 1e-4, 500, CAUSE_LIMIT)
    for name, p in chances.items():
        if None not in p:
            assert stats.kstest(p, "uniform").pvalue > 1e-4, name


def test_depths_are_not_sorted_by_the_noise_that_they_share():
    """Triangulated depth and deviation come from the same pixels: inside a placement they are correlated."""
    generator = np.random.default_rng(12)
    noise = generator.standard_normal(120)
    sheets_mm = np.repeat([175.0, 275.0, 375.0], 40)
    rows = [
        StopResidual("pan", (k,), k, "left", 100, (depth + 0.5 * e,), (), 10.0 * k, 0.03 * e, 0.03)
        for k, (depth, e) in enumerate(zip(sheets_mm, noise, strict=True))
    ]
    (depth,) = (c for c in residual_causes(rows) if (c.name, c.axis) == ("depth", "pan"))
    assert [g.count for g in depth.groups] == [40, 40, 40] and not depth.suspicious
    # One placement is not tested; an oblique sheet that reaches far is, in bins far wider than the noise.
    (near,) = (c for c in residual_causes(rows[:40]) if (c.name, c.axis) == ("depth", "pan"))
    assert len(near.groups) == 1 and near.p is None
    oblique = [replace(r, depth_mm=(200.0 + r.steps,)) for r in rows]
    (far,) = (c for c in residual_causes(oblique) if (c.name, c.axis) == ("depth", "pan"))
    assert len(far.groups) == 6 and far.p is not None


@pytest.mark.parametrize("backwards", [False, True])
def test_recursive_residuals_are_independent_and_standard(backwards):
    """Any common value, unlike variances: the n - 1 numbers have the unit matrix for covariance, by linear algebra."""
    variances = np.array([0.5, 2.0, 1.0, 4.0])
    rows = np.array([[w or 0.0 for w in recursive_residuals(e, variances, backwards=backwards)] for e in np.eye(4)]).T
    first = -1 if backwards else 0
    assert not rows[first].any()
    kept = np.delete(rows, first, axis=0)
    np.testing.assert_allclose(kept @ np.diag(variances) @ kept.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(kept.sum(axis=1), 0.0, atol=1e-12)
    assert recursive_residuals(np.ones(1), np.ones(1), backwards=backwards) == ()


def test_the_larger_of_two_gross_defects_is_the_cause():
    """The chance of a chi-square with two degrees of freedom is exp(-x / 2), however small; others stay ordered."""
    far = np.array([10.0, 1e3, 1e5, 1e7])
    np.testing.assert_allclose(log_chance(far, 2), -far / 2, rtol=1e-12)
    for dof in (1, 3, 6):
        near = np.array([1.0, 30.0, 600.0])
        np.testing.assert_allclose(log_chance(near, dof), stats.chi2.logsf(near, dof), rtol=1e-12)
        # Continued from where the plain law still has digits: the asymptotic slope is -1/2.
        ends = log_chance(np.array([1000.0, 2000.0, 1e5]), dof)
        assert np.all(np.isfinite(ends)) and np.all(np.diff(ends) < 0)
        assert (ends[1] - ends[0]) / 1000 == pytest.approx(-0.5, abs=3 / 1000)
    spot, cameras = (_Answer(float(log_chance(x, 3)), str(x), "", x, 3, 0.0) for x in (1600.0, 1e5))
    assert _holm([spot, cameras]).cause.startswith("100000.0")


def test_terms_and_chance_are_about_what_the_classic_saw(mixed_fit):
    """Chance is what its own stop errors and pixels add: within 4 of its standard uncertainties (type A)."""
    measured = classic(mixed_fit.campaign)
    for direction, gap in explain_gap(mixed_fit, draws=64).items():
        chance = {t.name: t for t in gap.terms}[CHANCE]
        spread = np.hypot(chance.sd, measured.directions[direction].u_type_a_deg_per_step)
        assert abs(chance.value) < 4 * spread

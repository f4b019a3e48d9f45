"""Experiments left out: folds, refits, what each estimator predicts."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.waits import check_forward, doings

from tvsbayes.comparison.held_out import folds_of, hold_out, judge, predict_classic
from tvsbayes.errors import NotConverged
from tvsbayes.estimators.four_point import Selection, classic, select_experiments
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.results.comparison_record import BETTER_JOINT, CANNOT_TELL, Prediction
from tvsbayes.results.records import plain
from tvsbayes.twin.simulated_campaign import simulate

pytestmark = pytest.mark.thorough


def astray(mixed_fit):
    return replace(mixed_fit, converged=False, problems=("it went astray",))


def without_end(_):
    raise NotConverged("diverged", "NOT CONVERGED: the fit went astray")


@pytest.mark.parametrize("refit", [astray, without_end])
def test_a_refit_that_failed_is_not_judged(mixed_fit, monkeypatch, refit):
    monkeypatch.setattr("tvsbayes.estimators.joint_fit.fit", lambda *_, **__: refit(mixed_fit))
    held = hold_out(mixed_fit)
    assert held.verdict == CANNOT_TELL and "went astray" in held.reason and not held.predictions


def test_a_single_step_count_cannot_tell(paper_fit):
    held = hold_out(paper_fit)
    assert held.verdict == CANNOT_TELL and "|N| = 200" in held.reason and not held.predictions
    assert set(held.unseen) == set(DIRECTIONS)
    # Common uncertainty by cameras is a part of the ratio's.
    for k, direction in enumerate(DIRECTIONS):
        assert 0 < held.unseen[direction] < paper_fit.draws.effective_deg_per_step[:, k].std()


def test_regions_of_one_counter_ask_for_another_counter(paper_fit, monkeypatch):
    """A second |N| would start there again and add no region."""
    monkeypatch.setattr("tvsbayes.comparison.held_out.folds_of", lambda *_: {"pan from 0": np.ones(4, dtype=bool)})
    reason = hold_out(paper_fit, by="regions").reason
    assert "start at one counter" in reason and "second starting counter" in reason and "|N|" not in reason


def test_joint_predicts_a_step_count_it_never_saw(mixed_fit):
    waits = []
    held = hold_out(mixed_fit, progress=waits.append)
    check_forward(waits)
    assert [name.split(" =")[0] for name in doings(waits)] == ["|N|"] * len(doings(waits)) and len(doings(waits)) > 1
    assert held.verdict == BETTER_JOINT and held.interval95[0] > 1
    assert held.joint.rms_block_deg < held.classic.rms_block_deg
    assert len(held.predictions) == len(select_experiments(mixed_fit.campaign).experiments)
    # 48 predictions whose stop errors pairs share: half of them count, 1e-4 two-sided.
    least = stats.binom.ppf(1e-4, 24, 0.95) / 24
    assert held.joint.coverage >= least
    ratios = {p.experiment: p.angle_deg / p.steps for p in held.predictions}
    for experiment in classic(mixed_fit.campaign).experiments:
        assert ratios[experiment.experiment] == pytest.approx(experiment.deg_per_step, rel=1e-12)
    json.dumps(plain(held), allow_nan=False)


def test_left_out_spots_teach_nothing(mixed_fit):
    """Spoiling experiments that a fit leaves out changes no bit of it."""
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
    """Experiments of pan alone: the other axis has no regions."""
    steps = [s for s in four_point_protocol(repeats=2, steps=(100, 200)) if s.experiment is None or s.experiment < 4]
    campaign = simulate(mounted_rig, steps, seed=3).campaign
    selection = select_experiments(campaign)
    assert set(selection.axis) == {"pan"}
    folds = folds_of(campaign, selection, "regions")
    assert folds and all(name.startswith("pan from ") for name in folds)
    assert np.all(np.sum(list(folds.values()), axis=0) == 1)


def test_experiments_beyond_the_lens_model_are_neither_fitted_nor_predicted():
    rows, nothing = np.zeros((4, 4), dtype=int), np.zeros((4, 4, 4))
    selection = Selection(np.arange(4), rows, nothing, np.full(4, 200), np.full(4, "pan"), ())
    angle = np.array([12.0, 12.1, 11.9, np.nan])
    angles = predict_classic(angle, selection, np.array([True, False, False, False]))
    assert angles[0][0] == pytest.approx(12.0) and np.isfinite(angles[0][1]) and angles[0][2] == 1
    assert predict_classic(angle, selection, np.array([False, False, False, True])) == {}


def test_few_experiments_predict_with_the_width_of_their_own_scatter():
    """Two others of known ratio and normal scatter: Student's t with 1 dof covers 95 %, the normal would 71 %."""
    sets = 4000
    generator = np.random.default_rng(21)
    rows, nothing = np.zeros((3, 4), dtype=int), np.zeros((3, 4, 4))
    selection = Selection(np.arange(3), rows, nothing, np.full(3, 200), np.full(3, "pan"), ())
    predictions = []
    for index in range(sets):
        angle = 12.0 + 0.05 * generator.standard_normal(3)
        ((_, row),) = predict_classic(angle, selection, np.array([True, False, False])).items()
        assert row[2] == 1
        predictions.append(Prediction(index, "one", "left", 200, float(angle[0]), *row, 12.0, 0.05))
    held = judge("steps", predictions, np.array([100, 200]), {})
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], sets, 0.95) / sets
    assert low <= held.classic.coverage <= high
    assert low <= held.joint.coverage <= high

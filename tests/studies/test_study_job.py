"""What decides a row, and what it takes from an estimator's draws."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from support.drawn_quantities import drawn_quantities

from tvsbayes.instrument.mechanisms import TWO_MIRROR


def test_seeds_do_not_depend_on_the_number_of_campaigns(job):
    seeds = [job.campaign_seed(i) for i in range(200)]
    assert len(set(seeds)) == 200 and all(0 <= s < 2**63 for s in seeds)
    assert replace(job, seed=8).campaign_seed(0) != seeds[0]


def test_estimates_of_a_posterior_go_by_its_weights():
    """Three draws of weights 1/2, 1/4, 1/4: means and variances by hand, and no draw counts as another."""
    from tvsbayes.posterior.draws import Posterior
    from tvsbayes.studies.study_job import sampled_estimates

    weights = np.array([[0.5, 0.25, 0.25]])
    physical = np.zeros((1, 3, len(TWO_MIRROR.names)))
    physical[0, :, TWO_MIRROR.index["backlash_deg.pan"]] = [0.1, 0.3, 0.5]
    ratio = np.zeros((1, 3, 4))
    ratio[0, :, 0], ratio[0, :, 1] = [0.06, 0.07, 0.08], [0.05, 0.05, 0.09]
    draws = drawn_quantities(1, 3, physical=physical, effective_deg_per_step=ratio)
    z = np.array([[[0.0, 1.0], [2.0, 1.0], [2.0, 5.0]]])
    joined = jax.tree.map(lambda x: x[0], draws)
    posterior = Posterior(None, z, np.zeros((1, 3)), draws, weights, None, 0, 0.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Posterior, "joined", joined)
        estimates = sampled_estimates(posterior)
    np.testing.assert_allclose(estimates.z, [1.0, 2.0], rtol=1e-15)
    np.testing.assert_allclose(estimates.covariance, [[1.0, 1.0], [1.0, 3.0]], rtol=1e-14)
    left, right, *_, pan_contrast, tilt_contrast, pan_play, tilt_play, _ = estimates.value
    assert (left, right, pan_contrast) == pytest.approx((0.0675, 0.06, 0.0075), rel=1e-12)
    assert (tilt_contrast, pan_play, tilt_play) == pytest.approx((0.0, 0.25, 0.0), rel=1e-12)


@pytest.mark.parametrize("sound", [True, False])
def test_a_chain_answers_where_weights_are_not_sound(sound):
    """And nowhere else: it costs several times as much."""
    from tvsbayes.studies import study_job

    calls = []

    def sampled(result, tier, *, seed):
        calls.append((result, tier, seed))
        return SimpleNamespace(tier=tier, converged=sound or tier == "emcee")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_job, "sample", sampled)
        posterior = study_job.posterior_of("a fit", 3)
    assert posterior.converged and calls[-1] == ("a fit", posterior.tier, 3)
    assert [tier for _, tier, _ in calls] == ["importance", "emcee"][: 1 if sound else 2]


@pytest.mark.slow
def test_the_planner_predicts_what_a_fit_of_real_gears_reports(mounted_rig):
    """Ratios, lines over the looks with the gears' errors: sds of a fit within 15 % of those predicted at its truth.

    Stop errors are estimated from 40 stops a direction, to 11 % each.
    """
    from tvsbayes.instrument.axes import DIRECTIONS
    from tvsbayes.instrument.protocols import grid_protocol
    from tvsbayes.planning.target import parse_target
    from tvsbayes.studies.study_job import StudyJob, study_row

    assert mounted_rig.table.priors["transmission_error_deg.pan"].u > 0
    plan = grid_protocol(targets=("d1", "d2"), pan_steps=(0, 60, 120, 180, 240), tilt_steps=(-80, -30, 30, 80))
    target = parse_target("u(worst) <= 1e-3 deg/step")
    row = study_row(StudyJob(mounted_rig, plan, target, seed=7, estimator="laplace"), 2)
    assert row.converged
    for direction in DIRECTIONS:
        headline = row.headlines[direction]
        assert headline.sd == pytest.approx(headline.predicted_sd, rel=0.15)
        assert abs(headline.value - headline.truth) < 4 * headline.sd
    assert row.target == pytest.approx(max(row.headlines[direction].sd for direction in DIRECTIONS))

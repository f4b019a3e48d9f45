"""A study's job, and one row: a plan simulated and fitted once, with the truth and the planner's forecast.

Headlines in deg/step, deg and mm; coordinates z have prior N(0, 1) each.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import numpy as np

from tvsbayes.errors import InputError, NothingToEstimate, TvsError
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.files.packages import own_version
from tvsbayes.gears.priors import half_normal_sd, half_normal_slope
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.mechanisms import BACKLASH_COLUMNS
from tvsbayes.instrument.parameters import TARGETS
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.rig import Rig, rig_table_toml
from tvsbayes.instrument.stereo_pair import stereo_bytes
from tvsbayes.model.headlines import Derived
from tvsbayes.planning.drawn_rigs import instruments_in
from tvsbayes.planning.expectation import Knowledge, fit_places, fitted_errors, information_of, prior_knowledge
from tvsbayes.planning.gear_places import NO_PLACES, expected_scales
from tvsbayes.planning.target import Target, sensitivity
from tvsbayes.posterior.draws import Posterior
from tvsbayes.posterior.sampling import sample
from tvsbayes.results.tiers import CHAIN, IMPORTANCE
from tvsbayes.statistics.optimal_design import covariance_of
from tvsbayes.statistics.weighted_draws import TAILS, weighted_mean, weighted_quantiles
from tvsbayes.studies.rows import STUDY_FORMAT, HeadlineRow, StudyRow
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth

ESTIMATORS = ("importance", "laplace")
"""Estimators of a row's values: the sampled posterior (`posterior_of`), or the Laplace approximation."""
ITERATIONS = 6
"""Iterations of slope and width of a backlash; each reduces the width's error at least threefold."""


@dataclass(frozen=True)
class StudyJob:
    """Inputs of a worker for any row of a study; `estimator` is one of `ESTIMATORS`."""

    rig: Rig
    steps: tuple[PlanStep, ...]
    target: Target
    seed: int = 0
    aperture: bool = False
    estimator: str = "importance"

    @cached_property
    def key(self) -> str:
        """Compute the SHA-256 of all inputs: program, rig, truth, cameras, plan, target, seed, reading, estimator."""
        rig = self.rig
        parts = [
            STUDY_FORMAT,
            own_version(),
            rig_table_toml(rig.table),
            json.dumps({name: [p.value, p.u, p.distribution] for name, p in sorted(rig.truth.items())}),
            "" if rig.stereo is None else stereo_bytes(rig.stereo).decode(),
            json.dumps([sorted(rig.sheets_mm.items()), rig.look_sd, sorted(rig.costs_s.items())]),
            json.dumps([[s.action, s.pan_steps, s.tilt_steps, s.target, s.experiment, s.point] for s in self.steps]),
            json.dumps([self.target.text, self.seed, self.aperture]),
            # Older rows, when there was no other estimator, keep their design.
            *([] if self.estimator == "laplace" else [self.estimator]),
        ]
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()

    def campaign_seed(self, index: int) -> int:
        """Compute the seed of campaign `index`, independent of order, engine and number of campaigns."""
        high, low = np.random.SeedSequence([self.seed, index]).generate_state(2)
        return (int(high) >> 10) << 32 | int(low)


def true_headlines(truth: Truth, campaign: Campaign, pose_rad: np.ndarray) -> np.ndarray:
    """Compute `TARGETS` of a true rig by the twin's formulas: ratios over a campaign's looks, others at a pose.

    Raises:
        NothingToEstimate: the campaign has no looks.
    """
    pan_deg, tilt_deg = np.degrees(pose_rad).tolist()
    true = truth.headlines(campaign, (pan_deg, tilt_deg))
    if true is None:
        raise NothingToEstimate("no-looks", "no look of this campaign has a spot: it has no ratios")
    return np.array([true[quantity.name] for quantity in TARGETS.values()])


def study_row(job: StudyJob, index: int) -> StudyRow:
    """Simulate one campaign, fit and sample it, and compare with the truth and the planner's prediction there.

    Every failure is a row too, such as a chain that has not converged: failures are counted, never dropped.
    """
    start, seed = time.perf_counter(), job.campaign_seed(index)
    run = simulate(job.rig, job.steps, seed, aperture=job.aperture)
    unseen = sum(spot.status != "ok" for spot in run.campaign.spots)
    row = StudyRow(job.key, index, seed, False, unseen, (), 0.0, estimator=job.estimator)
    try:
        result = fit(run.campaign)
        problems, estimates = tuple(result.problems), laplace_estimates(result)
        if job.estimator == "importance" and result.converged:
            posterior = posterior_of(result, seed % 2**32)
            problems, estimates = posterior.convergence.missing, sampled_estimates(posterior)
    except TvsError as error:
        return replace(row, problems=(error.message,), seconds=time.perf_counter() - start)
    return replace(
        row,
        converged=not problems,
        problems=problems,
        headlines=_compared(job, result, estimates, run.truth),
        target=reported(job, result, estimates),
        seconds=time.perf_counter() - start,
    )


def posterior_of(result: JointFit, seed: int) -> Posterior:
    """Sample by importance sampling, or by a chain if its weights are not reliable, as `tvsbayes fit` does."""
    posterior = sample(result, IMPORTANCE, seed=seed)
    return posterior if posterior.converged else sample(result, CHAIN, seed=seed)


@dataclass(frozen=True)
class Estimates:
    """Estimates of coordinates and headlines.

    Attributes:
        z: centre of the coordinates, shape (p,).
        covariance: covariance of the coordinates, shape (p, p).
        value: estimates of `TARGETS`, shape (9,).
        draws: draws of `TARGETS`, shape (n, 9).
        weights: weights of the draws, sum 1, shape (n,).
    """

    z: np.ndarray
    covariance: np.ndarray
    value: np.ndarray
    draws: np.ndarray
    weights: np.ndarray


def reported(job: StudyJob, result: JointFit, estimates: Estimates) -> float | None:
    """Compute the target's value by an estimator; None where no beam reaches its point."""
    target = job.target
    if target.point_mm is None:
        return target.factor * float(spread(estimates)[list(target.indices)].max())
    taught = fitted_errors(result, estimates.covariance)
    gears, covariance = (NO_PLACES, estimates.covariance) if taught is None else (taught.places, taught.covariance)
    try:
        at = sensitivity(target, estimates.z, result.space, job.rig.table, result.reference_pose_rad, gears)
    except InputError:
        return None
    return at.value(covariance, target.factor)


def spread(estimates: Estimates) -> np.ndarray:
    """Compute the sd of every headline, shape (9,)."""
    return np.sqrt(estimates.weights @ (estimates.draws - weighted_mean(estimates.draws, estimates.weights)) ** 2)


def laplace_estimates(result: JointFit) -> Estimates:
    """Return estimates by the mode and the draws of the Laplace approximation."""
    [mode] = _headline_draws(jax.tree.map(lambda part: np.asarray(part)[None], result.mode))
    draws = _headline_draws(result.draws)
    return Estimates(result.z, result.covariance, mode, draws, np.full(len(draws), 1 / len(draws)))


def sampled_estimates(posterior: Posterior) -> Estimates:
    """Return estimates by a posterior's draws."""
    z, weights = posterior.z.reshape(-1, posterior.z.shape[-1]), posterior.weights.ravel()
    draws = _headline_draws(posterior.joined)
    covariance = np.cov(z, rowvar=False, aweights=weights, ddof=0)
    return Estimates(weighted_mean(z, weights), covariance, weighted_mean(draws, weights), draws, weights)


def _compared(job: StudyJob, result: JointFit, estimates: Estimates, true: Truth) -> dict[str, HeadlineRow]:
    """Compare every headline with the truth and with the planner's prediction at that truth."""
    bare, pose = prior_knowledge(job.rig), result.reference_pose_rad
    instruments = instruments_in(bare, [true])
    z, space = instruments.z[0], instruments.space_of(0)
    # Ratios are slopes of the fit's lines, with gear errors of the true scales.
    knowledge = bare.with_places(replace(fit_places(result), scales=expected_scales(z, space, True)))
    information = information_of(job.steps, knowledge, aperture=job.aperture, z=z, space=space)
    at_truth = knowledge.gears.headlines(z, space, pose)
    predicted = predicted_sds(knowledge, information.fisher, np.asarray(at_truth.gradient), z)
    values = true_headlines(true, result.campaign, pose)
    low, high = weighted_quantiles(estimates.draws, estimates.weights, TAILS)
    sd = spread(estimates)
    return {
        name: HeadlineRow(
            truth=float(values[k]),
            value=float(estimates.value[k]),
            sd=float(sd[k]),
            interval95=(float(low[k]), float(high[k])),
            pit=float(estimates.weights @ (estimates.draws[:, k] < values[k])),
            predicted_sd=float(predicted[k]),
        )
        for k, name in enumerate(TARGETS)
    }


def predicted_sds(knowledge: Knowledge, fisher: np.ndarray, gradient: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Predict sds of quantities at a truth, with backlashes linearised over the width of their posteriors.

    Near zero backlash its slope by its coordinate vanishes: linearised there, a ratio would seem uncorrelated with it.
    The slope is taken as sd(backlash) / sd(coordinate), with the posterior's width found by iteration.

    Args:
        knowledge: knowledge before the plan.
        fisher: information of the plan at the truth, shape (p + e, p + e).
        gradient: d(quantity)/d(coordinates, errors of gears) there, shape (q, p + e).
        z: coordinates of the truth, shape (p,).

    Returns:
        Shape (q,).
    """
    slope = half_normal_slope(z[BACKLASH_COLUMNS])
    scale, covariance = np.ones(len(fisher)), np.eye(len(fisher))
    for _ in range(ITERATIONS):
        for column, at in zip(BACKLASH_COLUMNS, slope, strict=True):
            width = math.sqrt(covariance[column, column])
            scale[column] = half_normal_sd(z[column], width) / width / at
        covariance = covariance_of(knowledge.precision + fisher * np.outer(scale, scale))
    return np.sqrt(np.einsum("qi,ij,qj->q", gradient * scale, covariance, gradient * scale))


def _headline_draws(draws: Derived) -> np.ndarray:
    """Return `TARGETS` of draws, shape (draws, 9)."""
    return np.column_stack([draws[quantity.name] for quantity in TARGETS.values()])

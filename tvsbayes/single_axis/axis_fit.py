"""The fit of one axis: mode, sampled posterior, equal draws of all reported quantities.

It also finds priors that the readings contradict: the error and the play by position can absorb a wrong ratio or play,
so that the posterior shows no conflict with the prior. The check fits a model without that prior.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import NotConverged, TvsError
from tvsbayes.inference.chain import better, run_of
from tvsbayes.inference.importance import Sample, weighted_run
from tvsbayes.progress import Job, Show
from tvsbayes.results.estimates import CONFLICT_LIMIT, conflict_sentence
from tvsbayes.results.records import AnswerKind, EstimatorName, Tier
from tvsbayes.results.tiers import CHAIN, IMPORTANCE
from tvsbayes.single_axis.axis_campaign import AxisCampaign
from tvsbayes.single_axis.axis_density import HEADLINE_DRAWS, AxisDensity, AxisMode, find_mode, headline_functionals
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AxisPrior, axis_priors
from tvsbayes.single_axis.axis_rows import AxisRows, rows_of
from tvsbayes.single_axis.classic_line import fit_line
from tvsbayes.single_axis.period_search import waves_of
from tvsbayes.statistics.linear_posterior import LinearPosterior
from tvsbayes.statistics.streams import AxisStream, random_stream

ABSORBED = ("per_command", "backlash")
"""Keys of `[axis]` that processes of position can absorb."""
REMEDY = (
    "check sign and unit of commands (steps or microsteps?) and readings, or state the prior wider or leave it out of "
    "[axis]"
)
DRAWS = 200
"""Draws of the Laplace approximation for a value and its sd."""
MODE, WEIGHING, WALKING, SUMMARISING = "mode", "weighted draws", "chain", "summarising"
EQUAL_DRAWS = 2000
"""Number of equally weighted draws kept of a sample."""
ROUNDS_MAX = 32
"""Largest number of rounds of weighted draws: beyond it a chain costs less than the further draws."""
PILOTS_MAX = 16
"""Largest number of rounds that adapt the proposal: waves, creep and drifts are nonlinear, the Laplace approximation is
not."""


@dataclass(frozen=True)
class PriorConflict:
    """A prior that the readings contradict.

    Attributes:
        name: name of the parameter.
        value, sd: estimate from the readings without that prior; for a scale, its posterior. Folder's unit.
        prior: the prior, stated or default.
        stated: whether the prior was stated.
        distance: distance of the value from the prior's centre, in prior sds; infinite where the prior fixes it.
    """

    name: str
    value: float
    sd: float
    prior: AxisPrior
    stated: bool
    distance: float

    @property
    def text(self) -> str:
        """A sentence with the readings' value, the prior and the remedy."""
        prior, origin = self.prior, "of [axis]" if self.stated else "by default"
        entry = f"`{self.name.split('.')[0]} = {{ value = {prior.value:.10g}, u = {prior.u:.6g} }}` {origin}"
        # Digits down to the second digit of its u.
        digits = int(np.clip(2 + np.ceil(np.log10(max(abs(self.value), 1e-300) / self.sd)), 2, 12))
        quantity = f"{self.name} = {self.value:.{digits}g} (u = {self.sd:.2g})"
        return conflict_sentence(quantity, self.distance, entry, REMEDY)


def _conflicts(fit: AxisFit) -> Iterator[PriorConflict]:
    """Priors that the readings contradict."""
    model, stated = fit.model, fit.campaign.stated
    rng, defaults = random_stream(fit.seed, AxisStream.PRIOR_CONFLICTS), default_priors(fit.rows)
    for name in ABSORBED:
        if name in stated:
            yield from _absorbed_conflict(model, name, defaults[name], rng)
    values = model.coordinates.values(fit.w)
    for k, name in enumerate(model.coordinates.names):
        key, z = name.split(".")[0], float(fit.w[:, k].mean())
        # An axis much better than the default contradicts no statement of the user.
        far = (z if key not in stated else abs(z)) > CONFLICT_LIMIT
        if far and key not in ABSORBED and not key.startswith("wave_"):
            value, sd = float(values[name].mean()), float(values[name].std())
            yield PriorConflict(name, value, sd, model.priors[key], key in stated, abs(z))


def _absorbed_conflict(
    model: AxisModel, name: str, default: AxisPrior, rng: np.random.Generator
) -> Iterator[PriorConflict]:
    """The conflict of prior and readings beyond both u; none where the test is not possible."""
    prior = model.priors[name]
    if prior.u >= default.u or (name == "backlash" and not model.rows.both_sides):
        return
    without_prior = AxisModel.of(model.rows, {**model.priors, name: default}, None, model.coordinates.waves)
    mode = find_mode(without_prior)
    if mode.missing:
        return
    linear = without_prior.linear(mode.drawn(DRAWS, rng))
    draws = linear.drawn(without_prior.line_terms(**{name: 1.0})[None], rng)[:, 0]
    value, sd = float(draws.mean()), float(draws.std())
    difference = abs(value - prior.value)
    if difference > CONFLICT_LIMIT * float(np.hypot(prior.u, sd)):
        yield PriorConflict(name, value, sd, prior, True, difference / prior.u if prior.u else np.inf)


@dataclass(frozen=True, repr=False)
class AxisFit(Shown):
    """A fitted axis.

    Attributes:
        campaign, model: data and model of the fit.
        mode: mode of the sampled parameters.
        sample: the sampled posterior; None where nothing was sampled.
        w: coordinates of equal draws, (draws, d); from the Laplace approximation where no sample converged.
        seed: seed of all random numbers.
    """

    campaign: AxisCampaign
    model: AxisModel
    mode: AxisMode
    sample: Sample | None
    w: np.ndarray
    seed: int

    def shown(self) -> View:
        """Data, method and state of the fit; `axis_record.summarise_axis` has its results."""
        rows, method = self.rows, self.tier or self.estimator
        state = "converged" if self.error is None else f"NOT CONVERGED: {self.error.message}"
        return View(f"AxisFit of {len(rows.value)} rows at {len(rows.positions)} positions by {method}, {state}")

    @property
    def rows(self) -> AxisRows:
        """Averaged readings."""
        return self.model.rows

    @classmethod
    def of_draws(cls, campaign: AxisCampaign, model: AxisModel, w: np.ndarray, seed: int) -> AxisFit:
        """A fit from stored draws, without their sample."""
        mode = AxisMode(w.mean(axis=0), np.atleast_2d(np.cov(w.T)), 0.0)
        return cls(campaign, model, mode, None, w, seed)

    @property
    def answer(self) -> AnswerKind:
        """Kind of the intervals."""
        return "laplace" if self.sample is None else self.sample.convergence.answer

    @property
    def estimator(self) -> EstimatorName:
        """The estimator of the intervals."""
        return "laplace" if self.answer == "laplace" else "posterior"

    @property
    def tier(self) -> Tier | None:
        """Tier of the posterior; None for a Laplace approximation."""
        return None if self.sample is None or self.answer == "laplace" else self.sample.tier

    @property
    def missing(self) -> tuple[str, ...]:
        """Why the answer is not accepted, in sentences; without a sample, why the mode must not be used."""
        if self.sample is None:
            return self.mode.missing
        label = {"accepted": "", "rough": "ROUGH", "laplace": "LAPLACE"}[self.answer]
        return tuple(f"{label}: {sentence}" for sentence in self.sample.convergence.missing)

    @property
    def error(self) -> TvsError | None:
        """`NotConverged` where there is no mode or the sample did not converge."""
        if self.estimator == "posterior" or not self.mode.missing:
            return None
        if not self.free:
            remedy = "state other values in [axis]: every scale is held where the readings cannot be"
        elif contradicted := [conflict for conflict in self.conflicts if conflict.stated]:
            remedy = "; ".join(conflict.text for conflict in contradicted)
        else:
            remedy = "look for wild readings, and at the values and u of [axis]"
        return NotConverged("unconverged", "UNCONVERGED: " + "; ".join(self.mode.missing), remedy=remedy)

    @cached_property
    def conflicts(self) -> tuple[PriorConflict, ...]:
        """Priors that the readings contradict."""
        return tuple(_conflicts(self))

    @cached_property
    def linear(self) -> LinearPosterior:
        """Posterior of the linear quantities at every equal draw."""
        return self.model.linear(self.w)

    @cached_property
    def draws(self) -> dict[str, np.ndarray]:
        """Equal draws (draws,) of every sampled parameter, of the linear ones, and of the line through the stops."""
        rng = random_stream(self.seed, AxisStream.LINEAR_TERMS)
        draws = {name: v for name, v in self.model.coordinates.values(self.w).items() if name in self.free}
        # All in one call: their posterior is joint, and a sum may be known far better than its terms.
        functionals, names = headline_functionals(self.model, self.w), self.model.shifts
        shifts = np.eye(self.model.columns)[list(self.model.shift_columns.values())]
        shifts = np.broadcast_to(shifts, (*functionals.shape[:-2], len(names), functionals.shape[-1]))
        functionals = np.concatenate([functionals, shifts], axis=-2)
        # In units of their sd: an offset is known to more digits than a contrast has; what is fixed stays exact.
        sd = self.linear.sd_of(functionals).mean(axis=0)
        linear = self.linear.drawn(functionals / np.where(sd > 0, sd, 1.0)[:, None], rng) * sd
        linear[:, sd == 0] = self.linear.mean_of(functionals)[:, sd == 0]
        return draws | dict(zip((*HEADLINE_DRAWS, *names), linear.T, strict=True))

    @property
    def free(self) -> tuple[str, ...]:
        """Sampled parameters."""
        return self.model.coordinates.names


def model_of(campaign: AxisCampaign, more: np.ndarray | None = None) -> AxisModel:
    """Build the model of a campaign; `more` as in `fit_axis`.

    Raises:
        NothingToEstimate: too few positions or moves, or readings without motion.
        InputError: too many moves, or angles that wrap.
    """
    rows = rows_of(campaign)
    priors = default_priors(rows) | campaign.priors
    return AxisModel.of(rows, priors, more, waves_of(rows, priors, campaign.periods))


def default_priors(rows: AxisRows) -> dict[str, AxisPrior]:
    """All default priors of an axis."""
    u = float(np.sqrt(fit_line(rows).covariance[1, 1]))
    return axis_priors({}, rows.travel, rows.line.slope, u, rows.unit)


def fit_axis(
    campaign: AxisCampaign,
    *,
    tier: Tier | None = None,
    sampled: bool = True,
    max_minutes: float = 10.0,
    seed: int = 0,
    progress: Show | None = None,
    more: np.ndarray | None = None,
) -> AxisFit:
    """Fit an axis campaign and sample its posterior.

    Args:
        campaign: from `read_axis`.
        tier: None for weighted draws, and a chain only where they are not accepted; "importance" for weighted draws
            alone; "emcee" for a chain that must agree with them, whatever their answer.
        sampled: sample the posterior; else only the Laplace approximation is used.
        max_minutes: time for the chain.
        seed: seed of all random numbers.
        progress: shows the progress.
        more: further commands at which the error will be evaluated, shape (n,).

    Raises:
        NothingToEstimate: too few positions or moves, or readings without motion.
        InputError: too many moves, or angles that wrap.
    """
    model = model_of(campaign, more)
    stages = {
        MODE: 1.0,
        WEIGHING: 2.0 * sampled,
        WALKING: 8.0 * (sampled and tier not in (None, IMPORTANCE)),
        SUMMARISING: 0.5,
    }
    with Job(stages, progress) as job:
        job.begin(MODE)
        mode, sample = find_mode(model), None
        if sampled and len(mode.w) and np.isfinite(mode.log_density):
            job.begin(WEIGHING)
            run = weighted_run(AxisDensity(model, mode), seed, job.at, ROUNDS_MAX, pilots_max=PILOTS_MAX)
            start_time = time.monotonic()
            sample = run.sample
            if tier not in (None, IMPORTANCE) or (tier is None and sample.convergence.answer != "accepted"):
                walk = run_of(tier or CHAIN)
                job.begin(WALKING)
                sample = better(sample, walk(run, None, None, job.at, start_time).until_converged(60.0 * max_minutes))
        job.begin(SUMMARISING)
        rng = random_stream(seed, AxisStream.RESAMPLING)
        if sample is not None and sample.convergence.converged:
            w = sample.equal(EQUAL_DRAWS, rng)
        else:
            w = mode.drawn(EQUAL_DRAWS, rng, "cholesky")
        fit = AxisFit(campaign, model, mode, sample, w, seed)
        assert fit.draws
    return fit

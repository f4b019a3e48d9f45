"""The fit of one axis: mode, both tiers of the posterior, equal draws of everything that is said of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import NotConverged, TvsError
from tvsbayes.progress import Advance, Job, Show
from tvsbayes.single_axis.axis_campaign import AxisCampaign
from tvsbayes.single_axis.axis_conflicts import PriorConflict, conflict_text, prior_conflicts
from tvsbayes.single_axis.axis_mode import AxisMode, find_mode
from tvsbayes.single_axis.axis_model import AxisModel, LinearPosterior
from tvsbayes.single_axis.axis_parameters import AxisPrior, axis_priors
from tvsbayes.single_axis.axis_rows import AxisRows, rows_of
from tvsbayes.single_axis.axis_sampling import (
    EQUAL_DRAWS,
    AxisChain,
    WeightedSample,
    chain_quality,
    grouped,
    run_chain,
    weighted_sample,
)
from tvsbayes.single_axis.classic_line import fit_line
from tvsbayes.single_axis.period_search import waves_of
from tvsbayes.statistics.weighted_draws import TAILS, weighted_summary

MODE, WEIGHING, WALKING, TELLING = "mode", "weighted draws", "chain", "summarising"
AGREEMENT_MAX = 4.0
"""Monte Carlo errors by which a mean or an interval's end of both tiers may differ."""
HEADLINES = ("per_command.forward", "per_command.backward", "backlash")


@dataclass(frozen=True)
class TierAgreement:
    """Whether both tiers say the same: the largest difference in Monte Carlo errors, of which quantity."""

    agrees: bool
    worst: float
    quantity: str


@dataclass(frozen=True, repr=False)
class AxisFit(Shown):
    """A fitted axis.

    Attributes:
        campaign, rows, model: what was fitted.
        mode: of the sampled parameters.
        first: weighted draws; None of a Laplace approximation.
        chain: None where none was run.
        agreement: of both; None where there is one only, or the weighted draws were not accepted.
        w: coordinates of equal draws, (draws, d).
        seed: of everything random.
    """

    campaign: AxisCampaign
    rows: AxisRows
    model: AxisModel
    mode: AxisMode
    first: WeightedSample | None
    chain: AxisChain | None
    agreement: TierAgreement | None
    w: np.ndarray
    seed: int

    def shown(self) -> View:
        """What was fitted and how; `axis_record.summarise_axis` says what came out."""
        rows, how = self.rows, self.tier or self.estimator
        state = "converged" if self.error is None else f"NOT CONVERGED: {self.error.message}"
        return View(f"AxisFit of {len(rows.value)} rows at {len(rows.positions)} positions by {how}, {state}")

    @classmethod
    def of_draws(cls, campaign: AxisCampaign, model: AxisModel, w: np.ndarray, seed: int) -> AxisFit:
        """Of draws that were kept; how they were made is not."""
        mode = AxisMode(w.mean(axis=0), np.atleast_2d(np.cov(w.T)), 0.0)
        return cls(campaign, model.rows, model, mode, None, None, None, w, seed)

    @property
    def estimator(self) -> str:
        """What made the intervals."""
        return "laplace" if self.first is None else "posterior"

    @property
    def tier(self) -> str | None:
        """Of the posterior."""
        return None if self.first is None else "importance" if self.chain is None else "emcee"

    @property
    def missing(self) -> tuple[str, ...]:
        """Why the intervals must not be used; empty where they may."""
        if self.first is None or not self.free:
            return self.mode.missing
        if self.chain is None:
            return self.first.missing
        if self.agreement is not None and not self.agreement.agrees:
            text = f"both tiers differ in {self.agreement.quantity} by {self.agreement.worst:.1f} Monte Carlo errors"
            return (*self.chain.missing, text)
        return self.chain.missing

    @property
    def error(self) -> TvsError | None:
        """`NotConverged` where the intervals must not be used."""
        if not self.missing:
            return None
        if not self.free:
            remedy = "state other values in [axis]: every scale is held where the readings cannot be"
        elif contradicted := [conflict for conflict in self.conflicts if conflict.stated]:
            # Between a prior and readings that contradict it no sampler comes to rest: longer helps nothing.
            remedy = "; ".join(conflict_text(conflict) for conflict in contradicted)
        elif self.first is None:
            remedy = "run again without --no-sample"
        else:
            longer = "more --max-minutes" if self.chain is not None and self.chain.missing else "another --seed"
            remedy = "run again without --quick" if self.chain is None else f"run again with {longer}"
        return NotConverged("unconverged", "UNCONVERGED: " + "; ".join(self.missing), remedy=remedy)

    @cached_property
    def conflicts(self) -> tuple[PriorConflict, ...]:
        """Priors that the readings contradict."""
        stated, rows = self.campaign.stated, self.rows
        return prior_conflicts(self.model, self.w, stated, default_priors(rows))

    @cached_property
    def linear(self) -> LinearPosterior:
        """What is linear, at every equal draw."""
        return self.model.linear(self.w)

    @cached_property
    def draws(self) -> dict[str, np.ndarray]:
        """Equal draws (draws,) of every sampled parameter, of the linear ones, and of the line through the stops."""
        rng = np.random.default_rng([self.seed, 3])
        found = {name: v for name, v in self.model.coordinates.values(self.w).items() if name in self.free}
        linear = self.linear.drawn(headline_functionals(self.model, self.w), rng)
        return found | dict(zip(HEADLINE_DRAWS, linear.T, strict=True)) | self._shift_draws(rng)

    def _shift_draws(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Of the zero's shifts in time."""
        names = self.model.shifts
        if not names:
            return {}
        drawn = self.linear.drawn(np.array([self.model.shift(name) for name in names]), rng)
        return dict(zip(names, drawn.T, strict=True))

    @property
    def free(self) -> tuple[str, ...]:
        """Sampled parameters."""
        return self.model.coordinates.names


HEADLINE_DRAWS = (
    *("offset", "per_command", "ratio_contrast", "backlash"),
    *("per_command.forward", "per_command.backward", "effective_per_command"),
)
"""Rows of `headline_functionals`."""


def line_weights(model: AxisModel, w: np.ndarray) -> np.ndarray:
    """Slope of the least-squares line of the error by position over the rows, each counting once.

    Shape (columns,), or (n, columns) at draws w (n, d) where a period is not known.
    """
    rows = model.rows
    off = rows.command - rows.command.mean()
    weights = off / (off @ off)
    if not model.repeats_by_draw:
        return weights @ model.functional(rows.command)
    return np.concatenate([weights @ model.functional(rows.command, part) for part in blocks_of(w)])


def blocks_of(w: np.ndarray) -> list[np.ndarray]:
    """Draws (n, d) in blocks small enough for functionals of many commands."""
    return np.array_split(w, max(1, len(w) // 100))


def headline_functionals(model: AxisModel, w: np.ndarray) -> np.ndarray:
    """Functionals of the columns, shape (`HEADLINE_DRAWS`, columns), or (n, ...) as those of `line_weights`."""
    of = model.head
    weights = line_weights(model, w)
    found = np.array(
        [
            # At command nought, where folders count from.
            of(offset=1.0, slope=-model.middle),
            of(slope=1.0),
            of(contrast=1.0),
            of(backlash=1.0),
            of(slope=1.0, contrast=0.5),
            of(slope=1.0, contrast=-0.5),
            of(slope=1.0),
        ]
    )
    if weights.ndim == 2:
        found = np.repeat(found[None], len(weights), axis=0)
    found[..., -1, :] += weights
    return found


def model_of(campaign: AxisCampaign, more: np.ndarray | None = None) -> AxisModel:
    """The model of a campaign; `more` as in `fit_axis`.

    Raises:
        NothingToEstimate: too few positions or moves, or readings that do not move.
        InputError: too many moves, or angles that wrap.
    """
    rows = rows_of(campaign)
    priors = default_priors(rows) | campaign.stated
    return AxisModel.of(rows, priors, more, waves_of(rows, priors, campaign.periods))


def default_priors(rows: AxisRows) -> dict[str, AxisPrior]:
    """Every prior of an axis, as if nothing were stated."""
    u = float(np.sqrt(fit_line(rows).covariance[1, 1]))
    return axis_priors({}, rows.travel, rows.line[1], u)


def fit_axis(
    campaign: AxisCampaign,
    *,
    tier: str = "emcee",
    sampled: bool = True,
    max_minutes: float = 10.0,
    seed: int = 0,
    progress: Show | None = None,
    more: np.ndarray | None = None,
) -> AxisFit:
    """Fit an axis campaign and sample its posterior.

    Args:
        campaign: from `read_axis`.
        tier: "importance" for weighted draws alone, "emcee" for the chain that must agree with them.
        sampled: sample; else the Laplace approximation stands alone.
        max_minutes: time for the chain.
        seed: of everything random.
        progress: told how far it is.
        more: further commands at which the error will be asked for, shape (n,).

    Raises:
        NothingToEstimate: too few positions or moves, or readings that do not move.
        InputError: too many moves, or angles that wrap.
    """
    model = model_of(campaign, more)
    stages = {MODE: 1.0, WEIGHING: 2.0 * sampled, WALKING: 8.0 * (sampled and tier == "emcee"), TELLING: 0.5}
    rng = np.random.default_rng([seed, 1])
    with Job(stages, progress) as job:
        job.begin(MODE)
        mode = find_mode(model)
        first, chain, agreement = None, None, None
        if sampled:
            job.begin(WEIGHING)
            first = weighted_sample(model.log_density, mode, rng, advance=job.at)
            w = first.equal(EQUAL_DRAWS, rng)
            if tier == "emcee" and len(mode.w):
                job.begin(WALKING)
                walked = _walked(model, first, seed, 60.0 * max_minutes, rng, job.at)
                chain, agreement = walked.chain, walked.agreement
                flat = chain.w.reshape(-1, chain.w.shape[2])
                w = flat[np.linspace(0, len(flat) - 1, EQUAL_DRAWS).astype(int)]
        elif len(mode.w):
            w = rng.multivariate_normal(mode.w, mode.covariance, EQUAL_DRAWS, method="cholesky")
        else:
            w = np.zeros((EQUAL_DRAWS, 0))
        job.begin(TELLING)
        found = AxisFit(campaign, model.rows, model, mode, first, chain, agreement, w, seed)
        assert found.draws
    return found


@dataclass(frozen=True)
class _Walked:
    """A chain, and whether it agrees with the weighted draws; None where these cannot be used."""

    chain: AxisChain
    agreement: TierAgreement | None


def _walked(
    model: AxisModel,
    first: WeightedSample,
    seed: int,
    max_seconds: float,
    rng: np.random.Generator,
    advance: Advance,
) -> _Walked:
    """A chain that agrees with the weighted draws, where these may be used, or went on for long."""
    if first.missing:
        return _Walked(run_chain(model.log_density, first, seed, max_seconds, advance), None)
    found: list[TierAgreement] = []

    def agrees(w: np.ndarray) -> bool:
        found.append(_agreement(model, first, w, rng))
        return found[-1].agrees

    chain = run_chain(model.log_density, first, seed, max_seconds, advance, agrees)
    return _Walked(chain, found[-1] if found else _agreement(model, first, chain.w, rng))


def _agreement(model: AxisModel, first: WeightedSample, w: np.ndarray, rng: np.random.Generator) -> TierAgreement:
    """Both tiers' means and interval ends of the headlines, given their scales: expectations and spreads alike."""
    picked = [HEADLINE_DRAWS.index(name) for name in HEADLINES]
    # Of no headline the functional depends on the draw.
    functionals = headline_functionals(model, first.w[:1]).reshape(-1, model.columns)[picked]
    keep = slice(None, None, max(1, len(first.w) // 6000))
    theirs = weighted_summary(
        model.linear(first.w[keep]).drawn(functionals, rng), first.weights[keep] / first.weights[keep].sum()
    )
    stride = max(1, w.shape[1] * w.shape[0] // 6000)
    part = w[:, ::stride]
    ours = model.linear(part.reshape(-1, part.shape[2])).drawn(functionals, rng)
    values = ours.reshape(*part.shape[:2], len(HEADLINES))
    _, bulk, tail = chain_quality(values)
    gaps = {}
    for k, name in enumerate(HEADLINES):
        flat = grouped(values)[..., k].ravel()
        if flat.std() == 0:
            continue
        gap = abs(flat.mean() - theirs.mean[k]) / np.hypot(flat.std() / np.sqrt(bulk[k]), theirs.mcse_mean[k])
        gaps[name] = float(gap)
        for end, probability in enumerate(TAILS):
            about = probability + np.array([-1, 0, 1]) * np.sqrt(probability * (1 - probability) / tail[k])
            low, middle, high = np.quantile(flat, np.clip(about, 0.0, 1.0))
            error = np.hypot(0.5 * (high - low), theirs.mcse_interval95[end][k])
            gap = float(abs(middle - theirs.interval95[end][k]) / error)
            gaps[f"{name}, {('lower', 'upper')[end]} end"] = gap
    worst = max(gaps, key=lambda name: gaps[name])
    return TierAgreement(gaps[worst] < AGREEMENT_MAX, gaps[worst], worst)

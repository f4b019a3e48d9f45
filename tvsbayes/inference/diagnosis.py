"""Whether a chain may be used: R-hat over groups of walkers, effective draws, stuck walkers, agreement with tier 1.

The stored draws are judged, so that ArviZ computes the same figures from `posterior.nc`. Draws are ordered (chain,
draw, ...); a chain is a walker.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.inference.chain import GROUPS, Chain
from tvsbayes.inference.density import Density, columns_of
from tvsbayes.inference.importance import ImportanceRun, Sample, uncertain
from tvsbayes.inference.summaries import monte_carlo_errors, propagated, reweighted
from tvsbayes.inference.walkers import autocorrelation_time
from tvsbayes.results.convergence import Agreement, Convergence, MonteCarloError, extreme
from tvsbayes.results.records import Tier
from tvsbayes.results.tiers import CHAIN
from tvsbayes.statistics.streams import Stream, random_stream

RHAT_LIMIT = 1.01
ESS_LIMIT = 400
TAU_LIMIT = 50
"""Limits of formulation 4.3: rank R-hat by group; bulk and tail effective draws, which make R-hat and the errors
reliable (Vehtari et al., Bayesian Analysis 16 (2021) 667); steps in autocorrelation times. Monte Carlo errors of
headlines have limits of their own, as in importance sampling."""
ROUGH_RHAT = 1.05
"""R-hat above which groups of walkers do not agree even roughly."""
AGREEMENT_LIMIT = 4.0
"""Monte Carlo errors by which a headline's mean or interval end may differ from importance sampling's. In two of a
thousand fits one of some thirty comparisons differs more by chance."""
STUCK_ACCEPTANCE = 0.25
"""Share of the median walker's acceptance below which a walker is stuck."""
STUCK_DEVIATION = 8.0
"""Median absolute deviations of mean log densities beyond which a walker is stuck, if also beyond a standard
deviation of a single draw: means of long chains scatter so little that a rare excursion exceeds the first limit."""
WARM_UP = 10
"""The first 1/10 of the steps is discarded: more than five autocorrelation times at `TAU_LIMIT`."""
STORED_DRAWS = 48
"""Draws stored per walker: this many to twice as many, some four thousand in all."""


@dataclass(frozen=True)
class ChainQuality:
    """Numbers behind the verdict, for the columns `names` (some are headlines) and for the walkers."""

    names: tuple[str, ...]
    rhat: np.ndarray
    ess_bulk: np.ndarray
    ess_tail: np.ndarray
    kept: int
    tau_steps: float
    stuck: np.ndarray

    @property
    def missing(self) -> list[str]:
        """Say in sentences which limits are not met; NaN meets none."""
        missing = []
        if not np.max(self.rhat) <= RHAT_LIMIT:
            worst = self.names[int(np.nanargmax(self.rhat))]
            missing.append(f"R-hat of {worst} is {np.max(self.rhat):.4f}, wanted {RHAT_LIMIT}")
        for kind, ess in (("bulk", self.ess_bulk), ("tail", self.ess_tail)):
            if not np.all(ess >= ESS_LIMIT):
                least = int(np.nanargmin(ess))
                missing.append(f"{self.names[least]} has {ess[least]:.0f} {kind} effective draws, wanted {ESS_LIMIT}")
        if not self.kept >= TAU_LIMIT * self.tau_steps:
            times = f"{self.kept / self.tau_steps:.0f} autocorrelation times"
            missing.append(f"{self.kept} steps are {times}, wanted {TAU_LIMIT}")
        if self.stuck.any():
            missing.append(f"stuck walkers: {', '.join(map(str, np.flatnonzero(self.stuck)))}")
        return missing

    def by_name(self, values: np.ndarray) -> dict[str, float]:
        """Return one of the arrays as a mapping from column name to value."""
        return dict(zip(self.names, map(float, values), strict=True))


def autocorrelation_steps(w: np.ndarray) -> float:
    """Compute the longest integrated autocorrelation time of positions (steps, walkers, d), in steps.

    A walker that never changed a coordinate has no autocorrelation there; one that hardly moves is found by its
    acceptance. The time is infinite where no walker moved along some coordinate.
    """
    moved = np.ptp(w, axis=0) > 0
    if not moved.any(axis=0).all():
        return float("inf")
    return max(autocorrelation_time(w[:, movers, k]) for k, movers in enumerate(moved.T))


def steps_wanted(chain: Chain) -> float:
    """Estimate from the autocorrelation times so far how many steps a chain needs; infinite if no walker moved."""
    discarded = len(chain.w) // WARM_UP
    return TAU_LIMIT * autocorrelation_steps(chain.w[discarded:]) * len(chain.w) / (len(chain.w) - discarded)


def grouped(values: np.ndarray) -> np.ndarray:
    """Join draws (walker, draw, ...) of neighbouring walkers into groups (group, draws, ...), in order of time."""
    walkers, draws, *rest = values.shape
    parts = values.reshape(GROUPS, walkers // GROUPS, draws, *rest)
    return np.swapaxes(parts, 1, 2).reshape(GROUPS, -1, *rest)


def stuck_walkers(chain: Chain, discarded: int) -> np.ndarray:
    """Find walkers that hardly move, or whose density differs from most, shape (walkers,)."""
    acceptance = chain.accepted / len(chain.w)
    means = chain.log_density[discarded:].mean(axis=0)
    deviation = np.abs(means - np.median(means))
    stuck = acceptance < STUCK_ACCEPTANCE * np.median(acceptance)
    single_draw = float(np.median(chain.log_density[discarded:].std(axis=0)))
    return stuck | (deviation > max(STUCK_DEVIATION * float(np.median(deviation)), single_draw))


@dataclass(frozen=True)
class Comparison:
    """Comparison of a chain with the weighted draws: mean, lower and upper end of the columns `names`, shape (3, n).

    Attributes:
        names: names of quantities.
        gap: difference.
        error: its Monte Carlo standard error.
        sd: standard deviations of the posterior, shape (n,).
    """

    names: tuple[str, ...]
    gap: np.ndarray
    error: np.ndarray
    sd: np.ndarray

    @property
    def agreement(self) -> Agreement:
        """Judge the agreement by the largest difference over its error."""
        labels = [f"{name}, {what}" for what in ("mean", "lower end", "upper end") for name in self.names]
        worst = extreme(dict(zip(labels, (self.gap / self.error).ravel().tolist(), strict=True)), max)
        return Agreement(worst.value < AGREEMENT_LIMIT, AGREEMENT_LIMIT, worst)

    @property
    def gaps(self) -> dict[str, MonteCarloError]:
        """Return the differences in posterior sds: possible errors of sampling where they are not chance."""
        rows = zip(*(self.gap / self.sd).tolist(), strict=True)
        return {name: MonteCarloError(mean, (*ends,)) for name, (mean, *ends) in zip(self.names, rows, strict=True)}


def _stacked(columns: Mapping[str, np.ndarray], names: Iterable[str], shape: tuple[int, ...]) -> np.ndarray:
    """Return draws (chain, draw) of quantities, by name along the last axis."""
    return np.stack([columns[name].reshape(shape) for name in names], axis=-1)


def compared(
    first: Sample, quantities: Mapping[str, np.ndarray], shape: tuple[int, int], names: tuple[str, ...]
) -> Comparison:
    """Compare draws (chain, draw) with the weighted draws, by the named columns that vary; by all if none does."""
    theirs = first.quantities
    varying = [name for name in quantities if np.ptp(quantities[name]) > 0 and np.ptp(theirs[name]) > 0]
    # Where no headline varies, all other quantities are compared.
    names = tuple(name for name in names if name in varying) or tuple(varying)
    ours = propagated(_stacked(quantities, names, shape))
    weighted = reweighted(_stacked(theirs, names, first.weights.shape), first.weights)
    one, other = (np.stack([each.mean, *each.interval95]) for each in (ours, weighted))
    errors = (np.stack([each.mcse_mean, *each.mcse_interval95]) for each in (ours, weighted))
    return Comparison(names, np.abs(one - other), np.hypot(*errors), ours.sd)


def quality_of(chain: Chain, discarded: int, columns: Mapping[str, np.ndarray], shape: tuple[int, int]) -> ChainQuality:
    """Compute the quality of a chain from columns of the stored draws (walker, draw)."""
    # Imported here: it loads a module named as JAX.
    from arviz_stats.base import array_stats

    values = _stacked(columns, columns, shape)
    axes = {"chain_axis": 0, "draw_axis": 1}
    return ChainQuality(
        tuple(columns),
        rhat=array_stats.rhat(grouped(values), method="rank", **axes),
        ess_bulk=array_stats.ess(values, method="bulk", **axes),
        ess_tail=array_stats.ess(values, method="tail", prob=(0.05, 0.95), **axes),
        kept=len(chain.w) - discarded,
        tau_steps=autocorrelation_steps(chain.w[discarded:]),
        stuck=stuck_walkers(chain, discarded),
    )


def chain_errors(
    headlines: tuple[str, ...], quantities: Mapping[str, np.ndarray], shape: tuple[int, int]
) -> dict[str, MonteCarloError]:
    """Compute Monte Carlo errors of the headlines that vary, from draws (walker, draw) of a chain."""
    names = [name for name in headlines if np.ptp(quantities[name]) > 0]
    return monte_carlo_errors(names, propagated(_stacked(quantities, names, shape))) if names else {}


def diagnose[D: Density](start: ImportanceRun[D], chain: Chain, tier: Tier = CHAIN) -> Sample:
    """Discard the warm-up, thin, draw the quantities integrated out, and judge the remaining chain."""
    density, first = start.density, start.sample
    discarded = len(chain.w) // WARM_UP
    thin = max(1, (len(chain.w) - discarded) // STORED_DRAWS)
    w = chain.w[discarded:][::thin].transpose(1, 0, 2)
    shape = walkers, draws = w.shape[:2]
    points = density.valued(w.reshape(walkers * draws, -1), random_stream(start.seed, Stream.CHAIN_PLACES))
    points = replace(points, log_target=chain.log_density[discarded:][::thin].T.ravel())
    quantities = density.quantities(points)
    quality = quality_of(chain, discarded, columns_of(density, points), shape)
    missing, same = quality.missing, None
    errors = chain_errors(density.headlines, quantities, shape)
    missing.extend(uncertain(errors))
    if not missing and first.convergence.answer == "accepted":
        beside = compared(first, quantities, shape, density.headlines)
        same = beside.agreement
        # Where two samplers disagree, their difference is the error.
        errors = errors if same.agrees else errors | beside.gaps
    if same is not None and not same.agrees:
        gap = f"by {same.worst.value:.1f} Monte Carlo errors, wanted below {AGREEMENT_LIMIT:g}"
        missing.append(f"{tier} and importance sampling differ on {same.worst.quantity} {gap}")
    convergence = Convergence(
        steps=len(chain.w),
        discarded=discarded,
        thin=thin,
        tau_steps=quality.tau_steps,
        rhat=quality.by_name(quality.rhat),
        ess_bulk=quality.by_name(quality.ess_bulk),
        ess_tail=quality.by_name(quality.ess_tail),
        acceptance=chain.accepted / len(chain.w),
        stuck_walkers=tuple(int(i) for i in np.flatnonzero(quality.stuck)),
        invalid=chain.invalid,
        missing=tuple(missing),
        importance=first.convergence.importance,
        agreement=same,
        monte_carlo_error=errors,
        rough=bool(
            np.max(quality.rhat) <= ROUGH_RHAT
            and not quality.stuck.any()
            and all(error.roughly_known for error in errors.values())
        ),
        tier=tier,
    )
    weights = np.full(shape, 1 / (walkers * draws))
    return Sample(points, quantities, weights, convergence, chain.seconds)

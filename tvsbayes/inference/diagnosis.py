"""Whether a chain may be used: R-hat over groups of walkers, effective draws, stuck walkers, agreement with tier 1.

The stored draws are judged, so that ArviZ computes the same figures from `posterior.nc`. Draws are ordered (chain,
draw, ...); a chain is a walker.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from emcee.autocorr import integrated_time

from tvsbayes.inference.chain import GROUPS, Chain
from tvsbayes.inference.density import Density, columns_of
from tvsbayes.inference.importance import Pool, Sample, uncertain
from tvsbayes.inference.summaries import monte_carlo_errors, propagated, reweighted
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


def autocorrelation_steps(w: np.ndarray) -> float:
    """Compute the longest integrated autocorrelation time of positions (steps, walkers, d), in steps.

    A walker that never changed a coordinate has no autocorrelation there; one that hardly moves is found by its
    acceptance. The time is infinite where no walker moved along some coordinate.
    """
    moved = np.ptp(w, axis=0) > 0
    if not moved.any(axis=0).all():
        return float("inf")
    of_coordinates = (w[:, movers, k, None] for k, movers in enumerate(moved.T))
    return max(float(integrated_time(x, tol=0, quiet=True)[0]) for x in of_coordinates)


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


def _stacked(columns: Mapping[str, np.ndarray], names: Iterable[str], shape: tuple[int, ...]) -> np.ndarray:
    """Return draws (chain, draw) of quantities, by name along the last axis."""
    return np.stack([columns[name].reshape(shape) for name in names], axis=-1)


def compared(
    first: Sample, quantities: Mapping[str, np.ndarray], shape: tuple[int, int], headlines: tuple[str, ...]
) -> tuple[Agreement, dict[str, MonteCarloError]]:
    """Compare means and interval ends of draws (chain, draw) with those of the weighted draws.

    Args:
        first: the weighted draws.
        quantities: draws of the chain by name, shapes (n,).
        shape: their numbers (chain, draw).
        headlines: quantities that are compared, where they vary; all others where none does.

    Returns:
        The largest difference over its Monte Carlo error, judged; all differences in posterior sds, which are errors
        of sampling where they are not chance.
    """
    theirs = first.quantities
    varying = [name for name in quantities if np.ptp(quantities[name]) > 0 and np.ptp(theirs[name]) > 0]
    names = [name for name in headlines if name in varying] or varying
    ours = propagated(_stacked(quantities, names, shape))
    weighted = reweighted(_stacked(theirs, names, first.weights.shape), first.weights)
    one, other = (np.stack([each.mean, *each.interval95]) for each in (ours, weighted))
    gap = np.abs(one - other)
    error = np.hypot(*(np.stack([each.mcse_mean, *each.mcse_interval95]) for each in (ours, weighted)))
    labels = [f"{name}, {what}" for what in ("mean", "lower end", "upper end") for name in names]
    worst = extreme(dict(zip(labels, (gap / error).ravel().tolist(), strict=True)), max)
    rows = zip(names, *(gap / ours.sd).tolist(), strict=True)
    gaps = {name: MonteCarloError(mean, (*ends,)) for name, mean, *ends in rows}
    return Agreement(worst.value < AGREEMENT_LIMIT, AGREEMENT_LIMIT, worst), gaps


def diagnose[D: Density](start: Pool[D], chain: Chain, tier: Tier = CHAIN) -> Sample:
    """Discard the warm-up, thin, draw the quantities integrated out, and judge the remaining chain."""
    # Imported here: it loads a module named as JAX.
    from arviz_stats.base import array_stats

    density, first = start.density, start.sample
    discarded = len(chain.w) // WARM_UP
    kept = chain.w[discarded:]
    thin = max(1, len(kept) // STORED_DRAWS)
    w = kept[::thin].transpose(1, 0, 2)
    shape = walkers, draws = w.shape[:2]
    points = density.valued(w.reshape(walkers * draws, -1), random_stream(start.seed, Stream.CHAIN_PLACES))
    points = replace(points, log_target=chain.log_density[discarded:][::thin].T.ravel())
    quantities, columns = density.quantities(points), columns_of(density, points)
    names, values, axes = tuple(columns), _stacked(columns, columns, shape), {"chain_axis": 0, "draw_axis": 1}
    rhat = array_stats.rhat(grouped(values), method="rank", **axes)
    bulk = array_stats.ess(values, method="bulk", **axes)
    tail = array_stats.ess(values, method="tail", prob=(0.05, 0.95), **axes)
    tau_steps, stuck = autocorrelation_steps(kept), np.flatnonzero(stuck_walkers(chain, discarded)).tolist()
    missing, agreement = [], None
    # NaN meets no limit.
    if not np.max(rhat) <= RHAT_LIMIT:
        missing.append(f"R-hat of {names[int(np.nanargmax(rhat))]} is {np.max(rhat):.4f}, wanted {RHAT_LIMIT}")
    for kind, ess in (("bulk", bulk), ("tail", tail)):
        if not np.all(ess >= ESS_LIMIT):
            least = int(np.nanargmin(ess))
            missing.append(f"{names[least]} has {ess[least]:.0f} {kind} effective draws, wanted {ESS_LIMIT}")
    if not len(kept) >= TAU_LIMIT * tau_steps:
        times = f"{len(kept) / tau_steps:.0f} autocorrelation times"
        missing.append(f"{len(kept)} steps are {times}, wanted {TAU_LIMIT}")
    if stuck:
        missing.append(f"stuck walkers: {', '.join(map(str, stuck))}")
    varying = [name for name in density.headlines if np.ptp(quantities[name]) > 0]
    errors = monte_carlo_errors(varying, propagated(_stacked(quantities, varying, shape))) if varying else {}
    missing.extend(uncertain(errors))
    if not missing and first.convergence.answer == "accepted":
        agreement, gaps = compared(first, quantities, shape, density.headlines)
        if not agreement.agrees:
            # Where two samplers disagree, their difference is the error.
            errors |= gaps
            by = f"by {agreement.worst.value:.1f} Monte Carlo errors, wanted below {AGREEMENT_LIMIT:g}"
            missing.append(f"{tier} and importance sampling differ on {agreement.worst.quantity} {by}")
    rough = bool(np.max(rhat) <= ROUGH_RHAT) and not stuck and all(e.roughly_known for e in errors.values())
    rhats, bulks, tails = (dict(zip(names, each.tolist(), strict=True)) for each in (rhat, bulk, tail))
    convergence = Convergence(
        steps=len(chain.w),
        discarded=discarded,
        thin=thin,
        tau_steps=tau_steps,
        rhat=rhats,
        ess_bulk=bulks,
        ess_tail=tails,
        acceptance=chain.accepted / len(chain.w),
        stuck_walkers=tuple(stuck),
        invalid=chain.invalid,
        missing=tuple(missing),
        importance=first.convergence.importance,
        agreement=agreement,
        monte_carlo_error=errors,
        rough=rough,
        tier=tier,
    )
    return Sample(points, quantities, np.full(shape, 1 / (walkers * draws)), convergence, chain.seconds)

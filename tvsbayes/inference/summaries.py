"""Quantities under a sampled posterior: mean, sd, interval and their Monte Carlo errors.

Draws are ordered (chain, draw, ...); a chain is a walker. Weighted draws are independent, all in one chain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from tvsbayes.display import Cell, Shown, View
from tvsbayes.results.convergence import MonteCarloError
from tvsbayes.statistics.weighted_draws import TAILS, Moments, weighted_summary


@dataclass(frozen=True, repr=False)
class Propagated(Moments, Shown):
    """A quantity under the posterior; every field but the last two has the shape of the quantity.

    Attributes:
        mean, sd: moments of the posterior.
        interval95: equal-tailed, first axis (low, high).
        mcse_mean, mcse_sd, mcse_interval95: Monte Carlo standard errors of the above.
        ess: effective draws behind the mean.
        draws: the values, shape (chain, draw, ...).
        weights: weights of the draws, sum 1, shape (chain, draw).
    """

    ess: np.ndarray
    draws: np.ndarray
    weights: np.ndarray

    def shown(self) -> View:
        """Show mean, sd and interval; of arrays, element by element."""
        low, high = np.atleast_1d(self.interval95[0]).ravel(), np.atleast_1d(self.interval95[1]).ravel()
        mean, sd, error = (np.atleast_1d(each).ravel().tolist() for each in (self.mean, self.sd, self.mcse_mean))
        columns = zip(mean, sd, low.tolist(), high.tolist(), error, strict=True)
        rows: list[tuple[Cell, ...]] = [(str(k), *row) for k, row in enumerate(columns)]
        return View("Propagated quantity", ("element", "mean", "sd", "2.5 %", "97.5 %", "Monte Carlo error"), rows)

    def by_quantity(self, title: str, names: Iterable[str]) -> View:
        """Show mean, sd and interval of the quantities of these names, each of shape (names,)."""
        columns = (each.tolist() for each in (self.mean, self.sd, *self.interval95))
        return View(title, ("quantity", "mean", "sd", "2.5 %", "97.5 %"), list(zip(names, *columns, strict=True)))


def carried(
    function: Callable[[Mapping[str, np.ndarray]], np.ndarray], by_name: Mapping[str, np.ndarray], count: int
) -> np.ndarray:
    """Evaluate a function of all draws by name; values (count, ...), one for each draw.

    Raises:
        ValueError: the number of rows is wrong, or values are not finite.
    """
    values = np.asarray(function(by_name), dtype=float)
    if values.ndim == 0 or len(values) != count:
        raise ValueError(
            f"the function returned shape {values.shape}; its first axis must be the {count} draws it was given: "
            "compute with whole arrays, not with their means"
        )
    if not np.all(np.isfinite(values)):
        share = np.mean(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
        raise ValueError(f"the function has no finite value for {100 * share:.2g} % of the draws")
    return values


def reweighted(values: np.ndarray, weights: np.ndarray) -> Propagated:
    """Summarise independent draws (chain, draw, ...) with weights (chain, draw)."""
    summary = weighted_summary(values.reshape(-1, *values.shape[2:]), weights.ravel())
    moments = {field.name: getattr(summary, field.name) for field in fields(Moments)}
    return Propagated(**moments, ess=summary.ess_mean, draws=values, weights=weights)


def propagated(values: np.ndarray) -> Propagated:
    """Summarise autocorrelated draws (chain, draw, ...) of equal weight."""
    # Imported here: loading takes as long as a fit with stored traces, and only chains need it.
    from arviz_stats.base import array_stats

    flat = values.reshape(*values.shape[:2], -1)
    weights = np.full(values.shape[:2], 1 / (values.shape[0] * values.shape[1]))
    # A quantity that is equal in all draws has no effective number of draws and no Monte Carlo error.
    moving = np.ptp(flat, axis=(0, 1)) > 0

    def each(statistic: Callable[..., np.ndarray], otherwise: float, **options) -> np.ndarray:
        result = np.full(flat.shape[2], otherwise)
        if moving.any():
            result[moving] = statistic(flat[..., moving], chain_axis=0, draw_axis=1, **options)
        return result.reshape(values.shape[2:])

    errors = [each(array_stats.mcse, 0.0, method="quantile", prob=prob) for prob in TAILS]
    return Propagated(
        mean=values.mean(axis=(0, 1)),
        sd=values.std(axis=(0, 1)),
        interval95=np.quantile(values, TAILS, axis=(0, 1)),
        mcse_mean=each(array_stats.mcse, 0.0, method="mean"),
        mcse_sd=each(array_stats.mcse, 0.0, method="sd"),
        mcse_interval95=np.stack(errors),
        ess=each(array_stats.ess, float(values.shape[0] * values.shape[1]), method="bulk"),
        draws=values,
        weights=weights,
    )


def monte_carlo_errors(names: Sequence[str], moments: Moments) -> dict[str, MonteCarloError]:
    """Return Monte Carlo errors by quantity, the last axis of moments, in posterior sds; 0 for constants."""
    sd = np.where(moments.sd > 0, moments.sd, 1.0)
    parts = moments.mcse_mean / sd, *(moments.mcse_interval95 / sd)
    rows = zip(*(np.reshape(part, len(names)).tolist() for part in parts), strict=True)
    return {name: MonteCarloError(mean, (low, high)) for name, (mean, low, high) in zip(names, rows, strict=True)}

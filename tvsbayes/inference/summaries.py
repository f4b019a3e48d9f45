"""Draws by name, propagated into quantities: mean, sd, interval and their Monte Carlo errors.

Draws are ordered (chain, draw, ...); a chain is a walker. Weighted draws are independent, all in one chain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.display import Cell, Shown, View
from tvsbayes.results.convergence import MonteCarloError
from tvsbayes.statistics.weighted_draws import TAILS, Moments, weighted_summary

if TYPE_CHECKING:
    import pandas as pd


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


class NamedDraws:
    """Draws of a posterior by name, with weights.

    Attributes:
        by_name: draws of every quantity, chains joined, each of shape (n,), in the unit of its name.
        weights: weights of the draws, sum 1, shape (n,) or (chain, draw).
    """

    by_name: Mapping[str, np.ndarray]
    weights: np.ndarray

    def view_of(self, title: str, names: Sequence[str]) -> View:
        """Show means, sds and 95 % intervals of the quantities of these names."""
        found = self.propagate(lambda p: np.stack([p[name] for name in names], axis=1))
        columns = (each.tolist() for each in (found.mean, found.sd, *found.interval95))
        return View(title, ("quantity", "mean", "sd", "2.5 %", "97.5 %"), list(zip(names, *columns, strict=True)))

    def to_dataframe(self) -> pd.DataFrame:
        """Return all draws by name, one row each, with their `weight` (sum 1)."""
        import pandas as pd

        return pd.DataFrame({**self.by_name, "weight": self.weights.ravel()})

    def summarised(self, values: np.ndarray) -> Propagated:
        """Compute mean, sd, interval and errors of values (chain, draw, ...), one for every draw."""
        return reweighted(values, np.atleast_2d(self.weights))

    def propagate(self, function: Callable[[Mapping[str, np.ndarray]], np.ndarray]) -> Propagated:
        """Propagate the posterior into a quantity of your own.

        Args:
            function: called once with all draws, a mapping from name to an array (n,) in the unit of the name; returns
                one value per draw, an array (n,) or (n, ...). For example the turn by 200 steps to the left after a
                reversal, deg: `lambda p: 200 * p["degrees_per_step.left"] - p["backlash_deg.pan"]`. The names are those
                of `fit.json` and of `list(posterior.by_name)`.

        Returns:
            Mean, sd, interval and their Monte Carlo errors (JCGM 101 clause 7, with weighted or correlated draws), each
            of the shape (...) of one value. Draws read from files are taken as independent.

        Raises:
            ValueError: the function returned a wrong number of rows, or values that are not finite.
        """
        values, count = np.asarray(function(self.by_name), dtype=float), self.weights.size
        if values.ndim == 0 or len(values) != count:
            raise ValueError(
                f"the function returned shape {values.shape}; its first axis must be the {count} draws it was given: "
                "compute with whole arrays, not with their means"
            )
        if not np.all(np.isfinite(values)):
            share = np.mean(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
            raise ValueError(f"the function has no finite value for {100 * share:.2g} % of the draws")
        return self.summarised(values.reshape(*np.atleast_2d(self.weights).shape, *values.shape[1:]))


def reweighted(values: np.ndarray, weights: np.ndarray) -> Propagated:
    """Summarise independent draws (chain, draw, ...) with weights (chain, draw)."""
    summary = weighted_summary(values.reshape(-1, *values.shape[2:]), weights.ravel())
    moments = {field.name: getattr(summary, field.name) for field in fields(Moments)}
    return Propagated(**moments, ess=summary.ess_mean, draws=values, weights=weights)


def propagated(values: np.ndarray) -> Propagated:
    """Summarise autocorrelated draws (chain, draw, ...) of equal weight."""
    # Imported here: loading takes as long as a fit with stored traces, and only chains need it.
    from arviz_stats.base import array_stats

    shape, flat = values.shape[:2], values.reshape(*values.shape[:2], -1)
    count = shape[0] * shape[1]
    # A quantity that is equal in all draws has no effective number of draws and no Monte Carlo error.
    moving = np.ptp(flat, axis=(0, 1)) > 0

    def each(statistic: Callable[..., np.ndarray], otherwise: float, **options) -> np.ndarray:
        result = np.full(flat.shape[2], otherwise)
        if moving.any():
            result[moving] = statistic(flat[..., moving], chain_axis=0, draw_axis=1, **options)
        return result.reshape(values.shape[2:])

    return Propagated(
        mean=values.mean(axis=(0, 1)),
        sd=values.std(axis=(0, 1)),
        interval95=np.quantile(values, TAILS, axis=(0, 1)),
        mcse_mean=each(array_stats.mcse, 0.0, method="mean"),
        mcse_sd=each(array_stats.mcse, 0.0, method="sd"),
        mcse_interval95=np.stack([each(array_stats.mcse, 0.0, method="quantile", prob=prob) for prob in TAILS]),
        ess=each(array_stats.ess, float(count), method="bulk"),
        draws=values,
        weights=np.full(shape, 1 / count),
    )


def monte_carlo_errors(names: Sequence[str], moments: Moments) -> dict[str, MonteCarloError]:
    """Return Monte Carlo errors by quantity, the last axis of moments, in posterior sds; 0 for constants."""
    sd = np.where(moments.sd > 0, moments.sd, 1.0)
    parts = moments.mcse_mean / sd, *(moments.mcse_interval95 / sd)
    rows = zip(*(np.reshape(part, len(names)).tolist() for part in parts), strict=True)
    return {name: MonteCarloError(mean, (low, high)) for name, (mean, low, high) in zip(names, rows, strict=True)}

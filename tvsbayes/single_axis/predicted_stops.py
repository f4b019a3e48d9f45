"""Readings of further moves, predicted by a fit: stops after another homing, with everything that is uncertain of them.

The moves are joined to those of the fit, as a segment of their own, and their rows left out (formulation 8): so the
prediction holds ratio, play, error by position, homing, drift, scatter of stops and of readings as the model has them.
Commands as in the folder, readings in its unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.errors import NothingToEstimate
from tvsbayes.single_axis.axis_campaign import AxisMove, Reading
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_rows import rows_of
from tvsbayes.statistics.streams import AxisStream, random_stream

DRAWS = 160
"""Of the scales, in a prediction."""


@dataclass(frozen=True)
class PredictedStops:
    """Readings of r stops by n draws of the scales, normal given each.

    Attributes:
        mean: shape (n, r).
        covariance: shape (n, r, r).
        scales: the draws by name, each (n,).
    """

    mean: np.ndarray
    covariance: np.ndarray
    scales: dict[str, np.ndarray]

    def pooled(self, weights: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Mean (r,) and covariance (r, r) of the mixture by weights (n,) of sum 1; None: of equal draws."""
        weights = np.full(len(self.mean), 1 / len(self.mean)) if weights is None else weights
        mean = weights @ self.mean
        off = self.mean - mean
        return mean, np.tensordot(weights, self.covariance, 1) + (weights[:, None] * off).T @ off

    def drawn(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Readings (count, r) of the mixture, as many of each draw as of any other."""
        which = np.arange(count) % len(self.mean)
        values, vectors = np.linalg.eigh(self.covariance)
        normal = rng.standard_normal((count, self.mean.shape[1])) * np.sqrt(np.maximum(values, 0.0))[which]
        return self.mean[which] + np.einsum("nij,nj->ni", vectors[which], normal)

    def log_densities(self, value: np.ndarray, more: np.ndarray | None = None) -> np.ndarray:
        """Of readings (r,) by each draw, shape (n,); `more` is a covariance (r, r) beside those of the prediction."""
        covariance = self.covariance if more is None else self.covariance + more
        _, log_det = np.linalg.slogdet(covariance)
        off = value - self.mean
        square = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])
        return -0.5 * (log_det + square + len(value) * np.log(2 * np.pi))

    def log_density(self, value: np.ndarray, more: np.ndarray | None = None) -> float:
        """Of readings (r,) by the mixture of equal draws; `more` as in `log_densities`."""
        return log_mean(self.log_densities(value, more))


def log_mean(logs: Sequence[float] | np.ndarray) -> float:
    """Logarithm of the mean of densities whose logarithms are given."""
    return float(np.logaddexp.reduce(logs) - np.log(len(logs)))


def carried_scales(of: AxisModel, drawn: np.ndarray, into: AxisModel, rng: np.random.Generator) -> np.ndarray:
    """Coordinates (n, d) for a model of more rows, from draws (n, d) for one of fewer.

    What the fewer rows do not hold, as the scatter of homings where there was one, has its prior, one draw of each of n
    equal shares of it; a backlash that was linear there is drawn given the scales.
    """
    from scipy.special import ndtri

    shares = np.tile(np.arange(len(drawn)) + 0.5, (len(into.coordinates.names), 1)) / len(drawn)
    w = ndtri(rng.permuted(shares, axis=1).T)
    for column, name in enumerate(into.coordinates.names):
        if name in of.coordinates.names:
            w[:, column] = drawn[:, of.coordinates.names.index(name)]
        elif name == "backlash":
            values, sd = of.linear(drawn).of(of.head(backlash=1.0)[None])
            prior = into.priors[name]
            w[:, column] = (values[:, 0] + sd[:, 0] * rng.standard_normal(len(drawn)) - prior.value) / prior.u
    return w


def _spread_draws(fit: AxisFit) -> np.ndarray:
    """So many equal draws (n, d) of a fit, even in the scatter of homings: few tell of its long tail by chance."""
    names = fit.model.coordinates.names
    order = np.argsort(fit.w[:, names.index("home_sd")]) if "home_sd" in names else np.arange(len(fit.w))
    return fit.w[order[((np.arange(DRAWS) + 0.5) * len(order) / DRAWS).astype(int)]]


def predicted_stops(
    fit: AxisFit, moves: Sequence[AxisMove], read: Sequence[int], u: np.ndarray, seed: int = 0
) -> PredictedStops:
    """Readings of moves that come after those of a fit and after another homing.

    Args:
        fit: of an axis.
        moves: of a campaign of its own, in order of time; commands as the mechanics get them.
        read: numbers of the moves that are read, ascending, shape (r,).
        u: standard uncertainties of these readings, shape (r,); 0 where nobody knows.
        seed: of what the draws do not hold.

    Raises:
        NothingToEstimate: the fit is of a drive that never stops.
    """
    if fit.rows.in_motion:
        raise NothingToEstimate(
            "in-motion",
            "the readings are of a drive at constant rate: they tell nothing of stops or of a reversal",
            file="campaign.toml",
            remedy="read stops from both directions into a folder without `rate`",
        )
    known, rng = fit.campaign, random_stream(seed, AxisStream.PREDICTED_STOPS)
    last, number = known.moves[-1], max(r.reading for r in known.readings) + 1
    count, begins = len(known.moves), moves[0].time_s
    joined = [
        replace(
            move,
            move=count + move.move,
            segment=last.segment + 1 + move.segment,
            time_s=last.time_s + move.time_s - begins,
        )
        for move in moves
    ]
    # Any value will do where a row counts as not read; on the line it moves nothing that is judged by the line.
    offset, slope = fit.rows.line
    readings = [
        Reading(number + k, count + at, offset + slope * moves[at].command, float(u[k])) for k, at in enumerate(read)
    ]
    longer = replace(known, moves=(*known.moves, *joined), readings=(*known.readings, *readings))
    rows = replace(rows_of(longer), line=fit.rows.line)
    model = AxisModel.of(rows, fit.model.priors, None, fit.model.coordinates.waves)
    w = carried_scales(fit.model, _spread_draws(fit), model, rng)
    mean, covariance = model.left_out(w, np.flatnonzero(rows.move >= count))
    return PredictedStops(mean, covariance, model.coordinates.values(w))

"""Predict readings of further moves from a fit: stops after another homing, with their complete uncertainty.

The moves are added to those of the fit, as their own segment, and their rows are left out (formulation 8). The
prediction thus includes ratio, play, error by position, homing, drift, scatter of stops and of readings in the model.
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
from tvsbayes.statistics.predicted_readings import PredictedReadings
from tvsbayes.statistics.streams import AxisStream, random_stream

DRAWS = 160
"""Number of draws of the scales in a prediction."""


@dataclass(frozen=True)
class PredictedStops(PredictedReadings):
    """Readings of stops, with the draws of the scales by name, each (n,)."""

    scales: dict[str, np.ndarray]


def transferred_scales(source: AxisModel, draws: np.ndarray, target: AxisModel, rng: np.random.Generator) -> np.ndarray:
    """Coordinates (n, d) for a model of more rows, from draws (n, d) for a model of fewer rows.

    Scales without a coordinate in `source`, such as the scatter of homings with a single homing, get their prior, one
    draw from each of its n equal shares; a backlash that is linear in `source` is drawn given the scales.
    """
    from scipy.special import ndtri

    shares = np.tile(np.arange(len(draws)) + 0.5, (len(target.coordinates.names), 1)) / len(draws)
    w = ndtri(rng.permuted(shares, axis=1).T)
    for column, name in enumerate(target.coordinates.names):
        if name in source.coordinates.names:
            w[:, column] = draws[:, source.coordinates.names.index(name)]
        elif name == "backlash":
            linear, backlash, prior = source.linear(draws), source.line_terms(backlash=1.0)[None], target.priors[name]
            values, sd = linear.mean_of(backlash)[:, 0], linear.sd_of(backlash)[:, 0]
            w[:, column] = (values + sd * rng.standard_normal(len(draws)) - prior.value) / prior.u
    return w


def _spread_draws(fit: AxisFit) -> np.ndarray:
    """`DRAWS` equal draws (n, d) of a fit, evenly spaced in the scatter of homings, so as not to miss its long tail."""
    names = fit.model.coordinates.names
    order = np.argsort(fit.w[:, names.index("home_sd")]) if "home_sd" in names else np.arange(len(fit.w))
    return fit.w[order[((np.arange(DRAWS) + 0.5) * len(order) / DRAWS).astype(int)]]


def predicted_stops(
    fit: AxisFit, moves: Sequence[AxisMove], read: Sequence[int], u: np.ndarray, seed: int = 0
) -> PredictedStops:
    """Predict readings of moves that follow those of a fit after another homing.

    Args:
        fit: fit of an axis.
        moves: moves of a separate campaign, in time order; commands as sent to the mechanics.
        read: numbers of the moves with readings, ascending, shape (r,).
        u: standard uncertainties of these readings, shape (r,); 0 where unknown.
        seed: seed of quantities without draws in the fit.

    Raises:
        NothingToEstimate: the drive never stops.
    """
    if fit.rows.in_motion:
        raise NothingToEstimate(
            "in-motion",
            "the readings are of a drive at constant rate: they contain no stops and no reversal",
            file="campaign.toml",
            remedy="read stops from both directions into a folder without `rate`",
        )
    known, rng = fit.campaign, random_stream(seed, AxisStream.PREDICTED_STOPS)
    last, number = known.moves[-1], max(r.reading for r in known.readings) + 1
    count, start_s = len(known.moves), moves[0].time_s
    joined = [
        replace(
            move,
            move=count + move.move,
            segment=last.segment + 1 + move.segment,
            time_s=last.time_s + move.time_s - start_s,
        )
        for move in moves
    ]
    # The value of a left-out row is arbitrary; a value on the line leaves all that depends on the line unchanged.
    line = fit.rows.line
    readings = [
        Reading(number + k, count + m, line.offset + line.slope * moves[m].command, float(u[k]))
        for k, m in enumerate(read)
    ]
    extended = replace(known, moves=(*known.moves, *joined), readings=(*known.readings, *readings))
    rows = replace(rows_of(extended), line=line)
    model = AxisModel.of(rows, fit.model.priors, None, fit.model.coordinates.waves)
    w = transferred_scales(fit.model, _spread_draws(fit), model, rng)
    stops = model.left_out(w, np.flatnonzero(rows.move >= count))
    return PredictedStops(stops.mean, stops.covariance, model.coordinates.values(w))

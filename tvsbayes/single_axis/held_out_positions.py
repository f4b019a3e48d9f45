"""Hold-out of one axis: every commanded position left out in turn, fitted without it, predicted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.errors import NothingToEstimate
from tvsbayes.inference.importance import K_MAX, PILOT_ROUNDS, weighted_run
from tvsbayes.progress import Job, Show
from tvsbayes.results.comparison_record import AxisHoldOut, HeldOutReadings
from tvsbayes.single_axis.axis_campaign import AxisCampaign
from tvsbayes.single_axis.axis_density import AxisDensity
from tvsbayes.single_axis.axis_fit import model_of
from tvsbayes.single_axis.axis_mode import find_mode
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_rows import DIRECTIONS, AxisRows, line_design
from tvsbayes.single_axis.classic_line import fit_line
from tvsbayes.single_axis.predicted_stops import PredictedStops, carried_scales
from tvsbayes.statistics.intervals import NORMAL_95, rms
from tvsbayes.statistics.streams import AxisStream, random_stream
from tvsbayes.statistics.weighted_draws import effective_draws, smoothed_weights

DRAWS, HELD_ROUNDS = 300, 2
"""Draws that predict, of every fit without a position, and its rounds of importance sampling at least."""
POSITIONS_MIN, POSITIONS_MAX = 3, 200
REFITTED_MAX, WEIGHED, WEIGHED_MIN = 30, 400, 80
"""Positions up to which each has a fit of its own; beyond, draws of one fit are weighted, as long as so many of them
count. `POSITIONS_MAX` are predicted at most."""


def _means_of(rows: AxisRows, members: np.ndarray) -> tuple[np.ndarray, int]:
    """Weights (rows,) of the mean of all readings in these rows, and how many there are."""
    count = rows.count[members]
    return count / count.sum(), int(count.sum())


def classic_prediction(rows: AxisRows, left_out: np.ndarray, members: np.ndarray) -> tuple[float, float]:
    """Mean of rows `members` by offset, scale and play fitted to the rows that are not left out, and its u."""
    line = fit_line(rows, ~left_out)
    weights, _ = _means_of(rows, members)
    at = weights @ line_design(rows)[members]
    variance = float(at @ line.covariance @ at + line.scatter**2 * weights @ weights)
    return float(at @ line.solved), float(np.sqrt(variance))


@dataclass(frozen=True)
class _Prediction:
    """Of the rows left out: mean (rows,), covariance (rows, rows), and what is wrong with them, or ""."""

    mean: np.ndarray
    covariance: np.ndarray
    fault: str = ""


def _reweighted(model: AxisModel, w: np.ndarray, left: np.ndarray) -> _Prediction | None:
    """By draws (n, d) of the posterior of all rows, weighted by what each makes of those left out.

    None where the weights cannot be trusted. Leave-one-out by importance (Vehtari, Gelman and Gabry, Stat. Comput. 27
    (2017) 1413), whole positions left out.
    """
    stops = PredictedStops(*model.left_out(w, left), {})
    smooth = smoothed_weights(-stops.log_densities(model.rows.value[left]))
    if not smooth.pareto_k < K_MAX or effective_draws(smooth.weights) < WEIGHED_MIN:
        return None
    return _Prediction(*stops.pooled(smooth.weights))


def _refitted(model: AxisModel, out: np.ndarray, seed: int) -> _Prediction:
    """By a fit of the rows that are not left out."""
    without = AxisModel.of(model.rows.without(out), model.priors, None, model.coordinates.waves)
    rng = random_stream(seed, AxisStream.HELD_OUT)
    drawn = _drawn(without, DRAWS, seed, rng)
    w = carried_scales(without, drawn.w, model, rng)
    return _Prediction(*PredictedStops(*model.left_out(w, np.flatnonzero(out)), {}).pooled(), drawn.fault)


def hold_out_positions(campaign: AxisCampaign, seed: int = 0, progress: Show | None = None) -> AxisHoldOut:
    """Every commanded position left out in turn, with all its readings from both sides.

    Args:
        campaign: from `read_axis`.
        seed: of everything random.
        progress: told how far it is.

    Raises:
        NothingToEstimate: fewer than three positions, or what `fit_axis` refuses.
        InputError: what `fit_axis` refuses.
    """
    model = model_of(campaign)
    rows = model.rows
    positions = rows.positions
    if len(positions) < POSITIONS_MIN:
        raise NothingToEstimate(
            "too-few-positions",
            f"{len(positions)} positions: with one left out no line is left",
            file="moves.csv",
            remedy="read at least three positions",
        )
    predictions: list[HeldOutReadings] = []
    warnings = []
    if len(positions) > POSITIONS_MAX:
        warnings.append(f"of {len(positions)} positions {POSITIONS_MAX} are left out in turn, evenly chosen")
        positions = positions[np.linspace(0, len(positions) - 1, POSITIONS_MAX).astype(int)]
    drawn = None
    with Job({"hold-out": 1.0}, progress) as job:
        for number, position in enumerate(positions):
            job.at(number / len(positions), f"position {position:.10g}")
            out = rows.command == position
            if len(np.unique(rows.command[~out])) < 2 or (~out).sum() < 3:
                warnings.append(f"position {position:.10g}: too few readings elsewhere to predict it")
                continue
            left, predicted = np.flatnonzero(out), None
            if len(positions) > REFITTED_MAX:
                drawn = _whole_draws(model, seed) if drawn is None else drawn
                predicted = _reweighted(model, drawn, left)
            predicted = predicted or _refitted(model, out, seed + number)
            if predicted.fault:
                warnings.append(f"position {position:.10g}: {predicted.fault}")
            predictions += _scored(rows, position, left, predicted.mean, predicted.covariance)
    return AxisHoldOut(
        positions=tuple(predictions),
        rms_z=rms([p.z for p in predictions]),
        classic_rms_z=rms([p.classic_z for p in predictions if p.classic_u > 0]),
        inside_share=sum(p.inside for p in predictions) / max(sum(p.rows for p in predictions), 1),
        warnings=tuple(warnings),
    )


def _whole_draws(model: AxisModel, seed: int) -> np.ndarray:
    """Coordinates (`WEIGHED`, d) of the scales by all rows."""
    rng = random_stream(seed, AxisStream.HELD_OUT_BY_WEIGHTS)
    return _drawn(model, WEIGHED, seed, rng).w


@dataclass(frozen=True)
class _Drawn:
    """Coordinates (n, d) of equal draws, and what their sample lacks, or ""."""

    w: np.ndarray
    fault: str


def _drawn(model: AxisModel, count: int, seed: int, rng: np.random.Generator) -> _Drawn:
    """By importance sampling."""
    mode = find_mode(model)
    if not len(mode.w):
        return _Drawn(np.zeros((count, 0)), "; ".join(mode.missing))
    sample = weighted_run(AxisDensity(model, mode), seed, rounds_least=HELD_ROUNDS, pilots_max=PILOT_ROUNDS).sample
    return _Drawn(sample.equal(count, rng), "; ".join(sample.convergence.missing))


def _scored(
    rows: AxisRows, position: float, left: np.ndarray, mean: np.ndarray, covariance: np.ndarray
) -> list[HeldOutReadings]:
    """The position from each side it was reached from."""
    predictions = []
    out = rows.command == position
    for side in (1, -1, 0):
        mine = np.flatnonzero(rows.side[left] == side)
        if not len(mine):
            continue
        members = left[mine]
        weights, n = _means_of(rows, members)
        predicted = float(weights @ mean[mine])
        u = float(np.sqrt(weights @ covariance[np.ix_(mine, mine)] @ weights))
        z = (rows.value[members] - mean[mine]) / np.sqrt(np.diag(covariance)[mine])
        classic, classic_u = classic_prediction(rows, out, members)
        predictions.append(
            HeldOutReadings(
                position=float(position),
                direction=DIRECTIONS[side],
                n=n,
                mean=float(weights @ rows.value[members]),
                predicted=predicted,
                u=u,
                rows=len(members),
                inside=int(np.sum(np.abs(z) <= NORMAL_95)),
                classic_predicted=classic,
                classic_u=classic_u,
                end=position in (rows.positions[0], rows.positions[-1]),
            )
        )
    return predictions

"""Hold-out of one axis: every commanded position is left out in turn and predicted from a fit of the others."""

from __future__ import annotations

from functools import cache

import numpy as np

from tvsbayes.errors import NothingToEstimate
from tvsbayes.inference.importance import K_MAX, PILOT_ROUNDS, weighted_run
from tvsbayes.progress import Job, Show
from tvsbayes.results.comparison_record import AxisHoldOut, HeldOutReadings
from tvsbayes.single_axis.axis_campaign import AxisCampaign
from tvsbayes.single_axis.axis_density import AxisDensity, find_mode
from tvsbayes.single_axis.axis_fit import model_of
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_rows import DIRECTIONS, AxisRows, line_design
from tvsbayes.single_axis.classic_line import fit_line
from tvsbayes.single_axis.predicted_stops import transferred_scales
from tvsbayes.statistics.intervals import NORMAL_95, WithSd, rms
from tvsbayes.statistics.predicted_readings import Pooled
from tvsbayes.statistics.streams import AxisStream, random_stream
from tvsbayes.statistics.weighted_draws import effective_draws, smoothed_weights

DRAWS, ROUNDS_MIN = 300, 2
"""Number of draws of a prediction by a fit without the position, and least number of rounds of importance sampling."""
POSITIONS_MIN, POSITIONS_MAX = 3, 200
REFITTED_MAX, DRAWS_WEIGHTED, EFFECTIVE_MIN = 30, 400, 80
"""Largest number of positions with a fit for each; for more positions, draws of one fit are reweighted, if at least the
last number of them are effective. At most `POSITIONS_MAX` are predicted."""


def _mean_weights(rows: AxisRows, members: np.ndarray) -> np.ndarray:
    """Weights (rows,) of the mean of all readings in these rows."""
    return rows.count[members] / rows.count[members].sum()


def _classic_prediction(rows: AxisRows, left_out: np.ndarray, members: np.ndarray) -> WithSd[float]:
    """Mean of rows `members` from offset, scale and play fitted to the other rows."""
    line = fit_line(rows, ~left_out)
    weights = _mean_weights(rows, members)
    design_row = weights @ line_design(rows)[members]
    variance = float(design_row @ line.covariance @ design_row + line.scatter**2 * weights @ weights)
    return WithSd(float(design_row @ line.solution), float(np.sqrt(variance)))


def _reweighted(model: AxisModel, w: np.ndarray, rows: np.ndarray) -> Pooled | None:
    """Prediction by draws (n, d) of the posterior of all rows, reweighted to omit the rows left out.

    None where the weights are unreliable. Leave-one-out by importance sampling (Vehtari, Gelman and Gabry, Stat.
    Comput. 27 (2017) 1413), with whole positions left out.
    """
    stops = model.left_out(w, rows)
    smoothed = smoothed_weights(-stops.log_densities(model.rows.value[rows]))
    if not smoothed.pareto_k < K_MAX or effective_draws(smoothed.weights) < EFFECTIVE_MIN:
        return None
    return stops.pooled(smoothed.weights)


def _refitted(model: AxisModel, left_out: np.ndarray, seed: int) -> tuple[Pooled, str]:
    """Prediction from a fit of the other rows, and the fault of its sample in words, "" for none."""
    reduced = AxisModel.of(model.rows.without(left_out), model.priors, None, model.coordinates.waves)
    rng = random_stream(seed, AxisStream.HELD_OUT)
    draws, fault = _equal_draws(reduced, DRAWS, seed, rng)
    w = transferred_scales(reduced, draws, model, rng)
    return model.left_out(w, np.flatnonzero(left_out)).pooled(), fault


def _equal_draws(model: AxisModel, count: int, seed: int, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Equal draws (n, d) by importance sampling, and the fault of their sample in words, "" for none."""
    mode = find_mode(model)
    if not len(mode.w):
        return np.zeros((count, 0)), "; ".join(mode.missing)
    sample = weighted_run(AxisDensity(model, mode), seed, rounds_least=ROUNDS_MIN, pilots_max=PILOT_ROUNDS).sample
    return sample.equal(count, rng), "; ".join(sample.convergence.missing)


def hold_out_positions(campaign: AxisCampaign, seed: int = 0, progress: Show | None = None) -> AxisHoldOut:
    """Leave out every commanded position in turn, with all its readings from both sides.

    Args:
        campaign: from `read_axis`.
        seed: seed of all random numbers.
        progress: shows the progress.

    Raises:
        NothingToEstimate: fewer than three positions, or as `fit_axis`.
        InputError: as `fit_axis`.
    """
    model = model_of(campaign)
    rows = model.rows
    positions = rows.positions
    if len(positions) < POSITIONS_MIN:
        raise NothingToEstimate(
            "too-few-positions",
            f"{len(positions)} positions: with one left out no line is determined",
            file="moves.csv",
            remedy="read at least three positions",
        )
    predictions: list[HeldOutReadings] = []
    warnings = []
    if len(positions) > POSITIONS_MAX:
        warnings.append(f"of {len(positions)} positions {POSITIONS_MAX} are left out in turn, evenly chosen")
        positions = positions[np.linspace(0, len(positions) - 1, POSITIONS_MAX).astype(int)]

    @cache
    def draws() -> np.ndarray:
        """Coordinates of the scales, from all rows."""
        rng = random_stream(seed, AxisStream.HELD_OUT_BY_WEIGHTS)
        return _equal_draws(model, DRAWS_WEIGHTED, seed, rng)[0]

    with Job({"hold-out": 1.0}, progress) as job:
        for number, position in enumerate(positions):
            job.at(number / len(positions), f"position {position:.10g}")
            left_out = rows.command == position
            if len(np.unique(rows.command[~left_out])) < 2 or (~left_out).sum() < 3:
                warnings.append(f"position {position:.10g}: too few readings elsewhere to predict it")
                continue
            rows_left_out = np.flatnonzero(left_out)
            prediction = _reweighted(model, draws(), rows_left_out) if len(positions) > REFITTED_MAX else None
            if prediction is None:
                prediction, fault = _refitted(model, left_out, seed + number)
                warnings += [f"position {position:.10g}: {fault}"] if fault else []
            predictions += _scores(rows, position, prediction)
    return AxisHoldOut(
        positions=tuple(predictions),
        rms_z=rms([p.z for p in predictions]),
        classic_rms_z=rms([p.classic_z for p in predictions if p.classic_u > 0]),
        inside_share=sum(p.inside for p in predictions) / max(sum(p.rows for p in predictions), 1),
        warnings=tuple(warnings),
    )


def _scores(rows: AxisRows, position: float, prediction: Pooled) -> list[HeldOutReadings]:
    """Scores of the position by side of approach."""
    predictions, (mean, covariance) = [], prediction
    left_out = rows.command == position
    rows_left_out = np.flatnonzero(left_out)
    for side in (1, -1, 0):
        of_side = np.flatnonzero(rows.side[rows_left_out] == side)
        if not len(of_side):
            continue
        members = rows_left_out[of_side]
        weights = _mean_weights(rows, members)
        predicted = float(weights @ mean[of_side])
        u = float(np.sqrt(weights @ covariance[np.ix_(of_side, of_side)] @ weights))
        z = (rows.value[members] - mean[of_side]) / np.sqrt(np.diag(covariance)[of_side])
        classic = _classic_prediction(rows, left_out, members)
        predictions.append(
            HeldOutReadings(
                position=float(position),
                direction=DIRECTIONS[side],
                n=int(rows.count[members].sum()),
                mean=float(weights @ rows.value[members]),
                predicted=predicted,
                u=u,
                rows=len(members),
                inside=int(np.sum(np.abs(z) <= NORMAL_95)),
                classic_predicted=classic.value,
                classic_u=classic.sd,
                end=position in (rows.positions[0], rows.positions[-1]),
            )
        )
    return predictions

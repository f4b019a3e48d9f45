"""Where the density of an axis' scales is highest, and how it is curved there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_rows import reversal_of
from tvsbayes.single_axis.classic_line import fit_line
from tvsbayes.single_axis.waves import start_of

STEP, CURVATURE_STEP = 1e-2, 5e-2
"""Of differences, in units of the coordinates' expected widths: a third derivative of 1 makes 2e-5 of a gradient."""
CURVATURE_MIN = 0.3
"""Least curvature taken, in units of the prior's: where a scale is not needed the density is bent the other way."""

BOUND = 5.0
"""Standard normal coordinates beyond it are one in two million."""
OFF_MAX = 1.0
"""Standard deviations from where a search ended to where slope and curvature there place the mode. A search that got
there ends within 0.01, at a kink of the play (8.1) within 0.7; one that got lost ends beyond 3, 2.8 or more in log
density too low."""


@dataclass(frozen=True)
class AxisMode:
    """Mode and Laplace approximation.

    Attributes:
        w: coordinates, shape (d,).
        covariance: shape (d, d).
        log_density: there; minus infinity where it has no value.
        missing: sentences on why the approximation may not be used by itself; empty where it may.
    """

    w: np.ndarray
    covariance: np.ndarray
    log_density: float
    missing: tuple[str, ...] = ()


def _repeat_sd(model: AxisModel) -> float:
    """Scatter of rows at one position from one side, unit; 1e-4 of the travel where none repeat."""
    rows = model.rows
    squares, freedom = 0.0, 0
    for command in () if rows.in_motion else rows.positions:
        for side in (-1, 0, 1):
            mine = rows.value[(rows.command == command) & (rows.side == side)]
            if len(mine) > 1:
                squares += len(mine) * float(np.var(mine))
                freedom += len(mine) - 1
    return max(float(np.sqrt(squares / freedom)) if freedom else 0.0, 1e-4 * rows.travel)


def _start(model: AxisModel, stop_sd: float) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates to begin at, with stops that scatter by so much, and their expected widths, each (d,)."""
    names = model.coordinates.names
    w, width = np.zeros(len(names)), np.ones(len(names))
    for k, name in enumerate(names):
        if name == "backlash":
            reversal, error = reversal_of(model.rows)
            w[k] = model.coordinates.coordinate(name, reversal)
            width[k] = min(max(error / model.priors[name].u, 1e-9), 1.0)
        elif name.startswith("wave_"):
            w[k] = start_of(model.coordinates.waves[int(name.split(".")[1]) - 1], name)
        elif name.startswith("stop_sd"):
            w[k] = np.clip(model.coordinates.coordinate(name, stop_sd), -4.0, 4.0)
    return w, width


def _gradients(model: AxisModel, w: np.ndarray, width: np.ndarray, step: float) -> np.ndarray:
    """Gradients (n, d) of the log density by the scaled coordinates, at coordinates (n, d)."""
    d = w.shape[1]
    shift = np.concatenate([np.diag(step * width), np.diag(-step * width)])
    value = model.log_density((w[:, None] + shift).reshape(-1, d)).reshape(len(w), 2, d)
    # Where a density has no value neither has its slope.
    with np.errstate(invalid="ignore"):
        slopes = (value[:, 0] - value[:, 1]) / (2 * step)
    return np.where(np.isfinite(slopes), slopes, 0.0)


def _missing(log_density: float, off: float = 0.0) -> tuple[str, ...]:
    """What a search did not reach, in sentences: a density with a value, and an end `off` few sds from the mode."""
    if not np.isfinite(log_density):
        return ("the readings have no density under these priors",)
    if not off <= OFF_MAX:
        return (f"the search for the mode ended {off:.1f} standard deviations away from it, wanted {OFF_MAX:g}",)
    return ()


def find_mode(model: AxisModel, near: Mapping[str, float] | None = None) -> AxisMode:
    """The mode by a quasi-Newton search from the least-squares line and the scatter of repeats.

    A search that does not get there begins anew where stops scatter as widely as rows do about the line: a single wild
    reading lies far outside what repeats tell, where the density is all slope.

    Args:
        model: whose mode is looked for.
        near: coordinates to begin at, by name: of a model with fewer waves.
    """
    start, width = _start(model, _repeat_sd(model))
    start = np.array([(near or {}).get(name, at) for name, at in zip(model.coordinates.names, start, strict=True)])
    nearest = _searched(model, start, width)
    if nearest.missing and len(nearest.w):
        bounded = _searched(model, *_start(model, _repeat_sd(model)), bounded=True)
        if not bounded.missing:
            return bounded
        again = _searched(model, *_start(model, max(fit_line(model.rows).scatter, 1e-4 * model.rows.travel)))
        nearest = max(nearest, again, key=lambda mode: (not mode.missing, mode.log_density))
    return nearest


def _searched(model: AxisModel, start: np.ndarray, width: np.ndarray, bounded: bool = False) -> AxisMode:
    """The mode that a search finds from coordinates (d,) whose expected widths are (d,).

    A `bounded` one stays within `BOUND` of the priors' centres: a long step over a steep density ends far out.
    """
    from scipy.optimize import minimize

    if not len(start):
        alone = float(model.log_density(start[None])[0])
        return AxisMode(start, np.zeros((0, 0)), alone, _missing(alone))

    def value(v: np.ndarray) -> float:
        density = float(model.log_density((start + width * v)[None])[0])
        return -density if np.isfinite(density) else 1e30

    def slope(v: np.ndarray) -> np.ndarray:
        return -_gradients(model, (start + width * v)[None], width, STEP)[0]

    how, bounds = "BFGS", None
    if bounded:
        how, bounds = "L-BFGS-B", list(zip((-BOUND - start) / width, (BOUND - start) / width, strict=True))
    options = {"gtol": 1e-2, "maxiter": 200}
    best = minimize(value, np.zeros(len(start)), jac=slope, method=how, bounds=bounds, options=options)
    v = np.asarray(best.x)
    w = start + width * v
    shift = np.concatenate([np.diag(CURVATURE_STEP * width), np.diag(-CURVATURE_STEP * width)])
    slopes = _gradients(model, w + shift, width, CURVATURE_STEP)
    count = len(w)
    curvature = -(slopes[:count] - slopes[count:]) / (2 * CURVATURE_STEP)
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    inverse = vectors @ np.diag(1 / np.maximum(values, CURVATURE_MIN)) @ vectors.T
    log_density = float(model.log_density(w[None])[0])
    left = _gradients(model, w[None], width, STEP)[0]
    off = float(np.sqrt(left @ inverse @ left))
    return AxisMode(w, width[:, None] * inverse * width, log_density, _missing(log_density, off))

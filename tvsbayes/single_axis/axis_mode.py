"""Mode of the density of an axis' scales, and its curvature at the mode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_rows import reversal_of
from tvsbayes.single_axis.classic_line import fit_line
from tvsbayes.single_axis.waves import start_coordinate

STEP, CURVATURE_STEP = 1e-2, 5e-2
"""Steps of differences, in expected widths of the coordinates: a third derivative of 1 changes a gradient by 2e-5."""
CURVATURE_MIN = 0.3
"""Least curvature, in units of the prior's: where the data do not require a scale the density is convex."""

BOUND = 5.0
"""Limit of coordinates: a standard normal variable exceeds it with probability one in two million."""
SDS_MAX = 1.0
"""Largest distance, in standard deviations, from the end of a search to the mode predicted from slope and curvature. A
successful search ends within 0.01, at a kink of the play (8.1) within 0.7; a failed one beyond 3, 2.8 or more in log
density too low."""


@dataclass(frozen=True)
class AxisMode:
    """Mode and Laplace approximation.

    Attributes:
        w: coordinates, shape (d,).
        covariance: shape (d, d).
        log_density: log density at the mode; minus infinity where it is undefined.
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
            values = rows.value[(rows.command == command) & (rows.side == side)]
            if len(values) > 1:
                squares += len(values) * float(np.var(values))
                freedom += len(values) - 1
    return max(float(np.sqrt(squares / freedom)) if freedom else 0.0, 1e-4 * rows.travel)


def _start(model: AxisModel, stop_sd: float) -> np.ndarray:
    """Start coordinates (d,) for stops with scatter `stop_sd`."""
    names = model.coordinates.names
    w = np.zeros(len(names))
    for k, name in enumerate(names):
        if name == "backlash":
            w[k] = model.coordinates.coordinate(name, reversal_of(model.rows).value)
        elif name.startswith("wave_"):
            w[k] = start_coordinate(model.coordinates.waves[int(name.split(".")[1]) - 1], name)
        elif name.startswith("stop_sd"):
            w[k] = np.clip(model.coordinates.coordinate(name, stop_sd), -4.0, 4.0)
    return w


def _gradients(model: AxisModel, w: np.ndarray, width: np.ndarray, step: float) -> np.ndarray:
    """Gradients (n, d) of the log density by the scaled coordinates, at coordinates (n, d)."""
    d = w.shape[1]
    shift = np.concatenate([np.diag(step * width), np.diag(-step * width)])
    value = model.log_density((w[:, None] + shift).reshape(-1, d)).reshape(len(w), 2, d)
    # Where the density is undefined, its slope is undefined too.
    with np.errstate(invalid="ignore"):
        slopes = (value[:, 0] - value[:, 1]) / (2 * step)
    return np.where(np.isfinite(slopes), slopes, 0.0)


def _missing(log_density: float, distance: float = 0.0) -> tuple[str, ...]:
    """Why a search failed, in sentences: an undefined density, or an end more than `SDS_MAX` sds from the mode."""
    if not np.isfinite(log_density):
        return ("the readings have no density under these priors",)
    if not distance <= SDS_MAX:
        return (f"the search for the mode ended {distance:.1f} standard deviations away from it, wanted {SDS_MAX:g}",)
    return ()


def find_mode(model: AxisModel, guess: Mapping[str, float] | None = None) -> AxisMode:
    """The mode by a quasi-Newton search from the least-squares line and the scatter of repeats.

    A failed search restarts with the scatter of rows about the line as that of stops: a single outlier is far outside
    the scatter of repeats, where the density is very steep.

    Args:
        model: the model.
        guess: start coordinates by name, from a model with fewer waves.
    """
    start = _start(model, _repeat_sd(model))
    known = np.array([(guess or {}).get(name, w) for name, w in zip(model.coordinates.names, start, strict=True)])
    best = _search(model, known)
    if best.missing and len(best.w):
        bounded = _search(model, start, bounded=True)
        if not bounded.missing:
            return bounded
        restarted = _search(model, _start(model, max(fit_line(model.rows).scatter, 1e-4 * model.rows.travel)))
        best = max(best, restarted, key=lambda mode: (not mode.missing, mode.log_density))
    return best


def _search(model: AxisModel, start: np.ndarray, bounded: bool = False) -> AxisMode:
    """The mode found by a search from coordinates (d,).

    A `bounded` search stays within `BOUND` of the priors' centres: a long step over a steep density ends far outside.
    """
    from scipy.optimize import minimize

    if not len(start):
        alone = float(model.log_density(start[None])[0])
        return AxisMode(start, np.zeros((0, 0)), alone, _missing(alone))
    # The expected widths of the coordinates.
    width, names = np.ones(len(start)), model.coordinates.names
    if "backlash" in names:
        width[names.index("backlash")] = min(max(reversal_of(model.rows).sd / model.priors["backlash"].u, 1e-9), 1.0)

    def value(v: np.ndarray) -> float:
        density = float(model.log_density((start + width * v)[None])[0])
        return -density if np.isfinite(density) else 1e30

    def slope(v: np.ndarray) -> np.ndarray:
        return -_gradients(model, (start + width * v)[None], width, STEP)[0]

    method, bounds = "BFGS", None
    if bounded:
        method, bounds = "L-BFGS-B", list(zip((-BOUND - start) / width, (BOUND - start) / width, strict=True))
    options = {"gtol": 1e-2, "maxiter": 200}
    best = minimize(value, np.zeros(len(start)), jac=slope, method=method, bounds=bounds, options=options)
    v = np.asarray(best.x)
    w = start + width * v
    shift = np.concatenate([np.diag(CURVATURE_STEP * width), np.diag(-CURVATURE_STEP * width)])
    slopes = _gradients(model, w + shift, width, CURVATURE_STEP)
    count = len(w)
    curvature = -(slopes[:count] - slopes[count:]) / (2 * CURVATURE_STEP)
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    inverse = vectors @ np.diag(1 / np.maximum(values, CURVATURE_MIN)) @ vectors.T
    log_density = float(model.log_density(w[None])[0])
    gradient = _gradients(model, w[None], width, STEP)[0]
    distance = float(np.sqrt(gradient @ inverse @ gradient))
    return AxisMode(w, width[:, None] * inverse * width, log_density, _missing(log_density, distance))

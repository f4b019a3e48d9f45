"""The posterior of an axis for samplers: density of its scales, its mode, draws of the analytically integrated line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tvsbayes.inference.density import Points
from tvsbayes.inference.students import StudentMixture
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AXIS_QUANTITIES
from tvsbayes.single_axis.axis_rows import reversal_of, scatter_within
from tvsbayes.single_axis.classic_line import fit_line
from tvsbayes.single_axis.waves import start_coordinate

LINES = sorted(
    (quantity for quantity in AXIS_QUANTITIES.values() if quantity.line),
    key=lambda quantity: (bool(quantity.parts), quantity.name != "offset"),
)
"""Quantities of the line in the order in which they are drawn; their functionals do not depend on the draw."""
HEADLINE_DRAWS = (*(quantity.name for quantity in LINES), "effective_per_command")
"""Rows of `headline_functionals`."""


def line_weights(model: AxisModel, w: np.ndarray, read: np.ndarray | None = None) -> np.ndarray:
    """Slope of the least-squares line of the error by position over commands `read`, by default those of the rows.

    Shape (columns,), or (n, columns) at draws w (n, d) where a period is not known.
    """
    command = model.rows.command if read is None else read
    deviations = command - command.mean()
    weights = deviations / (deviations @ deviations)
    if not model.repeats_by_draw:
        return weights @ model.functional(command)
    return np.concatenate([weights @ model.functional(command, part) for part in blocks_of(w)])


def blocks_of(w: np.ndarray) -> list[np.ndarray]:
    """Draws (n, d) in blocks small enough for functionals of many commands."""
    return np.array_split(w, max(1, len(w) // 100))


def headline_functionals(model: AxisModel, w: np.ndarray, read: np.ndarray | None = None) -> np.ndarray:
    """Functionals of the columns, shape (`HEADLINE_DRAWS`, columns), or (n, ...) as in `line_weights`."""
    weights = line_weights(model, w, read)
    functionals = np.concatenate([line_functionals(model), model.line_terms(per_command=1.0)[None]])
    if weights.ndim == 2:
        functionals = np.repeat(functionals[None], len(weights), axis=0)
    functionals[..., -1, :] += weights
    return functionals


def deviation_functionals(
    model: AxisModel, w: np.ndarray, commands: np.ndarray, read: np.ndarray | None = None
) -> np.ndarray:
    """Error that repeats by position at commands (t,), minus its least-squares line as in `line_weights`.

    Shape (t, columns); (n, t, columns) for draws w (n, d) where a period is unknown.
    """
    read = model.rows.command if read is None else read
    level, slope = model.functional(read, w).mean(axis=-2), line_weights(model, w, read)
    offsets = (commands - read.mean())[:, None]
    return model.functional(commands, w) - level[..., None, :] - offsets * slope[..., None, :]


def mean_play(model: AxisModel) -> np.ndarray:
    """Functional (columns,) of the mean of the play over the positions read."""
    functional = model.line_terms(backlash=1.0)
    functional[model.layout["play"]] = model.places.weights(model.rows.positions).mean(axis=0)
    return functional


def line_functionals(model: AxisModel) -> np.ndarray:
    """Functionals of all but the last of `HEADLINE_DRAWS`; the same for all draws."""
    return np.array([model.line_terms(**factors) for factors in line_factors(model).values()])


def line_factors(model: AxisModel) -> dict[str, Mapping[str, float]]:
    """Factors of `AxisModel.line_terms` by name of `LINES`."""
    return {each.name: each.line(model.middle) for each in LINES if each.line}


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
REPEAT_SHARE = 1e-4
"""Least scatter of stops at the start of a search, as a share of the travel."""


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

    def drawn(self, count: int, rng: np.random.Generator, method: Literal["svd", "cholesky"] = "svd") -> np.ndarray:
        """Draw coordinates (count, d) of the Laplace approximation."""
        if not len(self.w):
            return np.zeros((count, 0))
        return rng.multivariate_normal(self.w, self.covariance, count, method=method)


def find_mode(model: AxisModel, guess: Mapping[str, float] | None = None) -> AxisMode:
    """The mode by a quasi-Newton search from the least-squares line and the scatter of repeats.

    A failed search restarts with the scatter of rows about the line as that of stops: a single outlier is far outside
    the scatter of repeats, where the density is very steep.

    Args:
        model: the model.
        guess: start coordinates by name, from a model with fewer waves.
    """
    rows, names = model.rows, model.coordinates.names
    visits = np.unique([rows.command, rows.side], axis=1, return_inverse=True)[1].ravel()
    repeat_sd = 0.0 if rows.in_motion else scatter_within(rows.value, visits)
    start = _start(model, max(repeat_sd, REPEAT_SHARE * rows.travel))
    best = _search(model, np.array([(guess or {}).get(name, w) for name, w in zip(names, start, strict=True)]))
    if best.missing and len(best.w):
        bounded = _search(model, start, bounded=True)
        if not bounded.missing:
            return bounded
        restarted = _search(model, _start(model, max(fit_line(rows).scatter, REPEAT_SHARE * rows.travel)))
        best = max(best, restarted, key=lambda mode: (not mode.missing, mode.log_density))
    return best


def _start(model: AxisModel, stop_sd: float) -> np.ndarray:
    """Start coordinates (d,) for stops with scatter `stop_sd`."""
    coordinates = model.coordinates
    w = np.zeros(len(coordinates.names))
    for k, name in enumerate(coordinates.names):
        if name == "backlash":
            w[k] = coordinates.coordinate(name, reversal_of(model.rows).value)
        elif name.startswith("wave_"):
            w[k] = start_coordinate(coordinates.waves[int(name.split(".")[1]) - 1], name)
        elif name.startswith("stop_sd"):
            w[k] = np.clip(coordinates.coordinate(name, stop_sd), -4.0, 4.0)
    return w


def _gradients(model: AxisModel, w: np.ndarray, width: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Log densities (n,), and their gradients (n, d) by the scaled coordinates, at coordinates (n, d)."""
    d = w.shape[1]
    shift = np.concatenate([np.zeros((1, d)), np.diag(step * width), np.diag(-step * width)])
    value = model.log_density((w[:, None] + shift).reshape(-1, d)).reshape(len(w), 1 + 2 * d)
    # Where the density is undefined, its slope is undefined too.
    with np.errstate(invalid="ignore"):
        slopes = (value[:, 1 : 1 + d] - value[:, 1 + d :]) / (2 * step)
    return value[:, 0], np.where(np.isfinite(slopes), slopes, 0.0)


def _missing(log_density: float, distance: float = 0.0) -> tuple[str, ...]:
    """Why a search failed, in sentences: an undefined density, or an end more than `SDS_MAX` sds from the mode."""
    if not np.isfinite(log_density):
        return ("the readings have no density under these priors",)
    if not distance <= SDS_MAX:
        return (f"the search for the mode ended {distance:.1f} standard deviations away from it, wanted {SDS_MAX:g}",)
    return ()


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

    def value_and_slope(v: np.ndarray) -> tuple[float, np.ndarray]:
        value, slopes = _gradients(model, (start + width * v)[None], width, STEP)
        return -float(value[0]) if np.isfinite(value[0]) else 1e30, -slopes[0]

    bounds = list(zip((-BOUND - start) / width, (BOUND - start) / width, strict=True)) if bounded else None
    method, options = "L-BFGS-B" if bounded else "BFGS", {"gtol": 1e-2, "maxiter": 200}
    best = minimize(value_and_slope, np.zeros(len(start)), jac=True, method=method, bounds=bounds, options=options)
    w = start + width * np.asarray(best.x)
    shift = np.concatenate([np.diag(CURVATURE_STEP * width), np.diag(-CURVATURE_STEP * width)])
    _, slopes = _gradients(model, w + shift, width, CURVATURE_STEP)
    curvature = -(slopes[: len(w)] - slopes[len(w) :]) / (2 * CURVATURE_STEP)
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    inverse = vectors @ np.diag(1 / np.maximum(values, CURVATURE_MIN)) @ vectors.T
    [log_density], [gradient] = _gradients(model, w[None], width, STEP)
    distance = float(np.sqrt(gradient @ inverse @ gradient))
    return AxisMode(w, width[:, None] * inverse * width, float(log_density), _missing(float(log_density), distance))


class AxisDensity:
    """A `Density`; the part `linear` (n, t) of its points is a draw of all but the last of `HEADLINE_DRAWS`."""

    headlines = tuple(name for name, quantity in AXIS_QUANTITIES.items() if quantity.headline)
    fixed: frozenset[str] = frozenset()
    walkers = 48

    def __init__(self, model: AxisModel, mode: AxisMode):
        self.model, self.mode, self.invalid = model, mode, 0
        self.functionals = line_functionals(model)

    @property
    def dimension(self) -> int:
        """Number of sampled scales."""
        return len(self.mode.w)

    @property
    def log_constant(self) -> float:
        """Log density at the mode, with the constant of the normal priors of the coordinates."""
        return self.mode.log_density - 0.5 * self.dimension * float(np.log(2 * np.pi))

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Log density of w (n, d), relative to the mode; -inf where it is undefined."""
        return self.model.log_density(w) - self.mode.log_density

    def valued(self, w: np.ndarray, generator: np.random.Generator) -> Points:
        """Points at w with their log density and draws of the line."""
        log_density, line = self.model.posterior(w, self.functionals)
        drawn = line.drawn(np.eye(len(self.functionals)), generator)
        return Points(w, log_density - self.mode.log_density, {"linear": drawn})

    def log_density(self, points: Points) -> np.ndarray:
        """Log density of the sampled coordinates."""
        return points.log_target + self.mode.log_density

    def quantities(self, points: Points) -> dict[str, np.ndarray]:
        """Draws of the sampled scales and of the linear quantities."""
        values, names = self.model.coordinates.values(points.w), self.model.coordinates.names
        linear = dict(zip(HEADLINE_DRAWS, points.parts["linear"].T, strict=False))
        # A sampled backlash is already part of the linear one.
        return {name: values[name] for name in names if name in values} | linear

    def first_proposal(self) -> StudentMixture:
        """A mixture about the mode."""
        return StudentMixture.about(self.mode.w, self.mode.covariance)

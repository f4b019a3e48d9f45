"""The posterior of an axis for samplers: density of its scales, with draws of the analytically integrated line."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tvsbayes.inference.density import Points
from tvsbayes.inference.students import StudentMixture
from tvsbayes.single_axis.axis_mode import AxisMode
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AXIS_QUANTITIES

LINES = sorted(
    (quantity for quantity in AXIS_QUANTITIES.values() if quantity.line),
    key=lambda quantity: (bool(quantity.parts), quantity.name != "offset"),
)
"""Quantities of the line in the order in which they are drawn; their functionals do not depend on the draw."""
HEADLINE_DRAWS = (*(quantity.name for quantity in LINES), "effective_per_command")
"""Rows of `headline_functionals`."""


def line_weights(model: AxisModel, w: np.ndarray) -> np.ndarray:
    """Slope of the least-squares line of the error by position over the rows, with equal weights.

    Shape (columns,), or (n, columns) at draws w (n, d) where a period is not known.
    """
    rows = model.rows
    deviations = rows.command - rows.command.mean()
    weights = deviations / (deviations @ deviations)
    if not model.repeats_by_draw:
        return weights @ model.functional(rows.command)
    return np.concatenate([weights @ model.functional(rows.command, part) for part in blocks_of(w)])


def blocks_of(w: np.ndarray) -> list[np.ndarray]:
    """Draws (n, d) in blocks small enough for functionals of many commands."""
    return np.array_split(w, max(1, len(w) // 100))


def headline_functionals(model: AxisModel, w: np.ndarray) -> np.ndarray:
    """Functionals of the columns, shape (`HEADLINE_DRAWS`, columns), or (n, ...) as in `line_weights`."""
    lines, weights = line_functionals(model), line_weights(model, w)
    functionals = np.concatenate([lines, model.line_terms(per_command=1.0)[None]])
    if weights.ndim == 2:
        functionals = np.repeat(functionals[None], len(weights), axis=0)
    functionals[..., -1, :] += weights
    return functionals


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
    return {each.name: each.line(model.middle, model.rows.travel) for each in LINES if each.line}


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
        likelihood = self.model.posterior(w, self.functionals)
        linear = likelihood.linear.drawn(np.eye(len(self.functionals)), generator)
        return Points(w, likelihood.log_density - self.mode.log_density, {"linear": linear})

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

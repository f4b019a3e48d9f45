"""The posterior of a fit for samplers: the compiled density in the map's coordinates, with all quantities.

Coordinates w of `posterior.transport`; log densities are exact and include the map's Jacobian.
"""

from __future__ import annotations

import time
from functools import cached_property

import jax
import numpy as np

from tvsbayes.estimators.campaign_arrays import spot_constants
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import evaluate, no_draw
from tvsbayes.inference.density import Points
from tvsbayes.inference.importance import ROUNDS_MAX, Pool, Sample, weighted_run
from tvsbayes.inference.proposal import Independence, first_proposal
from tvsbayes.model.compiled import BATCH
from tvsbayes.posterior.draws import Draws, Posterior, derived_of, headline_names
from tvsbayes.posterior.transport import Mapped, Transport, transport
from tvsbayes.progress import Advance, unshown

MAPPED_SHARE = 0.25
"""Share of the time of importance sampling for the map, for the progress display."""
WALKERS = 64
"""Least number of walkers in an ensemble: a whole `BATCH` in each half."""


def walkers_for(dimension: int) -> int:
    """Choose the ensemble size: at least half as many walkers as dimensions, whole batches and groups in each half."""
    return max(WALKERS, 2 * BATCH * -(-dimension // (4 * BATCH)))


class Target:
    """A `Density` on NumPy arrays; NaN become -inf and are counted.

    The parts of its points are `z` (n, p) and `log_jacobian` (n,) of the map, and `place_errors_rad` (n, e), draws of
    the errors at places.
    """

    def __init__(self, fit: JointFit, path: Transport):
        self.fit, self.path = fit, path
        self.invalid = 0

    @property
    def dimension(self) -> int:
        """Return the number of sampled coordinates."""
        return self.path.dimension

    @property
    def walkers(self) -> int:
        """Return the number of walkers in an ensemble."""
        return walkers_for(self.dimension)

    @cached_property
    def headlines(self) -> tuple[str, ...]:
        """Return the names of the headlines."""
        return headline_names(self.fit)

    @cached_property
    def fixed(self) -> frozenset[str]:
        """Return the names of parameters fixed by their priors."""
        return frozenset(self.fit.names[i] for i in np.flatnonzero(~self.fit.free))

    @cached_property
    def log_constant(self) -> float:
        """Compute the constant of the evidence over the free parameters, `spot_constants` included.

        |det root| converts the integral over w to the coordinates z, whose normal priors have no constants in
        `likelihood.evaluate`.
        """
        fit = self.fit
        constants = float(spot_constants(fit.campaign)[fit.arrays.used].sum())
        constants -= 0.5 * self.dimension * np.log(2 * np.pi)
        # Fixed parameters have no prior to integrate over.
        held = 0.5 * float(np.sum(fit.z[~fit.free] ** 2))
        volume = float(np.sum(np.log(np.diag(self.path.root))))
        return float(volume + fit.log_density + constants + held)

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Compute the log density of w (n, d), relative to that of z at the mode; -inf where the model has no value."""
        return self.at(w, self.path.mapped(w), no_draw(len(w), self.fit.arrays)).log_target

    def valued(self, w: np.ndarray, generator: np.random.Generator) -> Points:
        """Compute the same, with draws of the errors at places."""
        return self.at(w, self.path.mapped(w), self.place_normals(len(w), generator))

    def place_normals(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Draw the normal numbers from which `evaluate` draws the errors at places."""
        return generator.standard_normal((count, 2 * self.fit.arrays.gears.filled))

    def at(self, w: np.ndarray, mapped: Mapped, normal: np.ndarray) -> Points:
        """Evaluate mapped points, with draws of the errors from standard normal numbers (n, e)."""
        evaluated = evaluate(mapped.z, normal, self.fit.space, self.fit.arrays)
        value, errors_rad = evaluated.log_density, evaluated.place_errors_rad
        invalid = np.isnan(value)
        self.invalid += int(invalid.sum())
        log_target = np.where(invalid, -np.inf, value - self.fit.log_density + mapped.log_jacobian)
        parts = {"z": mapped.z, "log_jacobian": mapped.log_jacobian, "place_errors_rad": errors_rad}
        return Points(w, log_target, parts)

    def log_density(self, points: Points) -> np.ndarray:
        """Return the log density in z, shape (n,)."""
        return points.log_target + self.fit.log_density - points.parts["log_jacobian"]

    def quantities(self, points: Points) -> Draws:
        """Compute parameters and headlines."""
        derived = derived_of(self.fit, points.parts["z"][None], points.parts["place_errors_rad"][None])
        return Draws(derived, self.fit.space.mechanism)

    def first_proposal(self) -> Independence:
        """Build a proposal that is standard normal except in heavy and coupled coordinates."""
        return first_proposal(self, self.dimension, self.path.heavy, self.path.coupled)

    def posterior(self, sample: Sample, seed: int) -> Posterior:
        """Build the posterior from a sample; `seed` is that of all random numbers."""
        shape = sample.weights.shape
        z, density = sample.points.parts["z"].reshape(*shape, -1), self.log_density(sample.points).reshape(shape)
        assert isinstance(sample.quantities, Draws)
        draws = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[2:]), sample.quantities.derived)
        return Posterior(self.fit, z, density, draws, sample.weights, sample.convergence, seed, sample.seconds)


def importance_run(fit: JointFit, seed: int, advance: Advance = unshown, rounds_max: int = ROUNDS_MAX) -> Pool[Target]:
    """Run `weighted_run` for a converged fit, by its map."""
    began, path = time.monotonic(), transport(fit)
    advance(MAPPED_SHARE)
    rest = 1 - MAPPED_SHARE
    return weighted_run(
        Target(fit, path), seed, lambda share: advance(MAPPED_SHARE + rest * share), rounds_max, began=began
    )

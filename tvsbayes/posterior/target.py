"""The posterior of a fit as samplers call it: the density in the map's coordinates, compiled, with all quantities.

Coordinates w of `posterior.transport`; log densities are exact, the map's Jacobian in them.
"""

from __future__ import annotations

from functools import cached_property

import jax
import numpy as np

from tvsbayes.estimators.campaign_arrays import spot_constants
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import evaluate, no_draw
from tvsbayes.inference.density import Points
from tvsbayes.inference.importance import Sample
from tvsbayes.inference.proposal import Independence, first_proposal
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.model.compiled import BATCH
from tvsbayes.posterior.draws import Draws, Posterior, derived_of, headline_names
from tvsbayes.posterior.transport import Mapped, Transport

WALKERS = 64


def walkers_for(dimension: int) -> int:
    """Ensemble size: at least half as many walkers as dimensions, whole batches and whole groups in each half."""
    return max(WALKERS, 2 * BATCH * -(-dimension // (4 * BATCH)))


class Target:
    """A `Density`: NumPy in, NumPy out, NaN refused and counted.

    Parts of its points: `z` (n, p) and `log_jacobian` (n,) where w is mapped to, `place_errors_rad` (n, e) a draw of
    the errors at places.
    """

    def __init__(self, fit: JointFit, path: Transport):
        self.fit, self.path = fit, path
        self.invalid = 0

    @property
    def dimension(self) -> int:
        """Number of sampled coordinates."""
        return self.path.dimension

    @property
    def walkers(self) -> int:
        """In an ensemble."""
        return walkers_for(self.dimension)

    @cached_property
    def headlines(self) -> tuple[str, ...]:
        """What a fit is for."""
        return headline_names(self.fit)

    @cached_property
    def fixed(self) -> frozenset[str]:
        """Parameters that priors hold."""
        return frozenset(self.fit.names[i] for i in np.flatnonzero(~self.fit.free))

    @cached_property
    def log_constant(self) -> float:
        """Of the evidence over the free parameters: likelihoods have the constants of `spot_constants`.

        |det root| takes the integral over w to the coordinates z, whose normal priors `likelihood.log_density` has
        without their constants.
        """
        fit = self.fit
        used = np.asarray(fit.arrays.spots.valid)[: len(ordered_spots(fit.campaign))] > 0
        constants = float(spot_constants(fit.campaign)[used].sum()) - 0.5 * self.dimension * np.log(2 * np.pi)
        # What is held fixed has no prior to be integrated over.
        held = 0.5 * float(np.sum(fit.z[~fit.free] ** 2))
        volume = float(np.sum(np.log(np.diag(self.path.root))))
        return float(volume + fit.log_density + constants + held)

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Log density of w (n, d), relative to z's at the mode; -inf where the model has no value."""
        return self.at(w, self.path.mapped(w), no_draw(len(w), self.fit.arrays)).log_target

    def valued(self, w: np.ndarray, generator: np.random.Generator) -> Points:
        """The same, with draws of the errors at places."""
        return self.at(w, self.path.mapped(w), self.place_normals(len(w), generator))

    def place_normals(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """What `evaluate` makes draws of the errors at places from."""
        return generator.standard_normal((count, 2 * self.fit.arrays.gears.filled))

    def at(self, w: np.ndarray, mapped: Mapped, normal: np.ndarray) -> Points:
        """Of points that are mapped already, with draws of the errors from standard normal numbers (n, e)."""
        evaluated = evaluate(mapped.z, normal, self.fit.space, self.fit.arrays)
        value, errors_rad = evaluated.log_density, evaluated.place_errors_rad
        invalid = np.isnan(value)
        self.invalid += int(invalid.sum())
        log_target = np.where(invalid, -np.inf, value - self.fit.log_density + mapped.log_jacobian)
        parts = {"z": mapped.z, "log_jacobian": mapped.log_jacobian, "place_errors_rad": errors_rad}
        return Points(w, log_target, parts)

    def log_density(self, points: Points) -> np.ndarray:
        """In z, shape (n,)."""
        return points.log_target + self.fit.log_density - points.parts["log_jacobian"]

    def quantities(self, points: Points) -> Draws:
        """Parameters and headlines."""
        derived = derived_of(self.fit, points.parts["z"][None], points.parts["place_errors_rad"][None])
        return Draws(derived, self.fit.space.mechanism)

    def first_proposal(self) -> Independence:
        """Standard normal but for heavy and coupled coordinates."""
        return first_proposal(self, self.dimension, self.path.heavy, self.path.coupled)

    def posterior(self, sample: Sample, seed: int) -> Posterior:
        """What was sampled, by the names of the contract; `seed` of everything random."""
        shape = sample.weights.shape
        z, density = sample.points.parts["z"].reshape(*shape, -1), self.log_density(sample.points).reshape(shape)
        assert isinstance(sample.quantities, Draws)
        draws = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[2:]), sample.quantities.derived)
        return Posterior(self.fit, z, density, draws, sample.weights, sample.convergence, seed, sample.seconds)

"""Draws of the posterior, propagated into any quantity with their Monte Carlo error.

One row for each draw, parameters and headlines in the units of their names. Draws of importance sampling have weights,
those of a chain equal weights; chains are walkers of the ensemble.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import jax
import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import no_draw
from tvsbayes.inference.summaries import NamedDraws, Propagated, propagated
from tvsbayes.instrument.axes import DIRECTION_SIGNS, DIRECTIONS
from tvsbayes.instrument.mechanisms import Mechanism
from tvsbayes.instrument.parameters import HEADLINES
from tvsbayes.instrument.stops import legs_of
from tvsbayes.model.compiled import in_batches
from tvsbayes.model.headlines import DERIVED, Derived, derived_quantities
from tvsbayes.results.convergence import Convergence, Reweighted
from tvsbayes.results.records import Tier
from tvsbayes.results.tiers import IMPORTANCE
from tvsbayes.statistics.streams import Stream, random_stream
from tvsbayes.statistics.weighted_draws import systematic, weighted_mean

DERIVED_BATCH = 2049
"""Batch size, that of the fit for its headlines, so that the compilation is shared."""


def derived_names(mechanism: Mechanism) -> tuple[str, ...]:
    """Return the names of derived quantities of a mechanism."""
    return tuple(name for name in DERIVED if name not in mechanism.absent)


class Draws(Mapping[str, np.ndarray]):
    """Posterior draws by name: every parameter, and the derived quantities `DERIVED`, each of shape (n,)."""

    def __init__(self, draws: Derived, mechanism: Mechanism):
        self.derived = draws
        self.names = (*mechanism.names, *derived_names(mechanism))

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the draws of one quantity."""
        if name not in self.names:
            raise KeyError(f"no quantity {name!r}; there are: {', '.join(self.names)}")
        return self.derived[name].ravel()

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self.names)

    def __len__(self) -> int:
        """Return the number of quantities."""
        return len(self.names)


def headline_names(fit: JointFit) -> tuple[str, ...]:
    """Return the names of the headlines in `Draws` that the campaign moved and priors do not fix."""
    moved, derived = set(legs_of(fit.campaign.moves)), derived_names(fit.space.mechanism)
    index = fit.space.mechanism.index
    names = [quantity.name for quantity in HEADLINES if quantity.applies(moved)]
    return tuple(name for name in names if (fit.free[index[name]] if name in index else name in derived))


@dataclass(frozen=True, repr=False)
class Posterior(NamedDraws, Shown):
    """A sampled posterior; check `converged` before using it.

    Attributes:
        fit: the fit whose posterior it is.
        z: draws of the prior-normal coordinates, shape (chain, draw, p); one chain for importance sampling.
        log_density: their log posterior density, without `campaign_arrays.spot_constants`, shape (chain, draw).
        draws: parameters and headlines in the units of data/docs/conventions.md, fields with leading axes (chain,
            draw).
        weights: weights of the draws, sum 1, shape (chain, draw).
        convergence: the diagnosis.
        seed: seed of all random numbers.
        seconds: time spent sampling, earlier runs of a resumed chain included.
        way: index in `JointFit.mixture` of each draw's homing hypothesis, shape (chain, draw); None where all draws are
            of `fit`.
    """

    fit: JointFit
    z: np.ndarray
    log_density: np.ndarray
    draws: Derived
    weights: np.ndarray
    convergence: Convergence | Reweighted
    seed: int
    seconds: float
    way: np.ndarray | None = None

    def shown(self) -> View:
        """Show means, sds and 95 % intervals of the headlines."""
        state = "converged" if self.converged else "NOT CONVERGED"
        title = f"Posterior by {self.tier}, {self.weights.size} draws, {state}"
        return self.view_of(title, headline_names(self.fit))

    @property
    def converged(self) -> bool:
        """Whether there is a sampled answer, accepted or rough (formulation 4.3)."""
        return self.convergence.converged

    @property
    def tier(self) -> Tier:
        """Return the tier of the draws: weighted independent draws, or equally weighted ones of a chain."""
        return self.convergence.tier

    @property
    def by_name(self) -> Draws:  # type: ignore[override]
        """Return all draws by public name, chains joined; their weights are `weights.ravel()`."""
        return Draws(self.draws, self.fit.space.mechanism)

    @property
    def joined(self) -> Derived:
        """Return all draws, chains joined: every field of `draws` with one leading axis."""
        return jax.tree.map(lambda x: x.reshape(self.weights.size, *x.shape[2:]), self.draws)

    @property
    def joined_z(self) -> np.ndarray:
        """Return the coordinates z of all draws, chains joined, shape (n, p)."""
        return self.z.reshape(self.weights.size, -1)

    @property
    def centre(self) -> Derived:
        """Compute the means of all fields of `draws`."""
        return jax.tree.map(lambda x: weighted_mean(np.asarray(x), self.weights.ravel()), self.joined)

    def chosen(self, count: int) -> np.ndarray:
        """Choose indices of at most `count` draws of equal weight, chains joined; evenly spaced in a chain."""
        offset = random_stream(self.seed, Stream.EQUAL_DRAWS).uniform()
        return systematic(self.weights.ravel(), min(count, self.weights.size), float(offset))

    def thinned(self, count: int) -> Derived:
        """Return the `chosen` draws: every field with one leading axis."""
        places = self.chosen(count)
        return jax.tree.map(lambda x: x[places], self.joined)

    def coordinates(self, count: int) -> np.ndarray:
        """Return the coordinates z of the `chosen` draws, shape (count, p)."""
        return self.joined_z[self.chosen(count)]

    def resampled(self, chains: int, draws: int) -> Posterior:
        """Resample to draws of equal weight, in chains; a draw of large weight is repeated."""
        return self.taken(self.equal_places(chains * draws).reshape(chains, draws))

    def equal_places(self, count: int) -> np.ndarray:
        """Choose indices of `count` draws of equal weight, in random order; a draw of large weight is repeated."""
        # Without the permutation the repeats of a draw would be in one chain.
        order = random_stream(self.seed, Stream.ORDER_OF_DRAWS)
        return order.permutation(systematic(self.weights.ravel(), count, 0.5))

    def taken(self, places: np.ndarray) -> Posterior:
        """Return the draws with indices (chain, draw), of equal weight."""
        return replace(
            self,
            z=self.joined_z[places],
            log_density=self.log_density.ravel()[places],
            draws=jax.tree.map(lambda x: x[places], self.joined),
            weights=np.full(places.shape, 1 / places.size),
            way=None if self.way is None else self.way.ravel()[places],
        )

    def summarised(self, values: np.ndarray) -> Propagated:
        """Compute mean, sd, interval and errors of values (chain, draw, ...), one for every draw."""
        return super().summarised(values) if self.tier == IMPORTANCE else propagated(values)

    def local_deg_per_step(self, pan_deg: float, tilt_deg: float) -> Propagated:
        """Compute gear ratio times mirror slope (left, right, up, down) at any pose (formulation 3.2)."""
        return self.summarised(local_at(self.fit, self.z, np.radians([pan_deg, tilt_deg])).local_deg_per_step)

    def lost_motion_deg(self, direction: str, steps: np.ndarray) -> Propagated:
        """Compute the mirror angle lost by a move after a reversal: min(k N, b) (play operator, formulation 3.1).

        Args:
            direction: left, right, up or down.
            steps: numbers of steps N >= 0, shape (n,).

        Returns:
            Fields of shape (n,), deg; divided by N, the deficit of a four-point estimate.
        """
        if direction not in DIRECTIONS:
            raise ValueError(f"direction {direction!r}; allowed: {', '.join(DIRECTIONS)}")
        axis, _ = DIRECTION_SIGNS[direction]
        count = np.atleast_1d(np.asarray(steps, dtype=float))
        return self.propagate(
            lambda p: np.minimum(
                np.multiply.outer(p[f"degrees_per_step.{direction}"], count), p[f"backlash_deg.{axis}"][:, None]
            )
        )


def derived_of(
    fit: JointFit, z: np.ndarray, place_errors_rad: np.ndarray, pose_rad: np.ndarray | None = None
) -> Derived:
    """Compute quantities of draws (..., p) with errors at places (..., e), by default at the fit's pose."""
    line = fit.seen_line if pose_rad is None else replace(fit.seen_line, pose_rad=pose_rad)
    points = z.reshape(-1, z.shape[-1])
    # Gears without repeating errors have no places, for which -1 would not work.
    given = points, place_errors_rad.reshape(len(points), place_errors_rad.shape[-1])
    flat = in_batches(lambda z, errors: derived_quantities(z, errors, fit.space, line), *given, size=DERIVED_BATCH)
    return jax.tree.map(lambda x: x.reshape(*z.shape[:-1], *x.shape[1:]), flat)


def local_at(fit: JointFit, z: np.ndarray, pose_rad: np.ndarray) -> Derived:
    """Compute parameters and local headlines of draws (..., p) at a pose (pan, tilt), without repeating errors."""
    none = np.asarray(no_draw(z[..., 0].size, fit.arrays))
    return derived_of(fit, z, none.reshape(*z.shape[:-1], -1), pose_rad)

"""Draws of the posterior, carried into any quantity with their Monte Carlo error.

One row a draw, parameters and headlines in the units of their names. Draws of importance sampling have weights, those
of a chain weigh the same; chains are walkers of the ensemble.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import jax
import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import no_draw
from tvsbayes.inference.summaries import Propagated, carried, propagated, reweighted
from tvsbayes.instrument.axes import DIRECTION_SIGNS, DIRECTIONS
from tvsbayes.instrument.mechanisms import TWO_MIRROR, Mechanism
from tvsbayes.instrument.parameters import HEADLINES, INDEX
from tvsbayes.instrument.stops import legs_of
from tvsbayes.model.compiled import in_batches
from tvsbayes.model.headlines import DERIVED, Derived, derived_quantities
from tvsbayes.results.convergence import Convergence, Reweighted
from tvsbayes.results.records import Tier
from tvsbayes.results.tiers import IMPORTANCE
from tvsbayes.statistics.streams import Stream, random_stream
from tvsbayes.statistics.weighted_draws import systematic, weighted_mean

if TYPE_CHECKING:
    import pandas as pd

DERIVED_BATCH = 2049
"""The batch in which the fit computes its headlines: the compilation is shared."""


def derived_names(mechanism: Mechanism) -> tuple[str, ...]:
    """Of what follows from parameters, in a mechanism: a head has no mirrors to be off the pan axis."""
    return tuple(name for name in DERIVED if not mechanism.terms or name != "effective_mirror_offset_mm")


class Draws(Mapping[str, np.ndarray]):
    """Posterior draws by name: every parameter, and the derived quantities `DERIVED`, each of shape (n,)."""

    def __init__(self, draws: Derived, mechanism: Mechanism = TWO_MIRROR):
        self.derived = draws
        documented = (name for name in mechanism.names if name in mechanism.documented)
        self.names = (*documented, *derived_names(mechanism))

    def __getitem__(self, name: str) -> np.ndarray:
        """Draws of one quantity."""
        if name not in self.names:
            raise KeyError(f"no quantity {name!r}; there are: {', '.join(self.names)}")
        return self.derived[name].ravel()

    def __iter__(self) -> Iterator[str]:
        """Names."""
        return iter(self.names)

    def __len__(self) -> int:
        """Number of quantities."""
        return len(self.names)


def headline_names(fit: JointFit) -> tuple[str, ...]:
    """Names in `Draws` of what a fit is for, as far as the campaign moved and priors leave it open."""
    moved, derived = set(legs_of(fit.campaign.moves)), derived_names(fit.space.mechanism)
    names = [quantity.name for quantity in HEADLINES if quantity.applies(moved)]
    return tuple(name for name in names if (fit.free[INDEX[name]] if name in INDEX else name in derived))


@dataclass(frozen=True, repr=False)
class Posterior(Shown):
    """A sampled posterior; look at `converged` before using it.

    Attributes:
        fit: the fit whose posterior it is.
        z: draws of the prior-normal coordinates, shape (chain, draw, p); of importance sampling all are one chain.
        log_density: their log posterior density, without `campaign_arrays.spot_constants`, shape (chain, draw).
        draws: parameters and headlines in the units of data/docs/conventions.md, fields with leading axes (chain,
            draw).
        weights: of the draws, sum 1, shape (chain, draw).
        convergence: the diagnosis.
        seed: of everything random.
        seconds: spent sampling, earlier runs of a resumed chain included.
        way: place in `JointFit.mixture` of the way of homing that each draw came from, shape (chain, draw); None where
            all came from `fit`.
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
        """Means, sds and 95 % intervals of what a fit is for."""
        state = "converged" if self.converged else "NOT CONVERGED"
        title = f"Posterior by {self.tier}, {self.weights.size} draws, {state}"
        names = headline_names(self.fit)
        values = self.propagate(lambda p: np.stack([p[name] for name in names], axis=1))
        columns = (each.tolist() for each in (values.mean, values.sd, *values.interval95))
        rows = list(zip(names, *columns, strict=True))
        return View(title, ("quantity", "mean", "sd", "2.5 %", "97.5 %"), rows)

    def to_dataframe(self) -> pd.DataFrame:
        """All draws by name, one row each, with their `weight` (sum 1)."""
        import pandas as pd

        return pd.DataFrame({**self.by_name, "weight": self.weights.ravel()})

    @property
    def converged(self) -> bool:
        """There is a sampled answer, accepted or rough (formulation 4.3)."""
        return self.convergence.converged

    @property
    def tier(self) -> Tier:
        """What made the draws: weighted independent draws, or the equal ones of a chain."""
        return self.convergence.tier

    @property
    def by_name(self) -> Draws:
        """All draws by contract name, chains joined; their weights are `weights.ravel()`."""
        return Draws(self.draws, self.fit.space.mechanism)

    @property
    def joined(self) -> Derived:
        """All draws, chains joined: every field of `draws` with one leading axis."""
        return jax.tree.map(lambda x: x.reshape(self.weights.size, *x.shape[2:]), self.draws)

    @property
    def centre(self) -> Derived:
        """Means of all fields of `draws`."""
        return jax.tree.map(lambda x: weighted_mean(np.asarray(x), self.weights.ravel()), self.joined)

    def chosen(self, count: int) -> np.ndarray:
        """Places of at most `count` draws that weigh the same, chains joined; evenly spaced in a chain."""
        offset = random_stream(self.seed, Stream.EQUAL_DRAWS).uniform()
        return systematic(self.weights.ravel(), min(count, self.weights.size), float(offset))

    def thinned(self, count: int) -> Derived:
        """The draws at `chosen` places: every field with one leading axis."""
        places = self.chosen(count)
        return jax.tree.map(lambda x: x[places], self.joined)

    def coordinates(self, count: int) -> np.ndarray:
        """The coordinates z of the draws at `chosen` places, shape (count, p)."""
        return self.z.reshape(-1, self.z.shape[-1])[self.chosen(count)]

    def resampled(self, chains: int, draws: int) -> Posterior:
        """Draws that weigh the same, in chains; a draw of much weight is repeated."""
        places = systematic(self.weights.ravel(), chains * draws, 0.5)
        # In order, the repeats of a draw would stand in one chain.
        places = random_stream(self.seed, Stream.ORDER_OF_DRAWS).permutation(places).reshape(chains, draws)
        return replace(
            self,
            z=self.z.reshape(-1, self.z.shape[-1])[places],
            log_density=self.log_density.ravel()[places],
            draws=jax.tree.map(lambda x: x[places], self.joined),
            weights=np.full((chains, draws), 1 / (chains * draws)),
            way=None if self.way is None else self.way.ravel()[places],
        )

    def summarised(self, values: np.ndarray) -> Propagated:
        """Mean, sd, interval and errors of values (chain, draw, ...), one for every draw."""
        return reweighted(values, self.weights) if self.tier == IMPORTANCE else propagated(values)

    def propagate(self, function: Callable[[Mapping[str, np.ndarray]], np.ndarray]) -> Propagated:
        """Carry the posterior into a quantity of your own.

        Args:
            function: is called once with all draws, a mapping from name to an array (n,) in the unit that the name
                says, and returns one value per draw: an array (n,) or (n, ...). For instance what 200 steps to the
                left turn after a reversal, deg: `lambda p: 200 * p["degrees_per_step.left"] - p["backlash_deg.pan"]`.
                The names are those of `fit.json` and of `list(posterior.by_name)`.

        Returns:
            Mean, sd, interval and their Monte Carlo errors (JCGM 101 clause 7, with weighted or correlated draws), each
            of the shape (...) of one value.

        Raises:
            ValueError: the function returned another number of rows, or values that are not finite.
        """
        chains, draws = self.z.shape[:2]
        values = carried(function, self.by_name, chains * draws)
        return self.summarised(values.reshape(chains, draws, *values.shape[1:]))

    def local_deg_per_step(self, pan_deg: float, tilt_deg: float) -> Propagated:
        """Gear ratio times the slope of the mirrors (left, right, up, down) at any pose (formulation 3.2)."""
        return self.summarised(local_at(self.fit, self.z, np.radians([pan_deg, tilt_deg])).local_deg_per_step)

    def lost_motion_deg(self, direction: str, steps: np.ndarray) -> Propagated:
        """Mirror angle that a move of `steps` loses after a reversal: min(k N, b) (play operator, formulation 3.1).

        Args:
            direction: left, right, up or down.
            steps: numbers of steps N >= 0, shape (n,).

        Returns:
            Fields of shape (n,), deg; divided by N it is what a four-point estimate is short by.
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
    """Parameters and headlines of draws (..., p) with their errors at places (..., e), by default at the fit's pose."""
    line = fit.seen_line if pose_rad is None else replace(fit.seen_line, pose_rad=pose_rad)
    points = z.reshape(-1, z.shape[-1])
    # Gears that repeat nothing have no places, and -1 divides by none.
    given = points, place_errors_rad.reshape(len(points), place_errors_rad.shape[-1])
    flat = in_batches(lambda z, errors: derived_quantities(z, errors, fit.space, line), *given, size=DERIVED_BATCH)
    return jax.tree.map(lambda x: x.reshape(*z.shape[:-1], *x.shape[1:]), flat)


def local_at(fit: JointFit, z: np.ndarray, pose_rad: np.ndarray) -> Derived:
    """Parameters and local headlines of draws (..., p) at a pose (pan, tilt), of gears that repeat no error."""
    none = np.asarray(no_draw(z[..., 0].size, fit.arrays))
    return derived_of(fit, z, none.reshape(*z.shape[:-1], -1), pose_rad)

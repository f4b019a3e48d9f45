"""Interface of an instrument to inference: a log density in few coordinates, and draws of quantities integrated out.

Coordinates w (n, d) hold many points at once; arrays are NumPy's.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Points:
    """Points with their log densities.

    Attributes:
        w: coordinates, shape (n, d).
        log_target: log density there, -inf where it has no value, shape (n,).
        parts: further arrays of the density for every point, by name, shapes (n, ...): mapped coordinates, draws of
            quantities integrated out.
    """

    w: np.ndarray
    log_target: np.ndarray
    parts: dict[str, np.ndarray]

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.w)

    def taken(self, places: np.ndarray | slice) -> Points:
        """Return the points at these indices."""
        return Points(
            self.w[places], self.log_target[places], {name: part[places] for name, part in self.parts.items()}
        )

    @classmethod
    def joined(cls, several: Iterable[Points]) -> Points:
        """Concatenate sets of points, skipping empty ones, which have no parts."""
        each = [points for points in several if len(points)]
        return cls(
            np.concatenate([points.w for points in each]),
            np.concatenate([points.log_target for points in each]),
            {name: np.concatenate([points.parts[name] for points in each]) for name in each[0].parts},
        )


NO_POINTS = Points(np.zeros((0, 0)), np.zeros(0), {})


class Density(Protocol):
    """A posterior as samplers use it.

    Attributes:
        dimension: d.
        headlines: names of the quantities by which a sample is judged.
        fixed: quantities that are constant except for rounding.
        walkers: number of walkers in an ensemble.
        log_constant: log model evidence less the log of the integral of exp(log density).
        invalid: number of evaluations so far without a value.
    """

    @property
    def dimension(self) -> int: ...  # noqa: D102
    @property
    def headlines(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def fixed(self) -> frozenset[str]: ...  # noqa: D102
    @property
    def walkers(self) -> int: ...  # noqa: D102
    @property
    def log_constant(self) -> float: ...  # noqa: D102
    @property
    def invalid(self) -> int: ...  # noqa: D102

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Compute the log density of w (n, d) up to a constant, -inf where it has no value."""
        ...

    def valued(self, w: np.ndarray, generator: np.random.Generator) -> Points:
        """Compute the same, with draws of the quantities integrated out."""
        ...

    def log_density(self, points: Points) -> np.ndarray:
        """Return the log density in the reported coordinates, shape (n,)."""
        ...

    def quantities(self, points: Points) -> Mapping[str, np.ndarray]:
        """Compute all reported quantities by name, shapes (n,)."""
        ...

    def first_proposal(self) -> Proposal:
        """Return the proposal to use before any draw exists."""
        ...


class Proposal(ABC):
    """A proposal density, which can be fitted to its draws; drawing from it is a `Step` of a chain."""

    @abstractmethod
    def draw(self, count: int, generator: np.random.RandomState) -> np.ndarray:
        """Draw independent points, shape (count, d)."""

    @abstractmethod
    def log_density(self, w: np.ndarray) -> np.ndarray:
        """Compute the log density, shape (n,)."""

    @abstractmethod
    def fitted(self, w: np.ndarray, log_target: np.ndarray, log_weights: np.ndarray) -> Proposal:
        """Return a proposal fitted to weighted draws of the target.

        Args:
            w: draws, shape (n, d).
            log_target: their log densities, shape (n,).
            log_weights: log (target / their proposal), shape (n,).
        """

    @property
    @abstractmethod
    def steps(self) -> tuple[tuple[Step, float], ...]:
        """Return Metropolis-Hastings steps of a chain with their shares, which sum to at most 1."""

    def __call__(self, w: np.ndarray, generator: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """Propose independent points, as a `Step`."""
        proposed = self.draw(len(w), generator)
        return proposed, self.log_density(w) - self.log_density(proposed)


class Step(Protocol):
    """A Metropolis-Hastings step of a chain."""

    def __call__(self, w: np.ndarray, generator: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """Propose new points for w (n, d), with ln q(old | new) - ln q(new | old)."""
        ...


def columns_of(density: Density, points: Points) -> dict[str, np.ndarray]:
    """Return draws of every quantity that varies, and `log_density`."""
    every = {**density.quantities(points), "log_density": density.log_density(points)}
    return {name: column for name, column in every.items() if name not in density.fixed and np.ptp(column) > 0}

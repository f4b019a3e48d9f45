"""What inference needs of an instrument: a log density in few coordinates, and draws of what was integrated out.

Coordinates w (n, d) of many points at once; arrays are NumPy's, whatever computes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Points:
    """Points with what a density says of them.

    Attributes:
        w: coordinates, shape (n, d).
        log_target: log density there, -inf where it has no value, shape (n,).
        parts: what else the density keeps of every point, by name, shapes (n, ...): what it was mapped to, a draw of
            what was integrated out.
    """

    w: np.ndarray
    log_target: np.ndarray
    parts: dict[str, np.ndarray]

    def __len__(self) -> int:
        """Number of points."""
        return len(self.w)

    def taken(self, places: np.ndarray | slice) -> Points:
        """Those at places."""
        return Points(
            self.w[places], self.log_target[places], {name: part[places] for name, part in self.parts.items()}
        )

    @classmethod
    def joined(cls, several: Iterable[Points]) -> Points:
        """One after the other; the empty ones have no parts."""
        each = [points for points in several if len(points)]
        return cls(
            np.concatenate([points.w for points in each]),
            np.concatenate([points.log_target for points in each]),
            {name: np.concatenate([points.parts[name] for points in each]) for name in each[0].parts},
        )


class Density(Protocol):
    """A posterior as samplers see it.

    Attributes:
        dimension: d.
        headlines: names of the quantities that a sample is judged by.
        fixed: quantities that are held, whatever rounding makes of them.
        walkers: in an ensemble.
        log_constant: what the log of the integral of exp(log density) lacks to the model evidence.
        invalid: evaluations so far without a value.
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
        """Log density of w (n, d) up to a constant, -inf where it has no value."""
        ...

    def valued(self, w: np.ndarray, generator: np.random.Generator) -> Points:
        """The same, with draws of what was integrated out."""
        ...

    def log_density(self, points: Points) -> np.ndarray:
        """Log density in the coordinates that are reported, shape (n,)."""
        ...

    def quantities(self, points: Points) -> Mapping[str, np.ndarray]:
        """Everything that is said of a point, by name, shapes (n,)."""
        ...

    def first_proposal(self) -> Proposal:
        """Where draws are proposed before any was made."""
        ...


class Proposal(Protocol):
    """A density that draws come from and that learns from them."""

    def draw(self, count: int, generator: np.random.RandomState) -> np.ndarray:
        """Independent draws, shape (count, d)."""
        ...

    def log_density(self, w: np.ndarray) -> np.ndarray:
        """Log density, shape (n,)."""
        ...

    def fitted(self, w: np.ndarray, log_target: np.ndarray, log_weights: np.ndarray) -> Proposal:
        """Nearer to the target as weighted draws show it."""
        ...

    @property
    def steps(self) -> tuple[tuple[Step, float], ...]:
        """Metropolis-Hastings steps of a chain with their shares, which sum to at most 1."""
        ...


class Step(Protocol):
    """A Metropolis-Hastings step of a chain."""

    def __call__(self, w: np.ndarray, generator: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """New points for w (n, d), and ln q(old | new) - ln q(new | old)."""
        ...


def columns_of(density: Density, points: Points) -> dict[str, np.ndarray]:
    """Draws of every quantity that is not the same in all of them, and `log_density`."""
    every = {**density.quantities(points), "log_density": density.log_density(points)}
    return {name: column for name, column in every.items() if name not in density.fixed and np.ptp(column) > 0}

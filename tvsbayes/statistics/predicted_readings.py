"""Predicted readings: a mixture of normal distributions, one for each draw of the scales.

`PredictedMachine` is the one interface of tables, promises, ISO 230-2 figures and certificates: readings predicted at
commands, from a side, at a stated `State`, by draw. An adapter of an instrument provides it (`single_axis.
predicted_stops` for an axis); who uses it knows no instrument. The contract:

- `expected` is the part of a reading that repeats at that state: line, play, error by position, creep, temperature and
  contrast, from their joint posterior. Its covariance is the uncertainty of this part, and common to all repetitions.
  Without a state it is that of the campaign's mean (`state`), one for all commands and both sides: the state of tables
  and figures. The zero is the mean of the campaign's homings.
- `use` is the distribution of states over which a promise holds.
- `homings` is the number of homings whose zeros the campaign read; 0 of an absolute encoder, whose zero walks on from
  the first move. With 1 nothing but a prior tells how homings scatter: `frees_shift`.
- `shifts` is what a change of state adds, by cause, in `expected` as well; `scatter` is what does not repeat, by cause.
  A single reading is `expected` at its state plus all of `scatter`.
- All have the same draws in the same order: sums of their means and covariances are by draw, `pooled` after the sum.
- The uncertainty of a reference that is common to all readings is in the covariance of `expected`, which is of
  positions, not of what that reference would read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np


class State(NamedTuple):
    """State of a machine at readings: numbers, or arrays (r,) or (n, r), one for each reading, or draw and reading.

    `hours` and `travel` (commands) count from the homing, `warm_hours` from the time at which the machine was switched
    on; `kelvin` is the temperature minus that of the campaign's first move.
    """

    hours: float | np.ndarray
    travel: float | np.ndarray
    warm_hours: float | np.ndarray
    kelvin: float | np.ndarray


class Use(NamedTuple):
    """Distribution of states: time and travel since the homing uniform up to `hours` and `travel`, kelvin in its range.

    `warm_hours` (k,) are those at the homings, each as probable.
    """

    hours: float
    travel: float
    warm_hours: np.ndarray
    kelvin: tuple[float, float]

    def states(self, draws: int, count: int, rng: np.random.Generator) -> State:
        """Draw `count` states of one use by draw, stratified: each after a homing of the same age."""
        hours, travel, kelvin = rng.permuted(np.tile((np.arange(count) + 0.5) / count, (3, 1)), axis=1)
        begun = np.asarray(self.warm_hours)[np.arange(draws) % len(self.warm_hours), None]
        low, high = self.kelvin
        return State(self.hours * hours, self.travel * travel, begun + self.hours * hours, low + (high - low) * kelvin)


class Pooled(NamedTuple):
    """Mean (r,) and covariance (r, r) of readings."""

    mean: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class PredictedReadings:
    """Readings (r,) that are normal given each of n draws: means (n, r) and covariances (n, r, r)."""

    mean: np.ndarray
    covariance: np.ndarray

    def pooled(self, weights: np.ndarray | None = None) -> Pooled:
        """Moments of the mixture with weights (n,) of sum 1; None: equal weights."""
        weights = np.full(len(self.mean), 1 / len(self.mean)) if weights is None else weights
        mean = weights @ self.mean
        deviations = self.mean - mean
        covariance = np.tensordot(weights, self.covariance, 1) + (weights[:, None] * deviations).T @ deviations
        return Pooled(mean, covariance)

    def plus(self, covariance: np.ndarray | float) -> PredictedReadings:
        """The same with a further covariance (n, r, r) or (r, r)."""
        return PredictedReadings(self.mean, self.covariance + covariance)

    def centred(self) -> PredictedReadings:
        """The readings less their mean: one common shift taken off."""
        return self.less(np.ones((1, self.mean.shape[1]), dtype=bool))

    def less(self, groups: np.ndarray) -> PredictedReadings:
        """The readings less the mean of each group, masks (g, r)."""
        kept = less_means(groups)
        return PredictedReadings(self.mean @ kept, kept @ self.covariance @ kept)

    def drawn(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Readings (count, r) drawn from the mixture, the same number from each draw."""
        draw = np.arange(count) % len(self.mean)
        values, vectors = np.linalg.eigh(self.covariance)
        normal = rng.standard_normal((count, self.mean.shape[1])) * np.sqrt(np.maximum(values, 0.0))[draw]
        return self.mean[draw] + np.einsum("nij,nj->ni", vectors[draw], normal)

    def log_densities(self, value: np.ndarray, additional: np.ndarray | None = None) -> np.ndarray:
        """Log density of readings (r,) by draw, shape (n,); `additional` is a covariance (r, r) to be added."""
        covariance = self.covariance if additional is None else self.covariance + additional
        _, log_det = np.linalg.slogdet(covariance)
        deviations = value - self.mean
        square = np.einsum("ni,ni->n", deviations, np.linalg.solve(covariance, deviations[..., None])[..., 0])
        return -0.5 * (log_det + square + len(value) * np.log(2 * np.pi))

    def log_density(self, value: np.ndarray, additional: np.ndarray | None = None) -> float:
        """Log density of readings (r,) under the mixture of equal draws; `additional` as in `log_densities`."""
        return log_mean(self.log_densities(value, additional))


def less_means(groups: np.ndarray) -> np.ndarray:
    """Compute the matrix (r, r) that takes from readings the mean of each of disjoint groups, masks (g, r)."""
    shares = groups / np.maximum(groups.sum(axis=1, keepdims=True), 1)
    return np.eye(groups.shape[1]) - groups.T.astype(float) @ shares


def log_mean(logs: Sequence[float] | np.ndarray) -> float:
    """Logarithm of the mean of densities, from their logarithms."""
    return float(np.logaddexp.reduce(logs) - np.log(len(logs)))


def frees_shift(homings: int) -> bool:
    """Whether the errors of an axis count less one shift common to all: its zero was read after one homing alone."""
    return homings == 1


class PredictedMachine(Protocol):
    """Readings of one axis, predicted from a fit: see the module for the contract."""

    @property
    def unit(self) -> str:
        """Unit of readings and of all uncertainties."""

    @property
    def state(self) -> State:
        """Mean state of the campaign's readings."""

    @property
    def use(self) -> Use:
        """Use as in the campaign: its longest time and travel after a homing, its range of temperatures."""

    @property
    def homings(self) -> int:
        """Number of homings whose zeros were read; 0 of an absolute encoder."""

    def expected(self, command: np.ndarray, side: np.ndarray, state: State | None = None) -> PredictedReadings:
        """Predict the repeatable part at commands (r,), play taken up by arriving on a side (r,): 1 rising, -1 falling.

        The state is one for all, or one for each; None for `state`.
        """

    def shifts(self, use: State, at: State) -> dict[str, PredictedReadings]:
        """Predict what readings at the states `use` have more than at the state `at`, by cause, in `expected`."""

    def scatter(self, side: np.ndarray, use: State, u: np.ndarray | float) -> dict[str, np.ndarray]:
        """Compute covariances (n, r, r) of what does not repeat, by cause, of readings after one homing.

        Causes: "homing", "drift" since then, "stops", "readings" with stated uncertainties u.
        """

"""Tables of gear errors for robots: columns at regular counters, and one for counters beyond.

Transmission error e and change of play d of both axes, deg, of the output's angle (formulation 3.1). Between table
counters both are interpolated with fixed weights. Beyond the table only their sds are known, and one column each serves
all counters there. NumPy.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tvsbayes.calibration.optics import GEAR_INPUTS, Number
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.places import NEAREST, interpolation

COUNTERS_MAX = 64
"""Largest number of counters of a table, by axis."""
BEYOND = "beyond"
"""Last part of the name of the column for counters beyond the table."""


@dataclass(frozen=True)
class GearTable:
    """Counters of tabulated gear errors; columns are ordered as `GEAR_INPUTS`, each with its counters, then beyond.

    Attributes:
        steps: counters of (pan, tilt), regular, ascending; both empty without repeating errors.
    """

    steps: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())

    @property
    def size(self) -> int:
        """Return the number of columns."""
        return sum(2 * (len(steps) + 1) for steps in self.steps if len(steps))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Return `GEAR_INPUTS`, or none without repeating errors."""
        return GEAR_INPUTS if self.size else ()

    @cached_property
    def parts(self) -> dict[str, slice]:
        """Return the columns of each of `inputs`; the last one of each is for counters beyond the table."""
        parts, begin = {}, 0
        for name in self.inputs:
            end = begin + len(self.steps[_axis(name)]) + 1
            parts[name] = slice(begin, end)
            begin = end
        return parts

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return column names: `transmission_error_at_deg.pan.-120`, the last part a counter or `beyond`."""
        return tuple(
            f"{name}.{place}"
            for name in self.inputs
            for place in (*(f"{n:.12g}" for n in self.steps[_axis(name)]), BEYOND)
        )

    def shares(self, axis: int, counters: Number) -> np.ndarray:
        """Compute the weights of an axis error's columns in its value at counters (...), shape (..., columns)."""
        nodes, flat = np.array(self.steps[axis]), np.ravel(counters).astype(float)
        inside = (flat >= nodes[0]) & (flat <= nodes[-1])
        shares = np.zeros((len(flat), len(nodes) + 1))
        shares[inside, :-1] = interpolation(flat[inside], nodes)
        shares[~inside, -1] = 1.0
        return shares.reshape(*np.shape(counters), -1)

    def _near(self, axis: int, counter: float) -> tuple[slice, list[float]]:
        """Return the columns of one error with weight at a counter, and their weights, as in `shares`."""
        nodes = self.steps[axis]
        if not nodes[0] <= counter <= nodes[-1]:
            return slice(len(nodes), len(nodes) + 1), [1.0]
        begin = min(max(bisect_right(nodes, counter) - NEAREST // 2, 0), len(nodes) - NEAREST)
        at, weights = nodes[begin : begin + NEAREST], []
        for k in range(NEAREST):
            share = 1.0
            for other in range(NEAREST):
                if other != k:
                    share *= (counter - at[other]) / (at[k] - at[other])
            weights.append(share)
        return slice(begin, begin + NEAREST), weights

    def estimates_at(self, columns: np.ndarray, steps: tuple[float, float]) -> dict[str, float]:
        """Compute `at` for one row of columns (size,) at one pair of counters, faster, since robots call it often."""
        estimates, places = {}, [self._near(axis, n) for axis, n in enumerate(steps)] if self.size else []
        for name, part in self.parts.items():
            chosen, share = places[_axis(name)]
            values = columns[part.start + chosen.start : part.start + chosen.stop].tolist()
            estimates[name] = sum(a * b for a, b in zip(values, share, strict=True))
        return estimates

    def at(self, columns: np.ndarray, steps: tuple[Number, Number]) -> dict[str, np.ndarray]:
        """Compute errors at counters, by name of `inputs`.

        Args:
            columns: columns of the table, shape (..., size).
            steps: counters (pan, tilt), numbers or arrays of shape (n,).

        Returns:
            Arrays (...) or (..., n), deg; empty without repeating errors.
        """
        shares = [self.shares(axis, n) for axis, n in enumerate(steps)] if self.size else []
        return {name: columns[..., part] @ shares[_axis(name)].T for name, part in self.parts.items()}

    def look_covariance(self, covariance: np.ndarray, steps: tuple[Number, Number]) -> np.ndarray:
        """Compute the covariance of other inputs and of the errors at the counters of looks.

        Args:
            covariance: covariance of the others and the columns, shape (..., others + size, others + size); two axes
                for arrays of counters.
            steps: counters as for `at`.

        Returns:
            Shape (..., others + inputs, others + inputs), for arrays of counters with n before the last two.
        """
        others, count, shape = covariance.shape[-1] - self.size, len(self.inputs), np.shape(steps[0])
        share = np.zeros((*shape, count, self.size))
        shares = [self.shares(axis, n) for axis, n in enumerate(steps)]
        for row, (name, part) in enumerate(self.parts.items()):
            share[..., row, part] = shares[_axis(name)]
        rows = covariance[..., others:, :]
        if shape:
            # One matrix product for all looks.
            moved = (share.reshape(-1, self.size) @ rows).reshape(*shape, count, -1)
        else:
            moved = share @ rows
        joint = np.empty((*moved.shape[:-2], others + count, others + count))
        joint[..., :others, :others] = covariance[..., :others, :others]
        joint[..., others:, :others] = moved[..., :others]
        joint[..., :others, others:] = np.swapaxes(moved[..., :others], -1, -2)
        joint[..., others:, others:] = moved[..., others:] @ np.swapaxes(share, -1, -2)
        return joint


NO_GEARS = GearTable()
"""Table without repeating errors."""


def _axis(name: str) -> int:
    """Return the index of the axis of one of `GEAR_INPUTS`."""
    return AXES.index(name.split(".")[1])


def regular_counters(first: float, last: float, spacing: float) -> np.ndarray:
    """Choose counters of a table from a first to a last one, spaced by about `spacing`, at most `COUNTERS_MAX`."""
    count = int(np.clip(np.ceil((last - first) / spacing) + 1, 4, COUNTERS_MAX))
    return np.linspace(first, last, count)


def table_of(steps: Mapping[str, object]) -> GearTable:
    """Build a table from a file, by axis.

    Raises:
        ValueError: counters are not regular, ascending and finite.
        KeyError: an axis is missing.
    """
    steps_of_axes = [np.array(steps[axis], dtype=float) for axis in AXES]
    for nodes in steps_of_axes:
        regular = nodes.ndim == 1 and len(nodes) <= 4 * COUNTERS_MAX and np.all(np.isfinite(nodes))
        if not regular or len(nodes) in (1, 2, 3):
            raise ValueError("counters of a gear table")
        gaps = np.diff(nodes)
        if len(nodes) and (gaps.min() <= 0 or np.ptp(gaps) > 1e-6 * gaps.max()):
            raise ValueError("a gear table's counters are not regular")
    if (len(steps_of_axes[0]) == 0) != (len(steps_of_axes[1]) == 0):
        raise ValueError("a gear table of one axis")
    return GearTable((tuple(steps_of_axes[0].tolist()), tuple(steps_of_axes[1].tolist())))

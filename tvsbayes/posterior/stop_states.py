"""Stop errors, home offsets and unknown plays of a campaign as columns, eliminated in time order for many noise scales.

With G the columns, T the standard deviations of the states and unit noise, the covariance of the residuals is C = 1 + G
T^2 G'. A state is coupled only to those present in the same looks, so the Cholesky factor of 1 + T G'G T is sparse when
states are eliminated in the order in which they end: the information form of the filter of `estimators.likelihood`,
with a cost linear in the number of states. NumPy; leading axes are points of other scales.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import LinearSpots


@dataclass(frozen=True)
class StopStates:
    """All stop errors, home offsets and positions in the play of a campaign, in the order in which they end.

    Attributes:
        load: d(predicted)/d(state) of the spots' components, shape (4 n, m).
        variance: variances at the fit's noise scales, by direction (right, left, down, up), then by homings of (pan,
            tilt), shape (m, 6).
        constant: variances of all other states, shape (m,).
    """

    load: np.ndarray
    variance: np.ndarray
    constant: np.ndarray

    @cached_property
    def gram(self) -> np.ndarray:
        """Compute G'G, shape (m, m)."""
        return self.load.T @ self.load

    @cached_property
    def overlapping(self) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns of the upper triangle of G'G where both states affect a spot, with the diagonal."""
        rows, columns = np.nonzero(np.triu(self.gram))
        return rows, columns

    @cached_property
    def later(self) -> tuple[tuple[int, ...], ...]:
        """Return for each state the later states in its column of the Cholesky factor, fill-in included."""
        coupled = [set(np.flatnonzero(row[k + 1 :]) + k + 1) for k, row in enumerate(self.gram)]
        for after in coupled:
            ordered = sorted(after)
            if ordered:
                coupled[ordered[0]] |= set(ordered[1:])
        return tuple(tuple(sorted(map(int, after))) for after in coupled)


def stop_states(fit: JointFit, linear: LinearSpots) -> StopStates:
    """Expand the filter's six states: one column for each new draw of a state."""
    spots, states = linear.load.shape[0], linear.load.shape[2]
    mix = np.asarray(fit.arrays.spots.redraw_mix)[:spots]
    physical, mechanism = np.asarray(fit.mode.physical), fit.space.mechanism
    variance_of, homed = np.radians(physical[mechanism.stop_columns]) ** 2, np.asarray(fit.arrays.spots.homed)
    of_homing = np.diag(np.radians(physical[mechanism.columns("home_sd_deg")]) ** 2)
    times = []
    for state in range(states):
        drawn = np.flatnonzero(linear.renewed[:, state])
        for begin, end in zip(drawn, [*drawn[1:], spots], strict=True):
            by_scale, rest = np.zeros(6), 0.0
            if state < 2:
                by_scale[2 * state : 2 * state + 2] = mix[begin, state] * variance_of[state]
            else:
                by_scale[4:] = homed[begin, state - 2] * of_homing[state - 2] if state < 4 else 0.0
                rest = max(linear.variance[begin, state] - by_scale.sum(), 0.0)
            if linear.load[begin:end, :, state].any() and by_scale.sum() + rest > 0:
                times.append((end, begin, state, by_scale, rest))
    times.sort(key=lambda each: each[:3])
    load, variance, constant = np.zeros((spots, 4, len(times))), np.zeros((len(times), 6)), np.zeros(len(times))
    for column, (end, begin, state, by_scale, rest) in enumerate(times):
        load[begin:end, :, column] = linear.load[begin:end, :, state]
        variance[column], constant[column] = by_scale, rest
    return StopStates(load.reshape(4 * spots, len(times)), variance, constant)


@dataclass(frozen=True)
class Elimination:
    """The Cholesky factor of 1 + T G'G T for n standard deviations T and noise covariances.

    Attributes:
        sd: standard deviations of the states in units of the noise, shape (n, m).
        states: the states.
        pivot: diagonal of the factor, shape (n, m).
        below: its other columns: for each state, shape (n, later states).
    """

    sd: np.ndarray
    states: StopStates
    pivot: np.ndarray
    below: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, states: StopStates, sd: np.ndarray, gram: np.ndarray) -> Elimination:
        """Factorise column by column; `gram` is G'G of each point where states are `overlapping`, shape (n, k)."""
        later, (rows, columns) = states.later, states.overlapping
        scaled = np.ascontiguousarray((sd[:, rows] * sd[:, columns] * gram).T)
        diagonal = 1 + scaled[rows == columns].T
        rest = {(i, j): np.zeros(len(sd)) for i, after in enumerate(later) for j in after}
        rest |= dict(zip(zip(rows.tolist(), columns.tolist(), strict=True), scaled, strict=True))
        pivot, below = np.empty_like(sd), []
        for i, after in enumerate(later):
            # Rounding makes it negative at scales so large that a draw has no density: NaN says so.
            with np.errstate(invalid="ignore"):
                pivot[:, i] = np.sqrt(diagonal[:, i])
            column = np.stack([rest[i, j] / pivot[:, i] for j in after], axis=1) if after else np.empty((len(sd), 0))
            below.append(column)
            for a, j in enumerate(after):
                diagonal[:, j] -= column[:, a] ** 2
                for b in range(a + 1, len(after)):
                    rest[j, after[b]] -= column[:, a] * column[:, b]
        return cls(sd, states, pivot, tuple(below))

    def whitened(self, products: np.ndarray) -> np.ndarray:
        """Compute B with B'B = X'G T (1 + T G'G T)^-1 T G'X.

        Args:
            products: G'X, shape (m, c), or one for each point, shape (n, m, c).

        Returns:
            Shape (n, m, c).
        """
        rows = self.sd[..., None] * products
        for i, after in enumerate(self.states.later):
            row = rows[:, i]
            row /= self.pivot[:, i, None]
            for a, j in enumerate(after):
                rows[:, j] -= self.below[i][:, a, None] * row
        return rows

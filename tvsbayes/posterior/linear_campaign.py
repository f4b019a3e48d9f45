"""A campaign linearised at the mode, and its normal density at noise scales and time constants of a creep; NumPy.

Coordinates y are given and returned with the widest first. Precisions have the narrowest first, so that in their
triangular factors the mean of a coordinate follows from those wider than itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from tvsbayes.model.gear_processes import BlockRoot
from tvsbayes.posterior.look_noise import LookNoise
from tvsbayes.posterior.stop_states import Elimination, StopStates

FAR_ABOVE = 1e200
"""Last diagonal element that makes a matrix positive definite for any last row; its root is not used."""


def positive_factor(bordered: np.ndarray) -> np.ndarray:
    """Compute Cholesky factors of precisions with an additional last row, of their lower triangles, shape (n, k, k).

    Far out, the functions that span the noise of looks may leave a precision indefinite, or the stops without a factor
    (NaN). Its diagonal is raised, or it is replaced by 1: any positive definite matrix makes a map, and the weights are
    those of the density itself.
    """
    try:
        return np.linalg.cholesky(bordered)
    except np.linalg.LinAlgError:
        finite = np.isfinite(bordered).all(axis=(1, 2))[:, None, None]
        raised, diagonal = np.where(finite, bordered, np.eye(bordered.shape[1])), np.arange(bordered.shape[1] - 1)
        least = np.linalg.eigvalsh(raised[:, :-1, :-1])[:, 0]
        raised[:, diagonal, diagonal] += np.where(least > 0, 0.0, 1.0 - least)[:, None]
        return np.linalg.cholesky(raised)


@dataclass(frozen=True)
class Creep:
    """Creep of the zeros: columns of a linearised campaign that depend on its time constant.

    Attributes:
        warm_minutes: time of every spot since the machine was switched on, shape (s,).
        minutes: time constant at the mode; `scaled`: 1 at its noise scale, shape (q,).
        looks: looks, whose angles follow the zeros.
        rows: total creep of the zeros, in units of `looks`, by the columns of `LinearCampaign`, shape (2, c).
    """

    warm_minutes: np.ndarray
    minutes: float
    scaled: np.ndarray
    looks: LookNoise
    rows: np.ndarray

    def later(self, log_scale: np.ndarray) -> np.ndarray:
        """Compute how much more of the creep is over at each spot than at the mode, shape (n, s).

        `log_scale` is ln of the noise scales (n, q) over those at the mode.
        """
        minutes = self.minutes * np.exp([[0.0], *(log_scale @ self.scaled)[:, None]])
        over = -np.expm1(-self.warm_minutes / minutes)
        return over[1:] - over[0]

    def products(self, misfit: np.ndarray, later: np.ndarray) -> np.ndarray:
        """Multiply misfits (n, 4 s) by the columns of `more` at shares (n, s) or (1, s), shape (n, 2)."""
        load = self.looks.load
        by_spot = np.einsum("nsi,sia->nsa", misfit.reshape(len(misfit), *load.shape[:2]), load)
        return np.einsum("nsa,ns->na", by_spot, np.broadcast_to(later, by_spot.shape[:2]))

    def more(self, later: np.ndarray, crept_rad: np.ndarray) -> np.ndarray:
        """Compute the shift of predicted spots by shares (n, s) of creeps (n, 2) of the zeros, shape (n, 4 s)."""
        return np.einsum("sia,ns,na->nsi", self.looks.load, later, crept_rad, optimize=True).reshape(len(later), -1)


@dataclass(frozen=True)
class LinearCampaign:
    """The campaign linearised at the mode: observed - predicted is residual - along y - states s - places e + noise.

    Rows are the components of the spots in units of their noise at the mode; states s and errors e are in rad. The
    errors e, repeating by position or drifts, affect many looks.

    Attributes:
        residual: shape (4 n,).
        along: d(predicted)/dy of the coordinates other than noise scales, shape (4 n, g).
        states: stop errors, home offsets and unknown plays.
        by_noise: variance of every state at the mode by the noise scale that it is proportional to, shape (m, q).
        constant: variance independent of all of them, shape (m,).
        places: d(predicted)/d(errors at places, then terms of the drifts), shape (4 n, e).
        place_root: factor of the covariance of these errors at ln of noise scales (n, q) over those at the mode.
        prior: precision of y without data, shape (g, g).
        looks: noise of the looks at other scales.
        pixels, scatter: 1 at the noise scales of all pixels and of the looks' angles, shapes (q,) and (2, q).
        creep: creep of the zeros; None where its time constant is not estimated.
    """

    residual: np.ndarray
    along: np.ndarray
    states: StopStates
    by_noise: np.ndarray
    constant: np.ndarray
    places: np.ndarray
    place_root: Callable[[np.ndarray], BlockRoot]
    prior: np.ndarray
    looks: LookNoise
    pixels: np.ndarray
    scatter: np.ndarray
    creep: Creep | None = None

    @cached_property
    def columns(self) -> np.ndarray:
        """Stack errors at places, coordinates from the narrowest on, and the residual, shape (4 n, e + g + 1)."""
        return np.column_stack([self.places, self.along[:, ::-1], self.residual])

    @cached_property
    def _seen(self) -> np.ndarray:
        return self.looks.seen(np.concatenate([self.columns, self.states.load], axis=1))

    @cached_property
    def _spanned(self) -> np.ndarray:
        """Compute `products` at the mode, then the reductions by functions of `LookNoise.basis`, shape (1 + r, k)."""
        by_states, of_states = self.states.load.T @ self.columns, self.states.gram[self.states.overlapping]
        at_mode = np.concatenate([(self.columns.T @ self.columns).ravel(), by_states.ravel(), of_states])
        count, by_angle, (rows, columns) = self.columns.shape[1], self._seen, self.states.overlapping
        of_state = by_angle[..., count:]
        lost = (of_state[:, :, None, rows] * of_state[:, None, :, columns]).reshape(4 * len(of_state), len(rows))
        by_columns = self.looks.products(by_angle, by_angle[..., :count])
        flat = by_columns.reshape(len(by_columns), by_angle.shape[2] * count)
        return np.concatenate([at_mode[None], np.concatenate([flat, self.looks.basis @ lost], axis=1)])

    def products(self, inner: np.ndarray, later: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Multiply columns and states by the inverse noise covariance of n points.

        Args:
            inner: from `LookNoise.inner`, shape (n, s, 2, 2).
            later: from `Creep.later`; None without a creep.

        Returns:
            Products of the columns with each other (n, c, c), of the states with the columns (n, m, c), and of states
            with each other where they are `StopStates.overlapping` (n, k).
        """
        count, states = self.columns.shape[1], self.states.load.shape[1]
        shares = self.looks.shares(inner)
        whole = np.column_stack([np.ones(len(inner)), -shares]) @ self._spanned
        by_columns, of_states = np.split(whole, [(count + states) * count], axis=1)
        gram, by_states = np.split(by_columns.reshape(-1, count + states, count), [count], axis=1)
        if self.creep is None or later is None:
            return gram, by_states, of_states
        # All products use one covariance, that of the functions that span K: only then is the product of the columns
        # positive definite after eliminating the states.
        rows, square, spanned = self.creep.rows, self.looks.square, (shares @ self.looks.basis).reshape(inner.shape)
        left = later[..., None, None] * (np.eye(2) - square @ spanned)
        new = np.tensordot(np.swapaxes(left, 1, 2), self._seen, ((2, 3), (0, 1)))
        cross = np.swapaxes(new[..., :count], 1, 2) @ rows
        both = rows.T @ np.tensordot(later[..., None, None] * left, square, ((1, 3), (0, 1))) @ rows
        by_states = by_states + np.swapaxes(new[..., count:], 1, 2) @ rows
        return gram + cross + np.swapaxes(cross, 1, 2) + both, by_states, of_states

    def conditional(self, log_scale: np.ndarray, score: np.ndarray) -> Conditional:
        """Compute the normal density of y given ln of noise scales (n, q) over those at the mode.

        The precision of errors at places and y has the score as an additional last row. The parts of y in its factor
        are the required factor and forward solution, the errors integrated out (Schur complement).

        Args:
            log_scale: shape (n, q).
            score: constant part of the score of y, from the narrowest on, that is subtracted, shape (g,).
        """
        places, weight = self.places.shape[1], np.exp(-2 * log_scale @ self.pixels)
        later = None if self.creep is None else self.creep.later(log_scale)
        inner = self.looks.inner(weight[:, None] * np.exp(2 * log_scale @ self.scatter.T))
        gram, by_states, of_states = self.products(inner, later)
        variance = self.constant + np.exp(2 * log_scale) @ self.by_noise.T
        elimination = Elimination.of(self.states, np.sqrt(weight[:, None] * variance), of_states)
        white, root = elimination.whitened(by_states), self.place_root(log_scale)
        whole = weight[:, None, None] * (gram - np.swapaxes(white, 1, 2) @ white)
        # Errors at places are in units of their prior sds, since their covariance may be nearly singular.
        whole[:, places:, :places] = np.swapaxes(root.transposed_times(whole[:, :places, places:]), 1, 2)
        whole[:, :places, :places] = root.congruent(whole[:, :places, :places])
        diagonal = np.arange(places)
        whole[:, diagonal, diagonal] += 1.0
        whole[:, places:-1, places:-1] += self.prior[::-1, ::-1]
        whole[:, -1, places:-1] -= score
        whole[:, -1, -1] = FAR_ABOVE
        factor = positive_factor(whole)
        return Conditional(
            self, weight, inner, elimination, white, root, factor[:, :-1, :-1], factor[:, -1, places:-1], later
        )


@dataclass(frozen=True)
class Conditional:
    """The normal density of y at n points of noise scales.

    Attributes:
        linear: the campaign.
        weight: weight of squared residuals by the pixel scale, shape (n,).
        inner: from `LookNoise.inner`.
        elimination: elimination of the states.
        white: whitened products of states and columns, shape (n, m, e + g + 1).
        root: factor of the covariance of the errors at places, of n points.
        factor: lower triangular factor of the precision of errors at places (N(0, 1) a priori) and y together, shape
            (n, e + g, e + g).
        shift: factor' x the mean of y, from the narrowest on, shape (n, g).
        later: from `Creep.later`; None without a creep.
    """

    linear: LinearCampaign
    weight: np.ndarray
    inner: np.ndarray
    elimination: Elimination
    white: np.ndarray
    root: BlockRoot
    factor: np.ndarray
    shift: np.ndarray
    later: np.ndarray | None

    @property
    def own(self) -> np.ndarray:
        """Return the factor of the precision of y alone, from the narrowest on, shape (n, g, g)."""
        places = self.root.size
        return self.factor[:, places:, places:]

    def located(self, standard: np.ndarray) -> np.ndarray:
        """Map standard normal coordinates (n, g) to y."""
        return _back_substituted(self.own, standard[:, ::-1] + self.shift)

    def standard(self, y: np.ndarray) -> np.ndarray:
        """Map the k widest coordinates y (n, k) to standard normal ones, the inverse of `located`."""
        first = self.shift.shape[1] - y.shape[1]
        return (np.einsum("nij,ni->nj", self.own[:, first:, first:], y[:, ::-1]) - self.shift[:, first:])[:, ::-1]

    def means(self, wide: np.ndarray) -> np.ndarray:
        """Compute means of the narrow coordinates (n, k), given the others (n, g - k)."""
        narrow = self.shift.shape[1] - wide.shape[1]
        right = self.shift[:, :narrow] - np.einsum("nij,ni->nj", self.own[:, narrow:, :narrow], wide[:, ::-1])
        return _back_substituted(self.own[:, :narrow, :narrow], right)

    def misfit(self, residual: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Subtract from residuals (n, 4 k) at coordinates y (n, g) those of the linearised campaign."""
        linear, beyond = self.linear, residual - self.linear.residual + y @ self.linear.along.T
        if linear.creep is not None and self.later is not None:
            rows = linear.creep.rows
            beyond += linear.creep.more(self.later, y[:, ::-1] @ rows[:, self.root.size : -1].T - rows[:, -1])
        return np.nan_to_num(beyond)

    def centring(self, misfit: np.ndarray, narrow: int) -> np.ndarray:
        """Compute the Gauss-Newton step of the narrow coordinates (n, narrow) for a `misfit`, wide ones fixed.

        There may be any number of misfits for one point of noise scales.
        """
        linear, places = self.linear, self.root.size
        count = places + narrow
        misfit = linear.looks.whitened(misfit, self.inner)
        white = self.elimination.whitened((misfit @ linear.states.load)[..., None])
        right = misfit @ linear.columns[:, :count] - np.einsum("nmc,nmo->nc", self.white[..., :count], white)
        if linear.creep is not None and self.later is not None:
            right += linear.creep.products(misfit, self.later) @ linear.creep.rows[:, :count]
        right *= self.weight[:, None]
        right[:, :places] = self.root.transposed_times(right[:, :places, None])[..., 0]
        factors = np.broadcast_to(self.factor[:, :count, :count], (len(misfit), count, count))
        pairs = zip(factors, right, strict=True)
        solved = [lapack.dpotrs(factor, each, lower=1)[0][places:] for factor, each in pairs]
        return np.reshape(solved, (len(misfit), narrow))[:, ::-1]


def _back_substituted(factors: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve L'y = right (n, g) for lower triangular L; NumPy's solver would factorise again."""
    pairs = zip(factors, right, strict=True)
    return np.reshape([lapack.dtrtrs(factor.T, each)[0] for factor, each in pairs], right.shape)[:, ::-1]

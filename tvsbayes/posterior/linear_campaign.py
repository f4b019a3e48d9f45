"""A campaign linearised at the mode, and its normal equations at noise scales and time constants of a creep; NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from tvsbayes.model.gear_processes import BlockRoot
from tvsbayes.posterior.look_noise import LookNoise
from tvsbayes.posterior.stop_states import Elimination, StopStates


@dataclass(frozen=True)
class Creep:
    """Creep of the zeros: columns of a linearised campaign that depend on its time constant.

    Attributes:
        warm_minutes: time of every spot since the machine was switched on, shape (s,).
        minutes: time constant at the mode.
        looks: looks, whose angles follow the zeros.
        rows: total creep of the zeros, in units of `looks`, by the columns of `LinearCampaign`, shape (2, c).
    """

    warm_minutes: np.ndarray
    minutes: float
    looks: LookNoise
    rows: np.ndarray

    def later(self, log_scale: np.ndarray) -> np.ndarray:
        """Compute how much more of the creep is over at each spot than at the mode, shape (n, s).

        `log_scale` is ln of the time constants (n,) over that at the mode.
        """
        minutes = self.minutes * np.exp([[0.0], *log_scale[:, None]])
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
        by_noise: variance of every state at the mode by the noise coordinates that scale it, shape (m, q).
        constant: variance independent of all of them, shape (m,).
        places: d(predicted)/d(errors at places, then terms of the drifts), shape (4 n, e).
        prior: precision of y without data, shape (g, g).
        looks: noise of the looks at other scales.
        creep: creep of the zeros; None where its time constant is not estimated.
    """

    residual: np.ndarray
    along: np.ndarray
    states: StopStates
    by_noise: np.ndarray
    constant: np.ndarray
    places: np.ndarray
    prior: np.ndarray
    looks: LookNoise
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
        """Compute `Products` at the mode, then the reductions by functions of `LookNoise.basis`, shape (1 + r, k)."""
        by_states, of_states = self.states.load.T @ self.columns, self.states.gram[self.states.overlapping]
        at_mode = np.concatenate([(self.columns.T @ self.columns).ravel(), by_states.ravel(), of_states])
        count = self.columns.shape[1]
        by_angle, (rows, columns) = self._seen, self.states.overlapping
        of_state = by_angle[..., count:]
        lost = (of_state[:, :, None, rows] * of_state[:, None, :, columns]).reshape(4 * len(of_state), len(rows))
        by_columns = self.looks.products(by_angle, by_angle[..., :count])
        flat = by_columns.reshape(len(by_columns), by_angle.shape[2] * count)
        return np.concatenate([at_mode[None], np.concatenate([flat, self.looks.basis @ lost], axis=1)])

    def at(self, inner: np.ndarray, later: np.ndarray | None) -> Products:
        """Compute products of the columns by the inverse noise covariance of K, from `LookNoise.inner`.

        Args:
            inner: K, shape (n, s, 2, 2).
            later: from `Creep.later`.
        """
        count, states = self.columns.shape[1], self.states.load.shape[1]
        shares = self.looks.shares(inner)
        whole = np.column_stack([np.ones(len(inner)), -shares]) @ self._spanned
        by_columns, of_states = np.split(whole, [(count + states) * count], axis=1)
        gram, by_states = np.split(by_columns.reshape(-1, count + states, count), [count], axis=1)
        creep = self.creep
        if creep is None or later is None:
            return Products(gram, by_states, of_states)
        # All products use one covariance, that of the functions that span K: only then is the product of the columns
        # positive definite after eliminating the states.
        spanned = (shares @ self.looks.basis).reshape(inner.shape)
        left = later[..., None, None] * (np.eye(2) - self.looks.square @ spanned)
        new = np.tensordot(np.swapaxes(left, 1, 2), self._seen, ((2, 3), (0, 1)))
        cross = np.swapaxes(new[..., :count], 1, 2) @ creep.rows
        square = np.tensordot(later[..., None, None] * left, self.looks.square, ((1, 3), (0, 1)))
        by_states = by_states + np.swapaxes(new[..., count:], 1, 2) @ creep.rows
        both = creep.rows.T @ square @ creep.rows
        return Products(gram + cross + np.swapaxes(cross, 1, 2) + both, by_states, of_states)


@dataclass(frozen=True)
class Products:
    """Products of a linearised campaign's columns and states by the inverse noise covariance of n points.

    Attributes:
        gram: products of the columns with each other, shape (n, c, c).
        by_states: products of the states with the columns, shape (n, m, c).
        of_states: of states with each other where they are `StopStates.overlapping`, shape (n, k).
    """

    gram: np.ndarray
    by_states: np.ndarray
    of_states: np.ndarray


@dataclass(frozen=True)
class Conditional:
    """The linearised campaign at n points of noise scales; coordinates y from the narrowest on.

    Attributes:
        weight: weight of squared residuals by the pixel scale, shape (n,).
        inner: from `LookNoise.inner`.
        elimination: elimination of the states.
        white: whitened products of states and columns, shape (n, m, e + g + 1).
        root: factor of the covariance of the errors at places, of n points.
        factor: lower triangular factor of the precision of errors at places (N(0, 1) a priori) and y together, shape
            (n, e + g, e + g).
        shift: factor' x the mean of y, shape (n, g).
        later: from `Creep.later`; None without a creep.
    """

    weight: np.ndarray
    inner: np.ndarray
    elimination: Elimination
    white: np.ndarray
    root: BlockRoot
    factor: np.ndarray
    shift: np.ndarray
    later: np.ndarray | None = None

    @property
    def own(self) -> np.ndarray:
        """Return the factor of the precision of y alone, shape (n, g, g)."""
        places = self.root.size
        return self.factor[:, places:, places:]

    def solved(self, right: np.ndarray) -> np.ndarray:
        """Solve own' y = right for y by back substitution, shape (n, g); NumPy's solver would factorise again."""
        pairs = zip(self.own, right, strict=True)
        return np.array([lapack.dtrtrs(factor.T, each)[0] for factor, each in pairs]).reshape(right.shape)

    def centring(self, linear: LinearCampaign, misfit: np.ndarray, narrow: int) -> np.ndarray:
        """Compute the Gauss-Newton step of the narrow coordinates for a misfit, wide ones fixed.

        Args:
            linear: the campaign.
            misfit: residuals less the linear ones, shape (n, 4 k); any number of them for one point of noise scales.
            narrow: number of narrow coordinates, the first of y here.
        """
        places = self.root.size
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
        return np.reshape(solved, (len(misfit), narrow))

    def means(self, wide: np.ndarray) -> np.ndarray:
        """Compute means of the narrow coordinates (n, k) by the linearised campaign, given the others (n, g - k)."""
        narrow = self.shift.shape[1] - wide.shape[1]
        right = self.shift[:, :narrow] - np.einsum("nij,ni->nj", self.own[:, narrow:, :narrow], wide)
        pairs = zip(self.own[:, :narrow, :narrow], right, strict=True)
        return np.reshape([lapack.dtrtrs(factor.T, each)[0] for factor, each in pairs], right.shape)

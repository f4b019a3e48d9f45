"""A campaign linearised at the mode, and its normal equations at noise scales and time constants of a creep; NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from tvsbayes.posterior.stop_states import Elimination, StopStates


@dataclass(frozen=True)
class Creep:
    """Zeros that creep: columns of a linearised campaign that another time constant changes.

    Attributes:
        warm_minutes: since the machine was switched on, of every spot, shape (s,).
        minutes: time constant at the mode.
        slope: d(predicted)/d(zero, rad), shape (s, 4, 2).
        rows: how far the zeros creep in all, rad, by the columns of `LinearCampaign`, shape (2, c).
    """

    warm_minutes: np.ndarray
    minutes: float
    slope: np.ndarray
    rows: np.ndarray

    def later(self, log_scale: np.ndarray) -> np.ndarray:
        """How much more of the creep is over at each spot than at the mode, by ln of the time constants (n,) over it.

        Shape (n, s).
        """
        minutes = self.minutes * np.exp([[0.0], *log_scale[:, None]])
        over = -np.expm1(-self.warm_minutes / minutes)
        return over[1:] - over[0]

    def seen(self, rows: np.ndarray) -> np.ndarray:
        """Products of rows (4 s, c), spot by spot, with the slopes, shape (s, 2, c)."""
        return np.einsum("sia,sic->sac", self.slope, rows.reshape(*self.slope.shape[:2], -1))

    @cached_property
    def square(self) -> np.ndarray:
        """Products of the slopes with each other, shape (s, 2, 2)."""
        return np.einsum("sia,sib->sab", self.slope, self.slope)

    def products(self, misfit: np.ndarray, later: np.ndarray) -> np.ndarray:
        """Of misfits (n, 4 s) with what `more` sees of either zero, shares (n, s) or (1, s), shape (n, 2)."""
        by_spot = np.einsum("nsi,sia->nsa", misfit.reshape(len(misfit), *self.slope.shape[:2]), self.slope)
        return np.einsum("nsa,ns->na", by_spot, np.broadcast_to(later, by_spot.shape[:2]))

    def more(self, later: np.ndarray, crept_rad: np.ndarray) -> np.ndarray:
        """What spots are seen farther on where zeros (n, 2) creep, by shares (n, s) of it, shape (n, 4 s)."""
        return np.einsum("sia,ns,na->nsi", self.slope, later, crept_rad, optimize=True).reshape(len(later), -1)


@dataclass(frozen=True)
class LinearCampaign:
    """The campaign linearised at the mode: observed - predicted is residual - along y - states s - places e + noise.

    Rows are the components of the spots in units of their noise at the mode, states s and errors e rad. Errors repeat
    by position, or are drifts: what stays for many looks.

    Attributes:
        residual: shape (4 n,).
        along: d(predicted)/dy of the coordinates that are no noise scales, shape (4 n, g).
        states: stop errors and their like.
        by_noise: variance of every state at the mode by the noise coordinates that scale it, shape (m, q).
        constant: variance that scales with none, less what the noise of the looks has already, shape (m,).
        places: d(predicted)/d(errors at places, then terms of the drifts), shape (4 n, e).
        prior: precision of y without data, shape (g, g).
        creep: None where its time constant is not estimated.
    """

    residual: np.ndarray
    along: np.ndarray
    states: StopStates
    by_noise: np.ndarray
    constant: np.ndarray
    places: np.ndarray
    prior: np.ndarray
    creep: Creep | None = None

    @cached_property
    def columns(self) -> np.ndarray:
        """Errors at places, coordinates from the narrowest on, and the residual, shape (4 n, e + g + 1)."""
        return np.column_stack([self.places, self.along[:, ::-1], self.residual])

    @cached_property
    def gram(self) -> np.ndarray:
        """Products of the columns."""
        return self.columns.T @ self.columns

    @cached_property
    def by_states(self) -> np.ndarray:
        """Products of the states with the columns, shape (m, e + g + 1)."""
        return self.states.load.T @ self.columns

    @cached_property
    def _by_creep(self) -> np.ndarray:
        assert self.creep is not None
        return self.creep.seen(np.concatenate([self.columns, self.states.load], axis=1))

    def at(self, later: np.ndarray | None) -> Products:
        """Products of the columns where so much more of the creep is over, as `Creep.later` gives it."""
        creep = self.creep
        if creep is None or later is None:
            return Products(self.gram, self.by_states)
        new, count = np.tensordot(later, self._by_creep, 1), len(self.gram)
        cross = np.swapaxes(new[..., :count], 1, 2) @ creep.rows
        both = creep.rows.T @ np.tensordot(later**2, creep.square, 1) @ creep.rows
        by_states = self.by_states + np.swapaxes(new[..., count:], 1, 2) @ creep.rows
        return Products(self.gram + cross + np.swapaxes(cross, 1, 2) + both, by_states)


@dataclass(frozen=True)
class Products:
    """Of the columns of a linearised campaign with each other (..., c, c), and of the states with them (..., m, c)."""

    gram: np.ndarray
    by_states: np.ndarray


@dataclass(frozen=True)
class Conditional:
    """The linearised campaign at noise scales, a row for each of n points; coordinates y from the narrowest on.

    Attributes:
        weight: of squared residuals, by the pixel scale, shape (n,).
        elimination: of the states.
        white: of the products of states and columns, shape (n, m, e + g + 1).
        root: of the covariance of the errors at places, shape (n, e, e).
        factor: lower triangular factor of the precision of errors at places (N(0, 1) a priori) and y together, shape
            (n, e + g, e + g).
        shift: factor' x the mean of y, shape (n, g).
        later: as `Creep.later` gives it; None without a creep.
    """

    weight: np.ndarray
    elimination: Elimination
    white: np.ndarray
    root: np.ndarray
    factor: np.ndarray
    shift: np.ndarray
    later: np.ndarray | None = None

    @property
    def own(self) -> np.ndarray:
        """The factor of the precision of y alone, shape (n, g, g)."""
        places = self.root.shape[1]
        return self.factor[:, places:, places:]

    def solved(self, right: np.ndarray) -> np.ndarray:
        """Back substitution for y in own' y = right, shape (n, g): NumPy's solver would factorise anew."""
        pairs = zip(self.own, right, strict=True)
        return np.array([lapack.dtrtrs(factor.T, each)[0] for factor, each in pairs]).reshape(right.shape)

    def centring(self, linear: LinearCampaign, misfit: np.ndarray, narrow: int) -> np.ndarray:
        """The Gauss-Newton step of the narrow coordinates by which a misfit becomes least, wide ones held.

        Args:
            linear: the campaign.
            misfit: residuals beyond the linear ones, shape (n, 4 k); for one point of noise scales any number of them.
            narrow: number of narrow coordinates, the first of y here.
        """
        places = self.root.shape[1]
        count = places + narrow
        white = self.elimination.whitened((misfit @ linear.states.load)[..., None])
        right = misfit @ linear.columns[:, :count] - np.einsum("nmc,nmo->nc", self.white[..., :count], white)
        if linear.creep is not None and self.later is not None:
            right += linear.creep.products(misfit, self.later) @ linear.creep.rows[:, :count]
        right *= self.weight[:, None]
        right[:, :places] = np.einsum("nji,nj->ni", self.root, right[:, :places])
        factors = np.broadcast_to(self.factor[:, :count, :count], (len(misfit), count, count))
        pairs = zip(factors, right, strict=True)
        found = [lapack.dpotrs(factor, each, lower=1)[0][places:] for factor, each in pairs]
        return np.reshape(found, (len(misfit), narrow))

    def means(self, wide: np.ndarray) -> np.ndarray:
        """Of the narrow coordinates (n, k) by the linearised campaign, at y of the others (n, g - k)."""
        narrow = self.shift.shape[1] - wide.shape[1]
        right = self.shift[:, :narrow] - np.einsum("nij,ni->nj", self.own[:, narrow:, :narrow], wide)
        pairs = zip(self.own[:, :narrow, :narrow], right, strict=True)
        return np.reshape([lapack.dtrtrs(factor.T, each)[0] for factor, each in pairs], right.shape)

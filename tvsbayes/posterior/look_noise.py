"""Noise of looks at other scales than the mode's, pixels and the scatter of the beam's angles each by its own; NumPy.

In units of the noise at the mode a spot's components have the covariance p^2 (1 + U T U') at a point of noise scales:
p the scale of pixels over that at the mode, U what either angle moves them by, T diagonal, the variances of the angles
over p^2 less those at the mode. Its inverse is p^-2 (1 - U K U') with K = T (1 + U'U T)^-1 (Woodbury), which is smooth
in two numbers of the point and few of the spot: a few functions of the spots span it at all points, and products of
columns by the inverse are sums of as many matrices that are known beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

KNOTS, LEAST_VARIANCE = 16, 1e-4
"""Variances of either angle at which K is spanned, the least over that at the mode; and none."""
LEFT_OUT = 1e-2
"""Of the smallest eigenvalue of 1 - U K U', what the functions that are left out may change."""


@dataclass(frozen=True)
class LookNoise:
    """What scatters from look to look; angles in units whose square moves a spot by its noise, in the mean.

    Attributes:
        unit_rad: of the angles (pan, tilt), shape (2,).
        load: d(predicted)/d(angles), shape (s, 4, 2).
        weight: robust weights of the spots, shape (s,).
        variance: of the angles at the mode and full weight, shape (2,).
        most: largest variance over it, shape (2,).
    """

    unit_rad: np.ndarray
    load: np.ndarray
    weight: np.ndarray
    variance: np.ndarray
    most: np.ndarray

    @classmethod
    def of(cls, slope: np.ndarray, weight: np.ndarray, variance_rad2: np.ndarray, most: np.ndarray) -> LookNoise:
        """From slopes (s, 4, 2) per rad and variances (2,) in rad^2."""
        unit_rad = 1 / np.sqrt(np.maximum((slope**2).sum(axis=1).mean(axis=0), 1e-300))
        return cls(unit_rad, slope * unit_rad, weight, variance_rad2 / unit_rad**2, most)

    @cached_property
    def square(self) -> np.ndarray:
        """U'U, shape (s, 2, 2)."""
        return self.seen(self.load)

    def seen(self, rows: np.ndarray) -> np.ndarray:
        """U'X of rows X (4 s, c), spot by spot, shape (s, 2, c)."""
        return np.einsum("sia,sic->sac", self.load, rows.reshape(*self.load.shape[:2], -1))

    def inner(self, scale: np.ndarray) -> np.ndarray:
        """K at variances of the angles over p^2, as multiples (n, 2) of those at the mode, shape (n, s, 2, 2)."""
        more = (self.variance * (np.minimum(scale, self.most) - 1))[:, None] / self.weight[:, None]
        (one, across), (_, two) = np.moveaxis(self.square, 0, 2)
        by_one, by_two = 1 + one * more[..., 0], 1 + two * more[..., 1]
        both = -across * more[..., 0] * more[..., 1]
        rows = np.stack([more[..., 0] * by_two, both, both, more[..., 1] * by_one], axis=-1)
        return (rows / (by_one * by_two + across * both)[..., None]).reshape(*both.shape, 2, 2)

    @cached_property
    def basis(self) -> np.ndarray:
        """Orthonormal functions of the spots that span `inner`, shape (r, 4 s)."""
        knots = [np.append(0.0, np.geomspace(LEAST_VARIANCE, most, KNOTS)) for most in self.most]
        scale = np.stack(np.meshgrid(*knots), axis=-1).reshape(-1, 2)
        # What the smallest eigenvalue of 1 - U K U' is at least: that of 1 + U T U' is 1 + U'U T at most.
        widest = 1 + np.max((self.variance * scale)[:, None] / self.weight[:, None] * self._squares, axis=(1, 2))
        spanned = np.linalg.svd(widest[:, None] * self.inner(scale).reshape(len(scale), -1), full_matrices=False)
        left = np.sqrt(np.cumsum((spanned.U * spanned.S)[:, ::-1] ** 2, axis=1)).max(axis=0)
        return spanned.Vh[: int(np.sum(left > LEFT_OUT))]

    @cached_property
    def _squares(self) -> np.ndarray:
        return np.trace(self.square, axis1=1, axis2=2)[:, None]

    def shares(self, inner: np.ndarray) -> np.ndarray:
        """Of the functions of `basis` in K, shape (n, r)."""
        return inner.reshape(len(inner), -1) @ self.basis.T

    def products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """X' U B U' Y by the functions B of `basis`, of `seen` columns (s, 2, c) and (s, 2, d), shape (r, c, d)."""
        given, rows = (left.shape[2], right.shape[2]), left.reshape(2 * len(left), -1)
        turned = (self.basis.reshape(-1, *self.square.shape) @ right).reshape(-1, *rows.shape[:1], given[1])
        return np.reshape([rows.T @ each for each in turned], (-1, *given))

    def whitened(self, misfit: np.ndarray, inner: np.ndarray) -> np.ndarray:
        """(1 - U K U') of misfits, shape (n, 4 s)."""
        by_spot = misfit.reshape(len(misfit), *self.load.shape[:2])[..., None]
        moved = self.load @ (inner @ (np.swapaxes(self.load, 1, 2) @ by_spot))
        return misfit - moved.reshape(misfit.shape)

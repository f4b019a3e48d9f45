"""Noise of looks at other scales than at the mode, of pixels and of the beam's scattering angles; NumPy.

In units of the noise at the mode a spot's components have the covariance p^2 (1 + U T U') at a point of noise scales: p
the scale of pixels over that at the mode, U their derivatives by the angles, T diagonal, the variances of the angles
over p^2 less those at the mode. Its inverse is p^-2 (1 - U K U') with K = T (1 + U'U T)^-1 (Woodbury), smooth in two
numbers of the point and few of the spot. Therefore a few functions of the spots span it at all points, and products of
columns by the inverse are sums of as many precomputed matrices.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

KNOTS, LEAST_VARIANCE = 16, 1e-4
"""Number of variances of each angle at which K is spanned, besides zero, and the least, relative to the mode's."""
LEFT_OUT = 1e-2
"""Largest relative change of the smallest eigenvalue of 1 - U K U' by the functions left out."""


@dataclass(frozen=True)
class LookNoise:
    """Noise of looks; angles in units that move spots by their noise, in the mean square.

    Attributes:
        unit_rad: units of the angles (pan, tilt), shape (2,).
        load: d(predicted)/d(angles), shape (s, 4, 2).
        weight: robust weights of the spots, shape (s,).
        variance: variances of the angles at the mode and full weight, shape (2,).
        most: largest variance relative to it, shape (2,).
    """

    unit_rad: np.ndarray
    load: np.ndarray
    weight: np.ndarray
    variance: np.ndarray
    most: np.ndarray

    @classmethod
    def of(cls, slope: np.ndarray, weight: np.ndarray, variance_rad2: np.ndarray, most: np.ndarray) -> LookNoise:
        """Build it from slopes (s, 4, 2) per rad and variances (2,) in rad^2."""
        unit_rad = 1 / np.sqrt(np.maximum((slope**2).sum(axis=1).mean(axis=0), 1e-300))
        return cls(unit_rad, slope * unit_rad, weight, variance_rad2 / unit_rad**2, most)

    @cached_property
    def square(self) -> np.ndarray:
        """Compute U'U, shape (s, 2, 2)."""
        return self.seen(self.load)

    def seen(self, rows: np.ndarray) -> np.ndarray:
        """Compute U'X of rows X (4 s, c), spot by spot, shape (s, 2, c)."""
        return np.einsum("sia,sic->sac", self.load, rows.reshape(*self.load.shape[:2], -1))

    def inner(self, scale: np.ndarray) -> np.ndarray:
        """Compute K, shape (n, s, 2, 2), at variances of the angles over p^2, multiples (n, 2) of those at the mode."""
        more = (self.variance * (np.minimum(scale, self.most) - 1))[:, None] / self.weight[:, None]
        (one, across), (_, two) = np.moveaxis(self.square, 0, 2)
        by_one, by_two = 1 + one * more[..., 0], 1 + two * more[..., 1]
        both = -across * more[..., 0] * more[..., 1]
        rows = np.stack([more[..., 0] * by_two, both, both, more[..., 1] * by_one], axis=-1)
        return (rows / (by_one * by_two + across * both)[..., None]).reshape(*both.shape, 2, 2)

    @cached_property
    def basis(self) -> np.ndarray:
        """Compute orthonormal functions of the spots that span `inner`, shape (r, 4 s)."""
        knots = [np.append(0.0, np.geomspace(LEAST_VARIANCE, most, KNOTS)) for most in self.most]
        scale = np.stack(np.meshgrid(*knots), axis=-1).reshape(-1, 2)
        # Inverse of a lower bound of the least eigenvalue of 1 - U K U': 1 + U T U' has at most that of 1 + U'U T.
        widest = 1 + np.max((self.variance * scale)[:, None] / self.weight[:, None] * self._squares, axis=(1, 2))
        spanned = np.linalg.svd(widest[:, None] * self.inner(scale).reshape(len(scale), -1), full_matrices=False)
        left = np.sqrt(np.cumsum((spanned.U * spanned.S)[:, ::-1] ** 2, axis=1)).max(axis=0)
        return spanned.Vh[: int(np.sum(left > LEFT_OUT))]

    @cached_property
    def _squares(self) -> np.ndarray:
        return np.trace(self.square, axis1=1, axis2=2)[:, None]

    def shares(self, inner: np.ndarray) -> np.ndarray:
        """Compute the coefficients of the functions of `basis` in K, shape (n, r)."""
        return inner.reshape(len(inner), -1) @ self.basis.T

    def products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Compute X' U B U' Y for the functions B of `basis`, from `seen` (s, 2, c) and (s, 2, d), shape (r, c, d)."""
        given, rows = (left.shape[2], right.shape[2]), left.reshape(2 * len(left), -1)
        turned = (self.basis.reshape(-1, *self.square.shape) @ right).reshape(-1, *rows.shape[:1], given[1])
        return np.reshape([rows.T @ each for each in turned], (-1, *given))

    def whitened(self, misfit: np.ndarray, inner: np.ndarray) -> np.ndarray:
        """Apply 1 - U K U' to misfits, shape (n, 4 s)."""
        by_spot = misfit.reshape(len(misfit), *self.load.shape[:2])[..., None]
        moved = self.load @ (inner @ (np.swapaxes(self.load, 1, 2) @ by_spot))
        return misfit - moved.reshape(misfit.shape)

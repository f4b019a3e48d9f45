"""A play in the map of the posterior: observations are linear in its degrees, which are not negative.

In z, where its prior is normal, the posterior of a play near zero is steep on one side and flat on the other. In
degrees it is a normal density truncated at zero, which has a closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from tvsbayes.gears.priors import FARTHEST_SD, half_normal, half_normal_coordinate, half_normal_slope


@dataclass(frozen=True)
class HalfNormal:
    """A half-normal quantity about its mode: steps of z, with normal prior, and linear steps of the quantity.

    Linear steps are in units of z at the mode.
    """

    mode: float

    @property
    def _slope(self) -> float:
        return float(half_normal_slope(self.mode))

    @property
    def least(self) -> float:
        """Return the linear step at which the quantity is zero."""
        return -float(half_normal(self.mode)) / self._slope

    def bent(self, straight: np.ndarray) -> np.ndarray:
        """Convert linear steps of the quantity to steps of z."""
        return half_normal_coordinate(half_normal(self.mode) + self._slope * straight) - self.mode

    def straight(self, bent: np.ndarray) -> np.ndarray:
        """Convert steps of z to linear steps, the inverse of `bent`."""
        return (half_normal(np.minimum(self.mode + bent, FARTHEST_SD)) - half_normal(self.mode)) / self._slope

    def log_bend(self, z: np.ndarray) -> np.ndarray:
        """Compute ln |d(bent)/d(straight)| at z."""
        return np.log(self._slope / half_normal_slope(z))

    @property
    def precision(self) -> float:
        """Return the prior precision of a linear step."""
        return self._slope**2

    @property
    def score(self) -> float:
        """Return d(log density)/d(linear step) at the mode of the density in z, less the term of the volume."""
        return self.mode - self._slope * float(half_normal(self.mode))


@dataclass(frozen=True)
class Cut:
    """The map between a standard normal quantity and one truncated below at bounds (n,).

    Probabilities of the upper tails are multiplied as logarithms, which is accurate at both ends.
    """

    bound: np.ndarray

    def within(self, free: np.ndarray) -> np.ndarray:
        """Map a standard normal quantity to the truncated one."""
        return -special.ndtri_exp(special.log_ndtr(-self.bound) + special.log_ndtr(-free))

    def without(self, within: np.ndarray) -> np.ndarray:
        """Map back, the inverse of `within`."""
        return -special.ndtri_exp(np.minimum(special.log_ndtr(-within) - special.log_ndtr(-self.bound), 0.0))

    def log_slope(self, free: np.ndarray, within: np.ndarray) -> np.ndarray:
        """Compute ln of d(within)/d(free)."""
        return special.log_ndtr(-self.bound) + 0.5 * (within**2 - free**2)

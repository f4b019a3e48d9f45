"""A play in the map of the posterior: its degrees are linear in what the spots see, and none is below zero.

In z, where its prior is normal, the posterior of a play near zero is steep on one side and flat on the other. Along
its own line it is a normal density that is cut at zero, and such a cut has a closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from tvsbayes.model.parameter_space import FARTHEST_SD, half_normal, half_normal_coordinate, half_normal_slope


@dataclass(frozen=True)
class HalfNormal:
    """A half-normal quantity about its mode: z, in which the prior is normal, and the line of the quantity there.

    Steps are in units of z at the mode.
    """

    mode: float

    @property
    def _slope(self) -> float:
        return float(half_normal_slope(self.mode))

    @property
    def least(self) -> float:
        """The step at which the quantity is zero."""
        return -float(half_normal(self.mode)) / self._slope

    def bent(self, straight: np.ndarray) -> np.ndarray:
        """The step of z by which the quantity moves along its line as far as these steps say."""
        return half_normal_coordinate(half_normal(self.mode) + self._slope * straight) - self.mode

    def straight(self, bent: np.ndarray) -> np.ndarray:
        """The inverse of `bent`."""
        return (half_normal(np.minimum(self.mode + bent, FARTHEST_SD)) - half_normal(self.mode)) / self._slope

    @property
    def precision(self) -> float:
        """Of a step, a priori."""
        return self._slope**2

    @property
    def score(self) -> float:
        """d(log density)/d(step) at the mode, where that by z is zero: less the share of the volume."""
        return self.mode - self._slope * float(half_normal(self.mode))


@dataclass(frozen=True)
class Cut:
    """A standard normal quantity of which only values above bounds (n,) are possible, by one without bounds.

    Probabilities of the upper tails are multiplied, as logarithms: both ends keep their digits.
    """

    bound: np.ndarray

    def within(self, free: np.ndarray) -> np.ndarray:
        """From a standard normal quantity to the bounded one."""
        return -special.ndtri_exp(special.log_ndtr(-self.bound) + special.log_ndtr(-free))

    def without(self, within: np.ndarray) -> np.ndarray:
        """The inverse of `within`."""
        return -special.ndtri_exp(np.minimum(special.log_ndtr(-within) - special.log_ndtr(-self.bound), 0.0))

    def log_slope(self, free: np.ndarray, within: np.ndarray) -> np.ndarray:
        """Ln of d(within)/d(free)."""
        return special.log_ndtr(-self.bound) + 0.5 * (within**2 - free**2)

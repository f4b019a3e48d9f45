"""Prediction of the gears' repeating errors at other counters from those at some counters (kriging). NumPy.

The factor of the joint covariance gives the prediction. Its rows for the other counters hold the conditional sd and the
weights of the known errors, in units in which these are N(0, 1) a priori (Rasmussen and Williams, Gaussian Processes
for Machine Learning, MIT Press 2006, 2.2). Counters in steps, angles in rad.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tvsbayes.instrument.mechanisms import Mechanism
from tvsbayes.instrument.parameters import PERIODS_MAX
from tvsbayes.model.gear_processes import GearScales, place_root


def scales_at(physical: np.ndarray, harmonic_period_deg: np.ndarray, mechanism: Mechanism) -> GearScales:
    """Extract the gear scales from all parameter values, of one point (p,) or many (n, p); periods of shape (2, 3)."""
    leading = physical.shape[:-1]

    def block(name: str) -> np.ndarray:
        return np.radians(physical[..., mechanism.columns(name)])

    return GearScales(
        error_rad=block("transmission_error_deg"),
        length_rad=block("transmission_error_length_deg"),
        play_rad=block("play_variation_deg"),
        drift_rad_per_root_hour=block("drift_deg_per_root_hour"),
        amplitude_rad=block("harmonic_amplitude_deg").reshape(*leading, 2, PERIODS_MAX),
        period_rad=np.radians(np.broadcast_to(harmonic_period_deg, (*leading, 2, PERIODS_MAX))),
    )


@dataclass(frozen=True)
class Between:
    """Prediction of errors at other counters (m,) from those at the places, in units of these.

    Attributes:
        error, play: weights of the places, rad, shapes (m, c).
        error_rest, play_rest: conditional sd given the places, rad, shapes (m,).
    """

    error: np.ndarray
    play: np.ndarray
    error_rest: np.ndarray
    play_rest: np.ndarray


@dataclass(frozen=True)
class KnownPlaces:
    """The c places of both axes at which the errors are known.

    Attributes:
        steps: counters, shape (c,).
        on_tilt: whether a place is on the tilt axis, shape (c,).
        ratio_rad_per_step: mean ratios (pan, tilt), shape (2,).
        scales: scales of the processes, NumPy; None where there is no place.
    """

    steps: np.ndarray
    on_tilt: np.ndarray
    ratio_rad_per_step: np.ndarray
    scales: GearScales | None

    @property
    def size(self) -> int:
        """Return the number of errors: transmission errors and plays."""
        return 2 * len(self.steps)

    @cached_property
    def root(self) -> np.ndarray:
        """Compute the lower triangular factor of the covariance of the errors, rad, shape (2 c, 2 c)."""
        return self._factor(self.steps, self.on_tilt)

    def _factor(self, steps: np.ndarray, on_tilt: np.ndarray) -> np.ndarray:
        if self.scales is None:
            return np.zeros((0, 0))
        angle_rad = steps * self.ratio_rad_per_step[on_tilt.astype(int)]
        return place_root(self.scales, angle_rad, on_tilt, np.ones(len(steps), dtype=bool))

    def factors_with(self, steps: np.ndarray, on_tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute factors of errors and of plays at the places, then at other counters, shapes (c + m, c + m), rad."""
        both = self._factor(np.append(self.steps, steps), np.append(self.on_tilt, on_tilt))
        half = len(both) // 2
        return both[:half, :half], both[half:, half:]

    def between(self, steps: np.ndarray, axis: int) -> Between:
        """Predict errors of an axis at counters (m,)."""
        different, which = np.unique(steps, return_inverse=True)
        count = len(self.steps)
        error, play = (
            part[count:][which]
            for part in self.factors_with(different.astype(float), np.full(len(different), axis == 1))
        )
        rests = (np.linalg.norm(part[:, count:], axis=1) for part in (error, play))
        return Between(error[:, :count], play[:, :count], *rests)

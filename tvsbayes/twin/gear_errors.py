"""Errors of true gears: of the output's angle and of the play by position, of the zero with time.

They are functions of an axis' angle, mean ratio x counter, in degrees, and fixed for a rig. They are written from
data/docs/formulation.md alone, independently of the estimators' covariances, so that a mistake in either is found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.conditions import TimedMove
from tvsbayes.instrument.parameters import PERIODS_MAX

FEATURES = 200
"""Number of waves in the sum of an error: given their lengths, its covariance is that of a Matern process to 1 part in
14, and exactly on average."""
MATERN_FREEDOM = 5
"""Frequencies of a Matern process of smoothness 5/2, times its length, have Student's t with 2 x 5/2 degrees of freedom
(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, 4.15: its spectral density)."""
SECONDS_PER_HOUR = 3600.0
ErrorFunction = Callable[[np.ndarray], np.ndarray]
"""Error in degrees at places (n,), in degrees of the output, or at hours (n,) since switching on."""


@dataclass(frozen=True, eq=False)
class Waves:
    """A sum of waves; 0 everywhere without waves.

    Attributes:
        rate_rad_per_deg: (m,) phase per degree of the output.
        cosine_deg, sine_deg: (m,) their parts.
    """

    rate_rad_per_deg: np.ndarray = field(default_factory=lambda: np.zeros(0))
    cosine_deg: np.ndarray = field(default_factory=lambda: np.zeros(0))
    sine_deg: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __call__(self, angle_deg: np.ndarray) -> np.ndarray:
        """Evaluate the sum at angles, in their shape."""
        # Campaigns return to few places, which are evaluated once: equal values, and little memory.
        places, at = np.unique(np.asarray(angle_deg, float), return_inverse=True)
        phase = np.multiply.outer(places, self.rate_rad_per_deg)
        values = np.sum(self.cosine_deg * np.cos(phase) + self.sine_deg * np.sin(phase), axis=-1)
        return values[at].reshape(np.shape(angle_deg))


@dataclass(frozen=True, eq=False)
class Tabulated:
    """An error tabulated at places (n,), linear between them and constant outside, read from a file."""

    angle_deg: np.ndarray
    error_deg: np.ndarray

    def __call__(self, angle_deg: np.ndarray) -> np.ndarray:
        """Evaluate the error at angles, in their shape; 0 for an empty table."""
        order = np.argsort(self.angle_deg)
        if not order.size:
            return np.zeros(np.shape(angle_deg))
        return np.interp(angle_deg, self.angle_deg[order], self.error_deg[order])


@dataclass(frozen=True, eq=False)
class AxisErrors:
    """Repeating errors of one axis.

    Attributes:
        error_deg: error of the output's angle, by place.
        play_deg: play less its mean, by place.
        warming_deg: error of the zero, by hours since switching on; a homing resets it.
    """

    error_deg: ErrorFunction = field(default_factory=Waves)
    play_deg: ErrorFunction = field(default_factory=Waves)
    warming_deg: ErrorFunction = field(default_factory=Waves)

    def play_at(self, backlash_deg: float, angle_deg: np.ndarray) -> np.ndarray:
        """Compute the width of the play at places (n,); it cannot be negative."""
        return np.maximum(backlash_deg + self.play_deg(angle_deg), 0.0)


GearErrors = Mapping[str, AxisErrors]
"""Errors by axis."""
PERFECT: GearErrors = {axis: AxisErrors() for axis in AXES}
"""Gears without repeating errors."""


def matern_waves(sd_deg: float, length_deg: float, rng: np.random.Generator) -> Waves:
    """Draw a Matern process of smoothness 5/2; the generator advances equally for any scales.

    Random Fourier features (Rahimi and Recht, NIPS 2007) with normal parts: Gaussian for given frequencies.
    """
    rate = rng.standard_t(MATERN_FREEDOM, FEATURES)
    parts = rng.standard_normal((2, FEATURES)) * (sd_deg / np.sqrt(FEATURES))
    return Waves(rate / length_deg, *parts) if sd_deg > 0 else Waves()


def draw_gear_errors(
    parameters: Mapping[str, float], period_deg: Mapping[str, tuple[float, ...]], rng: np.random.Generator
) -> GearErrors:
    """Draw errors of both axes with the scales of a true rig; a rig without scales has perfect gears.

    Args:
        parameters: parameters of the true rig, by contract name.
        period_deg: stated periods of each axis, in the order of `harmonic_amplitude_deg`.
        rng: generator, which advances equally for any scales.
    """
    errors: dict[str, AxisErrors] = {}
    for axis in AXES:
        length_deg = parameters.get(f"transmission_error_length_deg.{axis}", 1.0)
        error, width = (
            matern_waves(parameters.get(f"{name}.{axis}", 0.0), length_deg, rng)
            for name in ("transmission_error_deg", "play_variation_deg")
        )
        periods = np.array(period_deg.get(axis, ()), float)
        names = (f"harmonic_amplitude_deg.{axis}.{number}" for number in range(1, len(periods) + 1))
        # Waves of any phase: both parts are normal.
        parts = rng.standard_normal((2, PERIODS_MAX))[:, : len(periods)] * [parameters.get(name, 0.0) for name in names]
        waves = np.concatenate(
            [[error.rate_rad_per_deg, error.cosine_deg, error.sine_deg], [2 * np.pi / periods, *parts]], axis=1
        )
        errors[axis] = AxisErrors(Waves(*waves), width)
    return errors


def zero_shift_deg(
    parameters: Mapping[str, float], axis: str, warm_minutes: np.ndarray, kelvin: np.ndarray | float = 0.0
) -> np.ndarray:
    """Compute the shift of an axis' zero by creep during warm-up and by temperature.

    Args:
        parameters: parameters of the true rig; missing ones cause no shift.
        axis: "pan" or "tilt".
        warm_minutes: time since switching on, any shape.
        kelvin: temperature less the reference temperature of the zero.
    """
    creep = parameters.get(f"creep_deg.{axis}", 0.0), parameters.get("creep_minutes", 1.0)
    return zero_shift(*creep, warm_minutes, parameters.get(f"thermal_deg_per_K.{axis}", 0.0), kelvin)


def zero_shift(
    creep: float, creep_minutes: float, warm_minutes: np.ndarray | float, per_kelvin: float, kelvin: np.ndarray | float
) -> np.ndarray:
    """Compute the shift of any zero by creep and temperature, in the unit of `creep`."""
    still = np.exp(np.asarray(warm_minutes, float) / -creep_minutes)
    shift: np.ndarray = creep * (1.0 - still) + per_kelvin * kelvin
    return shift


def kelvin_of(moves: Sequence[TimedMove]) -> np.ndarray:
    """Return temperatures less the first, interpolated in time; 0 where fewer than two are recorded."""
    known = [m for m in moves if m.temperature_degC is not None]
    if len(known) < 2:
        return np.zeros(len(moves))
    degC = np.array([m.temperature_degC for m in known], float)
    if len(known) < len(moves):
        degC = np.interp([m.time_s for m in moves], [m.time_s for m in known], degC)
    return degC - degC[0]


def drift_deg(
    time_s: np.ndarray, first: np.ndarray, scale_deg_per_root_hour: float, draws: np.ndarray, warming_deg: ErrorFunction
) -> np.ndarray:
    """Compute the drift of the zero of one axis at each move (n,), 0 at every homing.

    Args:
        time_s: (n,) times of the moves, since switching on.
        first: (n,) True at the first row of a segment.
        scale_deg_per_root_hour: scale of the random walk.
        draws: (n,) standard normal numbers.
        warming_deg: see `AxisErrors`.
    """
    hours = np.asarray(time_s, float) / SECONDS_PER_HOUR
    step = scale_deg_per_root_hour * np.sqrt(np.diff(hours, prepend=hours[:1])) * draws
    warm = np.diff(warming_deg(hours), prepend=0.0)
    drift, at = np.empty(len(hours)), 0.0
    for row, change in enumerate(step + warm):
        drift[row] = at = 0.0 if first[row] else at + change
    return drift

"""Waves of known or unknown period in addition to the error by position: their settings and coordinates.

A wave is A cos(2 pi x / P - phase) with a second harmonic. x is the position |unit per command| x command, the time in
seconds, or the reading itself (a wave of the encoder). Cosines and sines are linear and have a normal prior of sd s;
the second harmonic has `SECOND` times s. s is half-normal, and with probability 1/2 there is no wave.
Turns of a gear differ slightly: cosine and sine of the first harmonic change over the record, linearly, by a normal
share of sd `WANDER` of s at its ends. Without this the uncertainty of a period would be too small for real gears.

The posterior has many peaks in s and P. Their coordinates with a standard normal prior are quantiles of tables close to
their posterior (`period_search`), and the ratio of prior to table is part of the density. The draws therefore have
exact weights for any tables. Without a wave its period follows its table (pseudo-prior: Carlin and Chib, J. R. Stat.
Soc. B 57 (1995) 473). Periods in the unit of their clock. NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial, log, pi
from typing import Literal

import numpy as np

Clock = Literal["position", "seconds", "encoder"]
SECOND = 0.25
"""sd of the second harmonic's cosine and sine over that of the first: with a larger value, a wave of twice the period
would explain the data nearly as well, by its second harmonic alone."""
WAVE_PRIOR = 0.5
"""Prior probability of a wave."""
WANDER = 0.1
"""sd of the change of the first harmonic's cosine and sine at an end of the record, relative to s."""
SHARES = (1.0, 1.0, SECOND, SECOND, WANDER, WANDER)
"""sds of a wave's columns relative to s."""
COLUMNS = len(SHARES)
"""Number of columns: cosine and sine of both harmonics, then of the change of the first."""
SCALE_RANGE = (1e-4, 4.0)
"""Range of s relative to the scale of its half-normal prior, which has 1e-4 of its probability outside."""


@dataclass(frozen=True)
class WavePeriods:
    """Periods of `[axis]`.

    Attributes:
        stated: known periods.
        between: ranges of unknown periods, each low and high; two ranges are identical or do not overlap.
        in_seconds: whether both are in time; else in position, unit of the readings.
        encoder: period of the encoder's own wave, unit of the readings; None without it.
    """

    stated: tuple[float, ...] = ()
    between: tuple[tuple[float, float], ...] = ()
    in_seconds: bool = False
    encoder: float | None = None

    def __bool__(self) -> bool:
        return bool(self.stated or self.between or self.encoder is not None)

    def entries(self) -> dict[str, object]:
        """The entries of `[axis]`."""
        return {
            "periods": list(self.stated),
            "periods_in": "seconds" if self.in_seconds else None,
            "period_between": [list(pair) for pair in self.between],
            "encoder_period": self.encoder,
        }

    @property
    def shortest(self) -> float | None:
        """Shortest of the gear's periods; None without any."""
        return min((*self.stated, *(low for low, _ in self.between)), default=None)


@dataclass(frozen=True)
class TabulatedDensity:
    """A density that is linear between nodes.

    Attributes:
        at: nodes, ascending, shape (nodes,).
        density: density at the nodes, positive, with integral 1.
    """

    at: np.ndarray
    density: np.ndarray

    @classmethod
    def of(cls, at: np.ndarray, log_density: np.ndarray, floor: float) -> TabulatedDensity:
        """A density proportional to exp(log_density), plus a uniform part with the probability `floor`."""
        density = np.exp(log_density - log_density.max())
        density = (1 - floor) * density / np.trapezoid(density, at) + floor / np.ptp(at)
        return cls(at, density / np.trapezoid(density, at))

    @property
    def _below(self) -> np.ndarray:
        """Probability below every node."""
        parts = 0.5 * (self.density[1:] + self.density[:-1]) * np.diff(self.at)
        return np.concatenate(([0.0], np.cumsum(parts)))

    def quantile(self, share: np.ndarray) -> np.ndarray:
        """Quantiles at probabilities `share`, any shape."""
        below = self._below
        k = np.clip(np.searchsorted(below, share, side="right") - 1, 0, len(self.at) - 2)
        rest = np.clip(share, 0.0, below[-1]) - below[k]
        start = self.density[k]
        slope = (self.density[k + 1] - start) / (self.at[k + 1] - self.at[k])
        # The root of start t + slope t^2 / 2 = rest in the form that is valid for slope 0 too.
        step = 2 * rest / (start + np.sqrt(np.maximum(start**2 + 2 * slope * rest, 0.0)))
        return self.at[k] + np.clip(step, 0.0, self.at[k + 1] - self.at[k])

    def share(self, x: float) -> float:
        """Probability below x."""
        k = int(np.clip(np.searchsorted(self.at, x, side="right") - 1, 0, len(self.at) - 2))
        density_at = np.interp(x, self.at, self.density)
        return float(self._below[k] + 0.5 * (self.density[k] + density_at) * (x - self.at[k]))

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Log density at x, any shape, inside the nodes."""
        return np.log(np.interp(x, self.at, self.density))


def log_scale_prior(log_scale: np.ndarray, unit: float) -> np.ndarray:
    """Log density of log s, half-normal by `unit`."""
    return 0.5 * log(2 / pi) + log_scale - np.log(unit) - 0.5 * np.exp(2 * (log_scale - np.log(unit)))


@dataclass(frozen=True)
class Wave:
    """One wave of the model.

    Attributes:
        clock: clock of its period.
        low, high: range of the period; equal where it is stated and its clock is known exactly.
        unit: scale of the half-normal prior of s, in the unit of the readings, > 0.
        log_scale: table of log s, given that the wave exists.
        log_period: table of the log of the period; None where it is fixed.
        absent: share of the coordinate's probability for no wave.
        peak: period with the largest evidence.
        known: the stated period; None for an unknown one.
    """

    clock: Clock
    low: float
    high: float
    unit: float
    log_scale: TabulatedDensity
    log_period: TabulatedDensity | None
    absent: float
    peak: float
    known: float | None = None

    @classmethod
    def fixed(cls, clock: Clock, period: float, unit: float) -> Wave:
        """A wave of one period, before any search."""
        low, high = (log(end * unit) for end in SCALE_RANGE)
        at = np.linspace(low, high, 200)
        table = TabulatedDensity.of(at, 0.3 * np.maximum(log_scale_prior(at, unit), -20.0), 0.5)
        return cls(clock, period, period, unit, table, None, 0.05, period)

    @property
    def is_fixed(self) -> bool:
        """Whether the period has no coordinate."""
        return self.low == self.high


@dataclass(frozen=True)
class WaveDraws:
    """One wave at draws: arrays (n,).

    Attributes:
        scale: s; 0 where the wave is absent.
        period: in the unit of its clock; shape (1,) where it is stated.
        log_prior: log density of its coordinates relative to the standard normal.
    """

    scale: np.ndarray
    period: np.ndarray
    log_prior: np.ndarray


def wave_draws(wave: Wave, scale_coordinate: np.ndarray, period_coordinate: np.ndarray | None) -> WaveDraws:
    """One wave at coordinates of its scale (n,) and of its period (n,), None where it is stated."""
    from scipy.special import ndtr

    share = ndtr(scale_coordinate)
    present = share > wave.absent
    log_scale = wave.log_scale.quantile(np.clip((share - wave.absent) / (1 - wave.absent), 0.0, 1.0))
    prior = np.where(present, log(WAVE_PRIOR / (1 - wave.absent)), log((1 - WAVE_PRIOR) / max(wave.absent, 1e-300)))
    correction = log_scale_prior(log_scale, wave.unit) - wave.log_scale.log_density(log_scale)
    period = np.array([wave.low])
    if period_coordinate is not None and wave.log_period is not None:
        log_period = wave.log_period.quantile(ndtr(period_coordinate))
        period = np.exp(log_period)
        correction = correction - log(log(wave.high / wave.low)) - wave.log_period.log_density(log_period)
    return WaveDraws(np.where(present, np.exp(log_scale), 0.0), period, prior + np.where(present, correction, 0.0))


def absent_coord(wave: Wave) -> float:
    """Coordinate of a wave's scale at which the wave is absent."""
    from scipy.special import ndtri

    return float(ndtri(0.5 * wave.absent))


def names_of(waves: Sequence[Wave]) -> tuple[str, ...]:
    """Coordinates of the waves, in order."""
    names = []
    for k, wave in enumerate(waves, start=1):
        names += [f"wave_scale.{k}", *([] if wave.is_fixed else [f"wave_period.{k}"])]
    return tuple(names)


def start_coordinate(wave: Wave, name: str) -> float:
    """Start coordinate of a search for the mode."""
    from scipy.special import ndtri

    if name.startswith("wave_scale") or wave.log_period is None:
        return float(ndtri(wave.absent + 0.5 * (1 - wave.absent)))
    return float(ndtri(np.clip(wave.log_period.share(log(wave.peak)), 1e-6, 1 - 1e-6)))


def log_order(waves: Sequence[Wave], draws: Sequence[WaveDraws]) -> np.ndarray:
    """Log prior (n or 1,) of the order of waves that share one range, since their numbering is a convention.

    If m of K waves are present, these are the first m, each nearest to its own peak among the rest; such an order
    represents K! / (K - m)! equivalent ones. -inf for all others.
    """
    order = np.zeros(1)
    by_range: dict[tuple[float, float, Clock], list[int]] = {}
    for k, wave in enumerate(waves):
        if wave.known is None and not wave.is_fixed:
            by_range.setdefault((wave.low, wave.high, wave.clock), []).append(k)
    for group in by_range.values():
        if len(group) < 2:
            continue
        present = np.array([draws[k].scale > 0 for k in group])
        count = present.sum(axis=0)
        allowed = np.all(present[:-1] | ~present[1:], axis=0)
        for row, k in enumerate(group):
            distance = np.abs(np.log(draws[k].period / waves[k].peak))
            for other, j in enumerate(group[row + 1 :], start=row + 1):
                nearer = distance <= np.abs(np.log(draws[j].period / waves[k].peak))
                allowed &= nearer | ~present[other] | ~present[row]
        log_orders = np.array([log(factorial(len(group)) / factorial(len(group) - m)) for m in range(len(group) + 1)])
        order = order + np.where(allowed, log_orders[count], -np.inf)
    return order


@dataclass(frozen=True)
class WaveRecord:
    """Range of the readings on the clock of a wave: its middle and half-width."""

    middle: float
    half: float

    @classmethod
    def of(cls, x: np.ndarray) -> WaveRecord:
        """The range of clock values (rows,)."""
        return cls(0.5 * float(np.min(x) + np.max(x)), 0.5 * float(np.ptp(x)) or 1.0)


def wave_columns(x: np.ndarray, period: np.ndarray, record: WaveRecord, width: np.ndarray | float = 0.0) -> np.ndarray:
    """A wave's columns (`COLUMNS`), averaged over `width` about x: shape (n, rows, columns).

    Args:
        x: shape (rows,).
        period: shape (n,).
        record: range over which the wave changes.
        width: averaging width of every row, shape (rows,).
    """
    turn = x[None] / period[:, None]
    turn = 2 * pi * (turn - np.round(turn))
    cosine, sine = np.cos(turn), np.sin(turn)
    second = [cosine**2 - sine**2, 2 * sine * cosine]
    if np.any(width):
        half = np.maximum(pi * np.asarray(width)[None] / period[:, None], 1e-9)
        factor = np.sin(half) / half
        cosine, sine = cosine * factor, sine * factor
        # sin 2x / 2x = cos x sin x / x.
        factor = factor * np.cos(half)
        second = [column * factor for column in second]
    position = ((x - record.middle) / record.half)[None]
    return np.stack([cosine, sine, *second, position * cosine, position * sine], axis=-1)

"""Errors of the gears at counters without looks, drawn given a fit's draws at the counters seen.

Transmission error e and change of play d are Gaussian processes of the output's angle k n (formulation 3.1). Every draw
has its own values at the places, scales and lengths: its table is the conditional mean of the processes plus a draw of
the conditional deviation. deg, steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from tvsbayes.calibration.gear_table import NO_GEARS, GearTable, regular_counters
from tvsbayes.calibration.optics import ERROR_AT, PLAY_AT
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.axes import AXES, Axis
from tvsbayes.instrument.parameters import PERIODS_MAX
from tvsbayes.model.gear_processes import FLOOR_RAD2
from tvsbayes.model.headlines import DEGREES
from tvsbayes.statistics.gaussian_process import JITTER, repeated
from tvsbayes.statistics.streams import Stream, random_stream

MARGIN_LENGTHS = 3.0
"""Correlation lengths by which a table extends beyond the counters seen: the correlation with them is 3 % there."""
COUNTERS_PER_LENGTH = 4.0
"""Counters of a table per correlation length: cubic interpolation has an RMS error of 1.2 % of the sd."""
BLOCK = 256
"""Draws whose covariances are in memory at once."""


@dataclass(frozen=True)
class DrawnGears:
    """Columns of a table, a row for every draw, deg.

    Attributes:
        table: its counters.
        expected: means given the errors at the places, shape (draws, table.size).
        left_open: drawn conditional deviations, same shape; the sum of both is the draw.
        by_places: d(expected)/d(errors at the places, in units of N(0, 1) a priori), at the fit's own scales, shape
            (table.size, errors).
    """

    table: GearTable
    expected: np.ndarray
    left_open: np.ndarray
    by_places: np.ndarray


@dataclass(frozen=True)
class Process:
    """Scales of one error of one axis by draw.

    Attributes:
        sd, length: shapes (draws,); deg.
        amplitudes: sds of the parts of stated period, shape (draws, periods).
        periods: stated periods, deg.
    """

    sd: np.ndarray
    length: np.ndarray
    amplitudes: np.ndarray
    periods: tuple[float, ...] = ()

    def covariance(self, angle_deg: np.ndarray) -> np.ndarray:
        """Compute the covariance of values at angles (draws, n): shape (draws, n, n), deg^2."""
        distance = angle_deg[:, :, None] - angle_deg[:, None, :]
        sd, length, *amplitudes = (x[:, None, None] for x in (self.sd, self.length, *self.amplitudes.T))
        covariance = repeated(distance, sd, length, zip(amplitudes, self.periods, strict=True))
        # Plays get the floor too, as draws may have none; `place_root` instead scales the factor.
        floor = JITTER * self.variance + FLOOR_RAD2 * DEGREES**2
        return covariance + floor[:, None, None] * np.eye(angle_deg.shape[1])

    @property
    def variance(self) -> np.ndarray:
        """Compute the variance of a value, shape (draws,), deg^2."""
        return self.sd**2 + np.sum(self.amplitudes**2, axis=1)

    def __getitem__(self, chosen: slice) -> Process:
        return Process(self.sd[chosen], self.length[chosen], self.amplitudes[chosen], self.periods)

    def without(self, number: int) -> Process:
        """Return the process without one of its parts of stated period."""
        amplitudes = self.amplitudes.copy()
        amplitudes[:, number] = 0.0
        return Process(self.sd, self.length, amplitudes, self.periods)


@dataclass(frozen=True)
class Conditional:
    """Values at new angles: conditional means given those at places, and conditional deviations; shapes (draws, n)."""

    expected: np.ndarray
    left_open: np.ndarray


def conditional(
    process: Process, seen_deg: np.ndarray, values: np.ndarray, new_deg: np.ndarray, normal: np.ndarray
) -> Conditional:
    """Draw a process at new angles given its values at places (Rasmussen and Williams 2.19, by one Cholesky factor).

    Args:
        process: scales by draw.
        seen_deg: angles of the places, shape (draws, p).
        values: values at the places, shape (draws, p).
        new_deg: new angles, shape (draws, n).
        normal: standard normal numbers for the deviations, shape (draws, n).
    """
    expected, left_open = np.empty(new_deg.shape), np.empty(new_deg.shape)
    count = seen_deg.shape[1]
    for begin in range(0, len(values), BLOCK):
        rows = slice(begin, begin + BLOCK)
        root = np.linalg.cholesky(process[rows].covariance(np.concatenate([seen_deg[rows], new_deg[rows]], axis=1)))
        whitened = np.linalg.solve(root[:, :count, :count], values[rows, :, None])
        expected[rows] = (root[:, count:, :count] @ whitened)[..., 0]
        left_open[rows] = (root[:, count:, count:] @ normal[rows, :, None])[..., 0]
    return Conditional(expected, left_open)


def seen_places(fit: JointFit) -> dict[Axis, np.ndarray]:
    """Return the indices of each axis' places among those of the fit."""
    places = fit.arrays.gears.places
    valid, on_tilt = np.asarray(places.valid), np.asarray(places.on_tilt)
    return {axis: np.flatnonzero(valid & (on_tilt == (axis == AXES[1]))) for axis in AXES}


def process_of(fit: JointFit, physical: np.ndarray, kind: str, axis: Axis) -> Process:
    """Return the scales of `ERROR_AT` or `PLAY_AT` of an axis from draws (n, parameters)."""
    index = fit.space.mechanism.index
    length = physical[:, index[f"transmission_error_length_deg.{axis}"]]
    if kind == PLAY_AT:
        return Process(physical[:, index[f"play_variation_deg.{axis}"]], length, np.zeros((len(physical), 0)))
    periods = np.ravel(fit.campaign.rig.harmonic_period_deg.get(axis, ())).tolist()[:PERIODS_MAX]
    columns = [index[f"harmonic_amplitude_deg.{axis}.{k + 1}"] for k in range(len(periods))]
    return Process(physical[:, index[f"transmission_error_deg.{axis}"]], length, physical[:, columns], tuple(periods))


def _table(physical: np.ndarray, seen_steps: Mapping[str, np.ndarray], index: Mapping[str, int]) -> GearTable:
    """Choose regular counters around those seen, by the draws' median lengths."""
    columns = []
    for axis in AXES:
        length = float(np.median(physical[:, index[f"transmission_error_length_deg.{axis}"]]))
        steps = length / abs(float(np.median(physical[:, index[f"degrees_per_step.{axis}"]])))
        low, high = float(seen_steps[axis].min()), float(seen_steps[axis].max())
        reach = MARGIN_LENGTHS * steps
        nodes = regular_counters(low - reach, high + reach, steps / COUNTERS_PER_LENGTH)
        columns.append(tuple(nodes.tolist()))
    return GearTable((columns[0], columns[1]))


def drawn_gears(
    fit: JointFit, physical: np.ndarray, place_errors_rad: np.ndarray, seed: int, own_scales: bool = True
) -> DrawnGears:
    """Draw tables of the gears' errors.

    Args:
        fit: fit of the campaign with these places.
        physical: draws in the units of the names, shape (n, parameters).
        place_errors_rad: their transmission errors at the places, then the plays, shape (n, errors).
        seed: seed of the conditional deviations.
        own_scales: whether the errors at places were drawn at their own scales, else at those of the fit's mode.

    Returns:
        Columns as a calibration stores them; none without repeating errors.
    """
    count, errors = place_errors_rad.shape
    if not errors:
        none = np.zeros((count, 0))
        return DrawnGears(NO_GEARS, none, none, np.zeros((0, 0)))
    steps, seen_of = np.asarray(fit.arrays.gears.places.steps), seen_places(fit)
    index = fit.space.mechanism.index
    table = _table(physical, {axis: steps[seen_of[axis]] for axis in AXES}, index)
    # The derivative of the table by the places at the fit's scales, these in units in which they are N(0, 1) a priori.
    mode = np.asarray(fit.mode.physical)
    root = fit.arrays.gears.at_places(np.asarray(fit.linearised.place_root).T * DEGREES).T
    generator = random_stream(seed, Stream.GEAR_TABLES)
    expected, left_open = np.zeros((count, table.size)), np.zeros((count, table.size))
    by_places = np.zeros((table.size, root.shape[1]))
    for kind, axis in product((ERROR_AT, PLAY_AT), AXES):
        part, at = table.parts[f"{kind}.{axis}"], seen_of[axis] + (0 if kind == ERROR_AT else errors // 2)
        known, new = steps[seen_of[axis]], np.array(table.steps[AXES.index(axis)])
        normal = generator.standard_normal((count, len(new) + 1))
        process, ratio = process_of(fit, physical, kind, axis), physical[:, index[f"degrees_per_step.{axis}"], None]
        values = place_errors_rad[:, at] * DEGREES
        drawn = conditional(process, ratio * known, values, ratio * new, normal[:, :-1])
        own_ratio = float(mode[index[f"degrees_per_step.{axis}"]])
        follows = _following(process_of(fit, mode[None], kind, axis), own_ratio * known, own_ratio * new)
        inner = slice(part.start, part.stop - 1)
        by_places[inner] = follows @ root[at]
        expected[:, inner] = drawn.expected if own_scales else values @ follows.T
        left_open[:, inner] = drawn.left_open
        left_open[:, part.stop - 1] = np.sqrt(process.variance) * normal[:, -1]
    # Unknown deviations must not shift the mean.
    return DrawnGears(table, expected, left_open - left_open.mean(axis=0), by_places)


def _following(process: Process, seen_deg: np.ndarray, new_deg: np.ndarray) -> np.ndarray:
    """Compute the weights of the values at places in the means at new angles: shape (new, seen)."""
    covariance = process.covariance(np.concatenate([seen_deg, new_deg])[None])[0]
    count = len(seen_deg)
    return np.linalg.solve(covariance[:count, :count], covariance[:count, count:]).T

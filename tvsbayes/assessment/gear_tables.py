"""Errors of the gears at counters that nobody saw, drawn given what a fit's draws hold at the counters seen.

Transmission error e and change of play d are Gaussian processes of the output's angle k n (formulation 3.1). Every draw
has values of its own at the places, scales and lengths of its own: its table is the mean of the processes there plus
what the places leave open. deg, steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.gear_table import NO_GEARS, GearTable, regular_counters
from tvsbayes.calibration.optics import ERROR_AT
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.axes import AXES, Axis
from tvsbayes.instrument.parameters import INDEX, PERIODS_MAX
from tvsbayes.model.gear_processes import FLOOR_RAD2
from tvsbayes.model.headlines import DEGREES
from tvsbayes.statistics.gaussian_process import JITTER, repeated
from tvsbayes.statistics.streams import Stream, random_stream

MARGIN_LENGTHS = 3.0
"""A table reaches as many correlation lengths beyond the counters seen: 97 % of a process has forgotten them there."""
COUNTERS_PER_LENGTH = 4.0
"""Cubic interpolation between them errs by 1.2 % of the sd (root mean square)."""
BLOCK = 256
"""Draws whose covariances are held at once."""


@dataclass(frozen=True)
class DrawnGears:
    """Columns of a table, a row for every draw, deg.

    Attributes:
        table: its counters.
        expected: means given the errors at the places, shape (draws, table.size).
        left_open: what those leave open, drawn, likewise; the sum of both is the draw.
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
        periods: deg.
    """

    sd: np.ndarray
    length: np.ndarray
    amplitudes: np.ndarray
    periods: tuple[float, ...] = ()

    def covariance(self, angle_deg: np.ndarray) -> np.ndarray:
        """Of values at angles (draws, n): shape (draws, n, n), deg^2."""
        distance = angle_deg[:, :, None] - angle_deg[:, None, :]
        sd, length, *amplitudes = (x[:, None, None] for x in (self.sd, self.length, *self.amplitudes.T))
        covariance = repeated(distance, sd, length, zip(amplitudes, self.periods, strict=True))
        # Of plays too, which `place_root` scales after their factor: draws may have none.
        floor = JITTER * self.variance + FLOOR_RAD2 * DEGREES**2
        return covariance + floor[:, None, None] * np.eye(angle_deg.shape[1])

    @property
    def variance(self) -> np.ndarray:
        """Of a value anywhere, shape (draws,), deg^2."""
        return self.sd**2 + np.sum(self.amplitudes**2, axis=1)

    def __getitem__(self, chosen: slice) -> Process:
        return Process(self.sd[chosen], self.length[chosen], self.amplitudes[chosen], self.periods)

    def without(self, number: int) -> Process:
        """The process without one of its parts of stated period."""
        amplitudes = self.amplitudes.copy()
        amplitudes[:, number] = 0.0
        return Process(self.sd, self.length, amplitudes, self.periods)


@dataclass(frozen=True)
class Conditional:
    """Values at new angles: means given those at places, and what is left open; shapes (draws, n)."""

    expected: np.ndarray
    left_open: np.ndarray


def conditional(
    process: Process, seen_deg: np.ndarray, values: np.ndarray, new_deg: np.ndarray, normal: np.ndarray
) -> Conditional:
    """A process at new angles given its values at places (Rasmussen and Williams 2.19, by one Cholesky factor).

    Args:
        process: scales by draw.
        seen_deg: angles of the places, shape (draws, p).
        values: there, shape (draws, p).
        new_deg: shape (draws, n).
        normal: standard normal numbers for what is left open, shape (draws, n).
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


def _axis(name: str) -> Axis:
    """Of one of `GEAR_INPUTS`."""
    return AXES[0] if name.endswith(AXES[0]) else AXES[1]


def stated_periods(fit: JointFit, axis: Axis) -> tuple[float, ...]:
    """Periods of an axis that the rig states, deg."""
    return tuple(np.ravel(fit.campaign.rig.harmonic_period_deg.get(axis, ())).tolist())


def seen_places(fit: JointFit) -> dict[Axis, np.ndarray]:
    """Numbers of each axis' places among those of the fit."""
    places = fit.arrays.gears.places
    valid, on_tilt = np.asarray(places.valid), np.asarray(places.on_tilt)
    return {axis: np.flatnonzero(valid & (on_tilt == (axis == AXES[1]))) for axis in AXES}


def process_of(physical: np.ndarray, name: str, periods: tuple[float, ...]) -> Process:
    """Scales of one of `GEAR_INPUTS`, of draws (n, parameters)."""
    axis = _axis(name)
    length = physical[:, INDEX[f"transmission_error_length_deg.{axis}"]]
    if not name.startswith(ERROR_AT):
        return Process(physical[:, INDEX[f"play_variation_deg.{axis}"]], length, np.zeros((len(physical), 0)))
    columns = [INDEX[f"harmonic_amplitude_deg.{axis}.{k + 1}"] for k in range(min(len(periods), PERIODS_MAX))]
    sd = physical[:, INDEX[f"transmission_error_deg.{axis}"]]
    return Process(sd, length, physical[:, columns], periods[: len(columns)])


def _table(physical: np.ndarray, seen_steps: Mapping[str, np.ndarray]) -> GearTable:
    """Regular counters around those seen, by the draws' middle lengths."""
    columns = []
    for axis in AXES:
        length = float(np.median(physical[:, INDEX[f"transmission_error_length_deg.{axis}"]]))
        steps = length / abs(float(np.median(physical[:, INDEX[f"degrees_per_step.{axis}"]])))
        low, high = float(seen_steps[axis].min()), float(seen_steps[axis].max())
        reach = MARGIN_LENGTHS * steps
        nodes = regular_counters(low - reach, high + reach, steps / COUNTERS_PER_LENGTH)
        columns.append(tuple(nodes.tolist()))
    return GearTable((columns[0], columns[1]))


def drawn_gears(
    fit: JointFit, physical: np.ndarray, place_errors_rad: np.ndarray, seed: int, own_scales: bool = True
) -> DrawnGears:
    """Tables of draws.

    Args:
        fit: whose campaign the places are of.
        physical: draws in the units of the names, shape (n, parameters).
        place_errors_rad: with them the transmission errors at the places, then the plays, shape (n, errors).
        seed: of what the places leave open.
        own_scales: the errors at places were drawn at the scales of their own draws, else at those of the fit's mode.

    Returns:
        Columns as a calibration keeps them; none where gears do not vary.
    """
    count, errors = place_errors_rad.shape
    if not errors:
        none = np.zeros((count, 0))
        return DrawnGears(NO_GEARS, none, none, np.zeros((0, 0)))
    steps, seen_of = np.asarray(fit.arrays.gears.places.steps), seen_places(fit)
    table = _table(physical, {axis: steps[seen_of[axis]] for axis in AXES})
    # The fit's own scales too: how its table follows the places, in units in which they are N(0, 1) a priori.
    mode, root = np.asarray(fit.mode.physical), np.asarray(fit.linearised.place_root) * DEGREES
    generator = random_stream(seed, Stream.GEAR_TABLES)
    expected, left_open = np.zeros((count, table.size)), np.zeros((count, table.size))
    by_places = np.zeros((table.size, errors))
    for name, part in table.parts.items():
        axis = _axis(name)
        at = seen_of[axis] + (0 if name.startswith(ERROR_AT) else errors // 2)
        periods = stated_periods(fit, axis)
        known, new = steps[seen_of[axis]], np.array(table.steps[AXES.index(axis)])
        normal = generator.standard_normal((count, len(new) + 1))
        process, ratio = process_of(physical, name, periods), physical[:, INDEX[f"degrees_per_step.{axis}"], None]
        values = place_errors_rad[:, at] * DEGREES
        drawn = conditional(process, ratio * known, values, ratio * new, normal[:, :-1])
        own_ratio = float(mode[INDEX[f"degrees_per_step.{axis}"]])
        follows = _following(process_of(mode[None], name, periods), own_ratio * known, own_ratio * new)
        inner = slice(part.start, part.stop - 1)
        by_places[inner] = follows @ root[at]
        expected[:, inner] = drawn.expected if own_scales else values @ follows.T
        left_open[:, inner] = drawn.left_open
        left_open[:, part.stop - 1] = np.sqrt(process.variance) * normal[:, -1]
    # What nobody knows moves no estimate.
    return DrawnGears(table, expected, left_open - left_open.mean(axis=0), by_places)


def _following(process: Process, seen_deg: np.ndarray, new_deg: np.ndarray) -> np.ndarray:
    """How means at new angles follow the values at places: shape (new, seen)."""
    covariance = process.covariance(np.concatenate([seen_deg, new_deg])[None])[0]
    count = len(seen_deg)
    return np.linalg.solve(covariance[:count, :count], covariance[:count, count:]).T

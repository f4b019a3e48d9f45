"""The density of an axis' readings: linear quantities are integrated out exactly, for many draws of the scales at once.

A reading = offset + unit per command x command + contrast + position in the play x (backlash + its variation) / 2
+ error by position + waves + creep + thermal shift + drift + stop error + errors that the reference's readings share
+ noise (formulation 8.1). A position is the reading less the reference's errors, which functionals leave out. A Kalman
filter of two states (drift, held stop error) over the rows whitens the columns of all other terms; its cost is linear
in the rows. For a drive at constant rate time and position are equivalent: no error by position, and seeing in place of
stop errors. NumPy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tvsbayes.gears.kalman import whitened
from tvsbayes.gears.places import ProcessPlaces
from tvsbayes.gears.states import HOUR_S, crept, scatter_covariances
from tvsbayes.single_axis.axis_parameters import AxisCoordinates, AxisPrior
from tvsbayes.single_axis.axis_rows import AxisRows, PlayPlaces, legs_are_long, play_places, reversal_of
from tvsbayes.single_axis.waves import COLUMNS, SHARES, Wave, WaveRecord, wave_columns
from tvsbayes.statistics.gaussian_process import JITTER, matern52
from tvsbayes.statistics.linear_posterior import LinearPosterior
from tvsbayes.statistics.predicted_readings import PredictedReadings

OFFSET_TRAVELS = 1.0
"""sd of the offset's prior about the least-squares line, in travels: nearly flat."""
FLOOR = 1e-7
"""Least scatter of a row as a share of the travel: readings that repeat exactly were rounded."""
FARTHEST = 12.0
"""Coordinates beyond it have density 0: a standard normal variable exceeds it once in 1e32."""
BLOCK_NUMBERS_MAX = 8_000_000
"""Largest number of values in a block of draws."""
OFFSET, SLOPE, CONTRAST, BACKLASH = 0, 1, 2, 3
"""Indices of the first columns, the terms of the line and the backlash."""
LINE_COLUMNS = {"offset": OFFSET, "per_command": SLOPE, "ratio_contrast": CONTRAST, "backlash": BACKLASH}


class Likelihood(NamedTuple):
    """Log density (n,) at many coordinates, and the posterior of the requested functionals, in place of columns."""

    log_density: np.ndarray
    linear: LinearPosterior


def averaged_variance(duration: np.ndarray) -> np.ndarray:
    """Variance of the mean of an exponentially correlated process over its own; `duration` is in correlation times."""
    ratio = np.maximum(duration, 1e-3)
    return np.where(duration > 1e-3, 2 / ratio * (1 + np.expm1(-ratio) / ratio), 1.0 - duration / 3)


def reading_variance(values: Mapping[str, np.ndarray], variance: np.ndarray, rows: AxisRows) -> np.ndarray:
    """Variances (n, r) of readings with stated ones (r,)."""
    return np.outer(values["reading_scale"] ** 2, variance) + (FLOOR * rows.travel) ** 2


def stop_variance(values: Mapping[str, np.ndarray], side: np.ndarray) -> np.ndarray:
    """Variances (n, r) of errors of stops reached from sides (r,)."""
    forward = 0.5 * (1.0 + side)
    stop = np.outer(values["stop_sd.forward"] ** 2, forward)
    return stop + np.outer(values["stop_sd.backward"] ** 2, 1.0 - forward)


def noise_covariances(
    values: Mapping[str, np.ndarray],
    rows: AxisRows,
    zero: np.ndarray,
    stop: np.ndarray,
    hours: np.ndarray,
    side: np.ndarray,
    variance: np.ndarray,
) -> dict[str, np.ndarray]:
    """Covariances (n, r, r) by cause of what does not repeat, at the scales of n draws; further arguments are (r,).

    Args:
        values: values of all scales, each (n,).
        rows: the axis.
        zero: numbers of the homings.
        stop: numbers of the stops.
        hours: times since the homings.
        side: sides from which the stops were reached.
        variance: variances of the readings by their stated u.
    """
    scales, stops = (values["home_sd"], values["drift_per_root_hour"]), stop_variance(values, side)
    return scatter_covariances(scales, stops, reading_variance(values, variance, rows), hours, zero, stop)


class _Block(NamedTuple):
    """Products of a block of draws.

    Attributes:
        products: products of whitened readings and columns, shape (n, 1 + columns, 1 + columns).
        log_scatter: log-determinant of the innovations, shape (n,).
        factor: factor of the prior covariance, shape (n, columns, columns).
    """

    products: np.ndarray
    log_scatter: np.ndarray
    factor: np.ndarray


@dataclass(frozen=True)
class AxisModel:
    """Rows with priors and the coordinates of the sampled parameters.

    Attributes:
        rows: averaged readings.
        priors: prior of every key of `[axis]`.
        coordinates: coordinates of the sampled parameters, with those of the waves.
        places: places of the processes.
        unknown_segments: numbers of segments with rows whose position in the play is unknown.
    """

    rows: AxisRows
    priors: dict[str, AxisPrior]
    coordinates: AxisCoordinates
    places: ProcessPlaces
    unknown_segments: tuple[int, ...]

    @classmethod
    def of(
        cls,
        rows: AxisRows,
        priors: Mapping[str, AxisPrior],
        more: np.ndarray | None = None,
        waves: Sequence[Wave] = (),
    ) -> AxisModel:
        """The model of rows and complete priors.

        Args:
            rows: averaged readings.
            priors: from `axis_priors`.
            more: further commands at which the processes will be evaluated.
            waves: waves of the model.
        """
        in_motion = rows.in_motion
        unused = {
            "creep_minutes": _is_zero(priors["creep"]) or not _creeps(rows),
            "stop_sd.forward": in_motion or not np.any(rows.side >= 0),
            "stop_sd.backward": in_motion or not np.any(rows.side <= 0),
            "seeing_scale": not in_motion,
            "seeing_s": not in_motion,
            # At constant rate an error by position is a function of time and therefore part of the drift. Averaged
            # readings hardly separate white noise from seeing: noise is as stated, excess counts as seeing.
            "transmission_error": in_motion,
            "play_variation": in_motion,
            "transmission_error_length": in_motion
            or (_is_zero(priors["transmission_error"]) and _is_zero(priors["play_variation"])),
            "reading_scale": in_motion or not np.any(rows.variance > 0),
            "home_sd": len(np.unique(rows.zero)) < 2,
            "drift_per_root_hour": not np.any(rows.hours > 0),
            "backlash": legs_are_long(rows),
        }
        coordinates = AxisCoordinates.of(
            priors, frozenset(name for name, is_unused in unused.items() if is_unused), waves
        )
        spread = play_places(rows, np.array([rows.travel])).spread[0]
        begun = rows.legs.first & (rows.legs.side == 0)
        unknown = [int(k) for k in rows.legs.segment[begun] if np.any(spread[rows.segment == k] > 0)]
        command = rows.command[:0] if in_motion else rows.command
        places = ProcessPlaces.of(command, np.zeros(0) if more is None else more)
        return cls(rows, dict(priors), coordinates, places, tuple(unknown))

    @cached_property
    def homed(self) -> np.ndarray:
        """Numbers of the zeros that have readings, without the first."""
        return np.unique(self.rows.zero)[1:]

    @property
    def play_is_sampled(self) -> bool:
        """Whether stops may lie inside the play, which makes the backlash nonlinear."""
        return "backlash" in self.coordinates.names

    @property
    def middle(self) -> float:
        """The command to which the offset belongs."""
        return float(self.rows.command.mean())

    @cached_property
    def shifts(self) -> tuple[str, ...]:
        """Shifts of the zero in time that have a column: `creep`, `thermal_per_K`."""
        there = {"creep": _creeps(self.rows), "thermal_per_K": self.rows.kelvin is not None}
        return tuple(name for name, recorded in there.items() if recorded and not _is_zero(self.priors[name]))

    @cached_property
    def layout(self) -> dict[str, slice]:
        """Columns by what they are; those of the processes are in the order of the places."""
        places = len(self.places.command)
        sizes = {"line": len(LINE_COLUMNS), "homed": len(self.homed), "unknown": len(self.unknown_segments)}
        sizes |= {"shifts": len(self.shifts), "waves": COLUMNS * len(self.coordinates.waves)}
        sizes |= {"reference": len(self.rows.reference_causes), "error": places, "play": places}
        ends = np.cumsum(list(sizes.values())).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}

    @property
    def shift_columns(self) -> dict[str, int]:
        """Column of each of `shifts`."""
        return {name: k for k, name in enumerate(self.shifts, start=self.layout["shifts"].start)}

    def of_wave(self, k: int) -> slice:
        """Columns of wave k."""
        first = self.layout["waves"].start + COLUMNS * k
        return slice(first, first + COLUMNS)

    @property
    def processes(self) -> int:
        """First column of the error by position; that of the play follows it."""
        return self.layout["error"].start

    @property
    def columns(self) -> int:
        """Number of linear quantities."""
        return self.layout["play"].stop

    @cached_property
    def _weights(self) -> np.ndarray:
        return self.places.weights(self.rows.command)

    @cached_property
    def _unknown_spread(self) -> np.ndarray:
        """Half of the distance (1, rows) between the possible sides of a stop, by the line's reversal."""
        reversal = reversal_of(self.rows)
        return play_places(self.rows, np.array([max(abs(reversal.value), min(reversal.sd, self.rows.travel))])).spread

    def clock(self, wave: Wave, command: np.ndarray, time_s: np.ndarray, value: np.ndarray) -> np.ndarray:
        """Position, time or reading in which a wave is periodic, for commands, times and readings, each (t,)."""
        clocks = {"position": abs(self.rows.line.slope) * command, "seconds": time_s, "encoder": value}
        return clocks[wave.clock]

    def clock_of_rows(self, wave: Wave) -> np.ndarray:
        """`clock` of the rows, shape (rows,)."""
        return self.clock(wave, self.rows.command, self.rows.time_s, self.rows.value)

    def record(self, wave: Wave) -> WaveRecord:
        """Range of the rows on the clock of a wave."""
        return WaveRecord.of(self.clock_of_rows(wave))

    def wave_columns(self, wave: Wave, period: np.ndarray) -> np.ndarray:
        """Columns (n, rows, `COLUMNS`) of a wave at periods (n,), averaged as the rows are."""
        rows = self.rows
        speed = 1.0 if wave.clock == "seconds" else abs(rows.line.slope * (rows.rate or 0.0))
        return wave_columns(self.clock_of_rows(wave), period, self.record(wave), rows.width_s * speed)

    def in_time(
        self, minutes: np.ndarray, warm_s: np.ndarray, kelvin: np.ndarray | float | None
    ) -> dict[str, np.ndarray]:
        """Factors (n or 1, r) of the shifts of the zero at times since the machine was switched on and temperatures.

        `minutes` (n,) are the time constants of the creep.
        """
        factors = {}
        if "creep" in self.shifts:
            factors["creep"] = crept(np.atleast_2d(warm_s), 60.0 * minutes[:, None])
        if "thermal_per_K" in self.shifts:
            factors["thermal_per_K"] = np.atleast_2d(np.asarray(kelvin, dtype=float))
        return factors

    def fill(
        self,
        columns: np.ndarray,
        command: np.ndarray,
        play: PlayPlaces,
        in_time: Mapping[str, np.ndarray],
        waves: Sequence[np.ndarray],
    ) -> None:
        """Fill the columns (n, r, columns) of readings at commands (r,); those of single homings stay.

        Args:
            columns: what is filled, zeros before.
            command: where the processes act, (r,).
            play: places in the play.
            in_time: factors of the shifts of the zero.
            waves: columns of every wave, (n or 1, r, `COLUMNS`).
        """
        weights = self.places.weights(command)
        columns[..., OFFSET], columns[..., SLOPE] = 1.0, play.anchor - self.middle
        columns[..., CONTRAST], columns[..., BACKLASH] = 0.5 * play.path, 0.5 * play.side
        for name, factor in in_time.items():
            columns[..., self.shift_columns[name]] = factor
        for k, of_wave in enumerate(waves):
            columns[..., self.of_wave(k)] = of_wave
        columns[..., self.layout["error"]] = weights
        columns[..., self.layout["play"]] = 0.5 * play.share[..., None] * weights

    def _columns(self, w: np.ndarray, values: Mapping[str, np.ndarray], extra: np.ndarray | None) -> np.ndarray:
        """Readings minus the prior means, then all columns: shape (n or 1, rows, 1 + columns + extra)."""
        rows, backlash = self.rows, values["backlash"]
        drawn = zip(self.coordinates.waves, self.coordinates.wave_draws(w), strict=True)
        waves = [self.wave_columns(wave, draws.period) for wave, draws in drawn]
        minutes = values["creep_minutes"]
        in_time = self.in_time(
            minutes if "creep_minutes" in self.coordinates.names else minutes[:1], rows.warm_s, rows.kelvin
        )
        play = play_places(rows, backlash if self.play_is_sampled else np.zeros(1))
        spread = play.spread if self.play_is_sampled else self._unknown_spread
        # Equal columns are computed once for all draws.
        differ = self.play_is_sampled or any(len(each) > 1 for each in (*in_time.values(), *waves))
        size = len(w) if differ else 1
        filled = np.zeros((size, len(rows.move), 1 + self.columns + (0 if extra is None else extra.shape[1])))
        columns = filled[:, :, 1 : 1 + self.columns]
        self.fill(columns, rows.command, play, in_time, waves)
        columns[..., self.layout["homed"]] = rows.zero[:, None] == self.homed
        columns[..., self.layout["unknown"]] = spread[..., None] * np.equal.outer(rows.segment, self.unknown_segments)
        columns[..., self.layout["reference"]] = rows.reference
        means = self._prior_means(values)[:size]
        filled[:, :, 0] = rows.value
        for column in np.flatnonzero(means.any(axis=0)):
            filled[:, :, 0] -= means[:, column, None] * columns[..., column]
        if extra is not None:
            filled[:, :, 1 + self.columns :] = extra
        return filled

    def _prior_means(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Prior means of the columns, (n, columns)."""
        means = np.zeros((len(values["backlash"]), self.columns))
        means[:, OFFSET] = self.rows.line.offset + self.rows.line.slope * self.middle
        means[:, SLOPE] = self.priors["per_command"].value
        means[:, CONTRAST] = self.priors["ratio_contrast"].value
        means[:, BACKLASH] = values["backlash"]
        for name, column in self.shift_columns.items():
            means[:, column] = self.priors[name].value
        return means

    def _filtered(self, values: Mapping[str, np.ndarray], columns: np.ndarray) -> tuple[np.ndarray, ...]:
        """Columns (n or 1, rows, c) through `gears.kalman.whitened`, whose rows come first.

        The states of the filter are the drift of the zero and the error of the stop; in motion, the seeing.
        """
        rows, n = self.rows, len(values["backlash"])
        if rows.in_motion:
            stop = np.outer((values["seeing_scale"] * rows.reading_u) ** 2, np.ones(len(rows.move)))
            ratio = rows.width_s / values["seeing_s"][:, None]
            stop = stop * averaged_variance(ratio)
            gap = np.maximum(HOUR_S * rows.hours - rows.width_s, 0.0) / values["seeing_s"][:, None]
            mean_factor = np.where(ratio > 1e-3, -np.expm1(-ratio) / np.maximum(ratio, 1e-3), 1.0 - 0.5 * ratio)
            carry = np.minimum(np.exp(-gap) * mean_factor**2 / averaged_variance(ratio), 1.0)
        else:
            stop = stop_variance(values, rows.side)
            carry = np.ones((1, len(rows.move)))
        carry = np.where(rows.redrawn, 0.0, carry)
        reading = reading_variance(values, rows.variance, rows)
        if not (rows.in_motion or self.places.exact):
            reading = reading + self.between_nodes(values)[:, None]
        keep, variance = np.empty((2, len(rows.move), 2, n))
        keep[:, 0] = np.r_[0, rows.zero[1:] == rows.zero[:-1]][:, None]
        variance[:, 0] = np.outer(rows.hours, values["drift_per_root_hour"] ** 2)
        keep[:, 1], variance[:, 1] = carry.T, ((1 - carry**2) * stop).T
        return whitened(np.swapaxes(columns, 0, 1), keep, variance, np.ascontiguousarray(reading.T))

    def _whitened(self, values: Mapping[str, np.ndarray], columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns (n or 1, rows, c) in units of the scatter, decorrelated, and its log-determinant (n,)."""
        white, log_scatter, *_ = self._filtered(values, columns)
        return np.swapaxes(white, 0, 1), log_scatter

    def drift(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Drift of the zero after the last row at draws w (n, d): means by column (n, columns), variances (n,)."""
        values = self.coordinates.values(w)
        *_, means, covariance = self._filtered(values, self._columns(w, values, None))
        return means[0, :, 1:], covariance[0, 0]

    def between_nodes(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Variance (n,) of both processes midway between nodes, as lost by cubic interpolation."""
        spacing = abs(self.rows.line.slope) * (self.places.command[1] - self.places.command[0])
        weight = np.array([1.0, 0.0625, -0.5625, -0.5625, 0.0625])
        positions = np.array([1.5, 0.0, 1.0, 2.0, 3.0]) * spacing
        length = values["transmission_error_length"][:, None, None]
        correlation = matern52((positions[:, None] - positions)[None], length)
        residual = np.maximum(np.einsum("i,nij,j->n", weight, correlation, weight), 0.0)
        return residual * (values["transmission_error"] ** 2 + 0.25 * values["play_variation"] ** 2)

    @cached_property
    def informed(self) -> np.ndarray:
        """Columns with influence on any row; the others are places of predictions."""
        weighted = np.any(self._weights != 0, axis=0)
        return np.flatnonzero(np.concatenate((np.ones(self.processes, bool), weighted, weighted)))

    def _factor(self, w: np.ndarray, values: Mapping[str, np.ndarray], reorder: bool = False) -> np.ndarray:
        """Factor of the prior covariance of the columns, shape (n, columns, columns).

        It is a Cholesky factor with places in order. With `reorder`, places with influence on rows precede the others
        and do not depend on the coordinates of these.
        """
        sd = np.zeros((len(w), self.columns))
        sd[:, OFFSET] = OFFSET_TRAVELS * self.rows.travel
        sd[:, SLOPE], sd[:, CONTRAST] = self.priors["per_command"].u, self.priors["ratio_contrast"].u
        sd[:, BACKLASH] = 0.0 if self.play_is_sampled else self.priors["backlash"].u
        sd[:, self.layout["homed"]] = values["home_sd"][:, None]
        # That of a uniform distribution from -1 to 1.
        sd[:, self.layout["unknown"]] = np.sqrt(1 / 3)
        for name, column in self.shift_columns.items():
            sd[:, column] = self.priors[name].u
        for k, draws in enumerate(self.coordinates.wave_draws(w)):
            sd[:, self.of_wave(k)] = np.outer(draws.scale, SHARES)
        # Never rescaled: the readings share the error, so that their scatter says nothing about it.
        sd[:, self.layout["reference"]] = 1.0
        factor = sd[:, None] * np.eye(self.columns)
        distance = abs(self.rows.line.slope) * (self.places.command[:, None] - self.places.command)
        covariance = matern52(distance[None], values["transmission_error_length"][:, None, None])
        covariance = covariance + JITTER * np.eye(len(distance))
        if reorder:
            first = np.argsort(~np.any(self._weights != 0, axis=0), kind="stable")
            root = np.empty_like(covariance)
            root[:, first[:, None], first] = np.linalg.cholesky(covariance[:, first[:, None], first])
        else:
            root = np.linalg.cholesky(covariance)
        for block, scale in (("error", "transmission_error"), ("play", "play_variation")):
            factor[:, self.layout[block], self.layout[block]] = values[scale][:, None, None] * root
        return factor

    def _blocks(
        self, w: np.ndarray, extra: np.ndarray | None = None, informed: bool = False
    ) -> Iterator[tuple[slice, _Block]]:
        """The draws w (n, d) in blocks that fit into memory; `informed`: products only of the columns in `informed`."""
        width = 1 + self.columns + (0 if extra is None else extra.shape[1])
        size = max(1, BLOCK_NUMBERS_MAX // (width * max(len(self.rows.move), width)))
        for start in range(0, len(w), size):
            part = slice(start, start + size)
            values = self.coordinates.values(w[part])
            columns = self._columns(w[part], values, extra)
            if informed:
                columns = columns[:, :, np.concatenate(([0], 1 + self.informed))]
            white, log_scatter = self._whitened(values, columns)
            log_scatter = log_scatter - 2 * self.rows.log_density_within(values["reading_scale"])
            yield part, _Block(np.swapaxes(white, 1, 2) @ white, log_scatter, self._factor(w[part], values, informed))

    def white(self, w: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray:
        """Whitened readings, columns, further columns (rows, c) at draws w (n, d): (n, rows, 1 + columns + c)."""
        values = self.coordinates.values(w)
        return self._whitened(values, self._columns(w, values, extra))[0]

    def prior_factor(self, w: np.ndarray) -> np.ndarray:
        """Factor of the prior covariance of the columns (n, columns, columns) at draws w (n, d)."""
        return self._factor(w, self.coordinates.values(w))

    def whitened_extra(self, w: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Further columns (rows, c), whitened as the model's columns at one draw w (1, d)."""
        return self._whitened(self.coordinates.values(w), columns[None])[0][0]

    def log_likelihood(self, w: np.ndarray) -> np.ndarray:
        """Log density of the readings at coordinates (n, d), shape (n,)."""
        return self._likelihood(w, np.zeros((0, self.columns))).log_density

    def log_density(self, w: np.ndarray) -> np.ndarray:
        """Log posterior density at coordinates (n, d) up to a constant, shape (n,); -inf where it is undefined."""
        return self.posterior(w, np.zeros((0, self.columns))).log_density

    def posterior(self, w: np.ndarray, functionals: np.ndarray) -> Likelihood:
        """`log_density` at coordinates (n, d), with the posterior of functionals (t, columns)."""
        count = len(functionals)
        log_density, mean = np.full(len(w), -np.inf), np.zeros((len(w), count))
        covariance, prior = np.zeros((len(w), count, count)), np.full(len(w), -np.inf)
        near = np.flatnonzero(np.all(np.abs(w) < FARTHEST, axis=1))
        if len(near):
            prior[near] = self.coordinates.log_prior(w[near])
        parts = [np.flatnonzero(np.isfinite(prior))]
        while parts:
            if not len(part := parts.pop()):
                continue
            try:
                found = self._likelihood(w[part], functionals)
            except np.linalg.LinAlgError:
                # Rounding made a factorisation fail at one of them.
                parts += np.array_split(part, 2) if len(part) > 1 else []
                continue
            value = found.log_density + prior[part]
            log_density[part] = np.where(np.isfinite(value), value, -np.inf)
            mean[part], covariance[part] = found.linear.mean, found.linear.covariance
        return Likelihood(log_density, LinearPosterior(mean, covariance))

    def _likelihood(self, w: np.ndarray, functionals: np.ndarray) -> Likelihood:
        """Likelihood at coordinates (n, d), linear quantities integrated out."""
        rows, count = len(self.rows.move), len(functionals)
        log_density, mean, covariance = np.empty(len(w)), np.empty((len(w), count)), np.empty((len(w), count, count))
        for part, block in self._blocks(w):
            information, right_side = _normal_equations(block.products, block.factor)
            scale = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
            scaled = information / (scale[:, :, None] * scale[:, None, :])
            root = np.linalg.cholesky(scaled)
            sides = np.concatenate([right_side[:, None], functionals @ block.factor], axis=1) / scale[:, None]
            products = sides @ np.linalg.solve(scaled, np.swapaxes(sides, 1, 2))
            log_det = 2 * np.sum(np.log(np.diagonal(root, axis1=1, axis2=2)) + np.log(scale), axis=1)
            residual = block.products[:, 0, 0] - products[:, 0, 0]
            log_density[part] = -0.5 * (block.log_scatter + log_det + residual + rows * np.log(2 * np.pi))
            mean[part], covariance[part] = products[:, 0, 1:], products[:, 1:, 1:]
        if count:
            mean += self._prior_means(self.coordinates.values(w)) @ functionals.T
        return Likelihood(log_density, LinearPosterior(mean, covariance))

    def linear(self, w: np.ndarray) -> LinearPosterior:
        """Posterior of the linear quantities given coordinates (n, d); means include the prior means."""
        means, covariances = np.empty((len(w), self.columns)), np.empty((len(w), self.columns, self.columns))
        informed, others = self.informed, np.setdiff1d(np.arange(self.columns), self.informed)
        # Places without influence on rows have no information: only the matrix of the others is inverted.
        for part, block in self._blocks(w, informed=len(others) > 0):
            factor = block.factor[:, informed[:, None], informed] if len(others) else block.factor
            information, right_side = _normal_equations(block.products, factor)
            inverse = _inverse(information)
            loading = block.factor[:, :, informed] if len(others) else block.factor
            means[part] = np.einsum("nij,njk,nk->ni", loading, inverse, right_side, optimize=True)
            covariances[part] = loading @ inverse @ np.swapaxes(loading, 1, 2)
            for group in (others[: len(others) // 2], others[len(others) // 2 :]):
                # Columns of the error by position, then of the play, which are independent in the prior.
                own = block.factor[:, group[:, None], group]
                covariances[part, group[:, None], group] += own @ np.swapaxes(own, 1, 2)
        return LinearPosterior(means + self._prior_means(self.coordinates.values(w)), covariances)

    def left_out(self, w: np.ndarray, rows: np.ndarray) -> PredictedReadings:
        """Predict readings of some rows by all others, given the scales, with noise and stop errors.

        Each left-out row gets an additional unknown with a flat prior, so that it has no influence; the unknown is the
        reading minus its prediction.

        Args:
            w: coordinates (n, d).
            rows: numbers of the rows left out.
        """
        extra = np.zeros((len(self.rows.move), len(rows)))
        extra[rows, np.arange(len(rows))] = 1.0
        means, covariances = np.empty((len(w), len(rows))), np.empty((len(w), len(rows), len(rows)))
        for part, block in self._blocks(w, extra):
            information, right_side = _normal_equations(block.products, block.factor)
            inverse = _inverse(information)
            expected = np.einsum("nij,nj->ni", inverse, right_side)
            means[part] = self.rows.value[rows] - expected[:, self.columns :]
            covariances[part] = inverse[:, self.columns :, self.columns :]
        return PredictedReadings(means, covariances)

    def line_terms(self, **factors: float) -> np.ndarray:
        """A functional (columns,) of `offset`, `per_command`, `ratio_contrast`, `backlash` by their factors."""
        functional = np.zeros(self.columns)
        for name, factor in factors.items():
            functional[LINE_COLUMNS[name]] = factor
        return functional

    @property
    def repeats_by_draw(self) -> bool:
        """Whether the error by position has a wave of unknown period."""
        return any(wave.clock == "position" and not wave.is_fixed for wave in self.coordinates.waves)

    def functional(self, command: np.ndarray, w: np.ndarray | None = None) -> np.ndarray:
        """Error that repeats by position at commands (t,): the process and the waves of the gear.

        Functionals (t, columns); with an unknown period one for each draw w (n, d): (n, t, columns).

        Raises:
            ValueError: a period is unknown, and no draws are given.
        """
        by_draw = self.repeats_by_draw
        if by_draw and w is None:
            raise ValueError("draws are needed where a period is not known")
        draws = self.coordinates.wave_draws(np.zeros((1, len(self.coordinates.names))) if w is None else w)
        size = len(w) if by_draw and w is not None else 1
        functionals = np.zeros((size, len(command), self.columns))
        functionals[..., self.layout["error"]] = self.places.weights(command)
        for k, (wave, draw) in enumerate(zip(self.coordinates.waves, draws, strict=True)):
            if wave.clock == "position":
                x = self.clock(wave, command, command, command)
                functionals[:, :, self.of_wave(k)] = wave_columns(x, draw.period, self.record(wave))
        return functionals if by_draw else functionals[0]


def _is_zero(prior: AxisPrior) -> bool:
    """Whether a prior states that there is no such thing."""
    return prior.u == 0 == prior.value


def _creeps(rows: AxisRows) -> bool:
    """Whether times are known, so that a creep can be estimated."""
    return bool(np.ptp(rows.warm_s) > 0)


def _normal_equations(products: np.ndarray, factor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information (n, c, c) and right-hand side (n, c) of the columns in units of their prior, then of flat ones."""
    columns, size = factor.shape[1], products.shape[1] - 1
    if size > columns:
        whole = np.repeat(np.eye(size)[None], len(factor), axis=0)
        whole[:, :columns, :columns] = factor
        factor = whole
    transposed = np.swapaxes(factor, 1, 2)
    information = transposed @ products[:, 1:, 1:] @ factor
    information[:, range(columns), range(columns)] += 1.0
    return information, np.einsum("nij,nj->ni", transposed, products[:, 1:, 0])


def _inverse(information: np.ndarray) -> np.ndarray:
    """Inverse of the matrix, by its scaled one."""
    scale = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    scales = scale[:, :, None] * scale[:, None, :]
    # Fails where rounding made the matrix indefinite.
    np.linalg.cholesky(information / scales)
    return np.linalg.inv(information / scales) / scales

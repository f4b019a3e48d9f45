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
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tvsbayes.single_axis.axis_parameters import AxisCoordinates, AxisPrior
from tvsbayes.single_axis.axis_rows import HOUR_S, AxisRows, legs_are_long, play_places, reversal_of
from tvsbayes.single_axis.filter_of_rows import Whitened, averaged_variance, whitened
from tvsbayes.single_axis.linear_posterior import LinearPosterior
from tvsbayes.single_axis.process_places import ProcessPlaces, process_places
from tvsbayes.single_axis.waves import COLUMNS, SHARES, Wave, WaveRecord, wave_columns
from tvsbayes.statistics.gaussian_process import JITTER, matern52
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
LINE_TERMS = 4
"""Their number."""


@dataclass(frozen=True)
class Likelihood:
    """Likelihood of the readings at many coordinates, linear quantities integrated out.

    Attributes:
        log_density: shape (n,).
        linear: posterior of the requested functionals, in place of columns.
    """

    log_density: np.ndarray
    linear: LinearPosterior

    @classmethod
    def undefined(cls, count: int, size: int) -> Likelihood:
        """The likelihood at coordinates where the density is undefined."""
        return cls(np.full(count, -np.inf), LinearPosterior(np.zeros((count, size)), np.zeros((count, size, size))))

    @classmethod
    def joined(cls, parts: Sequence[Likelihood]) -> Likelihood:
        """Parts concatenated."""
        mean, covariance = ([getattr(part.linear, name) for part in parts] for name in ("mean", "covariance"))
        linear = LinearPosterior(np.concatenate(mean), np.concatenate(covariance))
        return cls(np.concatenate([part.log_density for part in parts]), linear)


@dataclass(frozen=True)
class _Block:
    """Products of a block of draws.

    Attributes:
        products: products of whitened columns, shape (n, 1 + columns, 1 + columns).
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
        unused = set()
        if priors["creep"].u == 0 == priors["creep"].value or not _creeps(rows):
            unused.add("creep_minutes")
        unused |= {"stop_sd.forward", "stop_sd.backward"} if rows.in_motion else {"seeing_scale", "seeing_s"}
        if rows.in_motion:
            # Averaged readings hardly separate white noise from seeing: noise is as stated, excess counts as seeing.
            unused |= {"transmission_error", "transmission_error_length", "play_variation", "reading_scale"}
        if not np.any(rows.variance > 0):
            unused.add("reading_scale")
        if len(np.unique(rows.zero)) < 2:
            unused.add("home_sd")
        if not np.any(rows.hours > 0):
            unused.add("drift_per_root_hour")
        if not np.any(rows.side >= 0):
            unused.add("stop_sd.forward")
        if not np.any(rows.side <= 0):
            unused.add("stop_sd.backward")
        if priors["transmission_error"].u == 0 == priors["transmission_error"].value:
            if priors["play_variation"].u == 0 == priors["play_variation"].value:
                unused.add("transmission_error_length")
        first_moves = np.flatnonzero(rows.legs.first)
        unknown_segments = tuple(int(k) for k in rows.legs.segment[first_moves[rows.legs.side[first_moves] == 0]])
        spread = play_places(rows, np.array([rows.travel])).spread[0]
        unknown_segments = tuple(k for k in unknown_segments if np.any(spread[rows.segment == k] > 0))
        if legs_are_long(rows):
            unused.add("backlash")
        # At constant rate an error by position is a function of time and therefore part of the drift.
        command = rows.command[:0] if rows.in_motion else rows.command
        places = process_places(command, np.zeros(0) if more is None else more)
        return cls(rows, dict(priors), AxisCoordinates.of(priors, frozenset(unused), waves), places, unknown_segments)

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
        names = [name for name, is_recorded in there.items() if is_recorded]
        return tuple(name for name in names if not self.priors[name].u == 0 == self.priors[name].value)

    @cached_property
    def layout(self) -> dict[str, slice]:
        """Columns by what they are; those of the processes are in the order of the places."""
        places = len(self.places.command)
        sizes = {"line": LINE_TERMS, "homed": len(self.homed), "unknown": len(self.unknown_segments)}
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

    def _shifts_of_rows(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Columns (n or 1, rows) of the shifts of the zero in time."""
        columns = {}
        if "creep" in self.shifts:
            minutes = values["creep_minutes"]
            minutes = minutes if "creep_minutes" in self.coordinates.names else minutes[:1]
            columns["creep"] = -np.expm1(-self.rows.warm_s[None] / (60.0 * minutes[:, None]))
        if "thermal_per_K" in self.shifts and self.rows.kelvin is not None:
            columns["thermal_per_K"] = self.rows.kelvin[None]
        return columns

    def _columns(self, w: np.ndarray, values: Mapping[str, np.ndarray], extra: np.ndarray | None) -> np.ndarray:
        """Readings minus the prior means, then all columns: shape (n or 1, rows, 1 + columns + extra)."""
        rows, backlash = self.rows, values["backlash"]
        drawn = zip(self.coordinates.waves, self.coordinates.wave_draws(w), strict=True)
        waves, shifts = [self.wave_columns(wave, draws.period) for wave, draws in drawn], self._shifts_of_rows(values)
        play = play_places(rows, backlash if self.play_is_sampled else np.zeros(1))
        spread = play.spread if self.play_is_sampled else self._unknown_spread
        # Equal columns are computed once for all draws.
        differ = self.play_is_sampled or any(len(each) > 1 for each in (*shifts.values(), *waves))
        blocks = len(backlash) if differ else 1
        width = 1 + self.columns + (0 if extra is None else extra.shape[1])
        filled = np.zeros((blocks, len(rows.move), width))
        level = rows.line.offset + rows.line.slope * self.middle
        anchor = play.anchor - self.middle
        filled[:, :, 0] = rows.value - level - self.priors["per_command"].value * anchor
        filled[:, :, 0] -= 0.5 * self.priors["ratio_contrast"].value * play.path
        filled[:, :, 0] -= 0.5 * play.side * backlash[:blocks, None]
        columns = filled[:, :, 1:]
        columns[..., OFFSET], columns[..., SLOPE], columns[..., CONTRAST] = 1.0, anchor, 0.5 * play.path
        columns[..., BACKLASH] = 0.5 * play.side
        columns[..., self.layout["homed"]] = rows.zero[:, None] == self.homed
        columns[..., self.layout["unknown"]] = spread[..., None] * np.equal.outer(rows.segment, self.unknown_segments)
        for name, column in shifts.items():
            filled[:, :, 0] -= self.priors[name].value * column
            columns[..., self.shift_columns[name]] = column
        for k, wave in enumerate(waves):
            columns[..., self.of_wave(k)] = wave
        columns[..., self.layout["reference"]] = rows.reference
        columns[..., self.layout["error"]] = self._weights
        columns[..., self.layout["play"]] = 0.5 * play.share[:, :, None] * self._weights
        if extra is not None:
            columns[..., self.columns :] = extra
        return filled

    def _stop_variance(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Variances of stop errors (in motion: of seeing), shape (n, rows)."""
        rows = self.rows
        if rows.in_motion:
            seeing = (values["seeing_scale"] * rows.reading_u) ** 2
            return seeing[:, None] * averaged_variance(rows.width_s[None] / values["seeing_s"][:, None])
        forward = 0.5 * (1.0 + rows.side)
        stop = np.outer(values["stop_sd.forward"] ** 2, forward)
        return stop + np.outer(values["stop_sd.backward"] ** 2, 1.0 - forward)

    def _reading_variance(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Variances of readings, shape (n, rows)."""
        rows = self.rows
        reading = np.outer(values["reading_scale"] ** 2, rows.variance) + (FLOOR * rows.travel) ** 2
        exact = rows.in_motion or self.places.exact
        return reading if exact else reading + self.between_nodes(values)[:, None]

    def _carry(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Share of the previous row's stop error (in motion: seeing) in each row: shape (n or 1, rows)."""
        rows = self.rows
        if not rows.in_motion:
            return np.where(rows.redrawn, 0.0, 1.0)[None]
        duration_s = values["seeing_s"][:, None]
        gap = np.maximum(HOUR_S * rows.hours - rows.width_s, 0.0)[None] / duration_s
        ratio = rows.width_s[None] / duration_s
        mean_factor = np.where(ratio > 1e-3, -np.expm1(-ratio) / np.maximum(ratio, 1e-3), 1.0 - 0.5 * ratio)
        carry = np.exp(-gap) * mean_factor**2 / averaged_variance(ratio)
        return np.where(rows.redrawn, 0.0, np.minimum(carry, 1.0))

    def between_nodes(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Variance (n,) of both processes midway between nodes, as lost by cubic interpolation."""
        spacing = abs(self.rows.line.slope) * (self.places.command[1] - self.places.command[0])
        length = values["transmission_error_length"]
        weight = np.array([1.0, -0.0625, 0.5625, 0.5625, -0.0625])
        positions = np.array([1.5, 0.0, 1.0, 2.0, 3.0]) * spacing
        weight[1:] *= -1
        correlation = matern52((positions[:, None] - positions)[None], length[:, None, None])
        residual = np.maximum(np.einsum("i,nij,j->n", weight, correlation, weight), 0.0)
        return residual * (values["transmission_error"] ** 2 + 0.25 * values["play_variation"] ** 2)

    @cached_property
    def informed(self) -> np.ndarray:
        """Columns with influence on any row; the others are places of predictions."""
        weighted = np.any(self._weights != 0, axis=0)
        return np.flatnonzero(np.concatenate((np.ones(self.processes, bool), weighted, weighted)))

    def _factor(self, values: Mapping[str, np.ndarray], scales: Sequence[np.ndarray], reorder: bool) -> np.ndarray:
        """Factor of the prior covariance of the columns, shape (n, columns, columns); `scales` (n,) are the waves'.

        It is a Cholesky factor with places in order. With `reorder`, places with influence on rows precede the others
        and do not depend on the coordinates of these.
        """
        sd = np.zeros((len(values["backlash"]), self.columns))
        sd[:, OFFSET] = OFFSET_TRAVELS * self.rows.travel
        sd[:, SLOPE], sd[:, CONTRAST] = self.priors["per_command"].u, self.priors["ratio_contrast"].u
        sd[:, BACKLASH] = 0.0 if self.play_is_sampled else self.priors["backlash"].u
        sd[:, self.layout["homed"]] = values["home_sd"][:, None]
        # That of a uniform distribution from -1 to 1.
        sd[:, self.layout["unknown"]] = np.sqrt(1 / 3)
        for name, column in self.shift_columns.items():
            sd[:, column] = self.priors[name].u
        for k, scale in enumerate(scales):
            sd[:, self.of_wave(k)] = np.outer(scale, SHARES)
        # Never rescaled: the readings share the error, so that their scatter says nothing about it.
        sd[:, self.layout["reference"]] = 1.0
        factor = sd[:, None] * np.eye(self.columns)
        distance = abs(self.rows.line.slope) * (self.places.command[:, None] - self.places.command)
        length = values["transmission_error_length"][:, None, None]
        covariance = matern52(distance[None], length) + JITTER * np.eye(len(distance))
        if reorder:
            first = np.argsort(~np.any(self._weights != 0, axis=0), kind="stable")
            root = np.empty_like(covariance)
            root[:, first[:, None], first] = np.linalg.cholesky(covariance[:, first[:, None], first])
        else:
            root = np.linalg.cholesky(covariance)
        error, play = self.layout["error"], self.layout["play"]
        factor[:, error, error] = values["transmission_error"][:, None, None] * root
        factor[:, play, play] = values["play_variation"][:, None, None] * root
        return factor

    def _blocks(
        self, w: np.ndarray, extra: np.ndarray | None = None, *, informed: bool = False
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
            white = self._whitened(values, columns)
            scales = [draws.scale for draws in self.coordinates.wave_draws(w[part])]
            products = np.swapaxes(white.columns, 1, 2) @ white.columns
            spread = self.rows.log_density_within(values["reading_scale"])
            yield part, _Block(products, white.log_scatter - 2 * spread, self._factor(values, scales, informed))

    def white(self, w: np.ndarray) -> np.ndarray:
        """Whitened readings and columns (rows, 1 + columns) at one draw w (1, d)."""
        values = self.coordinates.values(w)
        return self._whitened(values, self._columns(w, values, None)).columns[0]

    def prior_factor(self, w: np.ndarray) -> np.ndarray:
        """Factor of the prior covariance of the columns (columns, columns) at one draw w (1, d)."""
        scales = [draws.scale for draws in self.coordinates.wave_draws(w)]
        return self._factor(self.coordinates.values(w), scales, False)[0]

    def whitened_extra(self, w: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Further columns (rows, c), whitened as the model's columns at one draw w (1, d)."""
        return self._whitened(self.coordinates.values(w), columns[None]).columns[0]

    def _whitened(self, values: Mapping[str, np.ndarray], columns: np.ndarray) -> Whitened:
        drift, stop = values["drift_per_root_hour"] ** 2, self._stop_variance(values)
        return whitened(columns, self.rows, drift, stop, self._reading_variance(values), self._carry(values))

    def log_likelihood(self, w: np.ndarray) -> np.ndarray:
        """Log density of the readings at coordinates (n, d), shape (n,)."""
        return self.likelihood(w, np.zeros((0, self.columns))).log_density

    def likelihood(self, w: np.ndarray, functionals: np.ndarray) -> Likelihood:
        """Likelihood at coordinates (n, d), with the posterior of functionals (t, columns) of the linear quantities."""
        rows, count = len(self.rows.move), len(functionals)
        log_density, mean, covariance = np.empty(len(w)), np.empty((len(w), count)), np.empty((len(w), count, count))
        for part, block in self._blocks(w):
            normal = _normal_equations(block, 0)
            scale = np.sqrt(np.diagonal(normal.information, axis1=1, axis2=2))
            scaled = normal.information / (scale[:, :, None] * scale[:, None, :])
            root = np.linalg.cholesky(scaled)
            sides = np.concatenate([normal.right_side[:, None], functionals @ block.factor], axis=1) / scale[:, None]
            solved = np.linalg.solve(scaled, np.swapaxes(sides, 1, 2))
            products = sides @ solved
            log_det = 2 * np.sum(np.log(np.diagonal(root, axis1=1, axis2=2)) + np.log(scale), axis=1)
            residual = block.products[:, 0, 0] - products[:, 0, 0]
            log_density[part] = -0.5 * (block.log_scatter + log_det + residual + rows * np.log(2 * np.pi))
            mean[part], covariance[part] = products[:, 0, 1:], products[:, 1:, 1:]
        if count:
            mean += self._prior_means(w) @ functionals.T
        return Likelihood(log_density, LinearPosterior(mean, covariance))

    def _prior_means(self, w: np.ndarray) -> np.ndarray:
        """Prior means of the columns, (n, columns)."""
        means = np.zeros((len(w), self.columns))
        means[:, OFFSET] = self.rows.line.offset + self.rows.line.slope * self.middle
        means[:, SLOPE] = self.priors["per_command"].value
        means[:, CONTRAST] = self.priors["ratio_contrast"].value
        means[:, BACKLASH] = self.coordinates.values(w)["backlash"]
        for name, column in self.shift_columns.items():
            means[:, column] = self.priors[name].value
        return means

    def log_density(self, w: np.ndarray) -> np.ndarray:
        """Log posterior density at coordinates (n, d) up to a constant, shape (n,); -inf where it is undefined."""
        return self.posterior(w, np.zeros((0, self.columns))).log_density

    def posterior(self, w: np.ndarray, functionals: np.ndarray) -> Likelihood:
        """`likelihood` with the prior of the coordinates; -inf where the density is undefined."""
        count = len(functionals)
        likelihood = Likelihood.undefined(len(w), count)
        usable = np.flatnonzero(np.all(np.abs(w) < FARTHEST, axis=1))
        if len(usable):
            prior = self.coordinates.log_prior(w[usable])
            usable, prior = usable[np.isfinite(prior)], prior[np.isfinite(prior)]
        if len(usable):
            likelihood_there = self._possible(w[usable], functionals)
            value = likelihood_there.log_density + prior
            likelihood.log_density[usable] = np.where(np.isfinite(value), value, -np.inf)
            likelihood.linear.mean[usable], likelihood.linear.covariance[usable] = (
                likelihood_there.linear.mean,
                likelihood_there.linear.covariance,
            )
        return likelihood

    def _possible(self, w: np.ndarray, functionals: np.ndarray) -> Likelihood:
        """`likelihood`, -inf where rounding makes a factorisation fail."""
        try:
            return self.likelihood(w, functionals)
        except np.linalg.LinAlgError:
            if len(w) == 1:
                return Likelihood.undefined(1, len(functionals))
            middle = len(w) // 2
            return Likelihood.joined([self._possible(half, functionals) for half in (w[:middle], w[middle:])])

    def linear(self, w: np.ndarray) -> LinearPosterior:
        """Posterior of the linear quantities given coordinates (n, d); means include the prior means."""
        means, covariances = np.empty((len(w), self.columns)), np.empty((len(w), self.columns, self.columns))
        informed, others = self.informed, np.setdiff1d(np.arange(self.columns), self.informed)
        # Places without influence on rows have no information: only the matrix of the others is inverted.
        for part, block in self._blocks(w, informed=len(others) > 0):
            reduced = replace(block, factor=block.factor[:, informed[:, None], informed]) if len(others) else block
            normal = _normal_equations(reduced, 0)
            inverse = _inverse(normal.information)
            loading = block.factor[:, :, informed] if len(others) else block.factor
            means[part] = np.einsum("nij,njk,nk->ni", loading, inverse, normal.right_side, optimize=True)
            covariances[part] = loading @ inverse @ np.swapaxes(loading, 1, 2)
            for group in (others[: len(others) // 2], others[len(others) // 2 :]):
                # Columns of the error by position, then of the play, which are independent in the prior.
                factor = block.factor[:, group[:, None], group]
                covariances[part, group[:, None], group] += factor @ np.swapaxes(factor, 1, 2)
        return LinearPosterior(means + self._prior_means(w), covariances)

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
            normal = _normal_equations(block, len(rows))
            inverse = _inverse(normal.information)
            expected = np.einsum("nij,nj->ni", inverse, normal.right_side)
            means[part] = self.rows.value[rows] - expected[:, self.columns :]
            covariances[part] = inverse[:, self.columns :, self.columns :]
        return PredictedReadings(means, covariances)

    def line_terms(self, **factors: float) -> np.ndarray:
        """A functional (columns,) of `offset`, `per_command`, `ratio_contrast`, `backlash` by their factors."""
        functional = np.zeros(self.columns)
        for name, factor in factors.items():
            functional[_LINE_COLUMNS[name]] = factor
        return functional

    def shift(self, name: str) -> np.ndarray:
        """A functional (columns,) of one of `shifts`."""
        functional = np.zeros(self.columns)
        functional[self.shift_columns[name]] = 1.0
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
        functionals = np.zeros((len(command), self.columns))
        functionals[:, self.layout["error"]] = self.places.weights(command)
        by_draw = self.repeats_by_draw
        if by_draw and w is None:
            raise ValueError("draws are needed where a period is not known")
        draws = self.coordinates.wave_draws(np.zeros((1, len(self.coordinates.names))) if w is None else w)
        functionals = np.repeat(functionals[None], 1 if w is None or not by_draw else len(w), axis=0)
        for k, (wave, draw) in enumerate(zip(self.coordinates.waves, draws, strict=True)):
            if wave.clock == "position":
                x = self.clock(wave, command, command, command)
                functionals[:, :, self.of_wave(k)] = wave_columns(x, draw.period, self.record(wave))
        return functionals if by_draw else functionals[0]


def _creeps(rows: AxisRows) -> bool:
    """Whether times are known, so that a creep can be estimated."""
    return bool(np.ptp(rows.warm_s) > 0)


_LINE_COLUMNS = {"offset": OFFSET, "per_command": SLOPE, "ratio_contrast": CONTRAST, "backlash": BACKLASH}


class _NormalEquations(NamedTuple):
    """Information (n, c, c) and right-hand side (n, c)."""

    information: np.ndarray
    right_side: np.ndarray


def _normal_equations(block: _Block, flat: int) -> _NormalEquations:
    """Normal equations of the columns in units of their prior, then of `flat` ones."""
    products, columns = block.products, block.factor.shape[1]
    factor = block.factor
    if flat:
        size = columns + flat
        factor = np.zeros((len(block.factor), size, size))
        factor[:, :columns, :columns] = block.factor
        factor[:, range(columns, size), range(columns, size)] = 1.0
    transposed = np.swapaxes(factor, 1, 2)
    information = transposed @ products[:, 1:, 1:] @ factor
    information[:, range(columns), range(columns)] += 1.0
    return _NormalEquations(information, np.einsum("nij,nj->ni", transposed, products[:, 1:, 0]))


def _inverse(information: np.ndarray) -> np.ndarray:
    """Inverse of the matrix, by its scaled one."""
    scale = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    scales = scale[:, :, None] * scale[:, None, :]
    # Fails where rounding made the matrix indefinite.
    np.linalg.cholesky(information / scales)
    return np.linalg.inv(information / scales) / scales

"""Where the evidence of a wave lies: over a grid fine against 1 / span, then between its points where it is sharp.

Everything is linear and normal given the scales of noise and errors: these are held at the mode, the readings and all
columns are whitened once, and every period costs products with its own few columns. What is found makes the tables of
`waves.Wave`, from which the sampler starts; it weighs against the density without any of these approximations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.errors import refusal
from tvsbayes.single_axis.axis_mode import find_mode
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AXIS_KEYS, AxisPrior
from tvsbayes.single_axis.axis_rows import AxisRows
from tvsbayes.single_axis.classic_line import fit_line
from tvsbayes.single_axis.waves import (
    COLUMNS,
    SCALE_RANGE,
    SHARES,
    AskedPeriods,
    Clock,
    Tabulated,
    Wave,
    WaveRecord,
    absent_at,
    log_scale_prior,
    wave_columns,
)

PER_RESOLUTION = 8
"""Points of the grid in 1 / span of frequency."""
GRID_MAX = 30_000
"""Points; beyond it the range is refused."""
APART_MIN = 1e-9
"""Distance of logs of periods in the grid before it is refined: `REFINEMENTS` halvings stay above rounding."""
AT_ONCE = 400
"""Periods whose columns are held at once."""
SCALES = 60
"""Of the grid of log s."""
STEEP, NEAR, REFINEMENTS = 0.5, 14.0, 12
"""Log evidence that may lie between neighbours, where it is within `NEAR` of the best; rounds of halving."""
TEMPER, FLOOR = 0.6, 0.05
"""Power of the evidence in a table, and its uniform share: tables are wider than the posterior."""
ABSENT_MIN, ABSENT_MAX = 0.03, 0.9
"""Of a table's share without a wave."""
WAVES_MAX, FURTHER = 6, 3.0
"""Inferred waves while more are added than were asked for, and the log Bayes factor that another one needs."""
RESOLVED, UNRESOLVED = 0.5, 1e3
"""Periods in the record by which two waves differ at least, P / (2 N) of a period of which N fit in; log evidence of
one that does not is lowered by so much: it would be what the other changes by."""


@dataclass(frozen=True)
class _Prepared:
    """Whitened readings and columns at the mode.

    Attributes:
        model: with all other waves; the one that is looked for is not in it, or has no size at `w`.
        w: coordinates, shape (1, d).
        base: whitened readings and columns in units of their priors, shape (rows, 1 + columns).
        inverse: of the columns' information, shape (columns, columns).
        towards: right-hand side, shape (columns,).
    """

    model: AxisModel
    w: np.ndarray
    base: np.ndarray
    inverse: np.ndarray
    towards: np.ndarray


def _prepared(model: AxisModel, w: np.ndarray) -> _Prepared:
    white, factor = model.white(w)
    base = np.column_stack([white[:, :1], white[:, 1:] @ factor])
    information = base[:, 1:].T @ base[:, 1:] + np.eye(factor.shape[1])
    return _Prepared(model, w, base, np.linalg.inv(information), base[:, 1:].T @ base[:, 0])


def _log_evidence(ready: _Prepared, wave: Wave, log_period: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Log Bayes factors (p, scales) of a wave against none, at logs of periods (p,) and scales (scales,)."""
    model, rows = ready.model, ready.model.rows
    x = model.clock(wave, rows.command, rows.time_s, rows.value)
    width = rows.width_s * (1.0 if wave.clock == "seconds" else abs(rows.line[1] * (rows.rate or 0.0)))
    evidence = np.empty((len(log_period), len(scales)))
    for begins in range(0, len(log_period), AT_ONCE):
        part = slice(begins, begins + AT_ONCE)
        columns = wave_columns(x, np.exp(log_period[part]), WaveRecord.of(x), width) * np.array(SHARES)
        count = len(columns)
        flat = np.moveaxis(columns, 0, 1).reshape(len(x), -1)
        white = model.whitened_extra(ready.w, flat)
        across = white.T @ ready.base[:, 1:]
        towards = (white.T @ ready.base[:, 0] - across @ ready.inverse @ ready.towards).reshape(count, COLUMNS)
        of_columns = white.reshape(len(x), count, COLUMNS)
        across = across.reshape(count, COLUMNS, -1)
        information = np.einsum("rpi,rpj->pij", of_columns, of_columns, optimize=True)
        information -= across @ ready.inverse @ np.swapaxes(across, 1, 2)
        values, vectors = np.linalg.eigh(information)
        values = np.maximum(values, 0.0)[:, None, :]
        along = np.einsum("pij,pi->pj", vectors, towards)[:, None, :] ** 2
        variance = scales[None, :, None] ** 2
        evidence[part] = 0.5 * np.sum(variance * along / (1 + variance * values) - np.log1p(variance * values), axis=2)
    return evidence


@dataclass(frozen=True)
class _Searched:
    """A wave with tables by what the readings say, and its log Bayes factor against none."""

    wave: Wave
    log_evidence: float


def _searched(ready: _Prepared, wave: Wave, apart: Sequence[Wave] = ()) -> _Searched:
    """The wave, all others as in `ready`; its period resolved from those of `apart`, which the record hardly parts."""
    rows = ready.model.rows
    span = float(np.ptp(ready.model.clock(wave, rows.command, rows.time_s, rows.value)))
    low, high = (np.log(end * wave.unit) for end in SCALE_RANGE)
    log_scale = np.linspace(low, high, SCALES)
    prior = log_scale_prior(log_scale, wave.unit)
    weights = prior + np.log(np.gradient(log_scale))
    scales = np.exp(log_scale)

    def evidence_at(log_period: np.ndarray) -> np.ndarray:
        evidence = _log_evidence(ready, wave, log_period, scales)
        for other in apart:
            evidence[np.abs(np.exp(-log_period) - 1 / other.peak) * span < RESOLVED] -= UNRESOLVED
        return evidence

    grid = np.array([np.log(wave.low)]) if wave.is_fixed else period_grid(wave, span)
    evidence = evidence_at(grid)
    for _ in range(0 if wave.is_fixed else REFINEMENTS):
        by_period = np.logaddexp.reduce(evidence + weights, axis=1)
        best = np.maximum(by_period[1:], by_period[:-1])
        steep = (np.abs(np.diff(by_period)) > STEEP) & (best > by_period.max() - NEAR)
        # A peak between two points is seen by the curvature of its neighbours alone.
        peak = int(np.argmax(by_period))
        steep[max(peak - 1, 0) : peak + 1] |= bool(np.diff(grid)[max(peak - 1, 0)] > _sharp(evidence, grid))
        if not steep.any() or len(grid) > 2 * GRID_MAX:
            break
        more = 0.5 * (grid[1:] + grid[:-1])[steep]
        order = np.argsort(np.concatenate([grid, more]), kind="stable")
        grid = np.concatenate([grid, more])[order]
        evidence = np.concatenate([evidence, evidence_at(more)])[order]
    by_period = np.logaddexp.reduce(evidence + weights, axis=1)
    if wave.is_fixed:
        total, table, over = float(by_period[0]), None, np.zeros(1)
    else:
        over = np.log(np.gradient(grid) / np.ptp(grid))
        total = float(np.logaddexp.reduce(by_period + over))
        table = Tabulated.of(grid, TEMPER * by_period, FLOOR)
    by_scale = np.logaddexp.reduce(evidence + over[:, None], axis=0) + prior
    absent = float(np.clip(1 / (1 + np.exp(np.clip(total, -50, 50))), ABSENT_MIN, ABSENT_MAX))
    scale_table = Tabulated.of(log_scale, TEMPER * by_scale, FLOOR)
    peak_at = float(np.exp(grid[int(np.argmax(by_period))]))
    return _Searched(replace(wave, log_scale=scale_table, log_period=table, absent=absent, peak=peak_at), total)


def _sharp(evidence: np.ndarray, grid: np.ndarray) -> float:
    """Spacing of log periods that the best peak is resolved with: half a sd of its curvature."""
    best = evidence.max(axis=1)
    k = int(np.clip(np.argmax(best), 1, len(grid) - 2)) if len(grid) > 2 else 0
    if not k:
        return 0.0
    fitted = np.polyfit(grid[k - 1 : k + 2] - grid[k], best[k - 1 : k + 2], 2)[0]
    return float(0.5 / np.sqrt(max(-2 * fitted, 1e-12)))


def period_grid(wave: Wave, span: float) -> np.ndarray:
    """Logs of periods, evenly in frequency, ascending; `span` of the readings on the clock of the wave.

    Raises:
        InputError: the range is too wide for the span of the readings.
    """
    count = int(np.ceil((1 / wave.low - 1 / wave.high) * span * PER_RESOLUTION)) + 2
    if count > GRID_MAX:
        least = span * PER_RESOLUTION / GRID_MAX
        raise refusal(
            "range",
            file="campaign.toml",
            column="axis.period_between",
            found=f"periods from {wave.low:g}: {span / wave.low:.0f} of them fit into the record",
            allowed=f"periods from {least:.3g} on",
            remedy="raise the lower end of the range, or fit a part of the record",
        )
    even = np.linspace(1 / wave.high, 1 / wave.low, max(count, 40))[1:-1]
    # A slow wave, of which few fit in, needs points by its log. The ends come from one list alone: apart by rounding
    # they would have one point half-way.
    by_log = np.linspace(np.log(wave.low), np.log(wave.high), 60)
    grid = np.sort(np.concatenate([-np.log(even), by_log[1:-1]]))
    return np.concatenate([by_log[:1], grid[np.diff(grid, append=np.inf) > APART_MIN], by_log[-1:]])


def waves_of(rows: AxisRows, priors: Mapping[str, AxisPrior], periods: AskedPeriods) -> tuple[Wave, ...]:
    """The waves that a folder asks for, with tables by what its readings say; stated ones first, the encoder's last.

    Args:
        rows: what was read.
        priors: complete; the scale of `transmission_error` is that of the waves.
        periods: periods.

    Raises:
        InputError: a range that is too wide for the record.
    """
    if not periods:
        return ()
    error = priors["transmission_error"]
    unit = error.u or error.value or (AXIS_KEYS["transmission_error"].share or 0.0) * rows.travel
    clock: Clock = "seconds" if periods.in_seconds else "position"
    stated = [_of_stated(clock, period, unit, rows, priors) for period in periods.stated]
    unknown = [replace(Wave.fixed(clock, low, unit), high=high) for low, high in periods.between]
    encoder = [] if periods.encoder is None else [_of_stated("encoder", periods.encoder, unit, rows, priors)]
    known = [Wave.fixed(wave.clock, wave.peak, unit) for wave in (*stated, *encoder)]
    near: dict[str, float] = {}
    unknown, peaks = _inferred(rows, priors, known, unknown, near)
    every = [*known[: len(stated)], *peaks, *known[len(stated) :]]
    model = AxisModel.of(rows, priors, None, every)
    mode, names, final = find_mode(model, near).w, model.coordinates.names, []
    for k, wave in enumerate([*stated, *unknown, *encoder]):
        without = mode[None].copy()
        without[0, names.index(f"wave_scale.{k + 1}")] = absent_at(every[k])
        final.append(_searched(_prepared(model, without), wave).wave)
    return tuple(final)


def _inferred(
    rows: AxisRows,
    priors: Mapping[str, AxisPrior],
    known: Sequence[Wave],
    waves: Sequence[Wave],
    near: dict[str, float],
) -> tuple[list[Wave], list[Wave]]:
    """The waves of unknown period, and each at its peak: one after the other, the strongest evidence first.

    Every range gets the waves that it was asked for, and further ones while the evidence for another is `FURTHER`: a
    gear train has more periods than its owner knows of, and the one that is asked for may not be the strongest. `near`
    holds the coordinates of the last mode by name.
    """
    inferred: list[Wave] = []
    peaks: list[Wave] = []

    def strongest(ranges: Sequence[Wave]) -> _Searched:
        model = AxisModel.of(rows, priors, None, [*known, *peaks])
        mode = find_mode(model, near).w
        near.update(zip(model.coordinates.names, mode.tolist(), strict=True))
        ready = _prepared(model, mode[None])
        return max((_searched(ready, wave, peaks) for wave in ranges), key=lambda each: each.log_evidence)

    def take(best: _Searched) -> None:
        inferred.append(next(wave for wave in waves if (wave.low, wave.high) == (best.wave.low, best.wave.high)))
        peaks.append(replace(Wave.fixed(best.wave.clock, best.wave.peak, best.wave.unit), absent=best.wave.absent))

    different = list({(wave.low, wave.high): wave for wave in waves}.values())
    while different and len(inferred) < WAVES_MAX and (best := strongest(different)).log_evidence > FURTHER:
        take(best)
    for wave in different:
        while inferred.count(wave) < waves.count(wave):
            take(strongest([wave]))
    return inferred, peaks


RATIO_SDS = 3.0
"""sds of the ratio that a stated period of position may be off by on the line's."""
ERROR_SLOPE = 1.7
"""Slope that an error by position of sd 1 typically gives a line over a range of 1: half of the largest, root 12."""


def _of_stated(clock: Clock, period: float, unit: float, rows: AxisRows, priors: Mapping[str, AxisPrior]) -> Wave:
    """The wave of a stated period: on a clock of position the line's ratio stands for the true one, which is not known.

    What that may be off by is a narrow range of the period; where `per_command` is stated better, by that.
    """
    if clock != "position":
        return replace(Wave.fixed(clock, period, unit), known=period)
    ratio, prior = abs(rows.line[1]), priors["per_command"]
    error = max(priors["transmission_error"].u, priors["transmission_error"].value)
    spread = float(np.hypot(np.sqrt(fit_line(rows).covariance[1, 1]) / ratio, ERROR_SLOPE * error / rows.travel))
    middle = period
    if prior.u < spread * abs(prior.value):
        spread, middle = prior.u / abs(prior.value), period * ratio / abs(prior.value)
    if spread * RATIO_SDS < 1e-9:
        return replace(Wave.fixed(clock, middle, unit), known=period)
    factor = float(np.exp(RATIO_SDS * spread))
    return replace(Wave.fixed(clock, middle, unit), low=middle / factor, high=middle * factor, known=period)

"""Evidence of a wave by period, on a frequency grid finer than 1 / span, refined where the evidence is sharp.

The model is linear and normal given the scales of noise and errors. These are fixed at the mode, the readings and all
columns are whitened once, and every period costs products with its own few columns. The result gives the tables of
`waves.Wave`, from which the sampler starts; the sampler's weights use the density without these approximations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tvsbayes.errors import refusal
from tvsbayes.single_axis.axis_density import find_mode
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AXIS_KEYS, AxisPrior
from tvsbayes.single_axis.axis_rows import AxisRows
from tvsbayes.single_axis.classic_line import fit_line
from tvsbayes.single_axis.waves import (
    COLUMNS,
    SCALE_RANGE,
    SHARES,
    Clock,
    TabulatedDensity,
    Wave,
    WavePeriods,
    absent_coord,
    log_scale_prior,
)

PER_RESOLUTION = 8
"""Number of grid points per 1 / span of frequency."""
GRID_MAX = 30_000
"""Largest number of points; a range that needs more is refused."""
APART_MIN = 1e-9
"""Least distance of log periods in the grid before its refinement: `REFINEMENTS` halvings stay above rounding."""
AT_ONCE = 400
"""Number of periods in a block of columns."""
SCALES = 60
"""Number of grid points of log s."""
STEEP, NEAR, REFINEMENTS = 0.5, 14.0, 12
"""Largest step of log evidence between neighbours, where it is within `NEAR` of the best; rounds of halving."""
TEMPER, FLOOR = 0.6, 0.05
"""Power of the evidence in a table, and its uniform share; both make tables wider than the posterior."""
ABSENT_MIN, ABSENT_MAX = 0.03, 0.9
"""Limits of a table's probability of no wave."""
WAVES_MAX, FURTHER = 6, 3.0
"""Largest number of inferred waves, with those beyond the stated ranges, and the least log Bayes factor of another."""
RESOLVED, UNRESOLVED = 0.5, 1e3
"""Least difference of two waves in periods of the record, P / (2 N) of a period with N in it; reduction of the log
evidence of an unresolved wave, which would represent changes of the other."""


class _WhitenedModel(NamedTuple):
    """Whitened readings and columns at the mode.

    Attributes:
        model: model with all other waves; the searched wave is not in it, or is absent at `w`.
        w: coordinates, shape (1, d).
        base: whitened readings and columns in units of their priors, shape (rows, 1 + columns).
        inverse: inverse of the columns' information, shape (columns, columns).
    """

    model: AxisModel
    w: np.ndarray
    base: np.ndarray
    inverse: np.ndarray


def _whitened_model(model: AxisModel, w: np.ndarray) -> _WhitenedModel:
    [white], [factor] = model.white(w), model.prior_factor(w)
    columns = white[:, 1:] @ factor
    inverse = np.linalg.inv(columns.T @ columns + np.eye(factor.shape[1]))
    return _WhitenedModel(model, w, np.column_stack([white[:, :1], columns]), inverse)


def _log_evidence(state: _WhitenedModel, wave: Wave, log_period: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Log Bayes factors (p, scales) of a wave against none, at logs of periods (p,) and scales (scales,)."""
    model, rows = state.model, len(state.base)
    evidence = np.empty((len(log_period), len(scales)))
    towards = state.inverse @ (state.base[:, 1:].T @ state.base[:, 0])
    for start in range(0, len(log_period), AT_ONCE):
        block = slice(start, start + AT_ONCE)
        columns = model.wave_columns(wave, np.exp(log_period[block])) * np.array(SHARES)
        count = len(columns)
        flat = np.moveaxis(columns, 0, 1).reshape(rows, -1)
        white = model.whitened_extra(state.w, flat)
        cross = white.T @ state.base[:, 1:]
        right_side = (white.T @ state.base[:, 0] - cross @ towards).reshape(count, COLUMNS)
        wave_block = white.reshape(rows, count, COLUMNS)
        cross = cross.reshape(count, COLUMNS, -1)
        information = np.einsum("rpi,rpj->pij", wave_block, wave_block, optimize=True)
        information -= cross @ state.inverse @ np.swapaxes(cross, 1, 2)
        values, vectors = np.linalg.eigh(information)
        values = np.maximum(values, 0.0)[:, None, :]
        power = np.einsum("pij,pi->pj", vectors, right_side)[:, None, :] ** 2
        variance = scales[None, :, None] ** 2
        evidence[block] = 0.5 * np.sum(variance * power / (1 + variance * values) - np.log1p(variance * values), axis=2)
    return evidence


def _search(state: _WhitenedModel, wave: Wave, others: Sequence[Wave] = ()) -> tuple[Wave, float]:
    """Search one wave with all others as in `state`; its period must be resolved from those of `others`.

    Returns:
        The wave with tables from its evidence, and its log Bayes factor against none.
    """
    span = float(np.ptp(state.model.clock_of_rows(wave)))
    low, high = (np.log(end * wave.unit) for end in SCALE_RANGE)
    log_scale = np.linspace(low, high, SCALES)
    prior = log_scale_prior(log_scale, wave.unit)
    weights = prior + np.log(np.gradient(log_scale))
    scales = np.exp(log_scale)

    def evidence_at(log_period: np.ndarray) -> np.ndarray:
        evidence = _log_evidence(state, wave, log_period, scales)
        for other in others:
            evidence[np.abs(np.exp(-log_period) - 1 / other.peak) * span < RESOLVED] -= UNRESOLVED
        return evidence

    grid = np.array([np.log(wave.low)]) if wave.is_fixed else period_grid(wave, span)
    evidence = evidence_at(grid)
    for _ in range(0 if wave.is_fixed else REFINEMENTS):
        by_period = np.logaddexp.reduce(evidence + weights, axis=1)
        best = np.maximum(by_period[1:], by_period[:-1])
        steep = (np.abs(np.diff(by_period)) > STEEP) & (best > by_period.max() - NEAR)
        # A peak between two points appears only in the curvature of its neighbours.
        peak = int(np.argmax(by_period))
        steep[max(peak - 1, 0) : peak + 1] |= bool(np.diff(grid)[max(peak - 1, 0)] > _sharp(evidence, grid))
        if not steep.any() or len(grid) > 2 * GRID_MAX:
            break
        midpoints = 0.5 * (grid[1:] + grid[:-1])[steep]
        order = np.argsort(np.concatenate([grid, midpoints]), kind="stable")
        grid = np.concatenate([grid, midpoints])[order]
        evidence = np.concatenate([evidence, evidence_at(midpoints)])[order]
    by_period = np.logaddexp.reduce(evidence + weights, axis=1)
    if wave.is_fixed:
        total, table, log_weights = float(by_period[0]), None, np.zeros(1)
    else:
        log_weights = np.log(np.gradient(grid) / np.ptp(grid))
        total = float(np.logaddexp.reduce(by_period + log_weights))
        table = TabulatedDensity.of(grid, TEMPER * by_period, FLOOR)
    by_scale = np.logaddexp.reduce(evidence + log_weights[:, None], axis=0) + prior
    absent = float(np.clip(1 / (1 + np.exp(np.clip(total, -50, 50))), ABSENT_MIN, ABSENT_MAX))
    scale_table = TabulatedDensity.of(log_scale, TEMPER * by_scale, FLOOR)
    peak_period = float(np.exp(grid[int(np.argmax(by_period))]))
    return replace(wave, log_scale=scale_table, log_period=table, absent=absent, peak=peak_period), total


def _sharp(evidence: np.ndarray, grid: np.ndarray) -> float:
    """Spacing of log periods that resolves the best peak: half a sd by its curvature."""
    best = evidence.max(axis=1)
    k = int(np.clip(np.argmax(best), 1, len(grid) - 2)) if len(grid) > 2 else 0
    if not k:
        return 0.0
    fitted = np.polyfit(grid[k - 1 : k + 2] - grid[k], best[k - 1 : k + 2], 2)[0]
    return float(0.5 / np.sqrt(max(-2 * fitted, 1e-12)))


def period_grid(wave: Wave, span: float) -> np.ndarray:
    """Logs of periods, evenly in frequency, ascending; `span` is that of the readings on the clock of the wave.

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
    # A slow wave, with few periods in the record, needs points by its log. The ends come from one list only: ends
    # that differ by rounding would get a point between them.
    by_log = np.linspace(np.log(wave.low), np.log(wave.high), 60)
    grid = np.sort(np.concatenate([-np.log(even), by_log[1:-1]]))
    return np.concatenate([by_log[:1], grid[np.diff(grid, append=np.inf) > APART_MIN], by_log[-1:]])


def waves_of(rows: AxisRows, priors: Mapping[str, AxisPrior], periods: WavePeriods) -> tuple[Wave, ...]:
    """The waves that a folder defines, with tables from its readings; stated ones first, the encoder's last.

    Args:
        rows: averaged readings.
        priors: complete priors; the waves have the scale of `transmission_error`.
        periods: settings of the folder.

    Raises:
        InputError: a range is too wide for the record.
    """
    if not periods:
        return ()
    error = priors["transmission_error"]
    unit = error.u or error.value or (AXIS_KEYS["transmission_error"].share or 0.0) * rows.travel
    clock: Clock = "seconds" if periods.in_seconds else "position"
    stated = [_stated_wave(clock, period, unit, rows, priors) for period in periods.stated]
    unknown = [replace(Wave.fixed(clock, low, unit), high=high) for low, high in periods.between]
    encoder = [] if periods.encoder is None else [_stated_wave("encoder", periods.encoder, unit, rows, priors)]
    known = [Wave.fixed(wave.clock, wave.peak, unit) for wave in (*stated, *encoder)]
    start: dict[str, float] = {}
    unknown = _inferred(rows, priors, known, unknown, start)
    all_waves = [*known[: len(stated)], *map(_at_peak, unknown), *known[len(stated) :]]
    model = AxisModel.of(rows, priors, None, all_waves)
    mode, names, results = find_mode(model, start).w, model.coordinates.names, []
    for k, wave in enumerate([*stated, *unknown, *encoder]):
        without = mode[None].copy()
        without[0, names.index(f"wave_scale.{k + 1}")] = absent_coord(all_waves[k])
        results.append(_search(_whitened_model(model, without), wave)[0])
    return tuple(results)


def _at_peak(wave: Wave) -> Wave:
    """A wave that was searched, fixed at its peak."""
    return replace(Wave.fixed(wave.clock, wave.peak, wave.unit), absent=wave.absent)


def _inferred(
    rows: AxisRows,
    priors: Mapping[str, AxisPrior],
    known: Sequence[Wave],
    waves: Sequence[Wave],
    start: dict[str, float],
) -> list[Wave]:
    """Find the waves of unknown period, one after the other, the strongest evidence first.

    Every range gets the stated number of waves, and further ones while the evidence for another exceeds `FURTHER`: a
    gear train may have unexpected stronger periods. `start` has the coordinates of the last mode by name.
    """
    found: list[Wave] = []

    def strongest(ranges: Sequence[Wave]) -> tuple[Wave, float]:
        peaks = [_at_peak(wave) for wave in found]
        model = AxisModel.of(rows, priors, None, [*known, *peaks])
        mode = find_mode(model, start).w
        start.update(zip(model.coordinates.names, mode.tolist(), strict=True))
        state = _whitened_model(model, mode[None])
        return max((_search(state, wave, peaks) for wave in ranges), key=lambda result: result[1])

    different = list({(wave.low, wave.high): wave for wave in waves}.values())
    while different and len(found) < WAVES_MAX and (best := strongest(different))[1] > FURTHER:
        found.append(best[0])
    for wave in different:
        while sum((one.low, one.high) == (wave.low, wave.high) for one in found) < waves.count(wave):
            found.append(strongest([wave])[0])
    return found


RATIO_SDS = 3.0
"""Range of a stated period of position, in sds of the ratio on the line's clock."""
ERROR_SLOPE = 1.7
"""Typical slope of a line over a range of 1 from an error by position of sd 1: half of the largest, root 12."""


def _stated_wave(clock: Clock, period: float, unit: float, rows: AxisRows, priors: Mapping[str, AxisPrior]) -> Wave:
    """The wave of a stated period: a clock of position uses the line's ratio in place of the unknown true one.

    The period then has a narrow range from the uncertainty of the ratio, or of a better stated `per_command`.
    """
    if clock != "position":
        return replace(Wave.fixed(clock, period, unit), known=period)
    ratio, prior = abs(rows.line.slope), priors["per_command"]
    error = max(priors["transmission_error"].u, priors["transmission_error"].value)
    relative_sd = float(np.hypot(np.sqrt(fit_line(rows).covariance[1, 1]) / ratio, ERROR_SLOPE * error / rows.travel))
    middle = period
    if prior.u < relative_sd * abs(prior.value):
        relative_sd, middle = prior.u / abs(prior.value), period * ratio / abs(prior.value)
    if relative_sd * RATIO_SDS < 1e-9:
        return replace(Wave.fixed(clock, middle, unit), known=period)
    factor = float(np.exp(RATIO_SDS * relative_sd))
    return replace(Wave.fixed(clock, middle, unit), low=middle / factor, high=middle * factor, known=period)

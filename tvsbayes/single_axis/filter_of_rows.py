"""The Kalman filter over the rows of an axis: drift, and constant stop errors or the seeing of readings in motion.

Two states, many draws at once; times in hours, variances in the square of the readings' unit. Formulation 8.2. NumPy.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tvsbayes.single_axis.axis_rows import AxisRows


def averaged_variance(duration: np.ndarray) -> np.ndarray:
    """Variance of the mean of an exponentially correlated process over its own; `duration` is in correlation times."""
    ratio = np.maximum(duration, 1e-3)
    return np.where(duration > 1e-3, 2 / ratio * (1 + np.expm1(-ratio) / ratio), 1.0 - duration / 3)


class Whitened(NamedTuple):
    """Innovations of columns over their sd (n, rows, c), and the log-determinant of the scatter (n,)."""

    columns: np.ndarray
    log_scatter: np.ndarray


def whitened(
    columns: np.ndarray, rows: AxisRows, drift: np.ndarray, stop: np.ndarray, reading: np.ndarray, carry: np.ndarray
) -> Whitened:
    """Columns in units of the scatter of drift, stop errors and readings, decorrelated: innovations of the filter.

    Args:
        columns: shape (n or 1, rows, c).
        rows: their times and zeros.
        drift: variance per hour, shape (n,).
        stop: variances of stop errors or seeing, shape (n, rows).
        reading: variances of readings, shape (n, rows).
        carry: share of the previous row's stop error or seeing in each row; 0 where it is new, 1 where it is unchanged;
            shape (n or 1, rows).
    """
    n, count, width = len(drift), columns.shape[1], columns.shape[2]
    is_homed = np.append(False, rows.zero[1:] != rows.zero[:-1]).tolist()
    is_new = np.all(carry == 0, axis=0).tolist()
    # For a single draw plain floats avoid the overhead of array calls.
    by_row = [_by_row(numbers, n) for numbers in (np.outer(drift, rows.hours), stop, reading, carry)]
    blocks = []
    p_zero = p_held = p_both = 0.0 * by_row[0][0]
    for k, (drift_variance, scatter, noise, share) in enumerate(zip(*by_row, strict=True)):
        if is_homed[k]:
            p_zero, p_both = 0.0 * p_zero, 0.0 * p_both
        p_zero = p_zero + drift_variance
        if is_new[k]:
            p_held, p_both = scatter, 0.0 * p_both
        else:
            p_both = share * p_both
            p_held = share**2 * p_held + (1 - share**2) * scatter
        variance = p_zero + 2 * p_both + p_held + noise
        gain_zero, gain_held = (p_zero + p_both) / variance, (p_held + p_both) / variance
        blocks.append((variance, gain_zero, gain_held))
        # Joseph's form keeps variances positive when large ones are subtracted.
        rest_zero, rest_held = 1 - gain_zero, 1 - gain_held
        new_zero = rest_zero**2 * p_zero - 2 * rest_zero * gain_zero * p_both + gain_zero**2 * (p_held + noise)
        new_held = rest_held**2 * p_held - 2 * rest_held * gain_held * p_both + gain_held**2 * (p_zero + noise)
        p_both = (
            (rest_zero * rest_held + gain_zero * gain_held) * p_both
            - rest_zero * gain_held * p_zero
            - gain_zero * rest_held * p_held
            + gain_zero * gain_held * noise
        )
        p_zero, p_held = new_zero, new_held
    # Shape (3, rows, n, 1).
    variance, gain_zero, gain_held = np.array(blocks).reshape(count, 3, n).swapaxes(0, 1)[..., None]
    white = np.empty((count, n, width))
    zero, held = np.zeros((n, width)), np.zeros((n, width))
    column_of_row = np.swapaxes(columns, 0, 1)
    share = np.broadcast_to(carry, (n, count)).T[..., None]
    for k in range(count):
        if is_homed[k]:
            zero = np.zeros((n, width))
        if is_new[k]:
            innovation = column_of_row[k] - zero
            held = gain_held[k] * innovation
        else:
            held = share[k] * held
            innovation = column_of_row[k] - zero - held
            held += gain_held[k] * innovation
        white[k] = innovation
        zero = zero + gain_zero[k] * innovation
    return Whitened(np.swapaxes(white / np.sqrt(variance), 0, 1), np.log(variance[..., 0]).sum(axis=0))


def _by_row(of_draws: np.ndarray, count: int) -> list[Any]:
    """Values (n or 1, rows) by row: arrays (count,), or floats for one draw."""
    return (
        of_draws[0].tolist()
        if count == 1
        else list(np.ascontiguousarray(np.broadcast_to(of_draws, (count, of_draws.shape[1])).T))
    )

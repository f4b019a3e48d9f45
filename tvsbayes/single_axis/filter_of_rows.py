"""The Kalman filter over the rows of an axis: drift, and stop errors that are held or the seeing of readings in motion.

Two states, many draws at once; times in hours, variances in the square of the readings' unit. Formulation 8.2. NumPy.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tvsbayes.single_axis.axis_rows import AxisRows


def averaged_variance(over: np.ndarray) -> np.ndarray:
    """Variance of an exponentially correlated process' mean over a time, in units of its own; `over` its lasting."""
    far = np.maximum(over, 1e-3)
    return np.where(over > 1e-3, 2 / far * (1 + np.expm1(-far) / far), 1.0 - over / 3)


def whitened(
    columns: np.ndarray, rows: AxisRows, drift: np.ndarray, stop: np.ndarray, reading: np.ndarray, carry: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Columns in units of the scatter of drift, stop errors and readings, decorrelated: innovations of the filter.

    Args:
        columns: shape (n or 1, rows, c).
        rows: their times and segments.
        drift: variance per hour, shape (n,).
        stop: variances of stop errors or seeing, shape (n, rows).
        reading: variances of readings, shape (n, rows).
        carry: how much of the stop error or seeing of the row before each has; 0 where it is a new one, 1 where it is
            the same; shape (n or 1, rows).

    Returns:
        Innovations over their sd (n, rows, c), and the log-determinant of the scatter (n,).
    """
    n, count, width = len(drift), columns.shape[1], columns.shape[2]
    begins = np.append(False, rows.segment[1:] != rows.segment[:-1]).tolist()
    renewed = np.all(carry == 0, axis=0).tolist()
    # Numbers of one draw are plain floats: rows of a long record cost arithmetic, not calls.
    by_row = [_by_row(each, n) for each in (np.outer(drift, rows.hours), stop, reading, carry)]
    blocks = []
    p_zero = p_held = p_both = 0.0 * by_row[0][0]
    for k, (walked, scatter, noise, kept) in enumerate(zip(*by_row, strict=True)):
        if begins[k]:
            p_zero, p_both = 0.0 * p_zero, 0.0 * p_both
        p_zero = p_zero + walked
        if renewed[k]:
            p_held, p_both = scatter, 0.0 * p_both
        else:
            p_both = kept * p_both
            p_held = kept**2 * p_held + (1 - kept**2) * scatter
        variance = p_zero + 2 * p_both + p_held + noise
        gain_zero, gain_held = (p_zero + p_both) / variance, (p_held + p_both) / variance
        blocks.append((variance, gain_zero, gain_held))
        # Joseph's form: differences of large variances keep the rest positive.
        left_zero, left_held = 1 - gain_zero, 1 - gain_held
        after_zero = left_zero**2 * p_zero - 2 * left_zero * gain_zero * p_both + gain_zero**2 * (p_held + noise)
        after_held = left_held**2 * p_held - 2 * left_held * gain_held * p_both + gain_held**2 * (p_zero + noise)
        p_both = (
            (left_zero * left_held + gain_zero * gain_held) * p_both
            - left_zero * gain_held * p_zero
            - gain_zero * left_held * p_held
            + gain_zero * gain_held * noise
        )
        p_zero, p_held = after_zero, after_held
    # Shape (3, rows, n, 1).
    variance, gain_zero, gain_held = np.array(blocks).reshape(count, 3, n).swapaxes(0, 1)[..., None]
    white = np.empty((count, n, width))
    zero, held = np.zeros((n, width)), np.zeros((n, width))
    move_of_row = np.swapaxes(columns, 0, 1)
    kept = np.broadcast_to(carry, (n, count)).T[..., None]
    for k in range(count):
        if begins[k]:
            zero = np.zeros((n, width))
        if renewed[k]:
            innovation = move_of_row[k] - zero
            held = gain_held[k] * innovation
        else:
            held = kept[k] * held
            innovation = move_of_row[k] - zero - held
            held += gain_held[k] * innovation
        white[k] = innovation
        zero = zero + gain_zero[k] * innovation
    return np.swapaxes(white / np.sqrt(variance), 0, 1), np.log(variance[..., 0]).sum(axis=0)


def _by_row(of_draws: np.ndarray, count: int) -> list[Any]:
    """Numbers (n or 1, rows) of every row: arrays (count,), or floats of one draw."""
    return (
        of_draws[0].tolist()
        if count == 1
        else list(np.ascontiguousarray(np.broadcast_to(of_draws, (count, of_draws.shape[1])).T))
    )

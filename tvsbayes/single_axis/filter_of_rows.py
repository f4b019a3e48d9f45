"""The Kalman filter over the rows of an axis: drift, and stop errors that are held or the seeing of readings in motion.

Two states, many draws at once; times in hours, variances in the square of the readings' unit. Formulation 8.2. NumPy.
"""

from __future__ import annotations

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
    white = np.empty((n, count, width))
    log_scatter = np.zeros(n)
    zero, held = np.zeros((n, width)), np.zeros((n, width))
    p_zero, p_held, p_both = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(count):
        if k and rows.segment[k] != rows.segment[k - 1]:
            zero, p_zero, p_both = np.zeros((n, width)), np.zeros(n), np.zeros(n)
        p_zero = p_zero + drift * rows.hours[k]
        kept = carry[:, k]
        if np.all(kept == 0):
            held, p_held, p_both = np.zeros((n, width)), stop[:, k], np.zeros(n)
        else:
            held, p_both = kept[:, None] * held, kept * p_both
            p_held = kept**2 * p_held + (1 - kept**2) * stop[:, k]
        noise = reading[:, k]
        variance = p_zero + 2 * p_both + p_held + noise
        innovation = columns[:, k] - zero - held
        white[:, k] = innovation / np.sqrt(variance)[:, None]
        log_scatter += np.log(variance)
        gain_zero, gain_held = (p_zero + p_both) / variance, (p_held + p_both) / variance
        zero = zero + gain_zero[:, None] * innovation
        if k + 1 < count and np.any(carry[:, k + 1]):
            held = held + gain_held[:, None] * innovation
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
    return white, log_scatter

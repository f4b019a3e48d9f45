"""Figures of ISO 230-2 from positioning deviations: reversal, repeatability, systematic deviation, accuracy.

Any unit; fields are named in degrees, since the measured axes rotate. "Up" is the approach from below (left, up).
Clause numbers 2.11 to 2.20 of ISO 230-2:2006 are quoted from an independent implementation; the text of neither edition
was available, and further definitions have no number here.
"""

from __future__ import annotations

import numpy as np

from tvsbayes.results.metrology_tables import Positioning

RUNS_MIN = 2
"""Least number of runs: a standard deviation needs two."""


def figures_of(up_deg: np.ndarray, down_deg: np.ndarray) -> Positioning:
    """Compute ISO 230-2 figures from positioning deviations x_ij = actual - target.

    A common offset of all deviations does not change a figure. "Up" is the approach from below (left, up).

    Args:
        up_deg: deviations of upward runs, shape (..., m, n); NaN marks a missing run.
        down_deg: deviations of downward runs, shape (..., m, n').

    Returns:
        The figures, in the unit of the deviations.

    Raises:
        ValueError: shapes do not agree, or a target has fewer than two runs from one side.
    """
    up, down = np.asarray(up_deg, dtype=float), np.asarray(down_deg, dtype=float)
    if up.ndim < 2 or down.ndim < 2 or up.shape[:-1] != down.shape[:-1] or up.shape[-2] < 1:
        raise ValueError(f"deviations of shapes {up.shape} and {down.shape}; wanted (..., targets, runs) twice")
    for side in (up, down):
        if np.any(np.isinf(side)) or np.any(np.isfinite(side).sum(axis=-1) < RUNS_MIN):
            raise ValueError(f"every target needs at least {RUNS_MIN} finite runs from either side")
    # Mean unidirectional deviation at a position; 2.15 its estimated standard uncertainty s.
    mean_up, mean_down = np.nanmean(up, axis=-1), np.nanmean(down, axis=-1)
    sd_up, sd_down = np.nanstd(up, axis=-1, ddof=1), np.nanstd(down, axis=-1, ddof=1)
    # 2.11 mean bidirectional deviation, 2.12 reversal at a position.
    mean, reversal = 0.5 * (mean_up + mean_down), mean_up - mean_down
    # 2.16 and 2.17: repeatability at a position.
    r_up, r_down = 4 * sd_up, 4 * sd_down
    r = np.maximum(2 * sd_up + 2 * sd_down + np.abs(reversal), np.maximum(r_up, r_down))
    low_up, high_up = mean_up - 2 * sd_up, mean_up + 2 * sd_up
    low_down, high_down = mean_down - 2 * sd_down, mean_down + 2 * sd_down

    def span(high: np.ndarray, low: np.ndarray) -> np.ndarray:
        return high.max(axis=-1) - low.min(axis=-1)

    return Positioning(
        mean_up_deg=mean_up,
        mean_down_deg=mean_down,
        sd_up_deg=sd_up,
        sd_down_deg=sd_down,
        reversal_at_deg=reversal,
        reversal_deg=np.abs(reversal).max(axis=-1),
        mean_reversal_deg=reversal.mean(axis=-1),
        repeatability_up_deg=r_up.max(axis=-1),
        repeatability_down_deg=r_down.max(axis=-1),
        repeatability_deg=r.max(axis=-1),
        systematic_up_deg=span(mean_up, mean_up),
        systematic_down_deg=span(mean_down, mean_down),
        systematic_deg=span(np.maximum(mean_up, mean_down), np.minimum(mean_up, mean_down)),
        mean_systematic_deg=span(mean, mean),
        accuracy_up_deg=span(high_up, low_up),
        accuracy_down_deg=span(high_down, low_down),
        accuracy_deg=span(np.maximum(high_up, high_down), np.minimum(low_up, low_down)),
    )

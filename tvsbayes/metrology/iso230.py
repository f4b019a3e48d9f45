"""Figures of ISO 230-2 from positioning deviations: reversal, repeatability, systematic deviation, accuracy.

Any unit. "Up" is the approach from below: forward of an axis, left and up of a scanner. Clause numbers 2.11 to 2.20 of
ISO 230-2:2006 are quoted from an independent implementation; the text of neither edition was available, and further
definitions have no number here.
"""

from __future__ import annotations

import numpy as np

from tvsbayes.results.metrology_tables import FIGURES, Positioning

RUNS_MIN = 2
"""Least number of runs for a standard deviation."""


def _mean_and_s(runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (n - 1) of runs (..., n) without NaN; NaN where there are none, or fewer than two."""
    count = np.isfinite(runs).sum(axis=-1)
    mean = np.where(count > 0, np.nansum(runs, axis=-1) / np.maximum(count, 1), np.nan)
    square = np.nansum((runs - mean[..., None]) ** 2, axis=-1)
    return mean, np.where(count >= RUNS_MIN, np.sqrt(square / np.maximum(count - 1, 1)), np.nan)


def iso230(up: np.ndarray, down: np.ndarray) -> dict[str, np.ndarray]:
    """Compute figures by name from deviations x_ij = actual - target, (..., targets, runs) of either side.

    NaN marks a missing run, and a figure that the runs do not give: R and A of a side with fewer than two runs at a
    target, figures of both sides where one has none. A common offset changes no figure but the means.
    """
    (mean_up, s_up), (mean_down, s_down) = _mean_and_s(up), _mean_and_s(down)
    # 2.11 mean bidirectional deviation, 2.12 reversal at a position.
    mean, reversal = 0.5 * (mean_up + mean_down), mean_up - mean_down
    # 2.16 and 2.17: repeatability at a position, of either and of both sides.
    r_up, r_down = 4 * s_up, 4 * s_down
    r = np.maximum(2 * s_up + 2 * s_down + np.abs(reversal), np.maximum(r_up, r_down))
    low_up, high_up = mean_up - 2 * s_up, mean_up + 2 * s_up
    low_down, high_down = mean_down - 2 * s_down, mean_down + 2 * s_down

    def span(high: np.ndarray, low: np.ndarray) -> np.ndarray:
        return high.max(axis=-1) - low.min(axis=-1)

    return {
        **{"mean_up": mean_up, "mean_down": mean_down, "sd_up": s_up, "sd_down": s_down, "reversal_at": reversal},
        "reversal": np.abs(reversal).max(axis=-1),
        "mean_reversal": reversal.mean(axis=-1),
        "repeatability_up": r_up.max(axis=-1),
        "repeatability_down": r_down.max(axis=-1),
        "repeatability": r.max(axis=-1),
        "systematic_up": span(mean_up, mean_up),
        "systematic_down": span(mean_down, mean_down),
        "systematic": span(np.maximum(mean_up, mean_down), np.minimum(mean_up, mean_down)),
        "mean_systematic": span(mean, mean),
        "accuracy_up": span(high_up, low_up),
        "accuracy_down": span(high_down, low_down),
        "accuracy": span(np.maximum(high_up, high_down), np.minimum(low_up, low_down)),
    }


SYMBOLS = {name.removesuffix("_deg"): symbol for name, (symbol, _) in FIGURES.items()}
"""Letter of the standard by the name of a figure."""


def figures_of(up_deg: np.ndarray, down_deg: np.ndarray) -> Positioning:
    """Compute the complete figures of a scanner's axis.

    Args:
        up_deg: deviations of upward runs, shape (..., m, n); NaN marks a missing run.
        down_deg: deviations of downward runs, shape (..., m, n').

    Raises:
        ValueError: shapes do not agree, or a target has fewer than two runs from one side.
    """
    up, down = np.asarray(up_deg, dtype=float), np.asarray(down_deg, dtype=float)
    if up.ndim < 2 or down.ndim < 2 or up.shape[:-1] != down.shape[:-1] or up.shape[-2] < 1:
        raise ValueError(f"deviations of shapes {up.shape} and {down.shape}; wanted (..., targets, runs) twice")
    for side in (up, down):
        if np.any(np.isinf(side)) or np.any(np.isfinite(side).sum(axis=-1) < RUNS_MIN):
            raise ValueError(f"every target needs at least {RUNS_MIN} finite runs from either side")
    return Positioning(**{f"{name}_deg": value for name, value in iso230(up, down).items()})

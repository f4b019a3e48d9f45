"""A published test by ISO 230-2: means and standard deviations by position, and all figures."""

from __future__ import annotations

import numpy as np

VECTOR = np.array(
    [
        [-92.42, -92.02, 8.7920419, 6.2849025, -0.40, 35.168167],
        [-91.62, -101.22, 6.7675697, 7.2938330, 9.60, 37.722805],
        [-84.82, -90.82, 7.2594766, 10.4259292, 6.00, 41.703717],
        [-89.02, -88.62, 9.0000000, 12.1778487, -0.40, 48.711395],
        [-109.42, -121.62, 12.5817328, 15.7257750, 12.20, 68.815016],
    ]
)
"""Of 25 + 25 readings of paulscherrerinstitute/ecmccfg, examples/test/fat_sat/report.md, nm: means up and down, s up
and down, B_i, R_i."""


PUBLISHED = {
    "reversal_deg": 12.2,
    "mean_reversal_deg": 5.4,
    "repeatability_up_deg": 50.326931,
    "repeatability_down_deg": 62.903100,
    "repeatability_deg": 68.815016,
    "systematic_up_deg": 24.6,
    "systematic_down_deg": 33.0,
    "systematic_deg": 36.8,
    "mean_systematic_deg": 27.7,
    "accuracy_up_deg": 64.282419,
    "accuracy_down_deg": 88.807247,
    "accuracy_deg": 88.807247,
}


def vector_runs() -> tuple[np.ndarray, np.ndarray]:
    """Five runs each way with exactly the means and standard deviations of the table."""
    pattern = np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) / np.sqrt(2.5)
    return VECTOR[:, [0]] + VECTOR[:, [2]] * pattern, VECTOR[:, [1]] + VECTOR[:, [3]] * pattern

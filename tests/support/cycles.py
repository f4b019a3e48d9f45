"""Deviations of simulated test cycles by side."""

from __future__ import annotations

import numpy as np

from tvsbayes.metrology.simulated_cycles import simulated_runs


def up_and_down(*arguments, **options) -> tuple[np.ndarray, np.ndarray]:
    runs = simulated_runs(*arguments, **options)
    return runs.up_deg, runs.down_deg

"""Deviations of simulated test cycles by side."""

from __future__ import annotations

import numpy as np

from tvsbayes.metrology.simulated_cycles import simulated_runs


def up_and_down(*arguments, **options) -> tuple[np.ndarray, np.ndarray]:
    found = simulated_runs(*arguments, **options)
    return found.up_deg, found.down_deg

"""The bent rig with gears whose errors are known to a process, tight where looks reached and wide beyond."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tvsbayes.calibration.gear_table import GearTable
from tvsbayes.calibration.optics import GEAR_INPUTS
from tvsbayes.calibration.pointing import Calibration

STEPS = (tuple(np.linspace(-800.0, 800.0, 33).tolist()), tuple(np.linspace(-700.0, 700.0, 21).tolist()))
"""Table counters of (pan, tilt), 400 beyond what looks reached."""
SD_DEG = dict(zip(GEAR_INPUTS, (0.08, 0.05, 0.03, 0.02), strict=True))
"""Of each error away from the looks."""
KNOWN = 0.2
"""Of that, where looks reached."""


def geared(one: Calibration, seed: int = 4) -> Calibration:
    """A calibration of rigs whose gears vary: waves of random phase about a wave, as many as it has draws.

    The errors hang together with the ratios, as those of a fit do.
    """
    rng, table = np.random.default_rng(seed), GearTable(STEPS)
    columns = np.empty((len(one.inputs), table.size))
    for number, (name, part) in enumerate(table.parts.items()):
        axis = number % 2
        low, high = one.range_steps[axis]
        nodes, sd = np.array(STEPS[axis]), SD_DEG[name]
        phase, amplitude = rng.uniform(0, 2 * np.pi, (2, len(columns), 1)) * np.array([[[1.0]], [[0.0]]])
        amplitude = amplitude + rng.standard_normal((len(columns), 1)) * np.sqrt(2) * sd
        off = np.clip(np.maximum(low - nodes, nodes - high) / 150, 0, 1)
        wave = amplitude * np.cos(nodes / 130 + phase) * (KNOWN + (1 - KNOWN) * off)
        lean = (one.inputs[:, axis, None] - one.mean[axis]) * nodes * (1 - off)
        columns[:, part.start : part.stop - 1] = sd * np.sin(nodes / 90 + number) + wave - 0.5 * lean
        columns[:, part.stop - 1] = rng.standard_normal(len(columns)) * sd
        columns[:, part.stop - 1] -= columns[:, part.stop - 1].mean()
    inputs = np.concatenate([one.inputs, columns], axis=1)
    mean = np.concatenate([one.mean, columns.mean(axis=0)])
    mean[len(one.mean) + np.array([part.stop - 1 for part in table.parts.values()])] = 0.0
    covariance = np.cov(inputs, rowvar=False)
    covariance[: len(one.mean), : len(one.mean)] = one.covariance
    return replace(one, mean=mean, covariance=covariance, inputs=inputs, gears=table)


def constant(one: Calibration, **deg: float) -> Calibration:
    """A calibration whose gears have the same error at every counter, by `GEAR_INPUTS` with _ for its dots."""
    table = GearTable(STEPS)
    columns = np.zeros(table.size)
    for name, part in table.parts.items():
        columns[part] = deg.get(name.replace(".", "_"), 0.0)
    size = len(one.mean) + table.size
    covariance = np.zeros((size, size))
    covariance[: len(one.mean), : len(one.mean)] = one.covariance
    return replace(
        one,
        mean=np.concatenate([one.mean, columns]),
        covariance=covariance,
        inputs=np.concatenate([one.inputs, np.tile(columns, (len(one.inputs), 1))], axis=1),
        gears=table,
    )

"""Axes drawn from their priors: a drive at constant rate, scores of draws against the truth, and lines of a table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from experiments.common.page import line
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.waves import WavePeriods
from tvsbayes.statistics.chances import binomial_bounds, rms_bounds

RATE = 15.0
"""Of drives, arcsec per second."""


def drive(seed: int) -> AxisCampaign:
    """A log of 400 readings in 1600 s with seeing, and a period of 60 to 600 s that is looked for."""
    times = np.sort(np.random.default_rng([seed, 99]).uniform(0.0, 1600.0, 400))
    readings = tuple(Reading(k, 0, RATE * float(t), 0.5, "ok", float(t)) for k, t in enumerate(times))
    stated = {"per_command": AxisPrior(1.0, 1e-3), "transmission_error": AxisPrior(0.0, 5.0)}
    stated["reading_scale"] = AxisPrior(1.0, 0.0)
    periods = WavePeriods((), ((60.0, 600.0),), True)
    return AxisCampaign("arcsec", (AxisMove(0, 0, 0.0, 0.0, "forward"),), readings, stated, {"rate": RATE}, periods)


def scored(draws: np.ndarray, true: float) -> dict[str, float]:
    """How far the mean is off in sds, and the share of the draws below the truth."""
    return {"z": float((draws.mean() - true) / draws.std()), "below": float(np.mean(draws < true))}


def rms(z: Sequence[float]) -> str:
    """Of z, for a table."""
    return f"{np.sqrt(np.mean(np.square(z))):.2f}" if len(z) else ""


def scores_line(protocol: str, name: str, scores: Sequence[dict], *more: str) -> str:
    """A row: shares of truths in central 50 and 95 % intervals and RMS z, each with its bounds."""
    below = np.array([score["below"] for score in scores])
    cells = [protocol, f"`{name}`", str(len(scores))]
    for level in (0.5, 0.95):
        low, high = binomial_bounds(len(scores), level)
        cells += [f"{100 * np.mean(np.abs(below - 0.5) <= level / 2):.0f} %", f"{low:.2f} to {high:.2f}"]
    low, high = rms_bounds(len(scores))
    return line(*cells, rms([score["z"] for score in scores]), f"{low:.2f} to {high:.2f}", *more)

"""Simulated test cycles of ISO 230-2 on an axis, for the draws of a calibration.

Counters in steps, angles in degrees of the beam about the moving axis (azimuth for pan, elevation for tilt).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tvsbayes.calibration.optics import Number, beam_angle_deg, output_deg
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.instrument.axes import AXES, SIDES
from tvsbayes.statistics.streams import Stream, random_stream

RUNS = 5
"""Runs per side of the standard test cycle of ISO 230-2."""
TARGETS_MIN = 2
"""Least number of targets for a systematic deviation."""
LONG_TRAVEL_DEG, TARGETS, TARGETS_LONG = 180.0, 5, 8
"""Targets of a rotary axis by its travel (ISO 230-2, by secondary sources): see `targets_wanted`."""
SIMULATED_TESTS = 1000
"""Number of simulated tests for a predictive interval, whose ends then scatter by 0.1 sd."""


def targets_wanted(travel_deg: float) -> int:
    """Return the number of targets that ISO 230-2 requires over a travel of a rotary axis."""
    return TARGETS_LONG if abs(travel_deg) > LONG_TRAVEL_DEG else TARGETS


def target_steps(low: float, high: float, deg_per_step: float) -> tuple[int, ...]:
    """Choose ascending targets between two turning points: a random place in each of equal cells, as ISO 230-2 asks.

    So no gear tooth repeats. A range of fewer than three steps has none.
    """
    count = targets_wanted((high - low) * deg_per_step)
    places = np.arange(count) + 0.5 + random_stream(0, Stream.CYCLE_COUNTERS).uniform(-0.2, 0.2, count)
    targets = sorted({round(low + (high - low) * p / count) for p in places} - {round(low), round(high)})
    return tuple(targets) if len(targets) >= TARGETS_MIN else ()


def simulated_runs(
    calibration: Calibration,
    axis: str,
    targets: Sequence[int],
    deg_per_step: float,
    *,
    runs: int = RUNS,
    tests: int = SIMULATED_TESTS,
    contrast_deg_per_step: np.ndarray | None = None,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate deviations of ISO 230-2 test cycles for the draws of a calibration, other axis mid-way and in mid-play.

    A test is homed once at a turning point below the targets. Each run goes up through them, turns above them and comes
    back; play is taken up at every target, and every stop has a new error. There is no homing between runs, so that
    unequal ratios of the two directions shift every run by c times the travel.

    Args:
        calibration: with draws.
        axis: pan or tilt.
        targets: counters, shape (m,).
        deg_per_step: target angles are this times the counters.
        runs: runs per side.
        tests: number of tests, each with its own draw.
        contrast_deg_per_step: draws of the axis' ratio contrast in the order of `calibration.inputs`, shape (n,); None
            is zero. Coordinates do not depend on it, since a counter has its mean ratio after homing.
        seed: seed of the stop errors.

    Returns:
        Deviations from the target angles, deg, reached from below and from above, each (tests, m, runs).
    """
    rows = np.linspace(0, len(calibration.inputs) - 1, tests).astype(int)
    values: dict[str, Number] = {n: calibration.inputs[rows, k, None, None] for k, n in enumerate(calibration.names)}
    noise = dict(zip(NOISE_NAMES, calibration.noise[rows].T[..., None, None], strict=True))
    contrast = 0.0 if contrast_deg_per_step is None else np.asarray(contrast_deg_per_step)[rows, None, None]
    steps, own = np.asarray(targets, dtype=float)[:, None], AXES.index(axis)
    low, high, other = steps.min(), steps.max(), AXES[1 - own]
    middle = float(calibration.range_steps[1 - own].mean())
    counters = [steps[:, 0], np.full(len(steps), middle)][:: 1 - 2 * own]
    # Errors by position are taken at the counter: the shift by the contrast changes them far less.
    gears = calibration.gears.at(calibration.inputs[rows, len(INPUT_NAMES) :], (counters[0], counters[1]))
    values |= {name: errors[..., None] for name, errors in gears.items()}
    other_deg = output_deg(values, other, middle, 0.0, calibration.period_deg.get(other))
    # An upward step is k + c/2, a downward one k - c/2 (formulation 3.1): a cycle of 2 L steps gains c L.
    before = contrast * (high - low) * np.arange(runs)
    generator = random_stream(seed, Stream.CYCLES)

    def deviations(side: float, name: str, travel: np.ndarray) -> np.ndarray:
        counted = steps + (before + 0.5 * contrast * travel) / values[f"degrees_per_step.{axis}"]
        mirror = output_deg(values, axis, counted, side, calibration.period_deg.get(axis))
        error = generator.standard_normal((tests, len(steps), runs)) * noise[f"stop_sd_deg.{name}"]
        return np.asarray(beam_angle_deg(values, axis, mirror + error, other_deg) - deg_per_step * steps)

    falling, rising = SIDES[axis]
    return deviations(1.0, rising, steps - low), deviations(-1.0, falling, 2 * high - low - steps)

"""Simulated test cycles of ISO 230-2 on an axis, for the draws of a calibration.

Counters in steps, angles in degrees of the beam about the moving axis (azimuth for pan, elevation for tilt).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    """Choose target counters over a range: a random place in each of equal cells, so that no gear tooth repeats.

    ISO 230-2 requires targets P_i = (i - 1) p + r with random r.

    Args:
        low: lower end of the range, steps; both ends are turning points, not targets.
        high: upper end.
        deg_per_step: ratio, which with the range determines the number of targets.

    Returns:
        Ascending counters, at least two where the range has three steps; empty for a smaller range.
    """
    count = targets_wanted((high - low) * deg_per_step)
    places = np.arange(count) + 0.5 + random_stream(0, Stream.CYCLE_COUNTERS).uniform(-0.2, 0.2, count)
    targets = sorted({round(low + (high - low) * p / count) for p in places} - {round(low), round(high)})
    return tuple(targets) if len(targets) >= TARGETS_MIN else ()


@dataclass(frozen=True)
class Runs:
    """Deviations of runs from their target angles, deg, by the side from which targets are approached.

    Attributes:
        up_deg, down_deg: arrays (m, n) or (tests, m, n) of m targets and n runs; not a number where a run is missing.
    """

    up_deg: np.ndarray
    down_deg: np.ndarray


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
) -> Runs:
    """Simulate deviations of ISO 230-2 test cycles for the draws of a calibration.

    A test is homed once at a turning point below the targets. Each run goes up through them, turns above them and comes
    back; play is taken up at every target, and every stop has a new error. There is no homing between runs, so that
    unequal ratios of the two directions shift every run by c times the travel. The other axis is in mid-play at the
    middle of its counters.

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
        Arrays of shape (tests, m, runs).
    """
    rows = np.linspace(0, len(calibration.inputs) - 1, tests).astype(int)
    values: dict[str, Number] = {n: calibration.inputs[rows, k, None, None] for k, n in enumerate(calibration.names)}
    noise = {name: calibration.noise[rows, k, None, None] for k, name in enumerate(NOISE_NAMES)}
    contrast = 0.0 if contrast_deg_per_step is None else np.asarray(contrast_deg_per_step)[rows, None, None]
    steps = np.asarray(targets, dtype=float)[:, None]
    low, high = steps.min(), steps.max()
    other = AXES[1 - AXES.index(axis)]
    middle = float(calibration.range_steps[AXES.index(other)].mean())
    at = (steps[:, 0], np.full(len(steps), middle)) if axis == AXES[0] else (np.full(len(steps), middle), steps[:, 0])
    # Errors by position are taken at the counter: the shift by the contrast changes them far less.
    gear_errors = calibration.gears.at(calibration.inputs[rows, len(INPUT_NAMES) :], at)
    values |= {name: errors[..., None] for name, errors in gear_errors.items()}
    other_deg = output_deg(values, other, middle, 0.0, calibration.period_deg.get(other))
    ratio = values[f"degrees_per_step.{axis}"]
    # An upward step is k + c/2, a downward one k - c/2 (formulation 3.1): a cycle of 2 L steps gains c L.
    before = contrast * (high - low) * np.arange(runs)
    gained = {1.0: before + 0.5 * contrast * (steps - low), -1.0: before + 0.5 * contrast * (2 * high - low - steps)}
    generator = random_stream(seed, Stream.CYCLES)
    result = []
    for side, name in ((1.0, SIDES[axis][1]), (-1.0, SIDES[axis][0])):
        counted = steps + gained[side] / ratio
        mirror = output_deg(values, axis, counted, side, calibration.period_deg.get(axis))
        error = generator.standard_normal((tests, len(steps), runs)) * noise[f"stop_sd_deg.{name}"]
        result.append(beam_angle_deg(values, axis, mirror + error, other_deg) - deg_per_step * steps)
    return Runs(*result)

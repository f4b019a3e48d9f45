"""Test cycles of ISO 230-2 on an axis, simulated on the rigs that the data allow.

Counters in steps, angles in degrees of the beam about the axis that turns (azimuth for pan, elevation for tilt).
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
"""A systematic deviation needs two targets."""
LONG_TRAVEL_DEG, TARGETS, TARGETS_LONG = 180.0, 5, 8
"""Targets of a rotary axis by its travel (ISO 230-2, by secondary sources): see `targets_wanted`."""
SIMULATED_TESTS = 1000
"""Tests drawn for a predictive interval: its ends then scatter by 0.1 sd."""


def targets_wanted(travel_deg: float) -> int:
    """Number of targets that ISO 230-2 asks for over a travel of a rotary axis."""
    return TARGETS_LONG if abs(travel_deg) > LONG_TRAVEL_DEG else TARGETS


def target_steps(low: float, high: float, deg_per_step: float, seed: int = 0) -> tuple[int, ...]:
    """Target counters over a range: equal cells, a place in each that no gear tooth repeats.

    ISO 230-2 wants targets P_i = (i - 1) p + r with random r.

    Args:
        low: lower end of the range, steps; both ends are turn-round points and no targets.
        high: upper end.
        deg_per_step: decides with the range how many targets there are.
        seed: of the places.

    Returns:
        Rising counters, at least two where the range has three steps; empty for a smaller range.
    """
    count = targets_wanted((high - low) * deg_per_step)
    places = np.arange(count) + 0.5 + random_stream(seed, Stream.CYCLE_COUNTERS).uniform(-0.2, 0.2, count)
    targets = sorted({round(low + (high - low) * p / count) for p in places} - {round(low), round(high)})
    return tuple(targets) if len(targets) >= TARGETS_MIN else ()


@dataclass(frozen=True)
class Runs:
    """Deviations of the runs of a test from their target angles, deg, by the side from which targets are approached.

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
    """Deviations of ISO 230-2 test cycles on the rigs that the data allow.

    A test is homed once at a turn-round point below the targets; each run goes up through them, turns round above
    them and comes back; play is taken up at every target; every stop draws its error. Runs follow each other without
    homing, so that unequal ratios of the two directions carry every run on by c times the travel. The other axis rests
    in mid-play at the middle of its counters.

    Args:
        calibration: with draws.
        axis: pan or tilt.
        targets: counters, shape (m,).
        deg_per_step: target angles are this times the counters.
        runs: per side.
        tests: number of tests, each on a draw of its own.
        contrast_deg_per_step: draws of the axis' ratio contrast in the order of `calibration.inputs`, shape (n,);
            None is none. Coordinates never see it, since a counter stands for its mean ratio after homing.
        seed: of the stop errors.

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
    # What repeats by position is taken at the counter: what the contrast has gained by then moves it by far less.
    gear_errors = calibration.gears.at(calibration.inputs[rows, len(INPUT_NAMES) :], at)
    values |= {name: errors[..., None] for name, errors in gear_errors.items()}
    other_deg = output_deg(values, other, middle, 0.0, calibration.period_deg.get(other))
    ratio = values[f"degrees_per_step.{axis}"]
    # Upwards a step is k + c/2, downwards k - c/2 (formulation 3.1): a whole cycle of 2 L steps gains c L.
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

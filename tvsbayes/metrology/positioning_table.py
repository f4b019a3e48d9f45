"""The ISO 230-2-style table of an axis: posterior predictive figures, and those of the campaign's own stops.

Angles in degrees of the beam about the moving axis (azimuth for pan, elevation for tilt); counters in steps. Nothing is
fitted here and no angle standard is involved: the notes of a table state its basis. No JAX.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import structs

from tvsbayes.calibration.optics import beam_angle_deg, beam_deg_per_step, output_deg
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.errors import plural
from tvsbayes.instrument.axes import AXES
from tvsbayes.metrology.iso230 import RUNS_MIN, figures_of
from tvsbayes.metrology.simulated_cycles import (
    RUNS,
    SIMULATED_TESTS,
    TARGETS_MIN,
    simulated_runs,
    target_steps,
    targets_wanted,
)
from tvsbayes.results.metrology_tables import FIGURES, AxisPositioning, Positioning, Predicted

INDIRECT = (
    "ISO 230-2-style and indirect: angles of the beam are inferred from spots in two cameras through the fitted model; "
    "no angle standard measured them"
)
OWN_STOPS = (
    "plug-in: s and B hold what moved over the campaign beside stop errors: pixel noise, home offsets, drift, and what "
    "unequal ratios of the two directions add up to; maxima of few runs are too large"
)
SIMULATED = (
    "predicted: {} simulated tests of {} runs per side, homed once before each test, drawn from the {}; a difference "
    "between the ratios of the two directions carries run after run on"
)
DEFINITIONS = "definitions of ISO 230-2 as secondary sources give them"
NOT_COVERED = (
    "drift, temperature and load: every run is taken to be made under the conditions of the campaign",
    "errors of the gears that neither play, ratio nor the stated harmonics describe",
    "an error that all looks of the cameras share: it is in the predicted E, M and A through the ratio, and in no "
    "plug-in figure",
)


@dataclass(frozen=True)
class StopReadings:
    """Mirror angles at the stops of one axis, inferred from the spots by the fitted geometry.

    Attributes:
        axis: pan or tilt.
        steps: counter of each stop, shape (n,).
        side: +1 reached left or up, -1 right or down, shape (n,).
        mirror_deg: mirror angle, stop errors and home offsets included, shape (n,).
        u_deg: its standard uncertainty from pixel noise alone, shape (n,).
        play_left_out: number of stops left out, whose last move may not have taken up the play.
        reference_pose_deg: pan and tilt of the fit's reference pose.
        values: parameters at the mode, by name.
    """

    axis: str
    steps: np.ndarray
    side: np.ndarray
    mirror_deg: np.ndarray
    u_deg: np.ndarray
    play_left_out: int
    reference_pose_deg: tuple[float, float]
    values: Mapping[str, float]


def _with_own_stops(table: AxisPositioning, readings: StopReadings, wanted: int) -> AxisPositioning:
    """Add the figures of the campaign's stops, or why there are none; `wanted` is ISO's number of targets."""
    u = float(np.sqrt(np.mean(readings.u_deg**2))) if len(readings.u_deg) else None
    notes, left_out = [], readings.play_left_out
    if left_out:
        notes = [f"plug-in: {left_out} stops left out whose play was not taken up for certain"]
    runs = {
        int(n): [np.flatnonzero((readings.steps == n) & (readings.side == s)) for s in (1, -1)]
        for n in np.unique(readings.steps)
    }
    usable = {n: pair for n, pair in runs.items() if min(map(len, pair)) >= RUNS_MIN}
    if len(usable) < TARGETS_MIN:
        counters = f"{plural(len(usable), 'counter')}"
        reason = (
            f"{counters} of the {readings.axis} axis with at least {RUNS_MIN} stops from either side; {TARGETS_MIN} "
            f"are needed, ISO 230-2 asks for {wanted} with {RUNS} runs"
        )
        return structs.replace(table, missing=reason, reading_u_deg=u, notes=tuple(notes))
    other = readings.reference_pose_deg[1 - AXES.index(readings.axis)]
    angle = beam_angle_deg(readings.values, readings.axis, readings.mirror_deg, other)
    deviation = angle - table.deg_per_step * readings.steps
    counts = tuple((len(up), len(down)) for up, down in usable.values())
    by_side = np.full((2, len(usable), max(map(max, counts))), np.nan)
    for k, pair in enumerate(usable.values()):
        for side, rows in enumerate(pair):
            by_side[side, k, : len(rows)] = deviation[rows]
    fewest = min(map(min, counts))
    if len(usable) < wanted or fewest < RUNS:
        made = f"plug-in: {len(usable)} targets, at least {fewest} runs per side"
        notes.insert(0, f"{made}; ISO 230-2 asks for {wanted} targets and {RUNS} runs")
    return structs.replace(
        table,
        plug_in=figures_of(*by_side),
        plug_in_steps=tuple(usable),
        plug_in_runs=counts,
        reading_u_deg=u,
        missing=None,
        notes=(OWN_STOPS, *notes),
    )


def _predicted(figures: Positioning) -> dict[str, Predicted]:
    """Compute median and interval of every figure over simulated tests."""
    quantiles = {name: np.quantile(getattr(figures, name), [0.025, 0.5, 0.975]).tolist() for name in FIGURES}
    return {name: Predicted(middle, (low, high)) for name, (low, middle, high) in quantiles.items()}


def _middle_deg_per_step(calibration: Calibration, axis: str) -> float:
    """Compute the beam's mean ratio of both directions at the middle of the counters, in mid-play."""
    counters = calibration.range_steps.mean(axis=1).tolist()
    estimates = calibration.estimates_at((counters[0], counters[1]))
    pan, tilt = (
        float(output_deg(estimates, a, n, 0.0, calibration.period_deg.get(a)))
        for a, n in zip(AXES, counters, strict=True)
    )
    return beam_deg_per_step(estimates, axis, (pan, tilt))


def positioning(
    calibration: Calibration,
    axis: str,
    *,
    readings: StopReadings | None = None,
    deg_per_step: float | None = None,
    targets: Sequence[int] | None = None,
    tests: int = SIMULATED_TESTS,
    contrast_deg_per_step: np.ndarray | None = None,
) -> AxisPositioning:
    """Build the ISO 230-2-style table of an axis: posterior predictive, and of the campaign's own stops.

    Args:
        calibration: with draws.
        axis: pan or tilt.
        readings: from `stop_readings`; None omits the plug-in table.
        deg_per_step: ratio of target angles to counters. None is the calibrated mean of both directions at the middle
            of the counters, as a user of the calibration would take; the design ratio gives the uncalibrated axis.
        targets: counters of the simulated tests; None spreads them over the campaign's range.
        tests: number of simulated tests.
        contrast_deg_per_step: draws of the ratio contrast, as in `simulated_runs`.

    Raises:
        ValueError: the calibration has no draws.
    """
    if not len(calibration.inputs):
        raise ValueError("this calibration has no draws: read it from results/draws.npz")
    low, high = calibration.range_steps[AXES.index(axis)]
    ratio = _middle_deg_per_step(calibration, axis) if deg_per_step is None else float(deg_per_step)
    chosen = target_steps(low, high, ratio) if targets is None else tuple(map(int, targets))
    predicted, made = None, f"no prediction: the {axis} axis was never moved over a range"
    if chosen:
        contrast = contrast_deg_per_step
        cycles = simulated_runs(calibration, axis, chosen, ratio, tests=tests, contrast_deg_per_step=contrast)
        predicted, made = _predicted(figures_of(*cycles)), SIMULATED.format(tests, RUNS, calibration.estimator)
    table = AxisPositioning(
        axis=axis,
        deg_per_step=ratio,
        predicted=predicted,
        target_steps=chosen,
        runs=RUNS,
        estimator=calibration.estimator,
        plug_in=None,
        plug_in_steps=(),
        plug_in_runs=(),
        reading_u_deg=None,
        missing="no stops were given",
        notes=(),
    )
    if readings is not None:
        table = _with_own_stops(table, readings, targets_wanted((high - low) * ratio))
    notes = (INDIRECT, *table.notes, made, DEFINITIONS, *(f"not covered: {text}" for text in NOT_COVERED))
    return structs.replace(table, notes=notes)

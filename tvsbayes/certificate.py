"""What a metrologist signs under: ISO 230-2-style figures, GUM uncertainty budgets, a DCC-schema XML.

Beam angles in degrees, about the axis that turns (azimuth for pan, elevation for tilt); counters in steps; mm where a
name says so. Nothing is fitted here: fits, calibrations and `results/fit.json` come in, results and bytes go out.
No JAX.

Clause numbers 2.11 to 2.20 of ISO 230-2:2006 are those that an independent implementation carries; neither edition's
text was at hand, and further definitions have no number here (research/report.md section 3). GUM = JCGM 100:2008.
"""

from __future__ import annotations

import base64
import datetime
import hashlib
import importlib
import json
import math
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.calibration import (
    AXES,
    INPUT_NAMES,
    NOISE_NAMES,
    NORMAL_95,
    SIDES,
    Calibration,
    beam_components,
    output_deg,
)
from tvsbayes.campaign import APPROACH_SIGN, Campaign, Move, input_hashes
from tvsbayes.classic import coverage_factor, effective_dof
from tvsbayes.files import (
    JSON_BYTES_MAX,
    InputError,
    Keys,
    NotConverged,
    escaped,
    parse_json,
    read_bytes,
    shipped_data,
    shown,
)

if TYPE_CHECKING:
    from tvsbayes.comparison import Budget
    from tvsbayes.information import Estimate, HeadlineCauses
    from tvsbayes.joint import JointFit

PROBABILITY = 0.95
RUNS = 5
"""Runs per side of the standard test cycle of ISO 230-2."""
RUNS_MIN, TARGETS_MIN = 2, 2
"""A standard deviation needs two runs, a systematic deviation two targets."""
LONG_TRAVEL_DEG, TARGETS, TARGETS_LONG = 180.0, 5, 8
"""Targets of a rotary axis by its travel (research/report.md section 3, unverified): see `targets_wanted`."""
SIMULATED_TESTS = 1000
"""Tests drawn for a predictive interval: its ends then scatter by 0.1 sd."""
INDIRECT = (
    "ISO 230-2-style and indirect: angles of the beam are inferred from spots in two cameras through the fitted model; "
    "no angle standard measured them"
)
NOT_COVERED = (
    "drift, temperature and load: every run is taken to be made under the conditions of the campaign",
    "errors of the gears that neither play, ratio nor the stated harmonics describe",
    "an error that all looks of the cameras share: it is in the predicted E, M and A through the ratio, and in no "
    "plug-in figure",
)
FIGURES: dict[str, tuple[str, str]] = {
    "reversal_deg": ("B", "reversal error of the axis"),
    "mean_reversal_deg": ("mean B", "mean reversal error"),
    "repeatability_up_deg": ("R up", "unidirectional repeatability, up"),
    "repeatability_down_deg": ("R down", "unidirectional repeatability, down"),
    "repeatability_deg": ("R", "bidirectional repeatability"),
    "systematic_up_deg": ("E up", "unidirectional systematic deviation, up"),
    "systematic_down_deg": ("E down", "unidirectional systematic deviation, down"),
    "systematic_deg": ("E", "bidirectional systematic deviation"),
    "mean_systematic_deg": ("M", "mean bidirectional deviation"),
    "accuracy_up_deg": ("A up", "unidirectional accuracy, up"),
    "accuracy_down_deg": ("A down", "unidirectional accuracy, down"),
    "accuracy_deg": ("A", "bidirectional accuracy"),
}
"""Fields of `Positioning` that are one number per test: symbol and term of ISO 230-2."""


@dataclass(frozen=True)
class Positioning:
    """ISO 230-2 figures of one axis. Any leading axes (...) are tests; m targets.

    Attributes:
        mean_up_deg, mean_down_deg: mean deviation per target and side, shape (..., m).
        sd_up_deg, sd_down_deg: their standard deviations (n - 1), shape (..., m).
        reversal_at_deg: B_i, up minus down, signed, shape (..., m).
        reversal_deg: B = max |B_i|; mean_reversal_deg: mean of B_i, signed; shape (...), as all that follow.
        repeatability_deg: R; repeatability_up_deg, repeatability_down_deg: of one side.
        systematic_deg: E; systematic_up_deg, systematic_down_deg: of one side.
        mean_systematic_deg: M.
        accuracy_deg: A; accuracy_up_deg, accuracy_down_deg: of one side.
    """

    mean_up_deg: np.ndarray
    mean_down_deg: np.ndarray
    sd_up_deg: np.ndarray
    sd_down_deg: np.ndarray
    reversal_at_deg: np.ndarray
    reversal_deg: np.ndarray
    mean_reversal_deg: np.ndarray
    repeatability_up_deg: np.ndarray
    repeatability_down_deg: np.ndarray
    repeatability_deg: np.ndarray
    systematic_up_deg: np.ndarray
    systematic_down_deg: np.ndarray
    systematic_deg: np.ndarray
    mean_systematic_deg: np.ndarray
    accuracy_up_deg: np.ndarray
    accuracy_down_deg: np.ndarray
    accuracy_deg: np.ndarray

    def as_json(self) -> dict[str, object]:
        """Every field as a number or nested lists."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}


def iso230(up_deg: np.ndarray, down_deg: np.ndarray) -> Positioning:
    """ISO 230-2 figures from positioning deviations x_ij = actual - target.

    A common offset of all deviations changes no figure. "Up" is the approach from below (left, up).

    Args:
        up_deg: deviations of runs that arrived upwards, shape (..., m, n); NaN marks a run that was not made.
        down_deg: the same downwards, shape (..., m, n').

    Returns:
        The figures; any unit will do, all come back in the unit of the deviations.

    Raises:
        ValueError: shapes do not agree, or a target has fewer than two runs from one side.
    """
    up, down = np.asarray(up_deg, dtype=float), np.asarray(down_deg, dtype=float)
    if up.ndim < 2 or down.ndim < 2 or up.shape[:-1] != down.shape[:-1] or up.shape[-2] < 1:
        raise ValueError(f"deviations of shapes {up.shape} and {down.shape}; wanted (..., targets, runs) twice")
    for side in (up, down):
        if np.any(np.isinf(side)) or np.any(np.isfinite(side).sum(axis=-1) < RUNS_MIN):
            raise ValueError(f"every target needs at least {RUNS_MIN} finite runs from either side")
    # Mean unidirectional deviation at a position; 2.15 its estimated standard uncertainty s.
    mean_up, mean_down = np.nanmean(up, axis=-1), np.nanmean(down, axis=-1)
    sd_up, sd_down = np.nanstd(up, axis=-1, ddof=1), np.nanstd(down, axis=-1, ddof=1)
    # 2.11 mean bidirectional deviation, 2.12 reversal at a position.
    mean, reversal = 0.5 * (mean_up + mean_down), mean_up - mean_down
    # 2.16 and 2.17: repeatability at a position.
    r_up, r_down = 4 * sd_up, 4 * sd_down
    r = np.maximum(2 * sd_up + 2 * sd_down + np.abs(reversal), np.maximum(r_up, r_down))
    low_up, high_up = mean_up - 2 * sd_up, mean_up + 2 * sd_up
    low_down, high_down = mean_down - 2 * sd_down, mean_down + 2 * sd_down

    def span(high: np.ndarray, low: np.ndarray) -> np.ndarray:
        return high.max(axis=-1) - low.min(axis=-1)

    return Positioning(
        mean_up_deg=mean_up,
        mean_down_deg=mean_down,
        sd_up_deg=sd_up,
        sd_down_deg=sd_down,
        reversal_at_deg=reversal,
        reversal_deg=np.abs(reversal).max(axis=-1),
        mean_reversal_deg=reversal.mean(axis=-1),
        repeatability_up_deg=r_up.max(axis=-1),
        repeatability_down_deg=r_down.max(axis=-1),
        repeatability_deg=r.max(axis=-1),
        systematic_up_deg=span(mean_up, mean_up),
        systematic_down_deg=span(mean_down, mean_down),
        systematic_deg=span(np.maximum(mean_up, mean_down), np.minimum(mean_up, mean_down)),
        mean_systematic_deg=span(mean, mean),
        accuracy_up_deg=span(high_up, low_up),
        accuracy_down_deg=span(high_down, low_down),
        accuracy_deg=span(np.maximum(high_up, high_down), np.minimum(low_up, low_down)),
    )


@dataclass(frozen=True)
class StopReadings:
    """Mirror angles at the stops of one axis, as the spots told them and the fitted geometry reads them.

    Attributes:
        axis: pan or tilt.
        steps: counter of each stop, shape (n,).
        side: +1 reached left or up, -1 right or down, shape (n,).
        mirror_deg: mirror angle, shape (n,); stop errors and home offsets are in it.
        u_deg: its standard uncertainty from pixel noise alone, shape (n,).
        play_left_out: stops whose last move may not have taken up the play.
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


@dataclass(frozen=True)
class _Rest:
    """Where an axis stands after a move; `leg` is the distance of the last move, infinite after homing."""

    number: int
    steps: int
    side: int
    leg: float


def _rests(moves: Sequence[Move], axis: str) -> list[_Rest]:
    """The stop at which an axis stands after every move: a new one whenever its counter changed (DESIGN 3.1)."""
    rests: list[_Rest] = []
    for move in moves:
        steps, approach = getattr(move, f"{axis}_steps"), getattr(move, f"{axis}_approach")
        if approach:
            last = _Rest(move.move, steps, APPROACH_SIGN[approach], math.inf)
        elif steps != rests[-1].steps:
            distance = steps - rests[-1].steps
            # Moves on in the same sense keep the play taken up.
            same = rests[-1].side * distance > 0
            leg = abs(distance) + (rests[-1].leg if same else 0.0)
            last = _Rest(move.move, steps, 1 if distance > 0 else -1, leg)
        else:
            last = rests[-1]
        rests.append(last)
    return rests


def stop_readings(fit: JointFit, axis: str) -> StopReadings:
    """What the spots say of every stop of an axis, before any stop error is shrunk towards zero.

    At each stop the mirror angle that fits its spots best (`joint.SpotDeviations`, weighted by their noise), added to
    the angle that counters and play predict.

    Args:
        fit: a converged fit.
        axis: pan or tilt.

    Returns:
        One row per stop with a known side and the play taken up for certain.
    """
    index = AXES.index(axis)
    values = dict(zip(fit.names, np.asarray(fit.mode.physical, dtype=float).tolist(), strict=True))
    spots = sorted((s for s in fit.campaign.spots if s.status == "ok"), key=lambda s: (s.move, s.spot))
    rests = _rests(fit.campaign.moves, axis)
    needed = values[f"backlash_deg.{axis}"] / abs(values[f"degrees_per_step.{axis}"])
    seen = fit.linearised.spot_deviations()
    sums: dict[int, list[float]] = {}
    left_out = set()
    for row, spot in enumerate(spots):
        rest = rests[spot.move]
        variance = float(seen.covariance_rad2[row, index, index])
        if spot.spot in fit.excluded_spots or variance <= 0:
            continue
        if rest.side == 0 or rest.leg < needed:
            left_out.add(rest.number)
            continue
        entry = sums.setdefault(rest.number, [0.0, 0.0, float(fit.linearised.mirror_angles_rad[row, index])])
        entry[0] += 1 / variance
        entry[1] += float(seen.deviation_rad[row, index]) / variance
    kept = [(rests[move], entry) for move, entry in sums.items()]
    return StopReadings(
        axis=axis,
        steps=np.array([rest.steps for rest, _ in kept], dtype=int),
        side=np.array([rest.side for rest, _ in kept], dtype=int),
        mirror_deg=np.degrees([angle + pull / weight for _, (weight, pull, angle) in kept]),
        u_deg=np.degrees([weight**-0.5 for _, (weight, _, _) in kept]),
        play_left_out=len(left_out),
        reference_pose_deg=tuple(np.degrees(fit.reference_pose_rad).tolist()),
        values=values,
    )


def _beam_deg(values: Mapping[str, object], axis: str, mirror_deg, other_deg) -> np.ndarray:
    """Beam angle about one axis: azimuth less its value C0 - 90 deg, or elevation; whole turns are kept."""
    pan, tilt = (mirror_deg, other_deg) if axis == "pan" else (other_deg, mirror_deg)
    _, (u, v, w) = beam_components(values, pan, tilt)
    if axis == "tilt":
        return np.degrees(np.arcsin(w))
    nominal = pan + values["pan_zero_emission_deg"] - 90.0
    off = np.degrees(np.arctan2(v, u)) - nominal
    return pan + (off + 180.0) % 360.0 - 180.0


def beam_deg_per_step(values: Mapping[str, float], axis: str, pose_deg: tuple[float, float]) -> float:
    """Mean of both directions' effective degrees per step at mirror angles (pan, tilt), as DESIGN 3.2 defines it."""
    index, half = AXES.index(axis), 1e-3
    here, other = pose_deg[index], pose_deg[1 - index]
    ends = [_beam_deg(values, axis, np.float64(here + s * half), np.float64(other)) for s in (1, -1)]
    return float(values[f"degrees_per_step.{axis}"] * (ends[0] - ends[1]) / (2 * half))


@dataclass(frozen=True)
class Predicted:
    """Median and equal-tailed 95 % interval of a figure over simulated tests."""

    median: float
    interval95: tuple[float, float]


@dataclass(frozen=True)
class AxisPositioning:
    """ISO 230-2-style table of one axis.

    Attributes:
        axis: pan or tilt.
        deg_per_step: targets are this times the counter.
        predicted: field of `FIGURES` -> median and interval over tests simulated from the draws; None if the axis
            never moved.
        target_steps: targets of the simulated tests.
        runs: simulated runs per target and side.
        estimator: "posterior" or "laplace": where the draws come from.
        plug_in: figures of the campaign's own stops, no leading axis; None where `missing` says why.
        plug_in_steps: counters of its targets.
        plug_in_runs: runs (up, down) at each of them.
        reading_u_deg: root mean square standard uncertainty of one reading from pixel noise, which is in every s.
        missing: why there is no plug-in table.
        notes: that it is indirect, what it rests on and what it does not cover.
    """

    axis: str
    deg_per_step: float
    predicted: dict[str, Predicted] | None
    target_steps: tuple[int, ...]
    runs: int
    estimator: str
    plug_in: Positioning | None
    plug_in_steps: tuple[int, ...]
    plug_in_runs: tuple[tuple[int, int], ...]
    reading_u_deg: float | None
    missing: str | None
    notes: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """Plain values; tuples become lists."""
        document = {name: value for name, value in vars(self).items() if name not in ("predicted", "plug_in")}
        predicted = self.predicted and {name: asdict(p) for name, p in self.predicted.items()}
        document |= {"predicted": predicted, "plug_in": self.plug_in and self.plug_in.as_json()}
        return json.loads(json.dumps(document, allow_nan=False))


def targets_wanted(travel_deg: float) -> int:
    """Number of targets that ISO 230-2 asks for over a travel of a rotary axis."""
    return TARGETS_LONG if abs(travel_deg) > LONG_TRAVEL_DEG else TARGETS


def target_steps(low: float, high: float, deg_per_step: float, seed: int = 0) -> tuple[int, ...]:
    """Target counters over a range: equal cells, a place in each that no gear tooth repeats.

    ISO 230-2 wants targets P_i = (i - 1) p + r with random r (research/report.md section 3).

    Args:
        low: lower end of the range, steps; both ends are turn-round points and no targets.
        high: upper end.
        deg_per_step: decides with the range how many targets there are.
        seed: of the places.

    Returns:
        Rising counters, at least two where the range has three steps; empty for a smaller range.
    """
    count = targets_wanted((high - low) * deg_per_step)
    places = np.arange(count) + 0.5 + np.random.default_rng([seed, 230]).uniform(-0.2, 0.2, count)
    found = sorted({round(low + (high - low) * p / count) for p in places} - {round(low), round(high)})
    return tuple(found) if len(found) >= TARGETS_MIN else ()


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
    values = {name: calibration.inputs[rows, k, None, None] for k, name in enumerate(INPUT_NAMES)}
    noise = {name: calibration.noise[rows, k, None, None] for k, name in enumerate(NOISE_NAMES)}
    contrast = 0.0 if contrast_deg_per_step is None else np.asarray(contrast_deg_per_step)[rows, None, None]
    steps = np.asarray(targets, dtype=float)[:, None]
    low, high = steps.min(), steps.max()
    other = AXES[1 - AXES.index(axis)]
    middle = float(calibration.range_steps[AXES.index(other)].mean())
    other_deg = output_deg(values, other, middle, 0.0, calibration.period_deg.get(other))
    ratio = values[f"degrees_per_step.{axis}"]
    # Upwards a step is k + c/2, downwards k - c/2 (DESIGN 3.1): a whole cycle of 2 L steps gains c L.
    before = contrast * (high - low) * np.arange(runs)
    gained = {1.0: before + 0.5 * contrast * (steps - low), -1.0: before + 0.5 * contrast * (2 * high - low - steps)}
    generator = np.random.default_rng([seed, 2302])
    result = []
    for side, name in ((1.0, SIDES[axis][1]), (-1.0, SIDES[axis][0])):
        counted = steps + gained[side] / ratio
        mirror = output_deg(values, axis, counted, side, calibration.period_deg.get(axis))
        error = generator.standard_normal((tests, len(steps), runs)) * noise[f"stop_sd_deg.{name}"]
        result.append(_beam_deg(values, axis, mirror + error, other_deg) - deg_per_step * steps)
    return Runs(*result)


@dataclass(frozen=True)
class _PlugIn:
    """Figures of the campaign's own stops, their targets and runs from either side, or why there are none."""

    figures: Positioning | None
    steps: tuple[int, ...] = ()
    runs: tuple[tuple[int, int], ...] = ()
    missing: str | None = None


def _plug_in(readings: StopReadings, deg_per_step: float, wanted: int) -> _PlugIn:
    runs = {
        int(n): [np.flatnonzero((readings.steps == n) & (readings.side == s)) for s in (1, -1)]
        for n in np.unique(readings.steps)
    }
    usable = {n: pair for n, pair in runs.items() if min(map(len, pair)) >= RUNS_MIN}
    if len(usable) < TARGETS_MIN:
        both = f"{len(usable)} counter{'s' * (len(usable) != 1)}"
        reason = (
            f"{both} of the {readings.axis} axis with at least {RUNS_MIN} stops from either side; {TARGETS_MIN} "
            f"are needed, ISO 230-2 asks for {wanted} with {RUNS} runs"
        )
        return _PlugIn(None, missing=reason)
    other = readings.reference_pose_deg[1 - AXES.index(readings.axis)]
    deviation = _beam_deg(readings.values, readings.axis, readings.mirror_deg, other) - deg_per_step * readings.steps
    longest = max(len(rows) for pair in usable.values() for rows in pair)
    table = np.full((2, len(usable), longest), np.nan)
    for k, pair in enumerate(usable.values()):
        for side, rows in enumerate(pair):
            table[side, k, : len(rows)] = deviation[rows]
    counts = tuple((len(a), len(b)) for a, b in usable.values())
    return _PlugIn(iso230(table[0], table[1]), tuple(usable), counts)


def positioning(
    calibration: Calibration,
    axis: str,
    *,
    readings: StopReadings | None = None,
    deg_per_step: float | None = None,
    targets: Sequence[int] | None = None,
    runs: int = RUNS,
    tests: int = SIMULATED_TESTS,
    contrast_deg_per_step: np.ndarray | None = None,
    seed: int = 0,
) -> AxisPositioning:
    """The ISO 230-2-style table of an axis: posterior predictive, beside the campaign's own stops.

    Args:
        calibration: with draws.
        axis: pan or tilt.
        readings: of `stop_readings`; None leaves the plug-in table out.
        deg_per_step: what turns counters into target angles: None takes the calibrated mean of both directions at the
            middle of the counters, as a user of the calibration would; give the design ratio to see the uncalibrated
            axis.
        targets: counters of the simulated tests; None spreads them over the campaign's range.
        runs: as in `simulated_runs`, like the next three.
        tests: number of simulated tests.
        contrast_deg_per_step: draws of the ratio contrast.
        seed: of targets and stop errors.

    Returns:
        The table, with what it does not cover.

    Raises:
        ValueError: the calibration holds no draws.
    """
    if not len(calibration.inputs):
        raise ValueError("this calibration has no draws: read it from results/draws.npz")
    index, estimates = AXES.index(axis), calibration.estimates
    low, high = calibration.range_steps[index]
    middle = calibration.range_steps.mean(axis=1)
    pose = tuple(
        float(output_deg(estimates, a, n, 0.0, calibration.period_deg.get(a)))
        for a, n in zip(AXES, middle, strict=True)
    )
    ratio = beam_deg_per_step(estimates, axis, pose) if deg_per_step is None else float(deg_per_step)
    chosen = target_steps(low, high, ratio, seed) if targets is None else tuple(map(int, targets))
    predicted = None
    if chosen:
        drawn = simulated_runs(
            calibration,
            axis,
            chosen,
            ratio,
            runs=runs,
            tests=tests,
            contrast_deg_per_step=contrast_deg_per_step,
            seed=seed,
        )
        found = iso230(drawn.up_deg, drawn.down_deg)
        predicted = {}
        for name in FIGURES:
            lower, middle_value, upper = np.quantile(getattr(found, name), [0.025, 0.5, 0.975])
            predicted[name] = Predicted(float(middle_value), (float(lower), float(upper)))
    own = _PlugIn(None, missing="no stops were given")
    notes = [INDIRECT]
    reading_u = None
    if readings is not None:
        wanted = targets_wanted((high - low) * ratio)
        own = _plug_in(readings, ratio, wanted)
        if len(readings.u_deg):
            reading_u = float(np.sqrt(np.mean(readings.u_deg**2)))
        if own.figures is not None:
            notes.append(
                "plug-in: s and B hold what moved over the campaign beside stop errors: pixel noise, home offsets, "
                "drift, and what unequal ratios of the two directions add up to; maxima of few runs are too large"
            )
            fewest = min(min(pair) for pair in own.runs)
            if len(own.steps) < wanted or fewest < RUNS:
                notes.append(
                    f"plug-in: {len(own.steps)} targets, at least {fewest} runs per side; ISO 230-2 asks for "
                    f"{wanted} targets and {RUNS} runs"
                )
        if readings.play_left_out:
            notes.append(f"plug-in: {readings.play_left_out} stops left out whose play was not taken up for certain")
    if chosen:
        notes.append(
            f"predicted: {tests} simulated tests of {runs} runs per side, homed once before each test, drawn from the "
            f"{calibration.estimator}; a difference between the ratios of the two directions carries run after run on"
        )
    else:
        notes.append(f"no prediction: the {axis} axis was never moved over a range")
    notes.append("definitions of ISO 230-2 as secondary sources give them")
    return AxisPositioning(
        axis=axis,
        deg_per_step=ratio,
        predicted=predicted,
        target_steps=chosen,
        runs=runs,
        estimator=calibration.estimator,
        plug_in=own.figures,
        plug_in_steps=own.steps,
        plug_in_runs=own.runs,
        reading_u_deg=reading_u,
        missing=own.missing,
        notes=(*notes, *(f"not covered: {text}" for text in NOT_COVERED)),
    )


@dataclass(frozen=True)
class Source:
    """An input quantity of a budget.

    Attributes:
        quantity, unit: its name and the unit of estimate and u; unit "1" for a standardised effect.
        estimate: its value, None where it is no single quantity.
        u: standard uncertainty.
        kind: "A" by statistics of the campaign, "B" otherwise (GUM 4.2, 4.3), "A, B" for a parameter fitted from both.
        distribution: from which u comes.
        dof: degrees of freedom of u (GUM G.4), infinite where it is taken as known.
        sensitivity: change of the result per unit of the quantity.
    """

    quantity: str
    unit: str
    estimate: float | None
    u: float
    kind: str
    distribution: str
    dof: float
    sensitivity: float


@dataclass(frozen=True)
class BudgetRow:
    """A line of a budget; fields as in `Source`, None where a line sums up several or is the correlation row.

    `contribution` is sensitivity times u, signed, in the unit of the result; `share` is of the combined variance and
    negative where correlations take variance away.
    """

    quantity: str
    unit: str
    estimate: float | None
    u: float | None
    kind: str
    distribution: str
    dof: float | None
    sensitivity: float | None
    contribution: float | None
    share: float


@dataclass(frozen=True)
class BudgetTable:
    """A GUM uncertainty budget.

    Attributes:
        quantity, unit: of the result.
        estimate: the result.
        rows: largest contribution first; the last one is `CORRELATIONS`, so that the shares sum to 1.
        u: combined standard uncertainty (GUM 5.1.2, 5.2.2).
        dof: effective degrees of freedom (GUM eq. G.2b), infinite where no input's are finite.
        coverage_factor: k = t_p(dof) (GUM G.4.1).
        probability: coverage probability p.
        expanded: U = k u.
        notes: what the reader must know.
    """

    quantity: str
    unit: str
    estimate: float
    rows: tuple[BudgetRow, ...]
    u: float
    dof: float
    coverage_factor: float
    probability: float
    expanded: float
    notes: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """Infinite degrees of freedom become null."""

        def finite(entry: dict[str, object]) -> dict[str, object]:
            dof = entry["dof"]
            return {**entry, "dof": None if dof is None or math.isinf(dof) else dof}

        document = finite(asdict(self))
        return {**document, "rows": [finite(row) for row in document["rows"]], "notes": list(self.notes)}


CORRELATIONS = "correlations, and what linear propagation leaves"
SMALL_SHARE = 1e-3
"""Inputs below this share of the variance are summed up in one line."""
INDEPENDENCE = (
    "effective degrees of freedom by Welch-Satterthwaite (GUM G.4.1), which takes the inputs as independent: with a "
    "large correlation row they are approximate"
)


def budget_table(
    quantity: str,
    unit: str,
    estimate: float,
    u: float,
    sources: Sequence[Source],
    *,
    probability: float = PROBABILITY,
    notes: Sequence[str] = (),
) -> BudgetTable:
    """Assemble a budget.

    Args:
        quantity: name of the result.
        unit: its unit.
        estimate: its value.
        u: its combined standard uncertainty, correlations and all: what the rows do not reach is the correlation row.
        sources: input quantities.
        probability: of U.
        notes: put before the standing one.

    Returns:
        The table.

    Raises:
        ValueError: u is not positive, or a number is not finite.
    """
    contributions = [s.sensitivity * s.u for s in sources]
    if not (u > 0 and math.isfinite(u) and all(map(math.isfinite, (estimate, *contributions)))):
        raise ValueError(f"{quantity}: a budget needs finite contributions and a positive uncertainty, not {u}")
    shares = [(c / u) ** 2 for c in contributions]
    rows, small = [], []
    for source, contribution, share in sorted(zip(sources, contributions, shares, strict=True), key=lambda x: -x[2]):
        if share < SMALL_SHARE:
            small.append((source, contribution, share))
        else:
            rows.append(BudgetRow(**vars(source), contribution=contribution, share=share))
    if small:
        kinds = sorted({kind for source, _, _ in small for kind in source.kind.split(", ")})
        several = (f"{len(small)} further inputs, each below {100 * SMALL_SHARE:g} %", "", None, None, ", ".join(kinds))
        together = math.sqrt(sum(c**2 for _, c, _ in small))
        rows.append(BudgetRow(*several, "", None, None, together, sum(share for _, _, share in small)))
    rows.append(BudgetRow(CORRELATIONS, "", None, None, "", "", None, None, None, 1 - sum(shares)))
    dof = effective_dof(u, contributions, [s.dof for s in sources])
    k = coverage_factor(dof, probability)
    return BudgetTable(quantity, unit, estimate, tuple(rows), u, dof, k, probability, k * u, (*notes, INDEPENDENCE))


UNIT_ENDINGS = (
    ("_deg_per_step", "deg/step"),
    ("degrees_per_step", "deg/step"),
    ("_deg", "deg"),
    ("_mm", "mm"),
    ("_rad", "rad"),
)


def unit_of(name: str) -> str:
    """Unit of a contract name (DESIGN 8): `backlash_deg.pan` -> deg; "1" where it has none."""
    stem = name.split(".")[0]
    if name.startswith("extrinsics."):
        stem = name.split(".")[1]
    return next((unit for ending, unit in UNIT_ENDINGS if stem.endswith(ending)), "1")


def headline_budget(causes: HeadlineCauses, quantity: str, estimate: Estimate) -> BudgetTable:
    """The budget of an effective ratio or a backlash, by cause.

    Rows are independent of each other: noise of the campaign, the cameras' calibration as one, and every stated prior.
    An estimate moves by c when the centre of a prior moves by one unit.

    Args:
        causes: of `information.headline_causes`.
        quantity: one of its quantities.
        estimate: what is reported of it, Laplace or posterior; its sd is the combined uncertainty.
    """
    row = causes.quantities.index(quantity)
    sources = []
    for k, name in enumerate(causes.names):
        contribution, dof = float(causes.contribution[row, k]), float(causes.dof[row, k])
        if math.isnan(causes.u[k]):
            kind = "B" if name.startswith("stereo") else "A"
            sources.append(
                Source(name, unit_of(quantity), None, abs(contribution), kind, causes.distribution[k], dof, 1.0)
            )
            continue
        log, u = causes.distribution[k] == "log-normal", float(causes.u[k])
        label = f"prior of ln {name}" if log else f"prior of {name}"
        unit = "1" if log else unit_of(name)
        values = (label, unit, float(causes.centre[k]), u, "B", causes.distribution[k], dof, contribution / u)
        sources.append(Source(*values))
    notes = (
        "inputs are independent; the last row is what the curvature of the density and the spread of the noise scales "
        "add to linear propagation",
    )
    return budget_table(quantity, unit_of(quantity), estimate.value, estimate.sd, sources, notes=notes)


_UNIT_NOISES = {
    "stop error pan": ("A", "normal", 1.0),
    "stop error tilt": ("A", "normal", 1.0),
    "place in the play, pan": ("B", "uniform", 12**-0.5),
    "place in the play, tilt": ("B", "uniform", 12**-0.5),
    "aperture noise": ("B", "normal", 1.0),
}
"""Noises of one look, as `coordinates` carries them: in units of their own scale."""


def coordinate_budget(
    budget: Budget, calibration: Calibration, xyz_mm: Sequence[float], component: str, *, by: str = "parameter"
) -> BudgetTable:
    """The budget of x, y or z of one located point.

    Args:
        budget: of `comparison.budget`.
        calibration: behind it.
        xyz_mm: the point, frame T, mm.
        component: "x", "y" or "z".
        by: "parameter": every parameter of the calibration and noise of the look, which are correlated; "cause": what
            its uncertainty comes from, independent.

    Raises:
        ValueError: another component or kind.
    """
    if component not in ("x", "y", "z") or by not in ("parameter", "cause"):
        raise ValueError(f"component {component!r} by {by!r}; allowed: x, y, z by parameter or cause")
    index = "xyz".index(component)
    u = math.sqrt(float(budget.covariance_mm2[index, index]))
    sources = []
    if by == "cause":
        notes = ("by cause; the causes are independent",)
        for name, variance in zip(budget.causes, budget.variance_mm2[:, index].tolist(), strict=True):
            noise = name.startswith(("pixel", "stop error"))
            sources.append(
                Source(name, "mm", None, math.sqrt(variance), "A" if noise else "B", "normal", math.inf, 1.0)
            )
    else:
        notes = ("by parameter; parameters fitted together are correlated (GUM 5.2.2)",)
        sd = np.sqrt(np.diag(calibration.covariance)).tolist()
        known = {
            n: (unit_of(n), e, s, "A, B", "normal") for (n, e), s in zip(calibration.estimates.items(), sd, strict=True)
        }
        for name, moved in zip(budget.parameters, budget.contribution_mm[:, index].tolist(), strict=True):
            if name in known:
                unit, estimate, width, kind, shape = known[name]
            else:
                (kind, shape, width), unit, estimate = _UNIT_NOISES[name], "1", 0.0
            if width > 0:
                sources.append(Source(name, unit, estimate, width, kind, shape, math.inf, moved / width))
    return budget_table(f"{component} of the point", "mm", float(xyz_mm[index]), u, sources, notes=notes)


DCC_VERSION = "3.3.0"
DCC_NAMESPACES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
"""DCC 3.3.0 imports D-SI 2.2.1, whose namespace carries no version (research/report.md section 4)."""
UNIT_SI = {"deg/step": r"\degree\per\one", "deg": r"\degree", "mm": r"\milli\metre"}
"""D-SI has no unit for a count: steps are `\\one`."""
NOT_STATED = "not stated"
COUNTRY_NOT_STATED = "ZZ"
"""User-assigned in ISO 3166-1: valid for the schema, named by PTB's Schematron."""
EXPANDED_SYMMETRY = 0.25
"""Standard uncertainties by which the middle of the 95 % interval may lie off the value before an interval is given
instead of an expanded uncertainty."""
NOT_ACCREDITED = (
    "This document is not an accredited calibration certificate. It was written by software from a campaign of its "
    "user in the format of the DCC schema; it is not signed, and nobody but its user vouches for it."
)
ITEM_ONLY = "The results relate only to the item named here, in the state and under the conditions of the campaign."
METHOD = (
    "Joint Bayesian estimate of gear ratios, backlash, mirror geometry and camera pose from the pixels of laser spots "
    "seen by a calibrated stereo pair at several depths; angles are inferred through cameras and model, no angle "
    "standard measured them. Effective degrees of the beam per motor step hold at the stated pose of the mirrors. "
    "U is half the 95 % interval, k = U/u."
)
REFERENCE, NORMS = "doi:10.3390/metrology5040058", ("JCGM 100:2008", "JCGM 101:2008")
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, escaped or not."""
_RELEASE = re.compile(r"(?:[0-9]{1,3}\.){0,3}[0-9]{1,3}(?![0-9])")
_XSD_SECONDS = 60


FIT_FORMATS = ("tvsbayes-fit/1",)
"""Versions of `results/fit.json` that can be read; the schema of each is in `data/schemas`."""
SCHEMA_PROBLEMS = 20
"""Among which the one to name is chosen: a document of another making has thousands."""


@cache
def _fit_validator(version: str):
    from jsonschema import Draft202012Validator

    path = shipped_data() / "schemas" / f"fit-{version}.schema.json"
    return Draft202012Validator(json.loads(path.read_text(encoding="utf-8")))


def _schema_problem(values: object, version: str) -> tuple[list[str | int], str] | None:
    """The place that most likely breaks the schema of `fit.json`, as keys and list indices, and what is allowed."""
    from jsonschema.exceptions import best_match

    error = best_match(islice(_fit_validator(version).iter_errors(values), SCHEMA_PROBLEMS))
    if error is None:
        return None
    place, rule = list(error.absolute_path), error.validator_value
    if "propertyNames" in error.absolute_schema_path:
        # jsonschema gives the place of the table whose key is wrong.
        place.append(error.instance)
    match error.validator:
        case "required":
            return [*place, next(name for name in rule if name not in error.instance)], "this key"
        case "additionalProperties":
            known = error.schema.get("properties", {})
            return [*place, next(name for name in error.instance if name not in known)], "no such key"
        case "type":
            return place, rule if isinstance(rule, str) else " or ".join(rule)
        case "const":
            return place, shown(rule)
        case "enum":
            return place, " or ".join(map(shown, rule))
        case other:
            return place, f"{other} {shown(rule)}"


def _check_agreement(keys: Keys) -> None:
    """What no schema can say: sizes that belong together, names that others stand for."""
    again = "run `tvsbayes fit` again"
    covariance = keys.table("covariance")
    count = len(covariance.values["names"])
    if any(len(row) != count for row in [covariance.values["matrix"], *covariance.values["matrix"]]):
        raise covariance.refuse("matrix", "shape", f"{count} rows of {count} numbers", again)
    keys.integer("seed", 0, 2**63 - 1)
    keys.text_value("command", 20_000)
    for name in ("python", "tvsbayes", *keys.table("versions").values):
        keys.table("versions").text_value(name)


def read_fit(path: Path | str) -> dict[str, object]:
    """Read `results/fit.json` of any version: what reports and certificates are written from, held to its schema.

    Raises:
        InputError: missing, damaged or of an unknown version, with the key.
    """
    keys = parse_json(read_bytes(Path(path), JSON_BYTES_MAX), escaped(Path(path).name))
    version = keys.word("format", FIT_FORMATS).removeprefix("tvsbayes-fit/")
    if problem := _schema_problem(keys.values, version):
        place, allowed = problem
        value: object = keys.values
        for part in place:
            value = value[part] if isinstance(part, int) else value.get(part, "nothing")
        # An entry of a list is named by the key of the list.
        *path, key = (part for part in place if isinstance(part, str))
        table = Keys({}, keys.file, keys.text, tuple(path))
        raise table.refuse(key, "schema", allowed, "run `tvsbayes fit` again", shown(value))
    _check_agreement(keys)
    return keys.values


def _plain(value: object) -> str:
    """Text that the schema takes: no character XML cannot hold, single spaces, never empty."""
    return " ".join(_FORBIDDEN.sub("\ufffd", str(value)).split()) or NOT_STATED


def _add(parent: ET.Element, tag: str, text: object | None = None, **attributes: str) -> ET.Element:
    element = ET.SubElement(parent, tag, attributes)
    if text is not None:
        element.text = _plain(text)
    return element


def _words(parent: ET.Element, tag: str, *texts: object, **attributes: str) -> ET.Element:
    """A `textType` or `richContentType`: one `dcc:content` a paragraph."""
    element = _add(parent, tag, **attributes)
    # The Schematron allows each language once per element.
    _add(element, "dcc:content", " ".join(map(_plain, texts)), lang="en")
    return element


def _decimals(u: float) -> int:
    """Decimals at which u keeps two significant digits (GUM 7.2.6)."""
    return max(0, 1 - int(f"{u:.1e}".split("e")[1]))


def _real(
    parent: ET.Element,
    unit: str,
    value: float,
    u: float | None,
    interval95: tuple[float, float] | None = None,
    distribution: str = "normal",
) -> None:
    """An `si:real` with no, a standard, an expanded uncertainty or an interval, two digits of uncertainty."""
    numbers = [value, *(() if u is None else (u,)), *(interval95 or ())]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"a certificate needs finite numbers, not {numbers}")
    real = _add(parent, "si:real")
    if not u:
        _add(real, "si:value", repr(float(value)))
        _add(real, "si:unit", unit)
        return
    low, high = interval95 or (value, value)
    expanded, middle = 0.5 * (high - low), 0.5 * (high + low)
    k = expanded / u
    # A coverage factor below 1 is no D-SI coverage factor.
    symmetric = interval95 is not None and k >= 1 and abs(middle - value) <= EXPANDED_SYMMETRY * u
    places = _decimals(expanded if symmetric else u)
    _add(real, "si:value", f"{value:.{places}f}")
    _add(real, "si:unit", unit)
    uncertainty = _add(real, "si:measurementUncertaintyUnivariate")
    if interval95 is None:
        standard = _add(uncertainty, "si:standardMU")
        _add(standard, "si:valueStandardMU", f"{u:.{places}f}")
        _add(standard, "si:distribution", distribution)
    elif symmetric:
        box = _add(uncertainty, "si:expandedMU")
        _add(box, "si:valueExpandedMU", f"{expanded:.{places}f}")
        _add(box, "si:coverageFactor", f"{k:.2f}")
        _add(box, "si:coverageProbability", f"{PROBABILITY:.2f}")
        _add(box, "si:distribution", distribution)
    else:
        box = _add(uncertainty, "si:coverageIntervalMU")
        _add(box, "si:valueStandardMU", f"{u:.{places}f}")
        _add(box, "si:intervalMin", f"{low:.{places}f}")
        _add(box, "si:intervalMax", f"{high:.{places}f}")
        _add(box, "si:coverageProbability", f"{PROBABILITY:.2f}")
        _add(box, "si:distribution", distribution)


def _quantity(parent: ET.Element, name: str, entry: Mapping[str, object] | None, unit: str, estimator: str) -> None:
    """A measured value of `fit.json`; one that was never moved or never estimated says so instead of a number."""
    quantity = _add(parent, "dcc:quantity", refType="basic_measuredValue")
    _words(quantity, "dcc:name", name)
    if entry is None:
        _words(quantity, "dcc:noQuantity", "no value: the axis was never moved in this direction")
        return
    low, high = entry["interval95"]
    shape = "normal" if estimator == "laplace" else "sampled posterior"
    _real(quantity, UNIT_SI[unit], entry["value"], entry["sd"], (low, high), shape)


def _dates(campaign: Campaign, issued: datetime.date) -> tuple[datetime.date, datetime.date, bool]:
    """First and last day of the campaign, and whether they were recorded."""
    created = campaign.header.get("created")
    if created is None:
        return issued, issued, False
    if not isinstance(created, datetime.datetime):
        return created, created, True
    # Times of moves count from any instant: a clock, or the start of the campaign.
    seconds = campaign.moves[-1].time_s - campaign.moves[0].time_s if campaign.moves else 0.0
    try:
        return created.date(), (created + datetime.timedelta(seconds=seconds)).date(), True
    except OverflowError:
        return created.date(), created.date(), True


def _contact(parent: ET.Element, tag: str, name: str, country: str, *, place: bool = True) -> ET.Element:
    contact = _add(parent, tag)
    _words(contact, "dcc:name", name)
    if place:
        _add(_add(contact, "dcc:location"), "dcc:countryCode", country)
    return contact


def _software(parent: ET.Element, tag: str, document: Mapping[str, object], **attributes: str) -> None:
    versions = document["versions"]
    software = _add(_add(parent, tag), "dcc:software", **attributes)
    _words(software, "dcc:name", "tvsbayes")
    # PTB's Schematron wants a letter and up to four numbers; the whole version stands in the description.
    found = _RELEASE.match(str(versions["tvsbayes"]))
    _add(software, "dcc:release", f"v{found.group() if found else '0'}")
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    _words(software, "dcc:description", f"{listed}; seed {document['seed']}; command: {document['command']}")


def _administrative(
    root: ET.Element,
    campaign: Campaign,
    document: Mapping[str, object],
    issued: datetime.date,
    identifier: str,
    laboratory: str,
    customer: str,
    country: str,
) -> None:
    header = campaign.header
    data = _add(root, "dcc:administrativeData")
    _software(data, "dcc:dccSoftware", document)
    core = _add(data, "dcc:coreData")
    _add(core, "dcc:countryCodeISO3166_1", country)
    _add(core, "dcc:usedLangCodeISO639_1", "en")
    _add(core, "dcc:mandatoryLangCodeISO639_1", "en")
    _add(core, "dcc:uniqueIdentifier", identifier)
    begin, end, recorded = _dates(campaign, issued)
    _add(core, "dcc:beginPerformanceDate", begin.isoformat())
    _add(core, "dcc:endPerformanceDate", end.isoformat())
    _add(core, "dcc:performanceLocation", "other")
    _add(core, "dcc:issueDate", issued.isoformat())
    item = _add(_add(data, "dcc:items"), "dcc:item", id="item")
    _words(item, "dcc:name", header.get("instrument") or "stepper-driven two-mirror laser positioner")
    serials = _add(item, "dcc:identifications")
    for value, name in ((header.get("serial") or NOT_STATED, "serial"), (header.get("name") or NOT_STATED, "campaign")):
        identification = _add(serials, "dcc:identification")
        _add(identification, "dcc:issuer", "other")
        _add(identification, "dcc:value", value)
        _words(identification, "dcc:name", name)
    place = _add(data, "dcc:calibrationLaboratory")
    _contact(place, "dcc:contact", laboratory, country)
    for name in ("dcc:cryptElectronicSeal", "dcc:cryptElectronicSignature", "dcc:cryptElectronicTimeStamp"):
        _add(place, name, "false")
    person = _add(_add(data, "dcc:respPersons"), "dcc:respPerson")
    _contact(person, "dcc:person", str(header.get("operator") or NOT_STATED), country, place=False)
    _add(person, "dcc:role", "operator of the campaign")
    _add(person, "dcc:mainSigner", "false")
    _contact(data, "dcc:customer", customer, country)
    statements = _add(data, "dcc:statements")

    def state(name: str, text: str, traceable: bool | None = None) -> None:
        statement = _add(statements, "dcc:statement")
        _words(statement, "dcc:name", name)
        if traceable is not None:
            _add(statement, "dcc:traceable", "true" if traceable else "false")
        _words(statement, "dcc:declaration", text)

    state("accreditation", NOT_ACCREDITED)
    found = traceability(campaign)
    state("traceability", found.statement, found.declared)
    state("scope", ITEM_ONLY)
    validation = document.get("validation")
    if validation is not None and not validation["passed"]:
        text = f"VALIDATION FAILED: {validation['cause']}. Uncertainties are stated as fitted; multiply every one of "
        state("validation", f"{text}them by {validation['inflation']:.2f}.")
    if header.get("synthetic"):
        state("synthetic data", "The campaign was simulated: no instrument was measured.")
    if not recorded:
        state("dates", "The campaign does not record its date; the date of issue stands for it.")
    if country == COUNTRY_NOT_STATED:
        state("country", f"The country was not stated; {COUNTRY_NOT_STATED} stands for it.")


@dataclass(frozen=True)
class Traceability:
    """What may be said of traceability.

    Attributes:
        statement: a sentence for certificates and reports.
        declared: the campaign names the certificate of its length standard, which nobody checks here.
    """

    statement: str
    declared: bool


def traceability(campaign: Campaign) -> Traceability:
    """The campaign's word on its length standard, passed on, not checked; simulated data are never traceable."""
    declared = campaign.header.get("traceability", {})
    certificate = _plain(declared.get("board_certificate", ""))
    if campaign.header.get("synthetic"):
        return Traceability("Simulated data: not traceable.", False)
    if certificate == NOT_STATED:
        text = "Not traceable: the campaign names no certificate of the length standard (the calibration board)."
        return Traceability(text, False)
    text = f"As declared by the user and not verified here: length from the board with certificate {certificate}."
    return Traceability(text, True)


def _equipment(parent: ET.Element, campaign: Campaign) -> None:
    declared = campaign.header.get("traceability", {})
    stereo = campaign.stereo
    listed = _add(parent, "dcc:measuringEquipments")
    cameras = _add(listed, "dcc:measuringEquipment", id="cameras")
    _words(cameras, "dcc:name", "stereo camera pair")
    text = f"2 x {stereo.image_width} x {stereo.image_height} px, calibration residual {stereo.rms_px:.3g} px rms"
    if stereo.assumed:
        text += "; covariance of the calibration assumed, not estimated"
    if "stereo_calibrated" in declared:
        text += f"; calibrated {declared['stereo_calibrated']}"
    _words(cameras, "dcc:description", text)
    board = _add(listed, "dcc:measuringEquipment", id="board", refType="basic_normalUsed")
    _words(board, "dcc:name", "calibration board (length standard)")
    identification = _add(_add(board, "dcc:identifications"), "dcc:identification")
    _add(identification, "dcc:issuer", "other")
    _add(identification, "dcc:value", declared.get("board_certificate", NOT_STATED))
    _words(identification, "dcc:name", "certificate as declared by the user")
    if "pitch_mm" in declared:
        quantity = _add(_add(board, "dcc:measuringEquipmentQuantities"), "dcc:measuringEquipmentQuantity")
        _words(quantity, "dcc:name", "pitch")
        _real(quantity, UNIT_SI["mm"], declared["pitch_mm"]["value"], declared["pitch_mm"]["u"])


def _conditions(parent: ET.Element, campaign: Campaign) -> None:
    stated = campaign.header.get("environment", {})
    conditions = _add(parent, "dcc:influenceConditions")
    for key, name, unit, kind in (
        ("temperature_degC", "temperature", r"\degreecelsius", "basic_temperature"),
        ("humidity_percent", "relative humidity", r"\percent", "basic_humidityRelative"),
    ):
        condition = _add(conditions, "dcc:influenceCondition", refType=kind)
        _words(condition, "dcc:name", name)
        data = _add(condition, "dcc:data")
        if key in stated:
            quantity = _add(data, "dcc:quantity", refType="basic_measuredValue")
            _words(quantity, "dcc:name", name)
            _real(quantity, unit, stated[key]["value"], stated[key]["u"])
        else:
            _words(data, "dcc:text", "not recorded")


def certificate_identifier(campaign: Campaign, document: Mapping[str, object], issued: datetime.date) -> str:
    """A name that data, priors, results and date determine: `tvsbayes-` and 32 hexadecimal digits."""
    results = {key: document[key] for key in ("inputs", "effective_deg_per_step", "parameters", "estimator")}
    text = json.dumps([results, str(campaign.header.get("name")), issued.isoformat()], sort_keys=True)
    return f"tvsbayes-{hashlib.sha256(text.encode()).hexdigest()[:32]}"


def dcc_bytes(
    campaign: Campaign,
    document: Mapping[str, object],
    *,
    issued: datetime.date,
    identifier: str | None = None,
    laboratory: str = NOT_STATED,
    customer: str = NOT_STATED,
    country: str = COUNTRY_NOT_STATED,
    report: bytes | None = None,
) -> bytes:
    """DCC-schema XML of a fit: unsigned, not accredited, traceable only as far as the campaign declares.

    Args:
        campaign: what was fitted; names are taken as given and stay text.
        document: content of `results/fit.json`.
        issued: date of issue; the same inputs and date give the same bytes.
        identifier: unique identifier; None makes one from inputs, results and date.
        laboratory: name of who measured.
        customer: name of for whom.
        country: ISO 3166-1 code of the place, two capital letters.
        report: the HTML report to embed.

    Returns:
        UTF-8 XML, DCC 3.3.0.

    Raises:
        InputError: a country that is no code, or results of other data or priors than the campaign's.
        NotConverged: the fit behind the results has not converged.
    """
    if not re.fullmatch("[A-Z]{2}", country):
        raise InputError(
            "country",
            f"country {escaped(country)!r}",
            column="country",
            found=escaped(country),
            allowed="two capital letters of ISO 3166-1, such as MX or DE",
            remedy="give the country in which the campaign was measured",
        )
    if document["inputs"] != input_hashes(campaign):
        raise InputError(
            "stale-results",
            "results/fit.json belongs to other data or priors than the campaign",
            file="fit.json",
            remedy="run `tvsbayes fit` on the campaign again",
        )
    if not document["converged"]:
        raise NotConverged(
            "not-converged",
            "no certificate of a fit that has not converged",
            remedy="run `tvsbayes fit` on the campaign again",
        )
    names = {f"xmlns:{prefix}": uri for prefix, uri in DCC_NAMESPACES.items()}
    # Prefixes are written out: registering them would change ElementTree for the whole process.
    root = ET.Element("dcc:digitalCalibrationCertificate", {**names, "schemaVersion": DCC_VERSION})
    name = identifier or certificate_identifier(campaign, document, issued)
    _administrative(root, campaign, document, issued, name, laboratory, customer, country)
    part = _add(_add(root, "dcc:measurementResults"), "dcc:measurementResult", refId="item")
    _words(part, "dcc:name", "degrees of beam per motor step, and backlash")
    estimator, pose = str(document["estimator"]), document["reference_pose_deg"]
    where = f"at mirror angles pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} deg"
    kind = "posterior draws" if estimator == "posterior" else "the Laplace approximation of the posterior"
    _words(part, "dcc:description", f"Effective ratios hold {where}. Values and intervals from {kind}.")
    method = _add(_add(part, "dcc:usedMethods"), "dcc:usedMethod", id="method")
    _words(method, "dcc:name", "joint estimate from stereo spots")
    texts = [METHOD, *(f"Method as named by the user: {t}" for t in [campaign.header.get("method")] if t)]
    _words(method, "dcc:description", *texts)
    for norm in NORMS:
        _add(method, "dcc:norm", norm)
    _add(method, "dcc:reference", REFERENCE)
    _software(part, "dcc:usedSoftware", document, id="software")
    _equipment(part, campaign)
    _conditions(part, campaign)
    results = _add(part, "dcc:results")
    data = _result(results, "effective degrees of beam per motor step")
    for direction, entry in document["effective_deg_per_step"].items():
        _quantity(data, f"effective degrees per step, {direction}", entry, "deg/step", estimator)
    data = _result(results, "backlash")
    for axis in AXES:
        moved = any(document["effective_deg_per_step"][d] is not None for d in SIDES[axis])
        entry = document["parameters"][f"backlash_deg.{axis}"] if moved else None
        _quantity(data, f"backlash of the {axis} axis", entry, "deg", estimator)
    for table in document.get("positioning", ()):
        _positioning_result(results, table)
    if report is not None:
        embedded = _add(root, "dcc:document")
        _add(embedded, "dcc:fileName", "report.html")
        _add(embedded, "dcc:mimeType", "text/html")
        _add(embedded, "dcc:dataBase64", base64.b64encode(report).decode())
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _result(results: ET.Element, name: str, *texts: str) -> ET.Element:
    """A result with its data element; it refers to method, software and equipment of the section."""
    result = _add(results, "dcc:result", refId="method software cameras board")
    _words(result, "dcc:name", name)
    if texts:
        _words(result, "dcc:description", *texts)
    return _add(result, "dcc:data")


def _positioning_result(results: ET.Element, table: Mapping[str, object]) -> None:
    if table["predicted"] is None:
        return
    notes = "; ".join(table["notes"])
    data = _result(results, f"ISO 230-2-style figures of the {table['axis']} axis, posterior predictive", notes)
    for name, (symbol, term) in FIGURES.items():
        found = table["predicted"][name]
        quantity = _add(data, "dcc:quantity", refType="basic_measuredValue")
        _words(quantity, "dcc:name", f"{symbol}, {term}")
        low, high = found["interval95"]
        # Medians and intervals of a simulation: the half width over 1.96 stands for u.
        _real(quantity, UNIT_SI["deg"], found["median"], (high - low) / (2 * NORMAL_95), (low, high), "simulated tests")


@dataclass(frozen=True)
class SchemaCheck:
    """What a schema validator said: `valid` is None where nothing could be checked, and `messages` say why."""

    tool: str | None
    valid: bool | None
    messages: tuple[str, ...]


def check_dcc(data: bytes, schema: Path) -> SchemaCheck:
    """Validate a certificate against the schema that the user names, without any network.

    xmllint where it is installed, else lxml; neither is a dependency. PTB's schema loads D-SI by URL: point to a folder
    in which the imports are relative paths.

    Args:
        data: of `dcc_bytes`.
        schema: `dcc.xsd`.

    Raises:
        InputError: there is no such file.
    """
    if not Path(schema).is_file():
        raise InputError(
            "missing-file",
            f"{escaped(str(schema), 200)}: no such file",
            file=escaped(str(schema), 200),
            remedy="give the path of dcc.xsd",
        )
    xmllint = shutil.which("xmllint")
    if xmllint:
        command = [xmllint, "--nonet", "--noout", "--schema", str(Path(schema).resolve()), "-"]
        try:
            done = subprocess.run(command, input=data, capture_output=True, timeout=_XSD_SECONDS, check=False)
        except subprocess.TimeoutExpired:
            return SchemaCheck("xmllint", None, (f"no answer within {_XSD_SECONDS} s",))
        messages = tuple(done.stderr.decode("utf-8", "replace").strip().splitlines())
        # 0 valid, 3 and 4 not valid; else the schema itself could not be used (xmllint(1), "Diagnostics").
        return SchemaCheck("xmllint", {0: True, 3: False, 4: False}.get(done.returncode), messages)
    try:
        etree = importlib.import_module("lxml.etree")
    except ImportError:
        return SchemaCheck(None, None, ("not checked: install xmllint (libxml2) or lxml to validate",))
    parser = etree.XMLParser(no_network=True, resolve_entities=False)
    try:
        checker = etree.XMLSchema(etree.parse(str(schema), parser))
    except (etree.XMLSchemaParseError, etree.XMLSyntaxError) as error:
        return SchemaCheck("lxml", None, (str(error),))
    valid = bool(checker.validate(etree.fromstring(data, parser)))
    return SchemaCheck("lxml", valid, tuple(str(entry) for entry in checker.error_log))

"""ISO 230-2 figures of an axis, measured and predicted."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from tvsbayes.calibration.optics import beam_components, output_deg
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.instrument.axes import AXES, SIDES
from tvsbayes.instrument.stops import StopReadings

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

"""Deviations at the stops: observed minus modelled mirror angles, as readings of an axis and grouped by cause.

Angles in degrees (rad where a name says so), counters in steps, depths in mm, times in s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.plausibility import SHALLOW
from tvsbayes.instrument.axes import AXES, direction_of
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.stops import Rest, rests_of
from tvsbayes.metrology.positioning_table import StopReadings
from tvsbayes.results.estimates import Cause, CauseGroup, StopResidual
from tvsbayes.statistics.chances import one_way_chance, recursive_residuals

CAUSE_BINS = 6
"""Largest number of groups of one cause."""
PLACEMENT_GAP = 1.03
"""Ratio of neighbouring depths above which placements differ: ten times the noise of a depth, 0.3 %."""
CAUSE_LIMIT = 0.01
"""Probability, for all tests of a campaign together, that correct residuals are called dependent on a cause."""
STEP_PHASES = 4
"""Full steps per electrical period of a two-phase stepper."""


@dataclass(frozen=True)
class _SeenRest:
    """A rest of an axis with the deviations of its usable spots, and their mean weighted by pixel noise.

    Each spot's residual, range projected out, is explained by two angles (`SpotDeviations`).

    Attributes:
        rest: counter of the axis and its approach.
        first: row among `ordered_spots` of its first spot, usable or not, at which the stop error was drawn.
        rows: of its usable spots, shape (n,).
        deviation_rad: of each, shape (n,).
        variance_rad2: of each by pixel noise, shape (n,).
        mean_rad: weighted mean.
        mean_variance_rad2: its variance by pixel noise.
    """

    rest: Rest
    first: int
    rows: np.ndarray
    deviation_rad: np.ndarray
    variance_rad2: np.ndarray
    mean_rad: float
    mean_variance_rad2: float


def _left_to_stops(fit: JointFit) -> np.ndarray:
    """Remove the effects of homings, drift, play and the gears' repeating errors from residuals, shape (spots, 4).

    These effects are common to many stops and estimated with all other parameters, so they are no deviation of a single
    stop. With u = C^-1 r of all spots, unit noise has the conditional mean u, and the error of a stop its variance
    times the projection of u. The other effects need not be computed one by one.
    """
    left = fit.information.residual.reshape(-1, 4)
    slope, spots = np.asarray(fit.linearised.slope), ordered_spots(fit.campaign)
    projected = np.einsum("nia,ni->na", slope, left)
    for index, axis in enumerate(AXES):
        rests = rests_of(fit.campaign.moves, axis)
        _, first, stop_of = np.unique([rests[spot.move].move for spot in spots], return_index=True, return_inverse=True)
        error_rad = fit.linearised.stop_variance[first, index] * np.bincount(stop_of, projected[:, index])
        left = left + slope[..., index] * error_rad[stop_of, None]
    return left


def _seen_rests(fit: JointFit, axis: str, residual: np.ndarray) -> list[_SeenRest]:
    """Collect rests of an axis with usable spots, in order, from whitened residuals (spots, 4)."""
    index, rests = AXES.index(axis), rests_of(fit.campaign.moves, axis)
    deviations = replace(fit.linearised, residual=residual).spot_deviations()
    deviation, variance = deviations.deviation_rad[:, index], deviations.covariance_rad2[:, index, index]
    rows_of: dict[Rest, list[int]] = {}
    determines = fit.arrays.used & (variance > 0)
    for row, spot in enumerate(ordered_spots(fit.campaign)):
        rows_of.setdefault(rests[spot.move], []).append(row)
    entries = []
    for rest, every in rows_of.items():
        # A variance of 0: the spot determines neither angle.
        rows = np.array([row for row in every if determines[row]], dtype=int)
        if len(rows):
            weight = 1 / variance[rows]
            total = float(weight.sum())
            mean = float(deviation[rows] @ weight) / total
            entries.append(_SeenRest(rest, every[0], rows, deviation[rows], variance[rows], mean, 1 / total))
    return entries


def stop_readings(fit: JointFit, axis: str) -> StopReadings:
    """Estimate every stop of an axis from its spots, without shrinking errors towards zero.

    The reading of a stop is the mean deviation of its spots plus the angle predicted by counters and play.

    Args:
        fit: a converged fit.
        axis: pan or tilt.

    Returns:
        One row per stop with a known side and the play certainly taken up.
    """
    needed = fit.values[f"backlash_deg.{axis}"] / abs(fit.values[f"degrees_per_step.{axis}"])
    rests = _seen_rests(fit, axis, np.asarray(fit.linearised.residual))
    kept = [one for one in rests if one.rest.sign != 0 and one.rest.leg >= needed]
    first = [one.rows[0] for one in kept]
    predicted = np.asarray(fit.linearised.mirror_angles_rad)[first, AXES.index(axis)]
    pan, tilt = np.degrees(fit.reference_pose_rad).tolist()
    return StopReadings(
        axis=axis,
        steps=np.array([one.rest.steps for one in kept], dtype=int),
        side=np.array([one.rest.sign for one in kept], dtype=int),
        mirror_deg=np.degrees(predicted + [one.mean_rad for one in kept]),
        u_deg=np.degrees(np.sqrt([one.mean_variance_rad2 for one in kept])),
        play_left_out=len(rests) - len(kept),
        reference_pose_deg=(pan, tilt),
        values=fit.values,
    )


def stop_residuals(fit: JointFit) -> tuple[StopResidual, ...]:
    """Compute deviations of all stops from the fitted model, both axes, in order.

    They exclude the common part of the calibration, drifts and repeating errors of the gears. The fit of all these
    absorbs a little of each deviation, so they scatter by less than `u_deg`.
    """
    spots, moves = ordered_spots(fit.campaign), fit.campaign.moves
    # A direction has no depth.
    depth_mm = np.asarray(fit.arrays.spots.triangulated_mm)[:, 0] * fit.campaign.has_images
    left, residuals = _left_to_stops(fit), list[StopResidual]()
    for index, axis in enumerate(AXES):
        for one in _seen_rests(fit, axis, left):
            # The row at which the stop error was drawn has its variance, whether that spot is used or not.
            variance = one.mean_variance_rad2 + fit.linearised.stop_variance[one.first, index]
            residuals.append(
                StopResidual(
                    axis=axis,
                    spots=tuple(spots[row].spot for row in one.rows),
                    steps=one.rest.steps,
                    direction=direction_of(axis, one.rest.sign),
                    leg_steps=abs(one.rest.distance),
                    depth_mm=tuple(depth_mm[one.rows].tolist()),
                    within=recursive_residuals(one.deviation_rad, one.variance_rad2, backwards=len(residuals) % 2 == 1),
                    time_s=moves[spots[one.rows[0]].move].time_s,
                    deviation_deg=float(np.degrees(one.mean_rad)),
                    u_deg=float(np.degrees(np.sqrt(variance))),
                )
            )
    return tuple(residuals)


def residual_causes(residuals: Sequence[StopResidual]) -> tuple[Cause, ...]:
    """Group deviations of the stops by depth, direction, N, step phase and time, separately for pan and tilt.

    Spots of one rest share its stop error, so for depth they are compared with each other, not with the model. A cause
    is suspicious where its p is below `CAUSE_LIMIT` divided by the number of tests (Bonferroni).
    """
    keys: dict[str, Callable[[StopResidual], float | str]] = {
        "direction": lambda r: r.direction or "unknown",
        "N": lambda r: r.leg_steps,
        "step phase": lambda r: f"n mod {STEP_PHASES} = {r.steps % STEP_PHASES}",
        "time": lambda r: r.time_s,
    }
    units = {"N": " steps", "time": " s"}
    causes = []
    for axis in AXES:
        mine = [r for r in residuals if r.axis == axis]
        scaled = np.array([r.deviation_deg / r.u_deg for r in mine])
        looks = [
            (depth, value)
            for r in mine
            for depth, value in zip(r.depth_mm, r.within or (r.deviation_deg / r.u_deg,), strict=True)
            if value is not None
        ]
        depths = [depth for depth, _ in looks]
        tested = (
            {"depth": (_placed(depths), np.array([value for _, value in looks]))} if any(depths) or not looks else {}
        )
        tested |= {n: (_binned([key(r) for r in mine], units.get(n, "")), scaled) for n, key in keys.items()}
        for name, (parts, measured) in tested.items():
            groups, members = [], []
            for label, rows in parts:
                part = measured[rows]
                spread = float(part.std(ddof=1)) if len(part) > 1 else 1.0
                groups.append(CauseGroup(label, len(part), float(part.mean()), spread / np.sqrt(len(part))))
                members.append(part)
            testable = [part for part in members if len(part) > 1 and np.ptp(part) > 0]
            p = one_way_chance(testable) if len(testable) > 1 else None
            causes.append(Cause(name, axis, tuple(groups), p, False))
    tests = sum(cause.p is not None for cause in causes)
    return tuple(structs.replace(c, suspicious=c.p is not None and c.p * tests < CAUSE_LIMIT) for c in causes)


def _placed(depths_mm: Sequence[float]) -> list[tuple[str, np.ndarray]]:
    """Group depths so that pixel noise does not mix groups: placements of the sheet, or bins of a wide range.

    A depth is triangulated from the pixels that also give the deviation: groups within one placement would sort the
    stops by their own noise.
    """
    array = np.array(depths_mm)
    order = np.argsort(array, kind="stable")
    gaps = np.flatnonzero(array[order][1:] > PLACEMENT_GAP * array[order][:-1]) + 1
    if len(gaps) >= CAUSE_BINS or (not len(gaps) and array.max(initial=0.0) > SHALLOW * array.min(initial=np.inf)):
        return _binned(depths_mm, " mm")
    groups = [rows for rows in np.split(order, gaps) if len(rows)]
    return [(f"{_told(array[rows].min())} to {_told(array[rows].max())} mm", np.sort(rows)) for rows in groups]


def _told(value: float) -> str:
    """Format with four digits, without an exponent."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def _binned(values: Sequence[float | str], unit: str) -> list[tuple[str, np.ndarray]]:
    """Group equal values; more than `CAUSE_BINS` numbers go into bins of about equal counts."""
    array = np.array(values)
    distinct = np.unique(array)
    if len(distinct) <= CAUSE_BINS or array.dtype.kind not in "if":
        return [(f"{v:.6g}{unit}" if unit else str(v), np.flatnonzero(array == v)) for v in distinct]
    bins = []
    for rows in np.array_split(np.argsort(array, kind="stable"), CAUSE_BINS):
        if len(rows):
            bins.append((f"{_told(array[rows].min())} to {_told(array[rows].max())}{unit}", rows))
    return bins

"""Deviations at stops, by cause."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import numpy as np
from scipy import stats

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.plausibility import SHALLOW
from tvsbayes.instrument.axes import AXES, direction_of
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.stops import StopReadings, rests_of
from tvsbayes.results.estimates import Cause, CauseGroup, StopResidual
from tvsbayes.statistics.intervals import recursive_residuals


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
    rests = rests_of(fit.campaign.moves, axis)
    needed = values[f"backlash_deg.{axis}"] / abs(values[f"degrees_per_step.{axis}"])
    seen = fit.linearised.spot_deviations()
    sums: dict[int, list[float]] = {}
    left_out = set()
    for row, spot in enumerate(spots):
        rest = rests[spot.move]
        variance = float(seen.covariance_rad2[row, index, index])
        if spot.spot in fit.excluded_spots or variance <= 0:
            continue
        if rest.sign == 0 or rest.leg < needed:
            left_out.add(rest.move)
            continue
        entry = sums.setdefault(rest.move, [0.0, 0.0, float(fit.linearised.mirror_angles_rad[row, index])])
        entry[0] += 1 / variance
        entry[1] += float(seen.deviation_rad[row, index]) / variance
    kept = [(rests[move], entry) for move, entry in sums.items()]
    return StopReadings(
        axis=axis,
        steps=np.array([rest.steps for rest, _ in kept], dtype=int),
        side=np.array([rest.sign for rest, _ in kept], dtype=int),
        mirror_deg=np.degrees([angle + pull / weight for _, (weight, pull, angle) in kept]),
        u_deg=np.degrees([weight**-0.5 for _, (weight, _, _) in kept]),
        play_left_out=len(left_out),
        reference_pose_deg=tuple(np.degrees(fit.reference_pose_rad).tolist()),
        values=values,
    )


CAUSE_BINS = 6
PLACEMENT_GAP = 1.03
"""Ratio of two neighbouring depths that belong to different placements: ten times the noise of a depth of 0.3 %."""
CAUSE_LIMIT = 0.01
"""Probability, all tests of a campaign together, with which clean residuals are called dependent on a cause."""
STEP_PHASES = 4
"""Full steps per electrical period of a two-phase stepper: what its currents repeat with."""


def stop_residuals(fit: JointFit) -> tuple[StopResidual, ...]:
    """Deviations of all stops from the fitted model, both axes, in order.

    At each spot the residual, range projected out, is explained by two angles (least squares); the spots of one rest
    of an axis are averaged with the weights of their pixel noise. The common part of the calibration is in none of
    them, and each deviation has lost a little to the fit: they scatter by slightly less than `u_deg`.
    """
    spots = ordered_spots(fit.campaign)
    moves = fit.campaign.moves
    rows = jax.tree.map(lambda x: np.asarray(x)[: len(spots)], fit.arrays.spots)
    seen = fit.linearised.spot_deviations()
    found = []
    for index, axis in enumerate(AXES):
        rests = rests_of(moves, axis)
        begun = np.array([rests[spot.move].move for spot in spots])
        for number in np.unique(begun):
            chosen = np.flatnonzero((begun == number) & (rows.valid > 0))
            if not len(chosen):
                continue
            rest = rests[number]
            mine, noise = seen.deviation_rad[chosen, index], seen.covariance_rad2[chosen, index, index]
            weight = 1 / noise
            mean = mine @ weight / weight.sum()
            # The row that drew the stop error has its variance, whether that spot is used or not.
            drawn = np.flatnonzero(begun == number)[0]
            variance = 1 / weight.sum() + fit.linearised.stop_variance[drawn, index]
            within = recursive_residuals(mine, noise, backwards=len(found) % 2 == 1)
            found.append(
                StopResidual(
                    axis=axis,
                    spots=tuple(spots[i].spot for i in chosen),
                    steps=rest.steps,
                    direction=direction_of(axis, rest.sign),
                    leg_steps=abs(rest.distance),
                    depth_mm=tuple(map(float, rows.triangulated_mm[chosen, 0])),
                    within=within,
                    time_s=moves[spots[chosen[0]].move].time_s,
                    deviation_deg=float(np.degrees(mean)),
                    u_deg=float(np.degrees(np.sqrt(variance))),
                )
            )
    return tuple(found)


def residual_causes(residuals: Sequence[StopResidual]) -> tuple[Cause, ...]:
    """Deviations of the stops grouped by depth, direction, N, step phase and time, pan and tilt apart.

    Spots of one rest share its stop error: for depth they are held against each other, not against the model.
    A cause is suspicious where its p is below `CAUSE_LIMIT` shared out among all tests (Bonferroni).
    """
    keys: dict[str, Callable[[StopResidual], float | str]] = {
        "direction": lambda r: r.direction or "unknown",
        "N": lambda r: r.leg_steps,
        "step phase": lambda r: f"n mod {STEP_PHASES} = {r.steps % STEP_PHASES}",
        "time": lambda r: r.time_s,
    }
    units = {"N": " steps", "time": " s"}
    found = []
    for axis in AXES:
        mine = [r for r in residuals if r.axis == axis]
        scaled = np.array([r.deviation_deg / r.u_deg for r in mine])
        looks = [
            (depth, value)
            for r in mine
            for depth, value in zip(r.depth_mm, r.within or (r.deviation_deg / r.u_deg,), strict=True)
            if value is not None
        ]
        tested = {"depth": ([depth for depth, _ in looks], np.array([value for _, value in looks]))}
        tested |= {name: ([key(r) for r in mine], scaled) for name, key in keys.items()}
        for name, (values, measured) in tested.items():
            groups, members = [], []
            for label, rows in _placed(values) if name == "depth" else _binned(values, units.get(name, "")):
                part = measured[rows]
                spread = float(part.std(ddof=1)) if len(part) > 1 else 1.0
                groups.append(CauseGroup(label, len(part), float(part.mean()), spread / np.sqrt(len(part))))
                members.append(part)
            testable = [part for part in members if len(part) > 1 and np.ptp(part) > 0]
            p = float(stats.f_oneway(*testable).pvalue) if len(testable) > 1 else None
            found.append(Cause(name, axis, tuple(groups), p, False))
    tests = sum(cause.p is not None for cause in found)
    return tuple(replace(c, suspicious=c.p is not None and c.p * tests < CAUSE_LIMIT) for c in found)


def _placed(depths_mm: Sequence[float]) -> list[tuple[str, np.ndarray]]:
    """Groups of depths that pixel noise cannot mix: placements of the sheet, or bins of depths that reach far.

    A depth is triangulated from the pixels that also give the deviation: groups inside one placement would sort the
    stops by their own noise.
    """
    array = np.array(depths_mm)
    order = np.argsort(array, kind="stable")
    gaps = np.flatnonzero(array[order][1:] > PLACEMENT_GAP * array[order][:-1]) + 1
    if len(gaps) >= CAUSE_BINS or (not len(gaps) and array.max(initial=0.0) > SHALLOW * array.min(initial=np.inf)):
        return _binned(depths_mm, " mm")
    groups = [rows for rows in np.split(order, gaps) if len(rows)]
    return [(f"{array[rows].min():.4g} to {array[rows].max():.4g} mm", np.sort(rows)) for rows in groups]


def _binned(values: Sequence[float | str], unit: str) -> list[tuple[str, np.ndarray]]:
    """Groups of equal values; more than `CAUSE_BINS` numbers go into bins of about equal counts."""
    array = np.array(values)
    distinct = np.unique(array)
    if len(distinct) <= CAUSE_BINS or array.dtype.kind not in "if":
        return [(f"{v:.6g}{unit}" if unit else str(v), np.flatnonzero(array == v)) for v in distinct]
    bins = []
    for rows in np.array_split(np.argsort(array, kind="stable"), CAUSE_BINS):
        if len(rows):
            bins.append((f"{array[rows].min():.4g} to {array[rows].max():.4g}{unit}", rows))
    return bins

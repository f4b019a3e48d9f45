"""Hold-out by position: every counter of an axis is left out in turn with all its looks, and predicted.

A rest is predicted by all other looks, through ratio, mirrors and the gears' errors at neighbouring counters. The looks
left out get free angles in the linear model about the mode found without them. These are the deviation of the position
from its prediction, and their sd is its u. Mirror angles in deg, counters in steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.comparison.held_out import refit
from tvsbayes.errors import NotConverged, NothingToEstimate
from tvsbayes.estimators.annealed_stage import linearised_at
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import linear_spots, stop_information
from tvsbayes.instrument.axes import AXES, SENSES, Axis
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.stops import rests_of
from tvsbayes.progress import Job, Show
from tvsbayes.results.comparison_record import HeldOutCounter, PositionHoldOut
from tvsbayes.statistics.intervals import rms

POSITIONS_MIN = 3
"""Least number of counters of an axis: with one left out, two determine a line."""


@dataclass(frozen=True)
class LeftOut:
    """A counter of an axis that is left out.

    Attributes:
        axis, counter: which.
        out: looks there, shape (spots,).
        sign: side from which the axis came to every look, shape (spots,).
    """

    axis: Axis
    counter: int
    out: np.ndarray
    sign: np.ndarray

    def __str__(self) -> str:
        return f"{self.axis} {self.counter}"


def hold_out_positions(fit_of_all: JointFit, *, progress: Show | None = None) -> PositionHoldOut:
    """Leave out every counter at which an axis was seen in turn, with all its looks from both sides.

    Args:
        fit_of_all: a converged fit; its campaign and model are used.
        progress: receives the progress.

    Raises:
        NothingToEstimate: neither axis was seen at three counters.
    """
    campaign = fit_of_all.campaign
    spots = ordered_spots(campaign)
    used = fit_of_all.arrays.used
    folds: list[LeftOut] = []
    warnings = []
    for axis in AXES:
        rests = [rests_of(campaign.moves, axis)[spot.move] for spot in spots]
        steps, sign = (np.array([getattr(rest, name) for rest in rests]) for name in ("steps", "sign"))
        counters = np.unique(steps[used])
        if len(counters) < POSITIONS_MIN:
            warnings.append(f"{axis} is seen at {len(counters)} counters: with one left out no line is determined")
            continue
        folds += [LeftOut(axis, counter, used & (steps == counter), sign) for counter in counters.tolist()]
    if not folds:
        raise NothingToEstimate(
            "too-few-positions",
            "neither axis was seen at three counters: with one left out no line is determined",
            file="moves.csv",
            remedy="look from at least three counters of an axis",
        )
    positions: list[HeldOutCounter] = []
    with Job(dict.fromkeys(map(str, folds), 1.0), progress) as job:
        for fold in folds:
            left_out = {spots[k].spot for k in np.flatnonzero(fold.out)}
            try:
                taught = refit(fit_of_all, left_out, str(fold), job.part(str(fold)))
            except NotConverged as error:
                warnings.append(error.message)
                continue
            positions += predicted_positions(fit_of_all, taught, fold)
    rms_z = rms([position.z for position in positions]) if positions else None
    return PositionHoldOut(positions=tuple(positions), rms_z=rms_z, warnings=tuple(warnings))


def predicted_positions(fit_of_all: JointFit, taught: JointFit, left_out: LeftOut) -> list[HeldOutCounter]:
    """Predict a counter by a fit `taught` without its looks, separately for each side of these."""
    lin = linearised_at(taught.z, fit_of_all.space, fit_of_all.arrays)
    rows, axis = np.flatnonzero(left_out.out), AXES.index(left_out.axis)
    columns = np.concatenate([lin.by_coordinates(fit_of_all.held), lin.by_angles(rows)], axis=2)
    information, count = stop_information(linear_spots(lin, fit_of_all.arrays, columns)), len(fit_of_all.z)
    # Coordinates have priors, angles of the looks left out do not.
    precision = information.fisher + np.diag(np.arange(len(information.fisher)) < count)
    score = information.score(columns)
    score[:count] -= taught.z
    mine = slice(count + axis, None, 2)
    deviation, covariance = np.linalg.solve(precision, score)[mine], np.linalg.inv(precision)[mine, mine]
    angles = lin.mirror_angles_rad[rows, axis] + lin.spot_deviations().deviation_rad[rows, axis]
    entries = []
    for side, direction in zip((1, -1, 0), (*SENSES[left_out.axis], "unknown"), strict=True):
        of_side = left_out.sign[rows] == side
        if not of_side.any():
            continue
        weight = of_side / of_side.sum()
        mean, off, u = np.degrees([weight @ angles, weight @ deviation, np.sqrt(weight @ covariance @ weight)]).tolist()
        entries.append(
            HeldOutCounter(
                axis=left_out.axis,
                position=left_out.counter,
                direction=direction,
                n=int(of_side.sum()),
                mean=mean,
                predicted=mean - off,
                u=u,
            )
        )
    return entries

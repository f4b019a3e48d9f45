"""Hold-out by position: every counter of an axis is left out in turn with all its looks, and predicted.

A rest is predicted by all other looks, through ratio, mirrors and the gears' errors at neighbouring counters. The looks
left out get free angles in the linear model about the mode found without them. These are the deviation of the position
from its prediction, and their sd is its u. Mirror angles in deg, counters in steps.
"""

from __future__ import annotations

import numpy as np

from tvsbayes.comparison.held_out import refit
from tvsbayes.errors import NothingToEstimate, TvsError
from tvsbayes.estimators.annealed_stage import NO_STEP, Fixed, stage
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import Linearised, linear_spots, stop_information
from tvsbayes.instrument.axes import AXES, SENSES
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.parameters import NAMES
from tvsbayes.instrument.stops import rests_of
from tvsbayes.progress import Job, Show
from tvsbayes.results.comparison_record import HeldOutCounter, PositionHoldOut
from tvsbayes.statistics.intervals import rms

POSITIONS_MIN = 3
"""Least number of counters of an axis: with one left out, two determine a line."""


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
    folds: dict[str, tuple[int, int, np.ndarray, np.ndarray]] = {}
    warnings = []
    for number, axis in enumerate(AXES):
        rests = [rests_of(campaign.moves, axis)[spot.move] for spot in spots]
        steps, sign = (np.array([getattr(rest, name) for rest in rests]) for name in ("steps", "sign"))
        counters = np.unique(steps[used])
        if len(counters) < POSITIONS_MIN:
            warnings.append(f"{axis} is seen at {len(counters)} counters: with one left out no line is determined")
            continue
        for counter in counters.tolist():
            folds[f"{axis} {counter}"] = number, counter, used & (steps == counter), sign
    if not folds:
        raise NothingToEstimate(
            "too-few-positions",
            "neither axis was seen at three counters: with one left out no line is determined",
            file="moves.csv",
            remedy="look from at least three counters of an axis",
        )
    positions: list[HeldOutCounter] = []
    with Job(dict.fromkeys(folds, 1.0), progress) as job:
        for name, (number, counter, out, sign) in folds.items():
            try:
                taught = refit(fit_of_all, frozenset(spots[k].spot for k in np.flatnonzero(out)), job.part(name))
            except TvsError as error:
                warnings.append(f"without {name} there is no fit: {error.message}")
                continue
            if not taught.converged:
                warnings.append(f"without {name} the fit does not converge: {'; '.join(taught.problems)}")
                continue
            positions += predicted_positions(fit_of_all, taught, number, counter, out, sign)
    rms_z = rms([position.z for position in positions]) if positions else None
    return PositionHoldOut(positions=tuple(positions), rms_z=rms_z, warnings=tuple(warnings))


def _of_all_looks(fit_of_all: JointFit, taught: JointFit) -> Linearised:
    """Linearise all looks at the mode of a fit of some."""
    constant = fit_of_all.held
    fixed = Fixed(constant, taught.z, np.array(1.0))
    return stage(taught.z, fit_of_all.space, fit_of_all.arrays, fixed, NO_STEP)


def predicted_positions(
    fit_of_all: JointFit, taught: JointFit, axis: int, counter: int, out: np.ndarray, sign: np.ndarray
) -> list[HeldOutCounter]:
    """Predict a counter, separately for each side of its looks.

    Args:
        fit_of_all: fit of all looks.
        taught: the fit without those left out.
        axis: number of the axis.
        counter: counter of the axis.
        out: looks left out, shape (spots,).
        sign: side from which the axis came, shape (spots,).
    """
    lin = _of_all_looks(fit_of_all, taught)
    fixed = fit_of_all.held
    columns, rows = np.where(fixed, 0.0, -np.asarray(lin.residual_jacobian)), np.flatnonzero(out)
    free = np.zeros((len(out), 4, 2 * len(rows)))
    for k, row in enumerate(rows.tolist()):
        free[row, :, 2 * k : 2 * k + 2] = np.asarray(lin.slope)[row]
    linear = linear_spots(lin, fit_of_all.arrays, np.concatenate([columns, free], axis=2))
    information, count = stop_information(linear), len(NAMES)
    # Coordinates have priors, angles of the looks left out do not.
    precision = information.fisher + np.diag(np.arange(len(information.fisher)) < count)
    score = np.zeros(len(precision))
    for group in information.groups:
        score += np.einsum("nic,ni->c", linear.jacobian[group.rows], group.residual.reshape(-1, 4))
    score[:count] -= taught.z
    mine = slice(count + axis, None, 2)
    deviation, covariance = np.linalg.solve(precision, score)[mine], np.linalg.inv(precision)[mine, mine]
    angles = lin.mirror_angles_rad[rows, axis] + lin.spot_deviations().deviation_rad[rows, axis]
    names = dict(zip((1, -1, 0), (*SENSES[AXES[axis]], "unknown"), strict=True))
    entries = []
    for side, direction in names.items():
        weight = (sign[rows] == side) / max(np.sum(sign[rows] == side), 1)
        if not weight.any():
            continue
        mean, off, u = np.degrees([weight @ angles, weight @ deviation, np.sqrt(weight @ covariance @ weight)]).tolist()
        entries.append(
            HeldOutCounter(
                axis=AXES[axis],
                position=counter,
                direction=direction,
                n=int(np.sum(weight > 0)),
                mean=mean,
                predicted=mean - off,
                u=u,
            )
        )
    return entries

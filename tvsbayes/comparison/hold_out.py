"""Calibrations compared: classic against joint on angles left out, their gap explained, in millimetres, and over time.

Frame T, mm; counters in steps; ratios in deg/step. In millimetres, the draws of a calibration stand for the rigs that
the data allow: on each of them the beam is followed to a range, the aperture reads it, and every estimator is asked
where the spot is. Nominal and classic users are given what is fair (DESIGN 5): a baseline shortened by the mirror
offset, its middle moved by half of that, and readings in the convention their equations expect.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.comparison.gap import camera_u, experiment_pixels
from tvsbayes.errors import TvsError
from tvsbayes.estimators.four_point import Selection, four_point_ratios, select_experiments
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.results.comparison_record import BETTER_CLASSIC, BETTER_JOINT, CANNOT_TELL, HoldOut, Prediction, Score

if TYPE_CHECKING:
    from tvsbayes.estimators.joint_fit import JointFit


HOLD_OUT_DRAWS = 256
REGIONS = 4
BLOCKS_MIN = 3
"""Fewest blocks whose scatter is worth an interval."""


def folds_of(campaign: Campaign, selection: Selection, by: str) -> dict[str, np.ndarray]:
    """Masks (e,) of the experiments that are left out together.

    Raises:
        ValueError: another scheme.
    """
    if by == "steps":
        lengths = np.abs(selection.steps)
        return {f"|N| = {n}": lengths == n for n in np.unique(lengths)}
    if by != "regions":
        raise ValueError(f'folds by "steps" or "regions", not {by!r}')
    moves = {move.move: move for move in campaign.moves}
    starts = [moves[campaign.spots[four[0]].move] for four in selection.spot_rows]
    moved = np.array([m.pan_steps if a == "pan" else m.tilt_steps for m, a in zip(starts, selection.axis, strict=True)])
    folds = {}
    for axis in AXES:
        mine = selection.axis == axis
        counters = np.unique(moved[mine])
        if not len(counters):
            continue
        for part in np.array_split(counters, min(REGIONS, len(counters))):
            name = f"{axis} from {part[0]}" + (f" to {part[-1]}" if len(part) > 1 else "")
            folds[name] = mine & np.isin(moved, part)
    return folds


def hold_out(fit_of_all: JointFit, by: str = "steps", seed: int = 0) -> HoldOut:
    """Leave experiments out, fold by fold, refit, and ask both estimators for their four-point angles.

    The classic foretells N times its mean of the direction; its uncertainty is the scatter of angles about N times
    the mean, and that of the mean. The joint foretells what the classic chain would measure on its beams, with
    stop errors and pixel noise drawn anew: the same quantity for both. Noise common to all experiments (the cameras)
    moves both predictions and the measured angle alike and is reported beside.

    Args:
        fit_of_all: a converged fit; its campaign and model are used.
        by: "steps" or "regions", see `folds_of`.
        seed: of the predictive draws.
    """
    from tvsbayes.posterior.predictive import looks_again

    campaign = fit_of_all.campaign
    selection = select_experiments(campaign)
    unseen = dict(zip(DIRECTIONS, camera_u(fit_of_all).tolist(), strict=True))
    lengths = np.unique(np.abs(selection.steps))

    def undecided(reason: str) -> HoldOut:
        return HoldOut(by, (), None, None, None, None, CANNOT_TELL, reason, unseen)

    if not len(selection.experiments):
        return undecided("there is no complete experiment")
    folds = folds_of(campaign, selection, by)
    if len(folds) < 2:
        what = f"all experiments have |N| = {lengths[0]}" if by == "steps" else "all experiments start at one counter"
        return undecided(f"{what}: a constant lost motion looks like a ratio there; measure a second |N|")
    angle = four_point_ratios(selection.pixels, selection.steps, selection.axis, campaign.stereo) * selection.steps
    predictions: list[Prediction] = []
    for index, (name, out) in enumerate(folds.items()):
        foretold = _foretell_classic(angle, selection, out)
        if not foretold:
            continue
        ids = frozenset(campaign.spots[r].spot for r in selection.spot_rows[out].ravel())
        without = f"without the experiments {name}"
        try:
            taught = _refit(fit_of_all, ids)
        except TvsError as error:
            return undecided(f"{without} there is no fit: {error.message}")
        if not taught.converged:
            return undecided(f"{without} the fit does not converge: {'; '.join(taught.problems)}")
        generator = np.random.default_rng([seed, index])
        z = taught.draws_z[:HOLD_OUT_DRAWS]
        pixels = looks_again(taught, z, taught.draws.physical[:HOLD_OUT_DRAWS], generator)
        pixels = experiment_pixels(taught, selection)(pixels)[:, out]
        chosen = {"steps": selection.steps[out], "axis": selection.axis[out]}
        draws = np.stack([four_point_ratios(p, stereo=campaign.stereo, **chosen) for p in pixels]) * chosen["steps"]
        for k, e in enumerate(np.flatnonzero(out)):
            # Draws beyond the cameras' lens model tell no angle.
            told = draws[np.isfinite(draws[:, k]), k]
            if e in foretold and len(told) > 1:
                predictions.append(
                    Prediction(
                        int(selection.experiments[e]),
                        name,
                        str(selection.direction[e]),
                        int(selection.steps[e]),
                        float(angle[e]),
                        *foretold[e],
                        float(told.mean()),
                        float(told.std(ddof=1)),
                    )
                )
    if not predictions:
        return undecided("no direction has two experiments outside of every fold")
    return _judge(by, predictions, lengths, unseen)


def _refit(fit_of_all: JointFit, without: frozenset[int]) -> JointFit:
    """The same model on fewer spots; its harmonics, contrasts and backlash are free where they were."""
    from tvsbayes.estimators.joint_fit import fit, priors_used

    rig, space = fit_of_all.campaign.rig, fit_of_all.space
    priors = priors_used(rig.priors, np.asarray(space.value), np.asarray(space.u))
    held = replace(fit_of_all.campaign, rig=replace(rig, priors=priors))
    return fit(held, without=without | set(fit_of_all.excluded_spots))


def _foretell_classic(angle: np.ndarray, selection: Selection, out: np.ndarray) -> dict[int, tuple[float, float, int]]:
    """Angle, standard uncertainty and its dof of each left-out experiment whose direction has two others, by row.

    Experiments without a finite angle (pixels beyond the lens model) neither teach nor are asked.
    """
    found = {}
    seen = np.isfinite(angle)
    for direction in DIRECTIONS:
        mine = seen & (selection.direction == direction)
        taught, asked = np.flatnonzero(mine & ~out), np.flatnonzero(mine & out)
        if len(taught) < 2:
            continue
        ratios = angle[taught] / selection.steps[taught]
        mean, sd = ratios.mean(), ratios.std(ddof=1)
        noise = np.sum((angle[taught] - mean * selection.steps[taught]) ** 2) / (len(taught) - 1)
        for e in asked:
            steps = float(selection.steps[e])
            u = float(np.sqrt(noise + (steps * sd) ** 2 / len(taught)))
            found[int(e)] = float(mean * steps), u, len(taught) - 1
    return found


def _judge(by: str, predictions: list[Prediction], lengths: np.ndarray, unseen: dict[str, float]) -> HoldOut:
    """Scores of both, and whether the difference is more than chance."""
    from scipy import stats

    angle, blocks = np.array([p.angle_deg for p in predictions]), [(p.fold, p.direction) for p in predictions]
    of_block = {b: np.array([x == b for x in blocks]) for b in dict.fromkeys(blocks)}
    scores, means = {}, {}
    dof = {"classic": np.array([p.classic_dof for p in predictions]), "joint": np.inf}
    for name in ("classic", "joint"):
        told = np.array([getattr(p, f"{name}_deg") for p in predictions])
        u = np.array([getattr(p, f"{name}_u_deg") for p in predictions])
        error = angle - told
        means[name] = np.array([error[rows].mean() for rows in of_block.values()])
        scores[name] = Score(
            rms_deg=float(np.sqrt(np.mean(error**2))),
            rms_block_deg=float(np.sqrt(np.mean(means[name] ** 2))),
            coverage=float(np.mean(np.abs(error) <= stats.t.ppf(0.975, dof[name]) * u)),
            log_density=float(np.mean(stats.t.logpdf(error, dof[name], scale=u))),
        )
    blocks_seen = len(of_block)
    ratio = scores["classic"].rms_block_deg / scores["joint"].rms_block_deg
    interval, verdict = None, CANNOT_TELL
    if len(lengths) == 1:
        reason = f"all experiments have |N| = {lengths[0]}: a constant lost motion looks like a ratio in all of them"
    elif blocks_seen < BLOCKS_MIN:
        reason = f"{blocks_seen} blocks (fold and direction) tell nothing of their scatter"
    else:
        interval = _ratio_interval(means["classic"], means["joint"])
        if interval[0] > 1:
            verdict = BETTER_JOINT
        elif interval[1] < 1:
            verdict = BETTER_CLASSIC
        reason = f"over {blocks_seen} blocks (fold and direction) the classic errs {ratio:.2g} times as much as the "
        reason += f"joint, 95 % interval {interval[0]:.2g} to {interval[1]:.2g}"
    return HoldOut(
        by,
        tuple(predictions),
        scores["classic"],
        scores["joint"],
        float(ratio),
        interval,
        verdict,
        reason,
        unseen,
    )


def _ratio_interval(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """95 % interval of rms(first) / rms(second) for pairs of errors with mean 0 and any correlation.

    First and c second have equal mean squares if their sum and difference are uncorrelated: those c for which the
    t test of that correlation (n - 1 degrees of freedom, means known to be 0) does not reject are the interval.
    """
    from scipy import stats

    n = len(first)
    ratio = np.sqrt(np.sum(first**2) / np.sum(second**2))
    correlation = first @ second / np.sqrt(np.sum(first**2) * np.sum(second**2))
    # Of proportional errors the correlation may exceed 1 by rounding.
    k = 1 + 2 * max(0.0, 1 - correlation**2) * stats.t.ppf(0.975, n - 1) ** 2 / (n - 1)
    root = np.sqrt(k**2 - 1)
    return float(ratio * np.sqrt(k - root)), float(ratio * np.sqrt(k + root))

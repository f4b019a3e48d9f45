"""Hold-out comparison of classic and joint: folds of experiments left out, refitted and predicted.

Scores are errors, coverage and density of predictions, and the interval of the ratio of both errors. A block is the
predictions of one fold and direction, whose errors are correlated. Four-point angles in degrees, counters in steps. JAX
is loaded by a refit, not by the import.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tvsbayes.comparison.gap import camera_u
from tvsbayes.errors import NotConverged, TvsError
from tvsbayes.estimators.four_point import Selection, experiment_rows, four_point_ratios, select_experiments
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.progress import Job, Show
from tvsbayes.results.comparison_record import BETTER_CLASSIC, BETTER_JOINT, CANNOT_TELL, HoldOut, Prediction, Score
from tvsbayes.statistics.chances import student_log_density
from tvsbayes.statistics.intervals import WithSd, coverage_factor
from tvsbayes.statistics.streams import Stream, random_stream

if TYPE_CHECKING:
    from tvsbayes.estimators.joint_fit import JointFit

BLOCKS_MIN = 3
"""Least number of blocks for an interval."""
HOLD_OUT_DRAWS, REGIONS = 256, 4
"""Draws behind a prediction of the joint estimator; largest number of regions of an axis."""
ONE_LENGTH = "all experiments have |N| = {}: a constant lost motion looks like a ratio {}"
DECIDED = (
    "over {} blocks (fold and direction) the classic error is {:.2g} times the joint one, 95 % interval {:.2g} to "
    "{:.2g}"
)


def judge(by: str, predictions: list[Prediction], lengths: np.ndarray, unseen: dict[str, float]) -> HoldOut:
    """Score both estimators, and test whether their difference is significant.

    Args:
        by: scheme of the folds.
        predictions: predictions of all experiments.
        lengths: distinct |N| of the campaign.
        unseen: see `HoldOut`.
    """
    angle, blocks = np.array([p.angle_deg for p in predictions]), [(p.fold, p.direction) for p in predictions]
    of_block = [np.array([x == b for x in blocks]) for b in dict.fromkeys(blocks)]
    scores, means = {}, {}
    for name in ("classic", "joint"):
        predicted, u = (np.array([getattr(p, f"{name}_{field}") for p in predictions]) for field in ("deg", "u_deg"))
        dof = np.array([p.classic_dof if name == "classic" else np.inf for p in predictions])
        error = angle - predicted
        means[name] = np.array([error[rows].mean() for rows in of_block])
        scores[name] = Score(
            rms_deg=float(np.sqrt(np.mean(error**2))),
            rms_block_deg=float(np.sqrt(np.mean(means[name] ** 2))),
            coverage=float(np.mean(np.abs(error) <= np.array([coverage_factor(n) for n in dof]) * u)),
            log_density=float(np.mean(student_log_density(error, dof, u))),
        )
    ratio = scores["classic"].rms_block_deg / scores["joint"].rms_block_deg
    interval, verdict, reason = None, CANNOT_TELL, ONE_LENGTH.format(lengths[0], "in all of them")
    if len(lengths) > 1 and len(of_block) < BLOCKS_MIN:
        reason = f"{len(of_block)} blocks (fold and direction) are too few to estimate their scatter"
    elif len(lengths) > 1:
        interval = low, high = ratio_interval(means["classic"], means["joint"])
        verdict = BETTER_JOINT if low > 1 else BETTER_CLASSIC if high < 1 else CANNOT_TELL
        reason = DECIDED.format(len(of_block), ratio, low, high)
    return HoldOut(
        by, tuple(predictions), scores["classic"], scores["joint"], float(ratio), interval, verdict, reason, unseen
    )


def ratio_interval(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Compute the 95 % interval of rms(first) / rms(second) for pairs of errors with mean 0 and any correlation.

    First and c second have equal mean squares if their sum and difference are uncorrelated. The interval holds all c
    for which the t test of that correlation (n - 1 degrees of freedom, means known to be 0) does not reject.
    """
    n = len(first)
    ratio = np.sqrt(np.sum(first**2) / np.sum(second**2))
    correlation = first @ second / np.sqrt(np.sum(first**2) * np.sum(second**2))
    # The correlation of proportional errors may exceed 1 by rounding.
    k = 1 + 2 * max(0.0, 1 - correlation**2) * coverage_factor(n - 1) ** 2 / (n - 1)
    root = np.sqrt(k**2 - 1)
    return float(ratio * np.sqrt(k - root)), float(ratio * np.sqrt(k + root))


def folds_of(campaign: Campaign, selection: Selection, by: str) -> dict[str, np.ndarray]:
    """Return masks (e,) of the experiments that are left out together.

    Raises:
        ValueError: there is no such scheme.
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


def hold_out(fit_of_all: JointFit, by: str = "steps", seed: int = 0, *, progress: Show | None = None) -> HoldOut:
    """Leave experiments out, fold by fold, refit, and predict their four-point angles by both estimators.

    The classic predicts N times its mean of the direction; its uncertainty is the scatter of angles about N times the
    mean, and that of the mean. The joint predicts the classic chain's result on its beams, with new stop errors and
    pixel noise, so that both predict the same quantity. Noise common to all experiments (the cameras) shifts both
    predictions and the measured angle equally and is reported separately.

    Args:
        fit_of_all: a converged fit; its campaign and model are used.
        by: "steps" or "regions", see `folds_of`.
        seed: seed of the predictive draws.
        progress: called with the share that is done.
    """
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
        if by == "steps":
            return undecided(ONE_LENGTH.format(lengths[0], "there; measure a second |N|"))
        what = "all experiments start at one counter: no other region is left to predict it from"
        return undecided(f"{what}; measure experiments from a second starting counter")
    angle = four_point_ratios(selection.pixels, selection.steps, selection.axis, campaign.stereo_pair) * selection.steps
    predictions: list[Prediction] = []
    with Job(dict.fromkeys(folds, 1.0), progress) as job:
        for index, (name, out) in enumerate(folds.items()):
            predicted = predict_classic(angle, selection, out)
            if not predicted:
                continue
            left_out = {campaign.spots[r].spot for r in selection.spot_rows[out].ravel()}
            try:
                taught = refit(fit_of_all, left_out, f"the experiments {name}", job.part(name))
            except NotConverged as error:
                return undecided(error.message)
            by_model = predict_joint(taught, selection, out, random_stream(seed, Stream.HELD_OUT, index))
            for e, joint in by_model.items():
                if e in predicted:
                    about = (int(selection.experiments[e]), name, str(selection.direction[e]), int(selection.steps[e]))
                    predictions.append(Prediction(*about, float(angle[e]), *predicted[e], *joint))
    if not predictions:
        return undecided("no direction has two experiments outside of every fold")
    return judge(by, predictions, lengths, unseen)


def refit(fit_of_all: JointFit, out: set[int], what: str, progress: Show | None) -> JointFit:
    """Refit the same model without some spots; harmonics, contrasts and backlash are free as in the fit of all.

    Spots that a robust fit excluded stay excluded. Those that it kept have full weight, since their weights depended on
    the spots now left out.

    Args:
        fit_of_all: the fit of all spots.
        out: ids of the spots left out.
        what: what they are, in words.
        progress: called with the share that is done.

    Raises:
        NotConverged: there is no converged fit without them.
    """
    from tvsbayes.estimators.joint_fit import fit

    reduced = replace(fit_of_all.campaign, rig=fit_of_all.table)
    try:
        fitted = fit(reduced, without=out | set(fit_of_all.excluded_spots), progress=progress)
    except TvsError as error:
        raise NotConverged(error.code, f"without {what} there is no fit: {error.message}") from error
    if not fitted.converged:
        problems = "; ".join(fitted.problems)
        raise NotConverged("not-converged", f"without {what} the fit does not converge: {problems}")
    return fitted


class ClassicAngle(NamedTuple):
    """An angle predicted by the classic estimator, deg; its standard uncertainty has few degrees of freedom."""

    angle_deg: float
    u_deg: float
    dof: int


def predict_classic(angle: np.ndarray, selection: Selection, out: np.ndarray) -> dict[int, ClassicAngle]:
    """Predict each left-out experiment by N times the mean of two or more others of its direction, by row.

    Its uncertainty is the scatter of angles (e,) about N times the mean, and that of the mean. Experiments without a
    finite angle (pixels outside the lens model) are neither used nor predicted.
    """
    angles: dict[int, ClassicAngle] = {}
    finite = np.isfinite(angle)
    for direction in DIRECTIONS:
        mine = finite & (selection.direction == direction)
        taught, left = np.flatnonzero(mine & ~out), np.flatnonzero(mine & out)
        if len(taught) < 2:
            continue
        ratios = angle[taught] / selection.steps[taught]
        mean, sd = ratios.mean(), ratios.std(ddof=1)
        noise = np.sum((angle[taught] - mean * selection.steps[taught]) ** 2) / (len(taught) - 1)
        for e in left:
            steps = float(selection.steps[e])
            u = float(np.sqrt(noise + (steps * sd) ** 2 / len(taught)))
            angles[int(e)] = ClassicAngle(float(mean * steps), u, len(taught) - 1)
    return angles


def predict_joint(
    taught: JointFit, selection: Selection, out: np.ndarray, generator: np.random.Generator
) -> dict[int, WithSd[float]]:
    """Predict the classic chain's angle on the joint's beams for each left-out experiment, by row, deg.

    Stop errors and pixel noise are drawn again. Draws outside the cameras' lens model give no angle.
    """
    from tvsbayes.posterior.predictive import looks_again

    z, physical = taught.draws_z[:HOLD_OUT_DRAWS], np.asarray(taught.draws.physical[:HOLD_OUT_DRAWS])
    errors_rad = np.asarray(taught.draws.place_errors_rad[:HOLD_OUT_DRAWS])
    pixels = looks_again(taught, z, physical, errors_rad, generator)
    pixels = pixels[:, experiment_rows(taught.campaign, selection)[out]]
    steps, axis = selection.steps[out], selection.axis[out]
    draws = four_point_ratios(pixels, steps, axis, taught.campaign.stereo_pair) * steps
    angles = {}
    for k, e in enumerate(np.flatnonzero(out).tolist()):
        finite = draws[np.isfinite(draws[:, k]), k]
        if len(finite) > 1:
            angles[e] = WithSd(float(finite.mean()), float(finite.std(ddof=1)))
    return angles

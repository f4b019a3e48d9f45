"""Who predicted better: errors, coverage and density of predictions, and the interval of the ratio of two errors.

Angles in degrees; a block is the predictions of one fold and direction, whose errors go together.
"""

from __future__ import annotations

import numpy as np

from tvsbayes.results.comparison_record import BETTER_CLASSIC, BETTER_JOINT, CANNOT_TELL, HoldOut, Prediction, Score
from tvsbayes.statistics.chances import student_log_density
from tvsbayes.statistics.intervals import coverage_factor

BLOCKS_MIN = 3
"""Fewest blocks whose scatter is worth an interval."""


def judge(by: str, predictions: list[Prediction], lengths: np.ndarray, unseen: dict[str, float]) -> HoldOut:
    """Scores of both, and whether the difference is more than chance.

    Args:
        by: how experiments were left out.
        predictions: of all of them.
        lengths: distinct |N| of the campaign.
        unseen: as in `HoldOut`.
    """
    angle, blocks = np.array([p.angle_deg for p in predictions]), [(p.fold, p.direction) for p in predictions]
    of_block = {b: np.array([x == b for x in blocks]) for b in dict.fromkeys(blocks)}
    scores, means = {}, {}
    dof: dict[str, list[float]] = {
        "classic": [p.classic_dof for p in predictions],
        "joint": [np.inf] * len(predictions),
    }
    for name in ("classic", "joint"):
        predicted = np.array([getattr(p, f"{name}_deg") for p in predictions])
        u = np.array([getattr(p, f"{name}_u_deg") for p in predictions])
        error = angle - predicted
        means[name] = np.array([error[rows].mean() for rows in of_block.values()])
        scores[name] = Score(
            rms_deg=float(np.sqrt(np.mean(error**2))),
            rms_block_deg=float(np.sqrt(np.mean(means[name] ** 2))),
            coverage=float(np.mean(np.abs(error) <= np.array([coverage_factor(n) for n in dof[name]]) * u)),
            log_density=float(np.mean(student_log_density(error, np.array(dof[name]), u))),
        )
    blocks_seen = len(of_block)
    ratio = scores["classic"].rms_block_deg / scores["joint"].rms_block_deg
    interval, verdict = None, CANNOT_TELL
    if len(lengths) == 1:
        reason = f"all experiments have |N| = {lengths[0]}: a constant lost motion looks like a ratio in all of them"
    elif blocks_seen < BLOCKS_MIN:
        reason = f"{blocks_seen} blocks (fold and direction) tell nothing of their scatter"
    else:
        interval = ratio_interval(means["classic"], means["joint"])
        if interval[0] > 1:
            verdict = BETTER_JOINT
        elif interval[1] < 1:
            verdict = BETTER_CLASSIC
        reason = f"over {blocks_seen} blocks (fold and direction) the classic errs {ratio:.2g} times as much as the "
        reason += f"joint, 95 % interval {interval[0]:.2g} to {interval[1]:.2g}"
    return HoldOut(
        by, tuple(predictions), scores["classic"], scores["joint"], float(ratio), interval, verdict, reason, unseen
    )


def ratio_interval(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """95 % interval of rms(first) / rms(second) for pairs of errors with mean 0 and any correlation.

    First and c second have equal mean squares if their sum and difference are uncorrelated: those c for which the
    t test of that correlation (n - 1 degrees of freedom, means known to be 0) does not reject are the interval.
    """
    n = len(first)
    ratio = np.sqrt(np.sum(first**2) / np.sum(second**2))
    correlation = first @ second / np.sqrt(np.sum(first**2) * np.sum(second**2))
    # Of proportional errors the correlation may exceed 1 by rounding.
    k = 1 + 2 * max(0.0, 1 - correlation**2) * coverage_factor(n - 1) ** 2 / (n - 1)
    root = np.sqrt(k**2 - 1)
    return float(ratio * np.sqrt(k - root)), float(ratio * np.sqrt(k + root))

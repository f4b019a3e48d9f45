"""Headlines of a fit against the truth: PIT, z and contraction, and their cells in a table.

PIT: share of the draws below the truth. Contraction: 1 - posterior variance / prior variance. Bounds are two-sided at
`tvsbayes.statistics.chances.BOUND`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.parameters import BLOCKS, INDEX
from tvsbayes.posterior.draws import Posterior
from tvsbayes.statistics.chances import BOUND, LEVELS, binomial_bounds, rms_bounds
from tvsbayes.studies import study_job
from tvsbayes.twin.true_rig import Truth

HEADLINES = (
    *(f"effective {direction}" for direction in DIRECTIONS),
    *("contrast pan", "contrast tilt", "backlash pan", "backlash tilt", "effective mirror offset"),
)
"""In the order of `tvsbayes.instrument.parameters.TARGETS`."""
MEAN_RATIOS = ("mean ratio pan", "mean ratio tilt")
"""Headlines too, in the tables that name them: the gears' own, without the mirrors."""
SHRINK = 0.8
"""A table whose sds are multiplied by this has to fail, or its test could not."""
LEAST_CONTRACTION = 0.1
"""Below it an interval is the prior's own and is not judged."""
JUDGED = f"RMS z | {' | '.join(f'{100 * level:.0f} %' for level in LEVELS)} | verdict"
"""Headings of the cells of a `Verdict`."""
OUTSIDE = " **!**"
"""Marks a figure that is outside its bounds."""
NOTE = f"**!** marks a figure outside its bounds at {BOUND:.0e}".replace("e-0", "e-")


def headlines(draws) -> dict[str, np.ndarray]:
    """Headline quantities of `tvsbayes.model.headlines.Derived`, whose leading axes are kept."""
    ratio, physical = np.asarray(draws.effective_deg_per_step), np.asarray(draws.physical)
    each = (
        *np.moveaxis(ratio, -1, 0),
        ratio[..., 0] - ratio[..., 1],
        ratio[..., 2] - ratio[..., 3],
        physical[..., INDEX["backlash_deg.pan"]],
        physical[..., INDEX["backlash_deg.tilt"]],
        draws["effective_mirror_offset_mm"],
        *(physical[..., INDEX[name]] for name in BLOCKS["degrees_per_step"]),
    )
    return dict(zip(HEADLINES + MEAN_RATIOS, each, strict=True))


def true_headlines(truth: Truth, campaign: Campaign, pose_rad: np.ndarray) -> dict[str, float]:
    """The same of a true rig, by the twin's formulas, over the looks of a campaign and at the pose of its fit."""
    values = dict(zip(HEADLINES, study_job.true_headlines(truth, campaign, pose_rad).tolist(), strict=True))
    return values | {
        name: float(truth.parameters[key]) for name, key in zip(MEAN_RATIOS, BLOCKS["degrees_per_step"], strict=True)
    }


def judged(found: JointFit | Posterior, truth: Truth, campaign: Campaign) -> dict[str, dict[str, float]]:
    """PIT, also of draws shrunk about the centre by `SHRINK`, z and contraction of every headline.

    Args:
        found: a fit, whose centre is its mode, or a posterior, whose centre is its mean.
        truth: of the campaign's rig.
        campaign: whose looks define the truth's ratios.
    """
    fit = found.fit if isinstance(found, Posterior) else found
    draws = headlines(found.draws)
    middle = None if isinstance(found, Posterior) else headlines(fit.mode)
    prior, true = headlines(fit.prior_draws), true_headlines(truth, campaign, fit.reference_pose_rad)
    result = {}
    for name, values in draws.items():
        values = values.ravel()
        weight = found.weights.ravel() if middle is None else np.full(values.shape, 1 / values.size)
        mean = weight @ values
        at = float(mean if middle is None else middle[name])
        variance = weight @ (values - mean) ** 2
        result[name] = {
            "pit": float(weight @ (values < true[name])),
            "pit_shrunk": float(weight @ (at + SHRINK * (values - at) < true[name])),
            "z": float((at - true[name]) / np.sqrt(variance)),
            "contraction": float(1 - variance / prior[name].var()),
        }
    return result


def marked(text: str, inside: bool) -> str:
    """A figure of a table, marked where it is outside its bounds."""
    return text + ("" if inside else OUTSIDE)


def rms_limits(count: int) -> str:
    """Bounds of an RMS z."""
    low, high = rms_bounds(count)
    return f"{low:.2f}-{high:.2f}"


def limits(count: int) -> str:
    """Bounds of the columns of `JUDGED`, without the verdict."""
    shares = (f"{100 * low:.0f}-{100 * high:.0f}" for low, high in (binomial_bounds(count, level) for level in LEVELS))
    return " | ".join([rms_limits(count), *shares])


@dataclass(frozen=True)
class Verdict:
    """RMS z and coverage of one quantity over many rigs: cells of a table, and whether all are within bounds."""

    cells: str
    within: bool
    prior: bool


def verdict(entries: Sequence[Mapping[str, float]], shrunk: bool = False) -> Verdict:
    """The judgement of one quantity, rig by rig; `shrunk` judges the draws shrunk by `SHRINK`."""
    pit = np.array([e["pit_shrunk" if shrunk else "pit"] for e in entries])
    z = np.array([e["z"] for e in entries]) / (SHRINK if shrunk else 1.0)
    low, high = rms_bounds(len(pit))
    rms = float(np.sqrt(np.mean(z**2)))
    inside = [low <= rms <= high]
    cells = [marked(f"{rms:.2f}", inside[0])]
    for level in LEVELS:
        share = float(np.mean(np.abs(pit - 0.5) < level / 2))
        low, high = binomial_bounds(len(pit), level)
        inside.append(low <= share <= high)
        cells.append(marked(f"{100 * share:.1f}", inside[-1]))
    prior = float(np.median([e["contraction"] for e in entries])) < LEAST_CONTRACTION
    word = "prior" if prior else "within" if all(inside) else "OUTSIDE"
    return Verdict(" | ".join([*cells, word]), all(inside), prior)

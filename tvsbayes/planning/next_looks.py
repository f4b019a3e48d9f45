"""The next best looks of a running session: from the present counters, first on the present sheet, without homing.

`plan --given --next` prints them and `acquire --adapt` takes them. Counters in steps, values in the target's unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tvsbayes.errors import NotConverged
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.conditions import powered_on_s, warm_minutes
from tvsbayes.instrument.plan import PlanLog
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stops import counters_made
from tvsbayes.planning.candidates import sheet_choices
from tvsbayes.planning.expectation import knowledge_of
from tvsbayes.planning.search import DesignProblem
from tvsbayes.planning.target import Target
from tvsbayes.posterior.sampling import sample
from tvsbayes.results.estimates import Measured, Uncertain
from tvsbayes.results.plan_record import Action, actions_of
from tvsbayes.results.records import Record, Tier
from tvsbayes.results.tiers import IMPORTANCE


class Confirmation(Record, frozen=True):
    """Effective ratios by a sampled posterior.

    Attributes:
        tier: what made its draws.
        accepted: whether they may be used.
        effective_deg_per_step: by direction.
    """

    tier: Tier
    accepted: bool
    effective_deg_per_step: dict[str, Measured]


class NextLooks(Record, frozen=True):
    """A few looks that continue a campaign.

    Attributes:
        target: target of the looks.
        now: the target's value by the campaign; `expected`: after the looks.
        minutes: duration by `[costs]`, without the first placement where its sheet is placed already.
        steps: placements, moves and looks; the first is a placement.
        after_each: the target's value after each look, in their order.
        effective_deg_per_step: effective ratios of the fit by direction, with their Laplace sds.
        why: reason of the choice, in words.
        confirmed: the ratios by the sampled posterior, where requested.
    """

    target: Target
    now: float
    expected: float
    minutes: float
    steps: tuple[Action, ...]
    after_each: tuple[float, ...]
    effective_deg_per_step: dict[str, Uncertain]
    why: str
    confirmed: Confirmation | None = None


def confirmation(fit: JointFit) -> Confirmation:
    """Estimate the effective ratios of a converged fit by importance sampling; Laplace sds may be too small."""
    posterior = sample(fit, IMPORTANCE)
    stats = posterior.propagate(lambda p: np.stack([p[f"effective_deg_per_step.{d}"] for d in DIRECTIONS], axis=1))
    ratios = map(Measured, stats.mean.tolist(), stats.sd.tolist(), map(tuple, stats.interval95.T.tolist()))
    return Confirmation(IMPORTANCE, posterior.converged, dict(zip(DIRECTIONS, ratios, strict=True)))


def next_looks(
    fit: JointFit,
    rig: Rig,
    target: Target,
    count: int,
    *,
    confirm_below: float | None = None,
    planned: Mapping[str, tuple[int, int]] | None = None,
) -> NextLooks:
    """Choose the looks that lower a target most per minute, by the fit of the present data.

    Args:
        fit: fit of the campaign so far; its last segment continues.
        rig: sheets, limits, costs.
        target: target to be lowered.
        count: number of looks.
        confirm_below: sample the posterior where the Laplace sd of every effective ratio is at most this, deg/step.
        planned: lowest and highest counter by axis of a plan that is being run, allowed as those that were made are.

    Raises:
        NotConverged: the fit.
        InputError: no sheet, nothing in view.
    """
    if not fit.converged:
        raise NotConverged.of(fit.problems, "see `tvsbayes fit`")
    moves, made = fit.campaign.moves, counters_made(fit.campaign.moves)
    if planned is not None:
        made = {axis: (min(made[axis][0], low), max(made[axis][1], high)) for axis, (low, high) in planned.items()}
    warm = float(warm_minutes(moves, powered_on_s(fit.campaign.header))[-1])
    problem = DesignProblem.of(
        replace(knowledge_of(fit, rig), warm_minutes=warm, made=made), target, fit.reference_pose_rad
    )
    # The segment continues: no new home offset, and the expectation of the looks includes the creep so far.
    problem = replace(problem, knowledge=replace(problem.knowledge, after_data=False), warming=False)
    session = PlanLog(list(moves), targets=[ordered_spots(fit.campaign)[-1].target])
    sheet_of_look, sheets = problem.candidates.looks.sheet, range(len(problem.knowledge.sheets))
    subsets = [np.isin(sheet_of_look, choice) for choice in sheet_choices(sheets, 2)]
    best = max(problem.choices(count, subsets, session), key=lambda choice: choice.gain_per_minute)
    order, sds = best.design.order, np.asarray(fit.draws.effective_deg_per_step).std(axis=0)
    places, quantity = ", ".join(dict.fromkeys(best.design.sheet)), target.text.split("<=")[0].strip()
    ratios = map(Uncertain, np.asarray(fit.mode.effective_deg_per_step).tolist(), sds.tolist())
    return NextLooks(
        target=target,
        now=problem.now,
        expected=best.value,
        minutes=best.minutes,
        steps=actions_of(best.steps),
        after_each=tuple(problem.value(best.picks, best.design, order[: n + 1]) for n in range(len(order))),
        effective_deg_per_step=dict(zip(DIRECTIONS, ratios, strict=True)),
        why=(
            f"{count} looks at {places} lower {quantity} most per minute: from {problem.now:.3g} to {best.value:.3g} "
            f"{target.unit} in {best.minutes:.1f} minutes"
        ),
        confirmed=confirmation(fit) if confirm_below is not None and sds.max() <= confirm_below else None,
    )

"""The next best looks of a running session: from the present counters, first on the present sheet, without homing.

`plan --given --next` prints them and `acquire --adapt` takes them. Counters in steps, values in the target's unit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tvsbayes.errors import NotConverged
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.conditions import powered_on_s, warm_minutes
from tvsbayes.instrument.plan import PlanLog, PlanStep, step_json
from tvsbayes.instrument.rig import Rig
from tvsbayes.planning.candidates import sheet_choices
from tvsbayes.planning.expectation import knowledge_of
from tvsbayes.planning.planner import design_problem
from tvsbayes.planning.target import Target
from tvsbayes.posterior.sampling import sample
from tvsbayes.results.tiers import IMPORTANCE


@dataclass(frozen=True)
class Confirmation:
    """Effective ratios by importance sampling, by direction, deg/step.

    Attributes:
        accepted: whether the weights may be used.
        deg_per_step, u_deg_per_step: means and sds.
        interval95: low and high ends.
    """

    accepted: bool
    deg_per_step: dict[str, float]
    u_deg_per_step: dict[str, float]
    interval95: dict[str, tuple[float, float]]

    def as_json(self) -> dict[str, Any]:
        """Return this part of the document of `plan --given --next`."""
        ratios = {
            d: {"value": self.deg_per_step[d], "sd": self.u_deg_per_step[d], "interval95": list(self.interval95[d])}
            for d in DIRECTIONS
        }
        return {"tier": IMPORTANCE, "accepted": self.accepted, "effective_deg_per_step": ratios}


@dataclass(frozen=True)
class NextLooks:
    """A few looks that continue a campaign.

    Attributes:
        target: target of the looks.
        steps: placements, moves and looks; the first is a placement.
        minutes: duration by `[costs]`, without that placement where its sheet is placed already.
        now: the target's value by the campaign; `expected`: after the looks.
        after_each: the target's value after each look, in their order.
        deg_per_step, u_deg_per_step: effective ratios of the fit by direction, and their Laplace sds.
        why: reason of the choice, in words.
        confirmed: the ratios by the sampled posterior, where requested.
    """

    target: Target
    steps: tuple[PlanStep, ...]
    minutes: float
    now: float
    expected: float
    after_each: tuple[float, ...]
    deg_per_step: dict[str, float]
    u_deg_per_step: dict[str, float]
    why: str
    confirmed: Confirmation | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the document of `plan --given --next`."""
        ratios = {d: {"value": self.deg_per_step[d], "sd": self.u_deg_per_step[d]} for d in DIRECTIONS}
        return {
            "target": self.target.as_json(),
            "now": self.now,
            "expected": self.expected,
            "minutes": self.minutes,
            "steps": [step_json(step) for step in self.steps],
            "after_each": list(self.after_each),
            "effective_deg_per_step": ratios,
            "why": self.why,
            "confirmed": None if self.confirmed is None else self.confirmed.as_json(),
        }


def confirmation(fit: JointFit) -> Confirmation:
    """Estimate the effective ratios of a converged fit by importance sampling; Laplace sds may be too small."""
    posterior = sample(fit, IMPORTANCE)
    stats = posterior.propagate(lambda p: np.stack([p[f"effective_deg_per_step.{d}"] for d in DIRECTIONS], axis=1))
    ends = [(low, high) for low, high in stats.interval95.T.tolist()]
    by_direction = (dict(zip(DIRECTIONS, row, strict=True)) for row in (stats.mean.tolist(), stats.sd.tolist(), ends))
    return Confirmation(posterior.converged, *by_direction)


def next_looks(fit: JointFit, rig: Rig, target: Target, count: int, *, confirm_below: float | None = None) -> NextLooks:
    """Choose the looks that lower a target most per minute, by the fit of the present data.

    Args:
        fit: fit of the campaign so far; its last segment continues.
        rig: sheets, limits, costs.
        target: target to be lowered.
        count: number of looks.
        confirm_below: sample the posterior where the Laplace sd of every effective ratio is at most this, deg/step.

    Raises:
        NotConverged: the fit.
        InputError: no sheet, nothing in view.
    """
    if not fit.converged:
        raise NotConverged.of(fit.problems, "see `tvsbayes fit`")
    power_s = powered_on_s(fit.campaign.header)
    knowledge = replace(knowledge_of(fit, rig), warm_minutes=float(warm_minutes(fit.campaign.moves, power_s)[-1]))
    problem = design_problem(knowledge, target, fit.reference_pose_rad, False)
    # The segment continues: no new home offset, and the expectation of the looks includes the creep so far.
    problem = replace(problem, knowledge=replace(problem.knowledge, after_data=False), warming=False)
    session = PlanLog(list(fit.campaign.moves), targets=[ordered_spots(fit.campaign)[-1].target])
    sheet_of_look, sheets = problem.candidates.looks.sheet, range(len(problem.knowledge.sheets))
    subsets = [np.isin(sheet_of_look, choice) for choice in sheet_choices(sheets, 2)]
    best = max(problem.choices(count, subsets, session), key=lambda choice: choice.gain_per_minute)
    sds = np.asarray(fit.draws.effective_deg_per_step).std(axis=0)
    confirmation_result = confirmation(fit) if confirm_below is not None and sds.max() <= confirm_below else None
    order = best.design.order
    places, quantity = ", ".join(dict.fromkeys(best.design.sheet)), target.text.split("<=")[0].strip()
    return NextLooks(
        target=target,
        steps=best.steps,
        minutes=best.minutes,
        now=problem.now,
        expected=best.value,
        after_each=tuple(problem.value(best.picks, best.design, order[: n + 1]) for n in range(len(order))),
        deg_per_step=dict(zip(DIRECTIONS, map(float, np.asarray(fit.mode.effective_deg_per_step)), strict=True)),
        u_deg_per_step=dict(zip(DIRECTIONS, map(float, sds), strict=True)),
        why=(
            f"{count} looks at {places} lower {quantity} most per minute: from {problem.now:.3g} to {best.value:.3g} "
            f"{target.unit} in {best.minutes:.1f} minutes"
        ),
        confirmed=confirmation_result,
    )

"""Faults of a plan and their cure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.instrument.plan import PlanStep, described, run_plan, step_json
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stops import observed_stops, separation
from tvsbayes.model.headlines import QUANTITIES, headlines
from tvsbayes.planning.candidates import Candidates, LookArrays, Looks, arrange, candidates, covariance_of
from tvsbayes.planning.expectation import PARAMETERS, Knowledge, PlanInformation, information_of, prior_knowledge
from tvsbayes.planning.search import Search
from tvsbayes.results.estimates import CONTRACTION_LIMIT

EXCHANGE_SHARE = 0.5
"""A ratio and a backlash are hard to tell apart where more than this share of the ratio's variance is exchange with
the backlash: knowing the backlash would then lower u of the ratio by 30 % and more."""
CURE_LOOKS = 12
"""Looks beyond which an addition is no small cure."""


@dataclass(frozen=True)
class PlanFault:
    """Something that a plan leaves to the priors, and the smallest addition that cures it.

    Attributes:
        axis: pan, tilt, or "depth".
        text: in words.
        addition: steps to append to the plan, empty where none was found.
        before, after: u of the worst effective ratio of the axis without and with it, deg/step.
    """

    axis: str
    text: str
    addition: tuple[PlanStep, ...]
    before: float
    after: float | None


@dataclass(frozen=True)
class PlanCheck:
    """What `check RIG PLAN` says.

    Attributes:
        looks, seen: looks ordered, and in both images at the most probable instrument.
        minutes: by `[costs]`.
        expected: u of every headline after the plan, in its unit.
        contraction: 1 - var_post / var_prior of every headline, None where the priors hold it fixed.
        faults: what the plan cannot separate.
        warnings: the same and more, as sentences.
    """

    looks: int
    seen: int
    minutes: float
    expected: dict[str, float]
    contraction: dict[str, float | None]
    faults: tuple[PlanFault, ...]
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """The document of `check --json` for a rig with a plan."""
        named = ("looks", "seen", "minutes", "expected", "contraction")
        faults = [
            {"axis": f.axis, "text": f.text, "addition": [step_json(s) for s in f.addition], "u_deg_per_step": f.after}
            for f in self.faults
        ]
        listed = {name: getattr(self, name) for name in named}
        return {"kind": "rig with plan", **listed, "faults": faults, "warnings": list(self.warnings)}


@dataclass(frozen=True)
class _Judged:
    """Covariance of the headlines after a plan, shape (9, 9), and what separates ratio and backlash of each axis."""

    information: PlanInformation
    covariance: np.ndarray
    gradient: np.ndarray
    prior: np.ndarray

    def rows(self, axis: str) -> list[int]:
        """Rows of the ratio and of the backlash of an axis."""
        return [QUANTITIES.index("left" if axis == "pan" else "up"), QUANTITIES.index(f"backlash.{axis}")]

    def exchange(self, axis: str) -> float:
        """Share of the ratio's variance that knowing the backlash would remove."""
        ratio, lost = self.rows(axis)
        c = self.covariance
        if self.prior[lost] == 0:
            return 0.0
        return float(c[ratio, lost] ** 2 / (c[ratio, ratio] * c[lost, lost]))

    def u(self, axis: str) -> float:
        """Of the worse effective ratio of an axis, deg/step."""
        rows = [0, 1] if axis == "pan" else [2, 3]
        return float(np.sqrt(np.diag(self.covariance)[rows].max()))

    def contraction(self) -> np.ndarray:
        """Of every headline, shape (9,); NaN where its prior holds it fixed."""
        left = np.diag(self.covariance)
        return 1 - np.divide(left, self.prior, out=np.full(len(left), np.nan), where=self.prior > 0)

    def faulty(self, axis: str) -> bool:
        """The axis' ratio or backlash is the prior's, or they exchange."""
        return bool(
            (self.contraction()[self.rows(axis)] < CONTRACTION_LIMIT).any() or self.exchange(axis) > EXCHANGE_SHARE
        )


def _judge(steps: Sequence[PlanStep], knowledge: Knowledge) -> _Judged:
    found = information_of(steps, knowledge)
    with jax.enable_x64(True):
        at = headlines(jnp.asarray(knowledge.z), knowledge.space, jnp.asarray(found.pose_rad))
    gradient = np.asarray(at.gradient)
    covariance = gradient @ covariance_of(knowledge.precision + found.fisher) @ gradient.T
    prior = np.einsum("qi,ij,qj->q", gradient, knowledge.covariance, gradient)
    return _Judged(found, covariance, gradient, prior)


def extended(
    steps: Sequence[PlanStep], looks: Looks, knowledge: Knowledge, overshoot: np.ndarray
) -> tuple[PlanStep, ...]:
    """Steps that append looks to a plan: no homing in between, a placement only where another sheet is needed."""
    end = run_plan(steps, knowledge.rig)
    more = [s for s in arrange(looks, knowledge.sheets, overshoot, end.at).steps if s.action != "home"]
    if more and more[0].action == "place" and more[0].target == end.sheet:
        more = more[1:]
    return tuple(replace(s, step=len(steps) + k) for k, s in enumerate(more))


def _fault_text(plan: _Judged, axis: str) -> str:
    """What a faulty axis leaves open."""
    ratio, lost = plan.contraction()[plan.rows(axis)]
    if ratio < CONTRACTION_LIMIT:
        return f"the plan tells nothing of the {axis} ratio"
    if lost < CONTRACTION_LIMIT:
        return f"the plan tells nothing of the {axis} backlash"
    share = 100 * plan.exchange(axis)
    return f"{axis} ratio and {axis} backlash cannot be told apart well ({share:.0f} % of the variance is common)"


@dataclass(frozen=True)
class _Cure:
    """Steps to append to a plan, and what it is then."""

    addition: tuple[PlanStep, ...]
    after: _Judged


def _cure(
    steps: Sequence[PlanStep], knowledge: Knowledge, found: Candidates, axis: str, before: _Judged
) -> _Cure | None:
    """Fewest looks after which the axis is no longer faulty, on the sheet that stands; None if there are none."""
    seen = LookArrays(found.looks, knowledge, False).at(knowledge.z, knowledge.space)
    rows = before.rows(axis)
    own = np.zeros(len(rows))
    precision = knowledge.precision + before.information.fisher
    search = Search(seen.rows[..., :PARAMETERS], precision, before.gradient[rows], own, "A")
    placed = run_plan(steps, knowledge.rig).sheet
    here = found.looks.sheet == (knowledge.sheets.index(placed) if placed in knowledge.sheets else 0)
    part = replace(search, rows=np.where(here[:, None, None], search.rows, 0.0))
    picks = np.array(part.greedy(CURE_LOOKS))
    for count in range(1, CURE_LOOKS + 1):
        addition = extended(steps, found.looks[picks[:count]], knowledge, found.overshoot)
        after = _judge((*steps, *addition), knowledge)
        if not after.faulty(axis):
            return _Cure(addition, after)
    return None


def beyond_limits(limits: CounterLimits, moves: Sequence[Move]) -> list[str]:
    """Axes that leave the limits which `[positioner]` states, as sentences."""
    found = []
    for axis in AXES:
        counters = [getattr(move, f"{axis}_steps") for move in moves]
        least, most = min(counters), max(counters)
        if not (limits.allow(axis, least) and limits.allow(axis, most)):
            found.append(f"{axis} moves from {least} to {most} steps; [positioner] allows {limits.words(axis)}")
    return found


def check_plan(rig: Rig, steps: Sequence[PlanStep]) -> PlanCheck:
    """What a plan on a rig cannot tell apart, in words, and the smallest addition that would (DESIGN 6).

    Args:
        rig: priors, sheets, limits.
        steps: the plan.

    Raises:
        InputError: a plan that looks at nothing or places an unknown sheet.
    """
    knowledge = prior_knowledge(rig)
    judged_plan = _judge(steps, knowledge)
    information = judged_plan.information
    contraction = judged_plan.contraction()
    observed = {move for move, seen in zip(information.look_moves, information.expectation.seen, strict=True) if seen}
    warnings, faults = [], []
    missed = int((~information.expectation.seen).sum())
    if missed:
        warnings.append(
            f"{missed} of {len(information.look_moves)} looks miss an image at the most probable instrument"
        )
    warnings += beyond_limits(rig.limits, information.moves)
    faulty = [axis for axis in AXES if judged_plan.faulty(axis)]
    found = None
    if faulty:
        try:
            found = candidates(knowledge)
        except InputError as error:
            warnings.append(f"no cure can be sought on this rig: {error.message}")
    for axis in faulty:
        reason = separation(observed_stops(information.moves, observed, axis), axis)
        text = _fault_text(judged_plan, axis) + (f": {reason}" if reason else "")
        cure = None if found is None else _cure(steps, knowledge, found, axis, judged_plan)
        before = judged_plan.u(axis)
        if cure is not None:
            looks, after = sum(s.action == "look" for s in cure.addition), cure.after.u(axis)
            text += (
                f"; smallest cure: {looks} more look{'s' * (looks != 1)}, {described(rig, cure.addition, steps)}: u of the "
                f"{axis} ratio {before:.2g} -> {after:.2g} deg/step"
            )
            faults.append(PlanFault(axis, text, cure.addition, before, after))
        else:
            text += f"; no {CURE_LOOKS} looks cure it on this rig" if found is not None else ""
            faults.append(PlanFault(axis, text, (), before, None))
        warnings.append(text)
    depths = {s.target for s in steps if s.action == "place"}
    if len({rig.sheets_mm[name] for name in depths}) == 1 and len(rig.sheets_mm) > 1:
        warnings.append(
            "all looks are at one depth: a second sheet position sharpens ratios; place "
            + ", ".join(name for name in knowledge.sheets if name not in depths)
        )
    u = np.sqrt(np.diag(judged_plan.covariance))
    return PlanCheck(
        looks=len(information.look_moves),
        seen=len(information.look_moves) - missed,
        minutes=information.minutes,
        expected=dict(zip(QUANTITIES, map(float, u), strict=True)),
        contraction={
            name: None if math.isnan(share) else float(share)
            for name, share in zip(QUANTITIES, contraction, strict=True)
        },
        faults=tuple(faults),
        warnings=tuple(warnings),
    )

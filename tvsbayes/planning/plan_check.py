"""What a plan cannot tell apart, in words, and the smallest addition that cures it.

Judged at the most probable instrument by the same rules as a fit is (`stops.inseparable`, `stops.few_stops`). Counters
in steps, u of the ratios in deg/step, minutes by the rig's `[costs]`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import AXES, SENSES, Axis
from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.instrument.parameters import INDEX, TARGET_ROWS
from tvsbayes.instrument.places import FEW_COUNTERS, LEAST_ERROR_RAD, too_few_counters
from tvsbayes.instrument.plan import PlanStep, describe_looks, run_plan, step_json
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stops import Stop, few_stops, inseparable, observed_stops, one_sided, separation
from tvsbayes.planning.candidates import Candidates, candidates
from tvsbayes.planning.expectation import (
    Knowledge,
    PlanInformation,
    expect,
    information_of,
    prior_knowledge,
)
from tvsbayes.planning.looks import LookArrays, Looks, arrange, covariance_of
from tvsbayes.planning.search import Search
from tvsbayes.progress import Job, Show
from tvsbayes.results.estimates import CONTRACTION_LIMIT

CURE_LOOKS = 24
"""Looks beyond which an addition is no small cure."""
JUDGING, CURING = "judging the plan", "seeking a cure"
JUDGED_SECONDS, EXPECT_COMPILED_SECONDS, CURED_SECONDS = 0.2, 12.0, 1.0
"""What progress predicts with."""


def judging_seconds() -> float:
    """To expect of a plan's judgement."""
    return JUDGED_SECONDS + expect.wait(EXPECT_COMPILED_SECONDS)


@dataclass(frozen=True)
class PlanFault:
    """Something that a plan leaves to the priors, and the smallest addition that cures it.

    Attributes:
        axis: pan or tilt.
        text: in words.
        addition: steps to append to the plan, empty where none was found.
        before, after: u of the worst effective ratio of the axis without and with it, deg/step.
    """

    axis: Axis
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
class Judged:
    """What a plan tells of the headlines: their covariance, shape (9, 9), gradients and prior variances, shape (9,)."""

    information: PlanInformation
    covariance: np.ndarray
    gradient: np.ndarray
    prior: np.ndarray

    def rows(self, axis: Axis) -> list[int]:
        """Rows of the ratio and of the backlash of an axis."""
        return [TARGET_ROWS[SENSES[axis][0]], TARGET_ROWS[f"backlash.{axis}"]]

    def exchange(self, axis: Axis) -> float:
        """Correlation of ratio and backlash of an axis: its square is the share of variance that they exchange."""
        ratio, lost = self.rows(axis)
        c = self.covariance
        if self.prior[lost] == 0:
            return 0.0
        return float(c[ratio, lost] / np.sqrt(c[ratio, ratio] * c[lost, lost]))

    def u(self, axis: Axis) -> float:
        """Of the worse effective ratio of an axis, deg/step."""
        rows = [TARGET_ROWS[direction] for direction in SENSES[axis]]
        return float(np.sqrt(np.diag(self.covariance)[rows].max()))

    def contraction(self) -> np.ndarray:
        """Of every headline, shape (9,); NaN where its prior holds it fixed."""
        left = np.diag(self.covariance)
        return 1 - np.divide(left, self.prior, out=np.full(len(left), np.nan), where=self.prior > 0)

    def stops(self, axis: Axis) -> tuple[Stop, ...]:
        """Those that are seen."""
        return observed_stops(self.information.moves, self.information.seen_moves, axis)

    def together(self, axis: Axis) -> str:
        """That ratio and backlash of the axis move together."""
        share = 100 * self.exchange(axis) ** 2
        return f"{axis} ratio and {axis} backlash are not well separated ({share:.0f} % of the variance is common)"

    def fault(self, axis: Axis) -> str | None:
        """What the plan leaves open of the axis in words: its ratio or backlash is the prior's, or they exchange."""
        ratio, lost = self.contraction()[self.rows(axis)]
        stops = self.stops(axis)
        free = self.prior[self.rows(axis)[1]] > 0
        if ratio < CONTRACTION_LIMIT:
            text = f"the plan tells nothing of the {axis} ratio"
        elif lost < CONTRACTION_LIMIT:
            text = f"the plan tells nothing of the {axis} backlash"
        elif inseparable(self.exchange(axis)) or (free and one_sided(stops, axis) is not None):
            text = self.together(axis)
        else:
            return None
        reason = separation(stops, axis)
        return text if reason is None else f"{text}: {reason}"


def judge(steps: Sequence[PlanStep], knowledge: Knowledge, *, aperture: bool = False) -> Judged:
    """What a plan will tell of the headlines at the most probable instrument.

    Raises:
        InputError: a plan that looks at nothing or places an unknown sheet.
    """
    information = information_of(steps, knowledge, aperture=aperture)
    gradient = np.asarray(knowledge.gears.headlines(knowledge.z, knowledge.space, information.pose_rad).gradient)
    covariance = gradient @ covariance_of(knowledge.precision + information.fisher) @ gradient.T
    prior = np.einsum("qi,ij,qj->q", gradient, knowledge.covariance, gradient)
    return Judged(information, covariance, gradient, prior)


def extended(
    steps: Sequence[PlanStep], looks: Looks, knowledge: Knowledge, overshoot: np.ndarray
) -> tuple[PlanStep, ...]:
    """Steps that append looks to a plan: no homing in between, a placement only where another sheet is needed."""
    end = run_plan(steps, knowledge.rig)
    more = [s for s in arrange(looks, knowledge.sheets, overshoot, end.at).steps if s.action != "home"]
    if more and more[0].action == "place" and more[0].target == end.sheet:
        more = more[1:]
    return tuple(replace(s, step=len(steps) + k) for k, s in enumerate(more))


@dataclass(frozen=True)
class _Cure:
    """Steps to append to a plan, and what it is then."""

    addition: tuple[PlanStep, ...]
    after: Judged


def _cure(
    steps: Sequence[PlanStep], knowledge: Knowledge, possible: Candidates, axis: Axis, before: Judged
) -> _Cure | None:
    """Fewest looks after which the axis has no fault, on the sheet that stands; None if there are none."""
    shown = LookArrays(possible.looks, knowledge, False).at(knowledge.z, knowledge.space)
    rows = before.rows(axis)
    precision = knowledge.precision + before.information.fisher
    search = Search(shown.rows[..., :-2], precision, before.gradient[rows], np.zeros(len(rows)), "A")
    placed = run_plan(steps, knowledge.rig).sheet
    allowed = possible.looks.sheet == (knowledge.sheets.index(placed) if placed in knowledge.sheets else 0)
    picks = np.array(search.among(allowed).greedy(CURE_LOOKS), dtype=int)
    for count in range(1, len(picks) + 1):
        addition = extended(steps, possible.looks[picks[:count]], knowledge, possible.overshoot)
        after = judge((*steps, *addition), knowledge)
        if after.fault(axis) is None:
            return _Cure(addition, after)
    return None


def beyond_limits(limits: CounterLimits, moves: Sequence[Move]) -> list[str]:
    """Axes that leave the limits which `[positioner]` states, as sentences."""
    faults = []
    for axis in AXES:
        counters = [getattr(move, f"{axis}_steps") for move in moves]
        least, most = min(counters), max(counters)
        if not (limits.allow(axis, least) and limits.allow(axis, most)):
            faults.append(f"{axis} moves from {least} to {most} steps; [positioner] allows {limits.words(axis)}")
    return faults


def _fault(
    steps: Sequence[PlanStep], knowledge: Knowledge, possible: Candidates | None, plan: Judged, axis: Axis, text: str
) -> PlanFault:
    """A fault with its smallest cure, if candidates were found among which to seek one."""
    before = plan.u(axis)
    if possible is None:
        return PlanFault(axis, text, (), before, None)
    cure = _cure(steps, knowledge, possible, axis, plan)
    if cure is None:
        return PlanFault(axis, f"{text}; no {CURE_LOOKS} looks cure it on this rig", (), before, None)
    looks, after = sum(s.action == "look" for s in cure.addition), cure.after.u(axis)
    more = f"{looks} more look{'s' * (looks != 1)}, {describe_looks(knowledge.rig, cure.addition, steps)}"
    text += f"; smallest cure: {more}: u of the {axis} ratio {before:.2g} -> {after:.2g} deg/step"
    return PlanFault(axis, text, cure.addition, before, after)


def _candidates(knowledge: Knowledge, warnings: list[str]) -> Candidates | None:
    """Looks that the rig can make; where it can make none, a warning says so."""
    try:
        return candidates(knowledge)
    except InputError as error:
        warnings.append(f"no cure can be sought on this rig: {error.message}")
        return None


def _few_stops(knowledge: Knowledge, plan: Judged) -> list[str]:
    """Directions whose stops will hardly tell their own scatter, as a sentence."""
    few = few_stops(plan.information.moves, plan.information.seen_moves)
    free = np.asarray(knowledge.space.u) > 0
    named = ", ".join(f"{name} {count}" for name, count in few.items() if free[INDEX[f"stop_sd_deg.{name}"]])
    return [f"few stops ({named}): they will hardly tell their own scatter; add stops"] if named else []


def _sees_few_counters(knowledge: Knowledge, plan: Judged) -> list[str]:
    """Axes whose looks cannot tell gear error from ratio, as sentences."""
    gears, notes = knowledge.gears, list[str]()
    if not gears.size:
        return notes
    moves = [move for move in plan.information.moves if move.move in plan.information.seen_moves]
    uncertain = np.linalg.norm(gears.root, axis=1)[: len(gears.steps)] > LEAST_ERROR_RAD
    for number, axis in enumerate(AXES):
        counters = sorted({getattr(move, f"{axis}_steps") for move in moves})
        of_axis = (gears.on_tilt == (number == 1)) & (gears.share != 0)
        if 2 <= len(counters) <= FEW_COUNTERS and uncertain[of_axis].any():
            places = gears.steps[of_axis].round().astype(int).tolist()
            room = np.diff(places).min() / 2
            telling = [n for n in places if np.abs(np.subtract(counters, n)).min() > room]
            notes.append(too_few_counters(axis, counters, telling))
    return notes


def _with_gears(knowledge: Knowledge, steps: Sequence[PlanStep], possible: Candidates | None) -> Knowledge:
    """What is known, with errors of gears over the counters of the plan and all that the rig could look from."""
    log = run_plan(steps, knowledge.rig)
    looks = [log.moves[look.move] for look in log.looks]
    reached = np.array([(move.pan_steps, move.tilt_steps) for move in looks]).reshape(-1, 2)
    reached = reached if possible is None else np.concatenate([reached, possible.looks.steps])
    return knowledge.with_gears(reached) if len(reached) else knowledge


def check_plan(rig: Rig, steps: Sequence[PlanStep], *, progress: Show | None = None) -> PlanCheck:
    """What a plan on a rig cannot tell apart, in words, and the smallest addition that would (formulation 6).

    Args:
        rig: priors, sheets, limits.
        steps: the plan.
        progress: told how far it is.

    Raises:
        InputError: a plan that looks at nothing or places an unknown sheet.
    """
    knowledge = prior_knowledge(rig)
    with Job({JUDGING: judging_seconds(), CURING: CURED_SECONDS}, progress) as job:
        job.begin(JUDGING)
        possible, warnings = None, list[str]()
        if knowledge.gears_vary:
            possible = _candidates(knowledge, warnings)
            knowledge = _with_gears(knowledge, steps, possible)
        plan = judge(steps, knowledge)
        job.begin(CURING)
        information = plan.information
        looks, in_view = len(information.look_moves), int(information.expectation.seen.sum())
        if in_view < looks:
            warnings.append(f"{looks - in_view} of {looks} looks miss an image at the most probable instrument")
        warnings += beyond_limits(rig.limits, information.moves)
        texts = {axis: text for axis in AXES if (text := plan.fault(axis)) is not None}
        if texts and not knowledge.gears_vary:
            possible = _candidates(knowledge, warnings)
        faults = tuple(_fault(steps, knowledge, possible, plan, axis, text) for axis, text in texts.items())
    warnings += [fault.text for fault in faults]
    warnings += _sees_few_counters(knowledge, plan)
    warnings += _few_stops(knowledge, plan)
    depths = {s.target for s in steps if s.action == "place"}
    if len({rig.sheets_mm[name] for name in depths}) == 1 and len(rig.sheets_mm) > 1:
        warnings.append(
            "all looks are at one depth: a second sheet position sharpens ratios; place "
            + ", ".join(name for name in knowledge.sheets if name not in depths)
        )
    u, shares = np.sqrt(np.diag(plan.covariance)), plan.contraction()
    return PlanCheck(
        looks=looks,
        seen=in_view,
        minutes=information.minutes,
        expected=dict(zip(TARGET_ROWS, map(float, u), strict=True)),
        contraction={
            name: None if math.isnan(share) else float(share) for name, share in zip(TARGET_ROWS, shares, strict=True)
        },
        faults=faults,
        warnings=tuple(warnings),
    )

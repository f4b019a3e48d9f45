"""Faults of a plan in words, and the smallest addition that corrects each.

Plans are evaluated at the most probable instrument by the rules for fits (`stops.inseparable`, `stops.few_stops`).
Counters in steps, u of the ratios in deg/step, minutes by the rig's `[costs]`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.errors import InputError, plural
from tvsbayes.instrument.axes import AXES, SENSES, Axis
from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.instrument.parameters import TARGET_ROWS
from tvsbayes.instrument.places import FEW_COUNTERS, LEAST_ERROR_RAD, too_few_counters
from tvsbayes.instrument.plan import PlanStep, continued, describe_looks, run_plan
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stops import Stop, few_stops, inseparable, observed_stops, one_sided, separation
from tvsbayes.planning.candidates import Candidates, candidates
from tvsbayes.planning.expectation import Knowledge, PlanInformation, expect, information_of, prior_knowledge
from tvsbayes.planning.looks import LookArrays, Looks, arrange
from tvsbayes.progress import Job, Show
from tvsbayes.results.estimates import CONTRACTION_LIMIT
from tvsbayes.results.plan_record import Action, actions_of
from tvsbayes.results.records import Record
from tvsbayes.statistics.optimal_design import Search, covariance_of

ADDED_LOOKS_MAX = 24
"""Largest number of looks in an addition."""
JUDGING, CURING = "evaluating the plan", "searching for more looks"
EVALUATED_SECONDS, EXPECT_COMPILED_SECONDS, CURED_SECONDS = 0.2, 12.0, 1.0
"""Expected durations for the progress display, s."""


def evaluation_seconds() -> float:
    """Predict the duration of evaluating a plan, s."""
    return EVALUATED_SECONDS + expect.wait(EXPECT_COMPILED_SECONDS)


class PlanFault(Record, frozen=True):
    """A quantity that a plan does not determine, and the smallest addition that determines it.

    Attributes:
        axis: pan or tilt.
        text: the fault in words.
        addition: actions to append to the plan, empty where none was found.
        u_deg_per_step: u of the worst effective ratio of the axis with them; None without.
    """

    axis: Axis
    text: str
    addition: tuple[Action, ...] = ()
    u_deg_per_step: float | None = None


class PlanCheck(Record, frozen=True, tag_field="kind", tag="rig with plan"):
    """Result of `check RIG PLAN`.

    Attributes:
        looks, seen: all looks, and those in both images at the most probable instrument.
        minutes: duration by `[costs]`.
        expected: u of every headline after the plan, in its unit.
        contraction: 1 - var_post / var_prior of every headline, None where the priors fix it.
        faults: faults of the plan.
        warnings: faults and further warnings, as sentences.
    """

    looks: int
    seen: int
    minutes: float
    expected: dict[str, float]
    contraction: dict[str, float | None]
    faults: tuple[PlanFault, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class PlanEvaluation:
    """Expected headlines of a plan: their covariance, shape (9, 9), gradients and prior variances, shape (9,)."""

    information: PlanInformation
    covariance: np.ndarray
    gradient: np.ndarray
    prior: np.ndarray

    def rows(self, axis: Axis) -> list[int]:
        """Return the rows of the ratio and of the backlash of an axis."""
        return [TARGET_ROWS[SENSES[axis][0]], TARGET_ROWS[f"backlash.{axis}"]]

    def exchange(self, axis: Axis) -> float:
        """Compute the correlation of ratio and backlash of an axis; its square is their common share of variance."""
        rows = self.rows(axis)
        (ratio, both), (_, backlash) = self.covariance[np.ix_(rows, rows)]
        return float(both / np.sqrt(ratio * backlash)) if self.prior[rows[1]] else 0.0

    def u(self, axis: Axis) -> float:
        """Return the uncertainty of the worse effective ratio of an axis, deg/step."""
        rows = [TARGET_ROWS[direction] for direction in SENSES[axis]]
        return float(np.sqrt(np.diag(self.covariance)[rows].max()))

    def contraction(self) -> np.ndarray:
        """Compute the contraction of every headline, shape (9,); NaN where its prior fixes it."""
        variance = np.diag(self.covariance)
        return 1 - np.divide(variance, self.prior, out=np.full(len(variance), np.nan), where=self.prior > 0)

    def stops(self, axis: Axis) -> tuple[Stop, ...]:
        """Return the stops with a visible look."""
        return observed_stops(self.information.moves, self.information.seen_moves, axis)

    def inseparable_text(self, axis: Axis) -> str:
        """Write that ratio and backlash of the axis are not separable."""
        share = 100 * self.exchange(axis) ** 2
        return f"{axis} ratio and {axis} backlash are not well separated ({share:.0f} % of the variance is common)"

    def fault(self, axis: Axis) -> str | None:
        """Describe the fault of the axis: ratio or backlash not determined, or not separable; None without one."""
        for name, contraction in zip(("ratio", "backlash"), self.contraction()[self.rows(axis)], strict=True):
            if contraction < CONTRACTION_LIMIT:
                text = f"the plan does not determine the {axis} {name}"
                break
        else:
            free = self.prior[self.rows(axis)[1]] > 0
            if not (inseparable(self.exchange(axis)) or (free and one_sided(self.stops(axis), axis) is not None)):
                return None
            text = self.inseparable_text(axis)
        reason = separation(self.stops(axis), axis)
        return text if reason is None else f"{text}: {reason}"


def evaluated(steps: Sequence[PlanStep], knowledge: Knowledge, *, aperture: bool = False) -> PlanEvaluation:
    """Compute expected headlines of a plan at the most probable instrument.

    Raises:
        InputError: a plan that looks at nothing or places an unknown sheet.
    """
    information = information_of(steps, knowledge, aperture=aperture)
    gradient = np.asarray(knowledge.gears.headlines(knowledge.z, knowledge.space, information.pose_rad).gradient)
    covariance = gradient @ covariance_of(knowledge.precision + information.fisher) @ gradient.T
    prior = np.einsum("qi,ij,qj->q", gradient, knowledge.covariance, gradient)
    return PlanEvaluation(information, covariance, gradient, prior)


def appended(steps: Sequence[PlanStep], looks: Looks, knowledge: Knowledge, run_up: np.ndarray) -> tuple[PlanStep, ...]:
    """Write looks as steps after a plan: without homing, with a placement only where another sheet is needed."""
    end = run_plan(steps, knowledge.rig)
    return continued(arrange(looks, knowledge.sheets, run_up, end.at).steps_onwards, len(steps), end.sheet)


def _fault(
    steps: Sequence[PlanStep], knowledge: Knowledge, possible: Candidates | None, plan: PlanEvaluation, axis: Axis
) -> PlanFault | None:
    """Describe the fault of an axis with the fewest looks on the present sheet that correct it; None without one."""
    text = plan.fault(axis)
    if text is None or possible is None:
        return None if text is None else PlanFault(axis, text)
    seen, rows = LookArrays(possible.looks, knowledge, False).at(knowledge.z, knowledge.space), plan.rows(axis)
    precision = knowledge.precision + plan.information.fisher
    search = Search(seen.rows[..., :-2], precision, plan.gradient[rows], np.zeros(len(rows)), "A")
    sheet = run_plan(steps, knowledge.rig).sheet
    allowed = possible.looks.sheet == (knowledge.sheets.index(sheet) if sheet in knowledge.sheets else 0)
    picks = np.array(search.among(allowed).greedy(ADDED_LOOKS_MAX), dtype=int)
    for count in range(1, len(picks) + 1):
        addition = appended(steps, possible.looks[picks[:count]], knowledge, possible.run_up)
        after = evaluated((*steps, *addition), knowledge)
        if after.fault(axis) is None:
            looks = f"{plural(count, 'more look')}, {describe_looks(knowledge.rig, addition, steps)}"
            text += f"; smallest addition: {looks}: u of the {axis} ratio {plan.u(axis):.2g} -> {after.u(axis):.2g} "
            return PlanFault(axis, f"{text}deg/step", actions_of(addition), after.u(axis))
    return PlanFault(axis, f"{text}; up to {ADDED_LOOKS_MAX} more looks do not change that on this rig")


def beyond_limits(limits: CounterLimits, moves: Sequence[Move]) -> list[str]:
    """Describe axes beyond the limits of `[positioner]` in sentences."""
    made = {axis: [getattr(move, f"{axis}_steps") for move in moves] for axis in AXES}
    return [
        f"{axis} moves from {min(counters)} to {max(counters)} steps; [positioner] allows {limits.words(axis)}"
        for axis, counters in made.items()
        if not (limits.allow(axis, min(counters)) and limits.allow(axis, max(counters)))
    ]


def _few_stops(knowledge: Knowledge, plan: PlanEvaluation) -> list[str]:
    """Describe directions with too few stops for their scatter in a sentence."""
    counts = few_stops(plan.information.moves, plan.information.seen_moves)
    free, index = np.asarray(knowledge.space.u) > 0, knowledge.space.mechanism.index
    counts_text = ", ".join(f"{name} {count}" for name, count in counts.items() if free[index[f"stop_sd_deg.{name}"]])
    return [f"few stops ({counts_text}): too few to estimate their scatter; add stops"] if counts_text else []


def _few_counters(knowledge: Knowledge, plan: PlanEvaluation) -> list[str]:
    """Describe axes with too few counters to separate gear error and ratio in sentences."""
    gears, notes = knowledge.gears, list[str]()
    if not gears.size:
        return notes
    moves = [move for move in plan.information.moves if move.move in plan.information.seen_moves]
    has_error = np.linalg.norm(gears.root, axis=1)[: len(gears.steps)] > LEAST_ERROR_RAD
    for number, axis in enumerate(AXES):
        counters = sorted({getattr(move, f"{axis}_steps") for move in moves})
        of_axis = (gears.on_tilt == (number == 1)) & (gears.share != 0)
        if 2 <= len(counters) <= FEW_COUNTERS and has_error[of_axis].any():
            places = gears.steps[of_axis].round().astype(int).tolist()
            half_gap = np.diff(places).min() / 2
            suggested = [n for n in places if np.abs(np.subtract(counters, n)).min() > half_gap]
            notes.append(too_few_counters(axis, counters, suggested))
    return notes


def check_plan(rig: Rig, steps: Sequence[PlanStep], *, progress: Show | None = None) -> PlanCheck:
    """Find faults of a plan on a rig, in words, and the smallest addition that corrects each (formulation 6).

    Args:
        rig: priors, sheets, limits.
        steps: the plan.
        progress: receives the progress.

    Raises:
        InputError: a plan that looks at nothing or places an unknown sheet.
    """
    knowledge, warnings = prior_knowledge(rig), list[str]()

    def possible() -> Candidates | None:
        try:
            return candidates(knowledge)
        except InputError as error:
            warnings.append(f"no looks can be added on this rig: {error.message}")
            return None

    with Job({JUDGING: evaluation_seconds(), CURING: CURED_SECONDS}, progress) as job:
        job.begin(JUDGING)
        pool = possible() if knowledge.gears_vary else None
        log = run_plan(steps, rig)
        reached = [(log.moves[look.move].pan_steps, log.moves[look.move].tilt_steps) for look in log.looks]
        if reached:
            # Errors of the gears over the counters of the plan and of all candidates.
            knowledge = knowledge.with_gears(np.array(reached + ([] if pool is None else pool.looks.steps.tolist())))
        plan = evaluated(steps, knowledge)
        job.begin(CURING)
        looks, in_view = len(plan.information.look_moves), int(plan.information.expectation.seen.sum())
        if in_view < looks:
            warnings.append(f"{looks - in_view} of {looks} looks miss an image at the most probable instrument")
        warnings += beyond_limits(rig.limits, plan.information.moves)
        if not knowledge.gears_vary and any(plan.fault(axis) is not None for axis in AXES):
            pool = possible()
        found = (_fault(steps, knowledge, pool, plan, axis) for axis in AXES)
        faults = tuple(fault for fault in found if fault is not None)
    warnings += [fault.text for fault in faults] + _few_counters(knowledge, plan) + _few_stops(knowledge, plan)
    placed = {s.target for s in steps if s.action == "place"}
    if len({rig.sheets_mm[name] for name in placed}) == 1 and len(rig.sheets_mm) > 1:
        others = ", ".join(name for name in knowledge.sheets if name not in placed)
        warnings.append(f"all looks are at one depth: a second sheet position lowers u of ratios; place {others}")
    u, shares = np.sqrt(np.diag(plan.covariance)).tolist(), plan.contraction().tolist()
    return PlanCheck(
        looks=looks,
        seen=in_view,
        minutes=plan.information.minutes,
        expected=dict(zip(TARGET_ROWS, u, strict=True)),
        contraction={n: None if math.isnan(share) else share for n, share in zip(TARGET_ROWS, shares, strict=True)},
        faults=faults,
        warnings=tuple(warnings),
    )

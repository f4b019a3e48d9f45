"""The smallest sufficient plan: families of looks chosen greedily over choices of sheets, and their exchange.

Values in the target's unit, minutes by the rig's `[costs]`; an experiment is four looks. Rows and precisions are in the
coordinates, with two more columns (rad) for the home offset of (pan, tilt) after an earlier campaign.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.instrument.mechanisms import CONTRAST_COLUMNS
from tvsbayes.instrument.parameters import TARGET_ROWS
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT, PlanLog, PlanStep, continued, plan_minutes
from tvsbayes.planning.assurance import Assurance, Family
from tvsbayes.planning.candidates import Candidates, candidates, sheet_choices
from tvsbayes.planning.expectation import Knowledge
from tvsbayes.planning.looks import LookArrays, LookPlan, Seen, arrange, information_of_looks
from tvsbayes.planning.target import Sensitivity, Target, sensitivity
from tvsbayes.progress import Advance, unshown
from tvsbayes.statistics.optimal_design import Search, covariance_of

LADDER = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
"""Numbers of experiments of the curve; 96 is the paper's."""
CONTRAST_PRECISION = 1e8
"""Precision of the contrasts during a search: their information depends on the path, which is not yet known."""
SUBSETS_MAX = 40
"""Largest number of choices of sheets that are searched."""
EXCHANGED_SHARE = 0.6
"""Share of the exchanges in the expected time of `refine`, for the progress display."""


@dataclass(frozen=True)
class Scope:
    """Scope of the search for a design.

    Attributes:
        criterion: one of `CRITERIA`: "c" the target, "D" or "A" ratios and backlashes together.
        aperture: looks also read the aperture.
        largest: largest number of experiments.
        minutes: the plan must not take longer.
    """

    criterion: str = "c"
    aperture: bool = False
    largest: int = LADDER[-1]
    minutes: float = math.inf


@dataclass(frozen=True)
class Choice:
    """A few looks chosen together, and their worth.

    Attributes:
        picks: numbers of the candidates, shape (k,).
        design: their plan.
        steps: its steps: from a homing on, or as they continue a session.
        minutes: duration by `[costs]`, without the placement of a sheet in place.
        value: value of the target after them, in the target's unit; `gain`: its reduction; `gain_per_minute`.
    """

    picks: np.ndarray
    design: LookPlan
    steps: tuple[PlanStep, ...]
    minutes: float
    value: float
    gain: float

    @property
    def gain_per_minute(self) -> float:
        """Return the reduction of the target a minute."""
        return self.gain / max(self.minutes, 1e-9)


@dataclass(frozen=True)
class DesignProblem:
    """The candidates, their expectation at the most probable instrument, and the target there.

    Attributes:
        knowledge: knowledge with the errors of the gears at places over all candidates.
        candidates: looks to choose from.
        seen: their expectation.
        target: target of the design.
        at_centre: sensitivity of the target.
        warming: whether the zeros creep during the looks; False where `seen` includes the creep of the whole session.
    """

    knowledge: Knowledge
    candidates: Candidates
    seen: Seen
    target: Target
    at_centre: Sensitivity
    warming: bool = True

    @classmethod
    def of(
        cls, knowledge: Knowledge, target: Target, pose_rad: np.ndarray | None = None, aperture: bool = False
    ) -> DesignProblem:
        """Take all candidates; effective ratios are at `pose_rad`, by default in the middle of them.

        Raises:
            InputError: nothing to look at or in view; a fixed target.
        """
        possible = candidates(knowledge)
        knowledge = knowledge.with_gears(possible.looks.steps)
        seen = LookArrays(possible.looks, knowledge, aperture).at(knowledge.z, knowledge.space)
        pose = seen.mirror_angles_rad.mean(axis=0) if pose_rad is None else pose_rad
        at_centre = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose, knowledge.gears)
        problem = cls(knowledge, possible, seen, target, at_centre)
        if problem.now == 0:
            raise InputError(
                "target",
                f"{target.quantity} is held fixed by the rig (u = 0): no plan changes its uncertainty",
                column="--target",
                found=target.text,
                allowed="a quantity that is to be estimated",
                remedy="state u > 0 for it in [rig.prior], or another target",
            )
        return problem

    @cached_property
    def now(self) -> float:
        """Compute the target's value before any further look."""
        return self.at_centre.value(self.knowledge.covariance, self.target.factor)

    def search(self, criterion: str = "c") -> Search:
        """Build a search among the looks, for the target, or by "D" or "A" for ratios and backlashes of both axes.

        Contrasts count as known; after data home offsets are two more columns.
        """
        known, aim, rows = self.knowledge, self.at_centre, self.seen.rows
        if criterion != "c":
            pose_rad = self.seen.mirror_angles_rad.mean(axis=0)
            every = np.asarray(known.gears.headlines(known.z, known.space, pose_rad).gradient)
            aim = Sensitivity(every[[TARGET_ROWS[q] for q in ("left", "up", "backlash.pan", "backlash.tilt")]])
        size, width = known.size, rows.shape[2] if known.after_data else known.size
        precision, gradient = np.zeros((width, width)), np.zeros((len(aim.gradient), width))
        precision[:size, :size], gradient[:, :size] = known.precision, aim.gradient
        precision[CONTRAST_COLUMNS, CONTRAST_COLUMNS] += CONTRAST_PRECISION
        if known.home_variances_rad2 is not None:
            precision[range(size, width), range(size, width)] = 1 / known.home_variances_rad2
        return Search(rows[..., :width], precision, gradient, aim.own_variance, criterion)

    def information(self, picks: np.ndarray, design: LookPlan, taken: np.ndarray | None = None) -> np.ndarray:
        """Compute the information of the looks `picks` (k,) of a design, or of those `taken` (indices in `picks`)."""
        rows = np.arange(len(picks)) if taken is None else taken
        minutes = design.warm_minutes(self.knowledge.rig)[rows] if self.warming else None
        context = self.knowledge.space, self.knowledge.home_variances_rad2, minutes
        return information_of_looks(self.seen, picks[rows], design.path[rows], *context)

    def value(self, picks: np.ndarray, design: LookPlan, taken: np.ndarray | None = None) -> float:
        """Compute the value of the target after looks, see `information`; in its unit."""
        precision = self.knowledge.precision + self.information(picks, design, taken)
        return self.at_centre.value(covariance_of(precision), self.target.factor)

    def choices(self, count: int, subsets: Iterable[np.ndarray], session: PlanLog | None = None) -> list[Choice]:
        """Choose the best looks in each subset of the candidates.

        Args:
            count: number of looks.
            subsets: masks of candidates, shape (m,) each; those without a candidate are omitted.
            session: the session that the looks continue; None for plans that begin with a homing.
        """
        search = self.search()
        picks = (np.array(search.among(subset).greedy(count)) for subset in subsets if subset.any())
        return [self._choice(each, session) for each in picks]

    def _choice(self, picks: np.ndarray, session: PlanLog | None) -> Choice:
        looks, rig, run_up = self.candidates.looks[picks], self.knowledge.rig, self.candidates.run_up
        design = arrange(looks, self.knowledge.sheets, run_up, session.at if session else (0, 0))
        if session is None:
            steps, minutes = design.steps, design.minutes(rig)
        else:
            # The first look gets a run-up, since the counters at the start of the looks are unknown.
            via = design.via.copy()
            via[0] = design.goal[0] - looks.side[design.order[0]] * run_up
            design = replace(design, via=via)
            steps = design.steps_onwards
            minutes = plan_minutes(rig, continued(steps, 0, session.sheet))
        value = self.value(picks, design)
        return Choice(picks, design, steps, minutes, value, max(self.now - value, 0.0))


def design_family(problem: DesignProblem, scope: Scope | None = None, advance: Advance = unshown) -> Family:
    """Find the choice of sheets and order of looks that meet the target soonest.

    For every choice of sheets looks are added greedily. The result is the choice that first meets the target, in
    minutes, or the best after the largest number of experiments (or minutes) if none does.
    """
    scope, knowledge, looks = scope or Scope(), problem.knowledge, problem.candidates.looks

    def merit(family: Family) -> tuple[float, float]:
        """Minutes until it meets the target, infinite where it never does, then the target's value."""
        best = math.inf, math.inf
        for n in (n for n in LADDER if n <= scope.largest):
            design = family.arranged(n)
            minutes = design.minutes(knowledge.rig)
            if minutes > scope.minutes:
                break
            value = problem.value(family.picks[: LOOKS_PER_EXPERIMENT * n], design)
            best = min(best, (minutes if value <= problem.target.limit else math.inf, value))
        return best

    search, families = problem.search(scope.criterion), []
    # The sheets that are farthest apart come first.
    subsets = sorted(sheet_choices(range(len(knowledge.sheets)), 3), key=lambda s: (s[0] - s[-1], len(s)))[:SUBSETS_MAX]
    for number, subset in enumerate(subsets):
        advance(number / len(subsets))
        allowed = np.isin(looks.sheet, subset)
        if allowed.any():
            picks = np.array(search.among(allowed).greedy(LOOKS_PER_EXPERIMENT * scope.largest))
            families.append(Family(knowledge, problem.candidates, picks, scope.aperture))
    return min(families, key=merit)


def refine(
    assurance: Assurance, problem: DesignProblem, experiments: int, scope: Scope, advance: Advance = unshown
) -> tuple[Family, np.ndarray]:
    """Improve the design of n experiments by exchanges.

    Exchanges are optimal for the most probable instrument; they are kept only where assurance and time permit.

    Returns:
        The design, and the reported uncertainty of the target over the truths, shape (draws,).
    """
    family, sheet = assurance.family, problem.candidates.looks.sheet
    picks = family.picks[: LOOKS_PER_EXPERIMENT * experiments]
    unchanged = replace(family, picks=picks), assurance.values([experiments])[experiments]
    if scope.criterion != "c":
        return unchanged
    search = problem.search().among(np.isin(sheet, sheet[picks]))
    exchanged = replace(family, picks=np.array(search.exchange(picks.tolist())))
    if exchanged.arranged(experiments).minutes(family.knowledge.rig) > scope.minutes:
        return unchanged
    advance(EXCHANGED_SHARE)

    def merit(refined: tuple[Family, np.ndarray]) -> tuple[float, float]:
        return float(np.mean(refined[1] <= problem.target.limit)), -float(np.median(refined[1]))

    # Of equals the unchanged one.
    return max(unchanged, (exchanged, assurance.of(exchanged).values([experiments])[experiments]), key=merit)

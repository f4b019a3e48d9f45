"""The smallest sufficient plan: greedy choice of looks, and their exchange, over choices of sheets.

Scores are variances of the target's quantities; rows and precisions are in the coordinates, with two more columns (rad)
for the home offset of (pan, tilt) after an earlier campaign.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tvsbayes.instrument.mechanisms import CONTRAST_COLUMNS
from tvsbayes.instrument.parameters import TARGET_ROWS
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT, PlanLog, PlanStep, continued, plan_minutes
from tvsbayes.planning.assurance import Assurance, Family
from tvsbayes.planning.candidates import Candidates, sheet_choices
from tvsbayes.planning.expectation import Knowledge
from tvsbayes.planning.looks import LookPlan, Seen, arrange, covariance_of, information_of_looks
from tvsbayes.planning.target import Sensitivity, Target
from tvsbayes.progress import Advance, unshown

CRITERIA = ("c", "D", "A")
EXCHANGED_SHARE = 0.6
"""Share of the exchanges in the expected time of `refine`, for the progress display."""
MEAN_WEIGHT = 0.05
"""Weight of the mean variance added to the worst, so that looks that improve only other quantities count a little."""


def scores(variances: np.ndarray, reference: np.ndarray, criterion: str) -> np.ndarray:
    """Compute scores to minimise from covariances (..., q, q) of the quantities; shape (...).

    "c": the worst variance and `MEAN_WEIGHT` of the mean; "D": log-determinant; "A": mean variance in units of
    `reference` (q,).
    """
    if criterion == "D":
        return np.linalg.slogdet(variances / np.sqrt(np.outer(reference, reference)))[1]
    diagonal = np.diagonal(variances, axis1=-2, axis2=-1)
    if criterion == "A":
        return np.mean(diagonal / reference, axis=-1)
    return diagonal.max(axis=-1) + MEAN_WEIGHT * diagonal.mean(axis=-1)


@dataclass(frozen=True)
class _Prospects:
    """Covariances with every candidate as the next look; the last axis is over candidates.

    Attributes:
        covariance: covariance of the columns before that look, shape (P, P).
        inner: covariance of its residuals, noise included, shape (4, 4, m).
        moved: covariance of its residuals with the quantities, shape (4, q, m).
    """

    covariance: np.ndarray
    inner: np.ndarray
    moved: np.ndarray

    def gain(self) -> np.ndarray:
        """Compute the reduction of the covariance of the quantities, moved^T inner^-1 moved, shape (q, q, m).

        Elimination runs over all candidates at once; LAPACK calls for each would be slower.
        """
        inner, moved = self.inner.copy(), self.moved.copy()
        gain = np.zeros((moved.shape[1], *moved.shape[1:]))
        for i in range(len(inner)):
            gain += moved[i, :, None] * (moved[i] / inner[i, i])
            factor = inner[i + 1 :, i] / inner[i, i]
            inner[i + 1 :, i + 1 :] -= factor[:, None] * inner[i, i + 1 :]
            moved[i + 1 :] -= factor[:, None] * moved[i]
        return gain


RECOMPUTED_AFTER = 16
"""Number of added looks after which prospects are recomputed, as rounding errors of differences accumulate."""


class Search:
    """Greedy choice and exchange of looks by low-rank updates of one covariance.

    A quantity fixed by the priors has no variance and is omitted.

    Args:
        rows: rows of all candidates, shape (m, 4, P); an excluded candidate has zero rows.
        precision: precision before any look, shape (P, P).
        gradient: d(quantity)/d(column), shape (q, P).
        variance: additional variance of the quantities, shape (q,).
        criterion: see `scores`.
        numbers: numbers of the candidates, ascending, shape (m,); by default their indices in `rows`.
    """

    def __init__(
        self,
        rows: np.ndarray,
        precision: np.ndarray,
        gradient: np.ndarray,
        variance: np.ndarray,
        criterion: str = "c",
        numbers: np.ndarray | None = None,
    ):
        self.rows, self.precision, self.criterion = rows, precision, criterion
        self.numbers = np.arange(len(rows)) if numbers is None else numbers
        self.covariance = covariance_of(precision)
        self.gradient, self.variance = gradient, variance
        uncertain = np.diag(self._quantities(self.covariance)) > 0
        self.gradient, self.variance = gradient[uncertain], variance[uncertain]
        self.reference = np.diag(self._quantities(self.covariance)).copy()
        # Candidates are last, as in prospects, so that large products need no copy.
        self.columns = np.ascontiguousarray(rows.transpose(2, 1, 0)).reshape(rows.shape[2], -1)

    def _quantities(self, covariance: np.ndarray) -> np.ndarray:
        return self.gradient @ covariance @ self.gradient.T + np.diag(self.variance)

    def _prospects(self, covariance: np.ndarray) -> _Prospects:
        count, components, columns = self.rows.shape
        spread = (self.rows.reshape(-1, columns) @ covariance).reshape(self.rows.shape)
        inner = (spread @ self.rows.transpose(0, 2, 1)).transpose(1, 2, 0) + np.eye(components)[:, :, None]
        moved = (self.gradient @ covariance @ self.columns).reshape(len(self.gradient), components, count)
        return _Prospects(covariance, inner, moved.swapaxes(0, 1))

    def _scores(self, prospects: _Prospects) -> np.ndarray:
        remaining = self._quantities(prospects.covariance)[:, :, None] - prospects.gain()
        return scores(np.moveaxis(remaining, -1, 0), self.reference, self.criterion)

    def after_one_more(self, covariance: np.ndarray) -> np.ndarray:
        """Compute the score after adding each candidate, shape (m,): C - B^T K^-1 B, K of four components."""
        return self._scores(self._prospects(covariance))

    def _with(self, prospects: _Prospects, index: int) -> _Prospects:
        """Compute prospects after one more look, by a low-rank update of every covariance."""
        row, (components, _, count) = self.rows[index], prospects.inner.shape
        root = np.linalg.cholesky(np.eye(components) + row @ prospects.covariance @ row.T)
        update = np.linalg.solve(root, row @ prospects.covariance)
        cross = (update @ self.columns).reshape(components, components, count)
        inner = prospects.inner - sum(part[:, None] * part for part in cross)
        slope = update @ self.gradient.T
        moved = prospects.moved - sum(part[:, None] * row[:, None] for part, row in zip(cross, slope, strict=True))
        covariance = prospects.covariance - update.T @ update
        return _Prospects(0.5 * (covariance + covariance.T), inner, moved)

    def greedy(self, count: int) -> list[int]:
        """Choose the best look, then the best addition, and so on; empty where there is no candidate."""
        prospects, places = self._prospects(self.covariance), []
        for count_added in range(1, count + 1 if len(self.rows) else 1):
            places.append(int(np.argmin(self._scores(prospects))))
            prospects = self._with(prospects, places[-1])
            if count_added % RECOMPUTED_AFTER == 0:
                prospects = self._prospects(prospects.covariance)
        return self.numbers[places].tolist()

    def _places(self, picks: Sequence[int]) -> list[int]:
        return np.searchsorted(self.numbers, list(picks)).tolist()

    def among(self, allowed: np.ndarray) -> Search:
        """Restrict the search to some candidates, mask of shape (m,)."""
        quantities = self.gradient, self.variance
        return Search(self.rows[allowed], self.precision, *quantities, self.criterion, self.numbers[allowed])

    def _after(self, places: Sequence[int]) -> np.ndarray:
        """Compute the covariance of the columns after a design."""
        rows = self.rows[list(places)].reshape(-1, self.rows.shape[2])
        return covariance_of(self.precision + rows.T @ rows)

    def value(self, picks: Sequence[int]) -> float:
        """Compute the score of a design."""
        return float(scores(self._quantities(self._after(self._places(picks))), self.reference, self.criterion))

    def exchange(self, picks: Sequence[int], passes: int = 2, worth: float = 1e-3) -> list[int]:
        """Replace looks one by one while this lowers the score by more than a share `worth` (Fedorov's exchange)."""
        places = self._places(picks)
        for _ in range(passes):
            changed = False
            for number, look in enumerate(places):
                scores_with = self.after_one_more(self._after(places[:number] + places[number + 1 :]))
                best = int(np.argmin(scores_with))
                if scores_with[look] - scores_with[best] > worth * abs(scores_with[look]):
                    places[number], changed = best, True
            if not changed:
                break
        return self.numbers[places].tolist()


LADDER = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
"""Numbers of experiments of the curve; 96 is the paper's."""
CONTRAST_PRECISION = 1e8
"""Precision of the contrasts during a search: their information depends on the path, which is not yet known."""


def search_precision(knowledge: Knowledge) -> np.ndarray:
    """Return the precision with known contrasts; after data home offsets are two more columns."""
    precision = knowledge.precision.copy()
    precision[CONTRAST_COLUMNS, CONTRAST_COLUMNS] += CONTRAST_PRECISION
    variances = knowledge.home_variances_rad2
    if variances is None:
        return precision
    size = len(precision)
    full = np.zeros((size + 2, size + 2))
    full[:size, :size] = precision
    full[range(size, size + 2), range(size, size + 2)] = 1 / variances
    return full


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
    minutes: float | None = None


SUBSETS_MAX = 40
"""Largest number of choices of sheets that are searched."""


@dataclass(frozen=True)
class Choice:
    """A few looks chosen together, and their worth.

    Attributes:
        picks: numbers of the candidates, shape (k,).
        design: their plan.
        steps: its steps: from a homing on, or as they continue a session.
        minutes: duration by `[costs]`, without the placement of a sheet in place.
        value: value of the target after them, in the target's unit.
        gain: its reduction.
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

    @cached_property
    def now(self) -> float:
        """Compute the target's value before any further look."""
        return self.at_centre.value(self.knowledge.covariance, self.target.factor)

    def search(self, sensitivity_sought: Sensitivity | None = None, criterion: str = "c") -> Search:
        """Build a search among the looks, for the target or for other quantities; contrasts count as known."""
        # The last two columns of rows are those of home offsets.
        rows = self.seen.rows if self.knowledge.after_data else self.seen.rows[..., :-2]
        aim = self.at_centre if sensitivity_sought is None else sensitivity_sought
        gradient = np.zeros((len(aim.gradient), rows.shape[2]))
        gradient[:, : self.knowledge.size] = aim.gradient
        return Search(rows, search_precision(self.knowledge), gradient, aim.own_variance, criterion)

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


def _of_gears(knowledge: Knowledge, seen: Seen) -> Sensitivity:
    """Compute the sensitivity of ratios and backlashes of both axes, in the middle of the looks."""
    pose_rad = seen.mirror_angles_rad.mean(axis=0)
    everything = np.asarray(knowledge.gears.headlines(knowledge.z, knowledge.space, pose_rad).gradient)
    return Sensitivity(everything[[TARGET_ROWS[q] for q in ("left", "up", "backlash.pan", "backlash.tilt")]])


@dataclass(frozen=True, order=True)
class _FamilyScore:
    """Minutes until a family meets the target, infinite where it never does, then the target's value."""

    minutes: float = math.inf
    value: float = math.inf


def _family_score(family: Family, problem: DesignProblem, scope: Scope) -> _FamilyScore:
    best = _FamilyScore()
    for n in (n for n in LADDER if n <= scope.largest):
        design = family.arranged(n)
        duration = design.minutes(problem.knowledge.rig)
        if scope.minutes is not None and duration > scope.minutes:
            break
        value = problem.value(family.picks[: LOOKS_PER_EXPERIMENT * n], design)
        best = min(best, _FamilyScore(duration if value <= problem.target.limit else math.inf, value))
    return best


def design_family(problem: DesignProblem, scope: Scope | None = None, advance: Advance = unshown) -> Family:
    """Find the choice of sheets and order of looks that meet the target soonest.

    For every choice of sheets looks are added greedily. The result is the choice that first meets the target, in
    minutes, or the best after the largest number of experiments (or minutes) if none does.
    """
    scope, knowledge, candidates = scope or Scope(), problem.knowledge, problem.candidates
    search = problem.search(None if scope.criterion == "c" else _of_gears(knowledge, problem.seen), scope.criterion)
    families = []
    # The sheets that are farthest apart come first.
    subsets = sorted(sheet_choices(range(len(knowledge.sheets)), 3), key=lambda s: (s[0] - s[-1], len(s)))[:SUBSETS_MAX]
    for number, subset in enumerate(subsets):
        advance(number / len(subsets))
        allowed = np.isin(candidates.looks.sheet, subset)
        if allowed.any():
            picks = search.among(allowed).greedy(LOOKS_PER_EXPERIMENT * scope.largest)
            families.append(Family(knowledge, candidates, np.array(picks), scope.aperture))
    return min(families, key=lambda family: _family_score(family, problem, scope))


def smallest_design(meets: Callable[[int], bool], sizes: Sequence[int]) -> int | None:
    """Find the smallest whole number that meets a monotone condition, bracketed by `sizes` first."""
    above = next((n for n in sizes if meets(n)), None)
    if above is None:
        return None
    below = max((n for n in sizes if n < above), default=0)
    while above - below > 1:
        middle = (above + below) // 2
        above, below = (middle, below) if meets(middle) else (above, middle)
    return above


@dataclass(frozen=True)
class Refined:
    """A design, and the reported uncertainty of the target over the truths, shape (draws,)."""

    family: Family
    reported: np.ndarray


def refine(
    family: Family,
    problem: DesignProblem,
    experiments: int,
    scope: Scope,
    assurance: Assurance,
    advance: Advance = unshown,
) -> Refined:
    """Improve the design of n experiments by exchanges.

    Exchanges are optimal for the most probable instrument; they are kept only where assurance and time permit.
    """
    knowledge, candidates = family.knowledge, family.candidates
    picks = family.picks[: LOOKS_PER_EXPERIMENT * experiments]
    unchanged = Refined(replace(family, picks=picks), assurance.values([experiments])[experiments])
    if scope.criterion != "c":
        return unchanged
    allowed = np.isin(candidates.looks.sheet, candidates.looks.sheet[picks])
    exchanged = replace(family, picks=np.array(problem.search().among(allowed).exchange(picks.tolist())))
    duration = exchanged.arranged(experiments).minutes(knowledge.rig)
    if scope.minutes is not None and duration > scope.minutes:
        return unchanged
    advance(EXCHANGED_SHARE)
    exchanged_result = Refined(exchanged, assurance.of(exchanged).values([experiments])[experiments])

    def merit(result: Refined) -> tuple[float, float]:
        return float(np.mean(result.reported <= problem.target.limit)), -float(np.median(result.reported))

    return exchanged_result if merit(exchanged_result) > merit(unchanged) else unchanged

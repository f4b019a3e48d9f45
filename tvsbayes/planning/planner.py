"""Planning: the cheapest plan that meets a target, its assurance, and the stopping rule.

Values in the target's unit, minutes by the rig's `[costs]`; an experiment is four looks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from msgspec import structs

from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError, NotConverged, plural
from tvsbayes.estimators.linear_spots import LinearSpots, stop_information
from tvsbayes.instrument.axes import AXES, DIRECTION_SIGNS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT, PlanStep
from tvsbayes.instrument.protocols import grid_protocol, mixed_protocol, paper_protocol
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stops import FEW_STOPS, inseparable, too_few
from tvsbayes.planning.assurance import Assurance, Family, instrument_gears
from tvsbayes.planning.candidates import candidates
from tvsbayes.planning.drawn_rigs import Instruments, alike, draw_instruments
from tvsbayes.planning.expectation import (
    Expectation,
    Knowledge,
    PlanInformation,
    information_of,
    knowledge_of,
    prior_knowledge,
)
from tvsbayes.planning.forecast import (
    ClassicAnswer,
    ClassicForecast,
    classic_answer,
    classic_forecast,
    value_of_classic,
)
from tvsbayes.planning.limits import Limit, limit_of, next_experiments, split_of, stop_now
from tvsbayes.planning.looks import LookArrays, Looks, covariance_of, looks_wait
from tvsbayes.planning.plan_check import JUDGING, Judgement, judge, judging_seconds
from tvsbayes.planning.search import LADDER, DesignProblem, Refined, Scope, design_family, refine, smallest_design
from tvsbayes.planning.target import Target, sensitivity
from tvsbayes.progress import Advance, Job, Show
from tvsbayes.results.plan_record import Advice, Batch
from tvsbayes.results.records import Record
from tvsbayes.statistics.chances import ASSURED, share_error

if TYPE_CHECKING:
    from tvsbayes.estimators.joint_fit import JointFit


class CurveRow(Record, frozen=True):
    """Results of up to n experiments: medians over draws of the instrument, in the target's unit.

    `classic` is None where the four-point method does not estimate the quantity or n is too small for it, `joint` where
    most instruments see no look.
    """

    experiments: int
    minutes: float
    classic: float | None
    joint: float | None
    assurance: float
    assurance_se: float


class Baseline(Record, frozen=True):
    """A known protocol, or the planned one: medians over drawn instruments of looks in view and of the target.

    `joint` is None where most instruments see no look.
    """

    name: str
    spots: int
    seen: int
    minutes: float
    joint: float | None


class PlanResult(Shown, Record, frozen=True, kw_only=True, rename={"limit": "limited_by", "shares": "variance_shares"}):
    """A plan with its curve and advice.

    Attributes:
        target: target of the plan.
        experiments, looks, minutes: its size; an experiment is four looks.
        now: the target's value before it, at the most probable instrument.
        expected: its median after it over drawn instruments, as in the row of the curve and the first of `baselines`;
            None where most instruments see no look.
        assurance, assurance_se: probability that its fit reports the target as met, and its Monte Carlo error; None
            where the target is met already.
        curve: results by number of experiments.
        n80, n95: experiments for which the assurance is 80 % and 95 %, None if none.
        baselines: the plan and other protocols.
        next: possible next experiments, best first; none before any data.
        stop: the stopping rule applied now.
        classic: the four-point method's own number of experiments, None for quantities that it does not estimate.
        met: the target is met already, or the plan meets it with an assurance of 80 %.
        notes: sentences on excluded looks and the reasons.
        draws, seed, criterion: settings of the computation.
        limit: floor of the target.
        shares: shares of the variance of the target after the plan, by cause.
        steps: the recommended plan, empty where the target is met already; not part of the document.
    """

    target: Target
    experiments: int
    looks: int
    minutes: float
    now: float
    expected: float | None
    assurance: float | None
    assurance_se: float | None
    curve: tuple[CurveRow, ...]
    n80: int | None
    n95: int | None
    baselines: tuple[Baseline, ...]
    next: tuple[Batch, ...]
    stop: Advice
    classic: ClassicAnswer | None
    met: bool
    notes: tuple[str, ...]
    draws: int
    seed: int
    criterion: str
    limit: Limit
    shares: dict[str, float]
    steps: tuple[PlanStep, ...]
    beside: ClassVar = ("steps",)

    def shown(self) -> View:
        """Show the curve by number of looks."""
        size = "met already" if self.assurance is None else f"{self.looks} looks in {self.minutes:.1f} minutes"
        columns = ("looks", "minutes", "classic", "joint", "chance of success")
        rows = [(LOOKS_PER_EXPERIMENT * p.experiments, p.minutes, p.classic, p.joint, p.assurance) for p in self.curve]
        return View(f"PlanResult for {self.target.text}: {size}", columns, rows)


PLAN_DRAWS = 200
BASELINE_DRAWS = 20
"""Drawn instruments at which other protocols are evaluated, move by move."""
IN_VIEW = 0.9
"""Share of the looks of a plan that half of the drawn instruments see at least, without a note."""


def _baselines(
    knowledge: Knowledge, target: Target, aperture: bool, pose_rad: np.ndarray | None, instruments: Instruments
) -> list[Baseline]:
    """Evaluate the paper's protocol, its mixture of step counts and starts, and the grid, on this rig's sheets."""
    sheets = knowledge.sheets
    plans: dict[str, tuple[PlanStep, ...]] = {}
    if len(sheets) > 1:
        pair = sheets[0], sheets[1]
        plans = {"paper": paper_protocol(targets=pair), "mixed": mixed_protocol(targets=pair)}
    plans["grid"] = grid_protocol(targets=sheets[:3])
    places = [
        replace(knowledge, z=z, space=instruments.space_of(row), gears=instrument_gears(knowledge, physical))
        for row, (z, physical) in enumerate(
            zip(instruments.z[:BASELINE_DRAWS], instruments.physical[:BASELINE_DRAWS], strict=True)
        )
    ]
    found = []
    for name, steps in plans.items():
        each = [baseline_of(name, information_of(steps, at, aperture=aperture), at, target, pose_rad) for at in places]
        seen, joint = (float(np.median([getattr(one, key) for one in each])) for key in ("seen", "joint"))
        found.append(structs.replace(each[0], seen=int(seen), joint=joint if math.isfinite(joint) else None))
    return found


def baseline_of(
    name: str, information: PlanInformation, knowledge: Knowledge, target: Target, pose_rad: np.ndarray | None = None
) -> Baseline:
    """Evaluate a plan at one instrument; ratios are at `pose_rad`, by default the plan's, as in a fit.

    The target is infinite where no beam of the instrument reaches the target's point.
    """
    pose = information.pose_rad if pose_rad is None else pose_rad
    try:
        at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose, knowledge.gears)
        value = at.value(covariance_of(knowledge.precision + information.fisher), target.factor)
    except InputError:
        value = math.inf
    in_view = int(information.expectation.seen.sum())
    return Baseline(name, len(information.look_moves), in_view, information.minutes, value)


def plan(
    rig: Rig,
    target: Target,
    *,
    given: JointFit | None = None,
    like: JointFit | None = None,
    minutes: float | None = None,
    criterion: str = "c",
    aperture: bool = False,
    draws: int = PLAN_DRAWS,
    largest: int = LADDER[-1],
    seed: int = 0,
    progress: Show | None = None,
) -> PlanResult:
    """Find the cheapest plan that meets a target, with expected results, or the reason why none can (formulation 6).

    Args:
        rig: sheets, limits, costs; its priors where there is no campaign.
        target: target of the plan.
        given: a fit of earlier data.
        like: a fit of another instrument of the same build, whose play, scatter and place the next one is drawn with.
        minutes: the plan must not take longer.
        criterion: criterion of the search: "c" the target, "D" or "A" ratios and backlashes together.
        aperture: looks also read the aperture.
        draws: number of instruments for the assurance.
        largest: largest number of experiments (of four looks) of a plan.
        seed: seed of the draws.
        progress: receives the progress.

    Returns:
        The plan, its curve and the advice.

    Raises:
        InputError: no sheet to look at, nothing in view, a point out of reach, too few minutes for one experiment.
        NotConverged: `given` or `like` did not converge.
    """
    for known in (given, like):
        if known is not None and not known.converged:
            raise NotConverged.of(known.problems, "see `tvsbayes fit`")
    knowledge = prior_knowledge(rig) if given is None else knowledge_of(given, rig)
    if like is not None:
        knowledge = alike(knowledge, knowledge_of(like, rig))
    campaign, pose = (None, None) if given is None else (given.campaign, given.reference_pose_rad)
    scope = Scope(criterion, aperture, largest, minutes)
    return plan_from(knowledge, target, campaign, pose, scope=scope, draws=draws, seed=seed, progress=progress)


def _curve(
    assurance: Assurance, forecast: ClassicForecast | None, durations: Mapping[int, float], size: _Size, plan: Refined
) -> tuple[CurveRow, ...]:
    """Compute results of up to n experiments, for each size; that of the plan has the plan's own looks.

    Noise scales estimated from few stops make values vary from size to size. A row states the best of all sizes up to
    its own, so that more experiments never appear worse. The best of several estimates has an optimistic bias.
    """
    target, draws = assurance.target, len(assurance.instruments)
    rows, best_value, best_share = [], math.inf, 0.0
    for n in size.sizes:
        reported = plan.reported if n == size.experiments else assurance.values([n])[n]
        best_value = min(best_value, float(np.median(reported)))
        best_share = max(best_share, float(np.mean(reported <= target.limit)))
        classic_value = value_of_classic(forecast, target, n)
        joint = best_value if math.isfinite(best_value) else None
        rows.append(CurveRow(n, durations[n], classic_value, joint, best_share, share_error(best_share, draws)))
    return tuple(rows)


def few_looks(looks: Looks, target: Target) -> list[str]:
    """Write notes on directions with too few stops in a design for reliable intervals.

    Every look of a design is a separate stop.
    """
    notes = []
    sides = {d: looks.side[:, AXES.index(axis)] == sign for d, (axis, sign) in DIRECTION_SIGNS.items()}
    for direction, stops in too_few({d: int(np.sum(reached)) for d, reached in sides.items()}).items():
        reached = f"only {plural(stops, 'stop')} {direction}"
        remedy = "plan u(worst), which asks for every direction"
        if target.quantity == "worst":
            remedy = f"look more often: {FEW_STOPS} stops determine their scatter"
        notes.append(f"{reached}: this plan is for its target only; for reliable intervals of {direction} {remedy}")
    return notes


def design_problem(knowledge: Knowledge, target: Target, pose_rad: np.ndarray | None, aperture: bool) -> DesignProblem:
    """Build the candidates for an instrument, and a target there.

    Raises:
        InputError: nothing to look at or in view; a fixed target.
    """
    possible = candidates(knowledge)
    knowledge = knowledge.with_gears(possible.looks.steps)
    expectation = LookArrays(possible.looks, knowledge, aperture).at(knowledge.z, knowledge.space)
    pose = expectation.mirror_angles_rad.mean(axis=0) if pose_rad is None else pose_rad
    at_centre = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose, knowledge.gears)
    problem = DesignProblem(knowledge, possible, expectation, target, at_centre)
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


def _durations(family: Family, scope: Scope) -> dict[int, float]:
    """Compute minutes by number of experiments, for those that the time allows."""
    durations = {n: family.arranged(n).minutes(family.knowledge.rig) for n in range(1, scope.largest + 1)}
    allowed = {n: minutes for n, minutes in durations.items() if scope.minutes is None or minutes <= scope.minutes}
    if not allowed:
        raise InputError(
            "minutes",
            f"one experiment of four looks takes {durations[1]:.1f} minutes",
            column="--minutes",
            allowed=f"at least {durations[1]:.1f}",
            remedy="allow more minutes, or lower [costs] if the machine is faster",
        )
    return allowed


@dataclass(frozen=True)
class _Size:
    """Number of experiments, the sizes of the curve, and the smallest with an assurance of 80 % and 95 %."""

    sizes: tuple[int, ...]
    n80: int | None
    n95: int | None
    experiments: int


def _size(assurance: Assurance, durations: Mapping[int, float], advance: Advance) -> _Size:
    largest = max(durations)
    sizes = sorted({n for n in LADDER if n <= largest} | {largest})
    assurance.values(sizes, advance)

    def smallest(level: float) -> int | None:
        return smallest_design(lambda n: assurance.met_share(n) >= level, sizes)

    n80, n95 = map(smallest, ASSURED)
    shown = sorted({*sizes, *(n for n in (n80, n95) if n)})
    return _Size(tuple(shown), n80, n95, n95 or n80 or largest)


LOOKING, CHOOSING = "looking from every place", "choosing looks"
COUNTING, EXCHANGING = "counting experiments", "exchanging looks"


def _stages(draws: int) -> dict[str, float]:
    """Return the stages of planning with expected seconds."""
    return {
        LOOKING: 0.1 + looks_wait(),
        CHOOSING: 2.5,
        COUNTING: 2.0 * draws / PLAN_DRAWS,
        EXCHANGING: 3.0,
        JUDGING: judging_seconds(),
    }


def plan_from(
    knowledge: Knowledge,
    target: Target,
    campaign: Campaign | None = None,
    pose_rad: np.ndarray | None = None,
    *,
    scope: Scope,
    draws: int,
    seed: int,
    progress: Show | None = None,
) -> PlanResult:
    """Plan from knowledge; effective ratios are at `pose_rad`, by default in the middle of the candidates."""
    with Job(_stages(draws), progress) as job:
        return _plan_in_stages(knowledge, target, campaign, pose_rad, scope, draws, seed, job)


def _plan_in_stages(
    knowledge: Knowledge,
    target: Target,
    campaign: Campaign | None,
    pose_rad: np.ndarray | None,
    scope: Scope,
    draws: int,
    seed: int,
    job: Job,
) -> PlanResult:
    job.begin(LOOKING)
    problem = design_problem(knowledge, target, pose_rad, scope.aperture)
    knowledge = problem.knowledge
    job.begin(CHOOSING)
    family = design_family(problem, scope, job.at)
    durations = _durations(family, scope)
    job.begin(COUNTING)
    assurance = Assurance(family, target, draw_instruments(knowledge, draws, seed), seed)
    forecast = classic_forecast(knowledge, assurance.instruments)
    size = _size(assurance, durations, job.at)
    job.begin(EXCHANGING)
    refined = refine(family, problem, size.experiments, scope, assurance, job.at)
    job.begin(JUDGING)
    steps = refined.family.arranged(size.experiments).steps
    judgement = judge(steps, knowledge, aperture=scope.aperture)
    curve = _curve(assurance, forecast, durations, size, refined)
    row = next(row for row in curve if row.experiments == size.experiments)
    looks = refined.family.looks(size.experiments)
    in_view = LookArrays(looks, knowledge, scope.aperture).in_images(assurance.instruments.z).sum(axis=1)
    planned = Baseline("planned", len(looks), int(np.median(in_view)), judgement.information.minutes, row.joint)
    largest_information = problem.information(family.picks, family.arranged(family.largest))
    limit = limit_of(knowledge, largest_information, problem.at_centre, target)
    pixel_information = _pixel_part(judgement.information.expectation)
    batches = next_experiments(problem) if knowledge.after_data else ()
    met_already = knowledge.after_data and problem.now <= target.limit
    notes = _notes(planned, looks, target, judgement)
    return PlanResult(
        target=target,
        steps=() if met_already else (replace(steps[0], made_for=target.text), *steps[1:]),
        experiments=0 if met_already else size.experiments,
        looks=0 if met_already else len(refined.family.picks),
        minutes=0.0 if met_already else judgement.information.minutes,
        now=problem.now,
        expected=problem.now if met_already else row.joint,
        assurance=None if met_already else row.assurance,
        assurance_se=None if met_already else row.assurance_se,
        curve=curve,
        n80=size.n80,
        n95=size.n95,
        limit=limit,
        shares=split_of(knowledge, judgement.information.fisher, pixel_information, problem.at_centre),
        baselines=(planned, *_baselines(knowledge, target, scope.aperture, pose_rad, assurance.instruments)),
        next=batches,
        stop=stop_now(problem.now, target, limit, batches, knowledge.after_data),
        classic=classic_answer(target, forecast, campaign),
        met=met_already or row.assurance >= ASSURED[0],
        notes=(*problem.candidates.notes, *([] if met_already else notes)),
        draws=draws,
        seed=seed,
        criterion=scope.criterion,
    )


def _notes(planned: Baseline, looks: Looks, target: Target, judgement: Judgement) -> list[str]:
    """Write notes on what a plan leaves open."""
    notes = few_looks(looks, target)
    if planned.seen < IN_VIEW * len(looks):
        notes.append(
            f"half of the drawn instruments see at most {planned.seen} of the {len(looks)} looks: state in [rig.prior] "
            "and [truth] more closely where the positioner stands (extrinsics), or plan --like a campaign of that build"
        )
    notes += [judgement.inseparable_text(axis) for axis in AXES if inseparable(judgement.exchange(axis))]
    return notes


def _pixel_part(expectation: Expectation) -> np.ndarray:
    """Compute the part of pixel noise alone in the information, (C^-1 J)^T (C^-1 J), shape (p + e, p + e)."""
    spots = LinearSpots(
        residual=np.zeros(expectation.jacobian.shape[:2]),
        load=np.asarray(expectation.load),
        renewed=np.asarray(expectation.keep) == 0,
        variance=np.asarray(expectation.variance),
        jacobian=np.asarray(expectation.jacobian),
        places=np.zeros((*expectation.jacobian.shape[:2], 0)),
    )
    gain = np.concatenate([group.jacobian for group in stop_information(spots).groups])
    return gain.T @ gain

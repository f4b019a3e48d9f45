"""Planning: the cheapest plan that meets a target, its assurance, and the stopping rule.

Values in the target's unit, minutes by the rig's `[costs]`; an experiment is four looks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
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
from tvsbayes.planning.drawn_rigs import Instruments, alike, draw_instruments
from tvsbayes.planning.expectation import (
    Expectation,
    Knowledge,
    PlanInformation,
    information_of,
    knowledge_of,
    prior_knowledge,
)
from tvsbayes.planning.forecast import ClassicAnswer, classic_answer, classic_forecast, value_of_classic
from tvsbayes.planning.limits import Limit, limit_of, next_experiments, split_of, stop_now
from tvsbayes.planning.looks import LookArrays, Looks, looks_wait
from tvsbayes.planning.plan_check import JUDGING, PlanEvaluation, evaluated, evaluation_seconds
from tvsbayes.planning.search import LADDER, DesignProblem, Scope, design_family, refine
from tvsbayes.planning.target import Target, sensitivity
from tvsbayes.progress import Advance, Job, Show
from tvsbayes.results.plan_record import Advice, Batch
from tvsbayes.results.records import Record
from tvsbayes.statistics.chances import ASSURED, share_error
from tvsbayes.statistics.optimal_design import covariance_of, smallest_design

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
LOOKING, CHOOSING = "looking from every place", "choosing looks"
COUNTING, EXCHANGING = "counting experiments", "exchanging looks"


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
    scope = Scope(criterion, aperture, largest, math.inf if minutes is None else minutes)
    return plan_from(knowledge, target, campaign, pose, scope=scope, draws=draws, seed=seed, progress=progress)


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
    counting = {COUNTING: 2.0 * draws / PLAN_DRAWS, EXCHANGING: 3.0, JUDGING: evaluation_seconds()}
    with Job({LOOKING: 0.1 + looks_wait(), CHOOSING: 2.5, **counting}, progress) as job:
        job.begin(LOOKING)
        problem = DesignProblem.of(knowledge, target, pose_rad, scope.aperture)
        knowledge = problem.knowledge
        job.begin(CHOOSING)
        family = design_family(problem, scope, job.at)
        durations = _durations(family, scope)
        job.begin(COUNTING)
        assurance = Assurance(family, target, draw_instruments(knowledge, draws, seed), seed)
        sizes, n80, n95 = _sizes(assurance, durations, job.at)
        experiments = n95 or n80 or max(durations)
        job.begin(EXCHANGING)
        planned, reported = refine(assurance, problem, experiments, scope, job.at)
        job.begin(JUDGING)
        steps = planned.arranged(experiments).steps
        evaluation = evaluated(steps, knowledge, aperture=scope.aperture)
        values = assurance.values(sizes) | {experiments: reported}
        forecast = classic_forecast(knowledge, assurance.instruments)
        curve = _curve(values, target, {n: value_of_classic(forecast, target, n) for n in values}, durations)
        row = next(row for row in curve if row.experiments == experiments)
        information, looks = evaluation.information, planned.looks(experiments)
        in_view = LookArrays(looks, knowledge, scope.aperture).in_images(assurance.instruments.z).sum(axis=1)
        baseline = Baseline("planned", len(looks), int(np.median(in_view)), information.minutes, row.joint)
        of_largest = problem.information(family.picks, family.arranged(family.largest))
        limit = limit_of(knowledge, of_largest, problem.at_centre, target)
        batches = next_experiments(problem) if knowledge.after_data else ()
        result = PlanResult(
            target=target,
            steps=(replace(steps[0], made_for=target.text), *steps[1:]),
            experiments=experiments,
            looks=len(planned.picks),
            minutes=information.minutes,
            now=problem.now,
            expected=row.joint,
            assurance=row.assurance,
            assurance_se=row.assurance_se,
            curve=curve,
            n80=n80,
            n95=n95,
            limit=limit,
            shares=split_of(knowledge, information.fisher, _by_pixels(information.expectation), problem.at_centre),
            baselines=(baseline, *_baselines(knowledge, target, scope.aperture, pose_rad, assurance.instruments)),
            next=batches,
            stop=stop_now(problem.now, target, limit, batches, knowledge.after_data),
            classic=classic_answer(target, forecast, campaign),
            met=row.assurance >= ASSURED[0],
            notes=(*problem.candidates.notes, *_notes(baseline, looks, target, evaluation)),
            draws=draws,
            seed=seed,
            criterion=scope.criterion,
        )
    if not knowledge.after_data or problem.now > target.limit:
        return result
    none = {"steps": (), "experiments": 0, "looks": 0, "minutes": 0.0, "assurance": None, "assurance_se": None}
    return structs.replace(result, **none, expected=problem.now, met=True, notes=problem.candidates.notes)


def _sizes(
    assurance: Assurance, durations: Mapping[int, float], advance: Advance
) -> tuple[list[int], int | None, int | None]:
    """Find the sizes of the curve, and the smallest with an assurance of 80 % and of 95 %."""
    sizes = sorted({n for n in LADDER if n in durations} | {max(durations)})
    assurance.values(sizes, advance)

    def smallest(level: float) -> int | None:
        return smallest_design(lambda n: assurance.met_share(n) >= level, sizes)

    n80, n95 = map(smallest, ASSURED)
    return sorted({*sizes, *(n for n in (n80, n95) if n)}), n80, n95


def _durations(family: Family, scope: Scope) -> dict[int, float]:
    """Compute minutes by number of experiments, for those that the time allows."""
    durations = {n: family.arranged(n).minutes(family.knowledge.rig) for n in range(1, scope.largest + 1)}
    if durations[1] > scope.minutes:
        raise InputError(
            "minutes",
            f"one experiment of four looks takes {durations[1]:.1f} minutes",
            column="--minutes",
            allowed=f"at least {durations[1]:.1f}",
            remedy="allow more minutes, or lower [costs] if the machine is faster",
        )
    return {n: minutes for n, minutes in durations.items() if minutes <= scope.minutes}


def _curve(
    values: Mapping[int, np.ndarray],
    target: Target,
    classic: Mapping[int, float | None],
    durations: Mapping[int, float],
) -> tuple[CurveRow, ...]:
    """Compute results of up to n experiments from the values (draws,) that fits of n experiments report.

    Noise scales estimated from few stops make values vary from size to size. A row states the best of all sizes up to
    its own, so that more experiments never appear worse. The best of several estimates has an optimistic bias.
    """
    rows, best_value, best_share = [], math.inf, 0.0
    for n, reported in values.items():
        best_value = min(best_value, float(np.median(reported)))
        best_share = max(best_share, float(np.mean(reported <= target.limit)))
        joint = best_value if math.isfinite(best_value) else None
        rows.append(CurveRow(n, durations[n], classic[n], joint, best_share, share_error(best_share, len(reported))))
    return tuple(rows)


def _baselines(
    knowledge: Knowledge, target: Target, aperture: bool, pose_rad: np.ndarray | None, instruments: Instruments
) -> list[Baseline]:
    """Evaluate the paper's protocol, its mixture of step counts and starts, and the grid, on this rig's sheets."""
    plans = {"grid": grid_protocol(targets=knowledge.sheets[:3])}
    if len(knowledge.sheets) > 1:
        pair = knowledge.sheets[0], knowledge.sheets[1]
        plans = {"paper": paper_protocol(targets=pair), "mixed": mixed_protocol(targets=pair), **plans}
    physical = instruments.physical[:BASELINE_DRAWS]
    places = [
        replace(knowledge, z=z, space=instruments.space_of(row), gears=instrument_gears(knowledge, values))
        for row, (z, values) in enumerate(zip(instruments.z, physical, strict=False))
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


def _notes(planned: Baseline, looks: Looks, target: Target, evaluation: PlanEvaluation) -> list[str]:
    """Write notes on what a plan leaves open."""
    notes = few_looks(looks, target)
    if planned.seen < IN_VIEW * len(looks):
        notes.append(
            f"half of the drawn instruments see at most {planned.seen} of the {len(looks)} looks: state in [rig.prior] "
            "and [truth] more closely where the positioner stands (extrinsics), or plan --like a campaign of that build"
        )
    return notes + [evaluation.inseparable_text(axis) for axis in AXES if inseparable(evaluation.exchange(axis))]


def few_looks(looks: Looks, target: Target) -> list[str]:
    """Write notes on directions with too few stops in a design for reliable intervals.

    Every look of a design is a separate stop.
    """
    remedy = "plan u(worst), which asks for every direction"
    if target.quantity == "worst":
        remedy = f"look more often: {FEW_STOPS} stops determine their scatter"
    stops = {d: int(np.sum(looks.side[:, AXES.index(axis)] == sign)) for d, (axis, sign) in DIRECTION_SIGNS.items()}
    return [
        f"only {plural(count, 'stop')} {direction}: this plan is for its target only; for reliable intervals "
        f"of {direction} {remedy}"
        for direction, count in too_few(stops).items()
    ]


def _by_pixels(expectation: Expectation) -> np.ndarray:
    """Compute the part of pixel noise alone in the information, (C^-1 J)^T (C^-1 J), shape (p + e, p + e)."""
    looks = LinearSpots(
        residual=np.zeros(expectation.jacobian.shape[:2]),
        load=np.asarray(expectation.load),
        renewed=np.asarray(expectation.keep) == 0,
        variance=np.asarray(expectation.variance),
        jacobian=np.asarray(expectation.jacobian),
        places=np.zeros((*expectation.jacobian.shape[:2], 0)),
    )
    gain = np.concatenate([group.jacobian for group in stop_information(looks).groups])
    return gain.T @ gain

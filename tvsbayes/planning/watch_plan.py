"""`plan --watch`: the fewest looks that notice every stated change, within a budget, and what is out of reach.

Candidates are the looks of the campaign itself: within the limits, in both images, at counters whose gear errors are
known. A pattern of them on every sheet is repeated after further homings, since a homing hides the same part of a
turned positioner from all looks that follow it. Patterns are searched with independent stops, so that information
adds up; what is said of the plan is computed from its own moves. Counters in steps, minutes by `[costs]`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from tvsbayes.comparison.watched_looks import (
    FALSE_ALARM_RATE,
    LOOKS_MIN,
    POWER_MIN,
    Departure,
    WatchedLooks,
    columns_of,
    null_distribution,
    powers,
    rows_of,
)
from tvsbayes.errors import InputError, NotConverged
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import LinearSpots, stop_information
from tvsbayes.estimators.noise_scales import noise_draws
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, Spot, ordered_spots, pixels_of
from tvsbayes.instrument.homing import homed
from tvsbayes.instrument.parameters import INDEX, NAMES
from tvsbayes.instrument.plan import PlanBuilder, PlanStep, plan_seconds, run_plan
from tvsbayes.instrument.rig import COSTS_S, Rig
from tvsbayes.instrument.stereo_pair import triangulate
from tvsbayes.instrument.stops import rests_of
from tvsbayes.model.parameter_space import physical_at
from tvsbayes.planning.candidates import BACKLASH_COLUMNS, run_up_steps
from tvsbayes.planning.expectation import HOME_VARIANCE_RAD2
from tvsbayes.results.watch_record import LOOKS_MAX, PlannedChange, WatchPlan
from tvsbayes.statistics.streams import Stream, random_stream

PATTERN_MAX = 12
"""Looks after one homing at most."""
CANDIDATES_MAX = 32
DIRECTIONS = 24
"""Of a change, over which patterns are judged."""
ENOUGH = 20.0
"""Noncentrality at which a test of three components at 1 % shared by eight has a power of 80 %."""


@dataclass(frozen=True)
class Candidate:
    """A look of the campaign that may be taken again: counters, the sides that they are reached from, its spot."""

    steps: tuple[int, int]
    side: tuple[int, int]
    target: str
    spot: Spot


def _candidates(campaign: Campaign, spots: Sequence[Spot], used: np.ndarray) -> list[Candidate]:
    """One look of every kind; at most `CANDIDATES_MAX` on a sheet, outermost counters first."""
    rests = [rests_of(campaign.moves, axis) for axis in AXES]
    by_place: dict[tuple, Candidate] = {}
    for row, spot in enumerate(spots):
        at = [rests[axis][spot.move] for axis in range(2)]
        side = at[0].sign, at[1].sign
        if used[row] and all(side):
            steps = at[0].steps, at[1].steps
            by_place.setdefault((steps, side, spot.target), Candidate(steps, side, spot.target, spot))
    if not by_place:
        return []
    every = np.array([one.steps for one in by_place.values()], dtype=float)
    middle, width = every.mean(axis=0), np.maximum(np.ptp(every, axis=0), 1.0)
    outer = sorted(by_place.values(), key=lambda one: -float(np.max(np.abs((one.steps - middle) / width))))
    sheets: dict[str, list[Candidate]] = {}
    for one in outer:
        of_sheet = sheets.setdefault(one.target, [])
        if len(of_sheet) < CANDIDATES_MAX:
            of_sheet.append(one)
    return [one for of_sheet in sheets.values() for one in of_sheet]


@dataclass(frozen=True)
class Pattern:
    """Numbers of the candidates that are looked at after a homing, by sheet."""

    looks: dict[str, tuple[int, ...]]

    @property
    def size(self) -> int:
        """Looks of one homing on every sheet."""
        return sum(map(len, self.looks.values()))


def _rig_of(campaign: Campaign, spots: Sequence[Spot], used: np.ndarray) -> Rig:
    """What a campaign says of its rig: sheets where its spots lie, the usual costs."""
    sheets: dict[str, float] = {}
    for name in () if campaign.rig.mechanism.sightings else dict.fromkeys(spot.target for spot in spots):
        of_sheet = [spot for spot, use in zip(spots, used, strict=True) if use and spot.target == name]
        if of_sheet:
            sheets[name] = float(np.median(triangulate(campaign.stereo, pixels_of(of_sheet))[:, 0]))
    return Rig(campaign.rig, campaign.stereo, campaign.rig.priors, sheets, {}, {}, dict(COSTS_S))


class WatchDesigns:
    """Plans for watching a calibration, and what they notice.

    Args:
        fit: converged.
        rig: limits, costs and sheets; None takes the campaign's own counters and the usual costs.
        seed: of the noise scales and of the directions of a change.
    """

    def __init__(self, fit: JointFit, rig: Rig | None, seed: int):
        self.fit, self.seed = fit, seed
        self.campaign = homed(fit.campaign, fit.sides)
        self.z = noise_draws(fit, 2, seed).centre
        spots = ordered_spots(self.campaign)
        used = np.asarray(fit.arrays.spots.valid)[: len(spots)] > 0
        self.rig = _rig_of(self.campaign, spots, used) if rig is None else rig
        every = _candidates(self.campaign, spots, used)
        self.candidates = [one for one in every if self._reachable(one)]
        if not self.candidates:
            raise InputError(
                "no-look",
                "no look of the campaign can be taken again: sides unknown, sheets that the rig does not have, or "
                "run-ups beyond the limits",
                remedy="name the campaign's sheets in [sheets], widen the limits in [positioner], or plan looks with "
                "`plan RIG`",
            )
        # The campaign as its own second day: what its looks show, with the columns of the changes.
        again = WatchedLooks(fit, replace(fit.campaign, spots=tuple(one.spot for one in self.candidates)))
        later = again.problem.spots[again.first :]
        shift = max(spot.spot for spot in spots) + 1
        rows = {spot.spot - shift: again.first + place for place, spot in enumerate(later)}
        self.changes = again.changes
        self._learn(again.linear(self.z), again.first, [rows[one.spot.spot] for one in self.candidates])

    @cached_property
    def _overshoot(self) -> np.ndarray:
        """Run-up (pan, tilt) that takes up the play as the fit found it, steps."""
        physical = physical_at(self.z, self.fit.space).value
        return run_up_steps(physical, physical[BACKLASH_COLUMNS])

    @cached_property
    def _limits(self) -> np.ndarray:
        """Lowest and highest counter of (pan, tilt): the rig's, else those that the campaign reached; (2, 2)."""
        reached = {axis: [getattr(move, f"{axis}_steps") for move in self.campaign.moves] for axis in AXES}
        known = self.rig.limits.within({axis: (min(reach), max(reach)) for axis, reach in reached.items()})
        return np.array([known[axis] for axis in AXES])

    def _reachable(self, one: Candidate) -> bool:
        if one.target not in self.rig.depths_mm:
            return False
        start = np.array(one.steps) - np.array(one.side) * self._overshoot
        both = np.stack([np.array(one.steps), start])
        return bool(np.all((both >= self._limits[:, 0]) & (both <= self._limits[:, 1])))

    def _learn(self, linear: LinearSpots, first: int, places: list[int]) -> None:
        """What the first day knows, and what every candidate (its row) would show, stop errors integrated out."""
        errors = linear.places.shape[2]
        self.parameters = len(NAMES)
        spelled = linear.spelled_out(linear.places)
        shifts = columns_of(self.changes)[-1].stop
        fisher = stop_information(rows_of(spelled, slice(first))).fisher
        keep = np.r_[: self.parameters, self.parameters + shifts : self.parameters + shifts + errors]
        self.known = fisher[np.ix_(keep, keep)] + np.eye(len(keep))
        shown = []
        for one, row in zip(self.candidates, places, strict=True):
            slope = linear.load[row, :, :2]
            variance = self._stop_variance(one)
            columns = spelled.jacobian[row]
            kept = columns[:, keep].copy()
            # The path since homing is short in these plans: the contrast is left to the first day.
            kept[:, [INDEX[f"ratio_contrast_deg_per_step.{axis}"] for axis in AXES]] = 0.0
            whole = np.concatenate([kept, columns[:, self.parameters : self.parameters + shifts], slope], axis=1)
            root = np.linalg.cholesky(np.eye(4) + slope @ np.diag(variance) @ slope.T)
            shown.append(np.linalg.solve(root, whole))
        rows = np.array(shown)
        self.each = np.einsum("mia,mib->mab", rows, rows)
        self.shifts = shifts
        generator = random_stream(self.seed, Stream.WATCHED_CHANGES)
        self._ways = []
        for change in self.changes:
            ways = generator.standard_normal((DIRECTIONS, len(change.names)))
            self._ways.append(change.size * ways / np.linalg.norm(ways, axis=1, keepdims=True))

    def _stop_variance(self, one: Candidate) -> np.ndarray:
        physical = physical_at(self.z, self.fit.space).value
        names = ("left" if one.side[0] > 0 else "right", "up" if one.side[1] > 0 else "down")
        return np.radians([physical[INDEX[f"stop_sd_deg.{name}"]] for name in names]) ** 2

    def information(self, pattern: Pattern, homings: float, also_before: bool = False) -> np.ndarray:
        """Of the changes, after a pattern with so many homings on every sheet, shape (q, q).

        With `also_before` the campaign had as many of them added.
        """
        total = np.zeros((self.each.shape[1] - 2,) * 2)
        for looks in pattern.looks.values():
            block = self.each[list(looks)].sum(axis=0)
            cross, offsets = block[:-2, -2:], block[-2:, -2:] + np.eye(2) / HOME_VARIANCE_RAD2
            total += homings * (block[:-2, :-2] - cross @ np.linalg.solve(offsets, cross.T))
        count = len(self.known)
        coupling, of_parameters = total[:count, count:], total[:count, :count]
        known = self.known + of_parameters * (2 if also_before else 1)
        return total[count:, count:] - coupling.T @ np.linalg.solve(known, coupling)

    def powers(self, pattern: Pattern, homings: float, also_before: bool = False) -> np.ndarray:
        """Of every change, at a limit by Bonferroni's bound."""
        information = self.information(pattern, homings, also_before)
        departure = Departure(0.0, 0, np.zeros(len(information)), information, self.changes)
        return np.array(powers(departure, np.log(FALSE_ALARM_RATE / len(self.changes)), self.seed))

    def _worth(self, pattern: Pattern, homings: float) -> float:
        """What patterns are chosen by: logs of the noncentralities that are too small, over directions and changes."""
        information, total = self.information(pattern, homings), 0.0
        for rows, ways in zip(columns_of(self.changes), self._ways, strict=True):
            shares = np.einsum("ni,ij,nj->n", ways, information[rows, rows], ways) / ENOUGH
            total += float(np.mean(np.minimum(np.log(np.maximum(shares, 1e-12)), 0.0)))
        return total

    def grown(self, sheets: Sequence[str], homings: float) -> list[Pattern]:
        """Patterns of one look on every sheet, two and so on, each the best beside those before it."""
        pattern, patterns = Pattern(dict.fromkeys(sheets, ())), []
        for _ in range(PATTERN_MAX):
            for sheet in sheets:
                numbers = [k for k, one in enumerate(self.candidates) if one.target == sheet]
                tried = [Pattern({**pattern.looks, sheet: (*pattern.looks[sheet], number)}) for number in numbers]
                pattern = max(tried, key=lambda one: self._worth(one, homings))
            patterns.append(pattern)
        return patterns

    def patterns(self) -> list[Pattern]:
        """For every choice of sheets, grown for few homings and for many."""
        names = list(dict.fromkeys(one.target for one in self.candidates))
        choices = [(name,) for name in names] + list(combinations(names, 2))
        grown = [pattern for sheets in choices for homings in (1.0, 8.0) for pattern in self.grown(sheets, homings)]
        return list({tuple(pattern.looks.items()): pattern for pattern in grown}.values())

    def steps(self, pattern: Pattern, homings: int) -> tuple[PlanStep, ...]:
        """The plan: each sheet placed once, on it a homing, the pattern, the next homing."""
        return tuple(step for step, _ in self._ordered(pattern, homings))

    def _ordered(self, pattern: Pattern, homings: int) -> list[tuple[PlanStep, Spot | None]]:
        """Steps with the spot that each look saw in the campaign."""
        plan, counts = PlanBuilder(), {}
        for sheet, looks in pattern.looks.items():
            for homing in range(homings):
                plan.home()
                if not homing:
                    plan.place(sheet)
                for one in (self.candidates[k] for k in looks):
                    start = [
                        goal - side * over if (goal - at) * side < over else at
                        for goal, side, over, at in zip(one.steps, one.side, self._overshoot, plan.at, strict=True)
                    ]
                    plan.move(*map(int, start))
                    plan.move(*one.steps)
                    counts[len(plan.steps)] = one.spot
                    plan.look()
        return [(step, counts.get(step.step)) for step in plan.steps]

    def minutes(self, pattern: Pattern, homings: int) -> float:
        """Duration by `[costs]`."""
        return plan_seconds(self.rig, self.steps(pattern, homings)) / 60

    def judged(self, pattern: Pattern, homings: int) -> list[float]:
        """Powers of the plan by its own moves, at the limit of all tests together."""
        ordered = self._ordered(pattern, homings)
        log = run_plan([step for step, _ in ordered], self.rig)
        shown = [spot for _, spot in ordered if spot is not None]
        spots = tuple(
            spot.renumbered(number, look.move) for number, (spot, look) in enumerate(zip(shown, log.looks, strict=True))
        )
        planned = replace(self.fit.campaign, moves=tuple(log.moves), spots=spots)
        departure = WatchedLooks(self.fit, planned).departure(self.z)
        return powers(departure, null_distribution(departure, self.seed).limit, self.seed)


MINUTES = 10.0
"""Of a plan that nobody limits."""
HOMINGS_MAX = 3000
"""On a sheet, up to which a need is told."""
RUNGS = np.unique(np.geomspace(1, HOMINGS_MAX, 30).round().astype(int))
"""Homings that are tried before the smallest number is sought between two of them."""
CORRECTIONS = 4
"""Times that a plan grows by a tenth where its own moves notice less than independent stops would."""


@dataclass(frozen=True)
class _Tried:
    """A pattern with its powers at `RUNGS`, shape (rungs, changes), and what it takes."""

    pattern: Pattern
    powers: np.ndarray
    first_minutes: float
    minutes_each: float

    def looks(self, homings: int) -> int:
        """On all its sheets."""
        return homings * self.pattern.size

    def minutes(self, homings: int) -> float:
        """Of so many homings on every sheet."""
        return self.first_minutes + (homings - 1) * self.minutes_each

    def allowed(self, minutes: float) -> np.ndarray:
        """Which rungs a budget allows."""
        looks = RUNGS * self.pattern.size
        taken = np.array([self.minutes(int(homings)) for homings in RUNGS])
        return (taken <= minutes) & (looks <= LOOKS_MAX) & (looks >= LOOKS_MIN)


def _tried(designs: WatchDesigns) -> list[_Tried]:
    trials = []
    for pattern in designs.patterns():
        powers = np.array([designs.powers(pattern, float(homings)) for homings in RUNGS])
        once, twice = (designs.minutes(pattern, homings) for homings in (1, 2))
        trials.append(_Tried(pattern, powers, once, twice - once))
    return trials


def _smallest(designs: WatchDesigns, tried: _Tried, wanted: np.ndarray) -> int | None:
    """Homings at which a pattern notices the wanted changes (a mask) often enough."""
    good = np.flatnonzero(np.all(tried.powers[:, wanted] >= POWER_MIN, axis=1))
    if not good.size:
        return None
    rung = int(good[0])
    low, high = (int(RUNGS[rung - 1]) if rung else 0), int(RUNGS[rung])
    while high - low > 1:
        middle = (low + high) // 2
        enough = np.all(designs.powers(tried.pattern, float(middle))[wanted] >= POWER_MIN)
        low, high = (low, middle) if enough else (middle, high)
    return max(high, -(-LOOKS_MIN // tried.pattern.size))


@dataclass(frozen=True)
class _Need:
    """The fewest looks for something."""

    tried: _Tried
    homings: int

    @property
    def looks(self) -> int:
        return self.tried.looks(self.homings)

    @property
    def minutes(self) -> float:
        return self.tried.minutes(self.homings)


def _fewest(designs: WatchDesigns, every: list[_Tried], wanted: np.ndarray, minutes: float = np.inf) -> _Need | None:
    """The fewest looks that notice the wanted changes; of equally many those that take the least time."""
    # By rungs first: what is seen between two of them costs a bisection for every pattern.
    rough = sorted(
        (tried.looks(int(RUNGS[rung])), number)
        for number, tried in enumerate(every)
        if (rung := int(np.argmax(np.all(tried.powers[:, wanted] >= POWER_MIN, axis=1)))) or _at_once(tried, wanted)
    )
    needs = []
    for _, number in rough[:12]:
        homings = _smallest(designs, every[number], wanted)
        if homings is not None and every[number].minutes(homings) <= minutes:
            needs.append(_Need(every[number], homings))
    return min(needs, key=lambda need: (need.looks, need.minutes), default=None)


def _at_once(tried: _Tried, wanted: np.ndarray) -> bool:
    return bool(np.all(tried.powers[0, wanted] >= POWER_MIN))


def _most(every: list[_Tried], minutes: float) -> np.ndarray:
    """The largest set of changes that a plan within the budget notices, as a mask."""
    best, best_key = np.zeros(every[0].powers.shape[1], dtype=bool), (-1, -1.0)
    for tried in every:
        for of_changes in tried.powers[tried.allowed(minutes)]:
            noticed = of_changes >= POWER_MIN
            key = int(noticed.sum()), float(np.sum(of_changes))
            if key > best_key:
                best, best_key = noticed, key
    return best


def _fullest(every: list[_Tried], minutes: float) -> _Need:
    """Where nothing can be noticed often enough: what notices most."""
    by_power = [
        (float(tried.powers[rung].sum()), number, int(RUNGS[rung]))
        for number, tried in enumerate(every)
        for rung in np.flatnonzero(tried.allowed(minutes))
    ]
    _, number, homings = max(by_power)
    return _Need(every[number], homings)


def watch_plan(fit: JointFit, rig: Rig | None = None, *, minutes: float = MINUTES, seed: int = 0) -> WatchPlan:
    """The fewest looks that notice every stated change with a power of 80 %, or as many of them as the time allows.

    Args:
        fit: of the campaign to be watched.
        rig: limits and costs; None takes the counters that the campaign reached, and the usual costs.
        minutes: the plan must not take longer.
        seed: of noise scales, null distribution and directions.

    Raises:
        NotConverged: the fit.
        InputError: no look can be taken again, or the time is too short for the smallest plan.
    """
    if not fit.converged:
        raise NotConverged.of(fit.problems, "see `tvsbayes fit`")
    designs = WatchDesigns(fit, rig, seed)
    every = _tried(designs)
    if not any(tried.allowed(minutes).any() for tried in every):
        least = min(tried.minutes(-(-LOOKS_MIN // tried.pattern.size)) for tried in every)
        raise InputError(
            "minutes",
            f"{LOOKS_MIN} looks take {least:.1f} minutes",
            column="--minutes",
            allowed=f"at least {least:.1f}",
            remedy="allow more minutes, or lower [costs] if the machine is faster",
        )
    wanted = _most(every, minutes)
    need = (_fewest(designs, every, wanted, minutes) if wanted.any() else None) or _fullest(every, minutes)
    homings, judged = _corrected(designs, need, wanted, minutes)
    pattern = need.tried.pattern
    changes = _changes(designs, every, judged)
    return WatchPlan(
        steps=designs.steps(pattern, homings),
        looks=need.tried.looks(homings),
        homings=homings * len(pattern.looks),
        minutes=designs.minutes(pattern, homings),
        minutes_allowed=minutes,
        power_wanted=POWER_MIN,
        false_alarm_rate=FALSE_ALARM_RATE,
        met=all(change.power >= POWER_MIN for change in changes),
        changes=changes,
    )


def _changes(designs: WatchDesigns, every: list[_Tried], judged: list[float]) -> tuple[PlannedChange, ...]:
    """What the plan notices of every change, and what each by itself would take."""
    alone = [_fewest(designs, every, mask) for mask in np.eye(len(designs.changes), dtype=bool)]
    added = _to_add(designs, every) if None in alone else [None] * len(alone)
    changes = []
    for change, power, need, more in zip(designs.changes, judged, alone, added, strict=True):
        description = change.what, change.size, change.unit, power
        if need is None:
            changes.append(PlannedChange(*description, None, None, None, more))
        else:
            homings = need.homings * len(need.tried.pattern.looks)
            changes.append(PlannedChange(*description, need.looks, homings, need.minutes, None))
    return tuple(changes)


def _to_add(designs: WatchDesigns, every: list[_Tried]) -> list[int | None]:
    """Looks that the campaign and every watch must have more before each change is noticed, to the next rung."""
    fewest: list[int | None] = [None] * len(designs.changes)
    for tried in every:
        for homings in RUNGS:
            looks, enough = tried.looks(int(homings)), designs.powers(tried.pattern, float(homings), True) >= POWER_MIN
            fewest = [
                min(looks, best or looks) if good else best for best, good in zip(fewest, enough.tolist(), strict=True)
            ]
            if enough.all():
                break
    return fewest


def _corrected(designs: WatchDesigns, need: _Need, wanted: np.ndarray, minutes: float) -> tuple[int, list[float]]:
    """Homings, and powers by the plan's own moves: more where neighbours that share a stop notice less."""
    homings = need.homings
    judged = designs.judged(need.tried.pattern, homings)
    for _ in range(CORRECTIONS):
        more = homings + -(-homings // 10)
        enough = np.all(np.array(judged)[wanted] >= POWER_MIN)
        if enough or need.tried.minutes(more) > minutes or need.tried.looks(more) > LOOKS_MAX:
            break
        homings, judged = more, designs.judged(need.tried.pattern, more)
    return homings, judged

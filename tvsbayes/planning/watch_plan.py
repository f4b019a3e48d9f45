"""`plan --watch`: the fewest looks that detect every stated change, within a budget, and undetectable changes.

Candidates are the looks of the campaign itself: within the limits, in both images, at counters with known gear errors.
A pattern of them on every sheet is repeated after further homings: the error of a homing masks the same part of a
positioner's rotation in all its looks. The search assumes independent stops, so that information adds up; the final
powers are computed from the plan's own moves. Counters in steps, minutes by `[costs]`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tvsbayes.comparison.departures import (
    FALSE_ALARM_RATE,
    LOOKS_MIN,
    POWER_MIN,
    Departure,
    columns_of,
    null_distribution,
    powers,
)
from tvsbayes.comparison.watched_looks import WatchedLooks, rows_of
from tvsbayes.errors import InputError, NotConverged
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import LinearSpots, stop_information
from tvsbayes.estimators.noise_scales import noise_draws
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, Look, ordered_spots, pixels_of
from tvsbayes.instrument.homing import homed
from tvsbayes.instrument.mechanisms import BACKLASH_COLUMNS, CONTRAST_COLUMNS
from tvsbayes.instrument.plan import PlanBuilder, PlanStep, plan_minutes, run_plan
from tvsbayes.instrument.rig import COSTS_S, Rig
from tvsbayes.instrument.stereo_pair import triangulate
from tvsbayes.instrument.stops import counters_made, rests_of
from tvsbayes.model.parameter_space import physical_at
from tvsbayes.planning.candidates import counter_range, have_room, run_up_steps, sheet_choices
from tvsbayes.planning.expectation import home_variances_rad2
from tvsbayes.planning.looks import run_up_start
from tvsbayes.planning.search import smallest_design
from tvsbayes.results.watch_record import LOOKS_MAX, PlannedChange, WatchPlan
from tvsbayes.statistics.streams import Stream, random_stream

PATTERN_MAX = 12
"""Largest number of looks after one homing."""
CANDIDATES_MAX = 32
CHANGE_DIRECTIONS = 24
"""Number of directions of a change for judging patterns."""
NONCENTRALITY_ENOUGH = 20.0
"""Noncentrality at which a test of three components, at 1 % over eight tests, has a power of 80 %."""


@dataclass(frozen=True)
class Candidate:
    """A look of the campaign that may be repeated: counters, their sides of approach, its spot."""

    steps: tuple[int, int]
    side: tuple[int, int]
    target: str
    spot: Look


def _candidates(campaign: Campaign, spots: Sequence[Look], used: np.ndarray) -> list[Candidate]:
    """List one look of each kind, at most `CANDIDATES_MAX` on a sheet, outermost counters first."""
    rests = [rests_of(campaign.moves, axis) for axis in AXES]
    by_place: dict[tuple, Candidate] = {}
    for row, spot in enumerate(spots):
        rests_here = [rests[axis][spot.move] for axis in range(2)]
        side = rests_here[0].sign, rests_here[1].sign
        if used[row] and all(side):
            steps = rests_here[0].steps, rests_here[1].steps
            by_place.setdefault((steps, side, spot.target), Candidate(steps, side, spot.target, spot))
    if not by_place:
        return []
    all_steps = np.array([candidate.steps for candidate in by_place.values()], dtype=float)
    middle, width = all_steps.mean(axis=0), np.maximum(np.ptp(all_steps, axis=0), 1.0)
    outer = sorted(by_place.values(), key=lambda candidate: -float(np.max(np.abs((candidate.steps - middle) / width))))
    sheets: dict[str, list[Candidate]] = {}
    for candidate in outer:
        sheet_candidates = sheets.setdefault(candidate.target, [])
        if len(sheet_candidates) < CANDIDATES_MAX:
            sheet_candidates.append(candidate)
    return [candidate for sheet_candidates in sheets.values() for candidate in sheet_candidates]


@dataclass(frozen=True)
class Pattern:
    """Numbers of the candidates to look at after a homing, by sheet."""

    looks: dict[str, tuple[int, ...]]

    @property
    def size(self) -> int:
        """Count the looks with one homing on every sheet."""
        return sum(map(len, self.looks.values()))


def _rig_of(campaign: Campaign, spots: Sequence[Look], used: np.ndarray) -> Rig:
    """Build a rig from a campaign: sheets at the depths of its spots, default costs."""
    sheets: dict[str, float] = {}
    for name in dict.fromkeys(spot.target for spot in spots) if campaign.has_images else ():
        sheet_spots = [spot for spot, use in zip(spots, used, strict=True) if use and spot.target == name]
        if sheet_spots:
            sheets[name] = float(np.median(triangulate(campaign.stereo_pair, pixels_of(sheet_spots))[:, 0]))
    return Rig(campaign.rig, campaign.stereo, campaign.rig.priors, sheets, {}, {}, dict(COSTS_S))


class WatchDesigns:
    """Plans for watching a calibration, and their powers.

    Args:
        fit: a converged fit.
        rig: limits, costs and sheets; None: the campaign's own counters and default costs.
        seed: seed of the noise scales and of the directions of a change.
    """

    def __init__(self, fit: JointFit, rig: Rig | None, seed: int):
        self.fit, self.seed = fit, seed
        self.campaign = homed(fit.campaign, fit.sides)
        self.z = noise_draws(fit, 2, seed).centre
        self._home_variances = home_variances_rad2(fit.z, fit.space)
        spots = ordered_spots(self.campaign)
        used = fit.arrays.used
        self.rig = _rig_of(self.campaign, spots, used) if rig is None else rig
        all_candidates = _candidates(self.campaign, spots, used)
        self.candidates = [look for look in all_candidates if self._reachable(look)]
        if not self.candidates:
            raise InputError(
                "no-look",
                "no look of the campaign can be taken again: sides unknown, sheets that the rig does not have, or "
                "run-ups beyond the limits",
                remedy="name the campaign's sheets in [sheets], widen the limits in [positioner], or plan looks with "
                "`plan RIG`",
            )
        # The candidates as new looks of a second session, with the columns of the changes.
        watched = WatchedLooks(fit, replace(fit.campaign, spots=tuple(look.spot for look in self.candidates)))
        new_spots = watched.problem.spots[watched.first :]
        shift = max(spot.spot for spot in spots) + 1
        rows = {spot.spot - shift: watched.first + place for place, spot in enumerate(new_spots)}
        self.changes = watched.changes
        self._prepare(watched.linear(self.z), watched.first, [rows[look.spot.spot] for look in self.candidates])

    @cached_property
    def _run_up(self) -> np.ndarray:
        """Compute the run-up (pan, tilt) that takes up the play by the fit, steps; none of an axis that never moves."""
        physical = physical_at(self.z, self.fit.space).value
        moves = [len({getattr(move, f"{axis}_steps") for move in self.campaign.moves}) > 1 for axis in AXES]
        return np.where(moves, run_up_steps(physical, self.fit.space.mechanism, physical[BACKLASH_COLUMNS]), 0)

    @cached_property
    def _limits(self) -> np.ndarray:
        """Return the lowest and highest counter of (pan, tilt): the rig's, else those of the campaign; (2, 2)."""
        return counter_range(self.rig.limits, counters_made(self.campaign.moves)).limits

    def _reachable(self, candidate: Candidate) -> bool:
        if candidate.target not in self.rig.depths_mm:
            return False
        steps, side = np.array(candidate.steps), np.array(candidate.side)
        return bool(have_room(steps, side, self._limits, self._run_up))

    def _prepare(self, linear: LinearSpots, first: int, places: list[int]) -> None:
        """Compute the information of the first session and of every candidate (its row), stop errors integrated out."""
        spelled = linear.spelled_out(linear.places)
        shifts = slice(len(self.z), len(self.z) + columns_of(self.changes)[-1].stop)
        fisher = stop_information(rows_of(spelled, slice(first))).fisher
        keep = np.r_[: shifts.start, shifts.stop : shifts.stop + linear.places.shape[2]]
        self.known = fisher[np.ix_(keep, keep)] + np.eye(len(keep))
        whitened = []
        for candidate, row in zip(self.candidates, places, strict=True):
            slope = linear.load[row, :, :2]
            variance = self._stop_variance(candidate)
            columns = spelled.jacobian[row]
            fitted = columns[:, keep].copy()
            # The path since homing is short in these plans: only the first session informs on the contrast.
            fitted[:, CONTRAST_COLUMNS] = 0.0
            joined = np.concatenate([fitted, columns[:, shifts], slope], axis=1)
            root = np.linalg.cholesky(np.eye(4) + slope @ np.diag(variance) @ slope.T)
            whitened.append(np.linalg.solve(root, joined))
        rows = np.array(whitened)
        self.each = np.einsum("mia,mib->mab", rows, rows)
        generator = random_stream(self.seed, Stream.WATCHED_CHANGES)
        self._directions = []
        for change in self.changes:
            directions = generator.standard_normal((CHANGE_DIRECTIONS, len(change.names)))
            self._directions.append(change.size * directions / np.linalg.norm(directions, axis=1, keepdims=True))

    def _stop_variance(self, candidate: Candidate) -> np.ndarray:
        physical = physical_at(self.z, self.fit.space).value
        stops = self.fit.space.mechanism.stop_columns
        columns = [stops[axis, int(side > 0)] for axis, side in enumerate(candidate.side)]
        return np.radians([physical[column] for column in columns]) ** 2

    def information(self, pattern: Pattern, homings: float, also_before: bool = False) -> np.ndarray:
        """Compute the information on the changes by a pattern with so many homings on every sheet, shape (q, q).

        With `also_before` the same looks are added to the campaign too.
        """
        total = np.zeros((self.each.shape[1] - 2,) * 2)
        for looks in pattern.looks.values():
            block = self.each[list(looks)].sum(axis=0)
            cross, offsets = block[:-2, -2:], block[-2:, -2:] + np.diag(1 / self._home_variances)
            total += homings * (block[:-2, :-2] - cross @ np.linalg.solve(offsets, cross.T))
        count = len(self.known)
        coupling, of_parameters = total[:count, count:], total[:count, :count]
        known = self.known + of_parameters * (2 if also_before else 1)
        return total[count:, count:] - coupling.T @ np.linalg.solve(known, coupling)

    def powers(self, pattern: Pattern, homings: float, also_before: bool = False) -> np.ndarray:
        """Compute the power for every change, at a limit by Bonferroni's bound."""
        information = self.information(pattern, homings, also_before)
        departure = Departure(0.0, 0, np.zeros(len(information)), information, self.changes)
        return np.array(powers(departure, np.log(FALSE_ALARM_RATE / len(self.changes)), self.seed))

    def _score(self, pattern: Pattern, homings: float) -> float:
        """Score a pattern: mean logs of insufficient noncentralities, over directions and changes."""
        information, total = self.information(pattern, homings), 0.0
        for rows, directions in zip(columns_of(self.changes), self._directions, strict=True):
            shares = np.einsum("ni,ij,nj->n", directions, information[rows, rows], directions) / NONCENTRALITY_ENOUGH
            total += float(np.mean(np.minimum(np.log(np.maximum(shares, 1e-12)), 0.0)))
        return total

    def grown(self, sheets: Sequence[str], homings: float) -> list[Pattern]:
        """Grow patterns of one look on every sheet, two and so on, by the best addition to the previous looks."""
        pattern, patterns = Pattern(dict.fromkeys(sheets, ())), []
        for _ in range(PATTERN_MAX):
            for sheet in sheets:
                numbers = [k for k, candidate in enumerate(self.candidates) if candidate.target == sheet]
                extensions = [Pattern({**pattern.looks, sheet: (*pattern.looks[sheet], number)}) for number in numbers]
                pattern = max(extensions, key=lambda candidate: self._score(candidate, homings))
            patterns.append(pattern)
        return patterns

    def patterns(self) -> list[Pattern]:
        """Build patterns for every choice of sheets, grown for few homings and for many."""
        names = list(dict.fromkeys(candidate.target for candidate in self.candidates))
        scopes = [(sheets, homings) for sheets in sheet_choices(names, 2) for homings in (1.0, 8.0)]
        grown = [pattern for sheets, homings in scopes for pattern in self.grown(sheets, homings)]
        return list({tuple(pattern.looks.items()): pattern for pattern in grown}.values())

    def steps(self, pattern: Pattern, homings: int) -> tuple[PlanStep, ...]:
        """Build the plan: each sheet placed once, with the pattern after every homing."""
        return tuple(step for step, _ in self._ordered(pattern, homings))

    def _ordered(self, pattern: Pattern, homings: int) -> list[tuple[PlanStep, Look | None]]:
        """Build the steps with the campaign's spot of each look."""
        plan, counts = PlanBuilder(), {}
        for sheet, looks in pattern.looks.items():
            for homing in range(homings):
                plan.home()
                if not homing:
                    plan.place(sheet)
                for look in (self.candidates[k] for k in looks):
                    goal, side, at = map(np.array, (look.steps, look.side, plan.at))
                    plan.move(*map(int, run_up_start(goal, side, at, self._run_up)))
                    plan.move(*look.steps)
                    counts[len(plan.steps)] = look.spot
                    plan.look()
        return [(step, counts.get(step.step)) for step in plan.steps]

    def minutes(self, pattern: Pattern, homings: int) -> float:
        """Compute the duration by `[costs]`, minutes."""
        return plan_minutes(self.rig, self.steps(pattern, homings))

    def judged(self, pattern: Pattern, homings: int) -> list[float]:
        """Compute powers of the plan by its own moves, at the limit of all tests together."""
        ordered = self._ordered(pattern, homings)
        log = run_plan([step for step, _ in ordered], self.rig)
        seen = [spot for _, spot in ordered if spot is not None]
        spots = tuple(
            spot.renumbered(number, look.move) for number, (spot, look) in enumerate(zip(seen, log.looks, strict=True))
        )
        planned = replace(self.fit.campaign, moves=tuple(log.moves), spots=spots)
        departure = WatchedLooks(self.fit, planned).departure(self.z)
        return powers(departure, null_distribution(departure, self.seed).limit, self.seed)


MINUTES = 10.0
"""Default limit of the duration of a plan, minutes."""
HOMINGS_MAX = 3000
"""Largest number of homings on a sheet that is stated as needed."""
HOMING_COUNTS: tuple[int, ...] = tuple(np.unique(np.geomspace(1, HOMINGS_MAX, 30).round().astype(int)).tolist())
"""Trial numbers of homings, before bisection between two of them."""
BISECTED_MAX = 12
"""Largest number of patterns for which the fewest homings are found."""
CORRECTIONS = 4
"""Largest number of increases by a tenth where the plan's own moves have less power than independent stops."""


@dataclass(frozen=True)
class _Trial:
    """A pattern with its powers at `HOMING_COUNTS`, shape (counts, changes), and its duration."""

    designs: WatchDesigns
    pattern: Pattern
    powers: np.ndarray
    first_minutes: float
    minutes_each: float

    def looks(self, homings: int) -> int:
        """Count the looks on all its sheets."""
        return homings * self.pattern.size

    def minutes(self, homings: int) -> float:
        """Compute the duration with so many homings on every sheet, minutes."""
        return self.first_minutes + (homings - 1) * self.minutes_each

    def allowed(self, minutes: float) -> np.ndarray:
        """Mark the `HOMING_COUNTS` within a budget."""
        return np.array([self.minutes(n) <= minutes and LOOKS_MIN <= self.looks(n) <= LOOKS_MAX for n in HOMING_COUNTS])

    def first_need(self, mask: np.ndarray) -> _Need | None:
        """Find the first of `HOMING_COUNTS` with enough power for the changes of a mask."""
        enough = np.all(self.powers[:, mask] >= POWER_MIN, axis=1)
        return _Need(self, HOMING_COUNTS[int(np.argmax(enough))]) if enough.any() else None


def _trials(designs: WatchDesigns) -> list[_Trial]:
    trials = []
    for pattern in designs.patterns():
        powers = np.array([designs.powers(pattern, homings) for homings in HOMING_COUNTS])
        once, twice = (designs.minutes(pattern, homings) for homings in (1, 2))
        trials.append(_Trial(designs, pattern, powers, once, twice - once))
    return trials


@dataclass(frozen=True)
class _Need:
    """A pattern with a number of homings on every sheet."""

    trial: _Trial
    homings: int

    @property
    def looks(self) -> int:
        return self.trial.looks(self.homings)

    @property
    def all_homings(self) -> int:
        return self.homings * len(self.trial.pattern.looks)

    @property
    def minutes(self) -> float:
        return self.trial.minutes(self.homings)

    @cached_property
    def judged(self) -> list[float]:
        """Compute powers by the plan's own moves."""
        return self.trial.designs.judged(self.trial.pattern, self.homings)

    def fewest(self, mask: np.ndarray) -> _Need:
        """Find the fewest homings that are enough for the changes of a mask, as the first of the trial counts is."""

        def enough(homings: int) -> bool:
            return bool(np.all(self.trial.designs.powers(self.trial.pattern, homings)[mask] >= POWER_MIN))

        homings = smallest_design(enough, [n for n in HOMING_COUNTS if n <= self.homings][-2:])
        assert homings is not None, "the first sufficient count is enough"
        return replace(self, homings=max(homings, -(-LOOKS_MIN // self.trial.pattern.size)))


def _fewest(trials: list[_Trial], mask: np.ndarray, minutes: float = np.inf) -> _Need | None:
    """Find the fewest looks that detect the changes of a mask; among equal numbers the least time."""
    # Patterns are first ranked by trial counts: values in between cost a bisection for each.
    first_needs = [need for trial in trials if (need := trial.first_need(mask)) is not None]
    needs = [need.fewest(mask) for need in sorted(first_needs, key=lambda need: need.looks)[:BISECTED_MAX]]
    within = (need for need in needs if need.minutes <= minutes)
    return min(within, key=lambda need: (need.looks, need.minutes), default=None)


def _noticeable(trials: list[_Trial], minutes: float) -> np.ndarray:
    """Find the largest set of changes that a plan within the budget detects, as a mask."""
    rows = [row for trial in trials for row in trial.powers[trial.allowed(minutes)]]
    return np.asarray(max(rows, key=lambda row: (np.sum(row >= POWER_MIN), np.sum(row))) >= POWER_MIN)


def _most_powerful(trials: list[_Trial], minutes: float) -> _Need:
    """Find the pattern with the largest total power, where no change can be detected with enough power."""
    by_power = [
        (float(trial.powers[rung].sum()), number, HOMING_COUNTS[rung])
        for number, trial in enumerate(trials)
        for rung in np.flatnonzero(trial.allowed(minutes))
    ]
    _, number, homings = max(by_power)
    return _Need(trials[number], homings)


def watch_plan(fit: JointFit, rig: Rig | None = None, *, minutes: float = MINUTES, seed: int = 0) -> WatchPlan:
    """Plan the fewest looks that detect every stated change with a power of 80 %, or as many as the time allows.

    Args:
        fit: fit of the campaign to be watched.
        rig: limits and costs; None: the counters of the campaign, and default costs.
        minutes: the plan must not take longer.
        seed: seed of noise scales, null distribution and directions.

    Raises:
        NotConverged: the fit.
        InputError: no look can be repeated, or the time is too short for the smallest plan.
    """
    if not fit.converged:
        raise NotConverged.of(fit.problems, "see `tvsbayes fit`")
    designs = WatchDesigns(fit, rig, seed)
    trials = _trials(designs)
    if not any(trial.allowed(minutes).any() for trial in trials):
        least_minutes = min(trial.minutes(-(-LOOKS_MIN // trial.pattern.size)) for trial in trials)
        raise InputError(
            "minutes",
            f"{LOOKS_MIN} looks take {least_minutes:.1f} minutes",
            column="--minutes",
            allowed=f"at least {least_minutes:.1f}",
            remedy="allow more minutes, or lower [costs] if the machine is faster",
        )
    noticed = _noticeable(trials, minutes)
    need = (_fewest(trials, noticed, minutes) if noticed.any() else None) or _most_powerful(trials, minutes)
    need = _corrected(need, noticed, minutes)
    changes = _changes(need, trials)
    return WatchPlan(
        steps=designs.steps(need.trial.pattern, need.homings),
        looks=need.looks,
        homings=need.all_homings,
        minutes=designs.minutes(need.trial.pattern, need.homings),
        minutes_allowed=minutes,
        power_wanted=POWER_MIN,
        false_alarm_rate=FALSE_ALARM_RATE,
        met=all(change.power >= POWER_MIN for change in changes),
        changes=changes,
        home_sd_by_prior=fit.home_sd_by_prior,
    )


def _changes(plan: _Need, trials: list[_Trial]) -> tuple[PlannedChange, ...]:
    """Describe every change by the plan's power for it and the looks needed for it alone."""
    tested = plan.trial.designs.changes
    needs = [_fewest(trials, mask) for mask in np.eye(len(tested), dtype=bool)]
    additions = _looks_to_add(trials) if None in needs else [None] * len(needs)
    changes = []
    for change, power, need, looks_to_add in zip(tested, plan.judged, needs, additions, strict=True):
        sizes = (None, None, None, looks_to_add) if need is None else (need.looks, need.all_homings, need.minutes, None)
        changes.append(PlannedChange(change.what, change.size, change.unit, power, *sizes))
    return tuple(changes)


def _looks_to_add(trials: list[_Trial]) -> list[int | None]:
    """Compute additional looks of the campaign and of every watch to detect each change, to the next trial count."""
    fewest: list[int | None] = [None] * trials[0].powers.shape[1]
    for trial in trials:
        for homings in HOMING_COUNTS:
            looks, enough = trial.looks(homings), trial.designs.powers(trial.pattern, homings, True) >= POWER_MIN
            fewest = [
                min(looks, best or looks) if met else best for best, met in zip(fewest, enough.tolist(), strict=True)
            ]
            if enough.all():
                break
    return fewest


def _corrected(need: _Need, noticed: np.ndarray, minutes: float) -> _Need:
    """Add homings where shared stops reduce the power for the changes of a mask."""
    for _ in range(CORRECTIONS):
        more = replace(need, homings=need.homings + -(-need.homings // 10))
        enough = np.all(np.array(need.judged)[noticed] >= POWER_MIN)
        if enough or more.minutes > minutes or more.looks > LOOKS_MAX:
            break
        need = more
    return need

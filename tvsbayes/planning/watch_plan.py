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
from scipy import linalg

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
from tvsbayes.results.watch_record import LOOKS_MAX, PlannedChange, WatchPlan
from tvsbayes.statistics.optimal_design import Prospects, covariance_of, smallest_design
from tvsbayes.statistics.streams import Stream, random_stream

PATTERN_MAX = 12
"""Largest number of looks after one homing."""
CANDIDATES_MAX = 32
CHANGE_DIRECTIONS = 24
"""Number of directions of a change for judging patterns."""
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
NONCENTRALITY_ENOUGH = 20.0
"""Noncentrality at which a test of three components, at 1 % over eight tests, has a power of 80 %."""


type Pattern = dict[str, tuple[int, ...]]
"""Numbers of the candidates to look at after a homing, by sheet."""


@dataclass(frozen=True)
class Candidate:
    """A look of the campaign that may be repeated: counters, their sides of approach, its spot."""

    steps: tuple[int, int]
    side: tuple[int, int]
    spot: Look


def _candidates(campaign: Campaign, spots: Sequence[Look], used: np.ndarray) -> list[Candidate]:
    """List one look of each kind, at most `CANDIDATES_MAX` on a sheet, outermost counters first."""
    by_move = list(zip(*(rests_of(campaign.moves, axis) for axis in AXES), strict=True))
    kinds: dict[tuple, Candidate] = {}
    for spot in (spot for spot, use in zip(spots, used, strict=True) if use):
        pan, tilt = by_move[spot.move]
        if pan.sign and tilt.sign:
            look = Candidate((pan.steps, tilt.steps), (pan.sign, tilt.sign), spot)
            kinds.setdefault((look.steps, look.side, spot.target), look)
    if not kinds:
        return []
    steps = np.array([look.steps for look in kinds.values()], dtype=float)
    distance = np.max(np.abs((steps - steps.mean(axis=0)) / np.maximum(np.ptp(steps, axis=0), 1.0)), axis=1)
    sheets: dict[str, list[Candidate]] = {}
    for _, look in sorted(zip(-distance, kinds.values(), strict=True), key=lambda pair: pair[0]):
        sheets.setdefault(look.spot.target, []).append(look)
    return [look for looks in sheets.values() for look in looks[:CANDIDATES_MAX]]


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
        spots, used = ordered_spots(self.campaign), fit.arrays.used
        self.rig = _rig_of(self.campaign, spots, used) if rig is None else rig
        self.candidates = [look for look in _candidates(self.campaign, spots, used) if self._reachable(look)]
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
        return counter_range(self.rig.limits, counters_made(self.campaign.moves))[0]

    def _reachable(self, look: Candidate) -> bool:
        if look.spot.target not in self.rig.depths_mm:
            return False
        return bool(have_room(np.array(look.steps), np.array(look.side), self._limits, self._run_up))

    def _prepare(self, linear: LinearSpots, first: int, places: list[int]) -> None:
        """Compute the information of the first session, and whitened rows of every candidate (its row of `linear`).

        Columns are what was fitted, then the changes, then the two offsets of a homing; stop errors are integrated out.
        """
        spelled = linear.spelled_out(linear.places)
        shifts = slice(len(self.z), len(self.z) + columns_of(self.changes)[-1].stop)
        fisher = stop_information(rows_of(spelled, slice(first))).fisher
        keep = np.r_[: shifts.start, shifts.stop : shifts.stop + linear.places.shape[2]]
        self.known = fisher[np.ix_(keep, keep)] + np.eye(len(keep))
        columns, slope = spelled.jacobian[places], linear.load[places, :, :2]
        fitted = columns[..., keep]
        # The path since homing is short in these plans: only the first session informs on the contrast.
        fitted[..., CONTRAST_COLUMNS] = 0.0
        sides = (np.array([look.side for look in self.candidates]) > 0).astype(int)
        stops = self.fit.space.mechanism.stop_columns
        stop_sd = np.radians(np.asarray(physical_at(self.z, self.fit.space).value)[stops[[0, 1], sides]])
        root = np.linalg.cholesky(np.eye(4) + (slope * stop_sd[:, None] ** 2) @ slope.swapaxes(1, 2))
        self._rows = np.linalg.solve(root, np.concatenate([fitted, columns[..., shifts], slope], axis=2))
        self._each = self._rows.swapaxes(1, 2) @ self._rows
        generator = random_stream(self.seed, Stream.WATCHED_CHANGES)
        self._directions = []
        for change in self.changes:
            directions = generator.standard_normal((CHANGE_DIRECTIONS, len(change.names)))
            self._directions.append(change.size * directions / np.linalg.norm(directions, axis=1, keepdims=True))

    def information(self, pattern: Pattern, homings: float, also_before: bool = False) -> np.ndarray:
        """Compute the information on the changes by a pattern with so many homings on every sheet, shape (q, q).

        With `also_before` the same looks are added to the campaign too.
        """
        total = np.zeros((self._each.shape[1] - 2,) * 2)
        for looks in pattern.values():
            block = self._each[list(looks)].sum(axis=0)
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

    def _scores(self, information: np.ndarray) -> np.ndarray:
        """Score informations (m, q, q): mean logs of insufficient noncentralities over directions of changes, (m,)."""
        total = np.zeros(len(information))
        for rows, directions in zip(columns_of(self.changes), self._directions, strict=True):
            shares = np.einsum("ni,mij,nj->mn", directions, information[:, rows, rows], directions, optimize=True)
            total += np.mean(np.minimum(np.log(np.maximum(shares / NONCENTRALITY_ENOUGH, 1e-12)), 0.0), axis=1)
        return total

    def grown(self, sheets: Sequence[str], homings: float) -> list[Pattern]:
        """Grow patterns of one look on every sheet, two and so on, by the best addition to the previous looks.

        So many homings on a sheet are one, of looks whose noise is smaller by their root, as are the offsets.
        """
        count, on = len(self.known), np.array([look.spot.target for look in self.candidates])
        fitted, shifts, slope = np.split(np.sqrt(homings) * self._rows, [count, self._rows.shape[2] - 2], axis=2)
        rows = np.concatenate([fitted, *(np.where(on == sheet, slope.T, 0.0).T for sheet in sheets)], axis=2)
        offsets = np.diag(np.tile(self._home_variances / homings, len(sheets)))
        prospects = Prospects.of_shifts(rows, linalg.block_diag(covariance_of(self.known), offsets), shifts)
        pattern: Pattern = {}
        patterns, information = list[Pattern](), np.zeros((shifts.shape[2],) * 2)
        for _ in range(PATTERN_MAX):
            for sheet in sheets:
                after = information + prospects.gains()
                best = int(np.argmax(np.where(on == sheet, self._scores(after), -np.inf)))
                pattern = {**pattern, sheet: (*pattern.get(sheet, ()), best)}
                prospects, information = prospects.measured(best), after[best]
            patterns.append(pattern)
        return patterns

    @cached_property
    def patterns(self) -> list[Pattern]:
        """Build patterns for every choice of sheets, grown for few homings and for many."""
        names = list(dict.fromkeys(look.spot.target for look in self.candidates))
        scopes = [(sheets, homings) for sheets in sheet_choices(names, 2) for homings in (1.0, 8.0)]
        grown = [pattern for sheets, homings in scopes for pattern in self.grown(sheets, homings)]
        return list({tuple(pattern.items()): pattern for pattern in grown}.values())

    def steps(self, pattern: Pattern, homings: int) -> tuple[PlanStep, ...]:
        """Build the plan: each sheet placed once, with the pattern after every homing."""
        plan = PlanBuilder()
        for sheet, looks in pattern.items():
            for homing in range(homings):
                plan.home()
                if not homing:
                    plan.place(sheet)
                for look in (self.candidates[k] for k in looks):
                    goal, side, at = map(np.array, (look.steps, look.side, plan.at))
                    plan.move(*map(int, run_up_start(goal, side, at, self._run_up)))
                    plan.move(*look.steps)
                    plan.look()
        return tuple(plan.steps)

    def minutes(self, pattern: Pattern, homings: int) -> float:
        """Compute the duration by `[costs]`, minutes."""
        return plan_minutes(self.rig, self.steps(pattern, homings))

    def own_powers(self, pattern: Pattern, homings: int) -> list[float]:
        """Compute powers of the plan by its own moves, at the limit of all tests together."""
        log = run_plan(self.steps(pattern, homings), self.rig)
        taken = [self.candidates[k].spot for looks in pattern.values() for k in looks * homings]
        spots = tuple(
            spot.renumbered(number, look.move) for number, (spot, look) in enumerate(zip(taken, log.looks, strict=True))
        )
        planned = replace(self.fit.campaign, moves=tuple(log.moves), spots=spots)
        departure = WatchedLooks(self.fit, planned).departure(self.z)
        return powers(departure, null_distribution(departure, self.seed).limit, self.seed)


class _Trials:
    """Every pattern t with every of `HOMING_COUNTS`: powers (t, counts, changes), looks and minutes (t, counts)."""

    def __init__(self, designs: WatchDesigns):
        self.designs, self.sizes = designs, [sum(map(len, pattern.values())) for pattern in designs.patterns]
        self.powers = np.array([[designs.powers(each, n) for n in HOMING_COUNTS] for each in designs.patterns])
        once, twice = (np.array([designs.minutes(each, n) for each in designs.patterns]) for n in (1, 2))
        self._first, self._further = once, twice - once
        self.looks = np.outer(self.sizes, HOMING_COUNTS)
        self.minutes = once[:, None] + np.outer(self._further, np.array(HOMING_COUNTS) - 1)

    def minutes_of(self, trial: int, homings: int) -> float:
        """Compute the duration of a pattern with so many homings on every sheet, minutes."""
        return float(self._first[trial] + (homings - 1) * self._further[trial])

    def allowed(self, minutes: float) -> np.ndarray:
        """Mark what a budget and the numbers of looks allow, shape (t, counts)."""
        return (self.minutes <= minutes) & (self.looks >= LOOKS_MIN) & (self.looks <= LOOKS_MAX)

    def noticeable(self, minutes: float) -> np.ndarray:
        """Find the largest set of changes that a plan within the budget detects, as a mask."""
        rows = self.powers[self.allowed(minutes)]
        best = max(rows, key=lambda row: (np.sum(row >= POWER_MIN), np.sum(row)))
        return np.asarray(best >= POWER_MIN)

    def most_powerful(self, minutes: float) -> tuple[int, int]:
        """Find the pattern and its homings with the largest total power."""
        total, allowed = self.powers.sum(axis=2), np.argwhere(self.allowed(minutes)).tolist()
        _, trial, homings = max((float(total[t, n]), t, HOMING_COUNTS[n]) for t, n in allowed)
        return trial, homings

    def fewest(self, mask: np.ndarray, minutes: float = np.inf) -> tuple[int, int] | None:
        """Find pattern and homings of the fewest looks that detect the changes of a mask; of equals the quickest."""
        enough = np.all(self.powers[..., mask] >= POWER_MIN, axis=2)
        first = [(int(np.argmax(row)), trial) for trial, row in enumerate(enough) if row.any()]
        found = []
        # Patterns are first ranked by trial counts: values in between cost a bisection for each.
        for count, trial in sorted(first, key=lambda one: self.looks[one[1], one[0]])[:BISECTED_MAX]:
            pattern, bracket = self.designs.patterns[trial], HOMING_COUNTS[max(count - 1, 0) : count + 1]

            def detects(homings: int, pattern: Pattern = pattern) -> bool:
                return bool(np.all(self.designs.powers(pattern, homings)[mask] >= POWER_MIN))

            homings = smallest_design(detects, bracket)
            assert homings is not None, "the first sufficient count is enough"
            homings = max(homings, -(-LOOKS_MIN // self.sizes[trial]))
            if self.minutes_of(trial, homings) <= minutes:
                found.append((homings * self.sizes[trial], self.minutes_of(trial, homings), trial, homings))
        return min(found, key=lambda one: one[:2])[2:] if found else None

    def looks_to_add(self) -> list[int | None]:
        """Compute looks that campaign and every watch have to add to detect each change, to the next trial count."""
        fewest: list[int | None] = [None] * self.powers.shape[2]
        for pattern, sizes in zip(self.designs.patterns, self.looks.tolist(), strict=True):
            for homings, looks in zip(HOMING_COUNTS, sizes, strict=True):
                enough = self.designs.powers(pattern, homings, True) >= POWER_MIN
                pairs = zip(fewest, enough.tolist(), strict=True)
                fewest = [min(looks, best or looks) if met else best for best, met in pairs]
                if enough.all():
                    break
        return fewest


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
    trials = _Trials(designs)
    if not trials.allowed(minutes).any():
        least_minutes = min(trials.minutes_of(trial, -(-LOOKS_MIN // n)) for trial, n in enumerate(trials.sizes))
        raise InputError(
            "minutes",
            f"{LOOKS_MIN} looks take {least_minutes:.1f} minutes",
            column="--minutes",
            allowed=f"at least {least_minutes:.1f}",
            remedy="allow more minutes, or lower [costs] if the machine is faster",
        )
    noticed = trials.noticeable(minutes)
    found = trials.fewest(noticed, minutes) if noticed.any() else None
    trial, homings = found or trials.most_powerful(minutes)
    pattern, size = designs.patterns[trial], trials.sizes[trial]
    own = designs.own_powers(pattern, homings)
    for _ in range(CORRECTIONS):
        # Shared stops may reduce the power.
        more = homings + -(-homings // 10)
        if np.all(np.array(own)[noticed] >= POWER_MIN) or trials.minutes_of(trial, more) > minutes:
            break
        if size * more > LOOKS_MAX:
            break
        homings, own = more, designs.own_powers(pattern, more)
    needs = [trials.fewest(alone) for alone in np.eye(len(designs.changes), dtype=bool)]
    to_add = trials.looks_to_add() if None in needs else [None] * len(needs)
    changes = []
    for change, power, need, looks_to_add in zip(designs.changes, own, needs, to_add, strict=True):
        what = change.what, change.size, change.unit, power
        if need is None:
            changes.append(PlannedChange(*what, None, None, None, looks_to_add))
            continue
        sheets, looks = len(designs.patterns[need[0]]), trials.sizes[need[0]]
        changes.append(PlannedChange(*what, looks * need[1], sheets * need[1], trials.minutes_of(*need), None))
    return WatchPlan(
        steps=designs.steps(pattern, homings),
        looks=size * homings,
        homings=homings * len(pattern),
        minutes=designs.minutes(pattern, homings),
        minutes_allowed=minutes,
        power_wanted=POWER_MIN,
        false_alarm_rate=FALSE_ALARM_RATE,
        met=all(change.power >= POWER_MIN for change in changes),
        changes=tuple(changes),
        home_sd_by_prior=fit.home_sd_by_prior,
    )

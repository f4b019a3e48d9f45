"""`plan --watch`: the fewest looks that notice every stated change, within a budget, and what is out of reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.comparison.watched_looks import FALSE_ALARM_RATE, LOOKS_MIN, POWER_MIN
from tvsbayes.errors import InputError, NotConverged
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.rig import Rig
from tvsbayes.planning.watch_design import Pattern, WatchDesigns
from tvsbayes.results.watch_record import LOOKS_MAX, PlannedChange, WatchPlan

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
    found = []
    for pattern in designs.patterns():
        powers = np.array([designs.powers(pattern, float(homings)) for homings in RUNGS])
        once, twice = (designs.minutes(pattern, homings) for homings in (1, 2))
        found.append(_Tried(pattern, powers, once, twice - once))
    return found


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
        for powers in tried.powers[tried.allowed(minutes)]:
            seen = powers >= POWER_MIN
            key = int(seen.sum()), float(np.sum(powers))
            if key > best_key:
                best, best_key = seen, key
    return best


def _fullest(every: list[_Tried], minutes: float) -> _Need:
    """Where nothing can be noticed often enough: what notices most."""
    found = [
        (float(tried.powers[rung].sum()), number, int(RUNGS[rung]))
        for number, tried in enumerate(every)
        for rung in np.flatnonzero(tried.allowed(minutes))
    ]
    _, number, homings = max(found)
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
    found = []
    for change, power, need, more in zip(designs.changes, judged, alone, added, strict=True):
        told = change.what, change.size, change.unit, power
        if need is None:
            found.append(PlannedChange(*told, None, None, None, more))
        else:
            homings = need.homings * len(need.tried.pattern.looks)
            found.append(PlannedChange(*told, need.looks, homings, need.minutes, None))
    return tuple(found)


def _to_add(designs: WatchDesigns, every: list[_Tried]) -> list[int | None]:
    """Looks that the campaign and every watch must have more before each change is noticed, to the next rung."""
    fewest: list[int | None] = [None] * len(designs.changes)
    for tried in every:
        for homings in RUNGS:
            looks, seen = tried.looks(int(homings)), designs.powers(tried.pattern, float(homings), True) >= POWER_MIN
            fewest = [
                min(looks, best or looks) if good else best for best, good in zip(fewest, seen.tolist(), strict=True)
            ]
            if seen.all():
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

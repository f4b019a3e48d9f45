"""Does a calibration still hold for new data? Tests of stated changes, of any instrument.

An adapter gives residuals of the new data from their prediction as score and information of the shifts of some
parameters (formulation 9); a change is such a shift for the new data alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tvsbayes.results.watch_record import CANNOT_TELL, MOVED, OK, MovedPart, SeenChange, Verdict, Watch
from tvsbayes.statistics.chances import log_chance
from tvsbayes.statistics.score import Directions, Score

LOOKS_MIN = 4
"""Least number of usable new looks."""
FALSE_ALARM_RATE = 0.01
POWER_MIN = 0.8
"""Power for a change of the stated size that a verdict of OK requires."""
NULL_DRAWS, DIRECTIONS_ASKED = 20_000, 200
"""Draws of the joint null distribution, and directions of a change over which its power is averaged."""
FOLLOWED = 1e-6
"""Share of a direction's information below which the old parameters can explain it entirely."""
TOLD_U = 2.0
"""Components of a change above this many u are reported."""


@dataclass(frozen=True)
class StatedChange:
    """A change that is tested.

    Attributes:
        what: its name in reports.
        names: parameters that it shifts.
        parts: names of their shifts in reports.
        size: length of the shift that must be detected, in `unit`.
        unit: unit of the shift.
    """

    what: str
    names: tuple[str, ...]
    parts: tuple[str, ...]
    size: float
    unit: str


def single_change(what: str, name: str, size: float, unit: str) -> StatedChange:
    """A change of one parameter."""
    return StatedChange(what, (name,), (what,), size, unit)


def columns_of(changes: Sequence[StatedChange]) -> tuple[slice, ...]:
    """Return the columns of each change among the shifts of all."""
    ends = np.cumsum([len(change.names) for change in changes])
    return tuple(slice(int(end) - len(change.names), int(end)) for end, change in zip(ends, changes, strict=True))


@dataclass(frozen=True)
class Departure:
    """Residuals of new looks from their prediction by the first session, at one set of noise scales.

    Attributes:
        chi2: squared length of the residuals in units of their covariance.
        dof: its number of observations.
        score: score of the shifts, in the units of `changes`, shape (q,).
        information: information of the looks on them, shape (q, q).
        changes: changes of these shifts.
    """

    chi2: float
    dof: int
    score: np.ndarray
    information: np.ndarray
    changes: tuple[StatedChange, ...]

    @property
    def columns(self) -> tuple[slice, ...]:
        """Return the columns of each change among the shifts."""
        return columns_of(self.changes)

    def log_chances(self, known: Sequence[slice] = ()) -> np.ndarray:
        """Log p of all residuals, then of every change where some, `known`, are free; 0 of these, (1 + c,)."""
        left, rows = Score(self.score, self.information), np.r_[tuple(known)] if known else np.zeros(0, dtype=int)
        left = left.given(rows, _directions(left.at(rows).information).inverse)
        each = [left.at(part) for part in self.columns]
        own = [_directions(of.information).log_chances(of.value) for of in each]
        logs = [np.zeros(()) if part in known else log_p for part, log_p in zip(self.columns, own, strict=True)]
        return np.array([log_chance(self.chi2, self.dof), *logs])


@dataclass(frozen=True)
class DrawnDepartures:
    """Departures over the distribution of the noise scales.

    Attributes:
        centre: departure at their most probable values.
        drawn: departures at draws of them.
        weights: weights of the draws, sum 1.
    """

    centre: Departure
    drawn: tuple[Departure, ...]
    weights: np.ndarray

    def log_chances(self, known: Sequence[slice] = ()) -> np.ndarray:
        """Logs of the means of `Departure.log_chances` over the noise scales."""
        with np.errstate(divide="ignore"):
            weights = np.log(self.weights)
        return np.logaddexp.reduce([each.log_chances(known) for each in self.drawn] + weights[:, None], axis=0)


def _directions(information: np.ndarray) -> Directions:
    """Directions that old parameters do not explain."""
    return Directions.of(information, FOLLOWED, np.sqrt(np.maximum(np.diag(information), 1e-300)))


@dataclass(frozen=True)
class NullDistribution:
    """Null distribution of the least log p of all changes, sorted, shape (draws,); `tests` is their number."""

    least: np.ndarray
    tests: int

    @property
    def limit(self) -> float:
        """Compute the limit of log p of single tests at the false-alarm rate of all together."""
        return float(np.quantile(self.least, FALSE_ALARM_RATE))

    def probability(self, log_p: float) -> float:
        """Compute the p-value of a least log p; beyond the draws by Bonferroni's bound."""
        counted = np.searchsorted(self.least, log_p, side="right")
        if not counted:
            return float(min(1 / len(self.least), self.tests * np.exp(log_p)))
        return float(counted / len(self.least))


def null_distribution(departure: Departure, seed: int) -> NullDistribution:
    """Simulate the linear model: scores ~ N(0, information)."""
    generator = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(departure.information)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    scores = generator.standard_normal((NULL_DRAWS, len(root))) @ root.T
    own = [_directions(departure.information[rows, rows]).log_chances(scores[:, rows]) for rows in departure.columns]
    return NullDistribution(np.sort(np.min([np.zeros(NULL_DRAWS), *own], axis=0)), len(departure.changes))


def powers(departure: Departure, limit: float, seed: int, times: float = 1.0) -> list[float]:
    """Compute the power of each change's own test, averaged over directions of the shift.

    It is a lower bound of the power of all tests together.

    Args:
        departure: only its information is used, so it may be that of a plan.
        limit: of log p.
        seed: seed of the directions.
        times: size of the change as a multiple of the stated one.
    """
    from scipy import special

    generator, shares = np.random.default_rng(seed), []
    for change, rows in zip(departure.changes, departure.columns, strict=True):
        block = departure.information[rows, rows]
        if not (dof := len(_directions(block).values)):
            shares.append(0.0)
            continue
        ways = generator.standard_normal((DIRECTIONS_ASKED, len(change.names)))
        ways *= times * change.size / np.linalg.norm(ways, axis=1, keepdims=True)
        critical = special.chdtri(dof, np.exp(limit))
        off = np.einsum("ni,ij,nj->n", ways, block, ways)
        shares.append(float(np.mean(1 - special.chndtr(critical, dof, off))))
    return shares


def _moved(departures: DrawnDepartures, limit: float) -> tuple[MovedPart, ...]:
    """Find changes that explain the looks, the best first, each given those before it."""
    moved: list[int] = []
    centre, places = departures.centre, departures.centre.columns
    while len(moved) < len(places):
        logs = departures.log_chances([places[k] for k in moved])[1:]
        if logs.min() > limit:
            break
        moved.append(int(np.argmin(logs)))
    parts: list[MovedPart] = []
    left = Score(centre.score, centre.information).at(np.r_[tuple(places[k] for k in moved)])
    covariance = _directions(left.information).inverse
    sizes, us = covariance @ left.value, np.sqrt(np.diag(covariance))
    for change in (centre.changes[k] for k in moved):
        (value, sizes), (u, us) = (np.split(each, [len(change.parts)]) for each in (sizes, us))
        ratio = np.abs(value) / u
        significant = [k for k in np.argsort(-ratio).tolist() if ratio[k] > TOLD_U] or [int(np.argmax(ratio))]
        parts += [MovedPart(change.parts[k], float(value[k]), float(u[k]), change.unit) for k in significant]
    return tuple(parts)


def tested(departures: DrawnDepartures, looks: int, same_cameras: bool, seed: int) -> Watch:
    """Test all changes.

    Args:
        departures: of the new data.
        looks: number of usable new looks or stops.
        same_cameras: whether the new looks state the campaign's cameras; true where there are none.
        seed: seed of the null distribution.
    """
    null = null_distribution(departures.centre, seed)
    logs = departures.log_chances()
    able = powers(departures.centre, null.limit, seed)
    changes = tuple(
        SeenChange(change.what, change.size, change.unit, power, float(np.exp(log_p)))
        for change, power, log_p in zip(departures.centre.changes, able, logs[1:], strict=True)
    )
    # The test of all residuals raises no alarm, since single bad looks have many causes other than a change.
    moved = bool(logs[1:].min() <= null.limit)
    verdict: Verdict = MOVED if moved else OK if min(able) >= POWER_MIN else CANNOT_TELL
    return Watch(
        verdict=verdict,
        p=null.probability(float(logs[1:].min())),
        false_alarm_rate=FALSE_ALARM_RATE,
        p_all=float(np.exp(logs[0])),
        moved=_moved(departures, null.limit) if moved else (),
        changes=changes,
        looks=looks,
        same_cameras=same_cameras,
    )

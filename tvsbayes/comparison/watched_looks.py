"""Watch over a stored fit by a few new looks: whether the calibration still holds, and if not, what moved.

Both sessions are linearised together at the mode of the first; the second begins with a homing. Stop errors, home
offsets and repeating errors of gears are in the covariance, those at counters of the first session as it determined
them; nothing is refitted. A change is a shift of parameters for the new looks alone (formulation 9). Degrees, mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from tvsbayes.errors import NothingToEstimate
from tvsbayes.estimators.annealed_stage import linearised_at
from tvsbayes.estimators.campaign_arrays import in_sight
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import LinearSpots, linear_spots, stop_information
from tvsbayes.estimators.mode_search import Problem
from tvsbayes.estimators.noise_scales import noise_draws
from tvsbayes.instrument.axes import AXES, HOME_SD_DEG
from tvsbayes.instrument.campaign import Campaign, input_hashes, ordered_spots
from tvsbayes.instrument.copies import refuse_same_looks
from tvsbayes.instrument.homing import homed
from tvsbayes.instrument.parameters import COLUMNS as COORDINATES
from tvsbayes.instrument.parameters import NAMES, RIG_NAMES
from tvsbayes.model.compiled import placed
from tvsbayes.model.parameter_space import physical_at
from tvsbayes.results.watch_record import CANNOT_TELL, MOVED, OK, MovedPart, SeenChange, Verdict, Watch
from tvsbayes.statistics.chances import log_chance

LOOKS_MIN = 4
"""Least number of usable new looks."""
FALSE_ALARM_RATE = 0.01
POWER_MIN = 0.8
"""Power for a change of the stated size that a verdict of OK requires."""
NOISE_DRAWS = 32
"""Draws of the noise scales, geometry and cameras integrated out, over which probabilities are averaged."""
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


def _pose(what: str, block: str) -> tuple[StatedChange, StatedChange]:
    turned, shifted = (tuple(f"{block}.{kind}.{axis}" for axis in "xyz") for kind in ("rotation_rad", "translation_mm"))
    about, along = (tuple(f"{what}: {how} {axis}" for axis in "xyz") for how in ("rotation about", "shift along"))
    return (
        StatedChange(f"{what}: rotation", turned, about, 0.05, "deg"),
        StatedChange(f"{what}: shift", shifted, along, 1.0, "mm"),
    )


def _single(what: str, name: str, size: float, unit: str) -> StatedChange:
    return StatedChange(what, (name,), (what,), size, unit)


_GEARS = (
    *(_single(f"ratio: {axis}", f"degrees_per_step.{axis}", 0.3, "%") for axis in AXES),
    *(_single(f"play: {axis}", f"backlash_deg.{axis}", 0.1, "deg") for axis in AXES),
)
CHANGES = (*_pose("cameras", "stereo"), *_pose("positioner", "extrinsics"), *_GEARS)
"""Tested changes of what a stereo pair sees, with the sizes that must be detected."""
_LEAN = tuple(f"azimuth_axis_tilt_deg.{side}" for side in ("north", "east"))
SIGHTED_CHANGES = (
    # These sizes exceed the uncertainty of a homing.
    *(_single(f"zero: {angle}", f"{angle}_zero_deg", 5 * HOME_SD_DEG, "deg") for angle in ("azimuth", "elevation")),
    StatedChange("base: lean", _LEAN, ("base: lean to azimuth 0", "base: lean to azimuth 90"), 0.1, "deg"),
    _single("beam: not square", "beam_not_square_deg", 0.1, "deg"),
    *_GEARS,
)
"""The same of a head that says where it points."""


def columns_of(changes: Sequence[StatedChange]) -> tuple[slice, ...]:
    """Return the columns of each change among the shifts of all."""
    ends = np.cumsum([len(change.names) for change in changes])
    return tuple(slice(int(end) - len(change.names), int(end)) for end, change in zip(ends, changes, strict=True))


def after_each_other(campaign: Campaign, looks: Campaign) -> Campaign:
    """Join two sessions to one campaign; the second begins with a homing of its own."""
    moves, spots, last = len(campaign.moves), max(spot.spot for spot in campaign.spots) + 1, campaign.moves[-1]
    later = tuple(
        replace(m, move=m.move + moves, segment=m.segment + last.segment + 1, time_s=m.time_s + last.time_s)
        for m in looks.moves
    )
    second = tuple(s.renumbered(s.spot + spots, s.move + moves) for s in looks.spots)
    return replace(campaign, moves=(*campaign.moves, *later), spots=(*campaign.spots, *second))


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
    changes: tuple[StatedChange, ...] = CHANGES

    @property
    def columns(self) -> tuple[slice, ...]:
        """Return the columns of each change among the shifts."""
        return columns_of(self.changes)

    def given(self, known: list[slice]) -> Departure:
        """Condition on some changes being free; score and information of the others remain."""
        if not known:
            return self
        rows = np.concatenate([np.arange(part.start, part.stop) for part in known])
        load = self.information[:, rows] @ _inverse(self.information[np.ix_(rows, rows)])
        information = self.information - load @ self.information[rows]
        return replace(self, score=self.score - load @ self.score[rows], information=information)


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


def _directions(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute eigenvalues of the scaled information not explained by old parameters, and unscaled vectors."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = values > FOLLOWED
    return values[kept], vectors[:, kept] / scale[:, None]


def _inverse(information: np.ndarray) -> np.ndarray:
    values, vectors = _directions(information)
    return (vectors / values) @ vectors.T


def _log_chances(score: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Compute log p of chi-squares of scores (..., q); 0 where the information has no direction."""
    values, vectors = _directions(information)
    if not len(values):
        return np.zeros(score.shape[:-1])
    return log_chance(np.sum((score @ vectors) ** 2 / values, axis=-1), len(values))


@dataclass(frozen=True)
class _ScoreInformation:
    """Score and information of columns of linearised spots, with the coordinates eliminated.

    Attributes:
        chi2: squared length of the remaining residuals and priors, up to a constant.
        score: score of the columns after the coordinates, shape (q,).
        information: information of these columns, shape (q, q).
    """

    chi2: float
    score: np.ndarray
    information: np.ndarray

    @classmethod
    def of(cls, spots: LinearSpots, prior: np.ndarray) -> _ScoreInformation:
        """Eliminate the first columns, coordinates with prior N(0, 1) that are at `prior`, shape (p,)."""
        information, count = stop_information(spots), len(prior)
        score = information.score(spots.jacobian)
        gradient, cross = score[:count] - prior, information.fisher[:count, count:]
        precision = information.fisher[:count, :count] + np.eye(count)
        left = np.linalg.solve(precision, np.column_stack([gradient, cross]))
        return cls(
            chi2=float(spots.residual.ravel() @ information.residual - gradient @ left[:, 0]),
            score=score[count:] - cross.T @ left[:, 0],
            information=information.fisher[count:, count:] - cross.T @ left[:, 1:],
        )


class WatchedLooks:
    """New looks and the campaign that they are compared with, as arguments of the compiled functions."""

    def __init__(self, fit: JointFit, looks: Campaign):
        campaign = homed(fit.campaign, fit.sides)
        self.fit, self.first = fit, len(ordered_spots(campaign))
        joined = after_each_other(campaign, homed(looks, fit.sides))
        used = np.append(fit.arrays.used, in_sight(joined)[self.first :])
        self.problem = Problem(joined, fit.table, used, np.asarray(fit.arrays.spots.weight)[: self.first])
        self.looks = int(used[self.first :].sum())
        apply = fit.space.mechanism.documented.issuperset
        self.changes = next(each for each in (CHANGES, SIGHTED_CHANGES) if apply(n for c in each for n in c.names))
        self.dof = int(self.problem.dof[self.usable].sum())

    def departure(self, z: np.ndarray, *, angles: bool = False) -> Departure:
        """Compute the departure of the looks from the first session, both linearised at z, at its noise scales.

        The shifts are those of the changes, or with `angles` the mirror angles (pan, tilt) of every usable look, deg.
        """
        linear, prior = self.linear(z, angles=angles), np.where(self.problem.held, 0.0, z)
        whole, before = (_ScoreInformation.of(spots, prior) for spots in (linear, rows_of(linear, slice(self.first))))
        return Departure(whole.chi2 - before.chi2, self.dof, whole.score, whole.information, self.changes)

    def linear(self, z: np.ndarray, *, angles: bool = False) -> LinearSpots:
        """Linearise both sessions at z, with columns for the coordinates, then for the changes or the looks' angles.

        They are linearised in physical values, not in coordinates, since a change may shift a fixed parameter.
        """
        at, rig = physical_at(z, self.problem.space), len(RIG_NAMES)
        plain = replace(
            self.problem.space,
            value=placed(at.value[:rig]),
            u=placed(np.ones(rig)),
            kind=placed(np.zeros(rig, dtype=np.asarray(self.problem.space.kind).dtype)),
            stereo_mean=placed(at.value[rig:]),
            stereo_root=placed(np.eye(len(NAMES) - rig)),
        )
        lin = linearised_at(np.zeros(len(NAMES)), plain, self.problem.arrays)
        physical = -np.asarray(lin.residual_jacobian)
        slope = np.where(self.problem.held, 0.0, physical @ at.slope)
        if angles:
            shifts = np.radians(1.0) * lin.by_angles(self.usable)
        else:
            shifted = [COORDINATES[name] for change in self.changes for name in change.names]
            shifts = physical[:, :, shifted] * self._unit_sizes(at.value)
            shifts[: self.first] = 0.0
        return linear_spots(lin, self.problem.arrays, np.concatenate([slope, shifts], axis=2))

    @property
    def usable(self) -> np.ndarray:
        """Return indices of the usable new looks in the linearised campaign, shape (looks,)."""
        return self.first + np.flatnonzero(self.problem.arrays.used[self.first :])

    def _unit_sizes(self, value: np.ndarray) -> np.ndarray:
        """Return physical values of a shift by one unit of the changes, shape (q,)."""
        sizes = []
        for change in self.changes:
            for name in change.names:
                radians = np.radians(1.0) if "rotation_rad" in name else 1.0
                sizes.append(0.01 * value[COORDINATES[name]] if change.unit == "%" else radians)
        return np.array(sizes)

    def departures(self, seed: int) -> DrawnDepartures:
        """Compute departures over the first session's marginal of the noise scales."""
        noise = noise_draws(self.fit, NOISE_DRAWS, seed)
        drawn = tuple(self.departure(z) for z in noise.z)
        return DrawnDepartures(self.departure(noise.centre), drawn, noise.weights)


def rows_of(spots: LinearSpots, rows: slice) -> LinearSpots:
    """Select spots of a linearised campaign, in their order."""
    return LinearSpots(**{part.name: getattr(spots, part.name)[rows] for part in fields(spots)})


def log_chances(departures: DrawnDepartures, known: list[slice]) -> np.ndarray:
    """Compute log p of all residuals, then of every change given known ones, averaged over noise scales, (1 + c,)."""
    chances = []
    for departure in departures.drawn:
        left, logs = departure.given(known), [log_chance(departure.chi2, departure.dof)]
        for rows in departure.columns:
            own = _log_chances(left.score[rows], left.information[rows, rows])
            logs.append(np.zeros(()) if rows in known else own)
        chances.append(np.array(logs))
    with np.errstate(divide="ignore"):
        weights = np.log(departures.weights)
    return np.logaddexp.reduce(np.array(chances) + weights[:, None], axis=0)


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
    own = [_log_chances(scores[:, rows], departure.information[rows, rows]) for rows in departure.columns]
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
        values, _ = _directions(block)
        dof = len(values)
        if not dof:
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
    places = departures.centre.columns
    while len(moved) < len(places):
        logs = log_chances(departures, [places[k] for k in moved])[1:]
        best = int(np.argmin(logs))
        if logs[best] > limit:
            break
        moved.append(best)
    if not moved:
        return ()
    rows = np.concatenate([np.arange(places[k].start, places[k].stop) for k in moved])
    covariance = _inverse(departures.centre.information[np.ix_(rows, rows)])
    sizes, us = covariance @ departures.centre.score[rows], np.sqrt(np.diag(covariance))
    parts: list[MovedPart] = []
    start = 0
    for change in (departures.centre.changes[k] for k in moved):
        own = slice(start, start := start + len(change.parts))
        value, u = sizes[own], us[own]
        ratio = np.abs(value) / u
        significant = [k for k in np.argsort(-ratio).tolist() if ratio[k] > TOLD_U] or [int(np.argmax(ratio))]
        parts += [MovedPart(change.parts[k], float(value[k]), float(u[k]), change.unit) for k in significant]
    return tuple(parts)


def watch(fit: JointFit, looks: Campaign, *, seed: int = 0) -> Watch:
    """Test whether a calibration still holds for new looks.

    Args:
        fit: converged fit of the campaign.
        looks: new looks at the same rig, from a homing on.
        seed: seed of the draws of noise scales and of the null distribution.

    Raises:
        InputError: the looks are those of the campaign.
        NothingToEstimate: fewer than `LOOKS_MIN` usable looks.
    """
    refuse_same_looks(fit.campaign, looks)
    usable = int(in_sight(looks).sum()) if ordered_spots(looks) else 0
    if usable < LOOKS_MIN:
        file = looks.looks_table.file
        raise NothingToEstimate(
            "too-few-looks",
            f"{file}: {usable} new looks can be used; a calibration is watched with at least {LOOKS_MIN}",
            file=file,
            remedy=looks.look_again,
        )
    watched = WatchedLooks(fit, looks)
    departures = watched.departures(seed)
    null = null_distribution(departures.centre, seed)
    logs = log_chances(departures, [])
    able = powers(departures.centre, null.limit, seed)
    changes = tuple(
        SeenChange(change.what, change.size, change.unit, power, float(np.exp(log_p)))
        for change, power, log_p in zip(watched.changes, able, logs[1:], strict=True)
    )
    # The test of all residuals raises no alarm, since single bad looks have many causes other than a change.
    moved = bool(logs[1:].min() <= null.limit)
    verdict: Verdict = MOVED if moved else OK if min(able) >= POWER_MIN else CANNOT_TELL
    hashes = input_hashes(fit.campaign)["stereo"], input_hashes(looks)["stereo"]
    return Watch(
        verdict=verdict,
        p=null.probability(float(logs[1:].min())),
        false_alarm_rate=FALSE_ALARM_RATE,
        p_all=float(np.exp(logs[0])),
        moved=_moved(departures, null.limit) if moved else (),
        changes=changes,
        looks=watched.looks,
        same_cameras=hashes[0] == hashes[1],
    )

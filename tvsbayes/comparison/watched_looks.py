"""Watch over a stored fit by a few new looks: whether the calibration still holds, and if not, what moved.

Both sessions are linearised together at the mode of the first; the second begins with a homing. Stop errors, home
offsets and repeating errors of gears are in the covariance, those at counters of the first session as it determined
them; nothing is refitted. A change is a shift of parameters for the new looks alone (formulation 9). Degrees, mm.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from msgspec import structs

from tvsbayes.comparison.departures import LOOKS_MIN, Departure, DrawnDepartures, StatedChange, single_change, tested
from tvsbayes.errors import NothingToEstimate
from tvsbayes.estimators.annealed_stage import linearised_at
from tvsbayes.estimators.campaign_arrays import in_sight
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import LinearSpots, linear_spots, stop_information
from tvsbayes.estimators.mode_search import Problem
from tvsbayes.estimators.noise_scales import noise_draws
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, input_hashes, ordered_spots
from tvsbayes.instrument.conditions import pause_s
from tvsbayes.instrument.copies import refuse_same_looks
from tvsbayes.instrument.homing import homed
from tvsbayes.model.compiled import placed
from tvsbayes.model.parameter_space import physical_at
from tvsbayes.results.watch_record import Watch
from tvsbayes.statistics.score import Score

NOISE_DRAWS = 32
"""Draws of the noise scales, geometry and cameras integrated out, over which probabilities are averaged."""


def _pose(what: str, block: str) -> tuple[StatedChange, StatedChange]:
    turned, shifted = (tuple(f"{block}.{kind}.{axis}" for axis in "xyz") for kind in ("rotation_rad", "translation_mm"))
    about, along = (tuple(f"{what}: {how} {axis}" for axis in "xyz") for how in ("rotation about", "shift along"))
    return (
        StatedChange(f"{what}: rotation", turned, about, 0.05, "deg"),
        StatedChange(f"{what}: shift", shifted, along, 1.0, "mm"),
    )


_GEARS = (
    *(single_change(f"ratio: {axis}", f"degrees_per_step.{axis}", 0.3, "%") for axis in AXES),
    *(single_change(f"play: {axis}", f"backlash_deg.{axis}", 0.1, "deg") for axis in AXES),
)
CHANGES = (*_pose("cameras", "stereo"), *_pose("positioner", "extrinsics"), *_GEARS)
"""Tested changes of what a stereo pair sees, with the sizes that must be detected."""
_LEAN = tuple(f"azimuth_axis_tilt_deg.{side}" for side in ("north", "east"))
SIGHTED_CHANGES = (
    # These sizes exceed the usual scatter of homings, 0.05 deg.
    *(single_change(f"zero: {angle}", f"{angle}_zero_deg", 0.25, "deg") for angle in ("azimuth", "elevation")),
    StatedChange("base: lean", _LEAN, ("base: lean to azimuth 0", "base: lean to azimuth 90"), 0.1, "deg"),
    single_change("beam: not square", "beam_not_square_deg", 0.1, "deg"),
    *_GEARS,
)
"""The same of a head that says where it points."""


def after_each_other(campaign: Campaign, looks: Campaign) -> Campaign:
    """Join two sessions to one campaign; the second begins with a homing of its own.

    The zero of an absolute encoder walks on between them.
    """
    moves, spots, last = len(campaign.moves), max(spot.spot for spot in campaign.spots) + 1, campaign.moves[-1]
    begins_s = last.time_s
    if campaign.rig.absolute:
        begins_s += pause_s(campaign.header, looks.header, last.time_s)
    later = tuple(
        replace(m, move=m.move + moves, segment=m.segment + last.segment + 1, time_s=m.time_s + begins_s)
        for m in looks.moves
    )
    second = tuple(s.renumbered(s.spot + spots, s.move + moves) for s in looks.spots)
    return replace(campaign, moves=(*campaign.moves, *later), spots=(*campaign.spots, *second))


def _fitted(spots: LinearSpots, prior: np.ndarray) -> tuple[float, Score]:
    """Fit the first columns, coordinates with prior N(0, 1) that are at `prior` (p,), in a linear model.

    Returns the squared length of the remaining residuals and priors, up to a constant, and what is left of the others.
    """
    information, count = stop_information(spots), len(prior)
    score = information.score(spots.jacobian)
    score[:count] -= prior
    inverse = np.linalg.inv(information.fisher[:count, :count] + np.eye(count))
    chi2 = spots.residual.ravel() @ information.residual - score[:count] @ inverse @ score[:count]
    rest = Score(score, information.fisher).given(slice(count), inverse)
    return float(chi2), rest.at(slice(count, None))


class WatchedLooks:
    """New looks and the campaign that they are compared with, as arguments of the compiled functions."""

    def __init__(self, fit: JointFit, looks: Campaign):
        campaign = homed(fit.campaign, fit.sides)
        self.fit, self.first = fit, len(ordered_spots(campaign))
        joined = after_each_other(campaign, homed(looks, fit.sides))
        used = np.append(fit.arrays.used, in_sight(joined)[self.first :])
        self.joined = joined
        self.problem = Problem(joined, fit.table, used, np.asarray(fit.arrays.spots.weight)[: self.first])
        self.looks = int(used[self.first :].sum())
        apply = set(fit.space.mechanism.names).issuperset
        self.changes = next(each for each in (CHANGES, SIGHTED_CHANGES) if apply(n for c in each for n in c.names))
        self.dof = int(self.problem.dof[self.usable].sum())

    def departure(self, z: np.ndarray, *, angles: bool = False) -> Departure:
        """Compute the departure of the looks from the first session, both linearised at z, at its noise scales.

        The shifts are those of the changes, or with `angles` the mirror angles (pan, tilt) of every usable look, deg.
        """
        linear, prior = self.linear(z, angles=angles), np.where(self.problem.held, 0.0, z)
        chi2, shifts = _fitted(linear, prior)
        before, _ = _fitted(rows_of(linear, slice(self.first)), prior)
        return Departure(chi2 - before, self.dof, shifts.value, shifts.information, self.changes)

    def linear(self, z: np.ndarray, *, angles: bool = False) -> LinearSpots:
        """Linearise both sessions at z, with columns for the coordinates, then for the changes or the looks' angles.

        They are linearised in physical values, not in coordinates, since a change may shift a fixed parameter.
        """
        at, rig = physical_at(z, self.problem.space), self.problem.space.rig
        plain = replace(
            self.problem.space,
            value=placed(at.value[:rig]),
            u=placed(np.ones(rig)),
            kind=placed(np.zeros(rig, dtype=np.asarray(self.problem.space.kind).dtype)),
            stereo_mean=placed(at.value[rig:]),
            stereo_root=placed(np.eye(len(z) - rig)),
        )
        lin = linearised_at(np.zeros(len(z)), plain, self.problem.arrays)
        physical = -np.asarray(lin.residual_jacobian)
        slope = np.where(self.problem.held, 0.0, physical @ at.slope)
        if angles:
            shifts = np.radians(1.0) * lin.by_angles(self.usable)
        else:
            index = self.problem.space.mechanism.index
            shifted = [index[name] for change in self.changes for name in change.names]
            shifts = physical[:, :, shifted] * self._unit_sizes(at.value)
            shifts[: self.first] = 0.0
        return linear_spots(lin, self.problem.arrays, np.concatenate([slope, shifts], axis=2))

    @property
    def usable(self) -> np.ndarray:
        """Return indices of the usable new looks in the linearised campaign, shape (looks,)."""
        return self.first + np.flatnonzero(self.problem.arrays.used[self.first :])

    def _unit_sizes(self, value: np.ndarray) -> np.ndarray:
        """Return physical values of a shift by one unit of the changes, shape (q,)."""
        index = self.problem.space.mechanism.index
        return np.array(
            [
                0.01 * value[index[name]] if change.unit == "%" else np.radians(1.0) if "_rad" in name else 1.0
                for change in self.changes
                for name in change.names
            ]
        )

    def departures(self, seed: int) -> DrawnDepartures:
        """Compute departures over the first session's marginal of the noise scales."""
        noise = noise_draws(self.fit, NOISE_DRAWS, seed)
        drawn = tuple(self.departure(z) for z in noise.z)
        return DrawnDepartures(self.departure(noise.centre), drawn, noise.weights)


def rows_of(spots: LinearSpots, rows: slice) -> LinearSpots:
    """Select spots of a linearised campaign, in their order."""
    return LinearSpots(**{part.name: getattr(spots, part.name)[rows] for part in fields(spots)})


def usable_looks(looks: Campaign, words: str, remedy: str) -> np.ndarray:
    """Return the mask of usable looks (looks,), of which there must be enough for a test.

    Raises:
        NothingToEstimate: fewer than `LOOKS_MIN`, in `words` between both numbers, with a remedy.
    """
    used, file = in_sight(looks) if ordered_spots(looks) else np.zeros(0, dtype=bool), looks.looks_table.file
    if used.sum() < LOOKS_MIN:
        message = f"{file}: {used.sum()} {words} {LOOKS_MIN}"
        raise NothingToEstimate("too-few-looks", message, file=file, remedy=remedy)
    return used


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
    usable_looks(looks, "new looks can be used; a calibration is watched with at least", looks.look_again)
    watched = WatchedLooks(fit, looks)
    hashes = input_hashes(fit.campaign)["stereo"], input_hashes(looks)["stereo"]
    result = tested(watched.departures(seed), watched.looks, hashes[0] == hashes[1], seed)
    return structs.replace(result, home_sd_by_prior=fit.home_sd_by_prior)

"""A campaign as arrays for the compiled functions: spots in time order and moves, both padded to a bucket.

Sizes are powers of two from `SMALLEST_BUCKET`, so that a second campaign compiles nothing; places of gears have other
sizes. px, counters in steps, aperture readings in rad; padded rows are not valid and have no effect.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from tvsbayes.instrument.axes import APPROACH_SIGN
from tvsbayes.instrument.campaign import Campaign, Move, ordered_spots, pixels_of
from tvsbayes.instrument.conditions import kelvin, powered_on_s, warm_minutes
from tvsbayes.instrument.places import PLACES_MAX, SeenPlaces, gears_vary, seen_places, vary_by_position
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.sightings import sighted_deg, sightings_of, tangent_frames
from tvsbayes.instrument.stereo_pair import triangulate
from tvsbayes.instrument.stops import redraws
from tvsbayes.model.compiled import placed
from tvsbayes.model.gear_processes import Places
from tvsbayes.model.laser_path import MoveArrays

COLUMNS_TOGETHER, PLACES_TOGETHER = 12, 6
"""Columns of errors that pass the filter together, and their places. Columns determine the cost of a density; the
paper's protocol has six counters."""
SMALLEST_BUCKET = 4096
"""Spots and moves are padded to this size or the next power of two above it: smaller campaigns share compiled
functions, and their cost follows their own rows."""
NOWHERE_MM = np.array([500.0, 0.0, 0.0])
"""Point of a look that is not used: finite, and in front of the cameras."""


class SpotArrays(eqx.Module):
    """Spots with status ok in time order, padded.

    `whitening` maps a pixel residual to stated standard deviations. `weight` scales a spot's information (1, or below
    for the robust option), `valid` is 0 for padding and excluded spots. `redraw[axis]` is whether the axis has a new
    stop error since the previous spot, with variance `redraw_mix[axis] @ (sd_right^2, sd_left^2)` (or down, up).
    `new_segment` is whether a segment began, `new_zero` whether with it the zero of (pan, tilt). `homed` is 1 where
    this has an unknown offset; `hours` is the time over which it walked, since the previous spot or a later homing.

    For sightings `triangulated_mm` is the direction of the head, a unit vector of frame P; `tangents` are the unit
    vectors along azimuth and elevation there (None for a stereo pair). The pixels are then angles on the sphere about
    that direction, rad, in the columns of `SIGHTED`.
    """

    move_index: Int[Array, " spots"]
    pixels: Float[Array, "spots 4"]
    whitening: Float[Array, "spots 4 4"]
    aperture_rad: Float[Array, " spots"]
    has_aperture: Float[Array, " spots"]
    triangulated_mm: Float[Array, "spots 3"]
    valid: Float[Array, " spots"]
    weight: Float[Array, " spots"]
    redraw: Bool[Array, "spots 2"]
    redraw_mix: Float[Array, "spots 2 2"]
    new_segment: Bool[Array, " spots"]
    new_zero: Bool[Array, "spots 2"]
    homed: Float[Array, "spots 2"]
    hours: Float[Array, "spots 2"]
    tangents: Float[Array, "spots 2 3"] | None = None


class GearArrays(eqx.Module):
    """Errors of the gears that may differ from place to place, a column each, and their effect on each spot.

    All errors at the places are their transmission errors, then their plays; only those that the priors leave open have
    a column: transmission errors of pan, of tilt, plays of pan, of tilt. A spot's axis angle contains an error times
    `share`: for a play minus its half where the axis came from the right or from below, else plus its half.

    Attributes:
        places: counters of both axes at which looks found the gears.
        share: effect of each column on the angle of its axis.
        error: number of each column among all errors at the places.
        on_tilt: axis of each column; valid: padding is last, and not valid.
    """

    places: Places
    share: Float[Array | np.ndarray, "spots columns"]
    error: Int[Array | np.ndarray, " columns"]
    on_tilt: Bool[Array | np.ndarray, " columns"]
    valid: Bool[Array | np.ndarray, " columns"]

    @property
    def together(self) -> int:
        """Return the number of columns in a group: `COLUMNS_TOGETHER`, or a divisor of the padded number."""
        return math.gcd(self.share.shape[1], COLUMNS_TOGETHER)

    @property
    def groups(self) -> int:
        """Return the number of groups of columns, padding included."""
        return self.share.shape[1] // max(self.together, 1)

    @property
    def columns(self) -> int:
        """Return the number of columns without padding; NumPy only."""
        return int(np.asarray(self.valid).sum())

    @property
    def filled(self) -> int:
        """Return the number of places, rounded up to a multiple of `PLACES_TOGETHER`; NumPy only."""
        return PLACES_TOGETHER * -(-int(np.asarray(self.places.valid).sum()) // PLACES_TOGETHER)

    @property
    def place(self) -> np.ndarray:
        """Return the place of each column; NumPy only."""
        return np.asarray(self.error)[: self.columns] % max(len(self.places.steps), 1)

    @property
    def of_play(self) -> np.ndarray:
        """Mark the columns that are plays; NumPy only."""
        return np.asarray(self.error)[: self.columns] >= len(self.places.steps)

    @property
    def rows(self) -> np.ndarray:
        """Return the number of each column among all errors at the filled places; NumPy only."""
        return self.place + self.filled * self.of_play

    def at_places(self, errors: np.ndarray) -> np.ndarray:
        """Return errors of the columns (..., c) as errors at all filled places (..., 2 filled); others are zero."""
        every = np.zeros((*errors.shape[:-1], 2 * self.filled))
        every[..., self.rows] = errors
        return every

    def without_padding(self) -> GearArrays:
        """Return NumPy arrays of the `filled` places and of the columns."""
        places = jax.tree.map(lambda array: np.asarray(array)[: self.filled], self.places)
        share = np.asarray(self.share)[:, : self.columns]
        kept = (np.asarray(array)[: self.columns] for array in (self.on_tilt, self.valid))
        return GearArrays(places, share, self.rows, *kept)


class CampaignArrays(eqx.Module):
    """A campaign as argument of jitted functions; `count` is the number of its spots without padding."""

    moves: MoveArrays
    spots: SpotArrays
    gears: GearArrays
    azimuth_convention: Bool[Array, ""]
    count: Int[Array, ""]

    @property
    def used(self) -> Bool[np.ndarray, " spots"]:
        """Mark each spot that the fit uses, without padding; NumPy only."""
        return np.asarray(self.spots.valid)[: int(self.count)] > 0

    @property
    def read(self) -> Bool[np.ndarray, " spots"]:
        """Mark each of `used` with an aperture reading; NumPy only."""
        return self.used & (np.asarray(self.spots.has_aperture)[: int(self.count)] > 0)

    def weighed(self, valid: np.ndarray, weight: np.ndarray) -> CampaignArrays:
        """Return a copy with other `valid` and `weight` of the first spots, as many as given."""
        both = [np.array(self.spots.valid), np.array(self.spots.weight)]
        for array, first in zip(both, (valid, weight), strict=True):
            array[: len(first)] = first
        return eqx.tree_at(lambda a: (a.spots.valid, a.spots.weight), self, tuple(map(placed, both)))

    def of_spots(self, start: Int[Array, ""] | int, count: int) -> CampaignArrays:
        """Return the same moves with `count` spots from `start` on."""

        def part(array):
            return jax.lax.dynamic_slice_in_dim(array, start, count)

        gears = eqx.tree_at(lambda gears: gears.share, self.gears, part(self.gears.share))
        return CampaignArrays(self.moves, jax.tree.map(part, self.spots), gears, self.azimuth_convention, self.count)


def bucket(count: int, smallest: int | None = None, growth: int = 2) -> int:
    """Return the padded length for `count` rows: `smallest` (default `SMALLEST_BUCKET`) times a power of `growth`."""
    size = SMALLEST_BUCKET if smallest is None else smallest
    while size < count:
        size *= growth
    return size


def padded(rows: Sequence[object] | ArrayLike, size: int, fill: ArrayLike = 0.0, dtype: type = np.float64) -> jax.Array:
    """Pad rows (n, ...) with `fill` to `size` rows."""
    given: np.ndarray = np.asarray(rows, dtype)
    rest: np.ndarray = np.broadcast_to(np.asarray(fill, dtype), (size - len(given), *given.shape[1:]))
    return placed(np.concatenate([given, rest]))


def move_arrays(moves: Sequence[Move], size: int | None = None, powered_on_s: float | None = None) -> MoveArrays:
    """Pad the moves, by default to their `bucket`; padding repeats the last counters and so has no effect.

    Args:
        moves: in time order.
        size: padded length.
        powered_on_s: when the machine was switched on, clock of `time_s`; by default at the first move.
    """
    size = bucket(len(moves)) if size is None else size
    steps = np.array([(m.pan_steps, m.tilt_steps) for m in moves])
    approach = [(APPROACH_SIGN.get(m.pan_approach, 0), APPROACH_SIGN.get(m.tilt_approach, 0)) for m in moves]
    first = [bool(m.pan_approach) for m in moves]
    conditions = warm_minutes(moves, powered_on_s), kelvin(moves)
    return MoveArrays(
        padded(steps, size, steps[-1]),
        padded(first, size, False, bool),
        padded(approach, size),
        *(padded(values, size, values[-1]) for values in conditions),
    )


def place_arrays(places: SeenPlaces) -> Places:
    """Pad places to the largest number of them."""
    count, size = len(places.steps), 2 * PLACES_MAX
    return Places(
        padded(places.steps, size), padded(places.on_tilt, size, False, bool), padded(np.ones(count), size, False, bool)
    )


def no_gears(size: int) -> GearArrays:
    """Return the arrays of gears without errors by position, for this padded number of spots."""
    none = placed(np.zeros(0, dtype=bool))
    places = Places(placed(np.zeros(0)), none, none)
    return GearArrays(places, padded(np.zeros((0, 0)), size), placed(np.zeros(0, dtype=np.int32)), none, none)


def gear_arrays(given: SeenPlaces, table: RigTable, size: int) -> GearArrays:
    """Pad the places of looks, and make columns of the errors that the priors leave open.

    Args:
        given: from `seen_places`.
        table: priors of the gears.
        size: padded number of spots.
    """
    places, varied = place_arrays(given), vary_by_position(table)
    most, axis = 2 * len(places.steps), given.on_tilt.astype(int)
    kept = [np.flatnonzero(of_kind[axis]) for of_kind in varied]
    error = np.concatenate([kept[0], len(places.steps) + kept[1]]).astype(np.int32)
    on_tilt = given.on_tilt[np.concatenate(kept)]
    share = np.concatenate([given.error_share[:, kept[0]], given.play_share[:, kept[1]]], axis=1)
    return GearArrays(
        places,
        padded(np.pad(share, ((0, 0), (0, most - share.shape[1]))), size),
        padded(error, most, 0, np.int32),
        padded(on_tilt, most, False, bool),
        padded(np.ones(len(error)), most, False, bool),
    )


def campaign_arrays(campaign: Campaign, table: RigTable | None = None) -> CampaignArrays:
    """Pack a campaign for the jitted functions.

    Args:
        campaign: a checked campaign with at least one spot of status ok.
        table: priors of the fit, by default those of the campaign; gears without repeating errors have no places.

    Returns:
        Arrays padded to `bucket` sizes.
    """
    spots = ordered_spots(campaign)
    size = bucket(len(spots))
    if campaign.has_images:
        pixels, tangents = pixels_of(spots), None
        points_mm = triangulate(campaign.stereo_pair, pixels)
    else:
        frames = tangent_frames(sighted_deg(sightings_of(spots)))
        pixels, points_mm = np.zeros((len(spots), 4)), frames[:, 2]
        tangents = padded(frames[:, :2], size, np.eye(3)[1:])
    covariance = np.stack([s.pixel_covariance() for s in spots])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    looks = [s.move for s in spots]
    priors = campaign.rig if table is None else table
    new = redraws(campaign.moves, looks, absolute=campaign.rig.absolute)
    places = seen_places(campaign.moves, looks, priors)
    gears = gear_arrays(places if gears_vary(priors) else places.none, priors, size)
    aperture = [np.nan if s.aperture_deg is None else s.aperture_deg for s in spots]
    finite = np.isfinite(points_mm).all(axis=1)
    points_mm[~finite] = NOWHERE_MM
    spot_arrays = SpotArrays(
        move_index=padded([s.move for s in spots], size, spots[-1].move, np.int32),
        pixels=padded(pixels, size),
        whitening=padded(whitening, size, np.eye(4)),
        aperture_rad=padded(np.nan_to_num(np.radians(aperture)), size),
        has_aperture=padded(np.isfinite(aperture), size),
        triangulated_mm=padded(points_mm, size, NOWHERE_MM),
        valid=padded(finite, size),
        weight=placed(np.ones(size)),
        redraw=padded(new.redraw, size, False, bool),
        redraw_mix=padded(new.redraw_mix, size),
        new_segment=padded(new.new_segment, size, False, bool),
        new_zero=padded(new.new_zero, size, False, bool),
        homed=padded(new.homed, size),
        hours=padded(new.hours, size),
        tangents=tangents,
    )
    azimuth = placed(campaign.rig.aperture_convention == "azimuth")
    moves = move_arrays(campaign.moves, powered_on_s=powered_on_s(campaign.header))
    return CampaignArrays(moves, spot_arrays, gears, azimuth, placed(np.int32(len(spots))))


def in_sight(campaign: Campaign) -> np.ndarray:
    """Mark each ordered spot that has a triangulated point; one outside the lens model's range has none."""
    spots = ordered_spots(campaign)
    if not campaign.has_images:
        return np.ones(len(spots), dtype=bool)
    return np.isfinite(triangulate(campaign.stereo_pair, pixels_of(spots))).all(axis=1)


def spot_constants(campaign: Campaign) -> np.ndarray:
    """Compute the constant terms of each ordered spot's log likelihood: 2 pi and its stated covariance."""
    constants = campaign.rig.mechanism.residuals
    return np.array(
        [
            -0.5
            * (
                (constants + (s.aperture_deg is not None)) * np.log(2 * np.pi)
                + np.linalg.slogdet(s.pixel_covariance())[1]
            )
            for s in ordered_spots(campaign)
        ]
    )

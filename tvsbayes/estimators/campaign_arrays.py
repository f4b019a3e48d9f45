"""A campaign as the arrays that the compiled functions take: spots in time order, moves, both padded to a bucket.

Sizes are powers of two from `SMALLEST_BUCKET`, so that a second campaign compiles nothing; places of gears have sizes
of their own. px, counters in steps, aperture readings in rad; padded rows are not valid and count nothing.
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
from tvsbayes.instrument.campaign import Campaign, Move, Spot, ordered_spots, pixels_of
from tvsbayes.instrument.conditions import kelvin, powered_on_s, warm_minutes
from tvsbayes.instrument.places import PLACES_MAX, SeenPlaces, gears_vary, seen_places
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.sightings import Sighting, sighted_deg, sightings_of, tangent_frames
from tvsbayes.instrument.stereo_pair import triangulate
from tvsbayes.instrument.stops import redraws
from tvsbayes.model.compiled import placed
from tvsbayes.model.gear_processes import Places
from tvsbayes.model.laser_path import MoveArrays

PLACES_TOGETHER = 6
"""Places of both axes whose columns go through the filter together: columns are what a density costs, and the paper's
protocol has these six counters."""
SMALLEST_BUCKET = 4096
"""Spots and moves are padded to this size or the next power of two above it: campaigns up to it share their compiled
functions, and cost what their own rows need."""
SIGHTED = (1, 2)
"""Columns of the pixels in which sightings have their two angles: the first column is where ranges are taken out."""
NOWHERE_MM = np.array([500.0, 0.0, 0.0])
"""Stands for the point of a look that counts for nothing: finite, and in front of the cameras."""


class SpotArrays(eqx.Module):
    """Spots with status ok in time order, padded.

    `whitening` maps a pixel residual to stated standard deviations. `weight` scales a spot's information
    (1, or below for the robust option), `valid` is 0 for padding and excluded spots. `redraw[axis]` says that the
    stop error of the axis was drawn anew since the previous spot, with variance
    `redraw_mix[axis] @ (sd_right^2, sd_left^2)` (or down, up). `hours` have passed since the spot before, or since the
    homing that came after it.

    Of sightings `triangulated_mm` is the direction in which the head was found to point, a unit vector of frame P, and
    `tangents` are those along azimuth and elevation there; None where a stereo pair sees spots. The pixels are then
    angles on the sphere about that direction, rad: none in the left image, two in the columns of `SIGHTED`.
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
    homed: Bool[Array, " spots"]
    hours: Float[Array, " spots"]
    tangents: Float[Array, "spots 2 3"] | None = None


class GearArrays(eqx.Module):
    """Where looks found the gears: places of both axes, and what the errors there do to each spot.

    The angle of the spot's axis of a place holds the transmission error there times `error_share`, and the play there
    times `play_share`: minus half of it where the axis came from the right or from below, with the other sign else.
    """

    places: Places
    error_share: Float[Array | np.ndarray, "spots places"]
    play_share: Float[Array | np.ndarray, "spots places"]

    def some(self, start: Int[Array, ""] | int, count: int) -> GearArrays:
        """So many places from one on."""

        def part(array):
            return jax.lax.dynamic_slice_in_dim(array, start, count, axis=-1)

        return jax.tree.map(part, self)

    @property
    def together(self) -> int:
        """Places of a group: `PLACES_TOGETHER`, or what divides their padded number evenly."""
        return math.gcd(len(self.places.steps), PLACES_TOGETHER)

    @property
    def groups(self) -> int:
        """Of places, padding included."""
        return len(self.places.steps) // max(self.together, 1)

    @property
    def filled(self) -> int:
        """Places of the groups that hold one; for NumPy's side."""
        together = max(self.together, 1)
        return together * -(-int(np.asarray(self.places.valid).sum()) // together)

    @property
    def errors_filled(self) -> np.ndarray:
        """Which of the errors at all places, transmission errors and plays, are those at the filled ones."""
        return np.add.outer([0, len(self.places.steps)], np.arange(self.filled)).ravel()

    def without_padding(self) -> GearArrays:
        """As NumPy arrays, of the `filled` places."""
        count = self.filled
        return jax.tree.map(lambda array: np.asarray(array)[..., :count], self)


class CampaignArrays(eqx.Module):
    """A campaign as arguments of jitted functions; `count` of its spots are no padding."""

    moves: MoveArrays
    spots: SpotArrays
    gears: GearArrays
    azimuth_convention: Bool[Array, ""]
    count: Int[Array, ""]

    def of_spots(self, start: Int[Array, ""] | int, count: int) -> CampaignArrays:
        """The same moves with `count` spots from one on: what follows the last is never asked for."""

        def part(array):
            return jax.lax.dynamic_slice_in_dim(array, start, count)

        gears = GearArrays(self.gears.places, part(self.gears.error_share), part(self.gears.play_share))
        return CampaignArrays(self.moves, jax.tree.map(part, self.spots), gears, self.azimuth_convention, self.count)


def bucket(count: int, smallest: int | None = None, growth: int = 2) -> int:
    """Padded length for `count` rows: `smallest`, by default `SMALLEST_BUCKET`, times a power of `growth`."""
    size = SMALLEST_BUCKET if smallest is None else smallest
    while size < count:
        size *= growth
    return size


def padded(rows: Sequence[object] | ArrayLike, size: int, fill: ArrayLike = 0.0, dtype: type = np.float64) -> jax.Array:
    """Rows (n, ...) with as many like `fill` behind them as make `size`."""
    given: np.ndarray = np.asarray(rows, dtype)
    rest: np.ndarray = np.broadcast_to(np.asarray(fill, dtype), (size - len(given), *given.shape[1:]))
    return placed(np.concatenate([given, rest]))


def move_arrays(moves: Sequence[Move], size: int | None = None, powered_on_s: float | None = None) -> MoveArrays:
    """Pad the moves, by default to their `bucket`; padding repeats the last counters and therefore changes nothing.

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
    """Of spots, padded to this number, whose gears are taken not to vary."""
    none = padded(np.zeros((0, 0)), size)
    return GearArrays(Places(placed(np.zeros(0)), *2 * [placed(np.zeros(0, dtype=bool))]), none, none)


def gear_arrays(given: SeenPlaces, size: int) -> GearArrays:
    """Pad the places of looks.

    Args:
        given: from `seen_places`.
        size: padded number of spots.
    """
    places = place_arrays(given)
    wider = (0, 0), (0, len(places.steps) - len(given.steps))
    return GearArrays(places, *(padded(np.pad(share, wider), size) for share in (given.error_share, given.play_share)))


def pixel_covariance(spot: Spot | Sighting) -> np.ndarray:
    """Stated covariance of (u_left, v_left, u_right, v_right), px^2; of a sighting rad^2, 1 where it has none."""
    if isinstance(spot, Sighting):
        covariance = np.eye(4)
        covariance[SIGHTED, SIGHTED] = np.radians(spot.u_deg or 1.0) ** 2
        return covariance
    sd = np.array([spot.su_left_px, spot.sv_left_px, spot.su_right_px, spot.sv_right_px], dtype=float)
    covariance = np.diag(sd**2)
    covariance[0, 1] = covariance[1, 0] = spot.ruv_left * sd[0] * sd[1]
    covariance[2, 3] = covariance[3, 2] = spot.ruv_right * sd[2] * sd[3]
    return covariance


def campaign_arrays(campaign: Campaign, table: RigTable | None = None) -> CampaignArrays:
    """Pack a campaign for the jitted functions.

    Args:
        campaign: a checked campaign with at least one spot of status ok.
        table: the priors of the fit, by default those of the campaign; gears without repeating errors have no places.

    Returns:
        Arrays padded to `bucket` sizes.
    """
    spots = ordered_spots(campaign)
    size = bucket(len(spots))
    frames = tangent_frames(sighted_deg(sightings_of(spots))) if campaign.rig.mechanism.sightings else None
    pixels = pixels_of(spots) if frames is None else np.zeros((len(spots), 4))
    covariance = np.stack([pixel_covariance(s) for s in spots])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    looks = [s.move for s in spots]
    priors = campaign.rig if table is None else table
    new = redraws(campaign.moves, looks)
    places = seen_places(campaign.moves, looks, priors)
    gears = gear_arrays(places if gears_vary(priors) else places.none, size)
    aperture = [np.nan if s.aperture_deg is None else s.aperture_deg for s in spots]
    points_mm = triangulate(campaign.stereo, pixels) if frames is None else frames[:, 2]
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
        homed=padded(new.homed, size, False, bool),
        hours=padded(new.hours, size),
        tangents=None if frames is None else padded(frames[:, :2], size, np.eye(3)[1:]),
    )
    azimuth = placed(campaign.rig.aperture_convention == "azimuth")
    moves = move_arrays(campaign.moves, powered_on_s=powered_on_s(campaign.header))
    return CampaignArrays(moves, spot_arrays, gears, azimuth, placed(np.int32(len(spots))))


def components(rig: RigTable) -> int:
    """Independent residuals of a look besides the aperture's: four pixels less their range, or two angles."""
    return len(SIGHTED) if rig.mechanism.sightings else 3


def in_sight(campaign: Campaign) -> np.ndarray:
    """Whether each ordered spot has a triangulated point: one beyond the reach of the lens model has none."""
    if campaign.rig.mechanism.sightings:
        return np.ones(len(ordered_spots(campaign)), dtype=bool)
    return np.isfinite(triangulate(campaign.stereo, pixels_of(ordered_spots(campaign)))).all(axis=1)


def spot_constants(campaign: Campaign) -> np.ndarray:
    """Terms of each ordered spot's log likelihood that no parameter changes: 2 pi and its stated covariance."""
    constants = components(campaign.rig)
    return np.array(
        [
            -0.5
            * (
                (constants + (s.aperture_deg is not None)) * np.log(2 * np.pi)
                + np.linalg.slogdet(pixel_covariance(s))[1]
            )
            for s in ordered_spots(campaign)
        ]
    )

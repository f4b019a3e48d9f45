"""Ideal looks: pixels and aperture angle of spots, and their derivatives by mirror angles, range and points.

Angles rad, lengths mm, px. The range of a look is that at which its beam passes closest to the triangulated spot
(formulation 4.1). Components of looks are separate arrays, as vectors are (`instrument.mirrors.Vectors`).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tvsbayes.estimators.campaign_arrays import CampaignArrays, SpotArrays
from tvsbayes.instrument.mirrors import Ray, Turn, Vectors
from tvsbayes.model.compiled import compiled
from tvsbayes.model.geometry import image, materialise, rotation_matrix, transform
from tvsbayes.model.laser_path import MirrorAngles, angles_at, no_moves, trace
from tvsbayes.model.parameter_space import Extrinsics, Model, ParameterSpace, Receiver

WINDOW = 512
"""Spots for which a compiled function returns numbers by spot in one call."""
Numbers = tuple[Float[Array, "..."], ...]
"""Components of many looks, one array each: pixels (u_left, v_left, u_right, v_right) and the aperture's angle."""


def aperture_angle(
    receiver: Receiver, points_p_mm: Vectors, azimuth_convention: Bool[Array, ""]
) -> Float[Array, "*batch"]:
    """Compute angle B at the aperture between +y of frame T and the spot, or its projection on x-y (formulation 5)."""
    turned = Turn.by(receiver.pan_zero_emission_rad - jnp.pi / 2, jnp).forward(points_p_mm)
    lateral2 = turned.x**2 + jnp.where(azimuth_convention, 0.0, 1.0) * turned.z**2
    # A spot on the baseline has no direction; the floor keeps the derivative finite there.
    return jnp.arctan2(jnp.sqrt(jnp.maximum(lateral2, 1e-12)), turned.y + receiver.baseline_mm)


def observe(
    model: Model, pose: Float[Array, "3 *batch"], azimuth_convention: Bool[Array, ""]
) -> Float[Array, "5 *batch"]:
    """Compute the observations of ideal looks.

    Args:
        model: parameters.
        pose: first axis pan (rad), tilt (rad), range along the beam (mm).
        azimuth_convention: convention of the aperture's reading.

    Returns:
        First axis u_left, v_left, u_right, v_right (px), aperture reading (rad).
    """
    pan, tilt, range_mm = pose
    points_p = trace(model.optics, pan, tilt).at(range_mm)
    pixels = image(model.cameras, in_frame_s(model.extrinsics, points_p))
    return jnp.stack([*pixels, aperture_reading(model.receiver, points_p, azimuth_convention)])


def in_frame_s(extrinsics: Extrinsics, points_p_mm: Vectors) -> Vectors:
    """Transform points from frame P to frame S."""
    turned = transform(rotation_matrix(extrinsics.rotation_rad), points_p_mm)
    return turned + Vectors.of(extrinsics.translation_mm)


def aperture_reading(
    receiver: Receiver, points_p_mm: Vectors, azimuth_convention: Bool[Array, ""]
) -> Float[Array, "*batch"]:
    """Compute the aperture's readings of points, its zero included, rad."""
    return aperture_angle(receiver, points_p_mm, azimuth_convention) + receiver.aperture_zero_rad


def nearest_range(extrinsics: Extrinsics, ray: Ray, points_s_mm: Vectors) -> Float[Array, "*batch"]:
    """Compute the ranges at which beams pass closest to points of frame S, mm."""
    from_origin = points_s_mm - Vectors.of(extrinsics.translation_mm)
    points_p = transform(rotation_matrix(extrinsics.rotation_rad).T, from_origin)
    return (points_p - ray.origin_mm).dot(ray.direction)


def angles_seen(points_mm: Vectors, spots: SpotArrays) -> tuple[Float[Array, "..."], ...]:
    """Compute angles of points from the sighted directions along azimuth and elevation, in four columns.

    Angles are on the great circle, rad, so that poles and full turns need no special case.
    """
    assert spots.tangents is not None
    across, above = (points_mm.dot(Vectors.of(spots.tangents[:, k].T)) for k in range(2))
    along = points_mm.dot(Vectors.of(spots.triangulated_mm.T))
    square = across**2 + above**2
    # The ratio of the angle to its sine, by its series for small angles.
    small = square < 1e-8 * along**2
    off = jnp.sqrt(jnp.where(small, 1.0, square))
    stretch = jnp.where(small & (along > 0), 1 / along * (1 - square / along**2 / 3), jnp.arctan2(off, along) / off)
    none = jnp.zeros_like(across)
    return none, across * stretch, above * stretch, none


def seen(model: Model, points_s_mm: Vectors, spots: SpotArrays) -> tuple[Float[Array, "..."], ...]:
    """Compute the observations of points of frame S: pixels of a stereo pair, or angles on the sphere."""
    return image(model.cameras, points_s_mm) if spots.tangents is None else angles_seen(points_s_mm, spots)


class Looks(eqx.Module):
    """Ideal looks at the ranges where the beams pass closest to the triangulated points, and their derivatives.

    `by_pan`, `by_tilt` and `by_range` are the derivatives of `predicted`. `pixels_by_point` and `reading_by_point` are
    those of pixels and reading by the points in frames S and P.
    """

    pan_rad: Float[Array, " spots"]
    tilt_rad: Float[Array, " spots"]
    range_mm: Float[Array, " spots"]
    points_p_mm: Vectors
    points_s_mm: Vectors
    predicted: Numbers
    by_pan: Numbers
    by_tilt: Numbers
    by_range: Numbers
    pixels_by_point: tuple[Vectors, ...]
    reading_by_point: Vectors

    def moved(self, way_s_mm: Vectors, way_p_mm: Vectors) -> Numbers:
        """Compute the change of the predicted numbers for displacements of the points in both frames."""
        return moved(self.pixels_by_point, self.reading_by_point, way_s_mm, way_p_mm)


def moved(
    pixels_by_point: tuple[Vectors, ...], reading_by_point: Vectors, way_s_mm: Vectors, way_p_mm: Vectors
) -> Numbers:
    """Compute the change of pixels and reading for displacements of points in frames S and P."""
    return (*(by_point.dot(way_s_mm) for by_point in pixels_by_point), reading_by_point.dot(way_p_mm))


def looks_at(model: Model, pan_rad: Array, tilt_rad: Array, arrays: CampaignArrays) -> Looks:
    """Linearise every look in its mirror angles and its range (formulation 4.1)."""
    optics, extrinsics, receiver = model.optics, model.extrinsics, model.receiver
    triangulated = Vectors.of(arrays.spots.triangulated_mm.T)
    pan_rad, tilt_rad = materialise((pan_rad, tilt_rad))
    unit = jnp.ones_like(pan_rad)
    ray, by_pan = jax.jvp(lambda angle: trace(optics, angle, tilt_rad), (pan_rad,), (unit,))
    _, by_tilt = jax.jvp(lambda angle: trace(optics, pan_rad, angle), (tilt_rad,), (unit,))
    ray, by_pan, by_tilt = materialise((ray, by_pan, by_tilt))
    sightings = arrays.spots.tangents is not None
    range_mm = unit if sightings else materialise(nearest_range(extrinsics, ray, triangulated))
    points_p = ray.at(range_mm)
    # A direction has no range.
    along = ray.direction * 0.0 if sightings else ray.direction
    ways_p = by_pan.at(range_mm), by_tilt.at(range_mm), along
    turn = rotation_matrix(extrinsics.rotation_rad)
    points_s = in_frame_s(extrinsics, points_p)
    ways_s = [transform(turn, way) for way in ways_p]
    points_p, points_s, ways_p, ways_s = materialise((points_p, points_s, ways_p, ways_s))
    pixels, pixels_along = jax.linearize(lambda points: seen(model, points, arrays.spots), points_s)
    reading, reading_along = jax.linearize(
        lambda points: aperture_reading(receiver, points, arrays.azimuth_convention), points_p
    )
    none = jnp.zeros_like(unit)
    along_axes = Vectors(unit, none, none), Vectors(none, unit, none), Vectors(none, none, unit)
    columns = [(*pixels_along(axis), reading_along(axis)) for axis in along_axes]
    *by_point, reading_by_point = materialise([Vectors(*entries) for entries in zip(*columns, strict=True)])
    by_pan, by_tilt, by_range = (
        moved(tuple(by_point), reading_by_point, s, p) for s, p in zip(ways_s, ways_p, strict=True)
    )
    return Looks(
        pan_rad=pan_rad,
        tilt_rad=tilt_rad,
        range_mm=range_mm,
        points_p_mm=points_p,
        points_s_mm=points_s,
        predicted=(*pixels, reading),
        by_pan=by_pan,
        by_tilt=by_tilt,
        by_range=by_range,
        pixels_by_point=tuple(by_point),
        reading_by_point=reading_by_point,
    )


def spot_angles(model: Model, arrays: CampaignArrays) -> MirrorAngles:
    """Compute mirror angles at all spots, from the first move on."""
    index, begin = arrays.spots.move_index, no_moves(arrays.moves)
    return angles_at(model.transmission, model.tilt_zero_rad, arrays.moves, index, begin).angles


@compiled(jax.Array)
def _observed(
    values: Float[Array, "batch parameters"],
    turned_rad: Float[Array, "batch spots 2"],
    space: ParameterSpace,
    arrays: CampaignArrays,
    first: Int[Array, ""],
) -> Float[Array, "batch spots 5"]:
    part = arrays.of_spots(first, turned_rad.shape[1])

    def one(values, turned):
        model = space.model_at(values)
        pan, tilt = spot_angles(model, part).angle_rad.T + turned.T
        if part.spots.tangents is not None:
            angles_rad = angles_seen(trace(model.optics, pan, tilt).direction, part.spots)
            return jnp.stack([*angles_rad, jnp.zeros_like(pan)], axis=1)
        triangulated = Vectors.of(part.spots.triangulated_mm.T)
        ranges_mm = nearest_range(model.extrinsics, trace(model.optics, pan, tilt), triangulated)
        return observe(model, jnp.stack([pan, tilt, ranges_mm]), part.azimuth_convention).T

    return jax.vmap(one)(values, turned_rad)


def observe_with_stop_errors(
    z: np.ndarray, stop_error_rad: np.ndarray, space: ParameterSpace, arrays: CampaignArrays
) -> np.ndarray:
    """Compute noiseless looks at the ranges of the observed spots, the mirrors off by given angles (pan, tilt).

    Args:
        z: coordinates, shape (n, p).
        stop_error_rad: sum of stop error, home offset and position in the play, added to the mirror angles, rad, shape
            (n, spots, 2).
        space: priors.
        arrays: the campaign.

    Returns:
        u_left, v_left, u_right, v_right (px), aperture reading (rad), shape (n, spots, 5), without padding.
    """
    count, window, parts = int(arrays.count), min(WINDOW, len(arrays.spots.valid)), []
    values = space.values(z)
    for first in range(0, count, window):
        window_errors = stop_error_rad[:, first : min(first + window, count)]
        filled = np.zeros((len(z), window, 2))
        filled[:, : window_errors.shape[1]] = window_errors
        parts.append(np.asarray(_observed(values, filled, space, arrays, np.int32(first)))[:, : window_errors.shape[1]])
    return np.concatenate(parts, axis=1)

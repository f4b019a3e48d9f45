"""Paths of the laser in a rig, look by look: over all mirrors to the spot, in frame S, with its pixels.

Computed by the model (formulation 3), at the mode of a fit or at the centre of the priors. mm, rad, px.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from tvsbayes.errors import InputError
from tvsbayes.estimators.campaign_arrays import CampaignArrays
from tvsbayes.estimators.looks import WINDOW, in_frame_s, nearest_range, spot_angles
from tvsbayes.instrument.mirrors import Optics, Ray, Vectors, beam_path
from tvsbayes.model.compiled import compiled
from tvsbayes.model.geometry import image, materialise, rotation_matrix, transform
from tvsbayes.model.parameter_space import ParameterSpace


class Ways(eqx.Module):
    """Paths of the laser in frame S; the last axis of every array is the look, the one before x, y, z or the pixel.

    Attributes:
        origin_mm: origin of frame P, on the pan axis, shape (3, 1).
        mirrors_mm, normals: points where the laser meets the mirrors in order, and their unit normals.
        end_mm: end of the beam, its closest point to the triangulated spot.
        predicted_px: u_left, v_left, u_right, v_right of that end, shape (4, looks).
    """

    origin_mm: Float[Array, "3 1"]
    mirrors_mm: Float[Array, "mirrors 3 looks"]
    normals: Float[Array, "mirrors 3 looks"]
    end_mm: Float[Array, "3 looks"]
    predicted_px: Float[Array, "4 looks"]


@compiled(Ways)
def _window(
    z: Float[Array, " parameters"],
    turned_rad: Float[Array, "looks 2"],
    space: ParameterSpace,
    arrays: CampaignArrays,
    first: Int[Array, ""],
) -> Ways:
    model, arrays = space.model(z), arrays.of_spots(first, len(turned_rad))
    pan, tilt = spot_angles(model, arrays).angle_rad.T + turned_rad.T
    if not isinstance(model.optics, Optics):
        remedy = "`tvsbayes fit --details` has the terms of a head"
        raise InputError("usage", "view draws the mirrors of a scanner, and this is a pan-tilt head", remedy=remedy)
    way = beam_path(model.optics, pan, tilt, jnp, materialise)
    rays = [Ray(*map(way.pan.forward, ray)) for ray in way.rays]
    ray = rays[-1]
    reach = nearest_range(model.extrinsics, ray, Vectors.of(arrays.spots.triangulated_mm.T))
    end = in_frame_s(model.extrinsics, ray.at(reach))
    turn, none = rotation_matrix(model.extrinsics.rotation_rad), jnp.zeros(1)
    return Ways(
        origin_mm=in_frame_s(model.extrinsics, Vectors(none, none, none)).stacked(),
        mirrors_mm=jnp.stack([in_frame_s(model.extrinsics, ray.origin_mm).stacked() for ray in rays]),
        normals=jnp.stack([transform(turn, way.pan.forward(mirror.normal)).stacked() for mirror in way.mirrors]),
        end_mm=end.stacked(),
        predicted_px=jnp.stack(image(model.cameras, end)),
    )


def laser_ways(z: np.ndarray, turned_rad: np.ndarray, space: ParameterSpace, arrays: CampaignArrays) -> Ways:
    """Compute the paths of all looks of a campaign, as NumPy arrays.

    Args:
        z: coordinates, shape (p,).
        turned_rad: repeatable errors of the gears, added to the mirror angles (pan, tilt), shape (looks, 2).
        space: priors.
        arrays: the campaign.
    """
    count, size = len(turned_rad), min(WINDOW, len(arrays.spots.valid))
    filled = np.zeros((-(-count // size) * size, 2))
    filled[:count] = turned_rad
    parts = [_window(z, filled[k : k + size], space, arrays, np.int32(k)) for k in range(0, count, size)]
    joined = jax.tree.map(lambda *arrays_of: np.concatenate(arrays_of, axis=-1)[..., :count], *parts)
    return replace(joined, origin_mm=np.asarray(parts[0].origin_mm))

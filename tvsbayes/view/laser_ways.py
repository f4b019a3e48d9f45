"""Where the laser goes in a rig, look by look: over both mirrors and as far as the spot, in frame S, and its pixels.

By the model itself (formulation 3), at the mode of a fit or at the centre of the priors. mm, rad, px.
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
from tvsbayes.instrument.mirrors import Optics, Ray, Vectors
from tvsbayes.model.compiled import compiled
from tvsbayes.model.geometry import image, rotation_matrix, transform
from tvsbayes.model.laser_path import reflections
from tvsbayes.model.parameter_space import ParameterSpace


class Ways(eqx.Module):
    """Ways of the laser in frame S; the first axis of every array is x, y, z or the pixel, the second the look.

    Attributes:
        origin_mm: of frame P, on the pan axis, shape (3, 1).
        first_mm, first_normal: where it meets mirror 1, and that mirror's unit normal.
        second_mm, second_normal: the same of mirror 2.
        end_mm: of the beam, where it passes closest to the triangulated spot.
        predicted_px: u_left, v_left, u_right, v_right of that end, shape (4, looks).
    """

    origin_mm: Float[Array, "3 1"]
    first_mm: Float[Array, "3 looks"]
    first_normal: Float[Array, "3 looks"]
    second_mm: Float[Array, "3 looks"]
    second_normal: Float[Array, "3 looks"]
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
    met = reflections(model.optics, pan, tilt)
    ray = Ray(met.second_mm, met.outgoing)
    reach = nearest_range(model.extrinsics, ray, Vectors.of(arrays.spots.triangulated_mm.T))
    end = in_frame_s(model.extrinsics, ray.at(reach))
    turn, none = rotation_matrix(model.extrinsics.rotation_rad), jnp.zeros(1)
    return Ways(
        origin_mm=in_frame_s(model.extrinsics, Vectors(none, none, none)).stacked(),
        first_mm=in_frame_s(model.extrinsics, met.first_mm).stacked(),
        first_normal=transform(turn, met.first_normal).stacked(),
        second_mm=in_frame_s(model.extrinsics, met.second_mm).stacked(),
        second_normal=transform(turn, met.second_normal).stacked(),
        end_mm=end.stacked(),
        predicted_px=jnp.stack(image(model.cameras, end)),
    )


def laser_ways(z: np.ndarray, turned_rad: np.ndarray, space: ParameterSpace, arrays: CampaignArrays) -> Ways:
    """Ways of all looks of a campaign, as NumPy arrays.

    Args:
        z: coordinates, shape (p,).
        turned_rad: added to the mirror angles (pan, tilt), shape (looks, 2): what gears repeat by position.
        space: priors.
        arrays: the campaign.
    """
    count, size = len(turned_rad), min(WINDOW, len(arrays.spots.valid))
    filled = np.zeros((-(-count // size) * size, 2))
    filled[:count] = turned_rad
    parts = [_window(z, filled[k : k + size], space, arrays, np.int32(k)) for k in range(0, count, size)]
    joined = jax.tree.map(lambda *arrays_of: np.concatenate(arrays_of, axis=1)[:, :count], *parts)
    return replace(joined, origin_mm=np.asarray(parts[0].origin_mm))

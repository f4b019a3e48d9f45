"""Where the laser goes in a rig, look by look: over both mirrors and as far as the spot, in frame S, and its pixels.

By the model itself (formulation 3), at the mode of a fit or at the centre of the priors. mm, rad, px.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from tvsbayes.errors import InputError
from tvsbayes.estimators.campaign_arrays import CampaignArrays
from tvsbayes.estimators.looks import in_frame_s, nearest_range
from tvsbayes.instrument.mirrors import Optics, Ray, Vectors
from tvsbayes.model.compiled import compiled
from tvsbayes.model.geometry import image, rotation_matrix, transform
from tvsbayes.model.laser_path import mirror_angles, reflections
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
def laser_ways(
    z: Float[Array, " parameters"], turned_rad: Float[Array, "looks 2"], space: ParameterSpace, arrays: CampaignArrays
) -> Ways:
    """Ways of all looks of a campaign, padding included.

    Args:
        z: coordinates.
        turned_rad: added to the mirror angles (pan, tilt): what gears repeat by position.
        space: priors.
        arrays: the campaign.
    """
    model = space.model(z)
    angles = mirror_angles(model.transmission, model.tilt_zero_rad, arrays.moves)
    pan, tilt = angles.angle_rad[arrays.spots.move_index].T + turned_rad.T
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

"""Derivatives of ideal looks by all coordinates at fixed ranges, block by block.

A gear changes looks through their mirror angles only, a mirror through the point that is hit, a lens through its own
two pixels: derivatives of the parts, chained, cost a fraction of those of the whole. Angles rad, px; derivatives are by
the coordinates of `model.parameter_space`. Columns come first, spots last.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from tvsbayes.estimators.campaign_arrays import CampaignArrays
from tvsbayes.estimators.looks import Looks, Numbers, aperture_reading, in_frame_s, seen, spot_angles
from tvsbayes.instrument.mechanisms import Mechanism
from tvsbayes.instrument.parameters import NOISE_NAMES, STEREO_PARAMETER_NAMES
from tvsbayes.model.geometry import materialise, rotation_matrix, transform
from tvsbayes.model.laser_path import trace
from tvsbayes.model.parameter_space import Model, ParameterSpace, Point

GEARS = (
    *("degrees_per_step", "ratio_contrast_deg_per_step", "backlash_deg", "harmonic_deg"),
    *("creep_deg", "creep_minutes", "thermal_deg_per_K"),
)
FRAMES = ("extrinsics.rotation_rad", "extrinsics.translation_mm")
RECEIVER = ("baseline_mm", "pan_zero_emission_deg", "aperture_zero_deg")


def _groups(mechanism: Mechanism) -> tuple[np.ndarray, ...]:
    """Group an instrument's coordinates by the part of a look that they act in.

    Returns:
        Coordinates of gears, optics, frames, cameras and receiver, and of scales of noise, which act in none.
    """
    gears, cameras = (*GEARS, mechanism.tilt_zero), ("focal_scale", *STEREO_PARAMETER_NAMES)
    parts = gears, mechanism.optics_names, FRAMES, cameras, RECEIVER, NOISE_NAMES
    return tuple(mechanism.columns(*names) for names in parts)


def look_jacobian(at: Point, space: ParameterSpace, looks: Looks, arrays: CampaignArrays) -> Numbers:
    """Compute d(predicted)/d(coordinates) at fixed ranges, shape (parameters, spots) for each of five components.

    Args:
        at: coordinates and their values.
        space: priors.
        looks: ideal looks at these coordinates.
        arrays: the campaign.
    """
    gears, optics, frames, cameras, receiver, noise = groups = _groups(space.mechanism)

    def moved(columns: np.ndarray, part: Callable[[Model], PyTree]) -> PyTree:
        """Differentiate a part of the model by some parameters in the units of their names, columns first."""

        def along(direction: Float[Array, " parameters"]) -> PyTree:
            return jax.jvp(lambda values: part(space.model_at(values)), (jnp.asarray(at.values),), (direction,))[1]

        return materialise(jax.vmap(along)(jnp.asarray(np.eye(space.size)[columns])))

    turn = rotation_matrix(space.model_at(jnp.asarray(at.values)).extrinsics.rotation_rad)
    pan, tilt = jnp.moveaxis(moved(gears, lambda m: spot_angles(m, arrays).angle_rad), 2, 0)
    ways_p = moved(optics, lambda m: trace(m.optics, looks.pan_rad, looks.tilt_rad)).at(looks.range_mm)
    ways_s = moved(frames, lambda m: in_frame_s(m.extrinsics, looks.points_p_mm))
    pixels = moved(cameras, lambda m: seen(m, looks.points_s_mm, arrays.spots))
    reading = moved(receiver, lambda m: aperture_reading(m.receiver, looks.points_p_mm, arrays.azimuth_convention))

    by_gears = tuple(p * pan + t * tilt for p, t in zip(looks.by_pan, looks.by_tilt, strict=True))
    by_optics = looks.moved(transform(turn, ways_p), ways_p)
    by_frames = tuple(by_point.dot(ways_s) for by_point in looks.pixels_by_point)
    spots = looks.range_mm.shape
    still = [jnp.zeros((len(columns), *spots)) for columns in (noise, frames, cameras, receiver)]
    blocks = [[by_gears[k], by_optics[k], by_frames[k], pixels[k], still[3], still[0]] for k in range(4)] + [
        [by_gears[4], by_optics[4], still[1], still[2], reading, still[0]]
    ]
    in_order = np.argsort(np.concatenate(groups))
    slope = at.slopes[:, None]

    def by_coordinates(by_values: Float[Array, "parameters spots"]) -> Float[Array, "parameters spots"]:
        # Every value of the rig has its own coordinate; the cameras' values share theirs.
        return jnp.concatenate([by_values[: space.rig] * slope, space.stereo_root.T @ by_values[space.rig :]])

    return tuple(by_coordinates(jnp.concatenate(own)[in_order]) for own in blocks)

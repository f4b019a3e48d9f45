"""Headlines of a point of parameter space at a pose: effective ratios, contrasts, backlash, mirror offset.

deg/step of the beam's azimuth and elevation in frame P; deg; mm. The pose is the pair of mirror angles (pan, tilt),
rad. With derivatives by the coordinates for planning, or for many points at once for draws.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.model.compiled import compiled
from tvsbayes.model.geometry import Scalar
from tvsbayes.model.laser_path import BeamAngles, Transmission, beam_angles
from tvsbayes.model.parameter_space import ParameterSpace

QUANTITIES = (*DIRECTIONS, *(f"{kind}.{axis}" for kind in ("contrast", "backlash") for axis in AXES), "mirror_offset")
"""Headlines in the order of `headlines`: effective deg/step, their differences, lost motion (deg), offset (mm)."""


class Headlines(eqx.Module):
    """Values of `QUANTITIES` and d/d(coordinates)."""

    value: Float[Array, " quantities"]
    gradient: Float[Array, "quantities parameters"]


DEGREES = 180 / np.pi


def effective_deg_per_step(gears: Transmission, angles: BeamAngles) -> Float[Array, "4"]:
    """Gear ratio of each direction times the slope of the mirrors at the pose of `angles`, ordered as `DIRECTIONS`."""
    ratio, half = gears.ratio_rad_per_step, 0.5 * gears.contrast_rad_per_step
    slope = jnp.diagonal(angles.jacobian)
    return jnp.stack([(ratio + half) * slope, (ratio - half) * slope], axis=1).ravel() * DEGREES


@compiled(Headlines)
def headlines(z: Float[Array, " parameters"], space: ParameterSpace, pose_rad: Float[Array, "2"]) -> Headlines:
    """Headlines at one pose (formulation 3.2) with their derivatives."""

    def values(z):
        model = space.model(z)
        angles = beam_angles(model.optics, pose_rad[0], pose_rad[1])
        gears = model.transmission
        effective = effective_deg_per_step(gears, angles)
        contrast = gears.contrast_rad_per_step * jnp.diagonal(angles.jacobian) * DEGREES
        lost = gears.backlash_rad * DEGREES
        return jnp.concatenate([effective, contrast, lost, angles.effective_mirror_offset_mm[None]])

    return Headlines(values(z), jax.jacfwd(values)(z))


class Derived(eqx.Module):
    """Headlines at one pose for one point of parameter space, in the units of data/docs/conventions.md.

    `effective_deg_per_step` is ordered left, right, up, down: gear ratio times the slope of the mirrors, the mean over
    a period of the transmission error, without its local slope. `jacobian` is d(azimuth, elevation)/d(pan, tilt).
    """

    physical: Float[Array, " parameters"]
    effective_deg_per_step: Float[Array, "4"]
    jacobian: Float[Array, "2 2"]
    effective_mirror_offset_mm: Scalar


@compiled(Derived)
def derived_quantities(
    z: Float[Array, "draws parameters"], space: ParameterSpace, reference_pose_rad: Float[Array, "2"]
) -> Derived:
    """Headlines of many points at once (formulation 3.2); every field has the leading axis `draws`."""

    def one(z):
        physical = space.physical(z)
        model = space.model(z)
        angles = beam_angles(model.optics, reference_pose_rad[0], reference_pose_rad[1])
        effective = effective_deg_per_step(model.transmission, angles)
        return Derived(physical, effective, angles.jacobian, angles.effective_mirror_offset_mm)

    return jax.vmap(one)(z)

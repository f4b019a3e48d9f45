"""Headlines of a point of parameter space at a pose: effective ratios, contrasts, backlash, mirror offset.

deg/step of the beam's azimuth and elevation in frame P; deg; mm. The pose is the pair of mirror angles (pan, tilt),
rad. With derivatives by the coordinates for planning, or for many points at once for draws.
"""

from __future__ import annotations

from collections.abc import Collection

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.parameters import INDEX
from tvsbayes.model.compiled import compiled
from tvsbayes.model.gear_processes import Places, errors_at
from tvsbayes.model.geometry import Scalar, materialise
from tvsbayes.model.laser_path import BeamAngles, Transmission, beam_angles, trace
from tvsbayes.model.parameter_space import Model, ParameterSpace, model_of

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


class SeenLine(eqx.Module):
    """Where a campaign's looks stand on the counters of both axes: what its headlines are the slopes over.

    Attributes:
        pose_rad: mean mirror angles (pan, tilt) over the looks used.
        places: counters.
        share: of the value at each place in the slope of the least-squares line through the looks of its axis,
            steps^-1.
    """

    pose_rad: Float[Array | np.ndarray, "2"]
    places: Places
    share: Float[Array | np.ndarray, " places"]


class Derived(eqx.Module):
    """Headlines of one point of parameter space, in the units of data/docs/conventions.md.

    Ratios are ordered left, right, up, down. `effective_deg_per_step` are slopes of the lines through the looks,
    transmission error included; `local_deg_per_step` gear ratio times the slope of the mirrors at the reference pose,
    without it. `jacobian` is d(azimuth, elevation)/d(pan, tilt) there. `place_errors_rad`: transmission errors, then
    plays, at the places; empty where gears do not vary.
    """

    physical: Float[Array, " parameters"]
    effective_deg_per_step: Float[Array, "4"]
    local_deg_per_step: Float[Array, "4"]
    jacobian: Float[Array, "2 2"]
    effective_mirror_offset_mm: Scalar
    place_errors_rad: Float[Array, " errors"]


def line_deg_per_step(
    model: Model, seen: SeenLine, place_errors_rad: Float[Array, " errors"], mirrors: BeamAngles
) -> Float[Array, "4"]:
    """Slopes of the beam's azimuth and elevation over the counters seen, by direction (formulation 3.2).

    Through one counter there is no line: the slope is then that of `mirrors`, at the reference pose.
    """
    gears, places = model.transmission, seen.places
    zero = jnp.stack([jnp.zeros(()), model.tilt_zero_rad])
    counted = places.by_axis(gears.ratio_rad_per_step) * places.steps
    # No play, no stop error, no drift: nothing but what the counter itself says.
    shaped = gears.harmonics.error_rad(jnp.stack([counted, counted], axis=1))
    error = jnp.where(places.on_tilt, shaped[:, 1], shaped[:, 0])
    count = len(place_errors_rad) // 2
    # Both lists of places begin alike; padding ends them.
    error = error + jnp.pad(place_errors_rad[:count], (0, max(len(error) - count, 0)))[: len(error)]

    def slope(turned: Float[Array, " places"]) -> Float[Array, "2"]:
        pan = jnp.where(places.on_tilt, seen.pose_rad[0], turned)
        tilt = jnp.where(places.on_tilt, turned, seen.pose_rad[1])
        beam = trace(model.optics, pan, tilt).direction
        azimuth, elevation = jnp.arctan2(beam.y, beam.x), jnp.arctan2(beam.z, jnp.hypot(beam.x, beam.y))
        # The beam turns with the mirrors but for degrees: the rest tells on which turn it is.
        rest = jnp.where(places.on_tilt, elevation, azimuth) - turned
        parts = seen.share * (turned + rest - jnp.round(rest / (2 * jnp.pi)) * (2 * jnp.pi))
        return jnp.sum(jnp.where(own, parts, 0.0), axis=1)

    own = jnp.stack([~places.on_tilt, places.on_tilt])
    lined, local = jnp.any(own & (seen.share != 0), axis=1), jnp.diagonal(mirrors.jacobian)
    ideal = counted + places.by_axis(zero)
    whole = jnp.where(lined, slope(ideal + error), gears.ratio_rad_per_step * local)
    of_mirrors = jnp.where(lined, slope(ideal) / gears.ratio_rad_per_step, local)
    half = 0.5 * gears.contrast_rad_per_step * of_mirrors
    return jnp.stack([whole + half, whole - half], axis=1).ravel() * DEGREES


@compiled(Derived)
def _derived(
    z: Float[Array, "draws parameters"],
    place_errors_rad: Float[Array, "draws errors"],
    space: ParameterSpace,
    seen: SeenLine,
) -> Derived:
    def one(z, errors):
        physical = materialise(space.physical(z))
        model = model_of(physical, space.harmonic_period_deg)
        angles = beam_angles(model.optics, seen.pose_rad[0], seen.pose_rad[1])
        return Derived(
            physical,
            line_deg_per_step(model, seen, errors, angles),
            effective_deg_per_step(model.transmission, angles),
            angles.jacobian,
            angles.effective_mirror_offset_mm,
            errors,
        )

    return jax.vmap(one)(z, place_errors_rad)


def derived_quantities(z: np.ndarray, place_errors_rad: np.ndarray, space: ParameterSpace, seen: SeenLine) -> Derived:
    """Headlines of many points at once (formulation 3.2), as NumPy arrays; every field has the leading axis `draws`.

    Args:
        z: coordinates, shape (draws, p).
        place_errors_rad: transmission errors, then plays, at the first of the places, shape (draws, e).
        space: priors.
        seen: lines.
    """
    given = np.asarray(place_errors_rad)
    found = _derived(z, errors_at(given, max(len(seen.places.steps), given.shape[1] // 2)), space, seen)
    return eqx.tree_at(lambda of: of.place_errors_rad, jax.tree.map(np.asarray, found), given)


def told_of(centre: Derived, draws: Derived, moved: Collection[str]) -> list[tuple[str, float, float]]:
    """Name with unit, value and sd of what a fit is for, of the directions that moved.

    Args:
        centre: of one set of parameters, fields without leading axis.
        draws: fields with one leading axis.
        moved: directions.
    """
    effective, physical = np.asarray(draws.effective_deg_per_step), np.asarray(draws.physical)
    rows = [
        (f"effective {name}, deg/step", float(centre.effective_deg_per_step[k]), float(effective[:, k].std()))
        for k, name in enumerate(DIRECTIONS)
        if name in moved
    ]
    for axis in AXES:
        k = INDEX[f"backlash_deg.{axis}"]
        rows.append((f"backlash {axis}, deg", float(centre.physical[k]), float(physical[:, k].std())))
    offset = float(np.asarray(draws.effective_mirror_offset_mm).std())
    return [*rows, ("effective mirror offset, mm", float(centre.effective_mirror_offset_mm), offset)]

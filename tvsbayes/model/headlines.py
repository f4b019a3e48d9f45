"""Formulas of the quantities of `instrument/parameters` at a point of parameter space and a pose.

deg/step of the beam's azimuth and elevation in frame P; deg; mm. The pose is the pair of mirror angles (pan, tilt),
rad. Planning uses derivatives by the coordinates, draws use many points at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.instrument.mechanisms import MECHANISMS
from tvsbayes.instrument.parameters import BLOCKS, QUANTITIES, REGISTRY, TARGETS
from tvsbayes.instrument.quantities import Quantity
from tvsbayes.model.compiled import compiled
from tvsbayes.model.gear_processes import Places, errors_at
from tvsbayes.model.laser_path import BeamAngles, Transmission, beam_angles, trace
from tvsbayes.model.parameter_space import Model, ParameterSpace

DEGREES = 180 / np.pi


class Headlines(eqx.Module):
    """Values of `TARGETS` and their derivatives by the coordinates."""

    value: Float[Array, " targets"]
    gradient: Float[Array, "targets parameters"]


class AtPose(eqx.Module):
    """A point of parameter space and a pose of the mirrors, the argument of `FORMULAS`.

    Attributes:
        model: gears, mirrors, cameras.
        mirrors: the beam at the pose.
        effective: effective ratios by direction, deg/step: slopes of the lines through the looks, or those at the pose.
    """

    model: Model
    mirrors: BeamAngles
    effective: Float[Array, "4"]


def effective_deg_per_step(gears: Transmission, angles: BeamAngles) -> Float[Array, "4"]:
    """Compute each direction's gear ratio times the slope of the mirrors at the pose, ordered as `DIRECTIONS`."""
    ratio, half = gears.ratio_rad_per_step, 0.5 * gears.contrast_rad_per_step
    slope = jnp.diagonal(angles.jacobian)
    return jnp.stack([(ratio + half) * slope, (ratio - half) * slope], axis=1).ravel() * DEGREES


def _contrast(at: AtPose) -> Array:
    """Compute the contrast from its own parameters: where the prior fixes it, it must not vary even by rounding."""
    gears = at.model.transmission
    return gears.contrast_rad_per_step / gears.ratio_rad_per_step * (at.effective[::2] + at.effective[1::2]) / 2


FORMULAS: dict[str, Callable[[AtPose], Array]] = {
    "effective_deg_per_step": lambda at: at.effective,
    "local_deg_per_step": lambda at: effective_deg_per_step(at.model.transmission, at.mirrors),
    "effective_contrast_deg_per_step": _contrast,
    "backlash_deg": lambda at: at.model.transmission.backlash_rad * DEGREES,
    "effective_mirror_offset_mm": lambda at: at.mirrors.effective_mirror_offset_mm,
}
"""Formulas for the values of all quantities of a block."""


def values_of(at: AtPose, blocks: Iterable[str]) -> Float[Array, " quantities"]:
    """Compute the values of quantities block by block."""
    return jnp.concatenate([jnp.ravel(FORMULAS[block](at)) for block in blocks])


def target_values(at: AtPose) -> Float[Array, " targets"]:
    """Compute the values of `TARGETS`, in their order."""
    return values_of(at, dict.fromkeys(quantity.block for quantity in TARGETS.values()))


@compiled(Headlines)
def headlines(z: Float[Array, " parameters"], space: ParameterSpace, pose_rad: Float[Array, "2"]) -> Headlines:
    """Compute headlines at one pose (formulation 3.2) and their derivatives."""

    def values(z):
        model = space.model(z)
        angles = beam_angles(model.optics, pose_rad[0], pose_rad[1])
        return target_values(AtPose(model, angles, effective_deg_per_step(model.transmission, angles)))

    return Headlines(values(z), jax.jacfwd(values)(z))


class SeenLine(eqx.Module):
    """Counters of a campaign's looks on both axes, over which its headlines are slopes.

    Attributes:
        pose_rad: mean mirror angles (pan, tilt) over the looks used.
        places: counters.
        share: weight of the value at each place in the slope of the least-squares line through the looks of its axis,
            steps^-1.
    """

    pose_rad: Float[Array | np.ndarray, "2"]
    places: Places
    share: Float[Array | np.ndarray, " places"]


def _by_direction(of: Derived, quantity: Quantity) -> np.ndarray:
    ratio, contrast = of[f"degrees_per_step.{quantity.axis}"], of[f"ratio_contrast_deg_per_step.{quantity.axis}"]
    half = 0.5 if quantity.parts[0] == quantity.sides[0] else -0.5
    return np.asarray(ratio + half * contrast)


def _difference(of: Derived, quantity: Quantity) -> np.ndarray:
    first, second = (of[f"effective_deg_per_step.{direction}"] for direction in quantity.sides)
    return np.asarray(first - second)


COMBINED: dict[str, Callable[[Derived, Quantity], np.ndarray]] = {
    "degrees_per_step": _by_direction,
    "effective_contrast_deg_per_step": _difference,
}
"""Formulas of blocks whose quantities follow from others."""
_MODELLED_BLOCKS = tuple(block for block in FORMULAS if block not in COMBINED and block not in BLOCKS)
MODELLED = {name: k for k, name in enumerate(name for block in _MODELLED_BLOCKS for name in QUANTITIES.blocks[block])}
"""Columns of quantities that are neither parameters nor follow from others."""
DERIVED = tuple(
    name for name, of in QUANTITIES.items() if name not in REGISTRY and (name in MODELLED or of.block in COMBINED)
)
"""All quantities with draws except parameters."""


class Derived(eqx.Module):
    """Quantities at points of parameter space by name, in the units of data/docs/conventions.md.

    Attributes:
        physical: values of the parameters of the instrument `key`.
        modelled: quantities of the model at the reference pose, by the columns `MODELLED`.
        jacobian: d(azimuth, elevation)/d(pan, tilt) there.
        place_errors_rad: transmission errors, then plays, at the places; empty where gears have no errors by position.
    """

    physical: Float[Array | np.ndarray, "*draws parameters"]
    modelled: Float[Array | np.ndarray, "*draws modelled"]
    jacobian: Float[Array | np.ndarray, "*draws 2 2"]
    place_errors_rad: Float[Array | np.ndarray, "*draws errors"]
    key: str = eqx.field(static=True)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a parameter or one of `DERIVED`, with the leading axes of the fields."""
        mechanism, physical = MECHANISMS[self.key], np.asarray(self.physical)
        if name in mechanism.index:
            return physical[..., mechanism.index[name]]
        if name in mechanism.constants:
            return np.full(physical.shape[:-1], mechanism.constants[name])
        if name in MODELLED:
            return np.asarray(self.modelled)[..., MODELLED[name]]
        quantity = QUANTITIES[name]
        return COMBINED[quantity.block](self, quantity)

    def block(self, name: str) -> np.ndarray:
        """Return all quantities of a block, along the last axis."""
        return np.stack([self[each] for each in QUANTITIES.blocks[name]], axis=-1)

    @property
    def effective_deg_per_step(self) -> np.ndarray:
        """Return the slopes of the lines through the looks by direction, transmission error included."""
        return self.block("effective_deg_per_step")

    @property
    def local_deg_per_step(self) -> np.ndarray:
        """Return gear ratio times mirror slope at the reference pose by direction, without transmission error."""
        return self.block("local_deg_per_step")


def line_deg_per_step(
    model: Model, seen: SeenLine, place_errors_rad: Float[Array, " errors"], mirrors: BeamAngles
) -> Float[Array, "4"]:
    """Compute slopes of the beam's azimuth and elevation over the counters seen, by direction (formulation 3.2).

    With one counter only, the slope is that of `mirrors` at the reference pose.
    """
    gears, places = model.transmission, seen.places
    zero = jnp.stack([jnp.zeros(()), model.tilt_zero_rad])
    counted = places.by_axis(gears.ratio_rad_per_step) * places.steps
    # Play, stop error and drift are left out: the angle is a function of the counter alone.
    shaped = gears.harmonics.error_rad(jnp.stack([counted, counted], axis=1))
    error = jnp.where(places.on_tilt, shaped[:, 1], shaped[:, 0])
    count = len(place_errors_rad) // 2
    # Both lists of places start equally and end with padding.
    error = error + jnp.pad(place_errors_rad[:count], (0, max(len(error) - count, 0)))[: len(error)]

    def slope(turned: Float[Array, " places"]) -> Float[Array, "2"]:
        pan = jnp.where(places.on_tilt, seen.pose_rad[0], turned)
        tilt = jnp.where(places.on_tilt, turned, seen.pose_rad[1])
        beam = trace(model.optics, pan, tilt).direction
        azimuth, elevation = jnp.arctan2(beam.y, beam.x), jnp.arctan2(beam.z, jnp.hypot(beam.x, beam.y))
        # Beyond the zenith the elevation continues past 90 deg.
        beyond = jnp.cos(jnp.pi - elevation - turned) > jnp.cos(elevation - turned)
        elevation = jnp.where(beyond, jnp.pi - elevation, elevation)
        rest = jnp.where(places.on_tilt, elevation, azimuth) - turned
        # The beam follows the mirrors to within degrees and a constant; the mean difference fixes the turn.
        sine, cosine = (jnp.sum(jnp.where(used, part(rest), 0.0), axis=1) for part in (jnp.sin, jnp.cos))
        turns = jnp.round((rest - places.by_axis(jnp.arctan2(sine, cosine))) / (2 * jnp.pi))
        parts = seen.share * (turned + rest - turns * (2 * jnp.pi))
        return jnp.sum(jnp.where(on_axis, parts, 0.0), axis=1)

    on_axis = jnp.stack([~places.on_tilt, places.on_tilt])
    used = on_axis & (seen.share != 0)
    lined, local = jnp.any(used, axis=1), jnp.diagonal(mirrors.jacobian)
    ideal = counted + places.by_axis(zero)
    whole = jnp.where(lined, slope(ideal + error), gears.ratio_rad_per_step * local)
    of_mirrors = jnp.where(lined, slope(ideal) / gears.ratio_rad_per_step, local)
    half = 0.5 * gears.contrast_rad_per_step * of_mirrors
    return jnp.stack([whole + half, whole - half], axis=1).ravel() * DEGREES


class _Modelled(eqx.Module):
    """The fields of `Derived` that the model computes."""

    modelled: Float[Array, "*draws modelled"]
    jacobian: Float[Array, "*draws 2 2"]


@compiled(_Modelled)
def _modelled(
    values: Float[Array, "draws parameters"],
    place_errors_rad: Float[Array, "draws errors"],
    space: ParameterSpace,
    seen: SeenLine,
) -> _Modelled:
    def one(values, errors):
        model = space.model_at(values)
        angles = beam_angles(model.optics, seen.pose_rad[0], seen.pose_rad[1])
        at = AtPose(model, angles, line_deg_per_step(model, seen, errors, angles))
        return _Modelled(values_of(at, _MODELLED_BLOCKS), angles.jacobian)

    return jax.vmap(one)(values, place_errors_rad)


def derived_quantities(
    z: Float[Array | np.ndarray, "draws parameters"],
    place_errors_rad: Float[Array | np.ndarray, "draws errors"],
    space: ParameterSpace,
    seen: SeenLine,
) -> Derived:
    """Compute headlines of many points (formulation 3.2) as NumPy arrays; every field has the leading axis `draws`.

    Args:
        z: coordinates, shape (draws, p).
        place_errors_rad: transmission errors, then plays, at the first of the places, shape (draws, e).
        space: space of the parameters.
        seen: counters of the looks.
    """
    given, values = np.asarray(place_errors_rad), space.values(z)
    modelled = _modelled(values, errors_at(given, max(len(seen.places.steps), given.shape[1] // 2)), space, seen)
    return Derived(values, np.asarray(modelled.modelled), np.asarray(modelled.jacobian), given, space.key)

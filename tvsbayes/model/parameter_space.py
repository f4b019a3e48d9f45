"""Coordinates with standard normal priors, and the model at a point of them.

Every parameter of an instrument has a coordinate z with prior N(0, 1) (`gears.priors`); the stereo parameters are mean
+ root z with root root^T their full covariance. As u = 0 fixes a parameter whatever its z, one compiled function serves
every choice of fixed parameters. Physical values have the units of their names.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tvsbayes.gears.priors import FARTHEST_SD, half_normal, half_normal_coordinate, half_normal_slope, values_at
from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG
from tvsbayes.instrument.chains import Chain, chain_of
from tvsbayes.instrument.mechanisms import MECHANISMS, TWO_MIRROR, Mechanism
from tvsbayes.instrument.parameters import BLOCKS, KINDS, PERIODS_MAX, RECEIVER_NAMES
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.stereo_pair import Stereo, stereo_covariance, stereo_parameters
from tvsbayes.model.compiled import placed
from tvsbayes.model.gear_processes import GearScales
from tvsbayes.model.geometry import Scalar, StereoCameras, Vector, materialise
from tvsbayes.model.laser_path import Harmonics, Transmission, ZeroShift

NO_PERIOD_DEG = np.full((2, PERIODS_MAX), FULL_TURN_DEG)
"""Replaces periods of transmission errors that are not stated; it has no effect, since those errors are 0."""


class Extrinsics(eqx.Module):
    """T_SP: frame P to frame S, p_S = R(rotation) p_P + translation."""

    rotation_rad: Vector
    translation_mm: Vector


class Receiver(eqx.Module):
    """The rotating aperture: baseline a, emission angle C0 at pan angle 0, zero and sd of its readings."""

    baseline_mm: Scalar
    pan_zero_emission_rad: Scalar
    aperture_zero_rad: Scalar
    aperture_sd_rad: Scalar


class Noise(eqx.Module):
    """Standard deviations of stops by [axis, (right/down, left/up)] and of looks by axis; factor on the pixel sds."""

    stop_sd_rad: Float[Array, "2 2"]
    look_scatter_rad: Float[Array, "2"]
    pixel_scale: Scalar
    home_sd_rad: Float[Array, "2"]


class Model(eqx.Module):
    """Everything that the forward model and the likelihood need, in rad and mm."""

    transmission: Transmission
    optics: Chain
    tilt_zero_rad: Scalar
    extrinsics: Extrinsics
    cameras: StereoCameras
    receiver: Receiver
    noise: Noise
    gears: GearScales


@jax.custom_jvp
def _half_normal(z: Float[Array, " n"]) -> Float[Array, " n"]:
    """Compute `half_normal` in JAX, with a derivative from its value, a tenth of the code of JAX's own."""
    return half_normal(z, jax.scipy.special)


@_half_normal.defjvp
def _half_normal_along(
    at: tuple[Float[Array, " n"]], along: tuple[Float[Array, " n"]]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    value = _half_normal(at[0])
    return value, half_normal_slope(at[0], value, jnp) * along[0]


class Point(eqx.Module):
    """A point: coordinates, values in the units of their names, and d(value)/d(coordinate) of the rig's parameters."""

    z: Float[Array | np.ndarray, " parameters"]
    values: Float[Array | np.ndarray, " parameters"]
    slopes: Float[Array | np.ndarray, " rig"]


class ParameterSpace(eqx.Module):
    """Priors of one rig as arrays; an argument of the jitted functions, never a constant in them.

    `harmonic_period_deg` holds the periods of the transmission errors of (pan, tilt), those of `NO_PERIOD_DEG` where
    not stated. `key` is the mechanism's key in `MECHANISMS`.
    """

    value: Float[Array, " rig"]
    u: Float[Array, " rig"]
    kind: Int[Array, " rig"]
    stereo_mean: Float[Array, " cameras"]
    stereo_root: Float[Array, "cameras cameras"]
    harmonic_period_deg: Float[Array, "2 3"]
    key: str = eqx.field(static=True, default=TWO_MIRROR.key)

    @property
    def mechanism(self) -> Mechanism:
        """Return the mechanism whose parameters these are."""
        return MECHANISMS[self.key]

    @property
    def size(self) -> int:
        """Return the number of coordinates."""
        return len(self.mechanism.names)

    @property
    def rig(self) -> int:
        """Return the number of coordinates with a prior in `[rig]`, which come first."""
        return self.value.shape[-1]

    def physical(self, z: Float[Array, " parameters"]) -> Float[Array, " parameters"]:
        """Convert coordinates to values in the units of their names."""
        return _values(self, z, jnp, _half_normal)

    def values(self, z: Float[Array | np.ndarray, "*points parameters"]) -> np.ndarray:
        """Compute `physical` of many points (..., p), in NumPy."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(_values(jax.tree.map(np.asarray, self), np.asarray(z), np, half_normal))

    def point(self, z: Float[Array, " parameters"]) -> Point:
        """Compute the point at these coordinates."""
        values = materialise(self.physical(z))
        return Point(z, values, _slopes(self, z, values, jnp))

    def known_point(self, z: np.ndarray) -> Point:
        """Compute `point` in NumPy."""
        known, values = jax.tree.map(np.asarray, self), self.values(z)
        with np.errstate(over="ignore", invalid="ignore"):
            return Point(z, values, np.asarray(_slopes(known, z, values, np)))

    def model(self, z: Float[Array, " parameters"]) -> Model:
        """Compute the model at these coordinates."""
        return self.model_at(materialise(self.physical(z)))

    def model_at(self, physical: Float[Array, " parameters"]) -> Model:
        """Compute the model at these values, in the units of their names."""
        return model_of(physical, self.harmonic_period_deg, self.mechanism)


def _values(space: ParameterSpace, z: Any, functions: ModuleType, half_normal: Callable[[Any], Any]) -> Any:
    """Convert coordinates to values in the units of their names, by functions of JAX or NumPy."""
    rig_z, stereo_z = z[..., : space.rig], z[..., space.rig :]
    half, log = (space.kind == KINDS.index(kind) for kind in ("half-normal", "log-normal"))
    rig = values_at(rig_z, space.value, space.u, half, log, functions, half_normal)
    return functions.concatenate([rig, space.stereo_mean + stereo_z @ space.stereo_root.T], axis=-1)


def _slopes(space: ParameterSpace, z: Any, values: Any, functions: ModuleType) -> Any:
    """Compute the slopes of the rig's part of `_values`, where every value has its own coordinate."""
    rig_z, own = z[: space.rig], values[: space.rig]
    half, log = (space.kind == KINDS.index(kind) for kind in ("half-normal", "log-normal"))
    bent = half & (rig_z < FARTHEST_SD)
    at, reached = functions.where(bent, rig_z, 0.0), functions.where(bent & (space.u > 0), own, 0.0)
    scaled = reached / functions.where(space.u > 0, space.u, 1.0)
    of_half = functions.where(bent, half_normal_slope(at, scaled, functions), 0.0)
    return space.u * functions.where(half, of_half, functions.where(log, own, 1.0))


def scale_of(mechanism: Mechanism) -> np.ndarray:
    """Return the factors from the units of `NAMES` to rad and mm, shape (p,)."""
    return np.array([np.pi / 180 if p.unit.startswith("deg") else 1.0 for p in mechanism.parameters.values()])


def _camera_columns(*parts: str) -> slice | np.ndarray:
    """Return columns of named intrinsics in a camera's block: a slice where adjacent, which compiles to less code."""
    columns = [BLOCKS["stereo.left"].index(f"stereo.left.{part}") for part in parts]
    first, last = columns[0], columns[-1]
    return slice(first, last + 1) if columns == list(range(first, last + 1)) else np.array(columns)


def model_of(
    physical: Float[Array, " parameters"],
    harmonic_period_deg: Float[Array | np.ndarray, "2 3"] = NO_PERIOD_DEG,
    mechanism: Mechanism = TWO_MIRROR,
) -> Model:
    """Assemble the model (deg is converted to rad here only).

    Args:
        physical: values in the units of their names.
        harmonic_period_deg: periods of the transmission error by axis, see `ParameterSpace`; the first of each axis is
            the period of `harmonic_deg`.
        mechanism: mechanism of these values.

    Returns:
        The model in rad and mm.
    """
    values = physical * scale_of(mechanism)
    period_deg = jnp.asarray(harmonic_period_deg)

    def block(name: str):
        names = BLOCKS[name]
        if names[0] in mechanism.constants:
            unit = np.pi / 180 if "_deg" in name else 1.0
            own = jnp.array([unit * mechanism.constants[each] for each in names])
        else:
            first = mechanism.index[names[0]]
            own = values[first : first + len(names)]
        return own[0] if names == (name,) else own

    intrinsics = jnp.stack([block("stereo.left"), block("stereo.right")])
    return Model(
        transmission=Transmission(
            ratio_rad_per_step=block("degrees_per_step"),
            contrast_rad_per_step=block("ratio_contrast_deg_per_step"),
            backlash_rad=block("backlash_deg"),
            harmonics=Harmonics(
                amplitude_rad=jnp.reshape(block("harmonic_deg"), (2, 2, 2)),
                period_rad=period_deg[:, 0] * (jnp.pi / 180),
                on_wheel=period_deg[:, 0] == FULL_TURN_DEG,
            ),
            zero_shift=ZeroShift(block("creep_deg"), block("creep_minutes"), block("thermal_deg_per_K")),
        ),
        optics=chain_of(mechanism, block),
        tilt_zero_rad=block(mechanism.tilt_zero),
        extrinsics=Extrinsics(block("extrinsics.rotation_rad"), block("extrinsics.translation_mm")),
        cameras=StereoCameras(
            focal_px=intrinsics[:, _camera_columns("fx", "fy")],
            centre_px=intrinsics[:, _camera_columns("cx", "cy")],
            radial=intrinsics[:, _camera_columns("k1", "k2", "k3")],
            tangential=intrinsics[:, _camera_columns("p1", "p2")],
            rotation_rad=block("stereo.rotation_rad"),
            translation_mm=block("stereo.translation_mm"),
            focal_scale=block("focal_scale"),
        ),
        receiver=Receiver(
            baseline_mm=block("baseline_mm"),
            pan_zero_emission_rad=block("pan_zero_emission_deg"),
            aperture_zero_rad=block("aperture_zero_deg"),
            aperture_sd_rad=block("aperture_sd_deg"),
        ),
        noise=Noise(
            stop_sd_rad=jnp.reshape(block("stop_sd_deg"), (2, 2))[:, ::-1],
            look_scatter_rad=block("look_scatter_deg"),
            pixel_scale=block("pixel_scale"),
            home_sd_rad=block("home_sd_deg"),
        ),
        gears=GearScales(
            error_rad=block("transmission_error_deg"),
            length_rad=block("transmission_error_length_deg"),
            play_rad=block("play_variation_deg"),
            drift_rad_per_root_hour=block("drift_deg_per_root_hour"),
            amplitude_rad=jnp.reshape(block("harmonic_amplitude_deg"), (2, PERIODS_MAX)),
            period_rad=period_deg * (jnp.pi / 180),
        ),
    )


def parameter_space(table: RigTable, stereo: Stereo | None) -> ParameterSpace:
    """Build the arrays of the priors of `[rig]` and of the stereo calibration."""
    priors = [table.priors[name] for name in table.mechanism.rig_names]
    cameras, covariance = stereo_parameters(stereo), stereo_covariance(stereo)
    scale = np.sqrt(np.diag(covariance))
    # Standard deviations span 1e-5 (rad) to 1 (px): the root is that of the correlation matrix. Zero rows (fixed
    # parameters) stay zero.
    safe = np.where(scale > 0, scale, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    # The symmetric root keeps coordinate j closest to parameter j.
    root = scale[:, None] * (vectors * np.sqrt(np.clip(eigenvalues, 0.0, None))) @ vectors.T
    return ParameterSpace(
        value=placed(np.array([float(p.value) for p in priors])),
        u=placed(np.array([float(p.u) for p in priors])),
        kind=placed(np.array([KINDS.index(p.distribution) for p in priors])),
        stereo_mean=placed(cameras),
        stereo_root=placed(root),
        harmonic_period_deg=placed(np.stack([_periods_deg(table, axis) for axis in AXES])),
        key=table.mechanism.key,
    )


def _periods_deg(table: RigTable, axis: str) -> np.ndarray:
    """Return the periods of an axis' transmission error, padded to the largest number."""
    stated = np.ravel(table.harmonic_period_deg.get(axis, ()))
    return np.append(stated, np.full(PERIODS_MAX - len(stated), FULL_TURN_DEG))


@dataclass(frozen=True)
class Physical:
    """Values in the units of their names, shape (p,), and d/d(coordinates), shape (p, p)."""

    value: np.ndarray
    slope: np.ndarray


def physical_at(z: np.ndarray, space: ParameterSpace) -> Physical:
    """Compute values and slopes at a point (p,), in NumPy: compiling does not pay for one point."""
    point = space.known_point(z)
    slope = np.zeros((len(z), len(z)))
    slope[: space.rig, : space.rig] = np.diag(point.slopes)
    slope[space.rig :, space.rig :] = np.asarray(space.stereo_root)
    return Physical(np.asarray(point.values), slope)


def named_at(at: Physical, mechanism: Mechanism, names: Sequence[str]) -> Physical:
    """Select named parameters (k,), slopes (k, p); constants of the instrument do not vary."""
    value, slope = np.zeros(len(names)), np.zeros((len(names), len(at.value)))
    for row, name in enumerate(names):
        if (column := mechanism.index.get(name)) is None:
            value[row] = mechanism.constants[name]
        else:
            value[row], slope[row] = at.value[column], at.slope[column]
    return Physical(value, slope)


def coordinates_of(space: ParameterSpace, physical: np.ndarray) -> np.ndarray:
    """Compute coordinates (..., p) of values in the units of their names, the inverse of `ParameterSpace.physical`.

    Parameters fixed by their priors have coordinate 0, and so have directions in which the cameras are exactly known.
    Coordinates are clipped at 30.
    """
    value, u, kind = (np.asarray(x, dtype=float) for x in (space.value, space.u, space.kind))
    true, cameras = np.split(np.asarray(physical, dtype=float), [space.rig], axis=-1)
    safe = np.where(u > 0, u, 1.0)
    log = np.log(np.where(true > 0, true, 1.0) / np.where(value > 0, value, 1.0)) / safe
    z = np.where(kind == KINDS.index("log-normal"), log, (true - value) / safe)
    z = np.where(kind == KINDS.index("half-normal"), half_normal_coordinate(true / safe), z)
    z = np.where(u > 0, np.clip(z, -30.0, 30.0), 0.0)
    stereo = (cameras - np.asarray(space.stereo_mean)) @ np.linalg.pinv(np.asarray(space.stereo_root)).T
    return np.concatenate([z, stereo], axis=-1)


def free_mask(
    space: ParameterSpace, has_aperture: bool, unseen: Collection[str] = ()
) -> Bool[np.ndarray, " parameters"]:
    """Mark estimated parameters: u > 0, the receiver's only with aperture readings, none `unseen`."""
    rig = np.asarray(space.u) > 0
    without = {*unseen, *(() if has_aperture else RECEIVER_NAMES)}
    rig &= np.array([name not in without for name in space.mechanism.rig_names])
    stereo = np.abs(np.asarray(space.stereo_root)).sum(axis=1) > 0
    return np.concatenate([rig, stereo])

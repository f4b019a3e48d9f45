"""Coordinates with standard-normal priors."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Bool, Float, Int
from scipy import special

from tvsbayes.instrument.axes import AXES, FULL_TURN_DEG
from tvsbayes.instrument.parameters import INDEX, KINDS, NAMES, RECEIVER_NAMES, RIG_NAMES
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.stereo_pair import Stereo
from tvsbayes.model.geometry import Scalar, StereoCameras, Vector
from tvsbayes.model.laser_path import Harmonics, Optics, Transmission


def prior_groups() -> dict[str, list[int]]:
    """Coordinates of every prior that can be a cause of uncertainty; the stereo calibration is one of them."""
    groups: dict[str, list[int]] = {"stereo calibration": list(range(len(RIG_NAMES), len(NAMES)))}
    for name in RIG_NAMES:
        stem = "focal scale" if name == "focal_scale" else f"prior of {name.split('.')[0]}"
        groups.setdefault(stem, []).append(INDEX[name])
    return groups


NO_PERIOD_DEG = np.full(2, FULL_TURN_DEG)
"""Stands for the periods of transmission errors that nobody stated; harmless, since those errors are 0."""


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
    """Stop standard deviations by [axis, (right/down, left/up)] and the factor on the stated pixel sds."""

    stop_sd_rad: Float[Array, "2 2"]
    pixel_scale: Scalar


class Model(eqx.Module):
    """Everything that the forward model and the likelihood need, in rad and mm."""

    transmission: Transmission
    optics: Optics
    tilt_zero_rad: Scalar
    extrinsics: Extrinsics
    cameras: StereoCameras
    receiver: Receiver
    noise: Noise


def half_normal(z: np.ndarray | float) -> np.ndarray | float:
    """A half-normal quantity by its coordinate, in units of its scale: `ParameterSpace.physical` in NumPy."""
    return -special.ndtri(0.5 * special.ndtr(-np.asarray(z)))


def half_normal_slope(z: np.ndarray | float) -> np.ndarray | float:
    """Its derivative by the coordinate, phi(z) / (2 phi(b))."""
    return 0.5 * np.exp(0.5 * (half_normal(z) ** 2 - np.asarray(z) ** 2))


class ParameterSpace(eqx.Module):
    """Priors of one rig as arrays; an argument of the jitted functions, never a constant in them.

    `harmonic_period_deg` holds the periods of the transmission errors of (pan, tilt), as `NO_PERIOD_DEG` where none
    is stated.
    """

    value: Float[Array, " rig"]
    u: Float[Array, " rig"]
    kind: Int[Array, " rig"]
    stereo_mean: Float[Array, "24"]
    stereo_root: Float[Array, "24 24"]
    harmonic_period_deg: Float[Array, "2"]

    def physical(self, z: Float[Array, " parameters"]) -> Float[Array, " parameters"]:
        """Coordinates -> values in the units of `NAMES`."""
        rig_z, stereo_z = z[: len(RIG_NAMES)], z[len(RIG_NAMES) :]
        half, log = self.kind == 1, self.kind == 2
        # Unused branches are fed harmless numbers: `where` lets their infinities into the gradient.
        # Beyond 37 sd Phi underflows and its inverse has no value: a fit may stray there, and must come back.
        w = jnp.where(half, jnp.minimum(rig_z, 36.0), 0.0)
        # 1 - (1 + Phi(w)) / 2 = Phi(-w) / 2 keeps its digits where Phi(w) rounds to 1.
        half_normal = -self.u * ndtri(0.5 * ndtr(-w))
        log_normal = self.value * jnp.exp(jnp.where(log, self.u, 0.0) * rig_z)
        rig = jnp.where(half, half_normal, jnp.where(log, log_normal, self.value + self.u * rig_z))
        return jnp.concatenate([rig, self.stereo_mean + self.stereo_root @ stereo_z])

    def model(self, z: Float[Array, " parameters"]) -> Model:
        """Coordinates -> model."""
        return model_of(self.physical(z), self.harmonic_period_deg)


RAD_NAMES = tuple(name for name in RIG_NAMES if "deg" in name)
SCALE = np.array([np.pi / 180 if name in RAD_NAMES else 1.0 for name in NAMES])
"""Contract units -> rad and mm."""


def model_of(
    physical: Float[Array, " parameters"], harmonic_period_deg: Float[Array | np.ndarray, "2"] = NO_PERIOD_DEG
) -> Model:
    """Assemble the model (deg -> rad happens here and nowhere else).

    Args:
        physical: values in the units of `NAMES`.
        harmonic_period_deg: periods of the transmission error (pan, tilt), see `ParameterSpace`.

    Returns:
        The model in rad and mm.
    """
    values = physical * SCALE
    period_deg = jnp.asarray(harmonic_period_deg)

    def block(first: str, length: int):
        return values[INDEX[first] : INDEX[first] + length]

    def one(name: str):
        return values[INDEX[name]]

    intrinsics = jnp.reshape(block("stereo.left.fx", 18), (2, 9))
    return Model(
        transmission=Transmission(
            ratio_rad_per_step=block("degrees_per_step.pan", 2),
            contrast_rad_per_step=block("ratio_contrast_deg_per_step.pan", 2),
            backlash_rad=block("backlash_deg.pan", 2),
            harmonics=Harmonics(
                amplitude_rad=jnp.reshape(block("harmonic_deg.pan.1.cos", 8), (2, 2, 2)),
                period_rad=period_deg * (jnp.pi / 180),
                on_wheel=period_deg == FULL_TURN_DEG,
            ),
        ),
        optics=Optics(
            mirror_offset_mm=one("mirror_offset_mm"),
            mirror1_error_rad=one("mirror1_error_deg"),
            mirror2_error_rad=one("mirror2_error_deg"),
            laser_tilt_rad=block("laser_tilt_deg.x", 2),
            laser_offset_mm=block("laser_offset_mm.x", 2),
            tilt_axis_skew_rad=one("tilt_axis_skew_deg"),
            tilt_axis_offset_mm=block("tilt_axis_offset_mm.x", 2),
        ),
        tilt_zero_rad=one("tilt_zero_deg"),
        extrinsics=Extrinsics(block("extrinsics.rotation_rad.x", 3), block("extrinsics.translation_mm.x", 3)),
        cameras=StereoCameras(
            focal_px=intrinsics[:, 0:2],
            centre_px=intrinsics[:, 2:4],
            radial=intrinsics[:, np.array([4, 5, 8])],
            tangential=intrinsics[:, 6:8],
            rotation_rad=block("stereo.rotation_rad.x", 3),
            translation_mm=block("stereo.translation_mm.x", 3),
            focal_scale=one("focal_scale"),
        ),
        receiver=Receiver(*block("baseline_mm", 4)),
        noise=Noise(
            stop_sd_rad=jnp.reshape(block("stop_sd_deg.left", 4), (2, 2))[:, ::-1],
            pixel_scale=one("pixel_scale"),
        ),
    )


def parameter_space(table: RigTable, stereo: Stereo) -> ParameterSpace:
    """Priors of `[rig]` and of the stereo calibration as arrays."""
    priors = [table.priors[name] for name in RIG_NAMES]
    covariance = np.asarray(stereo.parameter_covariance, dtype=np.float64)
    scale = np.sqrt(np.diag(covariance))
    # Standard deviations span 1e-5 (rad) to 1 (px): the root is taken of the correlation matrix. Zero rows
    # (fixed parameters) stay zero.
    safe = np.where(scale > 0, scale, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    # The symmetric root keeps coordinate j closest to parameter j.
    root = scale[:, None] * (vectors * np.sqrt(np.clip(eigenvalues, 0.0, None))) @ vectors.T
    with jax.enable_x64(True):
        return ParameterSpace(
            value=jnp.array([p.value for p in priors]),
            u=jnp.array([p.u for p in priors]),
            kind=jnp.array([KINDS.index(p.distribution) for p in priors]),
            stereo_mean=jnp.asarray(stereo.vector),
            stereo_root=jnp.asarray(root),
            harmonic_period_deg=jnp.array([table.harmonic_period_deg.get(a, FULL_TURN_DEG) for a in AXES]),
        )


def free_mask(space: ParameterSpace, has_aperture: bool) -> Bool[np.ndarray, " parameters"]:
    """Parameters that are estimated: u > 0, and the receiver's only where there are aperture readings."""
    rig = np.asarray(space.u) > 0
    if not has_aperture:
        rig[[INDEX[name] for name in RECEIVER_NAMES]] = False
    stereo = np.abs(np.asarray(space.stereo_root)).sum(axis=1) > 0
    return np.concatenate([rig, stereo])

"""The forward model: parameters -> transmission -> laser beam -> pixels of both cameras (DESIGN 3). Differentiable.

A vector is an array whose first axis is x, y, z; any batch axes follow. Lengths in mm, angles in rad. All functions
are written for JAX with few, wide operations: compile time grows with their number.

Frame P: z along the pan axis, up; x along the nominal beam at pan angle 0; y left; origin where the nominal laser
meets mirror 1. Frame Q is P turned by the pan angle. Pan positive = left, tilt positive = up; arrays over axes are
ordered (pan, tilt). Frame S: origin in the left camera's centre, X depth, Y left, Z up; OpenCV's camera axes are
x = -Y, y = -Z, z = X. Pinhole with Brown-Conrady distortion; the right camera sees x_right = R x_left + T. Image px
with the integer at the centre of a pixel, ordered (u_left, v_left, u_right, v_right).

Every parameter of DESIGN 8 has a coordinate z with prior N(0, 1): normal priors are value + u z, half-normals
u Phi^-1((1 + Phi(z)) / 2) (DESIGN 4.1: no boundary, no mirrored mode), log-normals value exp(u z); the 24 stereo
parameters are mean + root z with root root^T their full covariance. u = 0 fixes a parameter whatever its z, so that
one compiled function serves every choice of fixed parameters. Units of physical values are those of the names.
"""

from __future__ import annotations

import os
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Bool, Float, Int
from platformdirs import user_cache_path
from scipy import special

from tvsbayes.rigs import FULL_TURN_DEG, RIG_PRIORS, STEREO_PARAMETER_NAMES, RigTable, Stereo

Scalar = Float[Array, ""]
Vector = Float[Array, "3"]

CROSS = np.zeros((3, 3, 3))
"""CROSS[i, j] . r = the matrix of the cross product r x."""
CROSS[0, 1, 2], CROSS[1, 2, 0], CROSS[2, 0, 1] = -1.0, -1.0, -1.0
CROSS[1, 0, 2], CROSS[2, 1, 0], CROSS[0, 2, 1] = 1.0, 1.0, 1.0
HORIZONTAL = np.array([1.0, 1.0, 0.0])
CV_FROM_S = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""OpenCV's camera axes from frame S: x = -Y, y = -Z, z = X."""
NEAREST_MM = 1.0
"""Points nearer than this, or behind a camera, are projected as if they stood here: a solver that strays
there gets a finite gradient back, and no spot is ever seen there."""
WIDEST_TAN2 = 4.0
"""Squared tangent (63 degrees) beyond which the distortion polynomial is held: it is fitted inside the image
and folds outside it."""


def use_compilation_cache() -> bool:
    """Keep compiled functions in the user's cache folder (or `TVSBAYES_CACHE`).

    For programs such as the command line, which own their process: it changes a global setting of JAX, so nothing
    in the library calls it.

    Returns:
        Whether nothing is in the folder yet: the model has to be compiled first, half a minute to two minutes.
    """
    folder = Path(os.environ.get("TVSBAYES_CACHE") or user_cache_path("tvsbayes") / "jax")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    return next(folder.glob("*-cache"), None) is None


def materialise(tree):
    """Have XLA compute these arrays once.

    Its CPU backend otherwise fuses the whole optical chain into each of the many consumers of a derivative and
    computes it again in every one.
    """
    return jax.lax.optimization_barrier(tree)


def rotation_matrix(rotation_rad: Vector) -> Float[Array, "3 3"]:
    """Rodrigues' formula, with finite derivatives of every order at the zero rotation.

    Args:
        rotation_rad: rotation vector, rad.

    Returns:
        R such that `p_A = R p_B`.
    """
    angle2 = jnp.dot(rotation_rad, rotation_rad)
    # The series of sin(a)/a and (1 - cos a)/a^2 are exact to 1e-17 below a = 0.01 and have no 0/0.
    small = angle2 < 1e-4
    safe2 = jnp.where(small, 1.0, angle2)
    angle = jnp.sqrt(safe2)
    sinc = jnp.where(small, 1 - angle2 / 6 * (1 - angle2 / 20 * (1 - angle2 / 42)), jnp.sin(angle) / angle)
    versine = jnp.where(small, 0.5 - angle2 / 24 * (1 - angle2 / 30 * (1 - angle2 / 56)), (1 - jnp.cos(angle)) / safe2)
    cross = CROSS @ rotation_rad
    return jnp.eye(3) + sinc * cross + versine * (cross @ cross)


def along_batch(vector: Vector, like: Array) -> Float[Array, "3 ..."]:
    """Give one vector as many batch axes of length 1 as `like` has axes."""
    return jnp.reshape(vector, (3,) + (1,) * like.ndim)


def dot(first: Float[Array, "3 ..."], second: Float[Array, "3 ..."]) -> Float[Array, "..."]:
    """Scalar product over the first axis."""
    product = first * second
    return product[0] + product[1] + product[2]


def transform(matrix: Float[Array | np.ndarray, "3 3"], vectors: Float[Array, "3 *batch"]) -> Float[Array, "3 *batch"]:
    """Matrix times vectors, written out: XLA's small matrix products and reductions run far slower."""
    wide = jnp.reshape(matrix, (3, 3) + (1,) * (vectors.ndim - 1))
    return wide[:, 0] * vectors[0] + wide[:, 1] * vectors[1] + wide[:, 2] * vectors[2]


def rotate_about_z(angle_rad: Float[Array, "..."], vector: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
    """Turn vectors about z, counter-clockwise seen from +z; batch axes of both broadcast."""
    turned = transform(CROSS[:, :, 2], vector)
    level = vector * HORIZONTAL.reshape((3,) + (1,) * (vector.ndim - 1))
    return vector + jnp.sin(angle_rad) * turned + (jnp.cos(angle_rad) - 1) * level


def reflect(direction: Float[Array, "3 ..."], normal: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
    """Mirror directions at a plane with unit normal: d - 2 (d.n) n (DESIGN 3.2)."""
    return direction - 2 * dot(direction, normal) * normal


def intersect_plane(
    origin: Float[Array, "3 ..."],
    direction: Float[Array, "3 ..."],
    point: Float[Array, "3 ..."],
    normal: Float[Array, "3 ..."],
) -> Float[Array, "3 ..."]:
    """Points where lines meet the plane through `point`; not finite where they are parallel."""
    return origin + dot(point - origin, normal) / dot(direction, normal) * direction


class StereoCameras(eqx.Module):
    """Both cameras, arrays ordered (left, right), coefficients named as OpenCV names them.

    Attributes:
        focal_px: (fx, fy) of each camera.
        centre_px: (cx, cy) of each camera.
        radial: (k1, k2, k3) of each camera.
        tangential: (p1, p2) of each camera.
        rotation_rad: Rodrigues vector of R, x_right = R x_left + T.
        translation_mm: T.
        focal_scale: factor on every focal length (the laser's wavelength, DESIGN 3.3).
    """

    focal_px: Float[Array, "2 2"]
    centre_px: Float[Array, "2 2"]
    radial: Float[Array, "2 3"]
    tangential: Float[Array, "2 2"]
    rotation_rad: Vector
    translation_mm: Vector
    focal_scale: Scalar


def project(cameras: StereoCameras, points_s_mm: Float[Array, "3 *batch"]) -> Float[Array, "4 *batch"]:
    """Pixels of points of frame S in both images.

    Args:
        cameras: the stereo pair.
        points_s_mm: points in frame S, mm, first axis X, Y, Z.

    Returns:
        First axis (u_left, v_left, u_right, v_right), px.
    """
    batch = points_s_mm.shape[1:]
    ones = (1,) * len(batch)

    def per_camera(values):
        return jnp.reshape(values, values.shape + ones)

    left = transform(CV_FROM_S, points_s_mm)
    translation = jnp.reshape(cameras.translation_mm, (3, *ones))
    right = transform(rotation_matrix(cameras.rotation_rad), left) + translation
    points = materialise(jnp.stack([left, right]))
    depth = jnp.maximum(points[:, 2:], NEAREST_MM)
    xy = materialise(points[:, :2] / depth)
    r2 = materialise(jnp.minimum(xy[:, 0] ** 2 + xy[:, 1] ** 2, WIDEST_TAN2))
    k1, k2, k3 = (per_camera(cameras.radial[:, i]) for i in range(3))
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # With q = (p2, p1) OpenCV's tangential terms are q r^2 + 2 (q . xy) xy.
    q = per_camera(cameras.tangential[:, ::-1])
    distorted = materialise(
        xy * materialise(radial + 2 * (q[:, 0] * xy[:, 0] + q[:, 1] * xy[:, 1]))[:, None] + q * r2[:, None]
    )
    pixels = per_camera(cameras.focal_px * cameras.focal_scale) * distorted + per_camera(cameras.centre_px)
    return jnp.reshape(pixels, (4, *batch))


UNIFORM_SD = 1 / 12**0.5
"""Standard deviation of a uniform distribution of unit width."""
ORDERS = np.array([1.0, 2.0])
"""Turns of a harmonic of the transmission error per period."""


class Harmonics(eqx.Module):
    """Transmission error of both axes: h(a) = sum_o c_o cos(2 pi o a / P) + s_o sin(2 pi o a / P) (DESIGN 3.1).

    Attributes:
        amplitude_rad: indices axis, order, (c, s).
        period_rad: P of each axis, angle of the output.
        on_wheel: the wheel's error, a function of the output behind the play, instead of the pinion's, a function
            of the input before it.
    """

    amplitude_rad: Float[Array, "2 2 2"]
    period_rad: Float[Array, "2"]
    on_wheel: Bool[Array, "2"]

    def error_rad(self, angle_rad: Float[Array, "*moves 2"]) -> Float[Array, "*moves 2"]:
        """The error at one angle per axis."""
        phase = (2 * jnp.pi) * (angle_rad / self.period_rad)[..., None] * ORDERS
        cosine, sine = self.amplitude_rad[..., 0], self.amplitude_rad[..., 1]
        return jnp.sum(cosine * jnp.cos(phase) + sine * jnp.sin(phase), axis=-1)


def no_harmonics() -> Harmonics:
    """Perfect gears; a full turn stands for the period that nobody stated."""
    return Harmonics(jnp.zeros((2, 2, 2)), jnp.full(2, 2 * jnp.pi), jnp.ones(2, dtype=bool))


class Transmission(eqx.Module):
    """Gears of both axes: mean ratio, left-minus-right (up-minus-down) contrast, play and transmission error."""

    ratio_rad_per_step: Float[Array, "2"]
    contrast_rad_per_step: Float[Array, "2"]
    backlash_rad: Float[Array, "2"]
    harmonics: Harmonics = eqx.field(default_factory=no_harmonics)

    def directional_ratio(self, positive: Bool[Array, "2"]) -> Float[Array, "2"]:
        """Ratio of left and up moves (`positive`) or right and down moves, rad per step."""
        return self.ratio_rad_per_step + jnp.where(positive, 0.5, -0.5) * self.contrast_rad_per_step


class MoveArrays(eqx.Module):
    """Moves of a campaign, padded; `approach` is +1 left/up, -1 right/down, 0 unknown, read at `first` rows."""

    steps: Float[Array, "moves 2"]
    first: Bool[Array, " moves"]
    approach: Float[Array, "moves 2"]


class MirrorAngles(eqx.Module):
    """Mirror angles after each move, without stop error and home offset.

    Where the approach of a segment's first row is unknown the play may lie anywhere in its band: `angle_rad`
    is then the middle of the possible angles and `play_sd_rad` the standard deviation of a uniform
    distribution over them (zero as soon as a move has taken the play up).
    """

    angle_rad: Float[Array, "moves 2"]
    play_sd_rad: Float[Array, "moves 2"]


def mirror_angles(transmission: Transmission, tilt_zero_rad: Scalar, moves: MoveArrays) -> MirrorAngles:
    """Follow the counters through gears, play and transmission error.

    Over a band of unknown play the wheel's error is taken at the band's middle, as a shift of the whole band. At an
    amplitude of 0.1 deg and a play of 0.5 deg its curvature, left out, is worth 1e-6 deg and its slope 0.4 % of the
    deviation. The filter likewise adds home offsets behind the gears, as if the error had no slope.

    Args:
        transmission: gears of both axes.
        tilt_zero_rad: tilt mirror angle at mid-play and counter zero.
        moves: absolute counters in time order.

    Returns:
        Mirror angles (pan, tilt) after each move.
    """
    half = transmission.backlash_rad / 2
    harmonics = transmission.harmonics

    def turn(state, move):
        previous_steps, q = state
        steps, first = move
        delta = steps - previous_steps
        q_moved = q + transmission.directional_ratio(delta > 0) * delta
        q_homed = transmission.ratio_rad_per_step * steps
        q = jnp.where(first, q_homed, q_moved)
        return (steps, q), q

    def take_up(band, move):
        low, high = band
        q, first, approach = move
        # Play is monotone in its state: the two ends of the band bound every history in between.
        low = jnp.where(first, jnp.where(approach < 0, q + half, q - half), jnp.clip(low, q - half, q + half))
        high = jnp.where(first, jnp.where(approach > 0, q - half, q + half), jnp.clip(high, q - half, q + half))
        return (low, high), (0.5 * (low + high), UNIFORM_SD * (high - low))

    zero = jnp.zeros(2)
    _, q = jax.lax.scan(turn, (zero, zero), (moves.steps, moves.first))
    # The errors know no history: outside the scans they cost one vector operation.
    driven = q + jnp.where(harmonics.on_wheel, 0.0, harmonics.error_rad(q))
    _, (output, play_sd_rad) = jax.lax.scan(take_up, (zero, zero), (driven, moves.first, moves.approach))
    output += jnp.where(harmonics.on_wheel, harmonics.error_rad(output), 0.0)
    return MirrorAngles(output + jnp.stack([jnp.zeros(()), tilt_zero_rad]), play_sd_rad)


class Optics(eqx.Module):
    """Laser and the two mirrors, with every deviation from the nominal 45-degree chain (DESIGN 3.2)."""

    mirror_offset_mm: Scalar
    mirror1_error_rad: Scalar
    mirror2_error_rad: Scalar
    laser_tilt_rad: Float[Array, "2"]
    laser_offset_mm: Float[Array, "2"]
    tilt_axis_skew_rad: Scalar
    tilt_axis_offset_mm: Float[Array, "2"]


class Beam(eqx.Module):
    """Rays, in frame P unless said otherwise: they leave mirror 2 at `origin_mm` along the unit vectors `direction`."""

    origin_mm: Float[Array, "3 *batch"]
    direction: Float[Array, "3 *batch"]


def beam(optics: Optics, pan_rad: Float[Array, "*batch"], tilt_rad: Float[Array, "*batch"]) -> Beam:
    """Trace the laser over both mirrors (DESIGN 3.2; the signs are part of the contract).

    Args:
        optics: laser and mirrors.
        pan_rad: angles psi of the pan stage.
        tilt_rad: angles beta of the tilt stage.

    Returns:
        The rays in frame P.
    """
    zero, one = jnp.zeros(()), jnp.ones(())
    tangents = jnp.tan(optics.laser_tilt_rad)
    laser = jnp.concatenate([tangents, -one[None]]) / jnp.sqrt(1 + jnp.dot(tangents, tangents))
    laser_origin = jnp.concatenate([optics.laser_offset_mm, zero[None]])
    # The laser stands still in P; in the pan stage's frame Q it turns backwards.
    laser, laser_origin = materialise(
        (
            rotate_about_z(-pan_rad, along_batch(laser, pan_rad)),
            rotate_about_z(-pan_rad, along_batch(laser_origin, pan_rad)),
        )
    )

    mirror1 = jnp.pi / 4 + optics.mirror1_error_rad
    normal1 = along_batch(jnp.stack([zero, -jnp.sin(mirror1), jnp.cos(mirror1)]), pan_rad)
    hit1 = intersect_plane(laser_origin, laser, jnp.zeros_like(normal1), normal1)
    between = reflect(laser, normal1)
    hit1, between = materialise((hit1, between))

    ax, az = optics.tilt_axis_offset_mm
    centre = along_batch(jnp.stack([ax, -optics.mirror_offset_mm, az]), pan_rad)
    sin_skew, cos_skew = jnp.sin(optics.tilt_axis_skew_rad), jnp.cos(optics.tilt_axis_skew_rad)
    mirror2 = jnp.pi / 4 + optics.mirror2_error_rad
    ahead = jnp.sin(mirror2) * jnp.array([1.0, 0.0, 0.0])
    above = jnp.sin(mirror2) * jnp.stack([zero, -sin_skew, cos_skew])
    axial = jnp.cos(mirror2) * jnp.stack([zero, cos_skew, sin_skew])
    ahead, above, axial = (along_batch(v, pan_rad) for v in (ahead, above, axial))
    normal2 = materialise(jnp.cos(tilt_rad) * ahead + jnp.sin(tilt_rad) * above + axial)
    hit2 = materialise(intersect_plane(hit1, between, centre, normal2))
    outgoing = materialise(reflect(between, normal2))
    return Beam(*materialise((rotate_about_z(pan_rad, hit2), rotate_about_z(pan_rad, outgoing))))


class BeamAngles(eqx.Module):
    """Azimuth atan2(d_y, d_x) and elevation asin(d_z) of the beam in frame P with their Jacobian.

    `jacobian[i, j]` is d(azimuth, elevation)_i / d(pan, tilt)_j. `effective_mirror_offset_mm` is the signed
    distance of the beam line from the pan axis: the horizontal moment d_y o_x - d_x o_y over |d_xy|, +L for
    the nominal chain.
    """

    azimuth_rad: Scalar
    elevation_rad: Scalar
    jacobian: Float[Array, "2 2"]
    effective_mirror_offset_mm: Scalar


def beam_angles(optics: Optics, pan_rad: Scalar, tilt_rad: Scalar) -> BeamAngles:
    """Direction of the beam and its local slope against the mirror angles at one pose (DESIGN 3.2)."""

    def azimuth_elevation(angles):
        d = beam(optics, angles[0], angles[1]).direction
        return jnp.stack([jnp.arctan2(d[1], d[0]), jnp.arctan2(d[2], jnp.hypot(d[0], d[1]))])

    pose = jnp.stack([pan_rad, tilt_rad])
    azimuth, elevation = azimuth_elevation(pose)
    ray = beam(optics, pan_rad, tilt_rad)
    o, d = ray.origin_mm, ray.direction
    offset = (d[1] * o[0] - d[0] * o[1]) / jnp.hypot(d[0], d[1])
    return BeamAngles(azimuth, elevation, jax.jacfwd(azimuth_elevation)(pose), offset)


RIG_NAMES: tuple[str, ...] = tuple(RIG_PRIORS)
NAMES: tuple[str, ...] = (*RIG_NAMES, *STEREO_PARAMETER_NAMES)
"""Contract names (DESIGN 8) in the order of the coordinates."""
NOISE_NAMES: tuple[str, ...] = (
    *(f"stop_sd_deg.{direction}" for direction in ("left", "right", "up", "down")),
    "pixel_scale",
    "aperture_sd_deg",
)
"""Scales that the point estimate alternates with geometry and stereo (DESIGN 4.2)."""
RECEIVER_NAMES: tuple[str, ...] = (
    "baseline_mm",
    "pan_zero_emission_deg",
    "aperture_zero_deg",
    "aperture_sd_deg",
)
"""Observable only through aperture readings."""

INDEX: dict[str, int] = {name: index for index, name in enumerate(NAMES)}
KINDS = ("normal", "half-normal", "log-normal")
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
            harmonic_period_deg=jnp.array([table.harmonic_period_deg.get(a, FULL_TURN_DEG) for a in ("pan", "tilt")]),
        )


def free_mask(space: ParameterSpace, has_aperture: bool) -> Bool[np.ndarray, " parameters"]:
    """Parameters that are estimated: u > 0, and the receiver's only where there are aperture readings."""
    rig = np.asarray(space.u) > 0
    if not has_aperture:
        rig[[INDEX[name] for name in RECEIVER_NAMES]] = False
    stereo = np.abs(np.asarray(space.stereo_root)).sum(axis=1) > 0
    return np.concatenate([rig, stereo])

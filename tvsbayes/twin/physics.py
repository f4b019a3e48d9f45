"""The twin's own physics: gears with play, stop errors, mirrors, the beam on a sheet, cameras, the aperture's angle.

It shares formats and parameter names with the estimators, but no formula: everything is implemented here a second time,
from data/docs/formulation.md alone, so that an error in the estimators' model cannot hide in the twin. Frames S
(stereo), P (positioner), Q (pan stage) and T (TVS) as in `data/docs/conventions.md`; mm; degrees and radians by suffix;
pixels with the integer at the centre of a pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tvsbayes.instrument.axes import APPROACH_SIGN, AXES, DIRECTION_SIGNS, FULL_TURN_DEG
from tvsbayes.instrument.mechanisms import HEAD, TWO_MIRROR, mechanism_of
from tvsbayes.instrument.parameters import HARMONIC_ORDERS
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix
from tvsbayes.twin.head_physics import Beam, head_beam


def take_up(output_deg: float, driving_deg: float, backlash_deg: float) -> float:
    """Compute the output of a gear with play after its driver has moved to `driving_deg`."""
    return min(max(output_deg, driving_deg - backlash_deg / 2), driving_deg + backlash_deg / 2)


def play(q_deg: Sequence[float], start_deg: float, backlash_deg: float | np.ndarray) -> np.ndarray:
    """Compute outputs of a gear with play for driving angles q (n,), from output `start_deg` on.

    Play (n,) that varies by place is that at the end of each move, valid while the play changes by less than the angle.
    """
    output, y = np.empty(len(q_deg)), start_deg
    for i, (q, width) in enumerate(zip(q_deg, np.broadcast_to(backlash_deg, len(q_deg)), strict=True)):
        output[i] = y = take_up(y, q, width)
    return output


def transmission(
    counters: np.ndarray,
    first: np.ndarray,
    start_fraction: np.ndarray,
    home_deg: np.ndarray,
    ratios_deg_per_step: tuple[float, float],
    backlash_deg: float | np.ndarray,
    harmonics_deg: Sequence[complex] = (),
    period_deg: float = FULL_TURN_DEG,
) -> np.ndarray:
    """Compute the output angle (n,) of one axis after each move, degrees, without stop errors (formulation 3.1).

    Args:
        counters: (n,) absolute counters.
        first: (n,) True at the first row of a segment.
        start_fraction: (n,) position in the play at such a row, -1/2 (left, up) to +1/2; unused elsewhere.
        home_deg: (n,) home offset of the row's segment.
        ratios_deg_per_step: mean ratio and contrast; positive moves turn by mean + contrast / 2 per step.
        backlash_deg: full width of the play, everywhere or (n,) where each move ends.
        harmonics_deg: cosine part - i sine part of the transmission error for orders 1, 2 ...
        period_deg: its period in degrees of the output: a full turn for the wheel, behind the play; less for the
            pinion, before it.
    """
    mean, contrast = ratios_deg_per_step
    wheel, width = period_deg == FULL_TURN_DEG, np.broadcast_to(backlash_deg, len(counters))
    output = np.empty(len(counters))
    starts = [*np.flatnonzero(first), len(counters)]
    for begin, end in pairwise(starts):
        steps = np.diff(counters[begin:end])
        turned = steps * np.where(steps > 0, mean + contrast / 2, mean - contrast / 2)
        q = mean * counters[begin] + home_deg[begin] + np.concatenate(([0.0], np.cumsum(turned)))
        if not wheel:
            q = q + wobble_deg(q, harmonics_deg, period_deg)
        output[begin:end] = play(q, q[0] + start_fraction[begin] * width[begin], width[begin:end])
    return output + wobble_deg(output, harmonics_deg, period_deg) if wheel else output


def harmonics_deg(parameters: Mapping[str, float], axis: str) -> list[complex]:
    """Return the transmission error of an axis as an argument of `transmission`; missing parameters are 0."""
    names = [f"harmonic_deg.{axis}.{order}" for order in HARMONIC_ORDERS]
    return [complex(parameters.get(f"{name}.cos", 0.0), -parameters.get(f"{name}.sin", 0.0)) for name in names]


def wobble_deg(angle_deg: np.ndarray | float, harmonics_deg: Sequence[complex], period_deg: float) -> np.ndarray:
    """Compute the transmission error at angles: the real part of sum_o (c_o - i s_o) e^(i o phase)."""
    turn = np.exp(2j * np.pi * np.asarray(angle_deg) / period_deg)
    parts = (part * turn**order for order, part in enumerate(harmonics_deg, start=1))
    return np.real(sum(parts, np.zeros(turn.shape)))


def stop_errors(
    counters: np.ndarray,
    first: np.ndarray,
    approach: Sequence[str],
    draws: np.ndarray,
    sds: Mapping[str, float],
) -> np.ndarray:
    """Compute the stop error (n,) of one axis after each move, in the unit of `sds`.

    It is drawn again when this axis' counter changes, even if play absorbs the motion, and at first rows. It is kept
    while only the other axis moves. `sds` maps "+", "-" to the standard deviation of positive and negative moves; an
    unknown approach takes their root mean square. `approach` (n,) is read at first rows.
    """
    errors, error = np.empty(len(counters)), 0.0
    mean_sd = float(np.sqrt((sds["+"] ** 2 + sds["-"] ** 2) / 2))
    for i in range(len(counters)):
        if first[i]:
            error = draws[i] * {1: sds["+"], -1: sds["-"], 0: mean_sd}[APPROACH_SIGN[approach[i]]]
        elif counters[i] != counters[i - 1]:
            error = draws[i] * sds["+" if counters[i] > counters[i - 1] else "-"]
        errors[i] = error
    return errors


def mirror_chain(psi_rad: np.ndarray | float, beta_rad: np.ndarray | float, geometry: Mapping[str, float]) -> Beam:
    """Compute the beam for angles psi, beta of both axes, in P."""
    return BEAMS[mechanism_of(geometry).word](psi_rad, beta_rad, geometry)


def reflected_beam(psi_rad: np.ndarray | float, beta_rad: np.ndarray | float, geometry: Mapping[str, float]) -> Beam:
    """Compute the beam of a scanner by true reflections, the laser rotated into the pan stage Q (formulation 3.2)."""
    psi, beta = np.broadcast_arrays(np.asarray(psi_rad, float), np.asarray(beta_rad, float))
    tx, ty = (np.tan(np.radians(geometry[f"laser_tilt_deg.{axis}"])) for axis in "xy")
    ox, oy = geometry["laser_offset_mm.x"], geometry["laser_offset_mm.y"]
    m1 = np.radians(45 + geometry["mirror1_error_deg"])
    m2 = np.radians(45 + geometry["mirror2_error_deg"])
    skew = np.radians(geometry["tilt_axis_skew_deg"])
    laser = np.array([tx, ty, -1.0]) / np.sqrt(tx * tx + ty * ty + 1)
    point = _about_z(np.broadcast_to([ox, oy, 0.0], (*psi.shape, 3)), -psi)
    beam = Beam(point, _about_z(np.broadcast_to(laser, (*psi.shape, 3)), -psi))
    beam = _reflect(beam, np.zeros(3), np.array([0.0, -np.sin(m1), np.cos(m1)]))
    centre = np.array(
        [geometry["tilt_axis_offset_mm.x"], -geometry["mirror_offset_mm"], geometry["tilt_axis_offset_mm.z"]]
    )
    axis = np.array([0.0, np.cos(skew), np.sin(skew)])
    across, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, -np.sin(skew), np.cos(skew)])
    radial = np.cos(beta)[..., None] * across + np.sin(beta)[..., None] * up
    beam = _reflect(beam, centre, np.sin(m2) * radial + np.cos(m2) * axis)
    return Beam(_about_z(beam.origin, psi), _about_z(beam.direction, psi))


BEAMS = {TWO_MIRROR.word: reflected_beam, HEAD.word: head_beam}
"""Beams by the word of a mechanism."""


def _about_z(vector: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Rotate vectors (..., 3) about z, positive = counter-clockwise from above."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y, z = np.moveaxis(vector, -1, 0)
    return np.stack((c * x - s * y, s * x + c * y, z), axis=-1)


def _reflect(beam: Beam, on_plane: np.ndarray, normal: np.ndarray) -> Beam:
    """Compute the beam after a mirror, with origins where it meets the mirror's plane."""
    along = np.sum(beam.direction * normal, axis=-1, keepdims=True)
    distance = np.sum((on_plane - beam.origin) * normal, axis=-1, keepdims=True) / along
    return Beam(beam.origin + distance * beam.direction, beam.direction - 2 * along * normal)


@dataclass(frozen=True, eq=False)
class Sheet:
    """White sheets, one (...) or many: `depth_mm` (...), X of the plane on the X axis, and `normal` (..., 3) in S.

    The first component of the normal is 1: n . p = depth.
    """

    depth_mm: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True, eq=False)
class Light:
    """Points where beams meet their sheets, one (3,) or many (n, 3), from which pictures are rendered.

    Attributes:
        points_mm: (..., 3) on the sheet, frame S; NaN where there is no light or the beam never meets the sheet.
        directions: (..., 3) unit vectors along the beam, frame S.
        normals: (..., 3) of the sheet, frame S, of any length.
        points_P_mm: (..., 3) the same points in frame P.
    """

    points_mm: np.ndarray
    directions: np.ndarray
    normals: np.ndarray
    points_P_mm: np.ndarray

    def of(self, row: int) -> Light:
        """Return the light of one of many beams."""
        return Light(self.points_mm[row], self.directions[row], self.normals[row], self.points_P_mm[row])


def light_on_sheet(
    psi_rad: np.ndarray | float, beta_rad: np.ndarray | float, parameters: Mapping[str, float], sheet: Sheet
) -> Light:
    """Compute the light from mirrors at (...) angles on (...) sheets."""
    rotation = rotation_matrix(np.array([parameters[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    translation = np.array([parameters[f"extrinsics.translation_mm.{a}"] for a in "xyz"])
    origin_P, direction_P = mirror_chain(psi_rad, beta_rad, parameters)
    origin, direction = origin_P @ rotation.T + translation, direction_P @ rotation.T
    with np.errstate(divide="ignore"):
        gap = sheet.depth_mm - np.sum(origin * sheet.normal, axis=-1)
        distance = gap / np.sum(direction * sheet.normal, axis=-1)
    distance = np.where(distance > 0, distance, np.nan)[..., None]
    return Light(origin + distance * direction, direction, sheet.normal, origin_P + distance * direction_P)


@dataclass(frozen=True)
class Camera:
    """One camera; `rotation` and `translation_mm` transform points from the left camera's axes to its own."""

    matrix: np.ndarray
    distortion: np.ndarray
    rotation: np.ndarray
    translation_mm: np.ndarray
    width: int
    height: int

    def project(self, points_mm: np.ndarray) -> np.ndarray:
        """Project points (n, 3) in the left camera's axes to pixels (n, 2), by pinhole and Brown-Conrady distortion.

        Pixels outside the image are included; NaN behind the camera and beyond the radius up to which distortion is
        monotone.
        """
        in_camera = points_mm @ self.rotation.T + self.translation_mm
        k1, k2, p1, p2, k3 = self.distortion
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = in_camera[:, 0] / in_camera[:, 2], in_camera[:, 1] / in_camera[:, 2]
        r2 = a * a + b * b
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        v = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
        pixels = np.column_stack((self.matrix[0, 0] * u + self.matrix[0, 2], self.matrix[1, 1] * v + self.matrix[1, 2]))
        good = (in_camera[:, 2] > 0) & (r2 < _turning_radius_squared(k1, k2, k3))
        return np.where(good[:, None], pixels, np.nan)


@dataclass(frozen=True)
class CameraPair:
    """The two cameras of a rig."""

    left: Camera
    right: Camera


def cameras_of(stereo: Stereo, focal_scale: float = 1.0) -> CameraPair:
    """Build both cameras of a calibration; `focal_scale` multiplies fx and fy (1 in visible light, formulation 3.3)."""
    scale = np.array([[focal_scale, 1.0, 1.0], [1.0, focal_scale, 1.0], [1.0, 1.0, 1.0]])
    size = stereo.image_width, stereo.image_height
    left = Camera(stereo.M1 * scale, np.asarray(stereo.D1, float).ravel(), np.eye(3), np.zeros(3), *size)
    pose = np.asarray(stereo.R, float), np.asarray(stereo.T, float).ravel()
    return CameraPair(left, Camera(stereo.M2 * scale, np.asarray(stereo.D2, float).ravel(), *pose, *size))


def camera_axes(vectors_S: np.ndarray) -> np.ndarray:
    """Transform vectors (..., 3) from frame S to the left camera's axes: x right, y down, z along the view."""
    x, y, z = np.moveaxis(np.asarray(vectors_S, float), -1, 0)
    return np.stack((-y, -z, x), axis=-1)


def project(points_S_mm: np.ndarray, stereo: Stereo, focal_scale: float = 1.0) -> np.ndarray:
    """Project points (n, 3) in frame S to pixels (n, 4: u_left, v_left, u_right, v_right); NaN where not visible.

    `focal_scale` multiplies fx and fy of both cameras. A point is not visible where `Camera.project` gives NaN, or
    outside the image, whose outermost pixel centres are 0 and width - 1.
    """
    cameras, points = cameras_of(stereo, focal_scale), camera_axes(np.reshape(points_S_mm, (-1, 3)))
    return inside_images(np.hstack([camera.project(points) for camera in (cameras.left, cameras.right)]), stereo)


def inside_images(pixels: np.ndarray, stereo: Stereo) -> np.ndarray:
    """Return pixels (n, 4), with NaN rows where one of the two centres is outside its image."""
    last = np.tile([stereo.image_width - 1, stereo.image_height - 1], 2)
    inside = ((pixels >= 0) & (pixels <= last)).all(axis=1, keepdims=True)
    return np.where(inside, pixels, np.nan)


def _turning_radius_squared(k1: float, k2: float, k3: float) -> float:
    """Compute the square of the normalised radius up to which radial distortion is monotone, infinite if always."""
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-12].real
    return float(min(real[real > 0], default=np.inf))


def to_tvs(points_P_mm: np.ndarray, baseline_mm: float, pan_zero_emission_deg: float) -> np.ndarray:
    """Transform points (..., 3) from frame P to frame T: p_T = Rz(C0 - 90 deg) p_P + (0, a/2, 0)."""
    turned = _about_z(np.asarray(points_P_mm, float), np.radians(pan_zero_emission_deg - 90.0))
    return turned + np.array([0.0, baseline_mm / 2, 0.0])


def aperture_angle_deg(points_T_mm: np.ndarray, baseline_mm: float, convention: str) -> np.ndarray:
    """Compute angle B (...,) at the aperture between +y and the spot, "in-plane" or its "azimuth" (formulation 5)."""
    x, y, z = np.moveaxis(np.asarray(points_T_mm, float) + np.array([0.0, baseline_mm / 2, 0.0]), -1, 0)
    return np.degrees(np.arctan2(np.hypot(x, z) if convention == "in-plane" else x, y))


def beam_jacobian(geometry: Mapping[str, float], pose_deg: tuple[float, float]) -> np.ndarray:
    """Compute d(azimuth, elevation)/d(psi, beta) (2, 2) of the beam in P at a pose, by central differences."""
    step = 1e-5  # rad: truncation 1e-10, rounding 1e-11
    psi, beta = np.radians(pose_deg)
    directions = mirror_chain(
        psi + step * np.array([1, -1, 0, 0]), beta + step * np.array([0, 0, 1, -1]), geometry
    ).direction
    angles = np.stack((np.arctan2(directions[:, 1], directions[:, 0]), np.arcsin(directions[:, 2])))
    return np.stack((angles[:, 0] - angles[:, 1], angles[:, 2] - angles[:, 3]), axis=1) / (2 * step)


def local_deg_per_step(parameters: Mapping[str, float], reference_pose_deg: tuple[float, float]) -> dict[str, float]:
    """Compute degrees of the beam per step at a pose: k_dir d(az)/d(psi), k_dir d(el)/d(beta) (formulation 3.2).

    They are those of the mirrors alone, without the slope of a transmission error.
    """
    slope = dict(zip(AXES, np.diagonal(beam_jacobian(parameters, reference_pose_deg)), strict=True))
    return {
        name: float(parameters[f"degrees_per_step.{name}"] * slope[axis]) for name, (axis, _) in DIRECTION_SIGNS.items()
    }


def effective_mirror_offset_mm(parameters: Mapping[str, float], pose_deg: tuple[float, float]) -> float:
    """Compute the signed distance of the beam line from the pan axis at a pose, +L for the nominal rig, mm.

    (d_y o_x - d_x o_y) / sqrt(d_x^2 + d_y^2) with origin o and direction d in P is the beam's moment about the pan axis
    over its horizontal length.
    """
    psi, beta = np.radians(pose_deg)
    o, d = mirror_chain(psi, beta, parameters)
    return float((d[1] * o[0] - d[0] * o[1]) / np.hypot(d[0], d[1]))

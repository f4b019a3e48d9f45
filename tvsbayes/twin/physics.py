"""The digital twin: draws a true rig, runs a plan on it and writes down what the cameras would see.

It shares formats and parameter names with the estimators, but no formula: its physics (gears with play, mirrors,
cameras, aperture; DESIGN 3 and 5) is written here a second time, from the design alone, so that an error in the
estimators' model cannot hide in the twin. Frames S (stereo), P (positioner), Q (pan stage) and T (TVS) as in
DESIGN 2; mm; degrees and radians by suffix; pixels with the integer at the centre of a pixel. The parts of chance
(rig, stop errors, sheets, pixels, aperture) have their own random streams: changing one leaves the others as they
were.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from tvsbayes.instrument.axes import FULL_TURN_DEG
from tvsbayes.instrument.parameters import HARMONIC_ORDERS
from tvsbayes.instrument.stereo_pair import Stereo


def play(q_deg: Sequence[float], start_deg: float, backlash_deg: float) -> np.ndarray:
    """Output of a gear with play for driving angles q (n,), from output `start_deg` on."""
    output, y = np.empty(len(q_deg)), start_deg
    for i, q in enumerate(q_deg):
        y = min(max(y, q - backlash_deg / 2), q + backlash_deg / 2)
        output[i] = y
    return output


def transmission(
    counters: np.ndarray,
    first: np.ndarray,
    start_fraction: np.ndarray,
    home_deg: np.ndarray,
    ratios_deg_per_step: tuple[float, float],
    backlash_deg: float,
    harmonics_deg: Sequence[complex] = (),
    period_deg: float = FULL_TURN_DEG,
) -> np.ndarray:
    """Output angle (n,) in degrees of one axis after each move, stop errors excluded (DESIGN 3.1).

    Args:
        counters: (n,) absolute counters.
        first: (n,) True at the first row of a segment.
        start_fraction: (n,) where the play stands at such a row, -1/2 (left, up) to +1/2; unused elsewhere.
        home_deg: (n,) home offset of the row's segment.
        ratios_deg_per_step: mean ratio and contrast; positive moves turn by mean + contrast / 2 per step.
        backlash_deg: full width of the play.
        harmonics_deg: cosine part - i sine part of the transmission error for orders 1, 2 ...
        period_deg: its period in degrees of the output: a full turn for the wheel, behind the play; less for the
            pinion, before it.
    """
    mean, contrast = ratios_deg_per_step
    wheel = period_deg == FULL_TURN_DEG
    output = np.empty(len(counters))
    starts = [*np.flatnonzero(first), len(counters)]
    for begin, end in pairwise(starts):
        steps = np.diff(counters[begin:end])
        turned = steps * np.where(steps > 0, mean + contrast / 2, mean - contrast / 2)
        q = mean * counters[begin] + home_deg[begin] + np.concatenate(([0.0], np.cumsum(turned)))
        if not wheel:
            q = q + _wobble(q, harmonics_deg, period_deg)
        output[begin:end] = play(q, q[0] + start_fraction[begin] * backlash_deg, backlash_deg)
    return output + _wobble(output, harmonics_deg, period_deg) if wheel else output


def _wobble(angle_deg: np.ndarray, harmonics_deg: Sequence[complex], period_deg: float) -> np.ndarray:
    """Transmission error at angles: the real part of sum_o (c_o - i s_o) e^(i o phase)."""
    turn = np.exp(2j * np.pi * np.asarray(angle_deg) / period_deg)
    return sum((part * turn**order for order, part in enumerate(harmonics_deg, start=1)), np.zeros(len(turn))).real


def stop_errors(
    counters: np.ndarray,
    first: np.ndarray,
    approach: Sequence[str],
    draws: np.ndarray,
    sds: Mapping[str, float],
) -> np.ndarray:
    """Stop error (n,) of one axis as held after each move, in the unit of `sds`.

    Redrawn when this axis' counter changes, even if play absorbs the motion, and at first rows; held
    while only the other axis moves. `sds` maps "+", "-" to the standard deviation of positive and negative
    moves; an unknown approach takes their root mean square. `approach` (n,) is read at first rows.
    """
    held, error = np.empty(len(counters)), 0.0
    both = float(np.sqrt((sds["+"] ** 2 + sds["-"] ** 2) / 2))
    for i in range(len(counters)):
        if first[i]:
            side = {"left": "+", "up": "+", "right": "-", "down": "-"}.get(approach[i])
            error = draws[i] * (sds[side] if side else both)
        elif counters[i] != counters[i - 1]:
            error = draws[i] * sds["+" if counters[i] > counters[i - 1] else "-"]
        held[i] = error
    return held


def mirror_chain(
    psi_rad: np.ndarray | float, beta_rad: np.ndarray | float, geometry: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Beam leaving mirror 2 for mirror angles psi, beta: origin (..., 3) mm and direction (..., 3) in P.

    True reflections at true intersections (DESIGN 3.2). The laser is turned into the pan stage Q instead
    of the mirrors out of it. `geometry` maps contract names to values.
    """
    psi, beta = np.broadcast_arrays(np.asarray(psi_rad, float), np.asarray(beta_rad, float))
    tx, ty = (np.tan(np.radians(geometry[f"laser_tilt_deg.{axis}"])) for axis in "xy")
    ox, oy = geometry["laser_offset_mm.x"], geometry["laser_offset_mm.y"]
    m1 = np.radians(45 + geometry["mirror1_error_deg"])
    m2 = np.radians(45 + geometry["mirror2_error_deg"])
    skew = np.radians(geometry["tilt_axis_skew_deg"])
    laser = np.array([tx, ty, -1.0]) / np.sqrt(tx * tx + ty * ty + 1)
    point = _about_z(np.broadcast_to([ox, oy, 0.0], (*psi.shape, 3)), -psi)
    direction = _about_z(np.broadcast_to(laser, (*psi.shape, 3)), -psi)
    point, direction = _reflect(point, direction, np.zeros(3), np.array([0.0, -np.sin(m1), np.cos(m1)]))
    centre = np.array(
        [geometry["tilt_axis_offset_mm.x"], -geometry["mirror_offset_mm"], geometry["tilt_axis_offset_mm.z"]]
    )
    axis = np.array([0.0, np.cos(skew), np.sin(skew)])
    across, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, -np.sin(skew), np.cos(skew)])
    radial = np.cos(beta)[..., None] * across + np.sin(beta)[..., None] * up
    point, direction = _reflect(point, direction, centre, np.sin(m2) * radial + np.cos(m2) * axis)
    return _about_z(point, psi), _about_z(direction, psi)


def _about_z(vector: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) turned about z, positive = counter-clockwise from above."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y, z = np.moveaxis(vector, -1, 0)
    return np.stack((c * x - s * y, s * x + c * y, z), axis=-1)


def _reflect(
    point: np.ndarray, direction: np.ndarray, on_plane: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays meet a mirror plane, and their directions after it."""
    along = np.sum(direction * normal, axis=-1, keepdims=True)
    distance = np.sum((on_plane - point) * normal, axis=-1, keepdims=True) / along
    return point + distance * direction, direction - 2 * along * normal


def project(points_S_mm: np.ndarray, stereo: Stereo, focal_scale: float = 1.0) -> np.ndarray:
    """Pixels (n, 4: u_left, v_left, u_right, v_right) of points (n, 3) in frame S; NaN where not seen.

    Pinhole with Brown-Conrady; `focal_scale` multiplies fx and fy of both cameras. Not seen: behind a
    camera, beyond the radius where the distortion polynomial turns back, or outside the image, whose
    outermost pixel centres are 0 and width - 1.
    """
    x, y, z = np.asarray(points_S_mm, float).reshape(-1, 3).T
    left = np.column_stack((-y, -z, x))
    right = left @ np.asarray(stereo.R, float).T + np.asarray(stereo.T, float).ravel()
    views = ((left, stereo.M1, stereo.D1), (right, stereo.M2, stereo.D2))
    return inside_images(np.hstack([project_camera(*view, focal_scale) for view in views]), stereo)


def project_camera(
    points_mm: np.ndarray, matrix: np.ndarray, coefficients: np.ndarray, focal_scale: float = 1.0
) -> np.ndarray:
    """Pixels (n, 2) of points (n, 3) in a camera's own axes (x right, y down, z along the view).

    Beyond the image's borders too; NaN behind the camera and beyond the radius where distortion turns back.
    """
    k1, k2, p1, p2, k3 = np.asarray(coefficients, float).ravel()
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (points_mm[:, :2] / points_mm[:, 2:]).T
    r2 = a * a + b * b
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    v = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    u = focal_scale * matrix[0, 0] * u + matrix[0, 2]
    v = focal_scale * matrix[1, 1] * v + matrix[1, 2]
    good = (points_mm[:, 2] > 0) & (r2 < _turning_radius_squared(k1, k2, k3))
    return np.where(good[:, None], np.column_stack((u, v)), np.nan)


def inside_images(pixels: np.ndarray, stereo: Stereo) -> np.ndarray:
    """Pixels (n, 4) with NaN rows where one of the two centres is not on its image."""
    last = np.tile([stereo.image_width - 1, stereo.image_height - 1], 2)
    inside = ((pixels >= 0) & (pixels <= last)).all(axis=1, keepdims=True)
    return np.where(inside, pixels, np.nan)


def _turning_radius_squared(k1: float, k2: float, k3: float) -> float:
    """Square of the normalised radius up to which radial distortion grows, infinite if it always does."""
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-12].real
    return float(min(real[real > 0], default=np.inf))


def to_tvs(points_P_mm: np.ndarray, baseline_mm: float, pan_zero_emission_deg: float) -> np.ndarray:
    """Points (..., 3) from frame P to frame T: p_T = Rz(C0 - 90 deg) p_P + (0, a/2, 0)."""
    turned = _about_z(np.asarray(points_P_mm, float), np.radians(pan_zero_emission_deg - 90.0))
    return turned + np.array([0.0, baseline_mm / 2, 0.0])


def aperture_angle_deg(points_T_mm: np.ndarray, baseline_mm: float, convention: str) -> np.ndarray:
    """Angle B (...,) at the aperture between +y and the spot, "in-plane" or its "azimuth" (DESIGN 5)."""
    x, y, z = np.moveaxis(np.asarray(points_T_mm, float) + np.array([0.0, baseline_mm / 2, 0.0]), -1, 0)
    return np.degrees(np.arctan2(np.hypot(x, z) if convention == "in-plane" else x, y))


def beam_jacobian(geometry: Mapping[str, float], pose_deg: tuple[float, float]) -> np.ndarray:
    """d(azimuth, elevation)/d(psi, beta) (2, 2) of the beam in P at a pose, by central differences."""
    step = 1e-5  # rad: truncation 1e-10, rounding 1e-11
    psi, beta = np.radians(pose_deg)
    directions = mirror_chain(psi + step * np.array([1, -1, 0, 0]), beta + step * np.array([0, 0, 1, -1]), geometry)[1]
    angles = np.stack((np.arctan2(directions[:, 1], directions[:, 0]), np.arcsin(directions[:, 2])))
    return np.stack((angles[:, 0] - angles[:, 1], angles[:, 2] - angles[:, 3]), axis=1) / (2 * step)


def effective_deg_per_step(
    parameters: Mapping[str, float], reference_pose_deg: tuple[float, float]
) -> dict[str, float]:
    """Degrees of the beam per step at a pose: k_dir d(az)/d(psi) and k_dir d(el)/d(beta) (DESIGN 3.2).

    The mean over a period of the transmission error, without its local slope.
    """
    jacobian = beam_jacobian(parameters, reference_pose_deg)
    slopes = {"left": jacobian[0, 0], "right": jacobian[0, 0], "up": jacobian[1, 1], "down": jacobian[1, 1]}
    return {name: float(parameters[f"degrees_per_step.{name}"] * slope) for name, slope in slopes.items()}


def effective_mirror_offset_mm(parameters: Mapping[str, float], pose_deg: tuple[float, float]) -> float:
    """Signed distance of the beam line from the pan axis at a pose, +L for the nominal rig, mm.

    (d_y o_x - d_x o_y) / sqrt(d_x^2 + d_y^2) with origin o and direction d in P: the beam's moment about
    the pan axis over its horizontal length.
    """
    o, d = mirror_chain(*np.radians(pose_deg), parameters)
    return float((d[1] * o[0] - d[0] * o[1]) / np.hypot(d[0], d[1]))


def harmonics_deg(parameters: Mapping[str, float], axis: str) -> list[complex]:
    """Transmission error of an axis as `transmission` takes it; a rig that names none has none."""
    names = [f"harmonic_deg.{axis}.{order}" for order in HARMONIC_ORDERS]
    return [complex(parameters.get(f"{name}.cos", 0.0), -parameters.get(f"{name}.sin", 0.0)) for name in names]

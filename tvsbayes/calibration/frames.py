"""The frames of a ray (formulation 2): T and P of the positioner, S of the stereo pair, the left camera's in OpenCV.

S and camera are related to P by the extrinsics of the fit: rotation vector, rad, and translation, mm, of T_SP. NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tvsbayes.errors import InputError
from tvsbayes.instrument.parameters import names_of
from tvsbayes.instrument.stereo_pair import rotation_matrix

FRAMES = ("T", "P", "S", "camera")
EXTRINSICS_NAMES = names_of("extrinsics.rotation_rad", "extrinsics.translation_mm")
NO_POSE = np.zeros((0, len(EXTRINSICS_NAMES)))
"""Empty draws, of a calibration with moments only."""
P_INPUTS: Mapping[str, float] = {"pan_zero_emission_deg": 90.0, "baseline_mm": 0.0}
"""Inputs for which frame T equals frame P: p_T = Rz(C0 - 90 deg) p_P + (0, a/2, 0)."""
OPENCV_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""From S to OpenCV's axes of the left camera, x right, y down, z along its view: X = z_cv, Y = -x_cv, Z = -y_cv."""
ROTATION_STEP_RAD = 1e-5
"""Step of central differences of a rotation: truncation 1e-11, rounding 1e-11."""


def refuse_frame(frame: str, extrinsics: np.ndarray) -> None:
    """Refuse an unknown frame, or one that this calibration cannot give.

    Raises:
        InputError: either.
    """
    if frame not in FRAMES:
        allowed = ", ".join(FRAMES)
        raise InputError("frame", f"frame {frame!r}: unknown", allowed=allowed, remedy="name one of them")
    if frame in ("S", "camera") and not len(extrinsics):
        raise InputError(
            "no-extrinsics",
            f"frame {frame}: this calibration does not say where the cameras stand",
            allowed="frame T or P",
            remedy="load it from the results/ of its campaign: an exported JSON holds no pose of the cameras",
        )


def camera_rotation(extrinsics: np.ndarray, frame: str) -> np.ndarray:
    """Compute the rotation (3, 3) from P to S or the camera's axes; `extrinsics` (6,): rotation vector, translation."""
    rotation = rotation_matrix(extrinsics[:3])
    return OPENCV_AXES @ rotation if frame == "camera" else rotation


def in_cameras(ray: np.ndarray, extrinsics: np.ndarray, frame: str) -> np.ndarray:
    """Transform a ray of frame P, origin and direction (6,), to frame S or the camera's."""
    turn, shift = camera_rotation(extrinsics, frame), extrinsics[3:]
    return np.r_[turn @ ray[:3] + (OPENCV_AXES @ shift if frame == "camera" else shift), turn @ ray[3:]]


def camera_slopes(ray: np.ndarray, extrinsics: np.ndarray, frame: str) -> np.ndarray:
    """Compute derivatives of `in_cameras` by the ray, then by the extrinsics, shape (6, 12)."""
    turn = camera_rotation(extrinsics, frame)
    slopes = np.zeros((6, 12))
    slopes[:3, :3] = slopes[3:, 3:6] = turn
    for column, step in enumerate(ROTATION_STEP_RAD * np.eye(6)):
        ends = [in_cameras(ray, extrinsics + sign * step, frame) for sign in (1, -1)]
        slopes[:, 6 + column] = (ends[0] - ends[1]) / (2 * ROTATION_STEP_RAD)
    return slopes

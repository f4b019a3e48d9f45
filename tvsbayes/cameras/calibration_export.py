"""A calibrated pair as files of OpenCV and ROS; neither format keeps the covariance. Lengths: OpenCV mm, ROS metres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from tvsbayes.instrument.stereo_pair import Stereo

MM_PER_M = 1000.0
MATRIX_TAG = "!!opencv-matrix"
Format = Literal["opencv", "ros"]
EXPORT_NAMES: dict[Format, tuple[str, str]] = {
    "opencv": ("intrinsics.yml", "extrinsics.yml"),
    "ros": ("left.yaml", "right.yaml"),
}
"""The files of an export."""


def exported(stereo: Stereo, form: Format) -> dict[str, bytes]:
    """The files for another tool, by name; none of them keeps the covariance.

    `opencv`: `intrinsics.yml` (M1 D1 M2 D2, image size) and `extrinsics.yml` (R T R1 R2 P1 P2 Q) of the stereo
    sample, mm. `ros`: `left.yaml` and `right.yaml`, camera_info, metres.
    """
    import cv2

    size = (stereo.image_width, stereo.image_height)
    # alpha = 0: only pixels of both cameras, the default of ROS' calibrator and of OpenCV's sample.
    R1, R2, P1, P2, Q, *_ = cv2.stereoRectify(
        stereo.M1, stereo.D1, stereo.M2, stereo.D2, size, stereo.R, stereo.T.reshape(3, 1), alpha=0
    )
    if form == "opencv":
        inner = {"M1": stereo.M1, "D1": stereo.D1[None], "M2": stereo.M2, "D2": stereo.D2[None]}
        outer = {"R": stereo.R, "T": stereo.T[:, None], "R1": R1, "R2": R2, "P1": P1, "P2": P2, "Q": Q}
        sizes = {"image_width": size[0], "image_height": size[1]}
        return dict(zip(EXPORT_NAMES[form], (_opencv_text(inner, sizes), _opencv_text(outer, {})), strict=True))
    files = {}
    cameras = (("left", stereo.M1, stereo.D1, R1, P1), ("right", stereo.M2, stereo.D2, R2, P2))
    for file, (name, matrix, distortion, turn, projection) in zip(EXPORT_NAMES[form], cameras, strict=True):
        in_metres = np.array(projection, float)
        in_metres[:, 3] /= MM_PER_M
        matrices = {
            "camera_matrix": matrix,
            "distortion_coefficients": distortion[None],
            "rectification_matrix": turn,
            "projection_matrix": in_metres,
        }
        files[file] = _ros_text(name, size, matrices)
    return files


def _opencv_text(matrices: Mapping[str, np.ndarray], numbers: Mapping[str, int]) -> bytes:
    """OpenCV's YAML 1.0 of 2-D matrices, read equally by 4.x and 5.x."""
    lines = ["%YAML:1.0", "---", *(f"{key}: {value}" for key, value in numbers.items())]
    for key, matrix in matrices.items():
        lines += [f"{key}: {MATRIX_TAG}", *_entries(matrix, "   ", "[ {} ]", "dt: d")]
    return ("\n".join(lines) + "\n").encode()


def _ros_text(name: str, size: tuple[int, int], matrices: Mapping[str, np.ndarray]) -> bytes:
    lines = [f"image_width: {size[0]}", f"image_height: {size[1]}", f"camera_name: {name}"]
    for key, matrix in matrices.items():
        lines += ["distortion_model: plumb_bob"] * (key == "distortion_coefficients")
        lines += [f"{key}:", *_entries(matrix, "  ", "[{}]")]
    return ("\n".join(lines) + "\n").encode()


def _entries(matrix: np.ndarray, indent: str, form: str, *format_lines: str) -> list[str]:
    """Rows, columns, further lines of a format, and the numbers as a list in that format."""
    rows, cols = matrix.shape
    data = form.format(", ".join(map(repr, map(float, matrix.ravel()))))
    return [f"{indent}{entry}" for entry in (f"rows: {rows}", f"cols: {cols}", *format_lines, f"data: {data}")]

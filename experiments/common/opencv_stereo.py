"""OpenCV's calibration of a stereo pair from corners of a board."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np


def calibrated(
    points_mm: np.ndarray, sides: Sequence, size: tuple[int, int], flags: int, *, lens: int = 0, ends: tuple[int, float]
) -> tuple:
    """Each camera by itself, then both together as the flags say: rms, M1, D1, M2, D2, R, T.

    Args:
        points_mm: of the board, (corners, 3).
        sides: views of the left and of the right camera, (corners, 2) each.
        size: of a picture, px.
        flags: of `cv2.stereoCalibrate`.
        lens: flags of both steps.
        ends: steps and tolerance of the second one.
    """
    left, right = ([np.ascontiguousarray(view, np.float32) for view in side] for side in sides)
    shown = [points_mm.astype(np.float32)] * len(left)
    alone = [cv2.calibrateCamera(shown, side, size, None, None, flags=lens)[1:3] for side in (left, right)]
    criteria = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, *ends)
    starts = (left, right, *alone[0], *alone[1], size)
    return tuple(cv2.stereoCalibrate(shown, *starts, flags=flags | lens, criteria=criteria)[:7])

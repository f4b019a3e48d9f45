"""The paper's rectified pictures: conversion back to raw pixels."""

from __future__ import annotations

import cv2
import numpy as np
from support.drawn_spots import small_pair

from tvsbayes.cameras.contour import rectified_pair


def test_contour_is_converted_to_raw_pixels():
    """Against OpenCV's forward conversion."""
    stereo = small_pair()
    raw = np.random.default_rng(1).uniform([20, 20], [300, 220], (50, 2))
    for camera in rectified_pair(stereo):
        forward = cv2.undistortPoints(
            raw[:, None], camera.matrix, camera.distortion, R=camera.rotation, P=camera.projection
        ).reshape(-1, 2)
        # undistortPoints stops after five iterations: hundredths of a pixel.
        np.testing.assert_allclose(camera.raw(forward), raw, atol=0.05)

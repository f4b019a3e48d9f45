"""Laser spots drawn by the twin's cameras at 320 x 240 px, so that a test can afford dozens of looks."""

from __future__ import annotations

import numpy as np

from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix
from tvsbayes.twin.spot_pictures import Footprint, Scene, Sensor, render_spot

WIDTH, HEIGHT = 320, 240


def small_pair() -> Stereo:
    """Two cameras of 320 x 240 px, 85 mm apart, whose calibration is known to 0.1 px and 0.05 mm."""
    matrix = np.array([[200.0, 0, 161.0], [0, 201.0, 118.0], [0, 0, 1.0]])
    sds = np.array([*([0.1] * 4 + [1e-4] * 2 + [1e-5] * 2 + [1e-4]) * 2, *[1e-4] * 3, *[0.05] * 3])
    return Stereo(
        image_width=WIDTH,
        image_height=HEIGHT,
        M1=matrix,
        D1=np.array([-0.3, 0.1, 3e-4, -5e-4, -0.01]),
        M2=matrix + np.array([[-1.0, 0, 2], [0, -1, 3], [0, 0, 0]]),
        D2=np.array([-0.29, 0.095, -2e-4, 4e-4, -0.009]),
        R=rotation_matrix(np.array([0.004, -0.006, 0.003])),
        T=np.array([-85.0, 0.2, -0.3]),
        parameter_covariance=np.diag(sds**2),
        rms_px=0.2,
    )


def oval(rng: np.random.Generator, sd: float) -> np.ndarray:
    """Covariance of a spot 1.2 times as long as wide, turned at random."""
    c, s = np.cos(angle := rng.uniform(0, np.pi)), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    return turn @ np.diag([1.2 * sd**2, sd**2 / 1.2]) @ turn.T


def picture(*marks: Footprint, scene: Scene | None = None) -> np.ndarray:
    """Several spots in one picture, without speckle."""
    scene = scene or Scene(speckle_contrast=0.0)
    pictures = [render_spot(mark, WIDTH, HEIGHT, scene, Sensor(), (1, k, 0)) for k, mark in enumerate(marks)]
    return np.maximum.reduce(pictures)

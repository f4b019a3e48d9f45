"""What the cameras see while a plan runs: spots found in live pictures, and pictures rendered for the twin.

Pixels as in spots.csv: raw, the integer at the centre of a pixel; mm in frame S. No JAX.
"""

from __future__ import annotations

import numpy as np

from tvsbayes.device.camera import StereoImage
from tvsbayes.device.observation import Detection, Detector
from tvsbayes.device.renderer import Scene, Sensor, cameras_of, render_spots
from tvsbayes.device.spots import epipolar_refused, find_spot, pair_status
from tvsbayes.device.twin import Instrument, Light, Renderer
from tvsbayes.rigs import Rig, Stereo


def live_detector(stereo: Stereo) -> Detector:
    """Finds spots by the method `fit`, with the noise that a campaign's `detect` would begin with.

    `tvsbayes detect` learns the cameras' noise from all looks afterwards and is the better judge of their sds.

    Args:
        stereo: the calibration, for the epipolar check.
    """

    def found(lit: StereoImage, dark: StereoImage) -> Detection:
        left, right = find_spot(lit.left), find_spot(lit.right)
        status = pair_status(left, right)
        if status != "ok":
            return Detection(status)
        pixels = np.concatenate([left.centre_px, right.centre_px])
        covariance = np.zeros((4, 4))
        covariance[:2, :2], covariance[2:, 2:] = left.covariance_px2, right.covariance_px2
        if epipolar_refused(pixels[None], covariance[None], stereo)[0]:
            return Detection("epipolar")
        sds = np.sqrt(np.diag(covariance))
        correlations = covariance[0, 1] / (sds[0] * sds[1]), covariance[2, 3] / (sds[2] * sds[3])
        return Detection(
            "ok", tuple(map(float, pixels)), tuple(map(float, sds)), (float(correlations[0]), float(correlations[1]))
        )

    return found


def twin_renderer(rig: Rig, seed: int) -> Renderer:
    """Pictures of the true rig that a simulation with this seed draws.

    Args:
        rig: the declared rig.
        seed: of the simulation.
    """
    truth = Instrument(rig, seed).truth
    cameras = cameras_of(truth.stereo, truth.parameters["focal_scale"])
    scene, sensor = Scene(), Sensor()

    def pictures(light: Light, look: int, frame: int) -> StereoImage:
        made = render_spots(
            cameras, light.point_S_mm, light.direction_S, light.normal_S, scene, sensor, seed, look, frame
        )
        return StereoImage(made.left, made.right)

    return pictures

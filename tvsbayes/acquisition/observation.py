"""One look: a picture without laser light, one with it, and the spot found in them by a detector.

The laser is on only between the two pictures, and off afterwards in every case. Light also proves that no picture is
older than the look, for buffers of any depth. Pictures arrive in the order of exposure: a look waits for the spot to
appear after laser-on and to vanish after laser-off. The next look then begins with no lit picture in the buffers, and a
picture with a spot was exposed during it. A vanished spot also shows that the laser is off; a spot before laser-on is a
fault.

Raw px with the integer at the centre of a pixel; grey levels 0 to 255, also for pictures of 16 bits, stored unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from tvsbayes.acquisition.recorder import Four
from tvsbayes.cameras.capture import StereoCamera, StereoImage
from tvsbayes.cameras.contour import epipolar_refused
from tvsbayes.cameras.detection import pair_status
from tvsbayes.cameras.spot_fit import find_spot
from tvsbayes.cameras.spot_noise import SpotNoise
from tvsbayes.errors import fault
from tvsbayes.files.images import in_grey_levels, png_bytes
from tvsbayes.instrument.campaign import CAMERAS, UNDETECTED, frame_name
from tvsbayes.instrument.stereo_pair import Stereo
from tvsbayes.positioner.interface import Positioner

CHANGE_DN = 40
"""Change of a pixel, in grey levels, that counts as lit or as another scene: noise and JPEG stay below 10."""
WAIT_GRABS = 20
"""Number of grabs after which a missing spot counts as absent: each takes at least three frames, and no driver or
stream buffers sixty."""
SAME_PLACE_PX = 2.0
"""Upper bound of a spot's motion between two pictures of a scene at rest."""
UNSTEADY = "unsteady"
"""Status of a look whose background changed: by a person in the picture, or by ambient light."""


@dataclass(frozen=True)
class DetectedSpot:
    """The result of a detector for a pair of pictures.

    Attributes:
        status: "ok", "undetected", or the reason of refusal.
        pixels_px: u_left, v_left, u_right, v_right; None without a spot.
        sds_px: their standard uncertainties.
        correlations: correlation of u and v, left and right.
    """

    status: str
    pixels_px: Four | None = None
    sds_px: Four | None = None
    correlations: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Observation:
    """A detected spot with its pictures, PNG by name relative to the campaign's folder."""

    spot: DetectedSpot
    pictures: dict[str, bytes] = field(default_factory=dict)


class Detector(Protocol):
    """Finds the spot in a pair of pictures."""

    def __call__(self, lit: StereoImage, dark: StereoImage) -> DetectedSpot:
        """Find the spot: `lit` has the laser on, `dark` was taken just before; both state their full scale."""


class Observer(Protocol):
    """Takes a look with a positioner at rest."""

    def observe(self, positioner: Positioner, spot: int) -> Observation:
        """Take look number `spot`; the laser is off before and after."""


def wait_for_detection(lit: StereoImage, dark: StereoImage) -> DetectedSpot:
    """The detector for a later detection: every look is `undetected`."""
    return DetectedSpot(UNDETECTED)


@dataclass
class CameraObserver:
    """Takes looks with cameras.

    Attributes:
        camera: the pair.
        detector: finds the spots.
        keep_pictures: whether pictures go into the campaign's folder.
    """

    camera: StereoCamera
    detector: Detector = wait_for_detection
    keep_pictures: bool = True
    _white: int = field(default=0, init=False, repr=False)

    def observe(self, positioner: Positioner, spot: int) -> Observation:
        """See `Observer.observe`.

        Raises:
            DeviceFault: a camera repeats a picture, or the laser went off during the exposure, stayed on, or was on
                before.
        """
        positioner.laser(False)
        dark = self._grab()
        try:
            positioner.laser(True)
            lit, on = self._lit(positioner, dark)
        finally:
            positioner.laser(False)
        if not on:
            remedy = "raise the frame rate of the cameras, or the watchdog time of the firmware"
            raise fault("watchdog", "the laser went off during the exposure", remedy)
        self._wait_for_darkness(dark)
        pictures = {}
        if self.keep_pictures:
            pictures = {
                frame_name(spot, camera, folder): png_bytes(getattr(pair, camera))
                for folder, pair in (("frames", lit), ("dark", dark))
                for camera in CAMERAS
            }
        unsteady = max(rises_dn(lit, dark)) > CHANGE_DN
        detected = DetectedSpot(UNSTEADY) if unsteady else self.detector(lit, dark)
        if detected.status == "ok" and min(rises_dn(dark, lit)) <= CHANGE_DN:
            self._require_new(detected, dark)
        return Observation(detected, pictures)

    def _grab(self) -> StereoImage:
        """Grab a pair with its full scale, from the driver or else from the brightest pixel so far.

        Two dark pictures of 12 bits alone would be taken for 8 bits, and their noise for light.
        """
        pair = self.camera.grab()
        self._white = max(self._white, pair.full_scale)
        return replace(pair, white=self._white)

    def _lit(self, positioner: Positioner, dark: StereoImage) -> tuple[StereoImage, bool]:
        """Take a picture with the laser on; also return whether the laser was on to the end of its exposure."""
        for number in range(WAIT_GRABS):
            lit = self._grab()
            # Sensor noise makes any two exposures differ.
            if np.array_equal(lit.left, dark.left) or np.array_equal(lit.right, dark.right):
                remedy = "unplug the camera and plug it in again, then go on with --resume"
                raise fault("frozen", "a camera delivers the same picture again and again", remedy)
            if min(rises_dn(dark, lit)) > CHANGE_DN:
                if number:
                    # The laser came on during the first lit exposure, or an older one: take a fully lit one.
                    lit = self._grab()
                break
            if not positioner.state().laser_on:
                return lit, False
        return lit, positioner.state().laser_on

    def _require_new(self, spot: DetectedSpot, dark: StereoImage) -> None:
        """Refuses a spot that the picture without laser light also shows: a laser that is always on, or a lamp."""
        dark_px = self.detector(dark, dark).pixels_px
        if dark_px is None or spot.pixels_px is None:
            return
        if max(abs(a - b) for a, b in zip(dark_px, spot.pixels_px, strict=True)) < SAME_PLACE_PX:
            remedy = "cut the laser's supply at once; if it is off, cover what else shines in the picture"
            raise fault("light", "the spot is there with the laser off, too", remedy)

    def _wait_for_darkness(self, dark: StereoImage) -> None:
        for _ in range(WAIT_GRABS):
            if max(rises_dn(dark, self._grab())) <= CHANGE_DN:
                return
        remedy = "cut the laser's supply at once; if it is off, something else in the room has become bright"
        raise fault("light", "the spot does not vanish with the laser off", remedy)


def rises_dn(before: StereoImage, after: StereoImage) -> tuple[int, int]:
    """Largest increase of a pixel, left and right, grey levels of 8 bits."""
    import cv2

    white = max(before.full_scale, after.full_scale)
    pairs = (before.left, after.left), (before.right, after.right)
    left, right = (int(in_grey_levels(cv2.subtract(lit, dark), white).max()) for dark, lit in pairs)
    return left, right


def live_detector(stereo: Stereo) -> Detector:
    """Make a detector by the method `fit`, with the noise with which `detect` starts.

    `tvsbayes detect` later estimates the cameras' noise from all looks and gives more reliable sds.

    Args:
        stereo: the calibration, for the epipolar check.
    """

    def detect(lit: StereoImage, dark: StereoImage) -> DetectedSpot:
        white = max(lit.full_scale, dark.full_scale)
        left, right = (find_spot(picture, SpotNoise(), white) for picture in (lit.left, lit.right))
        status = pair_status(left, right)
        if status != "ok":
            return DetectedSpot(status)
        pixels = np.concatenate([left.centre_px, right.centre_px])
        covariance = np.zeros((4, 4))
        covariance[:2, :2], covariance[2:, 2:] = left.covariance_px2, right.covariance_px2
        if epipolar_refused(pixels[None], covariance[None], stereo)[0]:
            return DetectedSpot("epipolar")
        sds = np.sqrt(np.diag(covariance))
        correlations = covariance[0, 1] / (sds[0] * sds[1]), covariance[2, 3] / (sds[2] * sds[3])
        u, v, x, y = pixels.tolist()
        su, sv, sx, sy = sds.tolist()
        return DetectedSpot("ok", (u, v, x, y), (su, sv, sx, sy), (float(correlations[0]), float(correlations[1])))

    return detect

"""One look: a picture without laser light, one with it, and what a detector finds in them.

The laser is on only between the two pictures, and off again whatever happens. Raw px with the integer at the centre
of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from tvsbayes.device.camera import StereoCamera, StereoImage
from tvsbayes.device.driver import Positioner
from tvsbayes.device.twin import Instrument
from tvsbayes.files import DeviceFault, png_bytes

UNDETECTED = "undetected"
"""Status of a look whose frames wait for a detection (DESIGN 7)."""


@dataclass(frozen=True)
class Detection:
    """What was found in a pair of pictures.

    Attributes:
        status: "ok", "undetected", or the reason of refusal.
        pixels_px: u_left, v_left, u_right, v_right; None where there is no spot.
        sds_px: their standard uncertainties.
        correlations: of u and v, left and right.
    """

    status: str
    pixels_px: tuple[float, float, float, float] | None = None
    sds_px: tuple[float, float, float, float] | None = None
    correlations: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Observation:
    """A detection and the pictures behind it, PNG by name relative to the campaign's folder."""

    detection: Detection
    pictures: dict[str, bytes] = field(default_factory=dict)


class Detector(Protocol):
    """Finds the spot in a pair of pictures."""

    def __call__(self, lit: StereoImage, dark: StereoImage) -> Detection:
        """`lit` with the laser on, `dark` just before without it."""


class Observer(Protocol):
    """Takes a look with a positioner at rest."""

    def observe(self, positioner: Positioner, spot: int) -> Observation:
        """Look number `spot`; the laser is off before and after."""


def wait_for_detection(lit: StereoImage, dark: StereoImage) -> Detection:
    """The detector of those who detect later: every look is `undetected`."""
    return Detection(UNDETECTED)


@dataclass
class CameraObserver:
    """Looks with cameras.

    Attributes:
        camera: the pair.
        detector: finds the spots.
        keep_pictures: whether they go into the campaign's folder.
    """

    camera: StereoCamera
    detector: Detector = wait_for_detection
    keep_pictures: bool = True

    def observe(self, positioner: Positioner, spot: int) -> Observation:
        """See `Observer.observe`.

        Raises:
            DeviceFault: the camera repeats one picture, or the laser went off while it was exposed.
        """
        positioner.laser(False)
        dark = self.camera.grab()
        try:
            positioner.laser(True)
            lit = self.camera.grab()
            state = positioner.state()
        finally:
            positioner.laser(False)
        if not state.laser_on:
            remedy = "raise the frame rate of the cameras, or the watchdog time of the firmware"
            raise DeviceFault("watchdog", f"the laser went off during the exposure; {remedy}", remedy=remedy)
        # Sensor noise makes two exposures differ, whatever they show.
        if np.array_equal(lit.left, dark.left) or np.array_equal(lit.right, dark.right):
            remedy = "unplug the camera and plug it in again, then go on with --resume"
            raise DeviceFault("frozen", f"a camera delivers the same picture again and again; {remedy}", remedy=remedy)
        pictures = {}
        if self.keep_pictures:
            pairs = {"frames": lit, "dark": dark}
            pictures = {
                f"{folder}/{spot:06d}_{side}.png": png_bytes(getattr(pair, side))
                for folder, pair in pairs.items()
                for side in ("left", "right")
            }
        return Observation(self.detector(lit, dark), pictures)


@dataclass
class TwinObserver:
    """Looks at the digital twin without pictures: the centroids that a detector would state, noise included.

    Attributes:
        instrument: the simulated one.
        sd_px: standard uncertainty stated for every coordinate.
    """

    instrument: Instrument
    sd_px: float

    def observe(self, positioner: Positioner, spot: int) -> Observation:
        """See `Observer.observe`."""
        try:
            positioner.laser(True)
            pixels = self.instrument.noisy_centroid_px(self.sd_px)
        finally:
            positioner.laser(False)
        if not np.isfinite(pixels).all():
            return Observation(Detection("no-spot"))
        u_left, v_left, u_right, v_right = map(float, pixels)
        return Observation(Detection("ok", (u_left, v_left, u_right, v_right), (self.sd_px,) * 4))

"""The stereo cameras on OpenCV.

A picture is valid only if its exposure began after the request. Drivers keep old frames in their buffers, and frames
have no time stamp. Every `grab` therefore first empties the buffers. A buffered frame arrives as fast as it can be
decoded, a live one at the camera's rate, which is measured at opening. The first live frames may be older and are
dropped. A camera whose frames never need a wait is refused: they could be of any age. Where decoding takes as long as
the camera's period, both cases look the same; then the laser driver's test by light decides. Network streams are read
continuously (`network_stream`).

Pictures are (height, width, 3), blue, green, red, uint8 or uint16 from the camera: raw pixels, not rectified,
with full depth. Names with `_s` are in seconds.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from tvsbayes.cameras.network_stream import Capture, NetworkStream
from tvsbayes.errors import DeviceFault, InputError, escaped, fault
from tvsbayes.files.images import white_level
from tvsbayes.instrument.rig import Rig
from tvsbayes.positioner.interface import Clock

LIVE_S = 0.004
"""A frame that took less than this was certainly in a buffer: cameras up to 200 frames/s are slower."""
LIVE_SHARE = 0.7
"""Share of the camera's period that a frame must take to count as live."""
RATE_FRAMES, RATE_S = 12, 0.4
"""Least number of frames and seconds for the measurement of the rate at opening; the last eight frames are used."""
PIPELINE_FRAMES = 2
"""Number of live frames to leave out: one was being exposed at the request, one may be in transfer."""
FLUSH_FRAMES_MAX = 2_000
FLUSH_MAX_S = 10.0
"""Limits for emptying the buffers, in frames and in seconds: sockets hold some hundred small frames."""
STREAM_TIMEOUT_MS = 5_000
FFMPEG_QUIET = "-8"
"""FFmpeg's AV_LOG_QUIET."""


@dataclass(frozen=True, eq=False)
class StereoImage:
    """Two pictures of one moment, each (height, width, 3) uint8 or uint16, blue, green, red.

    `white` is the largest possible value of a pixel, None where the driver does not state it.
    """

    left: np.ndarray
    right: np.ndarray
    white: int | None = None

    @property
    def full_scale(self) -> int:
        """The full scale stated by the driver, else that of the smallest usual converter."""
        return self.white or white_level(max(int(self.left.max()), int(self.right.max())))


@dataclass(frozen=True)
class CameraSettings:
    """Settings that the cameras report.

    Attributes:
        values: readings by name and camera, e.g. "left.exposure"; without settings that a camera does not report.
        warnings: settings that could not be fixed, in words.
    """

    values: dict[str, float]
    warnings: tuple[str, ...] = ()


class StereoCamera(Protocol):
    """A pair of cameras with any driver."""

    def grab(self) -> StereoImage:
        """Take a pair whose exposure began after this call."""

    def settings(self) -> CameraSettings:
        """Current exposure, gain, white balance and focus."""

    def close(self) -> None:
        """Release the cameras; never raises."""


@contextmanager
def _quiet_opencv() -> Iterator[None]:
    """Suppresses warnings of OpenCV and its FFmpeg on stderr: failures are raised, with a remedy.

    A user's OPENCV_LOG_LEVEL or OPENCV_FFMPEG_LOGLEVEL has priority. FFmpeg reads its variable once, at the first
    stream that a process opens.
    """
    import cv2

    logging = cv2.utils.logging
    previous = None if "OPENCV_LOG_LEVEL" in os.environ else logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    ffmpeg = "OPENCV_FFMPEG_LOGLEVEL" not in os.environ
    if ffmpeg:
        os.environ["OPENCV_FFMPEG_LOGLEVEL"] = FFMPEG_QUIET
    try:
        yield
    finally:
        if ffmpeg:
            os.environ.pop("OPENCV_FFMPEG_LOGLEVEL", None)
        if previous is not None:
            logging.setLogLevel(previous)


def without_password(source: str) -> str:
    """The source for messages and logs: addresses lose user and password."""
    return re.sub(r"://[^/?#]*@", "://", source)


def open_capture(source: str | int) -> Capture:
    """Open a device by number or path, or a stream by address.

    Raises:
        DeviceFault: it cannot be opened.
    """
    import cv2

    if isinstance(source, str) and source.isascii() and source.isdigit() and len(source) <= 4:
        source = int(source)
    if isinstance(source, str) and "://" in source:
        if not source.startswith(("http://", "https://", "rtsp://")):
            remedy = "give a device number, a device path, or an http, https or rtsp address"
            found = escaped(without_password(source))
            raise InputError("camera", f"[cameras] source {found} is no camera", remedy=remedy)
        return NetworkStream(partial(_open_stream, source))
    return _opened(cv2.VideoCapture(source), source)


def _open_stream(address: str) -> Capture:
    """Open a stream with time limits for opening and reading."""
    import cv2

    timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, STREAM_TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, STREAM_TIMEOUT_MS]
    with _quiet_opencv():
        return _opened(cv2.VideoCapture(address, cv2.CAP_FFMPEG, timeouts), address)


def _opened(capture: Any, source: str | int) -> Capture:
    if not capture.isOpened():
        capture.release()
        remedy = "check [cameras] in the rig file, the cable, and that no other program has the camera"
        raise fault("camera", f"camera {escaped(without_password(str(source)))} cannot be opened", remedy)
    return capture


def open_cameras(
    table: Mapping[str, str | int | float],
    width: int,
    height: int,
    opener: Callable[[str | int], Capture] = open_capture,
    clock: Clock = time,
) -> OpenCVCamera:
    """Open the cameras of `[cameras]` in a rig file: `source` side by side, or `left` and `right`.

    Raises:
        InputError: neither or both are stated.
        DeviceFault: they cannot be opened or set.
    """
    two_devices = "left" in table and "right" in table
    if two_devices == ("source" in table):
        remedy = "give source = ... (side by side), or left = ... and right = ..."
        raise InputError("cameras", "[cameras] of the rig file names no cameras", column="cameras", remedy=remedy)
    captures: list[Capture] = []
    exposure = float(table["exposure"]) if "exposure" in table else None
    with _quiet_opencv():
        try:
            for source in (table[key] for key in (("left", "right") if two_devices else ("source",))):
                captures.append(opener(source if isinstance(source, str) else int(source)))
        except BaseException:
            for capture in captures:
                capture.release()
            raise
        return OpenCVCamera(captures, width, height, exposure, clock)


def opencv_cameras(rig: Rig) -> OpenCVCamera:
    """The driver `opencv`.

    Raises:
        InputError: `[cameras]` names no cameras.
        DeviceFault: they cannot be opened or set.
    """
    return open_cameras(rig.cameras, rig.stereo_pair.image_width, rig.stereo_pair.image_height)


class OpenCVCamera:
    """Two devices, or one that delivers both pictures side by side.

    Args:
        captures: one (side by side) or two (left, right) open captures; this object closes them.
        width: width of one picture, px.
        height: height of one picture, px.
        exposure: in the driver's unit; None switches the automatic mode off and keeps the current exposure.
        clock: source of time.

    Raises:
        DeviceFault: the exposure does not read back as set.
    """

    def __init__(
        self, captures: Sequence[Capture], width: int, height: int, exposure: float | None = None, clock: Clock = time
    ):
        self._captures, self._clock = list(captures), clock
        self._width, self._height = width, height
        self._warnings: list[str] = []
        try:
            for name, capture in zip(self._names, self._captures, strict=True):
                self._fix(name, capture, exposure)
            self._period_s = [self._measured_period_s(capture) for capture in self._captures]
        except BaseException:
            self.close()
            raise

    @property
    def _names(self) -> tuple[str, ...]:
        return ("left", "right") if len(self._captures) == 2 else ("stereo",)

    def _fix(self, name: str, capture: Capture, exposure: float | None) -> None:
        """Switch off all automatic modes, set size and exposure; a refused setting is a fault or a warning."""
        import cv2

        # One frame in the buffer, if the driver allows it, leaves less to empty.
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._width * (1 if len(self._captures) == 2 else 2))
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._height)
        fixed = {
            "automatic exposure": capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _manual_exposure(capture)),
            "white balance": capture.set(cv2.CAP_PROP_AUTO_WB, 0),
            "focus": capture.set(cv2.CAP_PROP_AUTOFOCUS, 0),
        }
        refused = [setting for setting, accepted in fixed.items() if not accepted]
        if refused:
            self._warnings.append(f"{name}: {', '.join(refused)} cannot be fixed from here; fix it at the camera")
        if exposure is None:
            return
        accepted, reported = capture.set(cv2.CAP_PROP_EXPOSURE, exposure), capture.get(cv2.CAP_PROP_EXPOSURE)
        # Drivers round to their own steps; tolerance: 5 % of the value, or one unit.
        if not accepted or abs(reported - exposure) > max(0.05 * abs(exposure), 1.0):
            found = f"{name}: exposure {exposure:g} was set and {reported:g} read back"
            remedy = "leave [cameras] exposure out and fix it at the camera, or give a value the driver takes"
            raise fault("exposure", found, remedy)

    def settings(self) -> CameraSettings:
        """See `StereoCamera.settings`."""
        import cv2

        properties = {
            "exposure": cv2.CAP_PROP_EXPOSURE,
            "auto_exposure": cv2.CAP_PROP_AUTO_EXPOSURE,
            "gain": cv2.CAP_PROP_GAIN,
            "white_balance_K": cv2.CAP_PROP_WB_TEMPERATURE,
            "auto_white_balance": cv2.CAP_PROP_AUTO_WB,
            "focus": cv2.CAP_PROP_FOCUS,
            "frames_per_s": cv2.CAP_PROP_FPS,
        }
        values = {}
        for name, capture in zip(self._names, self._captures, strict=True):
            for key, prop in properties.items():
                value = float(capture.get(prop))
                if np.isfinite(value) and value not in (0.0, -1.0):
                    values[f"{name}.{key}"] = value
        return CameraSettings(values, tuple(self._warnings))

    def grab(self) -> StereoImage:
        """See `StereoCamera.grab`.

        Raises:
            DeviceFault: no frame, a frame of another size, or a camera whose frames never need a wait.
        """
        for capture, period_s in zip(self._captures, self._period_s, strict=True):
            self._flush(capture, max(LIVE_S, LIVE_SHARE * period_s))
        for name, capture in zip(self._names, self._captures, strict=True):
            if not capture.grab():
                raise _no_frame(name)
        return self._split([self._retrieve(n, c) for n, c in zip(self._names, self._captures, strict=True)])

    def _measured_period_s(self, capture: Capture) -> float:
        """Time between two live frames, s."""
        times = [self._clock.monotonic()]
        while len(times) <= RATE_FRAMES or times[-1] - times[0] < RATE_S:
            if len(times) > FLUSH_FRAMES_MAX or not capture.grab():
                break
            times.append(self._clock.monotonic())
        return float(np.median(np.diff(times)[-8:])) if len(times) > 1 else 0.0

    def _flush(self, capture: Capture, live_s: float) -> None:
        """Take frames until the next one was exposed after this call."""
        start = previous = self._clock.monotonic()
        live = 0
        for _ in range(FLUSH_FRAMES_MAX):
            if not capture.grab():
                raise _no_frame(self._names[self._captures.index(capture)])
            now = self._clock.monotonic()
            live += now - previous > live_s
            if live >= PIPELINE_FRAMES:
                return
            if now - start > FLUSH_MAX_S:
                break
            previous = now
        remedy = "lower the frame rate of the camera, or serve its stream at the rate of the exposures"
        raise fault("stale", "the camera's frames never have to be waited for", remedy)

    def _retrieve(self, name: str, capture: Capture) -> np.ndarray:
        ok, picture = capture.retrieve()
        if not ok or picture is None:
            raise _no_frame(name)
        expected = self._height, self._width * (1 if len(self._captures) == 2 else 2)
        if picture.shape[:2] != expected or picture.dtype not in (np.uint8, np.uint16):
            found = f"{name}: pictures of {picture.shape[1]} x {picture.shape[0]} px"
            remedy = f"{expected[1]} x {expected[0]} px were calibrated: set the camera to that size"
            raise fault("image-size", found, remedy)
        # Monochrome cameras deliver one channel.
        return (
            picture if picture.ndim == 3 and picture.shape[2] == 3 else np.repeat(picture.reshape(*expected, 1), 3, 2)
        )

    def _split(self, pictures: list[np.ndarray]) -> StereoImage:
        if len(pictures) == 2:
            return StereoImage(pictures[0], pictures[1])
        picture = pictures[0]
        return StereoImage(picture[:, : self._width].copy(), picture[:, self._width :].copy())

    def close(self) -> None:
        """See `StereoCamera.close`."""
        for capture in self._captures:
            capture.release()
        self._captures = []


def _manual_exposure(capture: Capture) -> int:
    """The value of CAP_PROP_AUTO_EXPOSURE for manual: V4L2_EXPOSURE_MANUAL = 1 with Video4Linux, elsewhere 0.

    On Windows 1 would switch the automatic mode on (opencv pull request 22635).
    """
    return 1 if capture.getBackendName() == "V4L2" else 0


def _no_frame(name: str) -> DeviceFault:
    remedy = "check its cable and USB port, and that no other program has it; then go on with --resume"
    return fault("no-frame", f"camera {name} delivers no frame", remedy)

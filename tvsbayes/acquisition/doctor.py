"""Checks of an instrument before a campaign, each with its remedy.

Nothing moves except in `contract`. The laser stays off unless the caller requests the laser check, and is then on for
one picture; a positioner that is not homed refuses it. Seconds where a name says `_s`; grey levels 0 to 255.
"""

from __future__ import annotations

import os
import shutil
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from tvsbayes.acquisition.driver_contract import camera_violations, positioner_violations
from tvsbayes.acquisition.drivers import cameras_of, connect_trigger, positioner_of
from tvsbayes.acquisition.journal import Disk
from tvsbayes.acquisition.observation import CHANGE_DN, rises_dn
from tvsbayes.acquisition.operator import StopKey
from tvsbayes.cameras.capture import StereoCamera
from tvsbayes.errors import TvsError, escaped
from tvsbayes.files.images import in_grey_levels
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.rig import Rig
from tvsbayes.positioner.interface import DEFAULT_DRIVER, SEE_DOCTOR, Clock, Positioner
from tvsbayes.positioner.protocol import FIRMWARE_VERSION
from tvsbayes.positioner.serial_port import serial_ports

PJRC = 0x16C0
"""USB vendor of the Teensy."""
ON_PORTS = ("serial", "grbl")
"""Drivers of a board on a serial port."""
DISK_FREE_BYTES = 5 * 10**9
"""Free space for about 700 looks of four PNG of 1280 x 720 px, 1.8 MB each."""
FLUSH_SLOW_S = 0.1
"""A flush takes about 4 ms on a solid-state disk; five of them per look at this rate cost half a second."""
ROUND_TRIP_SLOW_S = 0.05
ROUND_TRIPS = 20
CLIPPED_SHARE_MAX = 0.001
DARK_MEAN_MIN = 2.0
BRIGHT_MEAN_MAX = 150.0
"""Range of the mean grey level without laser: below, the cap may be on; above, ambient light hides the spot."""
SHARPNESS_MIN = 3.0
"""Variance of the Laplacian, grey levels squared; a picture out of focus has only the sensor's noise."""


@dataclass(frozen=True)
class Check:
    """One result: `status` is "ok", "warning", "fault" or "skipped"; `remedy` is "" for ok."""

    name: str
    status: str
    found: str
    remedy: str = ""


class _Checks(list[Check]):
    """Results in the order in which to remove their faults."""

    def judge(self, name: str, found: str, remedy: str = "") -> None:
        """Add a warning where there is a remedy, else "ok"."""
        self.append(Check(name, "warning" if remedy else "ok", found, remedy))

    def failed(self, name: str, error: TvsError) -> None:
        """Add the fault of an error."""
        remedy = error.remedy or ""
        found = error.found or error.message.removesuffix(f"; {remedy}")
        self.append(Check(name, "fault", found, remedy.removesuffix(SEE_DOCTOR) or "see the message"))


def examine(
    rig: Rig,
    folder: Path,
    *,
    laser: bool = False,
    open_positioner: Callable[[], Positioner] | None = None,
    open_camera: Callable[[], StereoCamera] | None = None,
    clock: Clock = time,
) -> list[Check]:
    """All checks of an instrument, in the order in which to remove their faults.

    Args:
        rig: the rig file.
        folder: folder into which campaigns will be written.
        laser: whether the laser may be switched on for one picture; the caller has stated the hazard.
        open_positioner: replaces the rig file's positioner.
        open_camera: replaces the rig file's cameras.
        clock: clock of the timings.
    """
    checks = _Checks()
    _rig(rig, checks)
    _disk(folder, clock, checks)
    if open_positioner is None:
        on_port = rig.positioner.get("driver", DEFAULT_DRIVER) in ON_PORTS
        if on_port:
            _port(rig, checks)
        if rig.positioner.get("port") or not on_port:
            open_positioner = partial(positioner_of, rig)
    with ExitStack() as stack:
        positioner = None if open_positioner is None else _positioner(open_positioner, clock, checks, stack)
        camera = _camera(rig, open_camera or partial(cameras_of, rig), positioner, clock, checks, stack)
        if positioner is None or camera is None:
            checks.append(Check("laser", "skipped", "needs positioner and cameras", "correct the faults above first"))
        elif not laser:
            checks.append(Check("laser", "skipped", "not requested", "run doctor with --laser, goggles on"))
        else:
            _laser(positioner, camera, checks)
    return checks


def contract(
    rig: Rig,
    *,
    open_positioner: Callable[[], Positioner] | None = None,
    open_camera: Callable[[], StereoCamera] | None = None,
) -> list[Check]:
    """Whether the drivers keep their promises: THE MOTORS MOVE AND THE LASER COMES ON; arguments as of `examine`.

    It homes, moves to a quarter and to three quarters of the stated limits, and asks for one step beyond them.
    """
    if rig.limits.unstated:
        found, remedy = f"{', '.join(rig.limits.unstated)} not stated", "state them in [positioner] of the rig file"
        return [Check("contract", "fault", found, remedy)]
    (a, b), (c, d) = ((low or 0, high or 0) for low, high in (rig.limits.steps[axis] for axis in AXES))
    quarter, three_quarters = ((a + k * (b - a) // 4, c + k * (d - c) // 4) for k in (1, 3))
    broken: dict[str, list[str]] = {}
    checks, stop = _Checks(), StopKey()
    # There is no look to finish: the first Ctrl-C interrupts, and the driver is closed.
    stop.requested = True
    size = rig.stereo_pair.image_width, rig.stereo_pair.image_height
    try:
        with stop:
            positioner = positioner_of(rig) if open_positioner is None else open_positioner()
            broken["positioner"] = positioner_violations(positioner, [quarter, three_quarters], (b + 1, quarter[1]))
            camera = cameras_of(rig) if open_camera is None else open_camera()
            broken["cameras"] = camera_violations(camera, *size)
    except TvsError as error:
        checks.failed("contract", error)
        return checks
    remedy = "the driver breaks a promise: see data/docs/instrument.md, Your own hardware"
    for name, sentences in broken.items():
        checks += [Check(f"contract {name}", "fault", sentence, remedy) for sentence in sentences]
        if not sentences:
            checks.judge(f"contract {name}", "every promise is kept")
    return checks


def _rig(rig: Rig, checks: _Checks) -> None:
    if missing := rig.limits.unstated:
        remedy = "state them in [positioner]: without them the firmware's own limits hold"
        checks.judge("limits", f"{', '.join(missing)} not stated", remedy)
    elif len(rig.sheets_mm) < 2:
        checks.judge("limits", "fewer than two sheets", "name two depths in [sheets]")
    else:
        checks.judge("limits", f"soft limits stated, {len(rig.sheets_mm)} sheets")


def _disk(folder: Path, clock: Clock, checks: _Checks) -> None:
    """Check free space and the duration of a flush."""
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    try:
        free = shutil.disk_usage(folder).free
        disk, path = Disk(), folder / f".tvsbayes-doctor-{os.getpid()}"
        start = clock.monotonic()
        descriptor = disk.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        try:
            disk.write(descriptor, b"x" * 4096)
            disk.fsync(descriptor)
        finally:
            disk.close(descriptor)
            path.unlink()
        seconds = clock.monotonic() - start
    except OSError as error:
        remedy = f"make {escaped(str(folder), 200)} writable, or name another folder"
        checks.append(Check("disk", "fault", escaped(error.strerror or str(error)), remedy))
        return
    remedy = f"free at least {DISK_FREE_BYTES / 1e9:.0f} GB for 700 looks" * (free < DISK_FREE_BYTES)
    checks.judge("disk", f"{free / 1e9:.1f} GB free", remedy)
    remedy = "write to a local disk, not to a network or a memory card" * (seconds > FLUSH_SLOW_S)
    checks.judge("disk flush", f"{1000 * seconds:.1f} ms", remedy)


def _port(rig: Rig, checks: _Checks) -> None:
    ports, stated = serial_ports(), rig.positioner.get("port")
    listed = ", ".join(f"{p.device} ({p.description or ''}{', Teensy' * (p.vid == PJRC)})" for p in ports) or "none"
    listed = escaped(listed, 400)
    shown = escaped(str(stated))
    if not stated:
        remedy = 'write port = "..." into [positioner] of the rig file'
        checks.append(Check("port", "fault", f"ports: {listed}", remedy))
    elif all(port.device != stated for port in ports) and not Path(str(stated)).exists():
        remedy = "plug the device in, or correct [positioner] port; on Linux join the group dialout"
        checks.append(Check("port", "fault", f"{shown} is not there; ports: {listed}", remedy))
    else:
        checks.judge("port", shown)


def _positioner(
    open_positioner: Callable[[], Positioner], clock: Clock, checks: _Checks, stack: ExitStack
) -> Positioner | None:
    """Check firmware, state and round-trip time."""
    try:
        positioner = open_positioner()
    except TvsError as error:
        checks.failed("firmware", error)
        return None
    stack.callback(positioner.close)
    version = escaped(positioner.identity.get("fw", "unknown"))
    unlike = version != FIRMWARE_VERSION and "driver" not in positioner.identity
    found = f"version {version}" + f", shipped is {FIRMWARE_VERSION}" * unlike
    checks.judge(
        "firmware", found, "flash the firmware shipped with tvsbayes; this one speaks the same protocol" * unlike
    )
    for warning in getattr(positioner, "warnings", ()):
        checks.judge("positioner", warning, "see data/docs/instrument.md, Your own hardware")
    times = []
    try:
        for _ in range(ROUND_TRIPS):
            start = clock.monotonic()
            state = positioner.state()
            times.append(clock.monotonic() - start)
        if state.laser_on:
            state = positioner.laser(False)
            checks.judge("laser line", "it was on", "look for a program that left it on")
    except TvsError as error:
        # Closed before the cameras are opened, which may take long: its laser may be on.
        stack.close()
        checks.failed("positioner", error)
        return None
    # Pressed by hand, switches show their wiring before any motion.
    pairs = zip(AXES, state.home_pressed, state.limit_open, strict=True)
    switches = (
        f"{axis}: home {'pressed' if home else 'free'}, limit {'open' if limit else 'closed'}"
        for axis, home, limit in pairs
    )
    remedy = "turn the axis back by hand; if it stands free, check the wire of its limit switches"
    checks.judge("switches", "; ".join(switches), remedy * any(state.limit_open))
    remedy = "acquire homes by itself; for the laser check let a short plan run first" * (state.status != "idle")
    checks.judge("homing", state.status, remedy)
    trip, repeats = statistics.median(times), positioner.repeats
    remedy = "use a short USB cable, away from motor wires; no hub" * (trip > ROUND_TRIP_SLOW_S or repeats > 0)
    checks.judge("timing", f"{1000 * trip:.1f} ms, {repeats} of {ROUND_TRIPS} repeated", remedy)
    return positioner


def _camera(
    rig: Rig,
    open_camera: Callable[[], StereoCamera],
    positioner: Positioner | None,
    clock: Clock,
    checks: _Checks,
    stack: ExitStack,
) -> StereoCamera | None:
    """Check opening, settings, time of a new pair, exposure and focus."""
    try:
        camera = open_camera()
        stack.callback(camera.close)
        if positioner is not None:
            connect_trigger(positioner, camera)
        settings = camera.settings()
        start = clock.monotonic()
        image = camera.grab()
        seconds = clock.monotonic() - start
    except TvsError as error:
        checks.failed("cameras", error)
        return None
    size = f"{rig.stereo_pair.image_width} x {rig.stereo_pair.image_height} px"
    checks.judge("cameras", f"two pictures of {size}, a fresh pair in {seconds:.2f} s")
    for warning in settings.warnings:
        checks.judge("camera settings", warning, "fix it with the camera's own program")
    for side, picture in (("left", image.left), ("right", image.right)):
        _picture(side, picture, image.full_scale, checks)
    return camera


def _picture(side: str, picture: np.ndarray, white: int, checks: _Checks) -> None:
    """Check exposure and focus of a picture without laser; `white` is the camera's full scale."""
    import cv2

    grey = cv2.cvtColor(in_grey_levels(picture, white), cv2.COLOR_BGR2GRAY)
    mean, clipped = float(grey.mean()), float((grey >= 250).mean())
    remedy = ""
    if clipped > CLIPPED_SHARE_MAX or mean > BRIGHT_MEAN_MAX:
        remedy = "darken the room or shorten the exposure: the spot must stand out"
    elif mean < DARK_MEAN_MIN:
        remedy = "take the cap off, or lengthen the exposure"
    checks.judge(f"exposure {side}", f"mean {mean:.0f} of 255, {100 * clipped:.2f} % clipped", remedy)
    sharpness = float(cv2.Laplacian(grey.astype(np.float64), cv2.CV_64F).var())
    remedy = "focus on the sheet with the checkerboard at its place, then calibrate again"
    checks.judge(f"focus {side}", f"Laplacian variance {sharpness:.1f}", remedy * (sharpness < SHARPNESS_MIN))


def _laser(positioner: Positioner, camera: StereoCamera, checks: _Checks) -> None:
    """Check whether both cameras see the spot; the laser is off afterwards, whatever happens."""
    stop = StopKey()
    # There is no look to finish: the first Ctrl-C interrupts.
    stop.requested = True
    try:
        with stop:
            try:
                dark = camera.grab()
                positioner.laser(True)
                lit = camera.grab()
            finally:
                stop.closing = True
                positioner.laser(False)
    except TvsError as error:
        checks.failed("laser", error)
        return
    rises = rises_dn(dark, lit)
    found = f"brightest pixel rises by {rises[0]} (left) and {rises[1]} (right) of 255"
    remedy = "put the sheet into both views; check the laser's supply, and that the lenses have no infrared filter"
    checks.judge("laser", found, remedy * (min(rises) < CHANGE_DN))

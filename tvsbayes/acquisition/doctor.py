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
from tvsbayes.positioner.protocol import FIRMWARE_VERSION, DeviceState
from tvsbayes.positioner.serial_port import serial_ports

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

    @classmethod
    def judged(cls, name: str, found: str, remedy: str) -> Check:
        """Make a warning where there is a remedy, else "ok"."""
        return cls(name, "warning" if remedy else "ok", found, remedy)


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
    checks = [_rig(rig), *_disk(folder, clock)]
    positioner: Positioner | None = None
    device_checks: list[Check] = []
    try:
        if open_positioner is None:
            on_port = rig.positioner.get("driver", DEFAULT_DRIVER) in ON_PORTS
            if on_port:
                checks.append(_ports(rig))
            if rig.positioner.get("port") or not on_port:
                open_positioner = partial(positioner_of, rig)
        if open_positioner is not None:
            positioner, device_checks = _positioner(open_positioner, clock)
        checks += device_checks
        camera, device_checks = _camera(rig, open_camera, positioner, clock)
        checks += device_checks
        try:
            checks.append(_laser(positioner, camera, laser))
        finally:
            if camera is not None:
                camera.close()
    finally:
        if positioner is not None:
            positioner.close()
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
    ranges = [(low or 0, high or 0) for low, high in (rig.limits.steps[axis] for axis in AXES)]
    (a, b), (c, d) = ranges
    quarter, three_quarters = ((a + k * (b - a) // 4, c + k * (d - c) // 4) for k in (1, 3))
    beyond = b + 1, quarter[1]
    stop = StopKey()
    broken: dict[str, list[str]] = {}
    # There is no look to finish: the first Ctrl-C interrupts, and the driver is closed.
    stop.requested = True
    size = rig.stereo_pair.image_width, rig.stereo_pair.image_height
    try:
        with stop:
            positioner = positioner_of(rig) if open_positioner is None else open_positioner()
            broken["positioner"] = positioner_violations(positioner, [quarter, three_quarters], beyond)
            camera = cameras_of(rig) if open_camera is None else open_camera()
            broken["cameras"] = camera_violations(camera, *size)
    except TvsError as error:
        return [_failed("contract", error)]
    remedy = "the driver breaks a promise: see data/docs/instrument.md, Your own hardware"
    return [
        check
        for name, sentences in broken.items()
        for check in (
            [Check(f"contract {name}", "fault", sentence, remedy) for sentence in sentences]
            or [Check(f"contract {name}", "ok", "every promise is kept")]
        )
    ]


def _rig(rig: Rig) -> Check:
    missing = rig.limits.unstated
    if missing:
        remedy = "state them in [positioner]: without them the firmware's own limits hold"
        return Check("limits", "warning", f"{', '.join(missing)} not stated", remedy)
    if len(rig.sheets_mm) < 2:
        return Check("limits", "warning", "fewer than two sheets", "name two depths in [sheets]")
    return Check("limits", "ok", f"soft limits stated, {len(rig.sheets_mm)} sheets")


def _disk(folder: Path, clock: Clock) -> list[Check]:
    """Check free space and the duration of a flush."""
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    try:
        free = shutil.disk_usage(folder).free
        remedy = f"free at least {DISK_FREE_BYTES / 1e9:.0f} GB for 700 looks" * (free < DISK_FREE_BYTES)
        room = Check.judged("disk", f"{free / 1e9:.1f} GB free", remedy)
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
        found = escaped(error.strerror or str(error))
        return [Check("disk", "fault", found, f"make {escaped(str(folder), 200)} writable, or name another folder")]
    remedy = "write to a local disk, not to a network or a memory card" * (seconds > FLUSH_SLOW_S)
    return [room, Check.judged("disk flush", f"{1000 * seconds:.1f} ms", remedy)]


def _ports(rig: Rig) -> Check:
    ports = serial_ports()
    listed = ", ".join(f"{p.name} ({p.description}{', Teensy' if p.teensy else ''})" for p in ports) or "none"
    listed = escaped(listed, 400)
    stated_port = rig.positioner.get("port")
    if not stated_port:
        return Check("port", "fault", f"ports: {listed}", 'write port = "..." into [positioner] of the rig file')
    if all(port.name != stated_port for port in ports) and not Path(str(stated_port)).exists():
        remedy = "plug the device in, or correct [positioner] port; on Linux join the group dialout"
        return Check("port", "fault", f"{escaped(str(stated_port))} is not there; ports: {listed}", remedy)
    return Check("port", "ok", escaped(str(stated_port)))


def _failed(name: str, error: TvsError) -> Check:
    remedy = error.remedy or ""
    found = error.found or error.message.removesuffix(f"; {remedy}")
    return Check(name, "fault", found, remedy.removesuffix(SEE_DOCTOR) or "see the message")


def _positioner(open_positioner: Callable[[], Positioner], clock: Clock) -> tuple[Positioner | None, list[Check]]:
    """Check firmware, state and round-trip time."""
    try:
        positioner = open_positioner()
    except TvsError as error:
        return None, [_failed("firmware", error)]
    version = escaped(positioner.identity.get("fw", "unknown"))
    unlike = version != FIRMWARE_VERSION and "driver" not in positioner.identity
    found = f"version {version}" + f", shipped is {FIRMWARE_VERSION}" * unlike
    remedy = "flash the firmware shipped with tvsbayes; this one speaks the same protocol" * unlike
    checks = [Check.judged("firmware", found, remedy)]
    for warning in getattr(positioner, "warnings", ()):
        checks.append(Check("positioner", "warning", warning, "see data/docs/instrument.md, Your own hardware"))
    times = []
    try:
        for _ in range(ROUND_TRIPS):
            start = clock.monotonic()
            state = positioner.state()
            times.append(clock.monotonic() - start)
        if state.laser_on:
            state = positioner.laser(False)
            checks.append(Check("laser line", "warning", "it was on", "look for a program that left it on"))
        checks.append(_switches(state))
        remedy = "acquire homes by itself; for the laser check let a short plan run first" * (state.status != "idle")
        checks.append(Check.judged("homing", state.status, remedy))
    except TvsError as error:
        positioner.close()
        return None, [*checks, _failed("positioner", error)]
    trip, repeats = statistics.median(times), positioner.repeats
    remedy = "use a short USB cable, away from motor wires; no hub" * (trip > ROUND_TRIP_SLOW_S or repeats > 0)
    found = f"{1000 * trip:.1f} ms, {repeats} of {ROUND_TRIPS} repeated"
    return positioner, [*checks, Check.judged("timing", found, remedy)]


def _switches(state: DeviceState) -> Check:
    """Report home and limit switches: pressed by hand, they show their wiring before any motion."""
    pairs = zip(AXES, state.home_pressed, state.limit_open, strict=True)
    states = (
        f"{axis}: home {'pressed' if home else 'free'}, limit {'open' if limit else 'closed'}"
        for axis, home, limit in pairs
    )
    remedy = "turn the axis back by hand; if it stands free, check the wire of its limit switches"
    return Check.judged("switches", "; ".join(states), remedy * any(state.limit_open))


def _camera(
    rig: Rig, open_camera: Callable[[], StereoCamera] | None, positioner: Positioner | None, clock: Clock
) -> tuple[StereoCamera | None, list[Check]]:
    """Check opening, settings, time of a new pair, exposure and focus."""
    size = rig.stereo_pair.image_width, rig.stereo_pair.image_height
    try:
        camera = open_camera() if open_camera is not None else cameras_of(rig)
    except TvsError as error:
        return None, [_failed("cameras", error)]
    try:
        if positioner is not None:
            connect_trigger(positioner, camera)
        settings = camera.settings()
        start = clock.monotonic()
        image = camera.grab()
        seconds = clock.monotonic() - start
    except TvsError as error:
        camera.close()
        return None, [_failed("cameras", error)]
    checks = [Check("cameras", "ok", f"two pictures of {size[0]} x {size[1]} px, a fresh pair in {seconds:.2f} s")]
    for warning in settings.warnings:
        checks.append(Check("camera settings", "warning", warning, "fix it with the camera's own program"))
    white = image.full_scale
    checks += [*_picture("left", image.left, white), *_picture("right", image.right, white)]
    return camera, checks


def _picture(side: str, picture: np.ndarray, white: int) -> list[Check]:
    """Check exposure and focus of a picture without laser; `white` is the camera's full scale."""
    import cv2

    grey = cv2.cvtColor(in_grey_levels(picture, white), cv2.COLOR_BGR2GRAY)
    mean, clipped = float(grey.mean()), float((grey >= 250).mean())
    found = f"mean {mean:.0f} of 255, {100 * clipped:.2f} % clipped"
    remedy = ""
    if clipped > CLIPPED_SHARE_MAX or mean > BRIGHT_MEAN_MAX:
        remedy = "darken the room or shorten the exposure: the spot must stand out"
    elif mean < DARK_MEAN_MIN:
        remedy = "take the cap off, or lengthen the exposure"
    exposure = Check.judged(f"exposure {side}", found, remedy)
    sharpness = float(cv2.Laplacian(grey.astype(np.float64), cv2.CV_64F).var())
    blurred = "focus on the sheet with the checkerboard at its place, then calibrate again" * (
        sharpness < SHARPNESS_MIN
    )
    return [exposure, Check.judged(f"focus {side}", f"Laplacian variance {sharpness:.1f}", blurred)]


def _laser(positioner: Positioner | None, camera: StereoCamera | None, requested: bool) -> Check:
    """Check whether both cameras see the spot; the laser is off afterwards, whatever happens."""
    if positioner is None or camera is None:
        return Check("laser", "skipped", "needs positioner and cameras", "correct the faults above first")
    if not requested:
        return Check("laser", "skipped", "not requested", "run doctor with --laser, goggles on")
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
        return _failed("laser", error)
    rises = rises_dn(dark, lit)
    found = f"brightest pixel rises by {rises[0]} (left) and {rises[1]} (right) of 255"
    remedy = "put the sheet into both views; check the laser's supply, and that the lenses have no infrared filter"
    return Check.judged("laser", found, remedy * (min(rises) < CHANGE_DN))

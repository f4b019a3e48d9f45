"""Test the promises that every driver of a positioner or of cameras must keep, own and foreign.

`positioner_violations` moves the motors and switches the laser on: on real hardware wear goggles and clear the way. A
reset, an unplugging or a blocked axis cannot be tested here; data/docs/instrument.md, "Your own hardware", states the
promises for these cases. Counters in motor steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from tvsbayes.cameras.capture import CameraSettings, StereoCamera
from tvsbayes.errors import DeviceFault
from tvsbayes.positioner.interface import HomeReport, Positioner
from tvsbayes.positioner.protocol import DeviceState


def positioner_violations(
    positioner: Positioner, targets: Sequence[tuple[int, int]], forbidden: tuple[int, int]
) -> list[str]:
    """List the promises of `Positioner` that a driver breaks, in sentences; close it afterwards.

    Args:
        positioner: connected, not homed yet.
        targets: counters (pan, tilt) that it can reach, at least one.
        forbidden: counters outside its limits.
    """
    broken: list[str] = []

    def expect(kept: bool, promise: str) -> None:
        if not kept:
            broken.append(promise)

    try:
        expect("fw" in positioner.identity, 'identity has "fw", the version of the firmware')
        expect(all(isinstance(v, str) for v in positioner.identity.values()), "identity holds text")
        expect(positioner.repeats >= 0, "repeats counts requests that were sent again")
        expect(_refused(lambda: positioner.laser(True)), "no light before homing: a DeviceFault with a remedy")
        report = positioner.home()
        expect(isinstance(report, HomeReport) and report.state.status == "idle", "home ends at rest: status idle")
        for target in [*targets, targets[-1]]:
            reached, state_now = positioner.move_to(*target), positioner.state()
            for state, order in ((reached, "move_to"), (state_now, "state after it")):
                expect(_at(state) == target, f"{order} reports the counters ordered, {target}, not {_at(state)}")
            expect(state_now.status == "idle" and not state_now.laser_on, "after a motion it is idle and dark")
        for on in (True, False):
            expect(positioner.laser(on).laser_on is on, f"laser({on}) returns once the device has said so")
            expect(positioner.state().laser_on is on, f"state reports the laser as set by laser({on})")
        counters = _at(positioner.state())
        expect(_refused(lambda: positioner.move_to(*forbidden)), f"{forbidden} is refused: a DeviceFault with a remedy")
        expect(_at(positioner.state()) == counters, "what is refused moves nothing")
        positioner.laser(True)
        expect(not positioner.home().state.laser_on, "the laser is off after home")
        positioner.laser(True)
        expect(not positioner.move_to(*targets[0]).laser_on, "the laser is off in motion, no matter who left it on")
        positioner.laser(True)
    finally:
        positioner.close()
        # A second close is harmless.
        positioner.close()
    return list(dict.fromkeys(broken))


def camera_violations(camera: StereoCamera, width: int, height: int) -> list[str]:
    """List the promises of `StereoCamera` that a driver breaks, in sentences; close it afterwards.

    Args:
        camera: open.
        width: width of one picture, px.
        height: height of one picture, px.
    """
    broken: list[str] = []
    try:
        pairs = [camera.grab() for _ in range(3)]
        for pair in pairs:
            for side, picture in (("left", pair.left), ("right", pair.right)):
                if picture.shape != (height, width, 3) or picture.dtype not in (np.uint8, np.uint16):
                    found = f"this one is {picture.shape} of {picture.dtype}"
                    broken.append(f"{side} pictures are ({height}, {width}, 3) of uint8 or uint16; {found}")
        if any(np.array_equal(a.left, b.left) for a, b in pairwise(pairs)):
            broken.append("every grab is a new exposure: noise makes two pictures differ")
        if not isinstance(camera.settings(), CameraSettings):
            broken.append("settings returns CameraSettings")
    finally:
        camera.close()
        camera.close()
    return list(dict.fromkeys(broken))


def _at(state: DeviceState) -> tuple[int, int]:
    return state.pan_steps, state.tilt_steps


def _refused(order: Callable[[], object]) -> bool:
    try:
        order()
    except DeviceFault as error:
        return bool(error.remedy)
    return False

"""The promises of drivers: ours keep them, and a broken promise is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.grbl_board import BoardLink, GrblBoard

from tvsbayes.acquisition.driver_contract import camera_violations, positioner_violations
from tvsbayes.acquisition.simulated_instrument import ModelLink, SimulatedDevice, VirtualClock
from tvsbayes.cameras.capture import CameraSettings, StereoImage
from tvsbayes.errors import DeviceFault
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.firmware_model import Mechanics
from tvsbayes.positioner.grbl import GrblPositioner, GrblSettings

TARGETS, FORBIDDEN = ((100, 20), (-37, -8), (0, 5)), (9_999, 0)


def serial() -> SerialPositioner:
    device = SimulatedDevice(VirtualClock(), Mechanics(home_steps=(-60, -40)))
    return SerialPositioner(lambda: ModelLink(device), {"hp": -60, "ht": -40}, device.clock)


def grbl() -> GrblPositioner:
    board = GrblBoard()
    limits = CounterLimits({"pan": (-500, 500), "tilt": (-500, 500)})
    return GrblPositioner(lambda: BoardLink(board), GrblSettings(unwatched=True, limits=limits), board.clock)


@pytest.mark.parametrize("make", [serial, grbl])
def test_our_positioners_keep_every_promise(make):
    assert positioner_violations(make(), TARGETS, FORBIDDEN) == []


def lit(report):
    return replace(report, state=replace(report.state, laser_on=True))


def refusing_without_a_remedy(move):
    def refused(pan, tilt):
        try:
            return move(pan, tilt)
        except DeviceFault:
            raise DeviceFault("limit", "no") from None

    return refused


BROKEN = {
    "counters ordered": ("move_to", lambda move: lambda pan, tilt: replace(move(pan, tilt), pan_steps=pan + 1)),
    "off in motion": ("move_to", lambda move: lambda *to: replace(move(*to), laser_on=to == TARGETS[0])),
    "with a remedy": ("move_to", refusing_without_a_remedy),
    "off after home": (
        "home",
        lambda home: lambda: (r := home(), replace(r, state=replace(r.state, laser_on=True)))[1],
    ),
    "laser(True)": ("laser", lambda laser: lambda on: laser(False)),
    "before homing": ("laser", lambda laser: lambda on: laser.__self__.state()),
    '"fw"': ("identity", lambda identity: {}),
}
"""The method that is another, by the word that names the promise."""


@pytest.mark.parametrize("word", BROKEN)
def test_a_broken_promise_is_named(word):
    positioner, (name, changed) = serial(), BROKEN[word]
    setattr(positioner, name, changed(getattr(positioner, name)))
    assert any(word in sentence for sentence in positioner_violations(positioner, TARGETS, FORBIDDEN))


class Camera:
    """Noise of a size and kind; with `still` always the same."""

    def __init__(self, shape=(6, 8, 3), kind=np.uint8, still=False):
        self.shape, self.kind, self.still, self.rng = shape, kind, still, np.random.default_rng(0)

    def grab(self):
        rng = np.random.default_rng(0) if self.still else self.rng
        return StereoImage(*(rng.integers(0, 200, self.shape).astype(self.kind) for _ in range(2)))

    def settings(self):
        return CameraSettings({})

    def close(self):
        pass


def test_broken_promises_of_cameras_are_named():
    assert camera_violations(Camera(), 8, 6) == camera_violations(Camera(kind=np.uint16), 8, 6) == []
    assert "new exposure" in camera_violations(Camera(still=True), 8, 6)[0]
    assert "(6, 8, 3) of float64" in camera_violations(Camera(kind=np.float64), 8, 6)[0]
    assert len(camera_violations(Camera(shape=(8, 6, 3)), 8, 6)) == 2

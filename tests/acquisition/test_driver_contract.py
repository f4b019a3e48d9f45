"""The promises of drivers: ours keep them, and a broken promise is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.grbl_board import BoardLink, GrblBoard

from tvsbayes.acquisition.driver_contract import camera_violations, positioner_violations
from tvsbayes.acquisition.drivers import cameras_of, positioner_of
from tvsbayes.acquisition.simulated_instrument import ModelLink, SimulatedDevice, VirtualClock
from tvsbayes.cameras.capture import CameraSettings, StereoImage
from tvsbayes.errors import DeviceFault
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.grbl import GrblPositioner, GrblSettings
from tvsbayes.positioner.mechanics import Mechanics

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


def test_the_simulated_bench_keeps_every_promise(small_rig):
    simulated = {"driver": "simulated"}
    rig = replace(small_rig, positioner=dict(simulated), cameras={**simulated, "spot_sd_px": 0.08})
    assert positioner_violations(positioner_of(rig), TARGETS, FORBIDDEN) == []
    assert camera_violations(cameras_of(rig), rig.stereo.image_width, rig.stereo.image_height) == []


def _one_step_off(positioner):
    move = positioner.move_to
    positioner.move_to = lambda pan, tilt: replace(move(pan, tilt), pan_steps=pan + 1)


def _bright_home(positioner):
    home = positioner.home
    positioner.home = lambda: (r := home(), replace(r, state=replace(r.state, laser_on=True)))[1]


def _deaf_laser(positioner):
    laser = positioner.laser
    positioner.laser = lambda on: laser(False) if on else laser(on)


def _lit_mover(positioner):
    move = positioner.move_to
    positioner.move_to = lambda pan, tilt: replace(move(pan, tilt), laser_on=(pan, tilt) == TARGETS[0])


def _careless(positioner):
    def laser(on):
        return positioner.state()

    positioner.laser = laser


def _no_remedy(positioner):
    move = positioner.move_to

    def refusing(pan, tilt):
        try:
            return move(pan, tilt)
        except DeviceFault:
            raise DeviceFault("limit", "no") from None

    positioner.move_to = refusing


def _nameless(positioner):
    positioner.identity = {}


@pytest.mark.parametrize(
    ("change", "word"),
    [
        *((_one_step_off, "counters ordered"), (_bright_home, "off after home"), (_deaf_laser, "laser(True)")),
        *((_careless, "before homing"), (_no_remedy, "with a remedy"), (_nameless, '"fw"')),
        (_lit_mover, "off in motion"),
    ],
)
def test_a_broken_promise_is_named(change, word):
    positioner = serial()
    change(positioner)
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

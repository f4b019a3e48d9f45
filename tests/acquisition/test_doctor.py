"""The doctor: every finding comes with what to do, nothing moves, the laser ends off."""

from __future__ import annotations

import signal
from dataclasses import replace

import numpy as np
import pytest
from support.bench_runs import RIG_FILE
from support.grbl_board import BoardLink, GrblBoard

from tvsbayes.acquisition.doctor import contract, examine
from tvsbayes.acquisition.simulated_instrument import ModelLink, SimulatedDevice, VirtualClock
from tvsbayes.cameras.capture import CameraSettings, StereoImage
from tvsbayes.cli.main import run
from tvsbayes.errors import DeviceFault
from tvsbayes.instrument.rig import read_rig
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.firmware_model import Mechanics
from tvsbayes.positioner.grbl import GrblPositioner, GrblSettings

RIG = read_rig(RIG_FILE)


class Camera:
    """Pictures of a textured sheet at a mean grey level; a bright spot while the laser is on."""

    def __init__(self, device, level=40.0, texture=10.0, spot=150, warnings=(), fail_at=99):
        self.device, self.level, self.texture, self.spot = device, level, texture, spot
        self.warnings, self.left, self.closed = warnings, fail_at, False

    def settings(self):
        return CameraSettings({"stereo.exposure": -6.0}, tuple(self.warnings))

    def grab(self):
        self.left -= 1
        if self.left == 0:
            raise DeviceFault("no-frame", "gone", remedy="plug it in")
        picture = np.random.default_rng(1).normal(self.level, self.texture, (60, 80, 3))
        if self.device.mechanics.laser_on:
            picture[30, 40] += self.spot
        picture = np.clip(picture, 0, 255).astype(np.uint8)
        return StereoImage(picture, picture)

    def close(self):
        assert not self.device.mechanics.laser_on
        self.closed = True


def bench(**camera):
    device = SimulatedDevice(VirtualClock(), Mechanics(home_steps=(-60, -40)))
    return device, Camera(device, **camera)


def checks_of(device, camera, tmp_path, *, laser=False, homed=True):
    """The checks by name, after a homing if `homed`."""
    links = lambda: ModelLink(device)  # noqa: E731
    if homed:
        first = SerialPositioner(links, {"hp": -60, "ht": -40}, device.clock)
        first.home()
        first.close()
    before = list(device.mechanics.true_steps)
    checks = examine(
        RIG,
        tmp_path / "not yet there",
        laser=laser,
        open_positioner=lambda: SerialPositioner(links, {}, device.clock),
        open_camera=lambda: camera,
        clock=device.clock,
    )
    assert device.mechanics.true_steps == before, "nothing moves"
    assert not device.mechanics.laser_on
    assert all(check.remedy for check in checks if check.status != "ok")
    assert len({check.name for check in checks}) == len(checks)
    return {check.name: check for check in checks}


def test_healthy_instrument(tmp_path):
    device, camera = bench()
    checks = checks_of(device, camera, tmp_path, laser=True)
    assert {name for name, check in checks.items() if check.status != "ok"} == {"limits"}
    assert checks["firmware"].found == "version 1.1.0" and "rises by" in checks["laser"].found
    assert checks["timing"].found.startswith("0.6 ms, 0 of 20") and camera.closed


def test_a_grbl_board_is_examined_by_its_own_rules(tmp_path):
    """Its firmware version is not compared; the missing watchdog of the laser is reported."""
    board = GrblBoard()
    device, camera = bench()
    checks = examine(
        RIG,
        tmp_path,
        open_positioner=lambda: GrblPositioner(lambda: BoardLink(board), GrblSettings(), board.clock),
        open_camera=lambda: camera,
        clock=device.clock,
    )
    by_name = {check.name: check for check in checks}
    assert (by_name["firmware"].status, by_name["firmware"].found) == ("ok", "version Grbl 1.1h")
    assert "no watchdog" in by_name["positioner"].found and by_name["positioner"].remedy
    assert (by_name["homing"].status, by_name["homing"].found) == ("warning", "alarm") and board.steps == [400, 250]


def in_bits_of_twelve(camera: Camera, factor: int, *white: int) -> None:
    """The camera's pictures as 16-bit integers, times a factor."""
    grab = camera.grab

    def deep() -> StereoImage:
        pair = grab()
        return StereoImage(*(picture.astype(np.uint16) * factor for picture in (pair.left, pair.right)), *white)

    camera.grab = deep


def test_pictures_of_twelve_bits_are_judged_in_the_same_grey_levels(tmp_path):
    device, camera = bench()
    in_bits_of_twelve(camera, 16)
    checks = checks_of(device, camera, tmp_path, laser=True)
    assert {name for name, check in checks.items() if check.status != "ok"} == {"limits"}, checks


@pytest.mark.parametrize(
    ("camera", "name", "word"),
    [
        ({"level": 200.0}, "exposure left", "darken"),
        ({"level": 0.0, "texture": 0.5}, "exposure right", "cap"),
        ({"texture": 0.0}, "focus left", "focus"),
        ({"warnings": ["stereo: focus cannot be fixed"]}, "camera settings", "camera's own"),
        ({"spot": 5}, "laser", "infrared filter"),
        ({"fail_at": 2}, "laser", "plug it in"),
    ],
)
def test_bad_pictures_are_named_with_a_remedy(tmp_path, camera, name, word):
    device, camera = bench(**camera)
    check = checks_of(device, camera, tmp_path, laser=True)[name]
    assert check.status in ("warning", "fault") and word in check.remedy


def test_laser_stays_off_unless_requested(tmp_path):
    device, camera = bench()
    lasers = []
    grab = camera.grab
    camera.grab = lambda: (lasers.append(device.mechanics.laser_on), grab())[1]
    assert checks_of(device, camera, tmp_path)["laser"].status == "skipped"
    assert lasers and not any(lasers)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_laser_check_that_is_ended_from_outside_leaves_it_off(tmp_path, name):
    device, camera = bench()
    grab, lit = camera.grab, []

    def ended():
        lit.append(device.mechanics.laser_on)
        if lit[-1]:
            signal.raise_signal(getattr(signal, name))
        return grab()

    camera.grab = ended
    with pytest.raises(KeyboardInterrupt):
        checks_of(device, camera, tmp_path, laser=True)
    assert lit[-1] and not device.mechanics.laser_on and camera.closed


def test_unhomed_positioner_refuses_the_laser(tmp_path):
    device, camera = bench()
    checks = checks_of(device, camera, tmp_path, laser=True, homed=False)
    assert (checks["homing"].status, checks["laser"].status) == ("warning", "fault")


def test_dead_camera_and_dead_device(tmp_path):
    device, camera = bench(fail_at=1)
    checks = checks_of(device, camera, tmp_path, laser=True)
    assert (checks["cameras"].status, checks["laser"].status) == ("fault", "skipped") and camera.closed
    device, camera = bench()
    device.model.receive = lambda data, now_us: None
    checks = checks_of(device, camera, tmp_path, homed=False)
    assert checks["firmware"].status == "fault" and camera.closed


def test_a_positioner_that_fails_is_closed_before_the_cameras_are_opened(tmp_path):
    """Its laser may be on, and cameras may take long to open."""
    device, camera = bench()
    order = []

    class Failing(SerialPositioner):
        def state(self):
            raise DeviceFault("no-answer", "gone", remedy="plug it in")

        def close(self):
            order.append("closed")
            super().close()

    def open_camera():
        order.append("cameras")
        return camera

    positioner = lambda: Failing(lambda: ModelLink(device), {}, device.clock)  # noqa: E731
    checks = examine(RIG, tmp_path, laser=True, open_positioner=positioner, open_camera=open_camera, clock=device.clock)
    assert order == ["closed", "cameras"] and camera.closed
    assert {check.name: check.status for check in checks}["laser"] == "skipped"


def test_rig_without_hardware_says_what_is_missing(tmp_path):
    checks = {check.name: check for check in examine(RIG, tmp_path)}
    assert "[positioner]" in checks["port"].remedy and checks["cameras"].status == "fault"
    assert checks["disk flush"].status in ("ok", "warning") and list(tmp_path.iterdir()) == []


def test_contract_of_drivers_that_keep_it_and_of_one_that_does_not(small_rig):
    """On the simulated bench; then with a positioner that reports other counters, and without limits."""
    simulated = {"driver": "simulated"}
    limits = {"pan_min_steps": -50, "pan_max_steps": 150, "tilt_min_steps": -30, "tilt_max_steps": 40}
    rig = replace(small_rig, positioner=simulated | limits, cameras={**simulated, "spot_sd_px": 0.08})
    good = contract(rig)
    assert [(check.name, check.status) for check in good] == [("contract positioner", "ok"), ("contract cameras", "ok")]

    class Elsewhere(SerialPositioner):
        def move_to(self, pan_steps, tilt_steps):
            return replace(super().move_to(pan_steps, tilt_steps), pan_steps=pan_steps + 1)

    device = SimulatedDevice(VirtualClock(), Mechanics(home_steps=(-60, -40)))
    wrong = contract(rig, open_positioner=lambda: Elsewhere(lambda: ModelLink(device), {"hp": -60}, device.clock))
    faults = [check for check in wrong if check.status == "fault"]
    assert any("counters ordered" in check.found for check in faults) and all(check.remedy for check in faults)
    assert not device.mechanics.laser_on
    (missing,) = contract(replace(rig, positioner=simulated))
    assert missing.status == "fault" and "pan_min_steps" in missing.found


def test_contract_needs_the_word_that_the_laser_may_come_on(capsys):
    assert run(["doctor", "rig.toml", "--contract"]) == 2
    assert "--laser" in capsys.readouterr().err

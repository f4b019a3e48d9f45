"""The driver on the device model with a virtual clock: what it does, what it refuses, how it comes back."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from tvsbayes.acquisition.simulated_instrument import ModelLink, SimulatedDevice, VirtualClock
from tvsbayes.errors import DeviceFault
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.firmware_model import DeviceModel, Mechanics
from tvsbayes.positioner.interface import PositionLost
from tvsbayes.positioner.protocol import frame, request

SETTINGS = {"hp": -60, "ht": -40, "pmin": -300, "pmax": 300, "wd": 2000}
LIMITS = {"hp": -60, "ht": -40, "pmin": -300, "pmax": 200, "tmin": -150, "tmax": 100}


def simulated(**mechanics) -> SimulatedDevice:
    return SimulatedDevice(VirtualClock(), Mechanics(**{"home_steps": (-60, -40), "limit_steps": 900, **mechanics}))


def connected(device: SimulatedDevice, settings=None) -> SerialPositioner:
    return SerialPositioner(lambda: ModelLink(device), SETTINGS if settings is None else settings, device.clock)


def homed(device: SimulatedDevice, settings=None) -> SerialPositioner:
    positioner = connected(device, settings)
    positioner.home()
    return positioner


def test_a_laser_left_on_is_off_in_motion():
    device = simulated()
    positioner = homed(device)
    lit = []
    device.mechanics.moved = lambda axis, steps: lit.append(device.mechanics.laser_on)
    positioner.laser(True)
    assert not positioner.move_to(200, -15).laser_on and lit == [False, False]
    assert positioner.laser(True).laser_on, "and comes on again on request"


@pytest.mark.parametrize(
    ("action", "code"),
    [
        (lambda p, d: p.move_to(1, 1), "refused-unhomed"),
        (lambda p, d: p.laser(True), "refused-unhomed"),
        (lambda p, d: (p.home(), p.move_to(301, 0)), "refused-limit"),
        (lambda p, d: (p.home(), setattr(d.mechanics, "limit_steps", 100), p.move_to(200, 0)), "alarm-limit"),
        (lambda p, d: (p.home(), d.power_on(), p.move_to(1, 1)), "reset"),
    ],
)
def test_refusals_and_alarms_are_named(action, code):
    device = simulated()
    positioner = connected(device)
    with pytest.raises(DeviceFault) as caught:
        action(positioner, device)
    assert caught.value.code == code and caught.value.exit_code == 5 and caught.value.remedy
    positioner.close()
    assert not device.mechanics.laser_on


def test_motion_stopped_from_outside_is_no_arrival():
    """Even at the very counters ordered: the device's report on this motion counts, not its counters."""
    device = simulated()
    positioner = homed(device)
    original = device.model._finish_if_at_rest

    def stopped():
        device.model._stopping = True
        original()

    device.model._finish_if_at_rest = stopped
    with pytest.raises(DeviceFault) as caught:
        positioner.move_to(50, 0)
    assert caught.value.code == "stopped" and device.mechanics.true_steps[0] == 50


def test_close_darkens_though_another_program_has_counted_on():
    device = simulated()
    positioner = homed(device)
    positioner.laser(True)
    device.model.receive(request(4_000_000_000, "MA", 50, 0), device.clock.now_us)
    positioner.close()
    assert not device.mechanics.laser_on
    device.clock.sleep(5.0)
    device.model.advance(device.clock.now_us)
    assert device.mechanics.true_steps == [50, 0], "the other's motion goes on"


def test_a_device_that_never_answers_is_darkened_all_the_same():
    device = simulated()
    homed(device).laser(True)
    device.model._write = lambda line: None
    # A watchdog that leaves the light on for any client.
    device.model._settings["wd"] = 10**6
    with pytest.raises(DeviceFault):
        connected(device)
    assert not device.mechanics.laser_on


@pytest.mark.parametrize("words", [("MA", 300, 0), ("HOME",)])
def test_close_in_mid_motion_stops_the_motors(words):
    device = simulated()
    positioner = homed(device)
    positioner.move_to(0, 0)
    positioner._command(*words)
    positioner.close()
    device.clock.sleep(0.3)
    device.model.advance(device.clock.now_us)
    rest = list(device.mechanics.true_steps)
    device.clock.sleep(60.0)
    device.model.advance(device.clock.now_us)
    assert device.mechanics.true_steps == rest and -60 < rest[0] < 290


def test_wrong_protocol_version_is_named():
    device = simulated()
    device.model = DeviceModel(device.mechanics, 1, 0, device._send, protocol=3)
    with pytest.raises(DeviceFault, match=r"firmware 1\.1\.0 speaks protocol 3, this program speaks 2"):
        connected(device)


@pytest.mark.parametrize("last", ["9" * 95, "-1", "x", str(2**32)])
def test_an_identity_without_a_sequence_is_refused(last):
    """With a checksum that holds: another firmware, or one that has gone mad."""
    device = simulated()
    send, device.model._write = device.model._write, lambda line: None

    def altered(line):
        text = line[:-1].rpartition(b"*")[0].decode()
        send(frame(re.sub(r" q=\d+", f" q={last}", text)))

    device.model._write = altered
    with pytest.raises(DeviceFault) as caught:
        connected(device)
    assert caught.value.code == "firmware"


class Plug:
    """A line that can be pulled: every call fails until it is plugged in again."""

    def __init__(self, device):
        self.device, self.pulled_until_us = device, 0

    def open(self):
        plug = self
        if plug.device.clock.now_us < plug.pulled_until_us:
            raise OSError(2, "No such file or directory")

        class Pulled(ModelLink):
            def write(self, data):
                plug.check()
                super().write(data)

            def read(self, timeout_s):
                plug.check()
                return super().read(timeout_s)

        return Pulled(self.device)

    def check(self):
        if self.device.clock.now_us < self.pulled_until_us:
            raise OSError(5, "Input/output error")


def plugged_in() -> tuple[SimulatedDevice, Plug, SerialPositioner]:
    device = simulated()
    plug = Plug(device)
    positioner = SerialPositioner(plug.open, SETTINGS, device.clock)
    positioner.home()
    return device, plug, positioner


def test_another_program_meanwhile_is_noticed():
    device, plug, positioner = plugged_in()
    plug.pulled_until_us = device.clock.now_us + 1_000_000
    device.model.receive(request(500, "MA", 10, 10), device.clock.now_us)
    with pytest.raises(PositionLost) as caught:
        positioner.state()
    assert caught.value.code == "foreign"


@pytest.mark.parametrize(("axis", "last"), [(0, -300), (0, 200), (1, -150), (1, 100)])
def test_the_last_step_inside_a_limit_is_reached_and_the_next_refused(axis, last):
    positioner = homed(simulated(), LIMITS)
    inside, outside = [0, 0], [0, 0]
    inside[axis], outside[axis] = last, last + (1 if last > 0 else -1)
    state = positioner.move_to(*inside)
    assert [state.pan_steps, state.tilt_steps] == inside
    with pytest.raises(DeviceFault) as caught:
        positioner.move_to(*outside)
    assert caught.value.code == "refused-limit"
    state = positioner.state()
    assert [state.pan_steps, state.tilt_steps] == inside, "a refused move moves nothing"


@pytest.mark.parametrize("field", ["pan_steps", "tilt_steps", "pan_target_steps", "tilt_target_steps"])
def test_done_at_another_place_is_no_arrival(field, monkeypatch):
    """A step lost between the counter and the answer; the sequence and the status are those of an arrival."""
    positioner = homed(simulated(), LIMITS)
    truth = DeviceModel.state.fget

    def lie(device):
        state = truth(device)
        return replace(state, **{field: getattr(state, field) - 1})

    monkeypatch.setattr(DeviceModel, "state", property(lie))
    with pytest.raises(DeviceFault) as caught:
        positioner.move_to(120, 30)
    assert caught.value.code == "position"

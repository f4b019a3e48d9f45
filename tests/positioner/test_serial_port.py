"""Serial ports: opened by name alone, and the driver over a real file descriptor."""

from __future__ import annotations

import pytest
from support.pseudo_terminal import needs_pseudo_terminals, served

from tvsbayes.acquisition.simulated_instrument import SimulatedDevice, VirtualClock
from tvsbayes.errors import DeviceFault
from tvsbayes.positioner import serial_port
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.mechanics import Mechanics
from tvsbayes.positioner.serial_port import Port, serial_opener

SETTINGS = {"hp": -60, "ht": -40, "pmin": -300, "pmax": 300, "wd": 10_000}


def test_a_ports_name_is_never_taken_as_an_address(tmp_path):
    """With pyserial spy:// would write a file, alt:// call another class; other names end in its ValueError."""
    pytest.importorskip("serial")
    victim = tmp_path / "victim.txt"
    for port in (f"spy:///dev/ptmx?file={victim}", "loop://?x=1", "alt://x?class=nope", "a\0b"):
        with pytest.raises(DeviceFault) as caught:
            SerialPositioner(serial_opener(port, 115_200), {}, VirtualClock())
        assert caught.value.code == "port"
    assert not victim.exists()


def test_of_two_ports_of_one_device_the_named_one_is_opened(monkeypatch):
    """A Teensy with two serial ports, plugged in again under other names; a second device is never taken for it."""
    opened, there = [], ["/dev/ttyACM0", "/dev/ttyACM1"]

    def ports():
        return [Port("/dev/ttyACM9", "", 0x16C0, 1, "B"), *(Port(name, "", 0x16C0, 1, "A") for name in there)]

    monkeypatch.setattr(serial_port, "serial_ports", ports)
    monkeypatch.setattr(serial_port, "_SerialLink", lambda name, baud: opened.append(name))
    open_link = serial_opener("/dev/ttyACM1", 115_200)
    open_link()
    there[:] = ["/dev/ttyACM2", "/dev/ttyACM3"]
    open_link()
    there[:] = ["/dev/ttyACM2"]
    with pytest.raises(OSError, match="serial number A"):
        open_link()
    assert opened == ["/dev/ttyACM1", "/dev/ttyACM3"]


@needs_pseudo_terminals
def test_pyserial_on_a_pseudo_terminal():
    """A session from connection to close; the device's time runs with its bytes."""
    device = SimulatedDevice(VirtualClock(), Mechanics(home_steps=(-60, -40), limit_steps=900))
    with served(device, 2_000_000) as port:
        positioner = SerialPositioner(serial_opener(port, 115_200), SETTINGS)
        positioner.home()
        assert positioner.laser(True).laser_on
        assert positioner.move_to(30, 12).pan_steps == 30
        positioner.close()
        assert device.mechanics.true_steps == [30, 12] and not device.mechanics.laser_on

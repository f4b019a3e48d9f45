"""Serial ports: opened by name alone, and of two ports of one device the named one."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from tvsbayes.acquisition.simulated_instrument import VirtualClock
from tvsbayes.errors import DeviceFault
from tvsbayes.positioner import serial_port
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.serial_port import serial_opener


def test_a_ports_name_is_never_taken_as_an_address(tmp_path):
    """With pyserial spy:// would write a file, alt:// call another class; other names end in its ValueError."""
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
        named = [("/dev/ttyACM9", "B"), *((name, "A") for name in there)]
        return [SimpleNamespace(device=name, vid=0x16C0, pid=1, serial_number=number) for name, number in named]

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

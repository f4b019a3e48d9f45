"""Serial ports: the list of this computer's ports, and a port as the driver's `Link`.

A port is opened by name and exclusively; after an unplugging the same USB device is found again, also under another
name. Seconds where a name says `_s`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tvsbayes.errors import InputError
from tvsbayes.instrument.rig import Rig
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.grbl import GrblPositioner, GrblSettings
from tvsbayes.positioner.interface import Link
from tvsbayes.positioner.protocol import device_settings

BAUD = 115_200
"""Default baud rate; a USB device ignores it."""


def serial_ports() -> list[Any]:
    """The serial ports of this computer as pyserial describes them (`ListPortInfo`), by name."""
    from serial.tools import list_ports

    return sorted(list_ports.comports(), key=lambda port: port.device)


def _ports_of(device: Any) -> list[str]:
    """Names of all ports of the USB device to which this port belongs."""
    usb_id = (device.vid, device.pid, device.serial_number)
    return [p.device for p in serial_ports() if (p.vid, p.pid, p.serial_number) == usb_id]


def serial_opener(port: str, baud: int) -> Callable[[], Link]:
    """Return a function that opens a port by name, or after an unplugging the same USB device under its new name."""
    device = next((p for p in serial_ports() if p.device == port and p.serial_number), None)
    # A device may have several ports; their names keep their order.
    index = 0 if device is None else _ports_of(device).index(port)

    def open_link() -> Link:
        name = port
        if device is not None and port not in (names := _ports_of(device)):
            if len(names) <= index:
                raise OSError(f"no port with the USB serial number {device.serial_number}")
            name = names[index]
        return _SerialLink(name, baud)

    return open_link


def serial_positioner(rig: Rig) -> SerialPositioner:
    """The driver `serial`: a board with the firmware shipped with this package, connected.

    Raises:
        InputError: `[positioner]` names no serial port.
        DeviceFault: the port cannot be opened, or no board with this firmware answers.
    """
    return SerialPositioner(_opener_of(rig), device_settings(rig.positioner))


def grbl_positioner(rig: Rig) -> GrblPositioner:
    """The driver `grbl`: a GRBL board, connected.

    Raises:
        InputError: `[positioner]` names no serial port, or has entries that a GRBL board does not; settings of the
            board that do not fit.
        DeviceFault: the port cannot be opened, or no GRBL board answers.
    """
    settings = GrblSettings.of(rig.positioner)
    return GrblPositioner(_opener_of(rig), settings)


def _opener_of(rig: Rig) -> Callable[[], Link]:
    port = rig.positioner.get("port")
    if not port:
        remedy = 'write port = "/dev/ttyACM0" (or "COM3") into [positioner]; see tvsbayes doctor'
        raise InputError("positioner", "[positioner] of the rig file names no serial port", remedy=remedy)
    return serial_opener(str(port), int(rig.positioner.get("baud", BAUD)))


class _SerialLink:
    """A port of pyserial as a `Link`."""

    def __init__(self, port: str, baud: int):
        import serial

        # Exclusive: a second program on the line would read this program's answers. Without a write time-out a stalled
        # peer would block this program. `serial_for_url` is avoided: some of its addresses write files.
        self._serial = serial.Serial(None, baud, timeout=0.1, write_timeout=1.0)
        if hasattr(self._serial, "exclusive"):
            self._serial.exclusive = True
        self._serial.port = port
        try:
            self._serial.open()
        except ValueError as error:
            # The system cannot even try the name or speed, such as a name with a NUL.
            raise OSError(str(error)) from error

    def write(self, data: bytes) -> None:
        self._serial.write(data)

    def read(self, timeout_s: float) -> bytes:
        self._serial.timeout = timeout_s
        first = self._serial.read(1)
        # After an unplugging in_waiting raises OSError, a read its subclass SerialException.
        return first + self._serial.read(self._serial.in_waiting) if first else b""

    def close(self) -> None:
        try:
            self._serial.close()
        except OSError:
            pass

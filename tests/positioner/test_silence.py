"""No answer: each cause named by what was heard, and what to do about it."""

from __future__ import annotations

import random

import pytest

from tvsbayes.acquisition.simulated_instrument import ModelLink, SimulatedDevice, VirtualClock
from tvsbayes.errors import DeviceFault
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.firmware_model import Mechanics
from tvsbayes.positioner.protocol import SEQUENCE_MAX, request

GREETING = b"\r\nGrbl 1.1h ['$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n"
UNREADABLE = bytes(random.Random(3).choice((0x00, 0x80, 0xF8, 0xFE, 0x1C, 0x66)) for _ in range(40))


class Board:
    """Something at the other end: its greeting and its answer to every line, on a virtual clock."""

    def __init__(self, clock: VirtualClock, greeting: bytes, says):
        self.clock, self.pending, self.says, self.written = clock, bytearray(greeting), says, bytearray()
        self.closed = False

    def write(self, data: bytes) -> None:
        self.written += data
        for line in data.split(b"\n"):
            self.pending += self.says(line) if line.strip() else b""

    def read(self, timeout_s: float) -> bytes:
        data, self.pending = bytes(self.pending), bytearray()
        self.clock.sleep(0.001 if data else timeout_s)
        return data

    def close(self) -> None:
        self.closed = True


class WithCrLf(ModelLink):
    """Our own firmware, ported with `println`."""

    def to_host(self, data: bytes) -> None:
        super().to_host(data.replace(b"\n", b"\r\n"))


BOARDS = {
    "grbl": (GREETING, lambda line: b"error:1\r\n", "a GRBL board", "Grbl 1.1h", 'driver = "grbl"'),
    "marlin": (b"start\n", lambda line: b'echo:Unknown command: "' + line + b'"\nok\n', "Marlin", "echo:", "port"),
    "unreadable": (b"", lambda line: UNREADABLE, "unreadable bytes", "\\x", "baud"),
    "silence": (b"", lambda line: b"", "nothing was heard", "", "supply"),
    "other": (b"$GPGGA,1,2*33\r\n", lambda line: b"", "does not speak this protocol", "$GPGGA", "another device"),
}


@pytest.mark.parametrize("cause", BOARDS)
def test_what_was_heard_is_named_and_quoted(cause):
    greeting, says, words, quote, remedy = BOARDS[cause]
    clock = VirtualClock()
    board = Board(clock, greeting, says)
    with pytest.raises(DeviceFault) as caught:
        SerialPositioner(lambda: board, {}, clock)
    error = caught.value
    assert error.code == "no-answer" and words in error.found and quote in error.found and remedy in error.remedy
    assert error.message.isprintable() and board.closed
    assert board.written.endswith(request(0, "L", 0)), "whatever is there: its light is to go off"


def test_our_firmware_with_other_line_ends_is_named():
    device = SimulatedDevice(VirtualClock(), Mechanics())
    with pytest.raises(DeviceFault, match="CR LF") as caught:
        SerialPositioner(lambda: WithCrLf(device), {}, device.clock)
    assert "<0 ok" in caught.value.found and "LF only" in caught.value.remedy


def test_a_used_up_sequence_is_named():
    """One valid frame with the highest number, and nothing but a reset helps."""
    device = SimulatedDevice(VirtualClock(), Mechanics())
    link = ModelLink(device)
    link.write(request(SEQUENCE_MAX, "?"))
    link.read(0.1)
    link.close()
    with pytest.raises(DeviceFault, match=f"used up.*{SEQUENCE_MAX}") as caught:
        SerialPositioner(lambda: ModelLink(device), {}, device.clock)
    assert caught.value.code == "sequence" and "plug it in again" in caught.value.remedy
    device.power_on()
    SerialPositioner(lambda: ModelLink(device), {}, device.clock).close()

"""The shipped firmware on an emulated processor: QEMU's Cortex-M7 board with motors and switches at its pins.

The unchanged sketch is cross-compiled with `firmware/emulated` and run; the host reaches it through a serial port like
any other. Guest time follows this computer's clock; it may lag, never lead. Orders of a "hand at the bench" break wires
and hold motors, as `firmware/emulated/board.cpp` lists. The laser pin is read from outside the processor, so that its
level is known after a crash too.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from tvsbayes.errors import DeviceFault, InputError
from tvsbayes.positioner import firmware_folder

COMPILER, EMULATOR = "arm-none-eabi-g++", "qemu-system-arm"
PACKAGES = "qemu-system-arm gcc-arm-none-eabi libstdc++-arm-none-eabi-newlib"
"""Packages of compiler and emulator in Debian and Ubuntu."""
PROCESSOR = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16")
CODE = ("-std=gnu++17", "-Os", "-fno-exceptions", "-fno-rtti", "-ffunction-sections", "-Wl,--gc-sections")
WARNINGS = ("-Wall", "-Wextra", "-Wconversion")
BOARD = (EMULATOR, "-M", "mps2-an500", "-display", "none", "-monitor", "none")
STARTED_S = 20.0
"""Longest wait for the emulator to open its lines."""
_LASER_PIN = "xp /1xw 0x40028000"
_MOTORS = {"+": (0, 1), "-": (0, -1), "^": (1, 1), "v": (1, -1)}


def missing_tools() -> list[str]:
    """Programs that the emulation needs and this computer lacks."""
    return [name for name in (COMPILER, EMULATOR) if shutil.which(name) is None]


def core_sources() -> list[Path]:
    """The C++ files of the firmware's core."""
    return sorted((firmware_folder() / "tvs_positioner").glob("tvs_*.cpp"))


def cross_compile(program: Path, sources: Sequence[Path], *options: str) -> subprocess.CompletedProcess[str]:
    """Compile and link for the emulated board with all warnings enabled; return the compiler's result.

    Args:
        program: the file to write.
        sources: sources besides the board's start-up, which is always linked; an `.ino` counts as C++.
        options: further options, such as newlib's `--specs`.
    """
    firmware = firmware_folder()
    emulated = firmware / "emulated"
    files = [str(path) for path in (*sources, emulated / "startup.cpp")]
    folders = (f"-I{firmware / 'tvs_positioner'}", f"-I{emulated}", "-T", str(emulated / "an500.ld"))
    command = [COMPILER, *PROCESSOR, *CODE, *WARNINGS, *folders, *options, "-x", "c++", *files, "-o", str(program)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def build_sketch(program: Path) -> subprocess.CompletedProcess[str]:
    """Compile the sketch, its core and the board's pins, as `cross_compile`."""
    firmware = firmware_folder()
    sketch = firmware / "tvs_positioner" / "tvs_positioner.ino"
    sources = [sketch, firmware / "emulated" / "board.cpp", *core_sources()]
    return cross_compile(program, sources, "--specs=nosys.specs", "-include", "Arduino.h")


class EmulatedBoard:
    """A running board; a context manager that ends it.

    Args:
        on_step: called by `drain` with axis and sense (+1, -1) of every step of a motor.
        on_laser: called by `drain` with the state of the laser line after every change.

    Attributes:
        port: the serial port of the host's line.
        starts: number of starts of the firmware that `drain` has read.

    Raises:
        InputError: compiler or emulator are not installed, or do not work.
    """

    def __init__(
        self,
        on_step: Callable[[int, int], None] = lambda axis, sense: None,
        on_laser: Callable[[bool], None] = lambda on: None,
    ):
        self.on_step, self.on_laser = on_step, on_laser
        self.starts = 0
        if missing := missing_tools():
            remedy = f"install them (Debian, Ubuntu: apt install {PACKAGES})"
            raise InputError("emulator", f"the emulated board needs {' and '.join(missing)}: not found", remedy=remedy)
        self._folder = tempfile.TemporaryDirectory(prefix="tvsbayes-board-")
        self._process: subprocess.Popen[bytes] | None = None
        self._files: list[int] = []
        self._monitor: Any = None
        try:
            self._start(Path(self._folder.name))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> EmulatedBoard:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the emulator and remove its files."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._monitor is not None:
            self._monitor.close()
        for number in self._files:
            os.close(number)
        self._files.clear()
        self._folder.cleanup()

    def order(self, text: str) -> None:
        """Send an order of the "hand at the bench", such as "k 0 7"; see `firmware/emulated/board.cpp`."""
        os.write(self._files[1], text.encode("ascii") + b"\n")

    def drain(self) -> None:
        """Report events since the last call to the listeners, at least all before the host's last answer."""
        while True:
            try:
                data = os.read(self._files[0], 65_536)
            except BlockingIOError:
                return
            if not data:
                return
            for letter in data.decode("ascii"):
                if letter in _MOTORS:
                    self.on_step(*_MOTORS[letter])
                elif letter in "Ll":
                    self.on_laser(letter == "L")
                elif letter == "B":
                    self.starts += 1
                    self.on_laser(False)
                elif letter == "V":
                    found = "emulated board: the direction signal came too shortly before its step"
                    raise DeviceFault("direction-set-up", found, remedy="raise kDirectionSetupUs in the sketch")

    def laser_pin(self) -> bool:
        """The level of the laser pin now, read from outside the processor."""
        reply = self._ask("human-monitor-command", **{"command-line": _LASER_PIN})
        return bool(int(str(reply).split()[-1], 16) & 1)

    def _start(self, folder: Path) -> None:
        program, hand, monitor = folder / "sketch.elf", folder / "hand", folder / "monitor"
        compilation = build_sketch(program)
        if compilation.returncode:
            remedy = f"install {PACKAGES} again"
            raise InputError("emulator", f"the firmware does not compile: {compilation.stderr[-300:]}", remedy=remedy)
        for suffix in (".in", ".out"):
            os.mkfifo(f"{hand}{suffix}")
        # 256 ns per instruction takes a few percent of a core, so that a busy computer is fast enough.
        # A pipe buffers unread bytes without delaying the board; a socket delays it at every byte.
        self._process = subprocess.Popen(
            [
                *(*BOARD, "-kernel", str(program), "-icount", "shift=8,align=on"),
                *("-chardev", "pty,id=host", "-serial", "chardev:host"),
                *("-chardev", f"pipe,id=hand,path={hand}", "-serial", "chardev:hand"),
                *("-qmp", f"unix:{monitor},server=on,wait=off"),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._monitor = self._connect(monitor)
        self._monitor.readline()
        self._ask("qmp_capabilities")
        chardevs = {line["label"]: line["filename"] for line in self._ask("query-chardev")}
        self.port = str(chardevs["host"]).removeprefix("pty:")
        self._files = [os.open(f"{hand}.out", os.O_RDONLY | os.O_NONBLOCK), os.open(f"{hand}.in", os.O_WRONLY)]

    def _connect(self, monitor: Path) -> Any:
        deadline = time.monotonic() + STARTED_S
        while True:
            connection = socket.socket(socket.AF_UNIX)
            try:
                connection.connect(str(monitor))
                with connection:
                    return connection.makefile("rwb", buffering=0)
            except OSError as error:
                connection.close()
                exited = self._process is None or self._process.poll() is not None
                if exited or time.monotonic() > deadline:
                    remedy = f"try `{EMULATOR} -M help`; QEMU 7 or later has the board mps2-an500"
                    raise InputError("emulator", f"{EMULATOR} does not start: {error}", remedy=remedy) from error
            time.sleep(0.02)

    def _ask(self, command: str, **arguments: str) -> Any:
        """Send an order to the emulator itself and return its answer; events in between are ignored."""
        self._monitor.write(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")
        while True:
            reply = json.loads(self._monitor.readline() or '{"error": "ended"}')
            if "error" in reply:
                raise DeviceFault("emulator", f"emulated board: {reply['error']}", remedy="start the rehearsal again")
            if "return" in reply:
                return reply["return"]

"""Placements by a program, such as a robot that moves the rig, or a linear stage under the sheet.

The program gets three more arguments: the target, its nominal X in mm in frame S, and the number of the
placement in the plan, from 0. Exit code 0 means that the sheet is in place. What the program has started must not go on
moving: with the program its whole process group is ended. Seconds where a name says `_s`.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import IO

from msgspec import UNSET

from tvsbayes.acquisition.recorder import PlaceCommanded
from tvsbayes.errors import InputError, escaped, fault

LIMIT_S = 600.0
"""Default longest time of one placement."""
POLL_S = 0.1
"""Interval at which a placement asks whether the run goes on."""
GRACE_S = 5.0
"""Time between SIGTERM, after which a program can stop its motion, and SIGKILL."""
OUTPUT_BYTES_MAX = 64 * 1024
"""Most bytes of its output that are held at any time, the last ones."""
WORDS_MAX = 2000
"""Number of last characters of its output in the journal, whose lines are short."""


@dataclass(frozen=True)
class PlaceCommand:
    """A program that places the sheet.

    Attributes:
        command: program and its first arguments.
        limit_s: longest time of one placement.
    """

    command: tuple[str, ...]
    limit_s: float = LIMIT_S

    @classmethod
    def parsed(cls, line: str, limit_s: float | None) -> PlaceCommand:
        """Split a line as a shell would; no shell runs the command.

        Raises:
            InputError: no such program.
        """
        try:
            command = tuple(shlex.split(line))
        except ValueError:
            command = ()
        if not command or shutil.which(command[0]) is None:
            found, remedy = f"--place-command {escaped(line, 200)}", "name a program that can be started"
            raise InputError("usage", found, column="--place-command", allowed="a program", remedy=remedy)
        return cls(command, LIMIT_S if limit_s is None else limit_s)

    def run(self, target: str, x_mm: float, placement: int, meanwhile: Callable[[], bool]) -> PlaceCommanded:
        """Run the program; returns the event of the placement, also of a failed one.

        Args:
            target: target of the sheet.
            x_mm: nominal X of the target in frame S.
            placement: its number in the plan, from 0.
            meanwhile: called repeatedly; False ends the program.
        """
        start_s, exit_code, left, output = time.monotonic(), None, False, _Output()
        arguments = [*self.command, target, f"{x_mm:.3f}", str(placement)]
        try:
            # The program gets a session of its own: the Ctrl-C that ends the run does not reach it.
            process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except OSError as error:
            output.kept = (error.strerror or str(error)).encode()
        else:
            try:
                output.follow(process)
                exit_code = self._exit_code(process, start_s, meanwhile)
                # What only logs, as a `tee`, ends with the program.
                output.ended.wait(POLL_S)
            finally:
                left = _end_group(process) and exit_code is not None
            output.ended.wait(POLL_S)
        return PlaceCommanded(
            target=target,
            x_mm=x_mm,
            placement=placement,
            command=list(self.command),
            exit_code=exit_code,
            seconds=round(time.monotonic() - start_s, 1),
            limit_s=self.limit_s,
            words=output.kept.decode("utf-8", errors="replace")[-WORDS_MAX:],
            output_bytes=output.size,
            left_running=left or UNSET,
        )

    def _exit_code(self, process: subprocess.Popen[bytes], start_s: float, meanwhile: Callable[[], bool]) -> int | None:
        """The exit code; None for a program that has to be ended."""
        while meanwhile() and time.monotonic() - start_s < self.limit_s:
            try:
                return process.wait(POLL_S)
            except subprocess.TimeoutExpired:
                pass
        return None


def require_placed(event: PlaceCommanded) -> None:
    """Refuses a failed placement.

    Raises:
        DeviceFault: the program has failed.
    """
    if event.exit_code == 0:
        return
    code, limit_s = event.exit_code, event.limit_s
    ending = f"was ended after {event.seconds:g} s (limit {limit_s:g} s)" if code is None else f"ended with code {code}"
    text = escaped(event.words.strip()[-200:], 300) or "nothing"
    size = event.output_bytes or 0
    share = "" if size <= WORDS_MAX else f" (the end of {size} bytes; the rest is discarded)"
    found = f"the place command for {escaped(event.target)} {ending} and said: {text}{share}"
    raise fault("place-command", found, "bring the sheet into reach, then go on with --resume")


@dataclass
class _Output:
    """What a program writes, read as it comes, so that it neither waits nor fills a disk; the end of it is kept."""

    kept: bytes = b""
    size: int = 0
    ended: threading.Event = field(default_factory=threading.Event)

    def follow(self, process: subprocess.Popen[bytes]) -> None:
        threading.Thread(target=self._read, args=(process.stdout,), daemon=True).start()

    def _read(self, pipe: IO[bytes]) -> None:
        with pipe:
            while chunk := os.read(pipe.fileno(), OUTPUT_BYTES_MAX):
                self.size, self.kept = self.size + len(chunk), (self.kept + chunk)[-OUTPUT_BYTES_MAX:]
        self.ended.set()


def _end_group(process: subprocess.Popen[bytes]) -> bool:
    """End the program and all that it started in its process group; whether anything still ran."""
    try:
        if not _signalled(process, signal.SIGTERM):
            return False
        end_s = time.monotonic() + GRACE_S
        while _signalled(process, 0) and time.monotonic() < end_s:
            time.sleep(POLL_S)
        return True
    finally:
        # Also where a second Ctrl-C ends the grace.
        _signalled(process, getattr(signal, "SIGKILL", signal.SIGTERM))
        process.poll()


def _signalled(process: subprocess.Popen[bytes], number: int) -> bool:
    """Send a signal to the group (0: none); False if nothing of it runs. Windows has no groups: the program alone."""
    running = process.poll() is None
    if not hasattr(os, "killpg"):
        if running and number:
            process.terminate()
        return running
    try:
        os.killpg(process.pid, number)
    except (ProcessLookupError, PermissionError):
        return False
    return True

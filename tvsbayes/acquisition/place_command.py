"""Placements by a program, such as a robot that moves the rig, or a linear stage under the sheet.

The program gets three more arguments: the target, its nominal X in mm in frame S, and the number of the
placement in the plan, from 0. Exit code 0 means that the sheet is in place. Seconds where a name says `_s`.
"""

from __future__ import annotations

import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO

from tvsbayes.acquisition.journal_events import PlaceCommanded
from tvsbayes.errors import InputError, escaped, fault

LIMIT_S = 600.0
"""Default longest time of one placement."""
POLL_S = 0.1
"""Interval at which requests to the run are served during a placement."""
GRACE_S = 5.0
"""Time between SIGTERM, after which a program can stop its motion, and SIGKILL."""
WORDS_MAX = 2000
"""Number of last characters of its output that are kept."""


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
        start_s, exit_code = time.monotonic(), None
        with tempfile.TemporaryFile() as output:
            arguments = [*self.command, target, f"{x_mm:.3f}", str(placement)]
            try:
                # The program gets a session of its own: the Ctrl-C that ends the run does not reach it.
                with subprocess.Popen(
                    arguments, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
                ) as process:
                    exit_code = self._exit_code(process, start_s, meanwhile)
                text = _last_words(output)
            except OSError as error:
                text = error.strerror or str(error)
        return PlaceCommanded(
            target=target,
            x_mm=x_mm,
            placement=placement,
            command=list(self.command),
            exit_code=exit_code,
            seconds=round(time.monotonic() - start_s, 1),
            limit_s=self.limit_s,
            words=text,
        )

    def _exit_code(self, process: subprocess.Popen[bytes], start_s: float, meanwhile: Callable[[], bool]) -> int | None:
        """The exit code; None for a program that had to be ended."""
        try:
            while meanwhile() and time.monotonic() - start_s < self.limit_s:
                try:
                    return process.wait(POLL_S)
                except subprocess.TimeoutExpired:
                    pass
            process.terminate()
            try:
                process.wait(GRACE_S)
            except subprocess.TimeoutExpired:
                pass
            return None
        finally:
            process.kill()


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
    found = f"the place command for {escaped(event.target)} {ending} and said: {text}"
    raise fault("place-command", found, "bring the sheet into reach, then go on with --resume")


def _last_words(output: IO[bytes]) -> str:
    size = output.seek(0, 2)
    output.seek(max(0, size - WORDS_MAX))
    return output.read().decode("utf-8", errors="replace")

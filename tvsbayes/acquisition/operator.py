"""The operator of a run, the key that stops it, and its progress display.

The hazard is shown before the laser can be switched on; without a terminal the laser class is required. Ctrl-C ends a
run in an orderly way; signals that end the process become an interrupt, so that the laser is switched off.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import FrameType
from typing import Protocol

from tvsbayes.errors import InputError, escaped

HAZARD = """LASER HAZARD. 808 nm is invisible and likely class 3B: beam and reflections can blind before you blink.
Before you go on: goggles rated for 808 nm on everybody in the room; beam path shut in; no mirrors, watches, rings;
door sign and key switch in place. The laser is on only while a picture is taken. Ctrl-C stops: once after the
present look, twice at once. The firmware's watchdog is a last resort, no interlock."""
LASER_CLASSES = ("1", "1M", "2", "2M", "3R", "3B", "4")
"""Classes of IEC 60825-1 that a user may state in place of an answer."""
_Handler = Callable[[int, FrameType | None], object] | int | signal.Handlers
_TERMINATIONS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name))
"""SIGHUP exists on POSIX only, SIGBREAK on Windows only."""


class Operator(Protocol):
    """The person at the instrument."""

    def accept(self, hazard: str) -> bool:
        """Return whether the hazard has been read and the run may begin."""

    def place(self, target: str, x_mm: float, placement: int, remark: str) -> bool:
        """Put the sheet at a target (nominal X in frame S); False stops the run.

        `placement` counts the placements of the plan; a repeated number means the same place again. `remark` is the
        reason of a placement outside the plan, else "".
        """


@dataclass(frozen=True)
class Progress:
    """Progress of a run.

    Steps of the plan and looks, done and in total; refused and repeated looks, seconds left, the present step in words,
    and the running estimate, "" for none.
    """

    step: int
    steps: int
    looks: int
    looks_total: int
    refused: int
    retries: int
    seconds_left: float
    doing: str
    estimate: str = ""


class StopKey:
    """Ctrl-C: the first ends the run after the present look, the second interrupts at once.

    Signals that end a process (SIGTERM, SIGHUP of a closed terminal, Ctrl-Break on Windows) interrupt at once too:
    without a handler the process would die with the laser on.
    """

    def __init__(self, tell: Callable[[str], None] = lambda text: None):
        self.requested = False
        self.at_prompt = False
        """Whether a question is open: there is no look to finish, and the first Ctrl-C interrupts it."""
        self.closing = False
        """Whether laser and journal are being closed: nothing interrupts then, else the laser could stay on."""
        self._tell = tell
        self._before: dict[int, _Handler] = {}

    def __enter__(self) -> StopKey:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, *_TERMINATIONS):
                handler = signal.getsignal(number)
                # nohup ignores SIGHUP so that the run continues after its terminal closes.
                if number == signal.SIGINT or handler is not signal.SIG_IGN:
                    self._before[number] = signal.SIG_DFL if handler is None else handler
                    signal.signal(number, self._interrupt)
        return self

    def __exit__(self, *_: object) -> None:
        while self._before:
            number, handler = self._before.popitem()
            signal.signal(number, handler)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.closing:
            return
        if number != signal.SIGINT or self.requested or self.at_prompt:
            self.requested = True
            raise KeyboardInterrupt
        self.requested = True
        try:
            self._tell("finishing the present look; Ctrl-C again stops at once")
        except (RuntimeError, OSError):
            # The interrupted code was writing to the same stream, or the same key has ended the `tee` that reads it:
            # the request to stop counts nevertheless.
            pass


@dataclass(frozen=True)
class Terminal:
    """Output to the user of a run: `say` prints lines, `show` progress, and `ask` returns answers to questions."""

    say: Callable[[str], None] = lambda text: None
    show: Callable[[Progress], None] = lambda progress: None
    ask: Callable[[str], str] = input


@dataclass
class TerminalOperator:
    """Asks on the terminal.

    Attributes:
        stop: the stop key, which may interrupt a question.
        terminal: the terminal.
        laser_class: stated on the command line: the hazard is then shown without a question.
        places: whether a person places the sheet; else a program does.
    """

    stop: StopKey
    terminal: Terminal
    laser_class: str | None = None
    places: bool = True

    def accept(self, hazard: str) -> bool:
        """See `Operator.accept`."""
        for line in hazard.splitlines():
            self.terminal.say(line)
        if self.laser_class is not None:
            self.terminal.say(f"laser class {self.laser_class} stated on the command line: not asked")
            return True
        return self._answer("Type yes to go on: ") == "yes"

    def place(self, target: str, x_mm: float, placement: int, remark: str) -> bool:
        """See `Operator.place`."""
        if remark:
            self.terminal.say(f"note: {remark}")
        if not self.places:
            return True
        return self._answer(f"Put the sheet at {target} (X = {x_mm:g} mm), then press Enter; q stops: ") != "q"

    def _answer(self, question: str) -> str:
        self.stop.at_prompt = True
        try:
            return self.terminal.ask(question).strip().lower()
        except EOFError:
            self.terminal.say(
                "standard input has ended, the question cannot be asked: go on in a terminal, with --resume"
            )
        except KeyboardInterrupt:
            pass
        finally:
            self.stop.at_prompt = False
        self.stop.requested = True
        return "q"


def check_hazard(laser_class: str | None, simulate: bool) -> None:
    """Refuses an unknown laser class, and a real laser without a terminal or a class."""
    if laser_class is not None and laser_class.upper() not in LASER_CLASSES:
        remedy = "read it off the laser's label"
        raise InputError(
            "usage", f"laser class {escaped(laser_class)}", allowed=", ".join(LASER_CLASSES), remedy=remedy
        )
    # A closed standard input is represented by None.
    if not simulate and laser_class is None and not (sys.stdin and sys.stdin.isatty()):
        remedy = "run it in a terminal, or state --laser-class"
        raise InputError("usage", "the question about the laser hazard cannot be asked", remedy=remedy)


class LiveLine:
    """A progress line on a terminal, or plain lines at every tenth of the run elsewhere; a context manager."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bar

        self._console = Console(stderr=True)
        columns = TextColumn("{task.fields[doing]}"), BarColumn(), TextColumn("{task.fields[note]}")
        self._bar = Bar(*columns, console=self._console, transient=True, disable=not self._console.is_terminal)
        self._task = self._bar.add_task("acquire", total=None, doing="", note="")
        self._tenths = 0

    def __enter__(self) -> LiveLine:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, state: Progress) -> None:
        """Shows the present progress."""
        note = f"look {state.looks} of {state.looks_total}, {state.refused} refused, {state.retries} repeated, "
        note += f"{state.seconds_left / 60:.0f} min left"
        if state.estimate:
            note += f"; deg/step {state.estimate}"
        self._bar.update(self._task, total=state.steps, completed=state.step, doing=state.doing, note=note)
        tenths = 10 * state.step // max(state.steps, 1)
        if not self._console.is_terminal and tenths > self._tenths:
            self._tenths = tenths
            self._console.print(f"{10 * tenths} %: {note}", highlight=False)

    def ask(self, question: str) -> str:
        """Call `input` with the progress line stopped; the question goes to stderr, because stdout has the result."""
        self._bar.stop()
        try:
            self._console.print(question, end="", markup=False, highlight=False)
            if sys.stdin is None:
                raise EOFError
            return input()
        finally:
            self._bar.start()

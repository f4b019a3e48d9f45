"""Progress of long work: the present task, the share done, and the time left; the share never decreases.

A `Job` is work in named stages, each with its expected share of the time. The function that works reports its state,
and a callback shows it to the user, in the same thread. An exception of the callback passes through and so ends the
work. Without a callback, in an interactive session (a Python prompt, IPython, a notebook), work that has lasted two
seconds shows one line, which is removed at its end; scripts show nothing.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import TracebackType


@dataclass(frozen=True)
class Progress:
    """The state of long work.

    Attributes:
        doing: the present task, in words.
        share: share of the whole work done, from 0 to 1; it never decreases, and 1 is the end.
        seconds: time since the beginning.
        seconds_left: expected; it increases by no more than the time passed. None while it cannot be predicted.
    """

    doing: str
    share: float
    seconds: float
    seconds_left: float | None


Show = Callable[[Progress], None]
"""Receives the state of long work."""
Advance = Callable[[float], None]
"""Receives the share of a stage that is done, from 0 to 1."""
EXPECTED_SHARE, EXPECTED_SECONDS = 0.02, 0.5
"""Share done and time passed from which the remaining time is predicted."""
MEMORY = 0.2
"""Share of the time passed over which the speed is averaged: stages are not equally well predicted."""
EXPECTED_LAST = 0.8
"""Share of the remaining part of a stage of unknown length that ends at the length expected now, which may be short."""


SHOWN_AFTER_SECONDS = 2.0
"""Work that lasts this long is shown."""


def time_left(seconds: float | None) -> str:
    """Time left in words; "" where it is unknown."""
    if seconds is None:
        return ""
    return f"{seconds:.0f} s left" if seconds < 100 else f"{seconds / 60:.0f} min left"


Write = Callable[[Progress | None], None]
"""Replaces the displayed state of long work; None removes it."""


def _in_words(state: Progress | None) -> str:
    if state is None:
        return ""
    return ", ".join(filter(None, (f"{100 * state.share:.0f} %", state.doing, time_left(state.seconds_left))))


def _line_writer() -> Write | None:
    """Make the writer of a session's progress line; None in a script, or where nobody would see the line."""
    if not hasattr(sys, "ps1"):
        return None
    if "ipykernel" in sys.modules:
        from IPython.display import display

        handle = display({"text/plain": ""}, raw=True, display_id=True)
        return lambda state: handle.update({"text/plain": _in_words(state)}, raw=True)
    if not sys.stderr.isatty():
        return None

    def write(state: Progress | None) -> None:
        sys.stderr.write(f"\r\x1b[K{_in_words(state)}")
        sys.stderr.flush()

    return write


class DelayedDisplay:
    """The display of long work; it appears after `SHOWN_AFTER_SECONDS`, also before the first report.

    Args:
        doing: the present task, until something is reported.
        writer: makes the writer, called when the display appears.
    """

    _shown = threading.Lock()
    """Held by one display at a time: a job inside a job shows nothing."""

    def __init__(self, doing: str, writer: Callable[[], Write | None] = _line_writer):
        self._state, self._writer = Progress(doing, 0.0, 0.0, None), writer
        self._write: Write | None = None
        self._lock = threading.RLock()
        self._mine = self._shown.acquire(blocking=False)
        self._timer = threading.Timer(SHOWN_AFTER_SECONDS, self._open)
        self._timer.daemon = True
        if self._mine:
            self._timer.start()

    def show(self, state: Progress) -> None:
        """Receive the state."""
        with self._lock:
            self._state = state
            self._update()

    def close(self) -> None:
        """Remove the display."""
        self._timer.cancel()
        with self._lock:
            if self._write is not None:
                self._write(None)
                self._write = None
            if self._mine:
                self._mine = False
                self._shown.release()

    def _open(self) -> None:
        with self._lock:
            # The timer may fire while the work ends.
            if self._mine:
                self._write = self._writer()
                self._update()

    def _update(self) -> None:
        if self._write is not None:
            self._write(self._state)


def unshown(share: float) -> None:
    """Ignore progress: for callers that show none."""


class Job:
    """Work in named stages, as a context manager; the end is reported where its block ends without an error.

    Args:
        stages: expected share of the time by task, in order, in any unit; stages with 0 are left out.
        show: receives the state; None shows it only in an interactive session.
        clock: seconds.

    Raises:
        ValueError: all times are zero, or one is negative.
    """

    def __init__(
        self, stages: Mapping[str, float], show: Show | None = None, clock: Callable[[], float] = time.monotonic
    ):
        total = sum(stages.values())
        if not total > 0 or any(weight < 0 for weight in stages.values()):
            raise ValueError(f"stages {dict(stages)}: shares of the time are not negative, and some are positive")
        self._ends: dict[str, tuple[float, float]] = {}
        before = 0.0
        for doing, weight in stages.items():
            after = before + weight / total
            self._ends[doing] = before, after
            before = after
        self._show, self._clock, self._began = show, clock, clock()
        self._stage = next(iter(stages))
        self._told = Progress(self._stage, 0.0, 0.0, None)
        self._silent, self._skipped = True, 0.0
        self._line: DelayedDisplay | None = None

    def __enter__(self) -> Job:
        if self._show is None and hasattr(sys, "ps1"):
            self._line = DelayedDisplay(self._stage)
            self._show = self._line.show
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._line is not None:
            self._line.close()
        if kind is None:
            self._tell(self._told.doing, 1.0)

    def begin(self, doing: str) -> None:
        """Begin a stage; those before it are done, or were not needed. An unknown stage raises `KeyError`."""
        before, done = self._ends[self._stage]
        # Stages that were left out, or that reported nothing, give no speed for a prediction.
        self._skipped += max(self._ends[doing][0] - (before if self._silent else done), 0.0)
        self._stage = doing
        self.at(0.0)

    def at(self, share: float, detail: str = "") -> None:
        """Report the share of the present stage that is done, with a detail in words; the share never decreases."""
        first, end = self._ends[self._stage]
        self._silent = False
        if end > first:
            doing = f"{self._stage}: {detail}" if detail else self._stage
            self._tell(doing, first + min(max(share, 0.0), 1.0) * (end - first))

    def part(self, doing: str) -> Show | None:
        """Begin a stage that is a job of its own; returns its callback, None where nothing is shown."""
        self.begin(doing)
        self._silent = True
        return None if self._show is None else lambda state: self.at(state.share, state.doing)

    def _tell(self, doing: str, share: float) -> None:
        if self._show is None:
            return
        seconds = max(self._clock() - self._began, self._told.seconds)
        share = max(min(share, 1.0), self._told.share)
        self._told = Progress(doing, share, seconds, self._left(share, seconds))
        self._show(self._told)

    def _left(self, share: float, seconds: float) -> float | None:
        """Predict the seconds left by the averaged speed so far."""
        if share >= 1:
            return 0.0
        before, passed = self._told.seconds_left, seconds - self._told.seconds
        worked = share - self._skipped
        if before is None and (worked < EXPECTED_SHARE or seconds < EXPECTED_SECONDS):
            return None
        now = seconds * (1 - share) / max(worked, EXPECTED_SHARE)
        if before is None:
            return now
        expected = max(before - passed, 0.0)
        weight = passed / (passed + MEMORY * seconds) if passed > 0 else 0.0
        return min(expected + weight * (now - expected), before + passed)


class OpenEnded:
    """The share of a stage whose expected length changes as it goes on: it approaches 1 without reaching it early."""

    def __init__(self) -> None:
        self._since, self._share, self._expected = 0.0, 0.0, 0.0

    def share(self, done: float, expected: float) -> float:
        """The share after `done` of the `expected` steps or rounds; it does not decrease while `done` does not."""
        if expected > self._expected:
            self._share = self._of(done)
            self._since, self._expected = done, expected
        return self._of(done)

    def _of(self, done: float) -> float:
        length = self._expected - self._since
        part = min(max((done - self._since) / length, 0.0), 1.0) if length > 0 else 0.0
        return self._share + EXPECTED_LAST * part * (1 - self._share)

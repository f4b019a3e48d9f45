"""The bar that shows a wait: on stderr, where that is a terminal, for a wait that has lasted two seconds.

What an interrupted wait leaves behind is told too.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tvsbayes.cli.app import report_line
from tvsbayes.pipeline import SAMPLING
from tvsbayes.progress import SHOWN_AFTER_SECONDS, Progress, Show, time_left

if TYPE_CHECKING:
    from rich.progress import Progress as Bar


@contextmanager
def waiting() -> Iterator[Show | None]:
    """What shows the progress of the block; None where nobody sees it."""
    if not sys.stderr.isatty():
        yield None
        return
    shown = _Shown()
    try:
        yield shown.show
    finally:
        shown.close()


@contextmanager
def chain_kept(further: str) -> Iterator[Show]:
    """`waiting` for a fit; Ctrl-C says that its chain is kept, and how to go on with it."""
    from tvsbayes.posterior.sampling import WALKING

    told = 0
    try:
        with waiting() as shown:

            def show(state: Progress) -> None:
                nonlocal told
                told += state.doing == f"{SAMPLING}: {WALKING}"
                if shown is not None:
                    shown(state)

            yield show
    except KeyboardInterrupt:
        # It is told of once when it begins: before the first block of steps there is no chain to keep.
        if told > 1:
            report_line(f"the chain so far is kept in chain.npz; {further}")
        raise


class _Shown:
    """A bar that appears when the wait is long enough, also while nothing is told, and leaves no trace."""

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._lock = threading.RLock()
        self._state = Progress("", 0.0, 0.0, None)
        self._bar: Bar | None = None
        self._timer = threading.Timer(SHOWN_AFTER_SECONDS, self._open)
        self._timer.daemon = True
        self._timer.start()

    def show(self, state: Progress) -> None:
        """Takes the news."""
        with self._lock:
            self._state = state
            if self._bar is None and time.monotonic() - self._began >= SHOWN_AFTER_SECONDS:
                self._open()
            self._update()

    def close(self) -> None:
        """Take the bar away."""
        self._timer.cancel()
        with self._lock:
            if self._bar is not None:
                self._bar.stop()

    def _open(self) -> None:
        with self._lock:
            # The timer may fire after a bar was opened, or while the wait ends.
            if self._bar is not None or self._timer.finished.is_set():
                return
            from rich.console import Console
            from rich.progress import BarColumn, TaskProgressColumn, TextColumn
            from rich.progress import Progress as Bar

            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                TaskProgressColumn(),
                TextColumn("{task.fields[left]}"),
            )
            # Standard output is for the result alone.
            self._bar = Bar(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False)
            self._bar.add_task("", total=1.0, left="")
            self._update()
            self._bar.start()

    def _update(self) -> None:
        if self._bar is not None:
            state = self._state
            left = time_left(state.seconds_left)
            self._bar.update(self._bar.task_ids[0], description=state.doing, completed=state.share, left=left)

"""The progress bar, shown on stderr if it is a terminal, after two seconds of waiting.

After an interruption a line reports the files that were kept.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext

from tvsbayes.cli.app import report_line
from tvsbayes.pipeline import SAMPLING
from tvsbayes.progress import DelayedDisplay, Progress, Show, Write, time_left
from tvsbayes.results.tiers import CHAIN


@contextmanager
def waiting(kept: str = "") -> Iterator[Show | None]:
    """A function that shows the progress of the block; None without a terminal. After Ctrl-C the line `kept`."""
    display = DelayedDisplay("", _bar) if sys.stderr.isatty() else None
    try:
        with nullcontext() if display is None else closing(display):
            yield None if display is None else display.show
    except KeyboardInterrupt:
        if kept:
            report_line(kept)
        raise


@contextmanager
def chain_progress(hint: str) -> Iterator[Show]:
    """`waiting` for a fit; after Ctrl-C a line reports that the chain is kept, and how to continue it."""
    from tvsbayes.posterior.sampling import walking

    announced = 0
    try:
        with waiting() as show_progress:

            def show(state: Progress) -> None:
                nonlocal announced
                announced += state.doing == f"{SAMPLING}: {walking(CHAIN)}"
                if show_progress is not None:
                    show_progress(state)

            yield show
    except KeyboardInterrupt:
        # The first announcement is the start of the chain: before its first block of steps there is nothing to keep.
        if announced > 1:
            report_line(f"the chain so far is kept in chain.npz; {hint}")
        raise


def _bar() -> Write:
    """A bar on stderr that is removed at its end."""
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[left]}"))
    # Standard output receives only the result.
    bar = Bar(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False)
    task = bar.add_task("", total=1.0, left="")

    def write(state: Progress | None) -> None:
        if state is None:
            bar.stop()
            return
        time_text = time_left(state.seconds_left)
        bar.update(task, description=state.doing, completed=state.share, left=time_text)
        bar.start()

    return write

"""The bar that shows a wait: on stderr, where that is a terminal, for a wait that has lasted two seconds.

What an interrupted wait leaves behind is said too.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tvsbayes.cli.app import report_line
from tvsbayes.pipeline import SAMPLING
from tvsbayes.progress import DelayedDisplay, Progress, Show, Write, time_left


@contextmanager
def waiting() -> Iterator[Show | None]:
    """What shows the progress of the block; None where nobody sees it."""
    if not sys.stderr.isatty():
        yield None
        return
    display = DelayedDisplay("", _bar)
    try:
        yield display.show
    finally:
        display.close()


@contextmanager
def chain_kept(further: str) -> Iterator[Show]:
    """`waiting` for a fit; Ctrl-C says that its chain is kept, and how to go on with it."""
    from tvsbayes.posterior.sampling import WALKING

    announced = 0
    try:
        with waiting() as shown:

            def show(state: Progress) -> None:
                nonlocal announced
                announced += state.doing == f"{SAMPLING}: {WALKING}"
                if shown is not None:
                    shown(state)

            yield show
    except KeyboardInterrupt:
        # It is announced once when it begins: before the first block of steps there is no chain to keep.
        if announced > 1:
            report_line(f"the chain so far is kept in chain.npz; {further}")
        raise


def _bar() -> Write:
    """A bar on stderr that leaves no trace."""
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[left]}"))
    # Standard output is for the result alone.
    bar = Bar(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False)
    task = bar.add_task("", total=1.0, left="")

    def write(state: Progress | None) -> None:
        if state is None:
            bar.stop()
            return
        left = time_left(state.seconds_left)
        bar.update(task, description=state.doing, completed=state.share, left=left)
        bar.start()

    return write

"""A page that is served to a test: in a thread of this process, ended with the test."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager

from tvsbayes.view.contents import Contents
from tvsbayes.view.server import serving

SECONDS_MAX = 60
"""For the thread to start and to end; reached only where something is broken."""


@contextmanager
def page_served(contents: Contents) -> Iterator[str]:
    """The link of a server that runs as long as the block."""
    link: Future[str] = Future()
    loop = asyncio.new_event_loop()
    task = loop.create_task(serving(contents, 0, link.set_result))

    def run() -> None:
        try:
            loop.run_until_complete(task)
        except asyncio.CancelledError:
            pass
        finally:
            loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield link.result(SECONDS_MAX)
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(SECONDS_MAX)
        assert not thread.is_alive()

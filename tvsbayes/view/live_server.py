"""The server of a run's page, in a thread beside the run: it may be slow, or die, and the run goes on."""

from __future__ import annotations

import asyncio
import threading
import time
from concurrent.futures import Future
from types import TracebackType
from typing import Any

from tvsbayes.view.contents import Contents
from tvsbayes.view.server import serving
from tvsbayes.view.watched import Watched

LINGER_S, LINGER_POLL_S = 2.0, 0.05
"""Longest wait at the end for browsers to fetch the last snapshot: they ask twice a second."""
PICTURES_S = 0.5
"""For the pictures that they fetch after it."""
READER_S = 2.0
"""Whoever has not asked for so long has gone."""


class _Read:
    """A run, and when it was read last; see `Watched`."""

    def __init__(self, live: Watched):
        self._live = live
        self.read_s, self.number = -READER_S, -1

    def told(self) -> dict[str, Any]:
        """See `Watched.told`."""
        told = self._live.told()
        self.read_s, self.number = time.monotonic(), told["number"]
        return told

    def picture(self, spot: int, camera: str, kind: str) -> bytes | None:
        """See `Watched.picture`."""
        return self._live.picture(spot, camera, kind)

    def ask(self, what: str) -> bool:
        """See `Watched.ask`."""
        return self._live.ask(what)


class LivePage:
    """A page served beside a run; a context manager, entered once it listens.

    Args:
        contents: files of the page.
        live: the run.
        port: to listen on; 0 takes a free one.

    Attributes:
        link: what to open.

    Raises:
        InputError: on entering: the port is taken or forbidden.
    """

    def __init__(self, contents: Contents, live: Watched, port: int):
        self.link = ""
        self._live, self._read = live, _Read(live)
        self._link: Future[str] = Future()
        self._loop = asyncio.new_event_loop()
        self._task = self._loop.create_task(serving(contents, port, self._link.set_result, self._read))
        # A daemon: a server that hangs must not keep the process, and so the laser's port, alive.
        self._thread = threading.Thread(target=self._serve, name="live page", daemon=True)

    def __enter__(self) -> LivePage:
        self._thread.start()
        self.link = self._link.result()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._linger()
        self.end()
        self._thread.join(LINGER_S)

    def end(self) -> None:
        """Serve no longer, whatever the run does."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._task.cancel)

    def _serve(self) -> None:
        """Until it is ended or fails; what fails before it listens is told to who waits for the link."""
        try:
            self._loop.run_until_complete(self._task)
        except asyncio.CancelledError:
            pass
        except Exception as error:
            if not self._link.done():
                self._link.set_exception(error)
        finally:
            self._loop.close()

    def _linger(self) -> None:
        """Let the browsers that are there see how it ended."""
        until = time.monotonic() + LINGER_S
        last = self._live.told()["number"]
        while time.monotonic() < until and self._thread.is_alive():
            since_s = time.monotonic() - self._read.read_s
            if since_s > (PICTURES_S if self._read.number == last else READER_S):
                return
            time.sleep(LINGER_POLL_S)

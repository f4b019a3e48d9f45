"""The server of a run's page: 127.0.0.1 alone, in a thread beside the run, which goes on however slow or dead it is.

The server shares the file descriptors of the run, so it holds few connections, none for long without a request.
"""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from types import TracebackType
from typing import TYPE_CHECKING, Any

from tvsbayes.errors import InputError
from tvsbayes.files.disk import shipped_data
from tvsbayes.view.access import HOSTS, Access

if TYPE_CHECKING:
    from tvsbayes.view.live_handlers import Watched

HTML, CSS, SCRIPT = ("text/html; charset=utf-8", "text/css; charset=utf-8", "text/javascript; charset=utf-8")
PAGE_FILES = {
    "/": ("live.html", HTML),
    "/page.css": ("page.css", CSS),
    "/live.css": ("live.css", CSS),
    "/drawing.js": ("drawing.js", SCRIPT),
    "/live.js": ("live.js", SCRIPT),
}
"""Paths of the page, their files in `data/view` and what they are."""
REQUEST_BYTES_MAX = 4096
CONNECTIONS_MAX, DESCRIPTORS_SHARE = 64, 4
"""Open connections: so many, and at most one in so many of the descriptors that the process may have."""
IDLE_S = 5.0
"""A connection without a request for so long is closed; the page asks twice a second."""
LINGER_S, LINGER_POLL_S = 2.0, 0.05
"""Longest wait at the end for browsers to fetch the last snapshot: they ask twice a second."""
PICTURES_S = 0.5
"""For the pictures that they fetch after it."""
READER_S = 2.0
"""Anyone who has not asked for so long has gone."""


def page_files() -> dict[str, tuple[bytes, str]]:
    """The files of the page and what they are, by path.

    Raises:
        InputError: without the extra.
    """
    try:
        import tornado  # noqa: F401
    except ImportError as error:
        message, remedy = "the page needs the extra live (tornado)", "pip install 'tvsbayes[live]'"
        raise InputError("no-live", message, remedy=remedy) from error
    folder = shipped_data() / "view"
    return {path: ((folder / name).read_bytes(), kind) for path, (name, kind) in PAGE_FILES.items()}


def connections_max() -> int:
    """How many connections may be open at a time."""
    try:
        import resource
    except ImportError:
        return CONNECTIONS_MAX
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return CONNECTIONS_MAX if soft < 0 else max(2, min(CONNECTIONS_MAX, soft // DESCRIPTORS_SHARE))


async def serving(live: Watched, port: int, started: Callable[[str], None], read: Callable[[int], None]) -> None:
    """Serve the page of a run on 127.0.0.1 until the task is cancelled.

    Args:
        live: the run.
        port: to listen on; 0 takes a free one.
        started: given the link once the server listens.
        read: called with the number of every snapshot that is sent.

    Raises:
        InputError: the port is taken or forbidden, or the extra is missing.
    """
    files = page_files()
    from tornado.httpserver import HTTPServer
    from tornado.iostream import IOStream

    from tvsbayes.view.live_handlers import application

    class Server(HTTPServer):
        """Closes the connection that was opened first where there are too many: who comes new is heard."""

        def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
            still = [one for one in connections if not one.closed()]
            for one in still[: max(0, len(still) + 1 - most)]:
                one.close()
            connections[:] = [*still, stream]
            super().handle_stream(stream, address)

    connections: list[IOStream] = []
    most = connections_max()
    try:
        listening = socket.create_server((HOSTS[0], port))
    except OSError as error:
        allowed, remedy = "a free port", "name another, or leave --port out"
        found = f"port {port} of this machine cannot be used: {error.strerror or error}"
        raise InputError("port", found, column="--port", allowed=allowed, remedy=remedy) from error
    listening.setblocking(False)
    access = Access(listening.getsockname()[1])
    limits = {"max_body_size": REQUEST_BYTES_MAX, "idle_connection_timeout": IDLE_S, "body_timeout": IDLE_S}
    server = Server(application(files, access, live, read), **limits)
    server.add_sockets([listening])
    try:
        started(access.link)
        await asyncio.Event().wait()
    finally:
        server.stop()
        # A browser that waits on a connection kept open would else wait for ever.
        await server.close_all_connections()


class LivePage:
    """A page served beside a run; a context manager, entered once it listens.

    Args:
        live: the run.
        port: to listen on; 0 takes a free one.

    Attributes:
        link: what to open.

    Raises:
        InputError: on entering: the port is taken or forbidden, or the extra is missing.
    """

    def __init__(self, live: Watched, port: int):
        self.link = ""
        self._live, self._read_s, self._number = live, -READER_S, -1
        self._link: Future[str] = Future()
        self._loop = asyncio.new_event_loop()
        self._task = self._loop.create_task(serving(live, port, self._link.set_result, self._was_read))
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
        """Until it is ended or fails; what fails before it listens is raised to who waits for the link."""
        try:
            self._loop.run_until_complete(self._task)
        except asyncio.CancelledError:
            pass
        except Exception as error:
            if not self._link.done():
                self._link.set_exception(error)
        finally:
            self._loop.close()

    def _was_read(self, number: int) -> None:
        self._read_s, self._number = time.monotonic(), number

    def _linger(self) -> None:
        """Let the browsers that are there see how it ended."""
        until = time.monotonic() + LINGER_S
        last = self._live.document()["number"]
        while time.monotonic() < until and self._thread.is_alive():
            since_s = time.monotonic() - self._read_s
            if since_s > (PICTURES_S if self._number == last else READER_S):
                return
            time.sleep(LINGER_POLL_S)

"""The page of a run: served on 127.0.0.1 only, in a separate thread, whose delay or failure does not affect the run.

Only browsers with the page's link may read, and only from the page itself. The link's token stands after the #, which
browsers do not send; the page sends it as a header with every request. There is no cookie: requests that another page
causes in this browser carry no token (CSRF). The Host header reveals a foreign name that resolves to 127.0.0.1 (DNS
rebinding), Origin and Sec-Fetch-Site reveal another page (Fetch Metadata, W3C). All requests, also for unknown paths,
pass `Access` first; no path in a request is used as a path on the disk, and nothing can be written.

The server shares the file descriptors of the run, so it keeps few connections, and none for long without a request.
Tornado is an extra: it is imported once a page is served.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from types import TracebackType
from typing import Any, Protocol

from tvsbayes.errors import InputError
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import CAMERAS

HTML, CSS, SCRIPT = ("text/html; charset=utf-8", "text/css; charset=utf-8", "text/javascript; charset=utf-8")
PAGE_FILES = {
    "/": ("live.html", HTML),
    "/page.css": ("page.css", CSS),
    "/live.css": ("live.css", CSS),
    "/drawing.js": ("drawing.js", SCRIPT),
    "/live.js": ("live.js", SCRIPT),
}
"""Paths of the page, with their files in `data/view` and MIME types."""
PICTURE = re.compile(rf"/live/([0-9]{{1,10}})/({'|'.join(CAMERAS)})/(whole|spot)")
HOSTS = ("127.0.0.1", "localhost")
TOKEN_HEADER = "X-Tvsbayes-Token"
TOKEN_BYTES = 32
SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Headers of every answer. The policy lets the page load only from its own server: no request leaves the machine."""
REQUEST_BYTES_MAX = 4096
CONNECTIONS_MAX, DESCRIPTORS_SHARE = 64, 4
"""Largest number of open connections, also at most the process' limit of descriptors over the second number."""
IDLE_S = 5.0
"""Time without a request after which a connection is closed; the page sends two a second."""
LINGER_S, LINGER_POLL_S = 2.0, 0.05
"""Longest wait at the end for browsers to fetch the last snapshot, and interval of checking."""
PICTURES_S = 0.5
"""Further wait for the pictures that they fetch after it."""
READER_S = 2.0
"""Time without a request after which a reader counts as gone."""
Files = Mapping[str, tuple[bytes, str]]
"""Content and MIME type of the page's own files, by path."""


class Watched(Protocol):
    """Interface of a run for its page; called by the server's thread, so no call may wait for the run."""

    def document(self) -> dict[str, Any]:
        """The newest snapshot as a JSON document."""

    def picture(self, spot: int, camera: str, kind: str) -> bytes | None:
        """JPEG of the last look: "whole", or "spot" for the region around it; None if there is none."""


class Access:
    """Token and address of the page on one port."""

    def __init__(self, port: int) -> None:
        self.port = port
        self._token = secrets.token_urlsafe(TOKEN_BYTES)

    @property
    def link(self) -> str:
        """The address to open."""
        return f"http://{HOSTS[0]}:{self.port}/#{self._token}"

    def stranger(self, headers: Mapping[str, str]) -> str | None:
        """Why a request with these headers is not from the page itself, None where it may be."""
        hosts = [f"{host}:{self.port}" for host in HOSTS]
        if headers.get("Host", "") not in hosts:
            return "this server answers to 127.0.0.1 and localhost only"
        origins = (None, *(f"http://{host}" for host in hosts))
        foreign = headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none")
        return "another page asked" if foreign or headers.get("Origin") not in origins else None

    def knows(self, headers: Mapping[str, str]) -> bool:
        """Whether a request carries the token; compared in a time independent of where they differ."""
        return hmac.compare_digest(headers.get(TOKEN_HEADER, "").encode(errors="replace"), self._token.encode())


def page_files() -> dict[str, tuple[bytes, str]]:
    """The files of the page with their MIME types, by path.

    Raises:
        InputError: the extra is not installed.
    """
    try:
        import tornado  # noqa: F401
    except ImportError as error:
        message, remedy = "the page needs the extra live (tornado)", "pip install 'tvsbayes[live]'"
        raise InputError("no-live", message, remedy=remedy) from error
    folder = shipped_data() / "view"
    return {path: ((folder / name).read_bytes(), kind) for path, (name, kind) in PAGE_FILES.items()}


def connections_max() -> int:
    """Largest number of connections open at a time."""
    try:
        import resource
    except ImportError:
        return CONNECTIONS_MAX
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return CONNECTIONS_MAX if soft < 0 else max(2, min(CONNECTIONS_MAX, soft // DESCRIPTORS_SHARE))


def _application(files: Files, access: Access, live: Watched, read: Callable[[int], None]) -> Any:
    """The application that answers; `read` is called with the number of every snapshot that is sent."""
    from tornado import web

    class Page(web.RequestHandler):
        def set_default_headers(self) -> None:
            self.clear_header("Server")
            for name, value in SECURITY_HEADERS.items():
                self.set_header(name, value)

        def prepare(self) -> None:
            path, headers = self.request.path, self.request.headers
            reason = access.stranger(headers)
            # Files of the page contain no data of a run, and browsers cannot send the token's header for a script.
            if reason is None and path not in files and not access.knows(headers):
                reason = "without the token of its link: open the link that the terminal shows"
            if reason is not None:
                raise web.HTTPError(403, reason=reason)
            if path not in files and path != "/live" and PICTURE.fullmatch(path) is None:
                raise web.HTTPError(404)

        def get(self) -> None:
            path = self.request.path
            if path in files:
                content, kind = files[path]
                self.send(kind, content)
            elif asked := PICTURE.fullmatch(path):
                picture = live.picture(int(asked[1]), asked[2], asked[3])
                if picture is None:
                    # A newer look has replaced it, which is not an error.
                    self.set_status(204)
                else:
                    self.send("image/jpeg", picture)
            else:
                document = live.document()
                self.send("application/json", json.dumps(document, allow_nan=False))
                read(document["number"])

        def write_error(self, status_code: int, **kwargs: Any) -> None:
            # In words, without a traceback.
            self.send("text/plain; charset=utf-8", f"{status_code}: {self._reason}\n")

        def send(self, kind: str, content: str | bytes) -> None:
            self.set_header("Content-Type", kind)
            self.finish(content)

    return web.Application([(".*", Page)], log_function=lambda handler: None)


async def serving(live: Watched, port: int, started: Callable[[str], None], read: Callable[[int], None]) -> None:
    """Serve the page of a run on 127.0.0.1 until the task is cancelled.

    Args:
        live: the run.
        port: port to listen on; 0 selects a free one.
        started: called with the link once the server listens.
        read: called with the number of every snapshot that is sent.

    Raises:
        InputError: the port is taken or forbidden, or the extra is missing.
    """
    files = page_files()
    from tornado.httpserver import HTTPServer
    from tornado.iostream import IOStream

    connections: list[IOStream] = []
    most = connections_max()

    class Server(HTTPServer):
        """Closes the oldest connection where there are too many, so that new ones are served."""

        def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
            still = [one for one in connections if not one.closed()]
            for one in still[: max(0, len(still) + 1 - most)]:
                one.close()
            connections[:] = [*still, stream]
            super().handle_stream(stream, address)

    try:
        listening = socket.create_server((HOSTS[0], port))
    except OSError as error:
        allowed, remedy = "a free port", "name another, or leave --port out"
        found = f"port {port} of this machine cannot be used: {error.strerror or error}"
        raise InputError("port", found, column="--port", allowed=allowed, remedy=remedy) from error
    listening.setblocking(False)
    access = Access(listening.getsockname()[1])
    limits = {"max_body_size": REQUEST_BYTES_MAX, "idle_connection_timeout": IDLE_S, "body_timeout": IDLE_S}
    server = Server(_application(files, access, live, read), **limits)
    server.add_sockets([listening])
    try:
        started(access.link)
        await asyncio.Event().wait()
    finally:
        server.stop()
        # Otherwise a browser would wait without end on a connection kept open.
        await server.close_all_connections()


class LivePage:
    """A page served beside a run, as a context manager, entered once the server listens.

    Args:
        live: the run.
        port: port to listen on; 0 selects a free one.

    Attributes:
        link: the address to open.

    Raises:
        InputError: when entered: the port is taken or forbidden, or the extra is missing.
    """

    def __init__(self, live: Watched, port: int):
        self.link = ""
        self._live, self._read_s, self._number = live, -READER_S, -1
        self._link: Future[str] = Future()
        self._loop = asyncio.new_event_loop()
        self._task = self._loop.create_task(serving(live, port, self._link.set_result, self._was_read))
        # A daemon thread: a hanging server must not keep the process alive, and with it the laser's port.
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
        """Stop serving, in any state of the run."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._task.cancel)

    def _serve(self) -> None:
        """Serve until ended or failed; an error before listening is raised where the link is awaited."""
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
        """Give connected browsers time to fetch the final snapshot."""
        until = time.monotonic() + LINGER_S
        last = self._live.document()["number"]
        while time.monotonic() < until and self._thread.is_alive():
            since_s = time.monotonic() - self._read_s
            if since_s > (PICTURES_S if self._number == last else READER_S):
                return
            time.sleep(LINGER_POLL_S)

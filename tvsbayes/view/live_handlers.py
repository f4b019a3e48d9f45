"""Answers to a browser that watches a run: all requests, also for unknown paths, pass `Access` first. Tornado.

No path in a request is used as a path on the disk, and nothing can be written.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from tornado import web

from tvsbayes.instrument.campaign import CAMERAS
from tvsbayes.view.access import SECURITY_HEADERS, Access

Files = Mapping[str, tuple[bytes, str]]
"""Content and MIME type of the page's own files, by path."""


class Watched(Protocol):
    """Interface of a run for its page; called by the server's thread, so no call may wait for the run."""

    def document(self) -> dict[str, Any]:
        """The newest snapshot as a JSON document."""

    def picture(self, spot: int, camera: str, kind: str) -> bytes | None:
        """JPEG of the last look: "whole", or "spot" for the region around it; None if there is none."""


class Guarded(web.RequestHandler):
    """Base of all answers.

    Attributes:
        access: the access control.
        files: files of the page.
        live: the run.
        read: called with the number of every snapshot that is sent.
        open_to_all: whether the page's own browser is answered without the token.
    """

    open_to_all = False

    def initialize(self, access: Access, files: Files, live: Watched, read: Callable[[int], None]) -> None:
        """Initialise the handler; Tornado calls it for every request."""
        self.access, self.files, self.live, self.read = access, files, live, read

    def set_default_headers(self) -> None:
        """Set `SECURITY_HEADERS`, without the server's name."""
        self.clear_header("Server")
        for name, value in SECURITY_HEADERS.items():
            self.set_header(name, value)

    def prepare(self) -> None:
        """Refuse foreign requests first."""
        reason = self.access.stranger(self.request.headers)
        if reason is None and not self.open_to_all and not self.access.knows(self.request.headers):
            reason = "without the token of its link: open the link that the terminal shows"
        if reason is not None:
            raise web.HTTPError(403, reason=reason)

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """Write the error in words, without a traceback."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code}: {self._reason}\n")


class Unknown(Guarded):
    """Answers any other path."""

    def prepare(self) -> None:
        """Answer "not found" to requests with access."""
        super().prepare()
        raise web.HTTPError(404)


class File(Guarded):
    """A file of the page; it contains no data of a run, and browsers cannot send the token's header for a script."""

    open_to_all = True

    def get(self) -> None:
        """Send the file of exactly this path."""
        content, kind = self.files[self.request.path]
        self.set_header("Content-Type", kind)
        self.finish(content)


class Now(Guarded):
    """Gives the newest snapshot."""

    def get(self) -> None:
        """Send it as JSON."""
        self.set_header("Content-Type", "application/json")
        document = self.live.document()
        self.finish(json.dumps(document, allow_nan=False))
        self.read(document["number"])


class LivePicture(Guarded):
    """Gives a picture of the last look."""

    def get(self, spot: str, camera: str, kind: str) -> None:
        """Send it as JPEG; nothing if it no longer exists."""
        picture = self.live.picture(int(spot), camera, kind)
        if picture is None:
            # A newer look has replaced it, which is not an error.
            self.set_status(204)
            self.finish()
            return
        self.set_header("Content-Type", "image/jpeg")
        self.finish(picture)


def application(files: Files, access: Access, live: Watched, read: Callable[[int], None]) -> web.Application:
    """The application with all handlers by path."""
    given: dict[str, Any] = {"access": access, "files": files, "live": live, "read": read}
    pictures = rf"/live/([0-9]{{1,10}})/({'|'.join(CAMERAS)})/(whole|spot)"
    routes: list[Any] = [(path.replace(".", r"\."), File, given) for path in files]
    routes += [("/live", Now, given), (pictures, LivePicture, given)]
    return web.Application(
        routes, default_handler_class=Unknown, default_handler_args=given, log_function=lambda handler: None
    )

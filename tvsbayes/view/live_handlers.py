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
SAFER = ("pause", "laser off")
"""Requests allowed to every browser with the link, since they only make a run safer."""


class Watched(Protocol):
    """Interface of a run for its page; called by the server's thread, so no call may wait for the run."""

    def document(self) -> dict[str, Any]:
        """The newest snapshot as a JSON document."""

    def picture(self, spot: int, camera: str, kind: str) -> bytes | None:
        """JPEG of the last look: "whole", or "spot" for the region around it; None if there is none."""

    def ask(self, what: str) -> bool:
        """Put a request in the queue; return False once the run has ended.

        Raises:
            ValueError: not an allowed request.
        """

    def control_passed(self) -> None:
        """Record that another browser controls the run from now on."""


class Guarded(web.RequestHandler):
    """Base of all answers.

    Attributes:
        access: the access control.
        files: files of the page.
        live: the run.
        read: called with the number of every snapshot that is sent.
        open_to_all: whether the page's own browser is answered without the key.
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
        """Refuse foreign requests first; pass control on where its holder is silent."""
        reason = self.access.stranger(self.request.headers)
        if reason is None and not self.open_to_all and not self.access.knows(self.request.headers):
            reason = "this browser has no key: open the link that the terminal shows"
        if reason is not None:
            raise web.HTTPError(403, reason=reason)
        if self.access.takes_over(self.request.headers):
            self.live.control_passed()

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
    """A file of the page; it contains no data of a run, and browsers cannot send the key's header for a script."""

    open_to_all = True

    def get(self) -> None:
        """Send the file of exactly this path."""
        content, kind = self.files[self.request.path]
        self.set_header("Content-Type", kind)
        self.finish(content)


class Key(Guarded):
    """Gives a key for the token of the link."""

    open_to_all = True

    def post(self) -> None:
        """Answer `{"token": ...}` with `{"key": ...}`."""
        try:
            token = json.loads(self.request.body)["token"]
        except (ValueError, KeyError, TypeError, RecursionError):
            token = None
        key = self.access.key_for(token) if isinstance(token, str) else None
        if key is None:
            raise web.HTTPError(403, reason="the link is wrong: open the one that the terminal shows")
        self.finish({"key": key})


class Now(Guarded):
    """Gives the newest snapshot."""

    def get(self) -> None:
        """Send it as JSON; `controls` states whether this browser may make all requests."""
        self.set_header("Content-Type", "application/json")
        document = {**self.live.document(), "controls": self.access.controls(self.request.headers)}
        self.finish(json.dumps(document, allow_nan=False))
        self.read(document["number"])


class Ask(Guarded):
    """Takes a request to the run."""

    def post(self) -> None:
        """Put `{"what": ...}` in the queue; the snapshots contain its outcome."""
        try:
            what = json.loads(self.request.body)["what"]
            if not self.access.controls(self.request.headers) and what not in SAFER:
                reason = f"this browser only watches: another one controls; here only {' and '.join(SAFER)}"
                raise web.HTTPError(403, reason=reason)
            taken = self.live.ask(what)
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise web.HTTPError(400, reason="not a request that a run accepts") from error
        if not taken:
            raise web.HTTPError(409, reason="the run has ended")
        self.set_status(202)
        self.finish()


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
    routes += [("/key", Key, given), ("/live", Now, given), ("/ask", Ask, given), (pictures, LivePicture, given)]
    return web.Application(
        routes, default_handler_class=Unknown, default_handler_args=given, log_function=lambda handler: None
    )

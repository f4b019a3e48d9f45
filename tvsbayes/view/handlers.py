"""Answers to a browser: every one, also to what does not exist, passes `Access`. Tornado, of the extra `view`."""

from __future__ import annotations

import json
from typing import Any

from tornado import web

from tvsbayes.instrument.campaign import CAMERAS
from tvsbayes.view.access import SECURITY_HEADERS, Access
from tvsbayes.view.contents import Contents


class Guarded(web.RequestHandler):
    """What all answers share.

    Attributes:
        access: who may ask.
        contents: what is served.
        open_to_all: whether the page's own browser is answered without the key.
    """

    open_to_all = False

    def initialize(self, access: Access, contents: Contents) -> None:
        """Called by Tornado for every request."""
        self.access, self.contents = access, contents

    def set_default_headers(self) -> None:
        """Those of `SECURITY_HEADERS`, and nothing of the server's make."""
        self.clear_header("Server")
        for name, value in SECURITY_HEADERS.items():
            self.set_header(name, value)

    def prepare(self) -> None:
        """Refuse strangers before anything else."""
        reason = self.access.stranger(self.request.headers)
        if reason is None and not self.open_to_all and not self.access.knows(self.request.headers):
            reason = "this browser has no key: open the link that the terminal shows"
        if reason is not None:
            raise web.HTTPError(403, reason=reason)

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """In words, without a traceback."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code}: {self._reason}\n")


class Unknown(Guarded):
    """Any other path."""

    def prepare(self) -> None:
        """Not found, for those who may ask."""
        super().prepare()
        raise web.HTTPError(404)


class File(Guarded):
    """A file of the page: holds nothing of a campaign, and browsers cannot send our header for a script."""

    open_to_all = True

    def get(self) -> None:
        """The file of this very path."""
        content, kind = self.contents.files[self.request.path]
        self.set_header("Content-Type", kind)
        self.finish(content)


class Key(Guarded):
    """The key for the token of the link, once."""

    open_to_all = True

    def post(self) -> None:
        """`{"token": ...}` to `{"key": ...}`."""
        try:
            token = json.loads(self.request.body)["token"]
        except (ValueError, KeyError, TypeError):
            token = None
        key = self.access.key_for(token) if isinstance(token, str) else None
        if key is None:
            raise web.HTTPError(403, reason="the link is wrong or was used already: start the command again")
        self.finish({"key": key})


class Document(Guarded):
    """The scenes."""

    def get(self) -> None:
        """As JSON."""
        self.set_header("Content-Type", "application/json")
        self.finish(self.contents.document)


class Picture(Guarded):
    """A picture of a look."""

    def get(self, campaign: str, spot: str, camera: str) -> None:
        """As it lies in `frames/`."""
        found = self.contents.picture(int(campaign), int(spot), camera)
        if found is None:
            raise web.HTTPError(404, reason="no such picture")
        self.set_header("Content-Type", "image/png")
        self.finish(found)


def application(contents: Contents, access: Access) -> web.Application:
    """All of them by path."""
    given = {"access": access, "contents": contents}
    routes: list[Any] = [(path.replace(".", r"\."), File, given) for path in contents.files]
    pictures = rf"/picture/([0-9]{{1,2}})/([0-9]{{1,10}})/({'|'.join(CAMERAS)})"
    routes += [("/key", Key, given), ("/scene", Document, given), (pictures, Picture, given)]
    return web.Application(
        routes, default_handler_class=Unknown, default_handler_args=given, log_function=lambda handler: None
    )

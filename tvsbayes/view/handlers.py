"""Answers to a browser: every one, also to what does not exist, passes `Access`. Tornado, of the extra `view`."""

from __future__ import annotations

import json
from typing import Any

from tornado import web

from tvsbayes.instrument.campaign import CAMERAS
from tvsbayes.view.access import Access
from tvsbayes.view.contents import Contents
from tvsbayes.view.guard import Guarded
from tvsbayes.view.live_handlers import live_routes
from tvsbayes.view.watched import Watched


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


def application(contents: Contents, access: Access, live: Watched | None = None) -> web.Application:
    """All of them by path; those of a run where there is one, else those of campaigns."""
    given: dict[str, Any] = {"access": access, "contents": contents}
    routes: list[Any] = [(path.replace(".", r"\."), File, given) for path in contents.files]
    routes.append(("/key", Key, given))
    if live is None:
        pictures = rf"/picture/([0-9]{{1,2}})/([0-9]{{1,10}})/({'|'.join(CAMERAS)})"
        routes += [("/scene", Document, given), (pictures, Picture, given)]
    else:
        routes += live_routes(given | {"live": live})
    return web.Application(
        routes, default_handler_class=Unknown, default_handler_args=given, log_function=lambda handler: None
    )

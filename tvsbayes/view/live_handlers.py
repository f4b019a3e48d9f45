"""Answers of a run's page: what there is to see, and requests by the one browser that controls. Tornado."""

from __future__ import annotations

import json
from typing import Any

from tornado import web

from tvsbayes.instrument.campaign import CAMERAS
from tvsbayes.view.access import Access
from tvsbayes.view.contents import Contents
from tvsbayes.view.guard import Guarded
from tvsbayes.view.watched import Watched


class OfRun(Guarded):
    """An answer about a run.

    Attributes:
        live: the run.
    """

    def initialize(self, access: Access, contents: Contents, live: Watched | None = None) -> None:
        """Called by Tornado for every request."""
        super().initialize(access, contents)
        assert live is not None
        self.live = live


class Now(OfRun):
    """The newest snapshot."""

    def get(self) -> None:
        """As JSON; `controls` says whether this browser may ask for something."""
        self.set_header("Content-Type", "application/json")
        told = {**self.live.told(), "controls": self.access.controls(self.request.headers)}
        self.finish(json.dumps(told, allow_nan=False))


class Ask(OfRun):
    """A request to the run."""

    def post(self) -> None:
        """`{"what": ...}`, put in the queue; what becomes of it stands in the snapshots."""
        if not self.access.controls(self.request.headers):
            raise web.HTTPError(403, reason="this browser only watches: the first one that opened the link controls")
        try:
            taken = self.live.ask(json.loads(self.request.body)["what"])
        except (ValueError, KeyError, TypeError) as error:
            raise web.HTTPError(400, reason="nothing that can be asked of a run") from error
        if not taken:
            raise web.HTTPError(409, reason="the run has ended")
        self.set_status(202)
        self.finish()


class LivePicture(OfRun):
    """A picture of the last look."""

    def get(self, spot: str, camera: str, kind: str) -> None:
        """As JPEG; nothing where there is none any more."""
        found = self.live.picture(int(spot), camera, kind)
        if found is None:
            # A newer look has taken its place meanwhile: no fault of anybody's.
            self.set_status(204)
            self.finish()
            return
        self.set_header("Content-Type", "image/jpeg")
        self.finish(found)


def live_routes(given: dict[str, Any]) -> list[Any]:
    """Those of a run by path."""
    pictures = rf"/live/([0-9]{{1,10}})/({'|'.join(CAMERAS)})/(whole|spot)"
    return [("/live", Now, given), ("/ask", Ask, given), (pictures, LivePicture, given)]

"""What every answer to a browser shares: it passes `Access` first, and carries the security headers. Tornado."""

from __future__ import annotations

from typing import Any

from tornado import web

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

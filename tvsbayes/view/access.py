"""Who may read the page of a run: browsers that were given its link, from the page itself, and nobody else.

The link's token stands behind the #, which browsers send to nobody; the page gives it back once and gets a key of
its own, which it sends as a header with every request. The first browser controls the run, the others watch, and may
ask for what only makes it safer. A browser that controls and has not asked for `SILENT_S` loses control to the next one
that asks. No cookie: what another page makes this browser ask for carries no key (CSRF). A name that somebody else
points at 127.0.0.1 (DNS rebinding) is refused by the Host header, another page by Origin and Sec-Fetch-Site (Fetch
Metadata, W3C).
"""

from __future__ import annotations

import hmac
import secrets
import time
from collections.abc import Callable, Mapping

HOSTS = ("127.0.0.1", "localhost")
KEY_HEADER = "X-Tvsbayes-Key"
TOKEN_BYTES = 32
SILENT_S = 10.0
"""A browser asks twice a second, in a tab that is not seen once a second."""
BROWSERS_MAX = 64
"""Whose keys are known: of more, the one that has been silent longest is forgotten."""
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
"""Of every answer. The policy lets the page load from its own server only: no request leaves the machine."""


def _same(a: str, b: str) -> bool:
    """Whether two texts are equal, in a time that does not tell where they differ.

    JSON may bring half a character, of which there is no UTF-8.
    """
    return hmac.compare_digest(a.encode(errors="replace"), b.encode(errors="replace"))


class Access:
    """Token, keys and address of one page.

    Args:
        port: that the server listens on.
        clock: a steady clock, seconds.
    """

    def __init__(self, port: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.port, self._clock = port, clock
        self._token = secrets.token_urlsafe(TOKEN_BYTES)
        self._heard_s: dict[str, float] = {}
        self._controller = ""

    @property
    def link(self) -> str:
        """What to open."""
        return f"http://{HOSTS[0]}:{self.port}/#{self._token}"

    def stranger(self, headers: Mapping[str, str]) -> str | None:
        """Why a request does not come from the page itself, None where it may.

        Args:
            headers: of the request.
        """
        hosts = [f"{host}:{self.port}" for host in HOSTS]
        if headers.get("Host", "") not in hosts:
            return "this server answers to 127.0.0.1 and localhost only"
        origin = headers.get("Origin")
        if origin is not None and origin not in [f"http://{host}" for host in hosts]:
            return "another page asked"
        if headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            return "another page asked"
        return None

    def key_for(self, token: str) -> str | None:
        """A key for a browser that brings the token, the first of which controls; None for a wrong one."""
        if not _same(token, self._token):
            return None
        key = secrets.token_urlsafe(TOKEN_BYTES)
        if len(self._heard_s) >= BROWSERS_MAX:
            watchers = [one for one in self._heard_s if one != self._controller]
            del self._heard_s[min(watchers, key=self._heard_s.__getitem__)]
        self._heard_s[key] = self._clock()
        self._controller = self._controller or key
        return key

    def _key(self, headers: Mapping[str, str]) -> str | None:
        """The known key that a request carries."""
        brought = headers.get(KEY_HEADER, "")
        return next((key for key in tuple(self._heard_s) if _same(key, brought)), None)

    def controls(self, headers: Mapping[str, str]) -> bool:
        """Whether a request comes from the browser that controls."""
        return self._key(headers) == self._controller != ""

    def knows(self, headers: Mapping[str, str]) -> bool:
        """Whether a request carries a key."""
        return self._key(headers) is not None

    def takes_over(self, headers: Mapping[str, str]) -> bool:
        """Note that a browser asks; whether control passes to it by that."""
        key, now_s = self._key(headers), self._clock()
        if key is None:
            return False
        self._heard_s[key] = now_s
        if key == self._controller or now_s - self._heard_s[self._controller] < SILENT_S:
            return False
        self._controller = key
        return True

"""Access control of a run's page: only browsers with its link may read it, and only from the page itself.

The link's token stands after the #, which browsers do not send; the page returns it once and gets its own key, which it
sends as a header with every request. The first browser controls the run; the others watch, and may make only requests
that increase safety. A controlling browser that has sent no request for `SILENT_S` loses control to the next one that
does. There is no cookie: requests that another page causes in this browser carry no key (CSRF). The Host header reveals
a foreign name that resolves to 127.0.0.1 (DNS rebinding), Origin and Sec-Fetch-Site reveal another page (Fetch
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
"""Time without requests after which control may pass on; pages send two a second, in a hidden tab one."""
BROWSERS_MAX = 64
"""Largest number of known keys; beyond it the key unused longest is dropped."""
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


def _same(a: str, b: str) -> bool:
    """Compare two texts in a time independent of the position where they differ.

    JSON may contain a lone surrogate, which UTF-8 cannot encode.
    """
    return hmac.compare_digest(a.encode(errors="replace"), b.encode(errors="replace"))


class Access:
    """Token, keys and address of one page.

    Args:
        port: port of the server.
        clock: monotonic clock, seconds.
    """

    def __init__(self, port: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.port, self._clock = port, clock
        self._token = secrets.token_urlsafe(TOKEN_BYTES)
        self._heard_s: dict[str, float] = {}
        self._controller = ""

    @property
    def link(self) -> str:
        """The address to open."""
        return f"http://{HOSTS[0]}:{self.port}/#{self._token}"

    def stranger(self, headers: Mapping[str, str]) -> str | None:
        """Why a request is not from the page itself, None where it may be.

        Args:
            headers: headers of the request.
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
        """A key for a browser with the token, the first of which controls; None for a wrong token."""
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
        """The known key in a request."""
        brought = headers.get(KEY_HEADER, "")
        return next((key for key in tuple(self._heard_s) if _same(key, brought)), None)

    def controls(self, headers: Mapping[str, str]) -> bool:
        """Whether a request comes from the browser that controls."""
        return self._key(headers) == self._controller != ""

    def knows(self, headers: Mapping[str, str]) -> bool:
        """Whether a request carries a key."""
        return self._key(headers) is not None

    def takes_over(self, headers: Mapping[str, str]) -> bool:
        """Record the request of a browser; return whether control passes to it."""
        key, now_s = self._key(headers), self._clock()
        if key is None:
            return False
        self._heard_s[key] = now_s
        if key == self._controller or now_s - self._heard_s[self._controller] < SILENT_S:
            return False
        self._controller = key
        return True

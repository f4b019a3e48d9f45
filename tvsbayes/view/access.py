"""Who may read a page on this machine: the browser that was given its link, from the page itself, and nobody else.

A link is good for one browser; that of a live page is good for more, of which the first controls and the others only
watch. Its token stands behind the #, which browsers send to nobody; the page gives it back
once and gets a key, which it sends as a header of its own with every request. No cookie: what another page makes this
browser ask for carries no key (CSRF). A name that somebody else points at 127.0.0.1 (DNS rebinding) is refused by the
Host header, another page by Origin and Sec-Fetch-Site (Fetch Metadata, W3C).
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping

HOSTS = ("127.0.0.1", "localhost")
KEY_HEADER = "X-Tvsbayes-Key"
TOKEN_BYTES = 32
SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; connect-src 'self'; "
        "img-src 'self' data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Of every answer. The policy lets the page load from its own server only: no request leaves the machine. Plotly sets
styles from its script."""


def _bytes(brought: str) -> bytes:
    """Text to be compared; JSON may bring half a character, of which there is no UTF-8."""
    return brought.encode(errors="replace")


class Access:
    """Token, keys and address of one page.

    Args:
        port: that the server listens on.
        watchers: whether further browsers may watch.
    """

    def __init__(self, port: int, *, watchers: bool = False) -> None:
        self.port = port
        self._token: str | None = secrets.token_urlsafe(TOKEN_BYTES)
        self._key = secrets.token_urlsafe(TOKEN_BYTES)
        self._watching = secrets.token_urlsafe(TOKEN_BYTES) if watchers else None
        self._given = False

    @property
    def link(self) -> str:
        """What to open; its token is void once it was used, but on a page that others may watch."""
        return f"http://{HOSTS[0]}:{self.port}/#{self._token or ''}"

    def stranger(self, headers: Mapping[str, str]) -> str | None:
        """Why a request does not come from the page itself, None where it may.

        Args:
            headers: of the request.
        """
        own = [f"{host}:{self.port}" for host in HOSTS]
        if headers.get("Host", "") not in own:
            return "this server answers to 127.0.0.1 and localhost only"
        origin = headers.get("Origin")
        if origin is not None and origin not in [f"http://{host}" for host in own]:
            return "another page asked"
        if headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            return "another page asked"
        return None

    def key_for(self, token: str) -> str | None:
        """The key for whoever brings the token first, one to watch for those after it; None for a wrong or used one."""
        if self._token is None or not hmac.compare_digest(_bytes(token), _bytes(self._token)):
            return None
        first, self._given = not self._given, True
        if self._watching is None:
            self._token = None
        return self._key if first else self._watching

    def controls(self, headers: Mapping[str, str]) -> bool:
        """Whether a request carries the key of the first browser."""
        return hmac.compare_digest(_bytes(headers.get(KEY_HEADER, "")), _bytes(self._key))

    def knows(self, headers: Mapping[str, str]) -> bool:
        """Whether a request carries a key."""
        brought = _bytes(headers.get(KEY_HEADER, ""))
        watches = self._watching is not None and hmac.compare_digest(brought, _bytes(self._watching))
        return self.controls(headers) or watches

"""Access control of a run's page: only browsers with its link may read it, and only from the page itself.

The link's token stands after the #, which browsers do not send; the page sends it as a header with every request. There
is no cookie: requests that another page causes in this browser carry no token (CSRF). The Host header reveals a foreign
name that resolves to 127.0.0.1 (DNS rebinding), Origin and Sec-Fetch-Site reveal another page (Fetch Metadata, W3C).
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping

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


class Access:
    """Token and address of one page.

    Args:
        port: port of the server.
    """

    def __init__(self, port: int) -> None:
        self.port = port
        self._token = secrets.token_urlsafe(TOKEN_BYTES)

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

    def knows(self, headers: Mapping[str, str]) -> bool:
        """Whether a request carries the token; compared in a time independent of where they differ."""
        return hmac.compare_digest(headers.get(TOKEN_HEADER, "").encode(errors="replace"), self._token.encode())

"""The server of a page: 127.0.0.1 alone, until the process is interrupted. Tornado, loaded when it starts."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable

from tvsbayes.errors import InputError
from tvsbayes.view.access import HOSTS, Access
from tvsbayes.view.contents import Contents
from tvsbayes.view.watched import Watched

REQUEST_BYTES_MAX = 4096


def serve(contents: Contents, port: int, started: Callable[[str], None]) -> None:
    """Serve a page on 127.0.0.1 until the process is interrupted.

    Args:
        contents: what is served.
        port: to listen on; 0 takes a free one.
        started: told the link once the server listens.

    Raises:
        InputError: the port is taken or forbidden.
    """
    asyncio.run(serving(contents, port, started))


async def serving(contents: Contents, port: int, started: Callable[[str], None], live: Watched | None = None) -> None:
    """The same in a loop that runs already, until the task is cancelled; with a run, its page."""
    from tornado.httpserver import HTTPServer

    from tvsbayes.view.handlers import application

    try:
        listening = socket.create_server((HOSTS[0], port))
    except OSError as error:
        allowed, remedy = "a free port", "name another, or leave --port out"
        found = f"port {port} of this machine cannot be used: {error.strerror or error}"
        raise InputError("port", found, column="--port", allowed=allowed, remedy=remedy) from error
    listening.setblocking(False)
    access = Access(listening.getsockname()[1], watchers=live is not None)
    server = HTTPServer(application(contents, access, live), max_body_size=REQUEST_BYTES_MAX)
    server.add_sockets([listening])
    try:
        started(access.link)
        await asyncio.Event().wait()
    finally:
        server.stop()
        # A browser that waits on a connection kept open would else wait for ever.
        await server.close_all_connections()

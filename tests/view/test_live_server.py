"""The page of a run over a real socket: browsers with the link read, strangers get nothing, nobody acts."""

from __future__ import annotations

import http.client
import json
import socket
import sys
import threading
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import pytest

pytest.importorskip("tornado", reason="the extra live is not installed")

from support.bench_runs import Run

from tvsbayes.acquisition.live_run import LiveRun, SeenLook
from tvsbayes.errors import InputError
from tvsbayes.files.images import png_bytes
from tvsbayes.instrument.campaign import frame_name, read_campaign
from tvsbayes.view import live_server
from tvsbayes.view.live_server import (
    PAGE_FILES,
    SECURITY_HEADERS,
    TOKEN_HEADER,
    LivePage,
    connections_max,
    page_files,
)


@dataclass(frozen=True)
class Asker:
    """A browser without a screen."""

    port: int
    token: str

    def answer(self, path: str, method: str = "GET", body: object = None, **headers: str):
        """Status and content."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        try:
            sent = None if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
            connection.request(method, path, sent, {k.replace("_", "-"): v for k, v in headers.items()})
            got = connection.getresponse()
            assert {name: got.headers[name] for name in SECURITY_HEADERS} == SECURITY_HEADERS
            assert "Server" not in got.headers and "Set-Cookie" not in got.headers
            return got.status, got.read()
        finally:
            connection.close()

    @property
    def key(self) -> dict[str, str]:
        """The header that the page sends."""
        return {TOKEN_HEADER: self.token}

    def now(self) -> dict:
        status, content = self.answer("/live", **self.key)
        assert status == 200
        return json.loads(content)


@pytest.fixture
def live():
    run = LiveRun()
    png = png_bytes(np.full((64, 64), 90, np.uint8))
    pictures = {frame_name(3, camera): png for camera in ("left", "right")}
    run.looked(SeenLook(3, "ok", "d1", (30.0, 30.0, 31.0, 31.0), (0.1,) * 4, pictures))
    return run


@pytest.fixture
def asker(live):
    with LivePage(live, 0) as page:
        address, _, token = page.link.partition("/#")
        yield Asker(int(address.rpartition(":")[2]), token)


def test_without_the_token_nothing_is_shown(asker):
    for key in ({}, {TOKEN_HEADER: "x"}, {TOKEN_HEADER: asker.token + "x"}, {TOKEN_HEADER: ""}):
        for path in ("/live", "/live/3/left/whole"):
            status, content = asker.answer(path, **key)
            assert status == 403 and b"open the link" in content


@pytest.mark.parametrize(
    "headers", [{"Host": "evil.example"}, {"Origin": "http://evil.example"}, {"Sec_Fetch_Site": "cross-site"}]
)
def test_another_page_with_the_token_gets_nothing(asker, headers):
    """DNS rebinding, another origin, a form of another site."""
    assert asker.answer("/live", **asker.key, **headers)[0] == 403


def test_no_request_acts_on_the_run(asker, live):
    before = live.latest
    for path in ("/live", "/", "/live/3/left/whole"):
        for method in ("POST", "PUT", "DELETE", "OPTIONS"):
            assert asker.answer(path, method, {} if method in ("POST", "PUT") else None, **asker.key)[0] == 405
    assert live.latest is before


@pytest.mark.parametrize(
    "path",
    [
        *("/live/3/left/../right", "/live/3/left/raw", "/live/3/middle/whole", "/live/../etc/passwd", "/scene"),
        *("/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/live/3/left/whole%00", "/live.html"),
    ],
)
def test_no_path_leads_out_of_the_list(asker, path):
    key = asker.key
    assert asker.answer(path, **key)[0] == 404
    assert asker.answer("/live/3/left/whole", **key)[1].startswith(b"\xff\xd8")
    assert asker.answer("/live/4/left/whole", **key) == (204, b"")


def test_files_of_the_page(asker):
    for path, (content, _) in page_files().items():
        assert asker.answer(path) == (200, content)
    assert set(page_files()) == set(PAGE_FILES)


def test_large_request_is_cut_off(asker):
    connection = http.client.HTTPConnection("127.0.0.1", asker.port, timeout=20)
    try:
        connection.request("POST", "/live", b"x" * 1_000_000)
        status = connection.getresponse().status
    except (ConnectionError, http.client.RemoteDisconnected):
        return
    finally:
        connection.close()
    assert status in (400, 413)


def test_it_listens_on_this_machine_alone(asker):
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.2", asker.port), timeout=5)


def test_idle_connections_neither_pile_up_nor_keep_a_browser_out(asker):
    """Each new one closes the oldest: of twice as many as allowed the first half is closed, and the page answers."""
    most = connections_max()
    with ExitStack() as stack:
        idle = []
        for _ in range(2 * most):
            idle.append(stack.enter_context(socket.create_connection(("127.0.0.1", asker.port), timeout=20)))
        assert asker.now()["state"] == "running"
        assert [one.recv(1) for one in idle[:most]] == [b""] * most


def test_connection_without_a_request_is_closed(live, monkeypatch):
    monkeypatch.setattr(live_server, "IDLE_S", 0.05)
    with LivePage(live, 0) as page:
        port = int(page.link.partition("/#")[0].rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), timeout=20) as idle:
            assert idle.recv(1) == b""
        with socket.create_connection(("127.0.0.1", port), timeout=20) as slow:
            slow.sendall(b"GET / HTTP/1.1\r\nHost: ")
            assert slow.recv(1) == b""


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "tornado", None)
    with pytest.raises(InputError) as refused:
        page_files()
    assert refused.value.code == "no-live" and refused.value.remedy == "pip install 'tvsbayes[live]'"


def test_taken_port_is_called_so(asker, live):
    with pytest.raises(InputError, match="cannot be used"):
        with LivePage(live, asker.port):
            pass


@pytest.mark.usefixtures("ctrl_c_works")
def test_a_server_that_dies_does_not_disturb_the_run(mounted_rig, tmp_path):
    live = LiveRun()
    with LivePage(live, 0) as page:

        def dies(instrument):
            page.end()
            page._thread.join()

        outcome = Run(mounted_rig, tmp_path / "c", at=3, then=dies, live=live).engine.run()
    assert (outcome.reason, outcome.ok) == ("done", 8) and len(read_campaign(tmp_path / "c").spots) == 8


@pytest.mark.usefixtures("ctrl_c_works")
def test_a_reader_that_never_reads_and_one_that_hangs_delay_nothing(mounted_rig, tmp_path):
    """The server's thread stands still in the middle of an answer as long as the run goes."""
    live, ended, hanging = LiveRun(), threading.Event(), threading.Event()
    document = live.document

    def hangs():
        if threading.current_thread() is not threading.main_thread():
            hanging.set()
            ended.wait(60)
        return document()

    live.document = hangs
    with LivePage(live, 0) as page:
        address, _, token = page.link.partition("/#")
        asker = Asker(int(address.rpartition(":")[2]), token)
        reader = threading.Thread(target=asker.now)
        reader.start()
        assert hanging.wait(60)
        outcome = Run(mounted_rig, tmp_path / "c", live=live).engine.run()
        assert not ended.is_set()
        ended.set()
        reader.join()
    assert (outcome.reason, outcome.ok) == ("done", 8)

"""The server over a real socket: what it gives to its own page, and what it refuses everybody else."""

from __future__ import annotations

import asyncio
import http.client
import json
import socket
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("tornado", reason="the extra view is not installed")
pytest.importorskip("plotly", reason="the extra view is not installed")

from support.served_pages import page_served

from tvsbayes.errors import InputError
from tvsbayes.files.images import png_bytes
from tvsbayes.instrument.campaign import frame_name
from tvsbayes.view.access import KEY_HEADER, SECURITY_HEADERS
from tvsbayes.view.contents import PAGE_FILES, Contents, page_files
from tvsbayes.view.server import serving

DOCUMENT = b'{"scenes": []}'
PICTURE = png_bytes(np.zeros((4, 6), dtype=np.uint8))
SECRET = b"\x89PNG\r\n\x1a\n of another folder"


@dataclass(frozen=True)
class Served:
    """A server that runs: its port and token, and what it answers."""

    port: int
    token: str

    def answer(self, path: str, method: str = "GET", body: bytes | None = None, **headers: str):
        """Status, headers and content; `headers` with underscores for hyphens."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        try:
            connection.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
            got = connection.getresponse()
            return got.status, dict(got.getheaders()), got.read()
        finally:
            connection.close()

    def key(self) -> str:
        status, _, content = self.answer("/key", "POST", json.dumps({"token": self.token}).encode())
        assert status == 200
        return json.loads(content)["key"]


def contents_of(folder: Path) -> Contents:
    frames = folder / "frames"
    frames.mkdir(parents=True)
    (folder / frame_name(3, "left")).write_bytes(PICTURE)
    (folder / frame_name(3, "right")).write_bytes(b"no picture")
    (folder.parent / "secret.png").write_bytes(SECRET)
    (folder / frame_name(4, "left")).symlink_to(folder.parent / "secret.png")
    (folder / frame_name(5, "left")).write_bytes(PICTURE)
    return Contents(DOCUMENT, (folder,), (frozenset({3, 4}),), page_files())


@pytest.fixture
def served(tmp_path):
    with page_served(contents_of(tmp_path / "campaign")) as link:
        address, _, token = link.partition("/#")
        yield Served(int(address.rpartition(":")[2]), token)


def test_page_and_its_files_are_served(served):
    for path, (_, kind) in PAGE_FILES.items():
        status, headers, content = served.answer(path)
        assert status == 200 and headers["Content-Type"] == kind and content
    assert b"Plotly" in served.answer("/plotly.js")[2]


def test_document_and_pictures_need_the_key(served):
    for path in ("/scene", "/picture/0/3/left", "/no/such/path"):
        assert served.answer(path)[0] == 403
        assert served.answer(path, **{KEY_HEADER: served.token})[0] == 403
    key = served.key()
    assert served.answer("/scene", **{KEY_HEADER: key})[2] == DOCUMENT
    status, headers, content = served.answer("/picture/0/3/left", **{KEY_HEADER: key})
    assert (status, headers["Content-Type"], content) == (200, "image/png", PICTURE)
    assert served.answer("/no/such/path", **{KEY_HEADER: key})[0] == 404


@pytest.mark.parametrize("body", [b'{"token": "wrong"}', b'{"token": 1}', b"{}", b"[]", b"\xff", b"", b'"x"'])
def test_wrong_token_gets_no_key(served, body):
    status, _, content = served.answer("/key", "POST", body)
    assert status == 403 and b"the link is wrong or was used already" in content


def test_used_token_gets_no_second_key(served):
    served.key()
    assert served.answer("/key", "POST", json.dumps({"token": served.token}).encode())[0] == 403


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Sec_Fetch_Site": "cross-site"},
    ],
)
def test_other_pages_get_nothing(served, headers):
    key = served.key()
    for path in ("/", "/scene", "/plotly.js", "/picture/0/3/left", "/nothing"):
        status, _, content = served.answer(path, **headers, **{KEY_HEADER: key})
        assert status == 403 and DOCUMENT not in content
    assert served.answer("/key", "POST", b"{}", **headers)[0] == 403


def test_preflight_of_another_origin_is_refused(served):
    asked = {"Origin": "http://evil.example", "Access_Control_Request_Headers": KEY_HEADER}
    status, headers, _ = served.answer("/scene", "OPTIONS", **asked)
    assert status == 403 and not [name for name in headers if name.lower().startswith("access-control")]


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS"])
def test_nothing_can_be_written(served, method):
    key = served.key()
    for path in ("/scene", "/picture/0/3/left", "/", "/page.js"):
        assert served.answer(path, method, b"{}", **{KEY_HEADER: key})[0] == 405


@pytest.mark.parametrize(
    "path",
    [
        "/../../etc/passwd",
        "/picture/0/../../secret.png/left",
        "/picture/0/3/..%2f..%2fsecret",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/picture/0/3/left/../right",
        "/picture/0/3/left%00",
        "//etc/passwd",
        "/frames/000003_left.png",
        "/page.html",
        "/picture/0/3/middle",
        "/picture/0/-3/left",
        "/picture/0/99999999999/left",
        # Of another campaign, of no look, no PNG, a link that leads out of the folder.
        "/picture/1/3/left",
        "/picture/0/5/left",
        "/picture/0/3/right",
        "/picture/0/4/left",
    ],
)
def test_no_path_leads_out_of_the_list(served, path):
    status, _, content = served.answer(path, **{KEY_HEADER: served.key()})
    assert status == 404 and content.startswith(b"404: ")


def test_every_answer_has_the_security_headers(served):
    key = served.key()
    for path, keyed in (("/", ""), ("/scene", key), ("/scene", ""), ("/nothing", key)):
        headers = served.answer(path, **{KEY_HEADER: keyed})[1]
        assert {name: headers[name] for name in SECURITY_HEADERS} == SECURITY_HEADERS
        assert "Server" not in headers and "Set-Cookie" not in headers


def test_large_request_is_cut_off(served):
    try:
        status = served.answer("/key", "POST", b"x" * 1_000_000)[0]
    except (ConnectionError, http.client.RemoteDisconnected):
        return
    assert status in (400, 413)


def test_it_listens_on_this_machine_alone(served):
    own = socket.gethostbyname(socket.gethostname())
    others = {own, "127.0.0.2"} - {"127.0.0.1"}
    for address in others:
        with pytest.raises(OSError):
            socket.create_connection((address, served.port), timeout=5)


def test_taken_port_is_called_so(served, tmp_path):
    contents = Contents(DOCUMENT, (), (), {})
    with pytest.raises(InputError, match="cannot be used"):
        asyncio.run(serving(contents, served.port, lambda link: None))


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "tornado", None)
    with pytest.raises(InputError) as refused:
        page_files()
    assert refused.value.code == "no-view" and refused.value.remedy == "pip install 'tvsbayes[view]'"

"""view: what it prints, what it hands to the server, what it refuses."""

from __future__ import annotations

import json

import pytest

from tvsbayes.cli.main import run

LINK = "http://127.0.0.1:4711/#token"


@pytest.fixture
def handed(monkeypatch):
    """What would have been served, and which links a browser would have been given; the extra need not be there."""
    served, opened = [], []

    def serve(contents, port, started):
        served.append((contents, port))
        started(LINK)

    monkeypatch.setattr("tvsbayes.view.server.serve", serve)
    monkeypatch.setattr("tvsbayes.view.contents.page_files", lambda: {"/": (b"", "text/html")})
    monkeypatch.setattr("webbrowser.open", opened.append)
    return served, opened


def test_view_serves_what_it_shows_and_prints_the_link(viewed, handed, capsys):
    served, opened = handed
    assert run(["view", str(viewed.bare), "--port", "4711", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {"link": LINK, "looks": [384], "fitted": [False]} and opened == []
    ((contents, port),) = served
    assert port == 4711 and contents.folders == (viewed.bare,)
    assert contents.picture(0, 3, "left").startswith(b"\x89PNG")
    assert [contents.picture(*asked) for asked in ((0, 3, "right"), (0, 9999, "left"), (1, 3, "left"))] == [None] * 3
    assert len(json.loads(contents.document)["scenes"]) == 1


def test_ctrl_c_ends_the_page_and_the_one_document_stays_the_only_one(viewed, handed, monkeypatch, capsys):
    def served_until_ctrl_c(contents, port, started):
        started(LINK)
        raise KeyboardInterrupt

    monkeypatch.setattr("tvsbayes.view.server.serve", served_until_ctrl_c)
    assert run(["view", str(viewed.bare), "--json"]) == 130
    assert json.loads(capsys.readouterr().out)["link"] == LINK


def test_view_opens_a_browser_unless_told_not_to(viewed, handed, capsys):
    _, opened = handed
    assert run(["view", str(viewed.bare)]) == 0
    printed = capsys.readouterr().out
    assert opened == [LINK] and LINK in printed and "note: no results" in printed
    assert run(["view", str(viewed.bare), "--no-browser"]) == 0
    assert opened == [LINK]


def test_view_refuses_an_axis_and_what_is_no_campaign(tmp_path, handed, capsys):
    assert run(["new", str(tmp_path / "stage"), "--axis"]) == 0
    assert run(["view", str(tmp_path / "stage")]) == 2
    assert "not an axis" in capsys.readouterr().err
    assert run(["view", str(tmp_path / "nothing")]) == 2
    assert handed[0] == []

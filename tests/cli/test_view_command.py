"""view: one complete file or none, never in place of data."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil

import pytest

from tvsbayes.instrument.campaign import frame_name


@pytest.fixture
def folder(unfitted_twin, tmp_path):
    return shutil.copytree(unfitted_twin, tmp_path / "campaign")


def document_of(html: str) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="document">(.*?)</script>', html, re.DOTALL)[1])


def test_view_writes_one_file_that_holds_all_it_needs(ask, folder):
    code, result = ask("view", folder)
    page = folder / "results" / "view.html"
    html = page.read_text(encoding="utf-8")
    contents = {"looks": [384], "pictures": [1], "fitted": [False]}
    assert (code, result) == (0, {"view": str(page), "bytes": page.stat().st_size, **contents})
    (scene,) = document_of(html)["scenes"]
    assert scene["pictures"]["3"]["left"]["whole"].startswith("data:image/jpeg;base64,")
    assert not re.search(r'(?:src|href)="(?!data:)|url\((?!#)|@import|https?://(?!www\.w3\.org/2000/svg")', html)


def test_page_runs_its_own_script_alone(say, folder):
    """The policy names the hash of the one script that there is, and lets nothing be loaded."""
    assert say("view", folder)[0] == 0
    html = (folder / "results" / "view.html").read_text(encoding="utf-8")
    (script,) = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', html)[1].replace("&#39;", "'")
    assert f"script-src 'sha256-{digest}'" in policy and "default-src 'none'" in policy and "http" not in policy


def test_view_states_the_path_of_the_page_and_what_it_lacks(say, folder, tmp_path):
    out = tmp_path / "page.html"
    code, printed, _ = say("view", folder, "--beside", folder, "-o", out)
    assert code == 0 and str(out) in printed and "note: no results" in printed and out.stat().st_size > 100_000
    assert len(document_of(out.read_text(encoding="utf-8"))["scenes"]) == 2
    assert not (folder / "results").exists()


def test_view_replaces_no_data_and_leaves_no_partial_file(say, folder, tmp_path, monkeypatch):
    for name in ("spots.csv", "campaign.toml", frame_name(3, "left")):
        before = (folder / name).read_bytes()
        code, _, log = say("view", folder, "-o", folder / name)
        assert code == 2 and "would replace data" in log and (folder / name).read_bytes() == before
    out = tmp_path / "page.html"
    out.write_text("my page")
    code, _, log = say("view", folder, "-o", out)
    assert code == 2 and "--force" in log and out.read_text() == "my page"
    out.write_text(older := "<title>tvsbayes view</title>")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    code, _, log = say("view", folder, "-o", out)
    assert code == 2 and "No space left" in log
    assert out.read_text() == older
    assert sorted(place.name for place in tmp_path.iterdir()) == ["campaign", "page.html"]
    (folder / "results").symlink_to(tmp_path)
    assert say("view", folder)[0] == 2

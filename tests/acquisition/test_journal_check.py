"""A journal and its frames checked; what is whole of a damaged one copied."""

from __future__ import annotations

import pytest
from support.hostile_folders import sealed

from tvsbayes.acquisition.journal import (
    LOG,
    LOG_ENTRIES_MAX,
    LOG_EVENTS_MAX,
    read_journal,
)
from tvsbayes.acquisition.journal_check import repair, verify
from tvsbayes.errors import InputError


def test_frames_swapped_stale_missing_or_grown_are_found(folder):
    left, right, later = (folder / "frames" / f"{name}.png" for name in ("000000_left", "000000_right", "000001_left"))
    one, two = left.read_bytes(), right.read_bytes()
    damages = {
        "swapped": lambda: (left.write_bytes(two), right.write_bytes(one)),
        "stale": lambda: left.write_bytes(later.read_bytes()),
        "one byte": lambda: left.write_bytes(one[:50] + b"?" + one[51:]),
        "grown": lambda: left.write_bytes(one + b"x"),
        "missing": left.unlink,
    }
    for what, damage in damages.items():
        damage()
        with pytest.raises(InputError) as caught:
            verify(folder)
        assert (caught.value.line, caught.value.column) == (3, "frames/000000_left.png"), what
        left.write_bytes(one)
        right.write_bytes(two)
    assert verify(folder).frames == 6


def test_frames_of_an_interrupted_look_are_listed_and_kept(folder):
    (folder / "frames" / "000003_left.png").write_bytes(b"taken, not logged")
    check = verify(folder)
    assert check.orphans == ("frames/000003_left.png",)
    assert "interrupted" in check.warnings[0]


def test_repair_keeps_what_is_whole_and_marks_the_gap(folder, tmp_path):
    lines = (folder / LOG).read_bytes().splitlines(keepends=True)
    lines[3] = lines[3].replace(b"step", b"stop")
    (folder / LOG).write_bytes(b"".join(lines)[:-4])
    (folder / "frames" / "000002_right.png").write_bytes(b"damaged")
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    done = repair(folder, tmp_path / "new")
    assert done.lost_lines == [4] and done.lost_frames == ["frames/000002_right.png"] and done.kept == 6
    events = [(r.event, r.data) for r in read_journal(tmp_path / "new").records]
    assert [event for event, _ in events] == [
        *("created", "intent", "looked", "gap"),
        *("looked", "intent", "looked", "gap"),
    ]
    assert (
        events[0][1]["repaired"] is True
        and events[0][1]["id"] == "0123"
        and events[3][1] == {"before_line": 5, "motion_lost": False}
    )
    assert verify(tmp_path / "new").frames == 5
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before, "the old one is untouched"
    with pytest.raises(InputError):
        repair(folder, tmp_path / "new")


def test_a_log_is_capped_in_events_and_entries(folder, tmp_path):
    for data, what in ((b"\n" * (LOG_EVENTS_MAX + 1), "events"), (b"[" * (LOG_ENTRIES_MAX + 1), "entries")):
        (folder / LOG).write_bytes(data)
        for read in (read_journal, lambda place: repair(place, tmp_path / "repaired")):
            with pytest.raises(InputError, match=what) as caught:
                read(folder)
            assert caught.value.code == "size"
    assert not (tmp_path / "repaired").exists()


def test_a_frame_named_twice_is_read_once(folder, tmp_path):
    data = (folder / LOG).read_bytes()
    (folder / LOG).write_bytes(sealed(data.replace(b"000001_left", b"000000_left")))
    with pytest.raises(InputError, match="a frame that an event before it names"):
        verify(folder)
    assert repair(folder, tmp_path / "repaired").lost_frames == ["frames/000000_left.png"]

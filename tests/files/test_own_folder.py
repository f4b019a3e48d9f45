"""Sealed files: only unchanged files of this user are read."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from tvsbayes.files.own_folder import MAGIC, OwnFolder

posix = pytest.mark.skipif(os.name != "posix", reason="Windows keeps the folders of its users apart by itself")


@pytest.fixture
def folder(tmp_path) -> OwnFolder:
    return OwnFolder(tmp_path / "own")


def test_a_sealed_file_round_trips(folder):
    assert folder.read("a") is None and folder.fault() == "it does not exist"
    assert folder.write("a", b"content") and folder.write("empty", b"")
    assert folder.read("a") == b"content" and folder.read("empty") == b"" and folder.read("b") is None
    assert folder.write("a", b"other") and folder.read("a") == b"other"
    assert sorted(p.name for p in folder.path.iterdir()) == ["a", "empty"], "nothing temporary stays"


def test_a_file_under_anothers_name_is_none(folder):
    folder.write("a", b"content")
    folder.write("b", b"other")
    (folder.path / "a").rename(folder.path / "b")
    assert folder.read("b") is None


@pytest.mark.parametrize("place", [0, len(MAGIC) - 1, len(MAGIC), len(MAGIC) + 31, len(MAGIC) + 32, -1])
def test_one_wrong_byte_is_detected(folder, place):
    folder.write("a", b"content")
    data = bytearray((folder.path / "a").read_bytes())
    data[place] ^= 1
    (folder.path / "a").write_bytes(data)
    assert folder.read("a") is None


@pytest.mark.parametrize("length", [0, 5, len(MAGIC) + 10, len(MAGIC) + 32, -1])
def test_a_truncated_file_is_detected(folder, length):
    folder.write("a", b"content")
    whole = (folder.path / "a").read_bytes()
    (folder.path / "a").write_bytes(whole[:length])
    assert folder.read("a") is None
    (folder.path / "a").write_bytes(whole + b"x")
    assert folder.read("a") is None


@posix
def test_only_the_user_may_write(folder):
    folder.write("a", b"content")
    assert stat.S_IMODE((folder.path / "a").stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.path.stat().st_mode) == 0o700


@posix
@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777])
def test_a_folder_writable_by_others_is_not_trusted(folder, mode):
    folder.write("a", b"content")
    folder.path.chmod(mode)
    assert folder.read("a") is None and not folder.write("b", b"more")
    assert folder.fault() == "others may write into it"
    folder.path.chmod(0o755)
    assert folder.read("a") == b"content", "others may read"


@posix
@pytest.mark.parametrize("mode", [0o620, 0o602])
def test_a_file_writable_by_others_is_not_trusted(folder, mode):
    folder.write("a", b"content")
    (folder.path / "a").chmod(mode)
    assert folder.read("a") is None


@posix
@pytest.mark.parametrize("which", ["folder", "file"])
def test_files_of_another_user_are_not_trusted(folder, which, monkeypatch):
    """Only root can change the owner of a file: the system's answer is replaced instead."""
    folder.write("a", b"content")
    real = {"folder": os.lstat, "file": os.fstat}[which]

    def another(path):
        fields = list(real(path))
        fields[4] = os.geteuid() + 1
        return os.stat_result(fields)

    monkeypatch.setattr(os, "lstat" if which == "folder" else "fstat", another)
    assert folder.read("a") is None
    assert (folder.fault() == "it belongs to another user") is (which == "folder")


@posix
def test_links_pipes_and_folders_are_no_sealed_files(folder, tmp_path):
    folder.write("a", b"content")
    (folder.path / "link").symlink_to(folder.path / "a")
    os.mkfifo(folder.path / "pipe")
    (folder.path / "inner").mkdir()
    assert [folder.read(name) for name in ("link", "pipe", "inner")] == [None] * 3
    (tmp_path / "linked").symlink_to(folder.path)
    assert OwnFolder(tmp_path / "linked").read("a") is None
    assert OwnFolder(folder.path / "a").fault() == "it is no folder"


def test_sizes_are_capped(tmp_path):
    small = OwnFolder(tmp_path / "own", file_bytes_max=100)
    assert not small.write("a", b"x" * 100) and small.write("b", b"x" * 10)
    assert OwnFolder(small.path).write("a", b"x" * 100)
    assert small.read("a") is None and OwnFolder(small.path).read("a") == b"x" * 100


def test_the_least_recently_used_file_is_removed_first(tmp_path):
    size = 1000
    # Three of them with their seals; a fourth is too many.
    folder = OwnFolder(tmp_path / "own", bytes_max=3 * (size + 100))
    for age, name in ((300, "a"), (200, "b"), (100, "c")):
        folder.write(name, b"x" * size)
        os.utime(folder.path / name, (1e9 - age, 1e9 - age))
    assert folder.read("a") is not None, "the oldest, but now used again"
    folder.write("d", b"x" * size)
    assert sorted(p.name for p in folder.path.iterdir()) == ["a", "c", "d"]


def test_a_place_that_cannot_be_written_is_no_error(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    folder = OwnFolder(tmp_path / "file" / "own")
    assert not folder.write("a", b"content") and folder.read("a") is None
    assert folder.fault()


def test_a_full_disk_leaves_no_file(folder, monkeypatch):
    folder.write("a", b"content")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    assert not folder.write("b", b"more")
    assert [p.name for p in Path(folder.path).iterdir()] == ["a"]

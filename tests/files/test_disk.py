"""Reading with a size limit, writing of complete files or none."""

from __future__ import annotations

import errno
import os
import stat
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.disk import (
    decode,
    new_folder,
    read_arrays,
    read_bytes,
    require_writable,
    shipped_data,
    write_atomically,
    write_folder,
)


def test_only_regular_files_inside_the_folder(tmp_path):
    folder = tmp_path / "campaign"
    folder.mkdir()
    (tmp_path / "outside.csv").write_text("x")
    (folder / "inside.csv").write_text("x")
    (folder / "good.csv").symlink_to(folder / "inside.csv")
    (folder / "bad.csv").symlink_to(tmp_path / "outside.csv")
    (folder / "loop.csv").symlink_to(folder / "loop.csv")
    (folder / "gone.csv").symlink_to(folder / "nothing.csv")
    (folder / "device.csv").symlink_to("/dev/zero")
    os.mkfifo(folder / "pipe.csv")
    assert read_bytes(folder / "good.csv", 10, folder) == b"x"
    codes = {}
    for name in ("bad", "loop", "gone", "device", "pipe", "missing", "nul\0"):
        with pytest.raises(InputError) as caught:
            read_bytes(folder / f"{name}.csv", 10, folder)
        codes[name] = caught.value.code
    with pytest.raises(InputError, match="regular file"):
        read_bytes(folder, 10)
    assert codes == {
        "bad": "path",
        "loop": "unreadable",
        "gone": "missing-file",
        "device": "path",
        "pipe": "not-a-file",
        "missing": "missing-file",
        "nul\0": "unreadable",
    }


def test_size_is_capped_before_reading(tmp_path):
    path = tmp_path / "sparse.csv"
    with open(path, "wb") as stream:
        stream.truncate(10**12)  # a terabyte of holes: reading it would not end
    with pytest.raises(InputError, match="1000000000000 bytes"):
        read_bytes(path, 1000)


def test_control_characters_never_reach_the_message(tmp_path):
    with pytest.raises(InputError) as caught:
        read_bytes(tmp_path / "a\x1b[31m\u202e.csv", 10)
    assert caught.value.message.isprintable()
    with pytest.raises(InputError) as caught:
        decode(b"a\n\x07", "t.csv")
    assert caught.value.message.isprintable() and caught.value.line == 2


@pytest.mark.parametrize("broken", ["fsync", "replace"])
@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_interrupted_write_leaves_the_old_file_whole(tmp_path, monkeypatch, broken, failure):
    path = tmp_path / "spots.csv"
    path.write_bytes(b"old")

    def fail(*_args):
        raise failure

    monkeypatch.setattr(os, broken, fail)
    with pytest.raises(InputError if isinstance(failure, OSError) else KeyboardInterrupt):
        write_atomically(path, b"new content")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["spots.csv"]


@pytest.mark.skipif(os.name != "posix", reason="only POSIX flushes folders")
@pytest.mark.parametrize(("number", "fails"), [(errno.EINVAL, False), (errno.ENOTSUP, False), (errno.EIO, True)])
def test_a_folder_that_cannot_be_flushed(tmp_path, monkeypatch, number, fails):
    """Some network shares flush files only; a failing disk is an error."""
    flush = os.fsync

    def files_only(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", files_only)
    with pytest.raises(InputError) if fails else nullcontext():
        write_atomically(tmp_path / "a.json", b"1")
    assert (tmp_path / "a.json").read_bytes() == b"1"


def test_atomic_write_replaces_and_obeys_the_umask(tmp_path):
    path = tmp_path / "a.json"
    write_atomically(path, b"1")
    write_atomically(path, b"2")
    (tmp_path / "plain").write_bytes(b"")
    assert path.read_bytes() == b"2"
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)
    with pytest.raises(InputError, match="writable folder"):
        write_atomically(tmp_path / "no such folder" / "a.json", b"1")


def test_shipped_data_lies_beside_a_checkout_or_inside_a_wheel():
    data = shipped_data()
    package = Path(__file__).resolve().parents[2] / "tvsbayes"
    assert data.name == "data" and data.parent.name in ("tvsbayes", package.parent.name)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


BEGUN = {"missing": None, "empty": {}, "with its cameras": {"stereo.json": b"{}"}}
MINE, OTHER = ({"campaign.toml": who, "moves.csv": who, "frames.csv": who} for who in (b"mine", b"other"))


@pytest.mark.parametrize("begun", BEGUN.values(), ids=BEGUN)
def test_a_new_folder_is_there_whole_or_not_at_all(tmp_path, begun):
    """Also below folders that are missing; what cannot be prepared leaves the place as it was."""
    to = tmp_path / "deep" / "new"
    if begun is not None:
        write_folder(to, begun)
    with pytest.raises(InputError, match="no space") as caught, new_folder(to, but=("stereo.json",)) as prepared:
        (prepared / "moves.csv").write_bytes(b"half")
        raise OSError(errno.ENOSPC, "no space")
    assert caught.value.code == "write"
    assert to.exists() == (begun is not None)
    assert contents(tmp_path / "deep") == {f"new/{name}": data for name, data in (begun or {}).items()}
    assert write_folder(to, MINE, but=("stereo.json",)) == [str(to / name) for name in MINE]
    assert contents(to) == (begun or {}) | MINE
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["new"], "nothing stays beside"


@pytest.mark.parametrize("begun", BEGUN.values(), ids=BEGUN)
def test_of_two_writers_of_a_new_folder_one_wins_whole(tmp_path, begun):
    """The other is refused, although the folder was free when it began."""
    to = tmp_path / "new"
    if begun is not None:
        write_folder(to, begun)
    with pytest.raises(InputError) as caught, new_folder(to, but=("stereo.json",)) as prepared:
        for name, data in OTHER.items():
            (prepared / name).write_bytes(data)
        write_folder(to, MINE, but=("stereo.json",))
    assert caught.value.code == "occupied" and "name another folder" in caught.value.remedy
    assert contents(tmp_path) == {f"new/{name}": data for name, data in ((begun or {}) | MINE).items()}


@pytest.mark.parametrize("leftover", [".new.0123456789ab.tmp", "notes.txt"])
def test_what_a_killed_process_left_does_not_occupy_a_folder(tmp_path, leftover):
    (tmp_path / leftover).mkdir()
    with nullcontext() if leftover.startswith(".") else pytest.raises(InputError, match="a folder with files"):
        write_folder(tmp_path, MINE)


def test_a_place_for_results_is_checked_before_the_work(tmp_path):
    """Nothing is created; a file in place of the folder is named."""
    require_writable(tmp_path / "a" / "results")
    require_writable(tmp_path)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="Not a directory") as refused:
        require_writable(tmp_path / "file")
    assert refused.value.code == "write" and "--out" in refused.value.remedy


def test_arrays_come_back_as_they_were_written(tmp_path):
    arrays = {
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "text": np.array(["a", "bcd"]),
        "flag": np.array(True),
        "none": np.zeros((0, 4, 4)),
        "counts": np.arange(5, dtype=np.uint32),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        again = read_arrays(tmp_path / "a.npz", 1_000_000)
        assert set(again) == set(arrays)
        for name, array in arrays.items():
            assert again[name].dtype == array.dtype
            np.testing.assert_array_equal(again[name], array)
    np.savez_compressed(tmp_path / "b.npz", zeros=np.zeros(1_000_000))
    assert (tmp_path / "b.npz").stat().st_size < 1_000_000
    with pytest.raises(ValueError, match="unpacked"):
        read_arrays(tmp_path / "b.npz", 1_000_000)

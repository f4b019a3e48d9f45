"""The journal: damage found, torn ends recovered, power loss enumerated, full disks, killed writers."""

from __future__ import annotations

import errno
import itertools
import os
import random
import stat
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from support.journals import continue_looks, write_looks

from tvsbayes.acquisition.journal import LOG, Disk, Journal, encode, read_journal
from tvsbayes.acquisition.journal_check import verify
from tvsbayes.errors import DeviceFault, InputError


def test_line_format_is_the_documented_one():
    # CRC-32 as gzip's trailer states it: printf '3 0000002a {"event":"x","a":1}' | gzip -c | tail -c8.
    assert encode(3, 42, "x", {"a": 1}) == b'0f407520 3 0000002a {"event":"x","a":1}\n'
    with pytest.raises(ValueError, match="not JSON compliant"):
        encode(0, 0, "x", {"a": float("nan")})
    with pytest.raises(ValueError, match="bytes"):
        encode(0, 0, "x", {"a": "y" * 20_000})


def flips_found(folder: Path, values_of) -> tuple[int, list[str]]:
    """Number of single-byte changes tried, and those that the reader did not refuse with a line number."""
    whole = (folder / LOG).read_bytes()
    missed, tried = [], 0
    for place, byte in enumerate(whole):
        for value in values_of(place, byte):
            (folder / LOG).write_bytes(whole[:place] + bytes([value]) + whole[place + 1 :])
            tried += 1
            try:
                read_journal(folder)
            except InputError as error:
                if error.line not in (line := whole.count(b"\n", 0, place) + 1, line + 1):
                    missed.append(f"byte {place} -> {value}: line {error.line} blamed instead of {line}")
            else:
                missed.append(f"byte {place} -> {value}: not found")
    (folder / LOG).write_bytes(whole)
    return tried, missed


def test_every_byte_flipped_is_found(folder):
    """A single-bit flip of every byte; all 255 other values of the last two bytes, where a torn end might be read."""
    size = (folder / LOG).stat().st_size
    rng = random.Random(1)

    def values(place, byte):
        if place >= size - 2:
            return [value for value in range(256) if value != byte]
        return [byte ^ (1 << rng.randrange(8))]

    tried, missed = flips_found(folder, values)
    assert tried == size - 2 + 2 * 255 and missed == []


def test_lost_doubled_swapped_and_foreign_lines_are_found(folder, tmp_path):
    write_looks(tmp_path / "other", 3)
    (tmp_path / "third").mkdir()
    other = (tmp_path / "other" / LOG).read_bytes().splitlines(keepends=True)
    lines = (folder / LOG).read_bytes().splitlines(keepends=True)
    other[3] = encode(3, int(lines[2][:8], 16) ^ 1, "intent", {"step": 1})
    changes = {
        "lost": (3, lines[:2] + lines[3:]),
        "doubled": (4, lines[:3] + lines[2:]),
        "swapped": (3, [*lines[:2], lines[3], lines[2], *lines[4:]]),
        "misnumbered": (4, [*lines[:3], encode(4, int(lines[2][:8], 16), "intent", {"step": 1}), *lines[4:]]),
        "foreign": (4, lines[:3] + other[3:4] + lines[4:]),
        "without its beginning": (1, lines[1:]),
    }
    for what, (line, content) in changes.items():
        (folder / LOG).write_bytes(b"".join(content))
        with pytest.raises(InputError) as caught:
            read_journal(folder)
        assert caught.value.line == line, what
        assert "--repair-to" in caught.value.message


def test_end_torn_at_every_byte_loses_nothing_else(folder):
    """Truncation at every byte of the last two lines, alone, with zero bytes behind it, and recovered by opening."""
    whole = (folder / LOG).read_bytes()
    starts = [0, *(k + 1 for k, byte in enumerate(whole) if byte == 10)]
    for cut in range(starts[-3], len(whole)):
        complete = whole.count(b"\n", 0, cut)
        for filling in (b"", b"\x00" * 16):
            (folder / LOG).write_bytes(whole[:cut] + filling)
            reading = read_journal(folder)
            assert len(reading.records) == complete
            assert whole[:cut] + filling == whole[: reading.size] + reading.torn
    (folder / LOG).write_bytes(whole[:-5])
    journal = Journal.open(folder)
    assert journal.torn == whole[starts[-2] : -5]
    assert (folder / f"log.torn-{starts[-2]}").read_bytes() == journal.torn, "what is cut off is kept aside"
    journal.append("stop", reason="done", exit_code=0)
    journal.close()
    assert (folder / LOG).read_bytes() == whole


def test_frame_names_cannot_leave_the_folder(folder):
    journal = Journal.open(folder)
    for name in ("../000000_left.png", "/tmp/000000_left.png", "frames/0_left.png", "frames/000000_up.png"):
        with pytest.raises(ValueError, match=r"\.png"):
            journal.store(name, b"")
    journal.append("looked", frames=[{"name": "../../etc/passwd", "sha256": "", "bytes": 0}])
    journal.close()
    with pytest.raises(InputError) as caught:
        verify(folder)
    assert caught.value.line == 9


@pytest.mark.skipif(os.name != "posix", reason="flock")
def test_a_disk_without_locks_is_not_called_another_writer(folder, monkeypatch):
    import fcntl

    def none_left(*_arguments):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", none_left)
    for begin, place in ((Journal.open, folder), (Journal.create, folder.with_name("new"))):
        handles = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else 0
        with pytest.raises(InputError, match="No locks available") as caught:
            begin(place)
        assert caught.value.code == "lock"
        assert not handles or len(os.listdir("/proc/self/fd")) == handles
    monkeypatch.undo()
    # Nothing stays that would call the folder occupied once it is on a disk with locks.
    Journal.create(folder.with_name("new")).close()


def test_two_writers_are_refused(folder):
    first = Journal.open(folder)
    with pytest.raises(InputError) as caught:
        Journal.open(folder)
    assert caught.value.code == "locked"
    first.close()
    Journal.open(folder).close()
    with pytest.raises(InputError) as caught:
        Journal.create(folder)
    assert caught.value.code == "occupied"


class FailingDisk(Disk):
    """Raises at the k-th call; a failing write may leave a part behind."""

    def __init__(self, at: int, number: int, part: float = 0.0):
        self.left, self.number, self.part = at, number, part

    def _count(self) -> bool:
        self.left -= 1
        return self.left == 0

    def _fail(self) -> None:
        if self._count():
            raise OSError(self.number, os.strerror(self.number))

    def open(self, path, flags):
        self._fail()
        return super().open(path, flags)

    def write(self, descriptor, data):
        if self._count():
            super().write(descriptor, data[: int(len(data) * self.part)])
            raise OSError(self.number, os.strerror(self.number))
        return super().write(descriptor, data)

    def fsync(self, descriptor):
        self._fail()
        super().fsync(descriptor)

    def close(self, descriptor):
        super().close(descriptor)
        self._fail()

    def replace(self, source, target):
        self._fail()
        super().replace(source, target)


@pytest.mark.parametrize(
    ("number", "part"), [(errno.ENOSPC, 0.6), (errno.ENOSPC, 1.0), (errno.EIO, 0.0), (errno.EROFS, 0.0)]
)
def test_disk_error_at_every_call_stops_cleanly_and_loses_nothing(tmp_path, number, part):
    for at in itertools.count(1):
        folder, acknowledged = tmp_path / str(at), [0]
        disk = FailingDisk(at, number, part)
        try:
            write_looks(folder, 2, disk, acknowledged.append)
        except DeviceFault as error:
            assert error.exit_code == 5 and error.code == "disk"
        else:
            break
        if not (folder / LOG).exists():
            assert acknowledged[-1] == 0
            continue
        reading = read_journal(folder)
        assert len(reading.records) >= acknowledged[-1], f"call {at}"
        if not reading.records:
            continue
        journal = Journal.open(folder)
        assert verify(folder).records >= acknowledged[-1]
        continue_looks(journal, 1, first=7)
        journal.close()
        verify(folder)
    assert at > 30, "the whole sequence was walked through"


def test_short_writes_are_completed(tmp_path):
    class Dribble(Disk):
        def write(self, descriptor, data):
            return super().write(descriptor, data[:7])

    write_looks(tmp_path, 1, Dribble())
    assert verify(tmp_path).records == 4


@pytest.mark.skipif(os.name != "posix", reason="only POSIX flushes folders")
def test_the_folder_of_the_first_frame_is_durable_before_an_event_names_it(tmp_path):
    """It is made with that frame: its own name has to be flushed too, behind the frame's and before the line."""

    class Following(Disk):
        def __init__(self):
            self.names, self.calls = {}, []

        def open(self, path, flags):
            descriptor = super().open(path, flags)
            self.names[descriptor] = path.relative_to(tmp_path).as_posix()
            return descriptor

        def write(self, descriptor, data):
            self.calls.append(f"write {self.names[descriptor]}")
            return super().write(descriptor, data)

        def fsync(self, descriptor):
            self.calls.append(f"flush {self.names[descriptor]}")
            super().fsync(descriptor)

    disk = Following()
    journal = Journal.create(tmp_path / "c", disk)
    assert not (tmp_path / "c" / "frames").exists()
    for number in range(2):
        disk.calls.clear()
        frame = journal.store(f"frames/{number:06d}_left.png", b"picture")
        journal.append("looked", frames=[frame.as_json()])
        created = ["flush c"] * (number == 0)
        picture_calls = [f"{call} c/frames/.{number:06d}_left.png.tmp" for call in ("write", "flush")]
        assert disk.calls == [*picture_calls, *created, "flush c/frames", f"write c/{LOG}", f"flush c/{LOG}"]
    journal.close()


@dataclass
class Inode:
    """Content that the disk surely has, and what was written since."""

    durable: bytes = b""
    pending: bytes = b""


@dataclass
class PowerLossDisk(Disk):
    """A disk that records what a power cut may leave at every moment, beside doing everything for real.

    Data are durable once their file was flushed, names once their folder was. Until then a cut may leave any
    selection of the pending name changes, and of a file's new bytes none, half, all, or zeros of that length.
    `forget` leaves out calls of one kind.
    """

    forget: str = ""
    inodes: dict[int, Inode] = field(default_factory=dict)
    folders: dict[int, Path] = field(default_factory=dict)
    names: dict[Path, Inode] = field(default_factory=dict)
    durable_names: dict[Path, Inode] = field(default_factory=dict)
    pending_names: list[tuple[Path | None, Path, Inode]] = field(default_factory=list)
    moments: list[tuple[int, list[dict[Path, bytes]]]] = field(default_factory=list)
    acknowledged: int = 0

    def open(self, path, flags):
        descriptor = super().open(path, flags)
        if path.is_dir():
            self.folders[descriptor] = path
        else:
            if flags & os.O_TRUNC or path not in self.names:
                self.names[path] = Inode()
                self.pending_names.append((None, path, self.names[path]))
            self.inodes[descriptor] = self.names[path]
        self._snap()
        return descriptor

    def write(self, descriptor, data):
        self.inodes[descriptor].pending += data
        self._snap()
        return super().write(descriptor, data)

    def fsync(self, descriptor):
        if descriptor in self.folders and self.forget != "folder":
            place = self.folders[descriptor]
            for change in [c for c in self.pending_names if c[1].parent == place]:
                self._apply(self.durable_names, change)
                self.pending_names.remove(change)
        elif descriptor in self.inodes:
            inode = self.inodes[descriptor]
            is_log = self.names.get(inode_path := next(p for p, i in self.names.items() if i is inode)) is not None
            is_log = is_log and inode_path.name == LOG
            if self.forget != ("log" if is_log else "frame"):
                inode.durable, inode.pending = inode.durable + inode.pending, b""
        self._snap()

    def close(self, descriptor):
        super().close(descriptor)
        self.inodes.pop(descriptor, None)
        self.folders.pop(descriptor, None)

    def replace(self, source, target):
        super().replace(source, target)
        inode = self.names.pop(source)
        self.names[target] = inode
        self.pending_names.append((source, target, inode))
        self._snap()

    @staticmethod
    def _apply(names, change):
        source, target, inode = change
        names.pop(source, None)
        names[target] = inode

    def _snap(self):
        """All states that a power cut at this moment may leave."""
        states = []
        for kept in itertools.product((False, True), repeat=len(self.pending_names)):
            names = dict(self.durable_names)
            for change, keep in zip(self.pending_names, kept, strict=True):
                if keep:
                    self._apply(names, change)
            choices = []
            for inode in names.values():
                new = inode.pending
                parts = {b"", new[: len(new) // 2], new, b"\x00" * len(new)}
                choices.append([inode.durable + part for part in parts])
            for contents in itertools.product(*choices):
                states.append(dict(zip(names, contents, strict=True)))
        self.moments.append((self.acknowledged, states))


def power_cuts(tmp_path: Path, forget: str, looks: int) -> tuple[int, int, int]:
    """States after a power cut: how many, in how many an acknowledged event or its frame is gone, or all refused."""
    disk = PowerLossDisk(forget)
    origin = tmp_path / "origin"

    def acknowledge(number):
        disk.acknowledged = number

    write_looks(origin, looks, disk, acknowledge)
    cuts, lost, refused = 0, 0, 0
    target = tmp_path / "after"
    for part in ("frames", "dark"):
        (target / part).mkdir(parents=True)
    done = set()
    for acknowledged, states in disk.moments:
        for state in states:
            key = (acknowledged, frozenset((p, c) for p, c in state.items() if not p.name.startswith(".")))
            if key in done:
                continue
            done.add(key)
            cuts += 1
            for old in target.rglob("*"):
                if old.is_file():
                    old.unlink()
            for path, content in state.items():
                (target / path.relative_to(origin)).write_bytes(content)
            if not (target / LOG).exists():
                lost += acknowledged > 0
                continue
            try:
                records = verify(target).records
            except InputError:
                refused += 1
            else:
                lost += records < acknowledged
    return cuts, lost, refused


def test_no_power_cut_loses_or_damages_what_was_acknowledged(tmp_path):
    cuts, lost, refused = power_cuts(tmp_path, "", 3)
    assert cuts > 25 and lost == refused == 0


@pytest.mark.parametrize("forget", ["folder", "frame", "log"])
def test_power_cut_bench_sees_every_forgotten_flush(tmp_path, forget):
    """The enumeration can fail: without one kind of flush it finds losses."""
    cuts, lost, refused = power_cuts(tmp_path, forget, 1)
    assert lost + refused > 10, (cuts, lost, refused)


WRITER = """
import sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from tvsbayes.acquisition.journal import Journal
folder = Path(sys.argv[1])
journal = Journal.open(folder) if (folder / "log.jsonl").exists() else Journal.create(folder, id="k")
spot = sum(record.event == "looked" for record in journal.records)
spot += 1000 * sum(record.event == "start" for record in journal.records)
journal.append("start")
print(len(journal.records), flush=True)
while True:
    frames = [journal.store(f"frames/{spot:06d}_{side}.png", b"%d" % spot * 5000) for side in ("left", "right")]
    journal.append("looked", spot=spot, frames=[frame.as_json() for frame in frames])
    print(len(journal.records), flush=True)
    spot += 1
"""


def killed_writers(folder: Path, kills: int, seed: int) -> tuple[int, int]:
    """Kill writers of one journal, each going on where the last one died: (events acknowledged, torn ends)."""
    rng = random.Random(seed)
    total, torn = 0, 0
    for _ in range(kills):
        command = [sys.executable, "-I", "-c", WRITER, str(folder), str(Path(__file__).parents[2])]
        process = subprocess.Popen(command, stdout=subprocess.PIPE)
        first = process.stdout.readline()
        try:
            process.wait(rng.uniform(0.0, 0.03))
        except subprocess.TimeoutExpired:
            process.kill()
        rest = process.communicate()[0]
        acknowledged = int((first + rest).split()[-1])
        reading = read_journal(folder)
        assert len(reading.records) >= acknowledged, "an acknowledged event is gone"
        torn += bool(reading.torn)
        verify(folder)
        total = acknowledged
    return total, torn


def test_killed_writers_lose_nothing(tmp_path):
    total, _ = killed_writers(tmp_path / "run", 6, seed=1)
    assert total > 6


def test_a_full_journal_is_reported_and_stays_readable(tmp_path, monkeypatch):
    monkeypatch.setattr("tvsbayes.acquisition.journal.LOG_EVENTS_MAX", 3)
    journal = Journal.create(tmp_path / "run")
    for step in range(2):
        journal.append("intent", step=step)
    with pytest.raises(DeviceFault) as caught:
        journal.append("intent", step=2)
    assert caught.value.code == "journal-full"
    assert len(read_journal(tmp_path / "run").records) == 3


@pytest.mark.skipif(os.name != "posix", reason="only POSIX flushes folders")
def test_a_file_system_that_flushes_no_folders_will_do(tmp_path, monkeypatch):
    flush = os.fsync

    def files_only(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", files_only)
    journal = Journal.create(tmp_path / "c")
    journal.append("begun")
    journal.close()
    assert [record.event for record in read_journal(tmp_path / "c").records] == ["created", "begun"]

"""The journal of an acquisition, `log.jsonl`: append-only, a CRC on every line, chained, on the disk before it counts.

One event per line: `CRC32 NUMBER PREVIOUS-CRC32 JSON`. The first CRC, in eight lower-case hexadecimal digits, covers
the rest of the line; the second is the first one of the line before, so that a missing, swapped or repeated line
shows. Frames are files of their own, written under a temporary name, flushed to the disk, renamed, their folder
flushed; only then is the line with their SHA-256 appended and flushed; only then has the event happened. So a crash
or a power cut at any moment leaves every acknowledged event whole, and at most one torn line at the end.

CRC and chain find accidents; they are no seal against forgery. A missing end is not visible from inside: a run that
ended by itself has a `stop` event, and frames without a line are listed.

Times in the events: UTC for people, `time_s` for the campaign (seconds since the first start, never decreasing).
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tvsbayes.files import (
    DeviceFault,
    InputError,
    escaped,
    flush_folder,
    make_folder,
    parse_json,
    read_bytes,
    refusal,
    write_atomically,
)

LOG = "log.jsonl"
FORMAT = "tvsbayes-log/1"
LINE_BYTES_MAX = 16_384
LOG_BYTES_MAX = 64 * 1024 * 1024
LOG_EVENTS_MAX = 100_000
LOG_ENTRIES_MAX = 5_000_000
"""Commas and opening brackets: short entries take up to 40 times their text in memory (experiments/hostile.md)."""
FRAME_BYTES_MAX = 128 * 1024 * 1024
FRAME_FOLDERS = ("frames", "dark")
"""Pictures with the laser on and, for the background, off."""
FRAME_NAME = re.compile(r"(?:frames|dark)/[0-9]{6}_(?:left|right)\.png")

_LINE = re.compile(rb"([0-9a-f]{8}) (0|[1-9][0-9]{0,8}) ([0-9a-f]{8}) (\{[ -~]*\})")
_REPAIR = "copy what is whole to a new folder: tvsbayes check FOLDER --repair-to NEW"


class Disk:
    """The calls through which a journal reaches the disk, so that tests can fail and replay each of them."""

    def open(self, path: Path, flags: int) -> int:
        """`os.open` for a file, or a folder to be flushed."""
        return os.open(path, flags | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0), 0o666)

    def write(self, descriptor: int, data: bytes) -> int:
        """`os.write`; may write less than asked for."""
        return os.write(descriptor, data)

    def fsync(self, descriptor: int) -> None:
        """`os.fsync`."""
        os.fsync(descriptor)

    def close(self, descriptor: int) -> None:
        """`os.close`."""
        os.close(descriptor)

    def replace(self, source: Path, target: Path) -> None:
        """`os.replace`."""
        os.replace(source, target)


@dataclass(frozen=True, slots=True)
class Record:
    """A line of the journal: its number from 0, the kind of event, its data, its line in the file from 1."""

    number: int
    event: str
    data: dict[str, object]
    line: int


@dataclass(frozen=True, slots=True)
class FrameFile:
    """A stored picture: name relative to the folder, SHA-256 of the file, its size in bytes."""

    name: str
    sha256: str
    size: int

    def as_json(self) -> dict[str, object]:
        """As a look's event holds it."""
        return {"name": self.name, "sha256": self.sha256, "bytes": self.size}


@dataclass(frozen=True)
class Reading:
    """A journal as it stands on the disk.

    Attributes:
        records: the whole lines, in order.
        torn: bytes of an unfinished last line, empty for none.
        size: bytes of the whole lines.
        crc: CRC of the last one, 0 for none.
    """

    records: tuple[Record, ...]
    torn: bytes
    size: int
    crc: int


@dataclass(frozen=True)
class Verification:
    """What a check of a journal and its frames found; whatever is damaged raises instead.

    Attributes:
        records: number of events.
        frames: number of frames whose SHA-256 was compared.
        orphans: frames without an event: of a look that a crash interrupted.
        torn_bytes: length of an unfinished last line.
        stopped: reason of the last `stop`, None where the run did not end by itself.
    """

    records: int
    frames: int
    orphans: tuple[str, ...]
    torn_bytes: int
    stopped: str | None

    def as_json(self) -> dict[str, object]:
        """The document of `tvsbayes check`."""
        warnings = []
        if self.torn_bytes:
            warnings.append(f"{LOG} ends in {self.torn_bytes} bytes of an unfinished line, which --resume cuts off")
        if self.orphans:
            names = ", ".join(self.orphans[:5]) + (", ..." if len(self.orphans) > 5 else "")
            warnings.append(f"{len(self.orphans)} frames without an event, of interrupted looks: {names}")
        if self.stopped is None:
            warnings.append("the run did not end by itself: go on with tvsbayes acquire --resume")
        return {"records": self.records, "frames": self.frames, "stopped": self.stopped, "warnings": warnings}


def encode(number: int, previous: int, event: str, data: dict[str, object]) -> bytes:
    """A line of the journal with its line feed.

    Raises:
        ValueError: too long, or data that JSON cannot hold (NaN and infinity included).
    """
    content = json.dumps({"event": event, **data}, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    body = b"%d %08x %s" % (number, previous, content.encode("ascii"))
    line = b"%08x %s\n" % (zlib.crc32(body), body)
    if len(line) > LINE_BYTES_MAX:
        raise ValueError(f"an event of {len(line)} bytes")
    return line


def _decode(line: bytes, number: int, previous: int) -> tuple[dict[str, object], int] | str:
    """Content and CRC of a line without its line feed, or what is wrong with it."""
    match = _LINE.fullmatch(line) if len(line) < LINE_BYTES_MAX else None
    if match is None:
        return "no event"
    crc = int(match[1], 16)
    if zlib.crc32(line[9:]) != crc:
        return "a line whose CRC does not fit"
    if int(match[2]) != number:
        return f"event {int(match[2])} where {number} belongs"
    if int(match[3], 16) != previous:
        return "a line that does not follow on the one before"
    try:
        values = parse_json(match[4], LOG).values
    except InputError:
        return "no JSON"
    return (values, crc) if isinstance(values.get("event"), str) else "no event"


def _is_torn(tail: bytes, number: int, previous: int) -> bool:
    """Whether a bad end of the file can be an append that a crash cut short, and nothing else.

    An append begins at a line's start and ends with its line feed; power loss may leave any part of it, and blocks of
    zero bytes for what was not written. A whole line with one wrong byte is none of that.
    """
    if tail.endswith(b"\n"):
        return b"\x00\x00" in tail
    if len(tail) > LINE_BYTES_MAX or b"\n" in tail:
        return False
    # A whole event whose line feed became another byte was acknowledged once.
    return isinstance(_decode(tail[:-1], number, previous), str)


def _read_log(folder: Path) -> bytes:
    """The bytes of `log.jsonl`, capped in size, events and entries before anything is parsed."""
    data = read_bytes(folder / LOG, LOG_BYTES_MAX, folder)
    counts = {
        "events": (data.count(b"\n"), LOG_EVENTS_MAX),
        "entries": (sum(map(data.count, (b",", b"[", b"{"))), LOG_ENTRIES_MAX),
    }
    for what, (count, most) in counts.items():
        if count > most:
            found, allowed, remedy = f"{count} {what}", f"at most {most}", "split the run into several campaigns"
            raise refusal("size", file=LOG, found=found, allowed=allowed, remedy=remedy)
    return data


def read_journal(folder: Path) -> Reading:
    """Reads `log.jsonl`; a torn last line is set apart, other damage is refused with its line.

    Raises:
        InputError: missing, damaged, or not a journal of this format.
    """
    folder = Path(folder)
    data = _read_log(folder)
    records: list[Record] = []
    position, previous = 0, 0
    while position < len(data):
        end = data.find(b"\n", position)
        line = data[position:] if end < 0 else data[position:end]
        content = _decode(line, len(records), previous) if end >= 0 else "a line without its end"
        if isinstance(content, str):
            tail = data[position:]
            if (end < 0 or end + 1 == len(data)) and _is_torn(tail, len(records), previous):
                return Reading(tuple(records), tail, position, previous)
            number, allowed = len(records) + 1, "events in their order, each with its CRC"
            raise refusal("journal", file=LOG, line=number, found=content, allowed=allowed, remedy=_REPAIR)
        values, previous = content
        event = str(values.pop("event"))
        if not records and (event != "created" or values.get("format") != FORMAT):
            allowed = f"the event created of the format {FORMAT}"
            raise refusal("journal", file=LOG, line=1, found=escaped(event), allowed=allowed, remedy=_REPAIR)
        records.append(Record(len(records), event, values, len(records) + 1))
        position = end + 1
    return Reading(tuple(records), b"", position, previous)


def frames_of(record: Record) -> list[FrameFile]:
    """The frames that an event names.

    Raises:
        InputError: entries that no journal of ours holds.
    """
    entries = record.data.get("frames", [])
    found = []
    for entry in entries if isinstance(entries, list) else [None]:
        good = isinstance(entry, dict) and set(entry) == {"name", "sha256", "bytes"}
        if not (good and isinstance(entry["name"], str) and FRAME_NAME.fullmatch(entry["name"])):
            allowed = "frames as { name, sha256, bytes }"
            raise refusal("journal", file=LOG, line=record.line, found="another", allowed=allowed, remedy=_REPAIR)
        found.append(FrameFile(entry["name"], str(entry["sha256"]), entry["bytes"]))
    return found


def _frame_problem(folder: Path, frame: FrameFile) -> str | None:
    """What is wrong with a stored frame, None for nothing."""
    try:
        data = read_bytes(folder / frame.name, FRAME_BYTES_MAX, folder)
    except InputError as error:
        return error.found or "unreadable"
    if len(data) != frame.size or hashlib.sha256(data).hexdigest() != frame.sha256:
        return "a file with another SHA-256 than when it was taken"
    return None


def orphans(folder: Path, records: tuple[Record, ...]) -> list[str]:
    """Frames on the disk that no event names, sorted."""
    named = {frame.name for record in records for frame in frames_of(record)}
    there = (f"{name}/{p.name}" for name in FRAME_FOLDERS for p in sorted((Path(folder) / name).glob("*.png")))
    return [name for name in there if name not in named]


def verify(folder: Path) -> Verification:
    """Reads the journal of a folder and compares every frame with its SHA-256.

    Raises:
        InputError: damage, with line number and what to do.
    """
    folder = Path(folder)
    reading = read_journal(folder)
    named: set[str] = set()
    count = 0
    for record in reading.records:
        for frame in frames_of(record):
            # Each is read once: a log of thousands of lines that name one large file would take hours.
            problem = "a frame that an event before it names" if frame.name in named else _frame_problem(folder, frame)
            named.add(frame.name)
            if problem is not None:
                place = {"file": LOG, "line": record.line, "column": frame.name}
                allowed = "the frame that the event names, unchanged"
                raise refusal("frame", **place, found=problem, allowed=allowed, remedy=_REPAIR)
            count += 1
    stops = [str(r.data.get("reason", "")) for r in reading.records[-1:] if r.event == "stop"]
    missing = tuple(orphans(folder, reading.records))
    return Verification(len(reading.records), count, missing, len(reading.torn), stops[0] if stops else None)


class Journal:
    """A journal open for appending; one writer at a time.

    After a failure nothing more is written: a failed flush may have dropped what it was to save, so that trying again
    would acknowledge what is not there.
    """

    def __init__(self, folder: Path, descriptor: int, reading: Reading, disk: Disk):
        self.folder = Path(folder)
        self.records = list(reading.records)
        self.torn = reading.torn
        """Bytes that were cut off when this journal was opened; they are kept in a file of their own."""
        self._descriptor: int | None = descriptor
        self._crc, self._size, self._disk = reading.crc, reading.size, disk
        self._dirty: set[Path] = set()

    @classmethod
    def create(cls, folder: Path, disk: Disk | None = None, **data: object) -> Journal:
        """A new journal in a folder that has none; `data` goes into its first event, `created`.

        Raises:
            InputError: there is one already, or the folder cannot be written.
        """
        disk = disk or Disk()
        folder = Path(folder)
        make_folder(folder)
        try:
            descriptor = disk.open(folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND)
        except FileExistsError as error:
            allowed, remedy = "a folder without a journal", "go on with --resume, or name another folder"
            raise refusal("occupied", file=LOG, found="a journal", allowed=allowed, remedy=remedy) from error
        except OSError as error:
            raise _disk_fault(error) from error
        journal = cls(folder, descriptor, Reading((), b"", 0, 0), disk)
        # The name of the log, and that of the folder itself.
        journal._dirty |= {folder, folder.absolute().parent}
        try:
            _lock(descriptor)
            journal.append("created", format=FORMAT, **data)
        except BaseException:
            # Nothing was acknowledged: without its file the folder can be tried again.
            journal.close()
            with contextlib.suppress(OSError):
                (folder / LOG).unlink()
            raise
        return journal

    @classmethod
    def open(cls, folder: Path, disk: Disk | None = None) -> Journal:
        """An existing journal, to go on with; a torn last line is kept aside and cut off.

        Raises:
            InputError: damaged, or another program writes it.
            DeviceFault: the disk refuses.
        """
        disk = disk or Disk()
        folder = Path(folder)
        read_bytes(folder / LOG, LOG_BYTES_MAX, folder)
        try:
            descriptor = disk.open(folder / LOG, os.O_WRONLY | os.O_APPEND)
        except OSError as error:
            raise _disk_fault(error) from error
        try:
            _lock(descriptor)
            reading = read_journal(folder)
            if reading.torn:
                write_atomically(folder / f"log.torn-{reading.size}", reading.torn)
                os.ftruncate(descriptor, reading.size)
                disk.fsync(descriptor)
            if not reading.records:
                allowed, remedy = "at least the event created", "begin anew in another folder"
                raise refusal("journal", file=LOG, found="no event", allowed=allowed, remedy=remedy)
        except OSError as error:
            os.close(descriptor)
            raise _disk_fault(error) from error
        except BaseException:
            os.close(descriptor)
            raise
        return cls(folder, descriptor, reading, disk)

    def store(self, name: str, data: bytes) -> FrameFile:
        """Writes a frame; it counts once an event that names it is appended.

        Raises:
            ValueError: a name that is no frame's.
            DeviceFault: the disk refuses; the journal is closed.
        """
        if not FRAME_NAME.fullmatch(name):
            raise ValueError(name)
        target = self.folder / name
        temporary = target.with_name(f".{target.name}.tmp")
        with self._guarded():
            # Only for a frame: a run that states centroids leaves no empty folders behind.
            if not target.parent.is_dir():
                target.parent.mkdir()
                self._dirty.add(self.folder)
            descriptor = self._disk.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            try:
                self._write(descriptor, data)
                self._disk.fsync(descriptor)
            finally:
                self._disk.close(descriptor)
            self._disk.replace(temporary, target)
        self._dirty.add(target.parent)
        return FrameFile(name, hashlib.sha256(data).hexdigest(), len(data))

    def append(self, event: str, **data: object) -> Record:
        """Appends an event and returns once it is on the disk, behind the frames stored before it.

        Raises:
            DeviceFault: the disk refuses; the journal is closed.
        """
        line = encode(len(self.records), self._crc, event, data)
        with self._guarded() as descriptor:
            if len(self.records) >= LOG_EVENTS_MAX or self._size + len(line) > LOG_BYTES_MAX:
                message, remedy = "the journal is full", "begin a new campaign for the rest of the plan"
                raise DeviceFault("journal-full", f"{message}; {remedy}", remedy=remedy)
            for folder in sorted(self._dirty):
                flush_folder(folder, self._disk)
            self._dirty.clear()
            self._write(descriptor, line)
            self._disk.fsync(descriptor)
        self._size += len(line)
        self._crc = int(line[:8], 16)
        record = Record(len(self.records), event, json.loads(json.dumps(data)), len(self.records) + 1)
        self.records.append(record)
        return record

    def close(self) -> None:
        """Gives the journal back; everything appended is on the disk already."""
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            os.close(descriptor)

    def _guarded(self) -> _Guard:
        return _Guard(self)

    def _write(self, descriptor: int, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[self._disk.write(descriptor, bytes(view)) :]


class _Guard:
    """Turns the first disk error into a `DeviceFault` and closes the journal for good."""

    def __init__(self, journal: Journal):
        self.journal = journal

    def __enter__(self) -> int:
        if self.journal._descriptor is None:
            raise DeviceFault("disk", "the journal is closed after a disk error", remedy="go on with --resume")
        return self.journal._descriptor

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None:
            self.journal.close()
        if isinstance(error, OSError):
            raise _disk_fault(error) from error


def _disk_fault(error: OSError) -> DeviceFault:
    found = escaped(error.strerror or str(error))
    remedy = "free space or change the disk, then go on with --resume: nothing acknowledged is lost"
    return DeviceFault("disk", f"the journal cannot be written: {found}; {remedy}", found=found, remedy=remedy)


def _lock(descriptor: int) -> None:
    """Refuses a second writer; the lock ends with the process, however it ends."""
    try:
        if os.name == "posix":
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            import msvcrt

            # Far behind the end, so that readers are not kept out.
            os.lseek(descriptor, LOG_BYTES_MAX + 1, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    except OSError as error:
        # What flock(2) and _locking say of a lock that somebody holds; anything else is a disk without locks.
        if error.errno not in (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK):
            found, allowed = escaped(error.strerror or str(error)), "a disk that can lock files"
            raise refusal("lock", file=LOG, found=found, allowed=allowed, remedy="use a local disk") from error
        allowed, remedy = "one program at a time", "wait for the other, or end it"
        raise refusal("locked", file=LOG, found="another writer", allowed=allowed, remedy=remedy) from error


@dataclass
class Repair:
    """What a repair kept and lost.

    Attributes:
        kept: events copied.
        lost_lines: lines of the old journal that are not whole.
        lost_frames: frames that are missing or changed; their looks stay, without these frames.
        torn_bytes: length of an unfinished last line that was left out.
    """

    kept: int = 0
    lost_lines: list[int] = field(default_factory=list)
    lost_frames: list[str] = field(default_factory=list)
    torn_bytes: int = 0

    def as_json(self) -> dict[str, object]:
        """The document of `tvsbayes check --repair-to`."""
        return {
            "kept": self.kept,
            "lost_lines": self.lost_lines,
            "lost_frames": self.lost_frames,
            "torn_bytes": self.torn_bytes,
        }


def _whole_lines(data: bytes) -> Iterator[tuple[int, dict[str, object] | None, int]]:
    """(line, content or None where it is damaged, number it states) of every line that ends."""
    for number, line in enumerate(data.split(b"\n")[:-1], start=1):
        match = _LINE.fullmatch(line) if len(line) < LINE_BYTES_MAX else None
        if match is None or zlib.crc32(line[9:]) != int(match[1], 16):
            yield number, None, -1
            continue
        try:
            values = parse_json(match[4], LOG).values
        except InputError:
            yield number, None, -1
            continue
        yield number, values if isinstance(values.get("event"), str) else None, int(match[2])


def repair(folder: Path, to: Path) -> Repair:
    """Copies what is whole into a new folder; the old one stays as it is.

    Where lines are missing a `gap` event stands: what followed it without a new homing cannot be trusted, because
    nobody knows which motion is missing. Frames that are not what their event says are left out and named.

    Raises:
        InputError: nothing whole, or `to` holds something.
    """
    folder, to = Path(folder), Path(to)
    data = _read_log(folder)
    lines = list(_whole_lines(data))
    done = Repair(torn_bytes=len(data) - data.rfind(b"\n") - 1)
    events = [(line, values, number) for line, values, number in lines if values is not None]
    done.lost_lines = [line for line, values, _ in lines if values is None]
    if not events:
        allowed, remedy = "at least one whole line", "take the campaign again"
        raise refusal("journal", file=LOG, found="nothing whole", allowed=allowed, remedy=remedy)
    make_folder(to, empty=True)
    first = events[0][1] if events[0][1]["event"] == "created" else {}
    created = {k: v for k, v in first.items() if k not in ("event", "format")}
    journal = Journal.create(to, **created, repaired=True)
    expected, ended = 1 if first else 0, False
    named: set[str] = set()
    try:
        for line, values, number in events[1:] if first else events:
            if number != expected:
                journal.append("gap", before_line=line)
            expected = number + 1
            content = {k: v for k, v in values.items() if k not in ("event", "frames")}
            record = Record(number, str(values["event"]), values, line)
            kept = []
            for frame in frames_of(record):
                twice = frame.name in named
                named.add(frame.name)
                if not twice and _frame_problem(folder, frame) is None:
                    kept.append(journal.store(frame.name, read_bytes(folder / frame.name, FRAME_BYTES_MAX, folder)))
                else:
                    done.lost_frames.append(frame.name)
            if "frames" in values:
                content["frames"] = [frame.as_json() for frame in kept]
            journal.append(record.event, **content)
            done.kept += 1
            ended = record.event == "stop"
        if not ended:
            journal.append("gap", before_line=len(lines) + 1)
    finally:
        journal.close()
    done.kept += bool(first)
    return done

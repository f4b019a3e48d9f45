"""The journal of an acquisition, `log.jsonl`: append-only, chained CRC per line, flushed before an event counts.

One event per line: `CRC32 NUMBER PREVIOUS-CRC32 JSON`. The first CRC, in eight lower-case hexadecimal digits, covers
the rest of the line; the second repeats the first CRC of the line before, so that a missing, swapped or repeated line
is detected. Frames are files of their own: written under a temporary name, flushed to the disk, renamed, their folder
flushed. Only then is the line with their SHA-256 appended and flushed, and the event counts. A crash or a power cut at
any moment therefore leaves every acknowledged event complete, and at most one incomplete line at the end.

What an event says is declared in `recorder`; here it is a kind with entries.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from tvsbayes.errors import DeviceFault, InputError, escaped, fault, refusal
from tvsbayes.files.disk import flush_folder, locked, make_folder, read_bytes, write_atomically
from tvsbayes.files.documents import parse_json
from tvsbayes.results.records import ClosedRecord

LOG = "log.jsonl"
FORMAT = "tvsbayes-log/1"
LINE_BYTES_MAX = 16_384
LOG_BYTES_MAX = 64 * 1024 * 1024
LOG_EVENTS_MAX = 100_000
LOG_ENTRIES_MAX = 5_000_000
"""Largest number of commas and opening brackets: short entries take up to 40 times their text in memory."""
FRAME_BYTES_MAX = 128 * 1024 * 1024
FRAME_FOLDERS = ("frames", "dark")
"""Pictures with the laser on and, for the background, off."""
FRAME_NAME = re.compile(r"(?:frames|dark)/[0-9]{6}_(?:left|right)\.png")
"""Names made by `instrument.campaign.frame_name`."""
LOG_LINE = re.compile(rb"([0-9a-f]{8}) (0|[1-9][0-9]{0,8}) ([0-9a-f]{8}) (\{[ -~]*\})")
EMPTY_REMEDY = "nothing was recorded: begin again in another folder, without --resume"
"""Remedy for a run that was killed before its first event, or whose journal was emptied."""
REPAIR_REMEDY = "copy the intact part to a new folder: tvsbayes check FOLDER --repair-to NEW"


class Frame(ClosedRecord, frozen=True, rename={"size": "bytes"}):
    """A stored picture: name relative to the folder, SHA-256 of the file, its size in bytes."""

    name: Annotated[str, Meta(pattern=rf"\A{FRAME_NAME.pattern}\Z")]
    sha256: str
    size: int


@dataclass(frozen=True, slots=True)
class Record:
    """A complete line of a journal.

    Attributes:
        number: number of the event, from 0.
        event, data: its kind and its entries.
        line: number of the line in the file, from 1.
        previous, crc: CRC of the line before and its own.
    """

    number: int
    event: str
    data: dict[str, Any]
    line: int
    previous: int = 0
    crc: int = 0

    def refused(self, found: object) -> InputError:
        """The refusal of an event that is invalid or contradicts those before it."""
        allowed, remedy = f"the entries of the event {self.event}", "tvsbayes check FOLDER --repair-to NEW"
        return refusal("event", file=LOG, line=self.line, found=escaped(str(found), 80), allowed=allowed, remedy=remedy)

    @property
    def frames(self) -> list[Frame]:
        """The frames that the event names.

        Raises:
            InputError: entries that this program never writes.
        """
        try:
            return msgspec.convert(self.data.get("frames", []), list[Frame])
        # JSON may hold a lone surrogate, which UTF-8 cannot encode.
        except (msgspec.ValidationError, UnicodeEncodeError) as error:
            raise damaged(self.line, "another", "frames as { name, sha256, bytes }") from error


def damaged(line: int | None, found: str, allowed: str, remedy: str = REPAIR_REMEDY) -> InputError:
    """The refusal of a journal."""
    return refusal("journal", file=LOG, line=line, found=found, allowed=allowed, remedy=remedy)


@dataclass(frozen=True)
class Reading:
    """The present content of a journal on the disk.

    Attributes:
        records: the complete lines, in order.
        torn: bytes of an incomplete last line, empty for none.
        size: bytes of the complete lines.
        crc: CRC of the last complete line, 0 for none.
    """

    records: tuple[Record, ...]
    torn: bytes
    size: int
    crc: int


def encode(number: int, previous: int, event: str, data: dict[str, object]) -> bytes:
    """A line of the journal with its line feed.

    Raises:
        ValueError: too long, or data that JSON cannot represent (such as NaN and infinity).
    """
    content = json.dumps({"event": event, **data}, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    body = b"%d %08x %s" % (number, previous, content.encode("ascii"))
    line = b"%08x %s\n" % (zlib.crc32(body), body)
    if len(line) > LINE_BYTES_MAX:
        raise ValueError(f"an event of {len(line)} bytes")
    return line


def parse_line(line: bytes, line_number: int) -> Record | str:
    """Parse a line of a file, without its line feed, independently of earlier lines; returns its fault if damaged."""
    match = LOG_LINE.fullmatch(line) if len(line) < LINE_BYTES_MAX else None
    if match is None:
        return "no event"
    crc = int(match[1], 16)
    if zlib.crc32(line[9:]) != crc:
        return "a line whose CRC does not fit"
    try:
        data = parse_json(match[4], LOG).values
    except InputError:
        return "no JSON"
    event = data.pop("event", None)
    if not isinstance(event, str):
        return "no event"
    return Record(int(match[2]), event, data, line_number, int(match[3], 16), crc)


def _following(line: bytes, number: int, previous: int) -> Record | str:
    """The line that follows `number` others, the last of which has the CRC `previous`; or its fault."""
    record = parse_line(line, number + 1)
    if isinstance(record, str):
        return record
    if record.number != number:
        return f"event {record.number} where {number} belongs"
    return record if record.previous == previous else "a line that does not follow on the one before"


def _is_torn(tail: bytes, number: int, previous: int) -> bool:
    """Whether an invalid end of the file can only be an append that a crash cut short.

    An append begins at a line's start and ends with its line feed; power loss may leave any part of it, with blocks of
    zero bytes in place of unwritten data. A complete line with one wrong byte is not such an append.
    """
    if tail.endswith(b"\n"):
        return b"\x00\x00" in tail
    if len(tail) > LINE_BYTES_MAX or b"\n" in tail:
        return False
    # A complete event whose line feed became another byte was acknowledged.
    return isinstance(_following(tail[:-1], number, previous), str)


def require_journal(folder: Path, remedy: str) -> None:
    """Refuses a folder without `log.jsonl`."""
    if not (folder / LOG).is_file():
        shown_path = escaped(str(folder / LOG), 200)
        raise refusal("missing-file", file=shown_path, found="no journal", allowed="a journal", remedy=remedy)


def read_log(folder: Path) -> bytes:
    """The bytes of `log.jsonl`, limited in size, events and entries before parsing."""
    data = read_bytes(folder / LOG, LOG_BYTES_MAX, folder)
    entries = sum(map(data.count, (b",", b"[", b"{")))
    for unit, count, limit in (("events", data.count(b"\n"), LOG_EVENTS_MAX), ("entries", entries, LOG_ENTRIES_MAX)):
        if count > limit:
            found, allowed, remedy = f"{count} {unit}", f"at most {limit}", "split the run into several campaigns"
            raise refusal("size", file=LOG, found=found, allowed=allowed, remedy=remedy)
    return data


def read_journal(folder: Path) -> Reading:
    """Reads `log.jsonl`; an incomplete last line is returned separately, other damage is refused with its line.

    Raises:
        InputError: missing, damaged, or not a journal of this format.
    """
    data = read_log(Path(folder))
    records: list[Record] = []
    position, previous = 0, 0
    while position < len(data):
        end = data.find(b"\n", position)
        record = "a line without its end" if end < 0 else _following(data[position:end], len(records), previous)
        if isinstance(record, str):
            tail = data[position:]
            if (end < 0 or end + 1 == len(data)) and _is_torn(tail, len(records), previous):
                return Reading(tuple(records), tail, position, previous)
            raise damaged(len(records) + 1, record, "events in their order, each with its CRC")
        if not records and (record.event != "created" or record.data.get("format") != FORMAT):
            raise damaged(1, escaped(record.event), f"the event created of the format {FORMAT}")
        previous = record.crc
        records.append(record)
        position = end + 1
    return Reading(tuple(records), b"", position, previous)


def orphans(folder: Path, records: Iterable[Record]) -> list[str]:
    """Frames on the disk that no event names, sorted."""
    in_events = {frame.name for record in records for frame in record.frames}
    stored = (f"{name}/{p.name}" for name in FRAME_FOLDERS for p in sorted((Path(folder) / name).glob("*.png")))
    return [name for name in stored if name not in in_events]


class Disk:
    """The calls through which a journal reaches the disk, so that tests can make each of them fail and replay them."""

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


class Journal:
    """A journal open for appending; one writer at a time.

    After a failure nothing more is written: a failed flush may have lost its data, and a second attempt would
    acknowledge an event that is not on the disk.
    """

    def __init__(self, folder: Path, descriptor: int, reading: Reading, disk: Disk):
        self.folder = Path(folder)
        self.records = list(reading.records)
        self.torn = reading.torn
        """Bytes cut off when this journal was opened; a separate file keeps them."""
        self._descriptor: int | None = descriptor
        self._crc, self._size, self._disk = reading.crc, reading.size, disk
        self._dirty: set[Path] = set()

    @classmethod
    def create(cls, folder: Path, disk: Disk | None = None, /, **data: object) -> Journal:
        """Create a journal in a folder that has none; `data` are the entries of its first event, `created`.

        Raises:
            InputError: there is already a journal, or the folder cannot be written.
        """
        disk, folder = disk or Disk(), Path(folder)
        make_folder(folder)
        try:
            descriptor = disk.open(folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND)
        except FileExistsError as error:
            allowed, remedy = "a folder without a journal", "go on with --resume, or name another folder"
            raise refusal("occupied", file=LOG, found="a journal", allowed=allowed, remedy=remedy) from error
        except OSError as error:
            raise _disk_fault(error) from error
        journal = cls(folder, descriptor, Reading((), b"", 0, 0), disk)
        # Flush the name of the log, and that of the folder itself.
        journal._dirty |= {folder, folder.absolute().parent}
        try:
            _lock(descriptor)
            journal.append("created", format=FORMAT, **data)
        except BaseException:
            # Nothing was acknowledged: after removing the file the folder can be used again.
            journal.close()
            with contextlib.suppress(OSError):
                (folder / LOG).unlink()
            raise
        return journal

    @classmethod
    def open(cls, folder: Path, disk: Disk | None = None) -> Journal:
        """Open an existing journal to continue it; cut off and keep an incomplete last line, remove unfinished frames.

        Raises:
            InputError: the journal is damaged, or another program writes it.
            DeviceFault: the disk refuses.
        """
        disk, folder = disk or Disk(), Path(folder)
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
                raise damaged(None, "no event", "at least the event created", EMPTY_REMEDY)
            for name in FRAME_FOLDERS:
                # This program holds the lock: no other program writes frames.
                for unfinished in (folder / name).glob(".*.png.tmp"):
                    unfinished.unlink(missing_ok=True)
        except BaseException as error:
            os.close(descriptor)
            if isinstance(error, OSError):
                raise _disk_fault(error) from error
            raise
        return cls(folder, descriptor, reading, disk)

    def store(self, name: str, data: bytes) -> Frame:
        """Writes a frame; it counts once an event naming it is appended.

        Raises:
            ValueError: not the name of a frame.
            DeviceFault: the disk refuses; the journal is closed.
        """
        if not FRAME_NAME.fullmatch(name):
            raise ValueError(name)
        target = self.folder / name
        temporary = target.with_name(f".{target.name}.tmp")
        with self._guarded():
            # Created for the first frame: a run without pictures leaves no empty folders.
            if not target.parent.is_dir():
                target.parent.mkdir()
                self._dirty.add(self.folder)
            descriptor = self._disk.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            try:
                self._write(descriptor, data)
            finally:
                self._disk.close(descriptor)
            self._disk.replace(temporary, target)
        self._dirty.add(target.parent)
        return Frame(name, hashlib.sha256(data).hexdigest(), len(data))

    def append(self, event: str, /, **data: object) -> Record:
        """Appends an event and returns once it is on the disk, after the frames stored before it.

        Raises:
            DeviceFault: the disk refuses; the journal is closed.
        """
        number = len(self.records)
        line = encode(number, self._crc, event, data)
        with self._guarded() as descriptor:
            if number >= LOG_EVENTS_MAX or self._size + len(line) > LOG_BYTES_MAX:
                raise fault("journal-full", "the journal is full", "begin a new campaign for the rest of the plan")
            for folder in sorted(self._dirty):
                flush_folder(folder, self._disk)
            self._dirty.clear()
            self._write(descriptor, line)
        self._size += len(line)
        self._crc = int(line[:8], 16)
        record = Record(number, event, json.loads(json.dumps(data)), number + 1)
        self.records.append(record)
        return record

    def close(self) -> None:
        """Closes the journal; all appended events are on the disk already."""
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            os.close(descriptor)

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[int]:
        """The descriptor; the first error closes the journal permanently, and a disk error becomes a `DeviceFault`."""
        if self._descriptor is None:
            raise DeviceFault("disk", "the journal is closed after a disk error", remedy="go on with --resume")
        try:
            yield self._descriptor
        except BaseException as error:
            self.close()
            if isinstance(error, OSError):
                raise _disk_fault(error) from error
            raise

    def _write(self, descriptor: int, data: bytes) -> None:
        """Write all of `data`, in as many calls as it takes, and flush it."""
        view = memoryview(data)
        while view:
            view = view[self._disk.write(descriptor, bytes(view)) :]
        self._disk.fsync(descriptor)


def _disk_fault(error: OSError) -> DeviceFault:
    remedy = "free space or change the disk, then go on with --resume: nothing acknowledged is lost"
    found = escaped(error.strerror or str(error))
    return DeviceFault("disk", f"the journal cannot be written: {found}; {remedy}", found=found, remedy=remedy)


def _lock(descriptor: int) -> None:
    """Refuses a second writer; the lock ends with the process in every case."""
    try:
        is_alone = locked(descriptor)
    except OSError as error:
        found, allowed = escaped(error.strerror or str(error)), "a disk that can lock files"
        raise refusal("lock", file=LOG, found=found, allowed=allowed, remedy="use a local disk") from error
    if not is_alone:
        allowed, remedy = "one program at a time", "wait for the other, or end it"
        raise refusal("locked", file=LOG, found="another writer", allowed=allowed, remedy=remedy)

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

import hashlib
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tvsbayes.acquisition.journal import (
    FRAME_BYTES_MAX,
    FRAME_FOLDERS,
    FRAME_NAME,
    LINE_BYTES_MAX,
    LOG,
    LOG_LINE,
    REPAIR_REMEDY,
    FrameFile,
    Journal,
    Record,
    read_journal,
    read_log,
)
from tvsbayes.errors import InputError, refusal
from tvsbayes.files.disk import make_folder, read_bytes
from tvsbayes.files.documents import parse_json


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
            raise refusal("journal", file=LOG, line=record.line, found="another", allowed=allowed, remedy=REPAIR_REMEDY)
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
                raise refusal("frame", **place, found=problem, allowed=allowed, remedy=REPAIR_REMEDY)
            count += 1
    stops = [str(r.data.get("reason", "")) for r in reading.records[-1:] if r.event == "stop"]
    missing = tuple(orphans(folder, reading.records))
    return Verification(len(reading.records), count, missing, len(reading.torn), stops[0] if stops else None)


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
        match = LOG_LINE.fullmatch(line) if len(line) < LINE_BYTES_MAX else None
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
    data = read_log(folder)
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

"""Checks a journal and its frames, and copies the intact lines of a damaged one.

CRC and chain detect accidents; they do not prevent forgery. A missing end leaves no trace in the lines; but a run that
ended by itself has a `stop` event, and frames without an event are listed.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from tvsbayes.acquisition.journal import (
    EMPTY_REMEDY,
    FRAME_BYTES_MAX,
    FRAME_FOLDERS,
    LOG,
    REPAIR_REMEDY,
    Journal,
    Record,
    event_of,
    parse_line,
    read_journal,
    read_log,
)
from tvsbayes.acquisition.journal_events import Frame, Stop
from tvsbayes.errors import InputError, refusal
from tvsbayes.files.disk import make_folder, read_bytes


@dataclass(frozen=True)
class Verification:
    """The result of a check of a journal and its frames; damage raises instead.

    Attributes:
        records: number of events.
        frames: number of frames whose SHA-256 was compared.
        orphans: frames without an event, from a look that a crash interrupted.
        torn_bytes: length of an incomplete last line.
        stopped: reason of the last `stop`, None where the run did not end by itself.
    """

    records: int
    frames: int
    orphans: tuple[str, ...]
    torn_bytes: int
    stopped: str | None

    @property
    def warnings(self) -> list[str]:
        """Warnings for the user."""
        warnings = []
        if self.torn_bytes:
            warnings.append(f"{LOG} ends in {self.torn_bytes} bytes of an unfinished line, which --resume cuts off")
        if self.orphans:
            names = ", ".join(self.orphans[:5]) + (", ..." if len(self.orphans) > 5 else "")
            warnings.append(f"{len(self.orphans)} frames without an event, of interrupted looks: {names}")
        if not self.records:
            warnings.append(f"{LOG} holds no event; {EMPTY_REMEDY}")
        elif self.stopped is None:
            warnings.append("the run did not end by itself: go on with tvsbayes acquire --resume")
        return warnings


def frames_of(record: Record) -> list[Frame]:
    """The frames that an event names.

    Raises:
        InputError: entries that this program never writes.
    """
    try:
        return msgspec.convert(record.data.get("frames", []), list[Frame])
    except (msgspec.ValidationError, UnicodeEncodeError) as error:
        allowed, line = "frames as { name, sha256, bytes }", record.line
        raise refusal("journal", file=LOG, line=line, found="another", allowed=allowed, remedy=REPAIR_REMEDY) from error


def _frame_problem(folder: Path, frame: Frame) -> str | None:
    """The fault of a stored frame, None for none."""
    try:
        data = read_bytes(folder / frame.name, FRAME_BYTES_MAX, folder)
    except InputError as error:
        return error.found or "unreadable"
    if len(data) != frame.size or hashlib.sha256(data).hexdigest() != frame.sha256:
        return "a file with another SHA-256 than when it was taken"
    return None


def orphans(folder: Path, records: tuple[Record, ...]) -> list[str]:
    """Frames on the disk that no event names, sorted."""
    in_events = {frame.name for record in records for frame in frames_of(record)}
    stored = (f"{name}/{p.name}" for name in FRAME_FOLDERS for p in sorted((Path(folder) / name).glob("*.png")))
    return [name for name in stored if name not in in_events]


def verify(folder: Path) -> Verification:
    """Reads the journal of a folder and compares every frame with its SHA-256.

    Raises:
        InputError: damage, with line number and remedy.
    """
    folder = Path(folder)
    reading = read_journal(folder)
    names: set[str] = set()
    count = 0
    for record in reading.records:
        for frame in frames_of(record):
            # Each frame is read once: thousands of lines naming one large file would take hours.
            problem = "a frame that an event before it names" if frame.name in names else _frame_problem(folder, frame)
            names.add(frame.name)
            if problem is not None:
                raise refusal(
                    "frame",
                    file=LOG,
                    line=record.line,
                    column=frame.name,
                    found=problem,
                    allowed="the frame that the event names, unchanged",
                    remedy=REPAIR_REMEDY,
                )
            count += 1
    end = event_of(reading.records[-1], Stop) if reading.records else None
    missing = tuple(orphans(folder, reading.records))
    return Verification(len(reading.records), count, missing, len(reading.torn), None if end is None else end.reason)


@dataclass
class Repair:
    """The result of a repair: copied events and losses.

    Attributes:
        kept: events copied.
        lost_lines: damaged lines of the old journal.
        lost_frames: frames that are missing or changed; their looks are kept without these frames.
        torn_bytes: length of an unfinished last line, which is not copied.
    """

    kept: int = 0
    lost_lines: list[int] = field(default_factory=list)
    lost_frames: list[str] = field(default_factory=list)
    torn_bytes: int = 0


IN_MOTION, ENDS_OF_MOTION = {"created", "gap", "intent", "verified"}, {"homed", "moved", "verified"}
"""Events after and before which a single lost line may belong to a motion, which has at least two lines."""


def _in_written_order(records: list[Record]) -> list[Record]:
    """Intact lines by their numbers, which their checksums cover; in file order where a number is repeated."""
    numbers = {record.number for record in records}
    return sorted(records, key=lambda record: record.number) if len(numbers) == len(records) else records


def repair(folder: Path, to: Path) -> Repair:
    """Copies the intact lines into a new folder; the old folder is unchanged.

    Intact lines are sorted by the order of writing. A `gap` event replaces missing lines: events
    after it do not count until a new homing, because an unknown motion may be missing, unless the event states that no
    motion was lost. Frames that differ from their event are left out and listed.

    Raises:
        InputError: no intact line, or `to` is not empty.
    """
    folder, to = Path(folder), Path(to)
    data = read_log(folder)
    parsed = [parse_line(line, number) for number, line in enumerate(data.split(b"\n")[:-1], start=1)]
    result = Repair(torn_bytes=len(data) - data.rfind(b"\n") - 1)
    events = _in_written_order([line for line in parsed if isinstance(line, Record)])
    result.lost_lines = [number for number, line in enumerate(parsed, start=1) if isinstance(line, str)]
    if not events:
        allowed, remedy = "at least one whole line", "take the campaign again"
        raise refusal("journal", file=LOG, found="nothing whole", allowed=allowed, remedy=remedy)
    make_folder(to, empty=True)
    header = events[0].data if events[0].event == "created" else {}
    created = {key: value for key, value in header.items() if key != "format"}
    journal = Journal.create(to, **{**created, "repaired": True})
    expected, stopped, previous = 1 if header else 0, False, "created"
    names: set[str] = set()
    try:
        for record in events[1:] if header else events:
            if record.number != expected:
                lost = record.number - expected != 1 or previous in IN_MOTION or record.event in ENDS_OF_MOTION
                journal.append("gap", before_line=record.line, **({} if lost else {"motion_lost": False}))
            expected, previous = record.number + 1, record.event
            frames = []
            for frame in frames_of(record):
                repeated = frame.name in names
                names.add(frame.name)
                if not repeated and _frame_problem(folder, frame) is None:
                    frames.append(journal.store(frame.name, read_bytes(folder / frame.name, FRAME_BYTES_MAX, folder)))
                else:
                    result.lost_frames.append(frame.name)
            content = {key: value for key, value in record.data.items() if key != "frames"}
            if "frames" in record.data:
                content["frames"] = [frame.as_json() for frame in frames]
            journal.append(record.event, **content)
            result.kept += 1
            stopped = record.event == "stop"
        if not stopped:
            journal.append("gap", before_line=len(parsed) + 1)
    finally:
        journal.close()
    result.kept += bool(header)
    return result

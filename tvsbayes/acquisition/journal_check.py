"""A journal and its frames checked, and what is whole of a damaged one copied.

CRC and chain find accidents; they are no seal against forgery. A missing end is not visible from inside: a run that
ended by itself has a `stop` event, and frames without a line are listed.
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

    @property
    def warnings(self) -> list[str]:
        """What the user should know."""
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
        InputError: entries that no journal of ours holds.
    """
    try:
        return msgspec.convert(record.data.get("frames", []), list[Frame])
    except msgspec.ValidationError as error:
        allowed, line = "frames as { name, sha256, bytes }", record.line
        raise refusal("journal", file=LOG, line=line, found="another", allowed=allowed, remedy=REPAIR_REMEDY) from error


def _frame_problem(folder: Path, frame: Frame) -> str | None:
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
    stored = (f"{name}/{p.name}" for name in FRAME_FOLDERS for p in sorted((Path(folder) / name).glob("*.png")))
    return [name for name in stored if name not in named]


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


IN_MOTION, ENDS_OF_MOTION = {"created", "gap", "intent", "verified"}, {"homed", "moved", "verified"}
"""Events after which, and before which, a single lost line may be part of a motion: one has two lines at least."""


def _in_written_order(records: list[Record]) -> list[Record]:
    """Whole lines by their numbers, which their checksums hold; as they stand where two have one number."""
    numbers = {record.number for record in records}
    return sorted(records, key=lambda record: record.number) if len(numbers) == len(records) else records


def repair(folder: Path, to: Path) -> Repair:
    """Copies what is whole into a new folder; the old one stays as it is.

    Whole lines that stand in another order than they were written in are put back into it. Where lines are missing a
    `gap` event stands: what followed it without a new homing cannot be trusted, because nobody knows which motion is
    missing; one that says that it lost no motion leaves the rest its worth. Frames that
    are not what their event says are left out and named.

    Raises:
        InputError: nothing whole, or `to` holds something.
    """
    folder, to = Path(folder), Path(to)
    data = read_log(folder)
    lines = [parse_line(line, place) for place, line in enumerate(data.split(b"\n")[:-1], start=1)]
    done = Repair(torn_bytes=len(data) - data.rfind(b"\n") - 1)
    events = _in_written_order([line for line in lines if isinstance(line, Record)])
    done.lost_lines = [place for place, line in enumerate(lines, start=1) if isinstance(line, str)]
    if not events:
        allowed, remedy = "at least one whole line", "take the campaign again"
        raise refusal("journal", file=LOG, found="nothing whole", allowed=allowed, remedy=remedy)
    make_folder(to, empty=True)
    first = events[0].data if events[0].event == "created" else {}
    created = {key: value for key, value in first.items() if key != "format"}
    journal = Journal.create(to, **{**created, "repaired": True})
    expected, ended, last = 1 if first else 0, False, "created"
    named: set[str] = set()
    try:
        for record in events[1:] if first else events:
            if record.number != expected:
                lost = record.number - expected != 1 or last in IN_MOTION or record.event in ENDS_OF_MOTION
                journal.append("gap", before_line=record.line, **({} if lost else {"motion_lost": False}))
            expected, last = record.number + 1, record.event
            kept = []
            for frame in frames_of(record):
                twice = frame.name in named
                named.add(frame.name)
                if not twice and _frame_problem(folder, frame) is None:
                    kept.append(journal.store(frame.name, read_bytes(folder / frame.name, FRAME_BYTES_MAX, folder)))
                else:
                    done.lost_frames.append(frame.name)
            content = {key: value for key, value in record.data.items() if key != "frames"}
            if "frames" in record.data:
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

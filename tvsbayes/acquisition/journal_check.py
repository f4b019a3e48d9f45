"""A journal checked, with its frames and the campaign files beside it; the intact lines of a damaged one copied.

CRC and chain detect accidents; they do not prevent forgery. A missing end leaves no trace in the lines; but a run that
ended by itself has a `stop` event, and frames without an event are listed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tvsbayes.acquisition.journal import (
    EMPTY_REMEDY,
    FRAME_BYTES_MAX,
    LOG,
    REPAIR_REMEDY,
    Frame,
    Journal,
    Record,
    damaged,
    orphans,
    parse_line,
    read_journal,
    read_log,
    require_journal,
)
from tvsbayes.acquisition.recorder import Recorded, Stop, event_of, recorded
from tvsbayes.acquisition.run_log import campaign_of, write_derived
from tvsbayes.errors import InputError, refusal
from tvsbayes.files.disk import make_folder, read_bytes
from tvsbayes.files.documents import TOML_BYTES_MAX, parse_toml
from tvsbayes.instrument.campaign import Campaign, read_campaign
from tvsbayes.instrument.campaign_header import parse_header
from tvsbayes.instrument.rig import parse_rig_table
from tvsbayes.instrument.stereo_pair import read_stereo

IN_MOTION, ENDS_OF_MOTION = {"created", "gap", "intent", "verified"}, {"homed", "moved", "verified"}
"""Events after and before which a single lost line may belong to a motion, which has at least two lines."""


@dataclass(frozen=True)
class Verification:
    """The result of a check of a journal and its frames; damage raises instead.

    Attributes:
        records: number of events.
        frames: number of frames whose SHA-256 was compared.
        orphans: frames without an event, from a look that a crash interrupted.
        torn_bytes: length of an incomplete last line.
        stopped: reason of the last `stop`, None where the run did not end by itself.
        warnings: for the user.
    """

    records: int
    frames: int
    orphans: tuple[str, ...]
    torn_bytes: int
    stopped: str | None
    warnings: list[str]


def _first(names: Iterable[object]) -> str:
    """The first five names."""
    names = list(names)
    return ", ".join(map(str, names[:5])) + ", ..." * (len(names) > 5)


def _frame_problem(folder: Path, frame: Frame) -> str | None:
    """The fault of a stored frame, None for none."""
    try:
        data = read_bytes(folder / frame.name, FRAME_BYTES_MAX, folder)
    except InputError as error:
        return error.found or "unreadable"
    if len(data) != frame.size or hashlib.sha256(data).hexdigest() != frame.sha256:
        return "a file with another SHA-256 than when it was taken"
    return None


def verify(folder: Path) -> Verification:
    """Reads the journal of a folder and compares every frame with its SHA-256.

    Raises:
        InputError: damage, with line number and remedy.
    """
    folder = Path(folder)
    reading = read_journal(folder)
    names: set[str] = set()
    for record in reading.records:
        for frame in record.frames:
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
    end = event_of(reading.records[-1], Stop) if reading.records else None
    missing, warnings = orphans(folder, reading.records), []
    if reading.torn:
        warnings.append(f"{LOG} ends in {len(reading.torn)} bytes of an unfinished line, which --resume cuts off")
    if missing:
        warnings.append(f"{len(missing)} frames without an event, of interrupted looks: {_first(missing)}")
    if not reading.records:
        warnings.append(f"{LOG} holds no event; {EMPTY_REMEDY}")
    elif end is None:
        warnings.append("the run did not end by itself: go on with tvsbayes acquire --resume")
    stopped = None if end is None else end.reason
    return Verification(len(reading.records), len(names), tuple(missing), len(reading.torn), stopped, warnings)


def check_journal(folder: Path) -> dict[str, object]:
    """Verifies the journal of a campaign folder and compares the campaign files with it.

    `moves` and `looks` of the document count the journal's entries; without a move there is no campaign yet.

    Raises:
        InputError: damage, with line number.
    """
    checked = verify(folder)
    records = read_journal(folder).records
    record, warnings = recorded(records), list(checked.warnings)
    if gaps := [r.line for r in records if r.event == "gap"]:
        warnings.append(
            f"a repair left gaps in lines {_first(gaps)}, and {len(record.ignored_lines)} events after them do not "
            "count: acquire --resume takes lost looks again"
        )
    for segment, (pan, tilt) in sorted(record.lost.items()):
        warnings.append(f"segment {segment}: {pan} and {tilt} steps were lost; its spots do not count")
    if record.unverified:
        names = ", ".join(map(str, record.unverified))
        warnings.append(
            f"whether steps were lost in segment {names} is not known: the run or the device was interrupted"
        )
    if record.moves or (folder / "campaign.toml").is_file():
        warnings += _compared(record, read_campaign(folder), empty=not records)
    else:
        warnings.append("no homing has been logged: there is no campaign yet")
    return {
        "records": checked.records,
        "frames": checked.frames,
        "stopped": checked.stopped,
        "warnings": warnings,
        "moves": len(record.moves),
        "looks": len(record.looks),
    }


def _compared(record: Recorded, present: Campaign, empty: bool) -> list[str]:
    """Warnings of rows that are missing in the tables of a campaign or in its journal."""
    moves, looks = len(record.moves) - len(present.moves), len(record.looks) - len(present.spots)
    warnings = []
    if moves > 0 or looks > 0:
        warnings.append(
            f"moves.csv and spots.csv are {max(moves, 0)} moves and {max(looks, 0)} looks behind the journal: "
            "acquire --resume writes them again"
        )
    if moves < 0 or looks < 0:
        remedy = EMPTY_REMEDY if empty else "acquire --resume takes lost looks again and keeps the tables"
        warnings.append(
            f"lost looks: the end of {LOG} is missing, {max(-looks, 0)} looks and {max(-moves, 0)} moves that "
            f"spots.csv and moves.csv have are not in it. Copy the folder, and bring {LOG} back from a backup if there "
            f"is one; else {remedy}"
        )
    return warnings


def behind_journal(folder: Path, present: Campaign) -> str:
    """A message about looks of the journal that spots.csv lacks; "" for none or without a journal.

    `check_journal` reports a damaged journal.
    """
    try:
        require_journal(folder, "")
        record = recorded(read_journal(folder).records)
    except InputError:
        return ""
    missing = sorted({spot.spot for spot in record.looks} - {spot.spot for spot in present.spots})
    if not missing:
        return ""
    looks = f"look{'s' * (len(missing) > 1)} {_first(missing)}"
    return f"spots.csv lacks {looks}, which {LOG} holds: the run was killed; acquire --resume writes the tables again"


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


def repair(folder: Path, to: Path) -> Repair:
    """Copies the intact lines into a new folder; the old folder is unchanged.

    Intact lines are sorted by their numbers, which their checksums cover; in file order where a number is repeated. A
    `gap` event replaces missing lines: events after it do not count until a new homing, because an unknown motion may
    be missing, unless the event states that no motion was lost. Frames that differ from their event are left out and
    listed.

    Raises:
        InputError: no intact line, or `to` is not empty.
    """
    folder, to = Path(folder), Path(to)
    data = read_log(folder)
    lines = data.split(b"\n")
    parsed = [parse_line(line, number) for number, line in enumerate(lines[:-1], start=1)]
    events = [line for line in parsed if isinstance(line, Record)]
    result = Repair(torn_bytes=len(lines[-1]))
    result.lost_lines = [number for number, line in enumerate(parsed, start=1) if isinstance(line, str)]
    if not events:
        raise damaged(None, "nothing whole", "at least one whole line", "take the campaign again")
    if len({record.number for record in events}) == len(events):
        events.sort(key=lambda record: record.number)
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
            for frame in record.frames:
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
            stopped = record.event == "stop"
        if not stopped:
            journal.append("gap", before_line=len(parsed) + 1)
    finally:
        journal.close()
    result.kept = len(events)
    return result


def repair_campaign(folder: Path, to: Path) -> dict[str, object]:
    """Copies the intact lines of a journal into a new folder, and writes their campaign there.

    Moves and looks after a gap without a new homing stay in the journal, are not used, and are counted separately.

    Raises:
        InputError: no journal, no intact line, a folder that is not empty, or campaign files that are damaged too.
    """
    require_journal(folder, "only folders written by `tvsbayes acquire` have a journal to repair")
    # Rig, stereo and header are in other files, written once and not changed since.
    keys = parse_toml(read_bytes(folder / "campaign.toml", TOML_BYTES_MAX, folder), "campaign.toml")
    stereo = read_stereo(folder / "stereo.json", folder=folder)
    settings = Campaign((), (), stereo, parse_rig_table(keys.table("rig")), parse_header(keys))
    result = repair(folder, to)
    records = read_journal(to).records
    record = recorded(records)
    if record.moves:
        write_derived(campaign_of(record, settings), to)
    ignored = [r.event for r in records if r.line in set(record.ignored_lines)]
    return {
        **asdict(result),
        "moves": len(record.moves),
        "looks": len(record.looks),
        "moves_not_counted": ignored.count("moved"),
        "looks_not_counted": ignored.count("looked"),
    }

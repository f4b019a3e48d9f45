"""The campaign files beside a journal: derived from it at any time, copied if edited, and repaired with it.

`moves.csv` and `spots.csv` follow `log.jsonl` and can be derived again; `campaign.toml` and `stereo.json` are written
once a homing is logged. A reader finds a complete campaign at any moment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from tvsbayes.acquisition.journal import EMPTY_REMEDY, LOG, read_journal, require_journal
from tvsbayes.acquisition.journal_check import repair, verify
from tvsbayes.acquisition.recorder import LOST_STEPS, Recorded, recorded
from tvsbayes.errors import InputError
from tvsbayes.files.csv_table import CSV_BYTES_MAX
from tvsbayes.files.disk import read_bytes, write_atomically
from tvsbayes.files.documents import TOML_BYTES_MAX, parse_toml
from tvsbayes.instrument.campaign import (
    UNDETECTED,
    Campaign,
    Look,
    Spot,
    campaign_toml,
    moves_bytes,
    parse_moves,
    parse_spots,
    read_campaign,
    spots_bytes,
)
from tvsbayes.instrument.campaign_header import parse_header
from tvsbayes.instrument.rig import parse_rig_table
from tvsbayes.instrument.stereo_pair import read_stereo, stereo_bytes

DERIVED = ("campaign.toml", "stereo.json", "moves.csv", "spots.csv", "truth.json")


def campaign_of(record: Recorded, settings: Campaign) -> Campaign:
    """The campaign of a journal with the stereo calibration, rig and header of `settings`."""
    return Campaign(record.moves, record.spots, settings.stereo, settings.rig, settings.header)


def write_derived(campaign: Campaign, folder: Path, tables_only: bool = False) -> None:
    """Writes the four campaign files, or only the growing tables, so that the folder is readable at any moment.

    Moves are written before spots: a spot never names a missing move. Spots that `detect` has found in pending frames
    keep that result. A file that is up to date is not written again.

    Raises:
        InputError: the folder cannot be written.
    """
    folder = Path(folder)
    for name, data in _files(campaign, folder, tables_only).items():
        if not _has_content(folder / name, data):
            write_atomically(folder / name, data)


def _has_content(path: Path, data: bytes) -> bool:
    try:
        return path.read_bytes() == data
    except OSError:
        return False


def _files(campaign: Campaign, folder: Path, tables_only: bool = False) -> dict[str, bytes]:
    detected = _detected(campaign, folder)
    spots = [
        detected[spot.spot] if spot.status == UNDETECTED and spot.spot in detected else spot for spot in campaign.spots
    ]
    moves, table = moves_bytes(campaign.moves), spots_bytes(spots)
    if campaign.moves:
        parse_spots(table, "spots.csv", parse_moves(moves), campaign.stereo_pair)
    files = {"moves.csv": moves, "spots.csv": table}
    if tables_only:
        return files
    return {"stereo.json": stereo_bytes(campaign.stereo_pair), **files, "campaign.toml": campaign_toml(campaign)}


def keep_edited(campaign: Campaign, folder: Path) -> dict[str, Path]:
    """Copies campaign files with more content than the journal, before they are written again.

    A user may have refused spots or added readings or priors. Tables that only lack the latest rows are not copied:
    a run leaves them in this state.

    Args:
        campaign: from the journal.
        folder: campaign folder.

    Returns:
        The copies made, by the name of the file: `spots.edited-1.csv` and so on, or `spots.longer-1.csv` where the
        table only has more rows than the journal, as after a loss of the journal's end.
    """
    folder, copies = Path(folder), {}
    longer = _extra_rows(campaign, folder)
    for name, data in _files(campaign, folder).items():
        path = folder / name
        if not path.is_file():
            continue
        present = read_bytes(path, CSV_BYTES_MAX, folder)
        if not set(present.splitlines()) - set(data.splitlines()):
            continue
        kind, number = "longer" if name in longer else "edited", 1
        while (copy := path.with_name(f"{path.stem}.{kind}-{number}{path.suffix}")).exists():
            number += 1
        write_atomically(copy, present)
        copies[name] = copy
    return copies


def _extra_rows(campaign: Campaign, folder: Path) -> dict[str, int]:
    """Number of additional rows of tables that have all rows of the journal and more, by name.

    The journal records lost steps only at the end of a segment, so that a status may be older or newer.
    """
    try:
        present = read_campaign(folder)
    except InputError:
        return {}

    def same(table: Sequence[Look], journal: Sequence[Look]) -> bool:
        return len(table) == len(journal) and all(map(_same_look, table, journal))

    moves, looks = len(campaign.moves), len(campaign.spots)
    extra_rows = {
        "moves.csv": len(present.moves) - moves if present.moves[:moves] == campaign.moves else 0,
        "spots.csv": len(present.spots) - looks if same(present.spots[:looks], campaign.spots) else 0,
    }
    return {name: rows for name, rows in extra_rows.items() if rows > 0}


def _same_look(row: Look, journal: Look) -> bool:
    """Whether a row of spots.csv is the journal's look, regardless of later changes by `detect` or a homing."""
    if journal.status == UNDETECTED and row.spot == journal.spot:
        return True
    lost = LOST_STEPS in (row.status, journal.status)
    return replace(row, status=journal.status) == journal if lost else row == journal


def _detected(campaign: Campaign, folder: Path) -> dict[int, Spot]:
    """Spots that are undetected in the journal and that `detect` has found since, from the present spots.csv."""
    if not (folder / "spots.csv").is_file() or all(spot.status != UNDETECTED for spot in campaign.spots):
        return {}
    waiting = {spot.spot: spot for spot in campaign.spots if spot.status == UNDETECTED}
    try:
        data = read_bytes(folder / "spots.csv", CSV_BYTES_MAX, folder)
        present = parse_spots(data, "spots.csv", campaign.moves, campaign.stereo_pair)
    except InputError:
        return {}
    return {
        spot.spot: spot
        for spot in present
        if spot.spot in waiting and spot.move == waiting[spot.spot].move and spot.status != UNDETECTED
    }


def check_journal(folder: Path) -> dict[str, object]:
    """Verifies the journal of a campaign folder and compares the campaign files with it.

    `moves` and `looks` of the document count the journal's entries; without a move there is no campaign yet.

    Raises:
        InputError: damage, with line number.
    """
    checked = verify(folder)
    reading = read_journal(folder)
    record = recorded(reading.records)
    warnings = checked.warnings
    gaps = [r.line for r in reading.records if r.event == "gap"]
    if gaps:
        warnings.append(
            f"a repair left gaps in lines {', '.join(map(str, gaps[:5]))}{', ...' * (len(gaps) > 5)}, and "
            f"{len(record.ignored_lines)} events after them do not count: acquire --resume takes lost looks again"
        )
    for segment, deviation in record.lost:
        warnings.append(f"segment {segment}: {deviation[0]} and {deviation[1]} steps were lost; its spots do not count")
    if record.unverified:
        names = ", ".join(map(str, record.unverified))
        warnings.append(
            f"whether steps were lost in segment {names} is not known: the run or the device was interrupted"
        )
    if record.moves or (folder / "campaign.toml").is_file():
        warnings += _compared(record, read_campaign(folder), empty=not checked.records)
    else:
        warnings.append("no homing has been logged: there is no campaign yet")
    return {
        "records": checked.records,
        "frames": checked.frames,
        "stopped": checked.stopped,
        "warnings": warnings,
        "moves": len(record.moves),
        "looks": len(record.spots),
    }


def _compared(record: Recorded, present: Campaign, empty: bool) -> list[str]:
    """Warnings of rows that are missing in the tables of a campaign or in its journal."""
    moves, looks = len(record.moves) - len(present.moves), len(record.spots) - len(present.spots)
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
    missing = sorted({spot.spot for spot in record.spots} - {spot.spot for spot in present.spots})
    if not missing:
        return ""
    names = ", ".join(map(str, missing[:5])) + (", ..." if len(missing) > 5 else "")
    looks = f"look{'s' * (len(missing) > 1)} {names}"
    return f"spots.csv lacks {looks}, which {LOG} holds: the run was killed; acquire --resume writes the tables again"


def repair_campaign(folder: Path, to: Path) -> dict[str, object]:
    """Copies the intact lines of a journal into a new folder, and writes their campaign there.

    Moves and looks after a gap without a new homing stay in the journal, are not used, and are counted separately.

    Raises:
        InputError: no journal, no intact line, a folder that is not empty, or campaign files that are damaged too.
    """
    require_journal(folder, "only folders written by `tvsbayes acquire` have a journal to repair")
    # Rig, stereo and header are in other files, written once and not changed since.
    settings = _settings_of(folder)
    result = repair(folder, to)
    records = read_journal(to).records
    record = recorded(records)
    if record.moves:
        write_derived(campaign_of(record, settings), to)
    ignored = set(record.ignored_lines)
    return {
        **asdict(result),
        "moves": len(record.moves),
        "looks": len(record.spots),
        "moves_not_counted": sum(r.event == "moved" for r in records if r.line in ignored),
        "looks_not_counted": sum(r.event == "looked" for r in records if r.line in ignored),
    }


def _settings_of(folder: Path) -> Campaign:
    """Stereo calibration, rig and header of a campaign whose tables may be damaged."""
    keys = parse_toml(read_bytes(folder / "campaign.toml", TOML_BYTES_MAX, folder), "campaign.toml")
    stereo = read_stereo(folder / "stereo.json", folder=folder)
    return Campaign((), (), stereo, parse_rig_table(keys.table("rig")), parse_header(keys))

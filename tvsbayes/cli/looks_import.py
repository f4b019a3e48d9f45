"""`import` of a table of moves and looks, or of a lab book with its pictures, into a campaign."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tvsbayes.cli.app import CAMERAS, report_line, write_files
from tvsbayes.cli.begin_commands import COPYING, has_rows, refuse_other_size
from tvsbayes.cli.confirmed_import import Import, occupied
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import InputError, escaped, refusal, typed
from tvsbayes.files.csv_table import CSV_BYTES_MAX
from tvsbayes.files.disk import make_folder, new_folder, read_bytes
from tvsbayes.files.documents import toml_line
from tvsbayes.importing.asking import listed
from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.columns import table_document, table_lines
from tvsbayes.importing.looks import FIELDS, LookRows, look_columns, look_rows, open_fields
from tvsbayes.importing.reader import read_foreign
from tvsbayes.instrument.axes import SENSES
from tvsbayes.progress import Job

if TYPE_CHECKING:
    from tvsbayes.cameras.book_pictures import BookedPictures
    from tvsbayes.instrument.campaign import Move, Spot
    from tvsbayes.instrument.corrections import Correction

CORRECT_HINT = ", or correct it with --column"


def import_looks(
    file: Path,
    to: Path,
    sheet: str | None,
    wishes: Wishes,
    correction: Correction,
    pictures: Path | None,
    globs: tuple[str, str] | None,
    interactive: bool,
) -> Import:
    """Import a table of moves and looks; columns that are missing are asked for where `interactive`."""
    from tvsbayes.instrument.campaign import Move, Spot, stereo_spots
    from tvsbayes.instrument.corrections import corrected

    known = _known_moves(to)
    table = read_foreign(file, sheet)
    chooser = look_columns(table, wishes.columns)
    if interactive and (wanted := open_fields(chooser, known is not None)):
        answers = dict(wishes.columns)
        report_line(f"{chooser.table.file} has the columns {', '.join(map(escaped, chooser.table.columns))}")
        for name in wanted:
            answers[name] = typer.prompt(f"which of them is {name}? (empty: none)", default="", show_default=False)
        wishes = replace(wishes, columns=answers)
        chooser = look_columns(table, answers)
    table = chooser.table
    rows = look_rows(chooser, wishes, None if known is None else len(known))
    moves = None if rows.moves is None else tuple(Move(**row) for row in rows.moves)
    looks = None if rows.looks is None else tuple(Spot(**row) for row in rows.looks)
    changed = corrected(moves, looks, correction, None if known is None else len(known))
    moves, spots = changed.moves, None if changed.spots is None else stereo_spots(changed.spots)
    _refuse_rows(to, moves, spots)
    booked = None
    if pictures is not None:
        booked = _booked(rows, spots or (), moves or known or (), pictures, globs, table.file)
        refuse_other_size(to, booked.image_sizes)
    assumed = [*rows.assumed, *changed.changes]
    if rows.created is not None and not (to / "campaign.toml").is_file():
        assumed.append(f"created: {rows.created.isoformat()}, the time of the first row, is time_s = 0")
    if booked is not None and booked.by_direction:
        what = f"{booked.by_direction} names stand in several folders: that of the direction of the experiment's move"
        assumed.append(f"pictures: {what} is taken; a column of directions, or the folder in the name, says it surely")
    ok = sum(spot.status == "ok" for spot in spots or ())
    lines = table_lines(table, rows.understood, FIELDS, rows.units)
    lines += [f"assumed: {text}" for text in assumed]
    counts = [] if moves is None else [f"{len(moves)} moves"]
    counts += [] if spots is None else [f"{len(spots)} looks, {ok} with a spot"]
    counts += [] if booked is None else [f"{len(booked.pictures)} of them with pictures"]
    lines.append(f"gives: {', '.join(counts)}")
    warnings = [] if booked is None else _left_out(booked, spots or ())
    lines += [f"not used: {text}" for text in warnings]
    turned = [] if booked is None else _turned(booked)
    lines += [f"warning: {text}" for text in turned]
    document: dict[str, Any] = {
        **table_document(table, rows.understood),
        "assumed": assumed,
        "moves": None if moves is None else len(moves),
        "spots": None if spots is None else len(spots),
        "ok": None if spots is None else ok,
        "campaign": str(to),
    }
    document |= {} if booked is None else {"pictures": 2 * len(booked.pictures), "warnings": [*warnings, *turned]}
    waits = any(spot.status == "undetected" for spot in spots or ())
    return Import(
        lines,
        document,
        lambda: _write(to, moves, spots, rows.created, booked),
        _next_step(to, waits and booked is not None),
        CORRECT_HINT,
    )


def _known_moves(to: Path) -> tuple[Move, ...] | None:
    """The moves of a campaign; None if there is only the template's row."""
    from tvsbayes.instrument.campaign import campaign_templates, parse_moves

    if not (file := to / "moves.csv").is_file():
        return None
    data = read_bytes(file, CSV_BYTES_MAX)
    if not (to / "campaign.toml").is_file() or data == campaign_templates()["moves.csv"]:
        return None
    try:
        return parse_moves(data, str(file))
    except InputError as error:
        if error.found != "an empty cell" or error.column not in ("pan_steps", "tilt_steps"):
            raise
        remedy = "fill them in there; or, if FILE is the log of the moves, import it --to a new folder"
        remedy += ", then `tvsbayes new` that folder with --pictures FOLDER"
        raise refusal(
            error.code,
            file=escaped(str(file), 200),
            line=error.line,
            column=error.column,
            found=error.found,
            allowed="counters of all moves",
            remedy=remedy,
        ) from error


def _refuse_rows(to: Path, moves: object, spots: object) -> None:
    """Refuse a folder whose tables have rows: nothing is overwritten."""
    if to.exists() and not (to / "campaign.toml").is_file():
        make_folder(to, empty=True, but=CAMERAS)
    if moves is not None and _known_moves(to) is not None:
        raise occupied(to / "moves.csv", "moves")
    if spots is not None and has_rows(to):
        raise occupied(to / "spots.csv", "looks")


def _booked(
    rows: LookRows,
    spots: Sequence[Spot],
    moves: Sequence[Move],
    folder: Path,
    globs: tuple[str, str] | None,
    file: str,
) -> BookedPictures:
    """The pictures that a lab book names."""
    from tvsbayes.cameras.book_pictures import BookRow, pictures_of_book
    from tvsbayes.cameras.picture_pairs import direction_of
    from tvsbayes.instrument.experiments import experiments_of

    if not rows.pictures:
        raise refusal(
            "missing-column",
            file=file,
            found="no column that names pictures of looks",
            allowed="a column of pictures, or of left and right pictures, of looks without centres",
            remedy="say which: --column picture=NAME, or --column picture_left=NAME --column picture_right=NAME; or "
            "leave out --pictures",
        )
    order = sorted(range(len(spots)), key=lambda row: (spots[row].move, spots[row].spot))
    counters = [(moves[spot.move].pan_steps, moves[spot.move].tilt_steps) for spot in spots]
    numbered = [spot.experiment for spot in spots], [spot.point for spot in spots]
    directions = {row: key[0] for key, own in experiments_of(*numbered, counters, order) for row in own}
    written = [
        next(filter(None, map(direction_of, re.findall("[a-z]+", text.lower()))), None) for text in rows.directions
    ]
    looks = zip(spots, rows.lines, rows.pictures, strict=True)
    book = [
        BookRow(s.spot, line, names, written[k] or "", directions.get(k) or "")
        for k, (s, line, names) in enumerate(looks)
    ]
    return pictures_of_book(book, folder, file, globs)


def _left_out(booked: BookedPictures, spots: Sequence[Spot]) -> list[str]:
    """Names without pictures and pictures without a look, a line for each kind."""
    without = [f"{spot.spot}" for spot in spots if spot.spot not in booked.pictures]
    kinds = {
        "named by the book, and no such pair of pictures": booked.missing,
        "not named by the book": booked.left_over,
        "of a kind that is not read; save them as PNG of 8 bits": booked.unread,
        "looks without pictures": without if len(without) > len(booked.missing) else (),
    }
    return [f"{len(names)} {reason}: {listed(names)}" for reason, names in kinds.items() if names]


def _turned(booked: BookedPictures) -> list[str]:
    """Directions that names of pictures, or the book, and counters state in opposite senses, a line for each axis."""
    lines = []
    for axis, ways in SENSES.items():
        if count := sum(booked.turned.get(way, 0) for way in ways):
            lines.append(
                f"of {count} looks the counters of {axis} move to the other side than the book or the name of the "
                f"picture says: left and up count up; --flip {axis}_steps writes the other sign"
            )
    return lines


def _next_step(to: Path, waits: bool) -> str:
    """The commands after an import."""
    steps = f"`tvsbayes check {typed(to)}`"
    if waits:
        steps = f"`tvsbayes detect {typed(to)}`, then {steps}"
    if not (to / "stereo.json").is_file():
        cameras = f"tvsbayes stereo --import CALIBRATION -o {typed(to / 'stereo.json')}"
        steps = f"`{cameras}`, or of pictures of a board, then {steps}"
    return steps


def _write(
    to: Path,
    moves: Sequence[Move] | None,
    spots: Sequence[Spot] | None,
    created: datetime.datetime | None,
    booked: BookedPictures | None,
) -> list[str]:
    """Write the tables, pictures before looks, and templates of the other files where they are missing."""
    from tvsbayes.cameras.look_pictures import copy_frames
    from tvsbayes.instrument.campaign import campaign_templates, moves_bytes, spots_bytes

    # Another import may have filled it since the question.
    _refuse_rows(to, moves, spots)
    contents = {} if moves is None else {"moves.csv": moves_bytes(moves)}
    # Looks are written last: a folder that lists them has all their pictures.
    contents |= {} if spots is None else {"spots.csv": spots_bytes(spots)}
    pictures = [] if booked is None else [str(to / "frames")]

    def bring(folder: Path) -> None:
        if booked is not None:
            with waiting() as progress, Job({COPYING: 1.0}, progress) as job:
                job.begin(COPYING)
                copy_frames(booked.pictures, folder, job.at)

    if (to / "campaign.toml").is_file():
        bring(to)
        return [*write_files(to, contents), *pictures]
    templates = campaign_templates()
    if created is not None:
        line = toml_line("created", created).encode()
        templates["campaign.toml"] = re.sub(rb"(?m)^# created = [^\n]*$", line, templates["campaign.toml"], count=1)
    with new_folder(to, but=CAMERAS) as prepared:
        bring(prepared)
        write_files(prepared, templates | contents)
    return [*(str(to / name) for name in contents), *pictures]

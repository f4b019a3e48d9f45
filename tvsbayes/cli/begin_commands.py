"""The command that creates a campaign: new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from tvsbayes.cli.app import CAMERAS, Json, check_word, finish, refuse_options, write_new
from tvsbayes.cli.instruments import INSTRUMENTS
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import InputError, escaped, listed, refusal, typed
from tvsbayes.files.csv_table import CSV_BYTES_MAX, csv_bytes
from tvsbayes.files.disk import read_bytes, write_atomically, write_folder
from tvsbayes.importing.asking import listed as named
from tvsbayes.instrument.mechanisms import WORDS
from tvsbayes.progress import Job

if TYPE_CHECKING:
    from tvsbayes.cameras.look_pictures import PairedLooks, ViewedFolder
    from tvsbayes.instrument.campaign import Move, Spot

COPYING = "copying pictures"
NAMES_LISTED = 6
"""Largest number of unpaired files or numbers in a line."""


def new(
    out: Annotated[Path, Argument(metavar="OUT", help="Folder to create; with --pictures also one of `new`.")],
    axis: Annotated[bool, Option("--axis", help="One axis and its readings, no optics.")] = False,
    mechanism: Annotated[
        str, Option(help="two-mirror (the scanner), or pan-tilt: a head, seen by a stereo pair.")
    ] = "two-mirror",
    sightings: Annotated[
        bool, Option("--sightings", help="With pan-tilt: the head's own camera says where it points.")
    ] = False,
    pictures: Annotated[Path | None, Option(help="Folder of spot pictures, left and right or side by side.")] = None,
    pair: Annotated[str | None, Option(help="number: in the name, that of the move; order: of the names.")] = None,
    swap: Annotated[bool, Option("--swap", help="Wide pictures hold the left camera's on the right.")] = False,
    left: Annotated[
        str | None, Option(help='Pictures of the left camera: "a/*.png"; as --right: side by side.')
    ] = None,
    right: Annotated[str | None, Option(help="Likewise of the right camera.")] = None,
    as_json: Json = False,
) -> None:
    """An empty campaign, explained in campaign.toml, and a rig file. With --pictures: its looks and their frames."""
    from tvsbayes.instrument.campaign import campaign_templates

    if pictures is None:
        refuse_options(
            "for pictures", "add --pictures FOLDER, or leave it out", pair=pair, swap=swap, left=left, right=right
        )
    check_word("--mechanism", mechanism, WORDS, "name one of them")
    is_head = mechanism != WORDS[0]
    if sightings and not is_head:
        raise InputError("usage", "--sightings are those of a head", remedy="add --mechanism pan-tilt")
    if axis:
        INSTRUMENTS["axis"].carry_out(
            "new", out, pictures=pictures, mechanism=is_head, sightings=sightings, as_json=as_json
        )
        return
    if is_head:
        refuse_options("for a scanner", "leave it out, and copy what `tvsbayes new` makes", pictures=pictures)
        from tvsbayes.cli.head_commands import head_templates

        tables = "log moves and sightings" if sightings else "put stereo.json beside them, log moves and spots"
        write_new(out, head_templates(sightings), f"{tables}, then `tvsbayes check` this folder", as_json)
        return
    if pictures is not None:
        _with_pictures(out, pictures, pair, swap, stated_globs(left, right, swap), as_json)
        return
    next_steps = (
        "put stereo.json beside them, log moves and spots, then `tvsbayes check` this folder\n"
        "pictures of the spots: fill in moves.csv, then `tvsbayes new` this folder again with --pictures FOLDER\n"
        "a table of your own: `tvsbayes import FILE --to` this folder"
    )
    write_new(out, campaign_templates(), next_steps, as_json)


def stated_globs(left: str | None, right: str | None, swap: bool) -> tuple[str, str] | None:
    """The patterns of both cameras, as --left and --right state them."""
    if (left is None) != (right is None):
        remedy = 'give both: --left "cam_a/*.png" --right "cam_b/*.png"'
        raise InputError("usage", "--left and --right: one of both is missing", remedy=remedy)
    if left is None or right is None:
        return None
    if left != right:
        refuse_options("of no use beside --left and --right", "leave it out, or exchange them", swap=swap)
    return left, right


def _with_pictures(
    out: Path, folder: Path, pair: str | None, swap: bool, globs: tuple[str, str] | None, as_json: bool
) -> None:
    """Add looks and frames of a folder of pictures to a new campaign or one without pictures."""
    from tvsbayes.cameras.look_pictures import copy_frames, pair_looks, views_of
    from tvsbayes.instrument.campaign import campaign_templates, spots_bytes

    check_word("--pair", pair, ("number", "order"), "write --pair number or --pair order, or leave it out")
    moves_path = moves_file(out, folder)
    rows = _rows_of(out)
    views = views_of(folder, swap=swap, globs=globs)
    moves = _moves_of(moves_path)
    numbers = None if moves_path is None else range(len(moves))
    paired = pair_looks(views.views, numbers, rows, pair)  # type: ignore[arg-type]
    refuse_other_size(out, views.image_sizes)
    if not (out / "campaign.toml").is_file():
        write_folder(out, campaign_templates(), but=CAMERAS)
    if moves_path is None:
        write_atomically(out / "moves.csv", _blank_moves(1 + max(spot.move for spot in paired.spots)))
    elif moves_path.parent != out:
        write_atomically(out / "moves.csv", read_bytes(moves_path, CSV_BYTES_MAX))
    with waiting() as progress, Job({COPYING: 1.0}, progress) as job:
        job.begin(COPYING)
        copied = copy_frames(paired.pictures, out, job.at)
    # spots.csv is written last: a folder with listed looks then has all their pictures.
    write_atomically(out / "spots.csv", spots_bytes(paired.spots))
    lines = _unpaired_lines(views, paired, "spots" if rows else "moves")
    text = _paired_text(out, paired, copied, "pan_steps and tilt_steps" if moves_path is None else None, moves)
    if not rows and paired.matching == "number" and paired.renumbered is None and 0 in paired.without:
        text += (
            "\nthe numbers in the names are those of moves, which count from 0: where yours count from 1, every look "
            "is now at the move after its own, and `tvsbayes check` says so once the spots are detected"
        )
    document: dict[str, Any] = {"campaign": str(out), "looks": len(paired.pictures), "pictures": copied}
    document |= {"paired_by": paired.matching, "warnings": lines, "moves_to_fill_in": moves_path is None}
    finish(document, "\n".join([text, *(f"not paired: {line}" for line in lines)]), as_json)


def moves_file(out: Path, folder: Path) -> Path | None:
    """The file with the moves of the pictures: in the campaign or beside the pictures; None if none."""
    from tvsbayes.instrument.campaign import campaign_templates

    target, nearby = out / "moves.csv", folder / "moves.csv"
    if target.is_file() and read_bytes(target, CSV_BYTES_MAX) != campaign_templates()["moves.csv"]:
        return target
    return nearby if nearby.is_file() else None


def _moves_of(file: Path | None) -> tuple[Move | None, ...]:
    """The checked moves of a file; None for each row of a file to fill in, which is only counted."""
    from tvsbayes.instrument.campaign import parse_moves

    if file is None:
        return ()
    data = read_bytes(file, CSV_BYTES_MAX)
    rows = len(data.splitlines()) - 1
    return (None,) * rows if data == _blank_moves(rows) else parse_moves(data, str(file))


def _blank_moves(count: int) -> bytes:
    """A `moves.csv` with empty counters for the user to fill in."""
    from tvsbayes.instrument.campaign import MOVES

    rows = ((k, 0, float(k), None, None, *(("unknown",) * 2 if k == 0 else ("", ""))) for k in range(count))
    return csv_bytes(MOVES.required, rows)


def _rows_of(out: Path) -> tuple[Spot, ...]:
    """The looks that a campaign lists; none for a missing folder."""
    from tvsbayes.instrument.campaign import read_campaign, stereo_spots

    return stereo_spots(read_campaign(out).spots) if has_rows(out) else ()


def has_rows(out: Path) -> bool:
    """Whether spots.csv has rows below its header."""
    spots = out / "spots.csv"
    return spots.is_file() and len(read_bytes(spots, CSV_BYTES_MAX).splitlines()) > 1


def refuse_other_size(out: Path, sizes: dict[str, tuple[int, int]]) -> None:
    """Refuse pictures of another size than that of the calibration: they give no usable centre."""
    from tvsbayes.instrument.stereo_pair import read_stereo

    if not (out / "stereo.json").is_file():
        return
    calibrated = read_stereo(out / "stereo.json").image_sizes
    if sizes != calibrated:
        found, allowed = f"pictures of {_sizes_px(sizes)}", f"{_sizes_px(calibrated)} as in stereo.json"
        place, remedy = escaped(str(out / "stereo.json"), 200), "calibrate and observe at one image size"
        raise refusal("image-size", file=place, found=found, allowed=allowed, remedy=remedy)


def _sizes_px(sizes: Mapping[str, tuple[int, int]]) -> str:
    """Sizes of pictures in words; one where both cameras have the same size."""
    return " and ".join(f"{width} x {height} px" for width, height in dict.fromkeys(sizes.values()))


def _paired_text(
    out: Path, pairs: PairedLooks, copied: int, to_fill_in: str | None, moves: Sequence[Move | None]
) -> str:
    """Counts of pictures and looks, the rule of pairing, and the next step."""
    place = escaped(str(out), 200)
    first = next(iter(pairs.pictures.items()), None)
    method = "the number in the name" if pairs.matching == "number" else "the order of the names"
    lines = [f"{place}: {copied} pictures in frames/, {len(pairs.pictures)} looks in spots.csv, paired by {method}"]
    if first is not None:
        left, right = ("/".join(map(escaped, picture.path.parts[-2:])) for picture in first[1].pictures)
        move = next(spot.move for spot in pairs.spots if spot.spot == first[0])
        names = left if left == right else f"{left} and {right}"
        arrival = moves[move] if move < len(moves) else None
        position = "" if arrival is None else f" at pan {arrival.pan_steps}, tilt {arrival.tilt_steps} steps"
        lines.append(f"for example {names}: spot {first[0]}, seen after move {move}{position}")
    if to_fill_in is not None:
        rows = 1 + max(spot.move for spot in pairs.spots)
        lines.append(f"fill in moves.csv: {to_fill_in} of all {rows} rows, absolute counters AFTER the move")
    if pairs.renumbered is not None:
        low, high = pairs.renumbered
        lines.append(
            f"the numbers in the names, {low} to {high}, are too sparse for moves: these are renumbered in order; "
            "with a moves.csv of your own begin again: put it beside the pictures, and name another folder"
        )
    if not (out / "stereo.json").is_file():
        lines.append(
            "put stereo.json beside it: `tvsbayes stereo BOARD_PICTURES --board 9x6 --pitch-mm 25 -o stereo.json`"
        )
    lines.append(f"next: `tvsbayes detect {typed(out)}`, then `tvsbayes check {typed(out)}`")
    return "\n".join(lines)


def _unpaired_lines(views: ViewedFolder, pairs: PairedLooks, rows: str) -> list[str]:
    """Unpaired files and rows, a line for each kind."""
    files = {
        "without the picture of the other camera": views.unpaired,
        "no camera in the name, or in a folder below the pairs": views.unnamed,
        f"not of {_sizes_px(views.image_sizes)} as most": views.other_size,
        "of a kind that is not read; save them as PNG of 8 bits": views.unread,
        "a second pair for its row": pairs.left_over,
        "of no look, by its name": views.without_spot,
    }
    lines = [
        f"{len(names)} files: " * (len(names) > 1) + f"{named(names, NAMES_LISTED)}: {reason}"
        for reason, names in files.items()
        if names
    ]
    if pairs.without:
        lines.append(f"{rows} {listed(pairs.without, NAMES_LISTED)}: no pictures, which they need not have")
    return lines

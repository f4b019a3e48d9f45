"""Campaign folders spoiled as by new users, each with the command and the words that must help.

Changes are made to the text of files, with nothing of the package: an older version can be given the same folders.
"""

from __future__ import annotations

import csv
import io
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Cells = dict[str, str]
PIXELS = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")


@dataclass(frozen=True)
class WrongInput:
    """A mistake.

    Attributes:
        spoil: does it to a good campaign folder.
        command: what is called then; CAMPAIGN stands for the folder, DATA for the shipped data.
        words: in what is printed, all of them.
        code: exit code.
    """

    spoil: Callable[[Path], None]
    command: str
    words: tuple[str, ...]
    code: int


def rows(file: str, change: Callable[[int, Cells], Cells | None]) -> Callable[[Path], None]:
    """Every row of a table changed, or left out where None comes back; columns are those of the first row."""

    def spoil(folder: Path) -> None:
        table = list(csv.DictReader(io.StringIO((folder / file).read_text())))
        changed = [row for k, cells in enumerate(table) if (row := change(k, dict(cells))) is not None]
        stream = io.StringIO()
        writer = csv.DictWriter(stream, changed[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(changed)
        (folder / file).write_text(stream.getvalue())

    return spoil


def cell(file: str, row: int, **cells: str) -> Callable[[Path], None]:
    """Some cells of one row."""
    return rows(file, lambda k, old: {**old, **cells} if k == row else old)


def cells(file: str, **changes: Callable[[str], str]) -> Callable[[Path], None]:
    """Some columns of every row."""
    return rows(file, lambda _, old: {**old, **{name: change(old[name]) for name, change in changes.items()}})


def text(file: str, old: str, new: str) -> Callable[[Path], None]:
    """A pattern in a file."""

    def spoil(folder: Path) -> None:
        whole = (folder / file).read_text()
        changed = re.sub(old, new, whole, flags=re.MULTILINE)
        assert changed != whole, f"{old} is not in {file}"
        (folder / file).write_text(changed)

    return spoil


def data(file: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """The bytes of a file."""

    def spoil(folder: Path) -> None:
        (folder / file).write_bytes(change((folder / file).read_bytes()))

    return spoil


def workbook(_: bytes) -> bytes:
    """A file that a spreadsheet saved in its own format."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    return stream.getvalue()


def times(*names: str, factor: float) -> Callable[[Path], None]:
    """Pixels times a factor."""
    return cells("spots.csv", **dict.fromkeys(names, lambda value: f"{factor * float(value):.4f}"))


def exchanged(first: str, second: str) -> Callable[[int, Cells], Cells]:
    """Two columns in each other's place."""
    return lambda _, old: {**old, first: old[second], second: old[first]}


def both(*spoils: Callable[[Path], None]) -> Callable[[Path], None]:
    """One after the other."""

    def spoil(folder: Path) -> None:
        for one in spoils:
            one(folder)

    return spoil


def relative_counters(folder: Path) -> None:
    """Steps of each move instead of where it ended."""
    before = {"pan_steps": 0, "tilt_steps": 0}

    def change(_: int, old: Cells) -> Cells:
        now = {name: int(old[name]) for name in before}
        steps = {name: str(now[name] - before[name]) for name in before}
        before.update(now)
        return {**old, **steps}

    rows("moves.csv", change)(folder)


def by_sheet(folder: Path) -> None:
    """Rows of spots.csv sorted by sheet."""
    table = list(csv.DictReader(io.StringIO((folder / "spots.csv").read_text())))
    ordered = iter(sorted(table, key=lambda row: row["target"]))
    rows("spots.csv", lambda *_: next(ordered))(folder)


def matlab_table(folder: Path) -> None:
    """Counters and centres in one table, the first pixel called 1."""
    moves = list(csv.DictReader(io.StringIO((folder / "moves.csv").read_text())))
    looks = list(csv.DictReader(io.StringIO((folder / "spots.csv").read_text())))
    lines = ["pan,tilt,XL,YL,XR,YR"]
    for look in looks:
        move = moves[int(look["move"])]
        lines.append(",".join([move["pan_steps"], move["tilt_steps"], *(str(float(look[n]) + 1) for n in PIXELS)]))
    (folder / "matlab.csv").write_text("\n".join(lines) + "\n")


def nothing(_: Path) -> None:
    """The mistake is in the command."""


def semicolons(point: str) -> Callable[[bytes], bytes]:
    """A table as a spreadsheet of another country saves it."""
    return lambda old: old.replace(b",", b";").replace(b".", point.encode())


CHECK = "check CAMPAIGN"
IMPORT = "`tvsbayes import FILE --to NEW` reads it"
SPOILT = {
    # Refused by the readers.
    "semicolons, decimal commas": WrongInput(data("spots.csv", semicolons(",")), CHECK, (IMPORT,), 2),
    "semicolons, points": WrongInput(data("moves.csv", semicolons(".")), CHECK, (IMPORT,), 2),
    "UTF-16": WrongInput(data("spots.csv", lambda b: b.decode().encode("utf-16")), CHECK, ("UTF-16", IMPORT), 2),
    "a column called otherwise": WrongInput(
        text("moves.csv", "pan_steps", "pan_step"), CHECK, ("did you mean pan_steps?",), 2
    ),
    "an extra column": WrongInput(
        rows("spots.csv", lambda _, old: {**old, "comment": "x"}), CHECK, ('"comment"', "notes of campaign.toml"), 2
    ),
    "a missing column": WrongInput(
        rows("spots.csv", lambda _, old: {k: v for k, v in old.items() if k != "status"}), CHECK, ("add status",), 2
    ),
    "ratio in steps per degree": WrongInput(
        text(
            "campaign.toml", r'^"degrees_per_step.pan" = \{ value = [0-9.]+', '"degrees_per_step.pan" = { value = 16.7'
        ),
        CHECK,
        ("degrees_per_step.pan", "unit"),
        2,
    ),
    "baseline in metres": WrongInput(
        text("campaign.toml", r"^baseline_mm = \{ value = [0-9.]+", "baseline_mm = { value = 0.2"),
        CHECK,
        ("baseline_mm", "unit"),
        2,
    ),
    "moves counted from 1": WrongInput(
        cells("moves.csv", move=lambda m: str(int(m) + 1)), CHECK, ("number the rows 0, 1, 2",), 2
    ),
    "u and v exchanged": WrongInput(
        both(
            rows("spots.csv", exchanged("u_left_px", "v_left_px")),
            rows("spots.csv", exchanged("u_right_px", "v_right_px")),
        ),
        CHECK,
        ("u and v are exchanged",),
        2,
    ),
    "a blank status": WrongInput(cell("spots.csv", 3, status=""), CHECK, ("line 5, status", "fill the cell in"), 2),
    "a missing move": WrongInput(
        rows("moves.csv", lambda k, old: None if k == 5 else old), CHECK, ("line 7, move", "number the rows"), 2
    ),
    "a spot twice": WrongInput(cell("spots.csv", 3, spot="2"), CHECK, ("line 5, spot", "renumber one of them"), 2),
    "a date of a spreadsheet": WrongInput(
        cell("spots.csv", 3, u_left_px="May 96"), CHECK, ("made a date of it", "format the column as text"), 2
    ),
    "marks between thousands": WrongInput(
        cell("spots.csv", 3, u_left_px="1,024.50"), CHECK, ("without marks between thousands: 1024.50",), 2
    ),
    "a comma in campaign.toml": WrongInput(
        text("campaign.toml", r"^baseline_mm = \{ value = 200.0", "baseline_mm = { value = 200,0"),
        CHECK,
        ("campaign.toml line",),
        2,
    ),
    "Left": WrongInput(cell("moves.csv", 0, pan_approach="Left"), CHECK, ("left, right, unknown",), 2),
    "cw": WrongInput(cell("moves.csv", 0, pan_approach="cw"), CHECK, ("left, right, unknown",), 2),
    "a forgotten dot": WrongInput(
        cell("spots.csv", 3, u_left_px="64025"),
        CHECK,
        ("line 5, u_left_px", "0 to 1280 px", "a decimal point left out?"),
        2,
    ),
    "no uncertainty": WrongInput(cell("spots.csv", 3, su_left_px="0"), CHECK, ("line 5, su_left_px", "0.0001"), 2),
    "a workbook": WrongInput(data("spots.csv", workbook), CHECK, ("XLSX", IMPORT), 2),
    "an empty time": WrongInput(cell("moves.csv", 3, time_s=""), CHECK, ("line 5, time_s", "an empty cell"), 2),
    "separators at the end": WrongInput(
        data("moves.csv", lambda b: b + b",,,,,,\n" * 2), CHECK, ("a line without any value", "delete the line"), 2
    ),
    # Rightly accepted.
    "BOM and CRLF": WrongInput(
        data("spots.csv", lambda b: b"\xef\xbb\xbf" + b.replace(b"\n", b"\r\n")), CHECK, ("0 warnings",), 0
    ),
    "rows by sheet": WrongInput(by_sheet, CHECK, ("0 warnings",), 0),
    "no pose of the positioner": WrongInput(text("campaign.toml", r'^"extrinsics.*\n', ""), CHECK, ("0 warnings",), 0),
    # Warned of.
    "cameras exchanged": WrongInput(
        both(
            rows("spots.csv", exchanged("u_left_px", "u_right_px")),
            rows("spots.csv", exchanged("v_left_px", "v_right_px")),
        ),
        CHECK,
        ("are left and right swapped",),
        0,
    ),
    "T in metres": WrongInput(
        text("stereo.json", r'^ "T": \[.*$', ' "T": [-0.085, 0.0003, -0.0004],'), CHECK, ("is it in metres?",), 0
    ),
    "centres in millimetres": WrongInput(times(*PIXELS, factor=0.003), CHECK, ("are the centres in millimetres?",), 0),
    "one sheet": WrongInput(
        rows("spots.csv", lambda _, old: old if old["target"] == "d1" else None),
        CHECK,
        ("all spots lie at one depth",),
        0,
    ),
    "OK for ok": WrongInput(
        cells("spots.csv", status=str.upper), CHECK, ("their status is not spelt ok, in small letters",), 0
    ),
    # Seen by `check` as well, not by `fit` alone.
    "steps instead of counters": WrongInput(relative_counters, CHECK, ("are these the steps of each move?",), 0),
    "pictures of half the size": WrongInput(times(*PIXELS, factor=0.5), CHECK, ("half the size",), 0),
    "tilt counts down": WrongInput(
        cells("moves.csv", tilt_steps=lambda n: str(-int(n))), CHECK, ("up counts up", "other sign"), 0
    ),
    "a centre 10 px off": WrongInput(
        rows("spots.csv", lambda k, old: {**old, "u_left_px": str(float(old["u_left_px"]) + 10)} if k == 6 else old),
        CHECK,
        ("spots 6 lie apart", "a mistyped pixel"),
        0,
    ),
    "no sheet names": WrongInput(cells("spots.csv", target=lambda _: ""), CHECK, ("column target is empty",), 0),
    "sheet names mixed up": WrongInput(
        rows("spots.csv", lambda k, old: {**old, "target": "d1" if k % 7 == 0 else old["target"]}),
        CHECK,
        ("sheet of another name",),
        0,
    ),
    "pixels from 1": WrongInput(
        matlab_table,
        "import CAMPAIGN/matlab.csv --to CAMPAIGN/new --pixels-from 1 --yes",
        ("px from 1", "new/spots.csv"),
        0,
    ),
    "mirror offset in metres": WrongInput(
        text("campaign.toml", r"^mirror_offset_mm = .*$", "mirror_offset_mm = { value = 0.03, u = 0.005 }"),
        CHECK,
        ("in metres?",),
        0,
    ),
    # In the command.
    "check of the folder above": WrongInput(
        nothing, "check CAMPAIGN/..", ("campaign.toml: found no such file", "campaigns in it: mine"), 2
    ),
    "check of a part": WrongInput(nothing, "check CAMPAIGN/moves.csv", ("a part of a campaign", "check "), 2),
    "rig and plan exchanged": WrongInput(
        nothing,
        "simulate DATA/rigs/mounted/paper.csv DATA/rigs/mounted/rig.toml CAMPAIGN/new",
        ("they are swapped",),
        2,
    ),
    "an export for C": WrongInput(
        nothing, "steps-for CAMPAIGN --export C", ("header and json", "--export header for C"), 2
    ),
    "a point without a reading": WrongInput(
        nothing, "locate CAMPAIGN --pan-steps 1 --tilt-steps 2", ("missing: --aperture-deg",), 2
    ),
    "a point in metres": WrongInput(
        nothing, "steps-for CAMPAIGN --x-mm 0.5 --y-mm 0.15 --z-mm 0.04", ("are these metres?", "--x-mm 500"), 2
    ),
    "detect without rows": WrongInput(
        data("spots.csv", lambda b: b.splitlines(True)[0]),
        "detect CAMPAIGN",
        ("spots.csv has no rows", "--pictures FOLDER"),
        3,
    ),
}

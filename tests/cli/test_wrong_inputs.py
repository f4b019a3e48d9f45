"""Campaign folders spoiled as by new users: each mistake is named, with a remedy.

Changes are made to the text of files, with nothing of the package.
"""

from __future__ import annotations

import csv
import io
import re
import shutil
import zipfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from support.commands import DATA, PAPER_TWIN

Cells = dict[str, str]
Spoil = Callable[[Path], None]
PIXELS = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")


def table_of(file: Path) -> list[Cells]:
    return list(csv.DictReader(io.StringIO(file.read_text())))


def table(file: str, change: Callable[[list[Cells]], list[Cells]]) -> Spoil:
    """A table with other rows; columns are those of the first."""

    def spoil(folder: Path) -> None:
        changed = change(table_of(folder / file))
        writer = csv.DictWriter(stream := io.StringIO(), changed[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(changed)
        (folder / file).write_text(stream.getvalue())

    return spoil


def cell(file: str, row: int, **cells: str) -> Spoil:
    """Some cells of one row."""
    return table(file, lambda rows: [{**old, **cells} if k == row else old for k, old in enumerate(rows)])


def cells(file: str, **changes: Callable[[str], str]) -> Spoil:
    """Some columns of every row."""
    return table(
        file, lambda rows: [old | {name: change(old[name]) for name, change in changes.items()} for old in rows]
    )


def exchanged(*pairs: tuple[str, str]) -> Spoil:
    """Columns of spots in each other's place."""
    return table("spots.csv", lambda rows: [old | {a: old[b] for p in pairs for a, b in (p, p[::-1])} for old in rows])


def text(file: str, old: str, new: str) -> Spoil:
    """A pattern in a file."""

    def spoil(folder: Path) -> None:
        changed, count = re.subn(old, new, (folder / file).read_text(), flags=re.MULTILINE)
        assert count, f"{old} is not in {file}"
        (folder / file).write_text(changed)

    return spoil


def data(file: str, change: Callable[[bytes], bytes]) -> Spoil:
    """The bytes of a file."""
    return lambda folder: (folder / file).write_bytes(change((folder / file).read_bytes())) and None


def times(factor: float) -> Spoil:
    """Pixels times a factor."""
    return cells("spots.csv", **dict.fromkeys(PIXELS, lambda value: f"{factor * float(value):.4f}"))


def prior(name: str, value: str) -> Spoil:
    return text("campaign.toml", rf'^"?{name}"? = \{{ value = [0-9.]+', f'"{name}" = {{ value = {value}')


def workbook(_: bytes) -> bytes:
    """A file that a spreadsheet saved in its own format."""
    with zipfile.ZipFile(stream := io.BytesIO(), "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    return stream.getvalue()


def steps(rows: list[Cells]) -> list[Cells]:
    """Of each move instead of where it ended."""
    names = ("pan_steps", "tilt_steps")
    return rows[:1] + [b | {name: str(int(b[name]) - int(a[name])) for name in names} for a, b in pairwise(rows)]


def matlab_table(folder: Path) -> None:
    """Counters and centres in one table, the first pixel called 1."""
    moves, lines = table_of(folder / "moves.csv"), ["pan,tilt,XL,YL,XR,YR"]
    for look in table_of(folder / "spots.csv"):
        move = moves[int(look["move"])]
        lines.append(",".join([move["pan_steps"], move["tilt_steps"], *(str(float(look[n]) + 1) for n in PIXELS)]))
    (folder / "matlab.csv").write_text("\n".join(lines) + "\n")


def semicolons(point: bytes) -> Callable[[bytes], bytes]:
    """A table as a spreadsheet of another country saves it."""
    return lambda old: old.replace(b",", b";").replace(b".", point)


IMPORT = "`tvsbayes import FILE --to NEW` reads it"
MOVES, SPOTS = "moves.csv", "spots.csv"
REFUSED: dict[str, tuple] = {
    "semicolons, decimal commas": (data(SPOTS, semicolons(b",")), IMPORT),
    "semicolons, points": (data(MOVES, semicolons(b".")), IMPORT),
    "UTF-16": (data(SPOTS, lambda b: b.decode().encode("utf-16")), "UTF-16", IMPORT),
    "a workbook": (data(SPOTS, workbook), "XLSX", IMPORT),
    "separators at the end": (
        data(MOVES, lambda b: b + b",,,,,,\n" * 2),
        "a line without any value",
        "delete the line",
    ),
    "a column called otherwise": (text(MOVES, "pan_steps", "pan_step"), "did you mean pan_steps?"),
    "an extra column": (
        table(SPOTS, lambda rows: [{**old, "comment": "x"} for old in rows]),
        *('"comment"', "notes of campaign.toml"),
    ),
    "a missing column": (
        table(SPOTS, lambda rows: [{k: v for k, v in old.items() if k != "status"} for old in rows]),
        "add status",
    ),
    "ratio in steps per degree": (prior("degrees_per_step.pan", "16.7"), "degrees_per_step.pan", "unit"),
    "baseline in metres": (prior("baseline_mm", "0.2"), "baseline_mm", "unit"),
    "a comma in campaign.toml": (prior("baseline_mm", "200,0"), "campaign.toml line"),
    "moves counted from 1": (cells(MOVES, move=lambda m: str(int(m) + 1)), "number the rows 0, 1, 2"),
    "a missing move": (table(MOVES, lambda rows: rows[:5] + rows[6:]), "line 7, move", "number the rows"),
    "an empty time": (cell(MOVES, 3, time_s=""), "line 5, time_s", "an empty cell"),
    "Left": (cell(MOVES, 0, pan_approach="Left"), "left, right, unknown"),
    "cw": (cell(MOVES, 0, pan_approach="cw"), "left, right, unknown"),
    "u and v exchanged": (
        exchanged(("u_left_px", "v_left_px"), ("u_right_px", "v_right_px")),
        "u and v are exchanged",
    ),
    "a blank status": (cell(SPOTS, 3, status=""), "line 5, status", "fill the cell in"),
    "a spot twice": (cell(SPOTS, 3, spot="2"), "line 5, spot", "renumber one of them"),
    "a date of a spreadsheet": (cell(SPOTS, 3, u_left_px="May 96"), "made a date of it", "format the column as text"),
    "marks between thousands": (cell(SPOTS, 3, u_left_px="1,024.50"), "without marks between thousands: 1024.50"),
    "a forgotten dot": (
        cell(SPOTS, 3, u_left_px="64025"),
        *("line 5, u_left_px", "0 to 1280 px", "a decimal point left out?"),
    ),
    "no uncertainty": (cell(SPOTS, 3, su_left_px="0"), "line 5, su_left_px", "0.0001"),
}
ACCEPTED: dict[str, tuple] = {
    "BOM and CRLF": (data(SPOTS, lambda b: b"\xef\xbb\xbf" + b.replace(b"\n", b"\r\n")), "0 warnings"),
    "rows by sheet": (table(SPOTS, lambda rows: sorted(rows, key=lambda row: row["target"])), "0 warnings"),
    "no pose of the positioner": (text("campaign.toml", r'^"extrinsics.*\n', ""), "0 warnings"),
    "cameras exchanged": (
        exchanged(("u_left_px", "u_right_px"), ("v_left_px", "v_right_px")),
        "are left and right swapped",
    ),
    "T in metres": (text("stereo.json", r'^ "T": \[.*$', ' "T": [-0.085, 0.0003, -0.0004],'), "is it in metres?"),
    "centres in millimetres": (times(0.003), "are the centres in millimetres?"),
    "pictures of half the size": (times(0.5), "half the size"),
    "one sheet": (table(SPOTS, lambda rows: [r for r in rows if r["target"] == "d1"]), "all spots lie at one depth"),
    "OK for ok": (cells(SPOTS, status=str.upper), "their status is not spelt ok, in small letters"),
    "steps instead of counters": (table(MOVES, steps), "are these the steps of each move?"),
    "tilt counts down": (cells(MOVES, tilt_steps=lambda n: str(-int(n))), "up counts up", "other sign"),
    "a centre 10 px off": (
        table(SPOTS, lambda rows: [r | {"u_left_px": str(float(r["u_left_px"]) + 10 * (r is rows[6]))} for r in rows]),
        *("spots 6 lie apart", "a mistyped pixel"),
    ),
    "no sheet names": (cells(SPOTS, target=lambda _: ""), "column target is empty"),
    "sheet names mixed up": (
        table(SPOTS, lambda rows: [r | ({"target": "d1"} if k % 7 == 0 else {}) for k, r in enumerate(rows)]),
        "sheet of another name",
    ),
    "mirror offset in metres": (
        text("campaign.toml", r"^mirror_offset_mm = .*$", "mirror_offset_mm = { value = 0.03, u = 0.005 }"),
        "in metres?",
    ),
}
COMMANDS: dict[str, tuple] = {
    # The exit code, then the words.
    "import CAMPAIGN/matlab.csv --to CAMPAIGN/new --pixels-from 1 --yes": (0, "px from 1", "new/spots.csv"),
    "check CAMPAIGN/..": (2, "campaign.toml: found no such file", "campaigns in it: mine"),
    "check CAMPAIGN/moves.csv": (2, "a part of a campaign", "check "),
    "simulate DATA/rigs/mounted/paper.csv DATA/rigs/mounted/rig.toml CAMPAIGN/new": (2, "they are swapped"),
    "steps-for CAMPAIGN --export C": (2, "header and json", "--export header for C"),
    "locate CAMPAIGN --pan-steps 1 --tilt-steps 2": (2, "missing: --aperture-deg"),
    "steps-for CAMPAIGN --x-mm 0.5 --y-mm 0.15 --z-mm 0.04": (2, "are these metres?", "--x-mm 500"),
    "detect CAMPAIGN": (3, "spots.csv has no rows", "--pictures FOLDER"),
}
CASES = {
    **{name: ("check CAMPAIGN", spoil, 2, words) for name, (spoil, *words) in REFUSED.items()},
    **{name: ("check CAMPAIGN", spoil, 0, words) for name, (spoil, *words) in ACCEPTED.items()},
    **{command: (command, matlab_table, code, words) for command, (code, *words) in COMMANDS.items()},
}


@pytest.mark.parametrize("name", CASES)
def test_the_remedy_fits_the_mistake(say, tmp_path, name):
    command, spoil, code, words = CASES[name]
    folder = tmp_path / "mine"
    shutil.copytree(PAPER_TWIN, folder)
    if command.startswith("detect"):
        spoil = data(SPOTS, lambda b: b.splitlines(True)[0])
    spoil(folder)
    found, out, log = say(*command.replace("CAMPAIGN", str(folder)).replace("DATA", str(DATA)).split())
    printed = " ".join((out + log).split())
    assert found == code, printed
    assert all(word in printed for word in words), printed

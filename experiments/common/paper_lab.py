"""The paper's lab as files: pictures of both cameras in folders of directions, and a book of them."""

from __future__ import annotations

import csv
import datetime
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tvsbayes.instrument.campaign import CAMERAS, Campaign, frame_name, read_campaign
from tvsbayes.instrument.experiments import experiments_of

BEGUN = datetime.datetime(2025, 7, 24, 9, 0, 0)
"""Local time of the first row: the day on which the paper was submitted."""
WORDS = {
    "left": {"LR": "L", "izq": "izq", "k": 0},
    "right": {"LR": "R", "izq": "der", "k": 1},
}
"""Words of either camera in names of pictures."""


@dataclass(frozen=True)
class Lab:
    """How a lab names its pictures and keeps its book.

    Attributes:
        name: in words.
        picture: name of a picture by direction, experiment, point and words of the camera.
        cell: what the book writes for a look; two cells for two columns.
        columns: names of the columns of time, experiment, point, plane, pan, tilt and of `cell`.
        direction: whether the book has a column of directions.
    """

    name: str
    picture: str
    cell: tuple[str, ...]
    columns: tuple[str, ...]
    direction: bool = False


LABS = (
    Lab(
        "folders of directions, cameras _L and _R; the book names the left picture",
        "{way}/exp{n:02d}_P{p}_{LR}.png",
        ("{way}/exp{n:02d}_P{p}_L.png",),
        ("Time", "Experiment", "Point", "Plane", "Pan", "Tilt", "Picture"),
    ),
    Lab(
        "prefix of a direction, cameras cam0 and cam1; what both names share, a column of directions",
        "{way}_{n}_{p}_cam{k}.png",
        ("{way}_{n}_{p}",),
        ("Hora", "Experimento", "Punto", "Plano", "Giro", "Inclinacion", "Imagen"),
        direction=True,
    ),
    Lab(
        "folders of directions, izq and der; one name in four folders, a column of directions",
        "{way}/exp{n:02d}_P{p}_{izq}.png",
        ("exp{n:02d}_P{p}",),
        ("Zeit", "Versuch", "Punkt", "Ebene", "Schwenk", "Neigung", "Bild"),
        direction=True,
    ),
    Lab(
        "folders of directions; two columns of pictures",
        "{way}/exp{n:02d}_P{p}_{LR}.png",
        ("{way}/exp{n:02d}_P{p}_L", "{way}/exp{n:02d}_P{p}_R"),
        ("time", "exp", "pt", "sheet", "pan", "tilt", "left picture", "right picture"),
    ),
)


def keys_of(campaign: Campaign) -> dict[int, tuple[str, int]]:
    """Direction and number, from 1 in each direction, of the experiment of every look, by its `spot`."""
    spots, moves = campaign.spots, campaign.moves
    at = [(moves[spot.move].pan_steps, moves[spot.move].tilt_steps) for spot in spots]
    found = experiments_of([s.experiment for s in spots], [s.point for s in spots], at, range(len(spots)))
    counts: dict[str, int] = {}
    keys = {}
    for (direction, _), rows in found:
        counts[direction] = counts.get(direction, 0) + 1
        keys |= {spots[row].spot: (direction, counts[direction]) for row in rows}
    return keys


def write_lab(lab: Lab, campaign: Campaign, frames: Path, folder: Path) -> dict[int, tuple[str, str]]:
    """Write `pictures/` and `book.csv`; the names of both pictures of every look, by its `spot`."""
    keys, names = keys_of(campaign), {}
    rows = []
    looks: dict[int, list] = {}
    for spot in sorted(campaign.spots, key=lambda spot: spot.spot):
        looks.setdefault(spot.move, []).append(spot)
    at = (0, 0)
    for move in campaign.moves:
        step = move.pan_steps - at[0], move.tilt_steps - at[1]
        at = move.pan_steps, move.tilt_steps
        clock = (BEGUN + datetime.timedelta(seconds=move.time_s)).isoformat(sep=" ", timespec="milliseconds")
        if move.move not in looks:
            rows.append([clock, "", "", "", *step, *[""] * (len(lab.cell) + lab.direction)])
        for look in looks.get(move.move, []):
            way, number = keys[look.spot]
            about = {"way": way, "n": number, "p": look.point}
            names[look.spot] = tuple(lab.picture.format(**about, **WORDS[side]) for side in CAMERAS)
            for name, side in zip(names[look.spot], CAMERAS, strict=True):
                (folder / "pictures" / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(frames / frame_name(look.spot, side), folder / "pictures" / name)
            cells = [cell.format(**about) for cell in lab.cell]
            rows.append([clock, number, f"P{look.point}", look.target, *step, *cells, *[way] * lab.direction])
            step = (0, 0)
    with (folder / "book.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([[*lab.columns, *["Direction"] * lab.direction], *rows])
    return names


def misplaced(names: Mapping[int, tuple[str, str]], pictures: Path, mine: Path) -> int:
    """Number of pictures in `frames/` that are not those of their look; looks are numbered by the rows of the book."""
    looks = sorted(read_campaign(mine).spots, key=lambda spot: (spot.move, spot.spot))
    wrong = 2 * abs(len(looks) - len(names))
    for look, own in zip(looks, (names[spot] for spot in sorted(names)), strict=False):
        for side, name in zip(CAMERAS, own, strict=True):
            file = mine / frame_name(look.spot, side)
            wrong += not file.is_file() or file.read_bytes() != (pictures / name).read_bytes()
    return wrong

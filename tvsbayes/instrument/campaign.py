"""What was moved and what was seen: moves, spots and the campaign folder.

Counters are absolute integers; px with the integer at the centre of a pixel; degrees where a name says `_deg`. Columns
are found by name. No JAX.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.csv_table import CSV_BYTES_MAX, Table, csv_bytes, parse_table
from tvsbayes.files.disk import make_folder, read_bytes, write_atomically
from tvsbayes.files.documents import JSON_BYTES_MAX, TOML_BYTES_MAX, parse_toml, toml_line
from tvsbayes.instrument.axes import SENSES, PanApproach, TiltApproach
from tvsbayes.instrument.campaign_header import parse_header
from tvsbayes.instrument.counter_limits import COUNTER_MAX
from tvsbayes.instrument.rig import RigTable, parse_rig_table, rig_table_toml
from tvsbayes.instrument.stereo_pair import Stereo, parse_stereo, stereo_bytes


@dataclass(frozen=True, slots=True)
class Move:
    """A row of `moves.csv`: absolute counters AFTER the move.

    Approaches are "left"/"right"/"unknown" and "up"/"down"/"unknown" in the first row of a segment,
    empty elsewhere.
    """

    move: int
    segment: int
    time_s: float
    pan_steps: int
    tilt_steps: int
    pan_approach: PanApproach | Literal[""] = ""
    tilt_approach: TiltApproach | Literal[""] = ""


@dataclass(frozen=True, slots=True)
class Spot:
    """A row of `spots.csv`: raw centroids and their standard uncertainties, px.

    All eight are numbers where `status` is "ok"; any of them may be None elsewhere, and no estimator
    reads the pixels of a spot that is not "ok".
    """

    spot: int
    move: int
    target: str
    experiment: int | None
    point: int | None
    u_left_px: float | None
    v_left_px: float | None
    u_right_px: float | None
    v_right_px: float | None
    su_left_px: float | None
    sv_left_px: float | None
    su_right_px: float | None
    sv_right_px: float | None
    aperture_deg: float | None = None
    status: str = "ok"
    ruv_left: float = 0.0
    ruv_right: float = 0.0


NAME_ACQUIRED = "acquired campaign"
"""Of a run whose rig file has no name."""
NAMES_BY_DEFAULT = (NAME_ACQUIRED, "my rig", "my axis", "my campaign")
"""Names that nobody chose: those of templates, the last of earlier ones."""


def title_of(header: Mapping[str, object], path: Path | None) -> str:
    """The name in a header that somebody gave, else its folder's, without line breaks."""
    name = str(header.get("name") or "").strip()
    if name and name not in NAMES_BY_DEFAULT:
        return name
    folder = "" if path is None else escaped(path.resolve().name, 200)
    return folder or name or "without a name"


@dataclass(frozen=True, repr=False)
class Campaign(Shown):
    """A campaign folder, checked. `header` holds the keys of `campaign.toml` outside `[rig]`."""

    moves: tuple[Move, ...]
    spots: tuple[Spot, ...]
    stereo: Stereo
    rig: RigTable = field(default_factory=RigTable)
    header: dict[str, object] = field(default_factory=dict)
    path: Path | None = None

    @property
    def title(self) -> str:
        """What readers call it: the name that somebody gave it, else its folder's."""
        return title_of(self.header, self.path)

    def shown(self) -> View:
        """Counts, and the looks with the counters behind them."""
        ok = sum(spot.status == "ok" for spot in self.spots)
        title = f"Campaign {self.title!r}: {len(self.moves)} moves, {len(self.spots)} spots ({ok} ok)"
        at = {move.move: (move.pan_steps, move.tilt_steps) for move in self.moves}
        columns = ("spot", "move", "pan_steps", "tilt_steps", *SPOT_COLUMNS[2:])
        rows = [
            (s.spot, s.move, *at.get(s.move, (None, None)), *(getattr(s, column) for column in SPOT_COLUMNS[2:]))
            for s in self.spots
        ]
        return View(title, columns, rows, most=5)


CAMERAS: tuple[Literal["left"], Literal["right"]] = ("left", "right")
"""The two cameras, in the order of the columns of spots.csv."""
PIXELS = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
"""Columns of a spot's centres."""
NO_PIXELS = (None, None, None, None)
"""Pixels, or their standard uncertainties, of a look without a spot."""
UNDETECTED = "undetected"
"""Status of a look whose pictures wait for `detect`."""
MOVE_COLUMNS = ("move", "segment", "time_s", "pan_steps", "tilt_steps", "pan_approach", "tilt_approach")
PIXEL_SDS = ("su_left_px", "sv_left_px", "su_right_px", "sv_right_px")
"""Columns of their standard uncertainties."""
PIXEL_SD_MIN, PIXEL_SD_MAX = 1e-4, 100.0
"""Of a standard uncertainty of a centre, px."""
APERTURE_MAX_DEG = 360.0
"""Of a reading of the aperture, either sign."""
SPOT_COLUMNS = (
    *("spot", "move", "target", "experiment", "point"),
    *(*PIXELS, *PIXEL_SDS, "aperture_deg", "status"),
)
_CORRELATIONS = ("ruv_left", "ruv_right")
ID_MAX = 10**9
# How far outside the image a centroid may lie, in image sizes: half a spot at the edge, not a wrong file.
_IMAGE_MARGIN = 0.1


def frame_name(spot: int, camera: str, folder: str = "frames") -> str:
    """Where a picture of a look lies in a campaign folder: `frames/000012_left.png`, `dark/` without laser light."""
    return f"{folder}/{spot:06d}_{camera}.png"


def with_pixels(
    spot: Spot,
    status: str,
    pixels_px: Sequence[float | None] = NO_PIXELS,
    sds_px: Sequence[float | None] = NO_PIXELS,
    correlations: Sequence[float] = (0.0, 0.0),
) -> Spot:
    """The row with another answer of a detector.

    Args:
        spot: the row.
        status: "ok", or why there is no spot.
        pixels_px: u_left, v_left, u_right, v_right.
        sds_px: their standard uncertainties.
        correlations: of u and v, left and right.
    """
    (u_left, v_left, u_right, v_right), (su_left, sv_left, su_right, sv_right) = pixels_px, sds_px
    return replace(
        spot,
        status=status,
        u_left_px=u_left,
        v_left_px=v_left,
        u_right_px=u_right,
        v_right_px=v_right,
        su_left_px=su_left,
        sv_left_px=sv_left,
        su_right_px=su_right,
        sv_right_px=sv_right,
        ruv_left=correlations[0],
        ruv_right=correlations[1],
    )


def parse_moves(data: bytes, file: str = "moves.csv") -> tuple[Move, ...]:
    """The checked rows of `moves.csv`; at least one."""
    table = parse_table(data, file, MOVE_COLUMNS)
    if not len(table):
        allowed, remedy = "at least one row", "write row 0: the counters and approaches after homing"
        raise refusal("empty", file=file, line=1, found="no rows", allowed=allowed, remedy=remedy)
    moves = table.integers("move", 0, ID_MAX)
    segments = table.integers("segment", 0, ID_MAX)
    times_s = table.numbers("time_s", -1e12, 1e12)
    table.check_counting("move", moves)
    table.check_segments(segments, times_s)
    approaches = {}
    for axis, words in SENSES.items():
        column = f"{axis}_approach"
        table.check_first_words(column, segments, (*words, "unknown"), "state how the axis arrived there")
        approaches[column] = table.columns[column]
    pan = table.integers("pan_steps", -COUNTER_MAX, COUNTER_MAX)
    tilt = table.integers("tilt_steps", -COUNTER_MAX, COUNTER_MAX)
    return tuple(map(Move, moves, segments, times_s, pan, tilt, *approaches.values()))


def check_experiments(
    table: Table, experiments: Sequence[int | None], points: Sequence[int | None], counts: Sequence[bool]
) -> None:
    """Refuses an experiment without point or the reverse, and twice the same point of an experiment that counts."""
    pairs = list(zip(experiments, points, strict=True))
    for row, (experiment, point) in enumerate(pairs):
        if (experiment is None) != (point is None):
            column = "experiment" if experiment is None else "point"
            allowed = "experiment and point both given or both empty"
            raise table.refuse(row, column, "missing", allowed, "complete the pair or empty it")
    keys = [pair if counted and pair != (None, None) else None for pair, counted in zip(pairs, counts, strict=True)]
    table.check_unique("point", keys, "every point of an experiment once")


def parse_spots(data: bytes, file: str, moves: int, stereo: Stereo) -> tuple[Spot, ...]:
    """The checked rows of `spots.csv`, in the order of the file.

    Args:
        data: the file's bytes.
        file: its name, for errors.
        moves: number of moves, which `move` must name.
        stereo: gives the image size.
    """
    table = parse_table(data, file, SPOT_COLUMNS, _CORRELATIONS)
    spots = table.integers("spot", 0, ID_MAX)
    table.check_unique("spot", spots, "unique ids")
    move_ids = table.integers("move", 0, ID_MAX)
    for row, move in enumerate(move_ids):
        if move is None or move >= moves:
            allowed = f"a row of moves.csv: 0 to {moves - 1}"
            raise table.refuse(row, "move", "missing-move", allowed, "name the last move before the look")
    experiments, points = table.integers("experiment", 0, ID_MAX, True), table.integers("point", 1, 4, True)
    statuses = table.texts("status", 200, empty=False)
    # A look that found no spot may be taken again.
    check_experiments(table, experiments, points, [status == "ok" for status in statuses])
    size = {"u": float(stereo.image_width), "v": float(stereo.image_height)}
    pixels = [table.numbers(column, -1e6, 1e6, empty=True) for column in PIXELS]
    sds = [table.numbers(column, PIXEL_SD_MIN, PIXEL_SD_MAX, empty=True) for column in PIXEL_SDS]
    for column, values in zip((*PIXELS, *PIXEL_SDS), (*pixels, *sds), strict=True):
        extent = size.get(column[0], 0.0)
        for row, value in enumerate(values):
            if statuses[row] != "ok":
                continue
            if value is None:
                allowed = "a finite decimal number, or an empty cell with a status other than ok"
                raise table.refuse(row, column, "missing", allowed, "give the value or a refusal reason")
            if column in PIXELS and not -_IMAGE_MARGIN <= value / extent <= 1 + _IMAGE_MARGIN:
                allowed = f"a position in the image, 0 to {extent:g} px, or close to it"
                remedy = _outside_remedy(values, extent, _exchanged(pixels, statuses, stereo))
                raise table.refuse(row, column, "outside-image", allowed, remedy)
    apertures = table.numbers("aperture_deg", -APERTURE_MAX_DEG, APERTURE_MAX_DEG, empty=True)
    correlations = [_parse_correlations(table, column, statuses) for column in _CORRELATIONS]
    head = (spots, move_ids, table.texts("target"), experiments, points)
    return tuple(map(Spot, *head, *pixels, *sds, apertures, statuses, *correlations))


def _outside_remedy(values: Sequence[float | None], extent: float, exchanged: bool) -> str:
    """What to do about pixels outside the image: a column, a cell, or the size of the pictures."""
    if exchanged:
        return "u and v are exchanged: u counts columns to the right, v rows down"
    outside = sum(value is not None and not -_IMAGE_MARGIN <= value / extent <= 1 + _IMAGE_MARGIN for value in values)
    if outside < 0.05 * len(values):
        return "correct the cell (a decimal point left out?), or give the spot a refusal reason"
    return "check the image size in stereo.json, or give the spot a refusal reason"


def _exchanged(pixels: Sequence[Sequence[float | None]], statuses: Sequence[str], stereo: Stereo) -> bool:
    """Whether all usable spots lie in the images once u and v of a row are exchanged; columns as in `PIXELS`."""
    extents = (stereo.image_height, stereo.image_width) * 2
    cells = [
        (column[row], extent)
        for column, extent in zip(pixels, extents, strict=True)
        for row, status in enumerate(statuses)
        if status == "ok"
    ]
    return all(value is None or -_IMAGE_MARGIN <= value / extent <= 1 + _IMAGE_MARGIN for value, extent in cells)


def _parse_correlations(table: Table, column: str, statuses: Sequence[str]) -> list[float]:
    """Correlations of u and v; 0 without the column, and where a row without a spot leaves the cell empty."""
    if column not in table.columns:
        return [0.0] * len(table)
    # At a correlation of 1 the two coordinates of a centroid would be one.
    values = table.numbers(column, -0.999999, 0.999999, empty=True)
    for row, value in enumerate(values):
        if value is None and statuses[row] == "ok":
            allowed = "a finite decimal number from -0.999999 to 0.999999"
            raise table.refuse(row, column, "number", allowed, "write 0 where it is not known")
    return [value or 0.0 for value in values]


# campaign.toml is written last: a folder without it is recognisably unfinished.
_FILES = {
    "stereo.json": JSON_BYTES_MAX,
    "moves.csv": CSV_BYTES_MAX,
    "spots.csv": CSV_BYTES_MAX,
    "campaign.toml": TOML_BYTES_MAX,
}


def _parse_files(files: dict[str, bytes], path: Path | None) -> Campaign:
    keys = parse_toml(files["campaign.toml"], "campaign.toml")
    header, rig = parse_header(keys), parse_rig_table(keys.table("rig"))
    stereo = parse_stereo(files["stereo.json"], "stereo.json")
    moves = parse_moves(files["moves.csv"])
    spots = parse_spots(files["spots.csv"], "spots.csv", len(moves), stereo)
    return Campaign(moves, spots, stereo, rig, header, path)


def read_campaign(folder: Path | str) -> Campaign:
    """Reads and checks a campaign folder (data/docs/campaign-files.md). Never `truth.json`, frames or results.

    Args:
        folder: holds `campaign.toml`, `stereo.json`, `moves.csv` and `spots.csv`.

    Returns:
        Moves in time order, spots in the order of the file, the stereo pair and the `[rig]` table; input of `fit`,
        `classic` and the plots.

    Raises:
        InputError: anything that is missing, malformed or contradicts itself, with file, line and column.
    """
    folder = Path(folder)
    if not folder.is_dir():
        place, found = escaped(str(folder), 200), "no such folder" if not folder.exists() else "a file"
        allowed, remedy = "a campaign folder", "give the folder that holds campaign.toml"
        raise refusal("missing-file", file=place, found=found, allowed=allowed, remedy=remedy)
    if not os.path.lexists(folder / "campaign.toml"):
        raise _no_campaign(folder)
    files = {name: read_bytes(folder / name, cap, folder) for name, cap in _FILES.items()}
    return _parse_files(files, folder)


def _no_campaign(folder: Path) -> InputError:
    """The error of a folder without campaign.toml, which names those below it that have one."""
    below = sorted(path.parent.name for path in folder.glob("*/campaign.toml"))
    remedy = "`tvsbayes new OUT` begins a campaign"
    if below:
        names = ", ".join(escaped(name) for name in below[:5])
        remedy = f"name one of the campaigns in it: {names}{' ...' * (len(below) > 5)}"
    elif (folder / "frames").is_dir() or (folder / "log.jsonl").is_file():
        remedy = "an unfinished run: go on with the command that began it (`simulate`, or `acquire --resume`)"
    found, allowed = f"no such file in {escaped(str(folder), 200)}", "the folder of a campaign"
    return refusal("missing-file", file="campaign.toml", found=found, allowed=allowed, remedy=remedy)


def moves_bytes(moves: Iterable[Move]) -> bytes:
    """The content of `moves.csv`."""
    return csv_bytes(MOVE_COLUMNS, ([getattr(m, c) for c in MOVE_COLUMNS] for m in moves))


def spots_bytes(spots: Sequence[Spot]) -> bytes:
    """The content of `spots.csv`; the correlations appear only where one is not zero."""
    correlated = any(s.ruv_left or s.ruv_right for s in spots)
    columns = (*SPOT_COLUMNS, *(_CORRELATIONS if correlated else ()))
    return csv_bytes(columns, ([getattr(s, c) for c in columns] for s in spots))


def campaign_toml(campaign: Campaign) -> bytes:
    """The content of `campaign.toml`: header and the complete `[rig]` table."""
    lines = [toml_line("format", "tvsbayes-campaign/1")]
    tables = {name: value for name, value in campaign.header.items() if isinstance(value, dict)}
    lines += [toml_line(key, value) for key, value in campaign.header.items() if key not in tables]
    for name, table in tables.items():
        lines += [f"[{name}]", *(toml_line(key, value) for key, value in table.items())]
    return ("\n".join(lines) + "\n" + rig_table_toml(campaign.rig)).encode()


def campaign_bytes(campaign: Campaign) -> dict[str, bytes]:
    """The four files of a campaign in the order in which they are to be written; what is read back is the same.

    Raises:
        InputError: `campaign` holds what `read_campaign` would refuse.
    """
    tables = moves_bytes(campaign.moves), spots_bytes(campaign.spots)
    files = dict(zip(_FILES, (stereo_bytes(campaign.stereo), *tables, campaign_toml(campaign)), strict=True))
    _parse_files(files, None)
    return files


def write_campaign(campaign: Campaign, folder: Path) -> None:
    """Writes the four files of a campaign into a new or empty folder.

    Raises:
        InputError: the folder holds something or cannot be written; what `campaign_bytes` refuses (then nothing is
            written).
    """
    folder, files = Path(folder), campaign_bytes(campaign)
    make_folder(folder, empty=True)
    for name, data in files.items():
        write_atomically(folder / name, data)


def input_hashes(campaign: Campaign) -> dict[str, str]:
    """SHA-256 of what an estimate depends on, by "moves", "spots", "stereo" and "rig".

    Taken over the values in canonical text, spots in order of id: line endings, digits beyond double
    precision, the order of columns, the campaign's name and its notes do not count.
    """
    spots = sorted(campaign.spots, key=lambda spot: spot.spot)
    contents = {
        "moves": moves_bytes(campaign.moves),
        "spots": spots_bytes(spots),
        "stereo": stereo_bytes(campaign.stereo),
        "rig": rig_table_toml(campaign.rig).encode(),
    }
    return {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()}


def ordered_spots(campaign: Campaign) -> list[Spot]:
    """Spots with status ok in the order in which the filter meets them."""
    return sorted((s for s in campaign.spots if s.status == "ok"), key=lambda s: (s.move, s.spot))


def pixels_of(spots: Iterable[Spot]) -> np.ndarray:
    """Their `PIXELS`, shape (spots, 4); not a number where there are none."""
    return np.array([[getattr(spot, name) for name in PIXELS] for spot in spots], dtype=float).reshape(-1, 4)

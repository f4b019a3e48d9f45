"""The data of a campaign: moves, spots and the campaign folder.

Counters are absolute integers; px with the integer at the centre of a pixel; degrees where a name says `_deg`. Columns
are found by name. No JAX.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.csv_kind import (
    Column,
    CsvKind,
    Values,
    counted,
    filled_where_ok,
    first_of_segment,
    follows_a_move,
    segments_in_time,
    templates,
    unique,
)
from tvsbayes.files.csv_table import CSV_BYTES_MAX, Table
from tvsbayes.files.disk import read_bytes, require_campaign_folder, write_folder
from tvsbayes.files.documents import JSON_BYTES_MAX, TOML_BYTES_MAX, parse_toml, toml_text
from tvsbayes.instrument.axes import PanApproach, TiltApproach
from tvsbayes.instrument.campaign_header import CAMPAIGN_FORMAT, parse_header
from tvsbayes.instrument.counter_limits import COUNTER_MAX
from tvsbayes.instrument.experiments import check_experiments
from tvsbayes.instrument.rig import RigTable, parse_rig_table, rig_table_toml
from tvsbayes.instrument.sightings import SIGHTINGS, Sighting, parse_sightings
from tvsbayes.instrument.stereo_pair import Stereo, WithStereo, no_stereo_pair, parse_stereo, stereo_bytes, triangulate

CAMERAS: tuple[Literal["left"], Literal["right"]] = ("left", "right")
"""The two cameras, in the order of the columns of spots.csv."""
PIXELS = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
"""Columns of a spot's centres."""
PIXEL_SDS = ("su_left_px", "sv_left_px", "su_right_px", "sv_right_px")
"""Columns of their standard uncertainties."""
NO_PIXELS = (None, None, None, None)
"""Pixels, or their standard uncertainties, of a look without a spot."""
UNDETECTED = "undetected"
"""Status of a look whose pictures wait for `detect`."""
PIXEL_SD_MIN, PIXEL_SD_MAX = 1e-4, 100.0
"""Limits of the standard uncertainty of a centre, px."""
TEMPERATURES_DEGC = (-273.15, 1000.0)
"""Range of temperatures of a machine, from absolute zero."""
APERTURE_MAX_DEG = 360.0
"""Largest absolute aperture reading."""
# Distance outside the image allowed for a centroid, in image sizes: half a spot at the edge, not a wrong file.
_IMAGE_MARGIN = 0.1
_WHERE_OK = filled_where_ok("give the value or a refusal reason")
_PIXEL = Column(
    "raw centroids, px, integer = centre of a pixel, (0, 0) the centre of the first (MATLAB counts from 1: subtract 1)",
    *(-1e6, 1e6),
    rule=_WHERE_OK,
)
_PIXEL_SD = Column("their standard uncertainties, px", PIXEL_SD_MIN, PIXEL_SD_MAX, rule=_WHERE_OK)
# At a correlation of 1 the two coordinates of a centroid would be the same.
_CORRELATION = Column(
    "optional: correlation of u and v",
    *(-0.999999, 0.999999),
    group="correlations",
    rule=filled_where_ok(
        "write 0 where it is not known", "a finite decimal number from -0.999999 to 0.999999", "number"
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Move:
    """A row of `moves.csv`: absolute counters and temperature AFTER the move; None where it was not read.

    Approaches are "left"/"right"/"unknown" and "up"/"down"/"unknown" in the first row of a segment,
    empty elsewhere.
    """

    move: Annotated[
        int,
        Column(
            "0, 1, 2, ...",
            rule=counted,
        ),
    ]
    segment: Annotated[
        int,
        Column(
            "0, then the same or one more: a homing begins the next segment",
            rule=segments_in_time,
        ),
    ]
    time_s: Annotated[
        float,
        Column(
            "seconds, never decreasing",
            *(-1e12, 1e12),
        ),
    ]
    pan_steps: Annotated[
        int,
        Column(
            "absolute counters AFTER the move, whole numbers; left and up count up",
            *(-COUNTER_MAX, COUNTER_MAX),
        ),
    ]
    tilt_steps: Annotated[
        int,
        Column(
            "",
            *(-COUNTER_MAX, COUNTER_MAX),
        ),
    ]
    pan_approach: Annotated[
        PanApproach | Literal[""],
        Column(
            "in the first row of a segment: `left`, `right` or `unknown`, the side from which the axis came there; "
            "empty elsewhere",
            rule=first_of_segment,
        ),
    ] = ""
    tilt_approach: Annotated[
        TiltApproach | Literal[""],
        Column("likewise `up`, `down`, `unknown`", rule=first_of_segment),
    ] = ""
    temperature_degC: Annotated[
        float | None,
        Column(
            "optional: of the machine; its zeros shift with it. Empty cells are interpolated in time",
            *TEMPERATURES_DEGC,
            group="temperature",
        ),
    ] = None
    assumed: Annotated[
        int,
        Column(
            "optional: 1 for a move that an import has added; no plan goes by it; empty or 0: made",
            *(0, 1),
            group="assumed",
        ),
    ] = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Spot:
    """A row of `spots.csv`: raw centroids and their standard uncertainties, px.

    All eight are numbers where `status` is "ok"; else any of them may be None, and no estimator reads them.
    """

    spot: Annotated[
        int,
        Column(
            "unique id",
            rule=unique,
        ),
    ]
    move: Annotated[int, Column("the last move before the look")]
    target: Annotated[
        str,
        Column(
            "any name for the placement of the sheet",
        ),
    ]
    experiment: Annotated[
        int | None,
        Column(
            "of the four-point method: number, and 1 to 4; both or neither",
        ),
    ] = None
    point: Annotated[int | None, Column("", 1, 4)] = None
    u_left_px: Annotated[float | None, _PIXEL] = None
    v_left_px: Annotated[float | None, _PIXEL] = None
    u_right_px: Annotated[float | None, _PIXEL] = None
    v_right_px: Annotated[float | None, _PIXEL] = None
    su_left_px: Annotated[float | None, _PIXEL_SD] = None
    sv_left_px: Annotated[float | None, _PIXEL_SD] = None
    su_right_px: Annotated[float | None, _PIXEL_SD] = None
    sv_right_px: Annotated[float | None, _PIXEL_SD] = None
    aperture_deg: Annotated[
        float | None,
        Column(
            "the scanner's own reading, deg, or empty",
            *(-APERTURE_MAX_DEG, APERTURE_MAX_DEG),
        ),
    ] = None
    status: Annotated[
        str,
        Column(
            "`ok`; `undetected` (pixels empty, frames wait); or a reason in words",
            chars_max=200,
            filled=True,
        ),
    ] = "ok"
    ruv_left: Annotated[float, _CORRELATION] = 0.0
    ruv_right: Annotated[float, _CORRELATION] = 0.0

    def pixel_covariance(self) -> np.ndarray:
        """The stated covariance of (u_left, v_left, u_right, v_right), px^2."""
        sd = np.array([self.su_left_px, self.sv_left_px, self.su_right_px, self.sv_right_px], dtype=float)
        covariance = np.diag(sd**2)
        covariance[0, 1] = covariance[1, 0] = self.ruv_left * sd[0] * sd[1]
        covariance[2, 3] = covariance[3, 2] = self.ruv_right * sd[2] * sd[3]
        return covariance

    def renumbered(self, number: int, move: int) -> Spot:
        """The spot with another id, after another move, without experiment."""
        return replace(self, spot=number, move=move, experiment=None, point=None)


MOVES = CsvKind(
    Move,
    "moves.csv",
    "a row after every command to the motors, in time order",
    ("at least one row", "write row 0: the counters and approaches after homing"),
    [Move(move=0, segment=0, time_s=0.0, pan_steps=0, tilt_steps=0, pan_approach="unknown", tilt_approach="unknown")],
)
SPOTS = CsvKind(Spot, "spots.csv", "a row for every look, in any order")
Look = Spot | Sighting
"""A look of any instrument."""


def stereo_spots(looks: Iterable[Look]) -> tuple[Spot, ...]:
    """The looks of a campaign as spots.

    Raises:
        InputError: they are sightings.
    """
    rows = tuple(looks)
    spots = tuple(look for look in rows if isinstance(look, Spot))
    if len(spots) != len(rows):
        raise no_stereo_pair()
    return spots


NAME_ACQUIRED = "acquired campaign"
"""Name of a run whose rig file has none."""
NAMES_BY_DEFAULT = (NAME_ACQUIRED, "my rig", "my axis", "my campaign")
"""Names in templates, the last from earlier versions; a campaign with one of them counts as unnamed."""


def title_of(header: Mapping[str, object], path: Path | None) -> str:
    """The name in the header, or the folder's where the header has a template's name; without line breaks."""
    name = str(header.get("name") or "").strip()
    if name and name not in NAMES_BY_DEFAULT:
        return name
    folder = "" if path is None else escaped(path.resolve().name, 200)
    return folder or name or "without a name"


@dataclass(frozen=True, repr=False)
class Campaign(Shown, WithStereo):
    """A campaign folder, checked. `header` holds the keys of `campaign.toml` outside `[rig]`.

    `spots` are sightings, and `stereo` is None, where the mechanism has sightings.
    """

    moves: tuple[Move, ...]
    spots: tuple[Look, ...]
    stereo: Stereo | None
    rig: RigTable = field(default_factory=RigTable)
    header: dict[str, object] = field(default_factory=dict)
    path: Path | None = None

    @cached_property
    def points_mm(self) -> np.ndarray:
        """Each spot triangulated by the stated cameras, frame S, shape (n, 3); computed once, read-only.

        NaN where a look has no spot, and outside the range of the lens model.

        Raises:
            InputError: the campaign has sightings.
        """
        points = np.full((len(self.spots), 3), np.nan)
        usable = np.array([spot.status == "ok" for spot in self.spots], dtype=bool)
        points[usable] = triangulate(self.stereo_pair, pixels_of(spot for spot in self.spots if spot.status == "ok"))
        points.flags.writeable = False
        return points

    @property
    def usable_points_mm(self) -> np.ndarray:
        """Rows of `points_mm` of the spots with status ok, in their order."""
        return self.points_mm[[spot.status == "ok" for spot in self.spots]]

    @property
    def aperture_read(self) -> bool:
        """Whether any usable look has a reading of the aperture."""
        return any(look.status == "ok" and look.aperture_deg is not None for look in self.spots)

    @property
    def looks_table(self) -> CsvKind[Any]:
        """The kind of file that holds its looks."""
        return SPOTS if self.has_images else SIGHTINGS

    @property
    def looks(self) -> str:
        """What its looks are called: spots or sightings."""
        return Path(self.looks_table.file).stem

    @property
    def look_again(self) -> str:
        """What brings further usable looks, in words."""
        return "look at more stops" + ", or detect the refused spots again" * self.has_images

    @property
    def title(self) -> str:
        """The name in its header, else that of its folder; see `title_of`."""
        return title_of(self.header, self.path)

    def shown(self) -> View:
        """Counts, and the looks with their counters."""
        ok = sum(spot.status == "ok" for spot in self.spots)
        kind = self.looks_table
        title = f"Campaign {self.title!r}: {len(self.moves)} moves, {len(self.spots)} {self.looks} ({ok} ok)"
        counters = {move.move: (move.pan_steps, move.tilt_steps) for move in self.moves}
        columns = kind.required[2:]
        rows = [
            (s.spot, s.move, *counters.get(s.move, (None, None)), *(getattr(s, column) for column in columns))
            for s in self.spots
        ]
        return View(title, ("spot", "move", "pan_steps", "tilt_steps", *columns), rows, most=5)


def frame_name(spot: int, camera: str, folder: str = "frames") -> str:
    """Path of a look's picture in a campaign folder: `frames/000012_left.png`; in `dark/` without laser light."""
    return f"{folder}/{spot:06d}_{camera}.png"


def with_pixels(
    spot: Spot,
    status: str,
    pixels_px: Sequence[float | None] = NO_PIXELS,
    sds_px: Sequence[float | None] = NO_PIXELS,
    correlations: Sequence[float] = (0.0, 0.0),
) -> Spot:
    """The row with a new result of the detector.

    Args:
        spot: the row.
        status: "ok", or the reason for no spot.
        pixels_px: u_left, v_left, u_right, v_right.
        sds_px: their standard uncertainties.
        correlations: correlation of u and v, left and right.
    """
    columns = (*PIXELS, *PIXEL_SDS, "ruv_left", "ruv_right")
    values = dict(zip(columns, (*pixels_px, *sds_px, *correlations), strict=True))
    return replace(spot, status=status, **values)  # type: ignore[arg-type]


def next_move(
    moves: Sequence[Move],
    segment: int,
    time_s: float,
    steps: tuple[int, int],
    approach: tuple[PanApproach | Literal[""], TiltApproach | Literal[""]] = ("", ""),
) -> Move:
    """The row after `moves`; counters and approaches of (pan, tilt)."""
    (pan, tilt), (pan_side, tilt_side) = steps, approach
    return Move(
        move=len(moves),
        segment=segment,
        time_s=time_s,
        pan_steps=pan,
        tilt_steps=tilt,
        pan_approach=pan_side,
        tilt_approach=tilt_side,
    )


def parse_moves(data: bytes, file: str = MOVES.file) -> tuple[Move, ...]:
    """The checked rows of `moves.csv`; at least one."""
    return MOVES.parse(data, file)


def parse_spots(data: bytes, file: str, moves: Sequence[Move], stereo: Stereo) -> tuple[Spot, ...]:
    """The checked rows of `spots.csv`, in the order of the file.

    Args:
        data: the file's bytes.
        file: its name, for errors.
        moves: the moves, which `move` must name.
        stereo: gives the image size.
    """
    checks = follows_a_move(len(moves), "look"), partial(_experiments, moves=moves), partial(_in_image, stereo=stereo)
    return SPOTS.parse(data, file, *checks)


def _experiments(table: Table, values: Values, moves: Sequence[Move]) -> None:
    """Refuse experiments that are not told apart; a look without a spot may be repeated."""
    counters = [(moves[move].pan_steps, moves[move].tilt_steps) for move in values["move"]]
    order = sorted(range(len(table)), key=lambda row: (values["move"][row], values["spot"][row]))
    check_experiments(table, values, counters, order, [status == "ok" for status in values["status"]])


def _in_image(table: Table, values: Values, stereo: Stereo) -> None:
    """Refuse a centroid outside the image."""
    statuses, pixels = values["status"], [values[column] for column in PIXELS]
    for column, centres in zip(PIXELS, pixels, strict=True):
        extent = float(stereo.image_width if column[0] == "u" else stereo.image_height)
        for row, value in enumerate(centres):
            if statuses[row] == "ok" and not _near(value, extent):
                allowed = f"a position in the image, 0 to {extent:g} px, or close to it"
                remedy = _outside_remedy(centres, extent, _exchanged(pixels, statuses, stereo))
                raise table.refuse(row, column, "outside-image", allowed, remedy)


def _near(value: float | None, extent: float) -> bool:
    """Whether a centroid, if there is one, lies in the image or close to it."""
    return value is None or -_IMAGE_MARGIN <= value / extent <= 1 + _IMAGE_MARGIN


def _outside_remedy(values: Sequence[float | None], extent: float, exchanged: bool) -> str:
    """The remedy for pixels outside the image: correct a column, a cell, or the size of the pictures."""
    if exchanged:
        return "u and v are exchanged: u counts columns to the right, v rows down"
    if sum(not _near(value, extent) for value in values) < 0.05 * len(values):
        return "correct the cell (a decimal point left out?), or give the spot a refusal reason"
    return "check the image size in stereo.json, or give the spot a refusal reason"


def _exchanged(pixels: Sequence[Sequence[float | None]], statuses: Sequence[str], stereo: Stereo) -> bool:
    """Whether all usable spots lie in the images once u and v of a row are exchanged; columns as in `PIXELS`."""
    extents = (stereo.image_height, stereo.image_width) * 2
    return all(
        _near(column[row], extent)
        for column, extent in zip(pixels, extents, strict=True)
        for row, status in enumerate(statuses)
        if status == "ok"
    )


_BYTES_MAX = {".json": JSON_BYTES_MAX, ".csv": CSV_BYTES_MAX, ".toml": TOML_BYTES_MAX}


def _parse_files(files: dict[str, bytes], path: Path | None) -> Campaign:
    keys = parse_toml(files["campaign.toml"], "campaign.toml")
    sightings = SIGHTINGS.file in files
    header, rig = parse_header(keys), parse_rig_table(keys.table("rig"), sightings)
    stereo = None if sightings else parse_stereo(files["stereo.json"], "stereo.json")
    moves = parse_moves(files["moves.csv"])
    if stereo is None:
        looks = parse_sightings(files[SIGHTINGS.file], SIGHTINGS.file, len(moves))
        return Campaign(moves, looks, None, rig, header, path)
    return Campaign(moves, parse_spots(files["spots.csv"], "spots.csv", moves, stereo), stereo, rig, header, path)


def read_campaign(folder: Path | str) -> Campaign:
    """Read and check a campaign folder (data/docs/campaign-files.md), without `truth.json`, frames and results.

    Args:
        folder: contains `campaign.toml`, `stereo.json`, `moves.csv` and `spots.csv`; for a head with sightings
            `campaign.toml`, `moves.csv` and `sightings.csv`.

    Returns:
        Moves in time order, spots in the order of the file, the stereo pair and the `[rig]` table; input of `fit`,
        `classic` and the plots.

    Raises:
        InputError: missing, malformed or contradictory entries, with file, line and column.
    """
    folder = Path(folder)
    require_campaign_folder(folder, "a campaign folder")
    if not os.path.lexists(folder / "campaign.toml"):
        raise _no_campaign(folder)
    sightings = os.path.lexists(folder / SIGHTINGS.file)
    if sightings and os.path.lexists(folder / SPOTS.file):
        found, allowed = f"{SPOTS.file} and {SIGHTINGS.file}", "one of them"
        remedy = (
            "make a campaign of each: a stereo pair sees the spots of the one, the head says where the other pointed"
        )
        raise refusal("two-tables", file=SIGHTINGS.file, found=found, allowed=allowed, remedy=remedy)
    tables = (MOVES.file, SIGHTINGS.file) if sightings else ("stereo.json", MOVES.file, SPOTS.file)
    paths = [folder / name for name in (*tables, "campaign.toml")]
    return _parse_files({path.name: read_bytes(path, _BYTES_MAX[path.suffix], folder) for path in paths}, folder)


def _no_campaign(folder: Path) -> InputError:
    """The error of a folder without campaign.toml; it lists subfolders that contain one."""
    campaigns = sorted(path.parent.name for path in folder.glob("*/campaign.toml"))
    remedy = "`tvsbayes new OUT` begins a campaign"
    if campaigns:
        names = ", ".join(escaped(name) for name in campaigns[:5])
        remedy = f"name one of the campaigns in it: {names}{' ...' * (len(campaigns) > 5)}"
    elif (folder / "frames").is_dir() or (folder / "log.jsonl").is_file():
        remedy = "an unfinished run: go on with the command that began it (`simulate`, or `acquire --resume`)"
    found, allowed = f"no such file in {escaped(str(folder), 200)}", "the folder of a campaign"
    return refusal("missing-file", file="campaign.toml", found=found, allowed=allowed, remedy=remedy)


def campaign_templates() -> dict[str, bytes]:
    """The commented files of an empty campaign."""
    return templates("templates", MOVES, SPOTS)


def moves_bytes(moves: Iterable[Move]) -> bytes:
    """The content of `moves.csv`."""
    return MOVES.content(moves)


def spots_bytes(spots: Iterable[Look]) -> bytes:
    """The content of `spots.csv`; the correlations appear only where one is not zero."""
    return SPOTS.content(stereo_spots(spots))


def looks_bytes(campaign: Campaign, ordered: bool = False) -> bytes:
    """The content of `spots.csv` or `sightings.csv`; `ordered` by id."""
    rows = sorted(campaign.spots, key=lambda row: row.spot) if ordered else campaign.spots
    return campaign.looks_table.content(rows)


def campaign_toml(campaign: Campaign) -> bytes:
    """The content of `campaign.toml`: header and the complete `[rig]` table."""
    tables = {name: value for name, value in campaign.header.items() if isinstance(value, dict)}
    top = {name: value for name, value in campaign.header.items() if name not in tables}
    return (toml_text({"": {"format": CAMPAIGN_FORMAT, **top}, **tables}) + rig_table_toml(campaign.rig)).encode()


def campaign_bytes(campaign: Campaign) -> dict[str, bytes]:
    """The four files of a campaign in the order of writing; reading them returns the same campaign.

    Raises:
        InputError: `read_campaign` would refuse the files.
    """
    files = {} if campaign.stereo is None else {"stereo.json": stereo_bytes(campaign.stereo)}
    files |= {MOVES.file: moves_bytes(campaign.moves), campaign.looks_table.file: looks_bytes(campaign)}
    # Written last: a folder without it is incomplete.
    files["campaign.toml"] = campaign_toml(campaign)
    _parse_files(files, None)
    return files


def write_campaign(campaign: Campaign, folder: Path) -> None:
    """Write the four files of a campaign into a new or empty folder, all or none.

    Raises:
        InputError: the folder is not empty or cannot be written, or `campaign_bytes` refuses.
    """
    write_folder(Path(folder), campaign_bytes(campaign))


def input_hashes(campaign: Campaign) -> dict[str, str]:
    """SHA-256 of the inputs of an estimate, by "moves", "spots", "stereo" and "rig".

    Taken over the values in canonical text, spots in order of id: line endings, digits beyond double precision, the
    order of columns, the campaign's name and its notes do not affect them.
    """
    contents = {
        "moves": moves_bytes(campaign.moves),
        "spots": looks_bytes(campaign, ordered=True),
        "stereo": b"" if campaign.stereo is None else stereo_bytes(campaign.stereo),
        "rig": rig_table_toml(campaign.rig).encode(),
    }
    return {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()}


def ordered_spots(campaign: Campaign) -> list[Look]:
    """Looks with status ok in the order in which the filter takes them."""
    ok = [s for s in campaign.spots if s.status == "ok"]
    return sorted(ok, key=lambda s: (s.move, s.spot))


def pixels_of(spots: Iterable[Look]) -> np.ndarray:
    """`PIXELS` of the spots, shape (spots, 4); NaN for missing values. Refuses sightings as `stereo_spots`."""
    rows = [[getattr(spot, name) for name in PIXELS] for spot in stereo_spots(spots)]
    return np.array(rows, dtype=float).reshape(-1, 4)

"""A campaign as one NeXus file (HDF5), for programs that read this format.

`/entry/looks` is the default plot: centroids with their uncertainties over the looks, with their counters;
`/entry/moves` has the counters over time, `/entry/instrument` axes and cameras. The campaign's files and the journal
are in `/entry/files` byte for byte; of pictures only the journal's names and SHA-256.

Counters in steps, px with the integer at the centre of a pixel, mm, degrees, seconds since `/entry/start_time`; every
number has its unit. Source: NeXus base classes, https://manual.nexusformat.org.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET

from tvsbayes.acquisition.journal import LOG, LOG_BYTES_MAX, Record, read_journal
from tvsbayes.acquisition.recorder import Looked, Stop, event_of
from tvsbayes.errors import escaped, refusal
from tvsbayes.files.csv_kind import Column
from tvsbayes.files.csv_table import CSV_BYTES_MAX
from tvsbayes.files.disk import read_bytes, write_atomically
from tvsbayes.files.documents import JSON_BYTES_MAX, TOML_BYTES_MAX
from tvsbayes.files.packages import own_version
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import CAMERAS, MOVES, PIXEL_SDS, SPOTS, Campaign, Look, Move, read_campaign

NOTHING = -1
"""Value for a look without experiment or point."""
_FILES = {
    "campaign.toml": TOML_BYTES_MAX,
    "stereo.json": JSON_BYTES_MAX,
    "moves.csv": CSV_BYTES_MAX,
    "spots.csv": CSV_BYTES_MAX,
    LOG: LOG_BYTES_MAX,
}
_NAMED_UNITS = ("steps", "degC")
"""Units that the names of datasets keep."""


@dataclass(frozen=True)
class NexusSummary:
    """Numbers in a file: rows of the tables, looks that count, events of the journal, pictures listed."""

    moves: int
    looks: int
    ok: int
    events: int
    pictures: int


def write_nexus(folder: Path, path: Path) -> NexusSummary:
    """Writes a campaign, with its journal where it has one, as a new NeXus file; completely or not at all.

    Args:
        folder: folder of the campaign.
        path: the file to write.

    Raises:
        InputError: an unreadable campaign or journal, an existing file, a folder that cannot be written.
    """
    import h5py

    folder, path = Path(folder), Path(path)
    if path.exists():
        remedy = "name another file, or move this one away; nothing is overwritten"
        shown_path = escaped(str(path), 200)
        raise refusal("occupied", file=shown_path, found="a file that is there", allowed="a new file", remedy=remedy)
    campaign = read_campaign(folder)
    records = read_journal(folder).records if (folder / LOG).is_file() else ()
    frames = [frame for record in records for frame in record.frames]
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.attrs.update(NX_class="NXroot", default="entry", creator="tvsbayes", h5py_version=h5py.__version__)
        entry = _group(file, "entry", "NXentry", default="looks")
        _entry(entry, campaign, records)
        _instrument(_group(entry, "instrument", "NXinstrument"), campaign)
        axes = {"signal": "pan_steps", "axes": ["time"], "auxiliary_signals": ["tilt_steps"]}
        moves = _group(entry, "moves", "NXdata", **axes)
        for column in MOVES.columns.values():
            _column(moves, column, campaign.moves)
        _looks(entry, campaign, records)
        pictures = _group(entry, "pictures", "NXcollection")
        what = "pictures in the campaign's folder: frames/ with the laser on, dark/ with it off"
        _put(pictures, "description", what)
        if frames:
            _put(pictures, "file_name", [frame.name for frame in frames])
            _put(pictures, "sha256", [frame.sha256 for frame in frames])
            _put(pictures, "bytes", [frame.size for frame in frames])
        _files(_group(entry, "files", "NXcollection"), folder)
    write_atomically(path, buffer.getvalue())
    ok = sum(spot.status == "ok" for spot in campaign.spots)
    return NexusSummary(len(campaign.moves), len(campaign.spots), ok, len(records), len(frames))


def _group(parent: Any, name: str, nexus_class: str, **attributes: object) -> Any:
    group = parent.create_group(name)
    group.attrs.update(NX_class=nexus_class, **attributes)
    return group


def _put(group: Any, name: str, value: object, unit: str = "", **attributes: object) -> None:
    """A dataset with its unit; text and lists of text as UTF-8."""
    import h5py

    text = isinstance(value, str) or (isinstance(value, list) and all(isinstance(item, str) for item in value))
    data = group.create_dataset(name, data=value, dtype=h5py.string_dtype() if text else None)
    data.attrs.update({**({"units": unit} if unit else {}), **attributes})


def _entry(entry: Any, campaign: Campaign, records: Sequence[Record]) -> None:
    header = campaign.header
    _put(entry, "title", campaign.title)
    _put(entry, "program_name", "tvsbayes", version=own_version())
    created = header.get("created")
    if created is not None:
        _put(entry, "start_time", created.isoformat() if hasattr(created, "isoformat") else str(created))
    end_times = [end.utc for record in records if (end := event_of(record, Stop)) is not None]
    if end_times and end_times[-1]:
        _put(entry, "end_time", end_times[-1])
    if header.get("synthetic"):
        _put(entry, "simulated", True)
    if "notes" in header:
        _put(entry, "experiment_description", str(header["notes"]))
    if "operator" in header:
        _put(_group(entry, "user", "NXuser"), "name", str(header["operator"]))


def _instrument(instrument: Any, campaign: Campaign) -> None:
    """Axes with their counters, cameras with their calibration, and the priors of the rig."""
    if "instrument" in campaign.header:
        _put(instrument, "name", str(campaign.header["instrument"]))
    for axis in AXES:
        group = _group(instrument, axis, "NXpositioner")
        _put(group, "name", axis)
        _put(group, "description", f"{axis} axis: absolute motor counter after every move")
        _put(group, "value", [getattr(move, f"{axis}_steps") for move in campaign.moves], "steps")
    stereo = campaign.stereo_pair
    for side, matrix, distortion in (("left", stereo.M1, stereo.D1), ("right", stereo.M2, stereo.D2)):
        group = _group(instrument, f"camera_{side}", "NXdetector")
        _put(group, "description", f"{side} camera of the stereo pair; OpenCV's camera model")
        _put(group, "image_size", [stereo.image_width, stereo.image_height], "px")
        _put(group, "camera_matrix", np.asarray(matrix), "px")
        _put(group, "distortion", np.asarray(distortion).ravel())
    pair = _group(instrument, "stereo", "NXcollection")
    _put(pair, "rotation", np.asarray(stereo.R))
    _put(pair, "translation", np.asarray(stereo.T).ravel(), "mm")
    _put(pair, "parameter_covariance", np.asarray(stereo.parameter_covariance))
    priors = _group(instrument, "prior", "NXcollection")
    for name, prior in campaign.rig.priors.items():
        _put(priors, name, prior.value, uncertainty=prior.u, distribution=prior.distribution)


def _looks(entry: Any, campaign: Campaign, records: Sequence[Record]) -> None:
    """Centroids with uncertainties; missing values are NaN, or -1 in columns of integers."""
    spots, moves = campaign.spots, campaign.moves
    signal, *others = (f"{coordinate}_{side}" for side in CAMERAS for coordinate in "uv")
    group = _group(entry, "looks", "NXdata", signal=signal, axes=["spot"], auxiliary_signals=others)
    events = [look for record in records if (look := event_of(record, Looked)) is not None]
    times = {look.spot: look.time_s for look in events if look.time_s is not UNSET}
    _put(group, "time", [times.get(spot.spot, moves[spot.move].time_s) for spot in spots], "s")
    for axis in AXES:
        _put(group, f"{axis}_steps", [getattr(moves[spot.move], f"{axis}_steps") for spot in spots], "steps")
    for column in SPOTS.columns.values():
        _column(group, column, spots)


def _column(group: Any, column: Column, rows: Sequence[Move] | Sequence[Look]) -> None:
    """A column of a table: its unit becomes an attribute; standard uncertainties are the `_errors` of a value."""
    name, unit = column.name, column.unit
    if unit not in _NAMED_UNITS:
        name = name.removesuffix(f"_{unit}")
    if column.name in PIXEL_SDS:
        name = f"{name[1:]}_errors"
    name = name.replace("ruv_", "correlation_uv_")
    values = [getattr(row, column.name) for row in rows]
    if column.kind is float:
        _put(group, name, np.array([np.nan if value is None else value for value in values], dtype=float), unit)
    else:
        _put(group, name, [NOTHING if value is None else value for value in values], unit)


def _files(group: Any, folder: Path) -> None:
    """The campaign's files, byte for byte."""
    for name, cap in _FILES.items():
        if not (folder / name).is_file():
            continue
        data = read_bytes(folder / name, cap, folder)
        note = _group(group, name.replace(".", "_"), "NXnote")
        _put(note, "file_name", name)
        _put(note, "sha256", hashlib.sha256(data).hexdigest())
        note.create_dataset("data", data=np.frombuffer(data, dtype=np.uint8), compression="gzip")

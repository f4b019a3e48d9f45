"""Files of clouds: CSV, or PLY with properties that CloudCompare and MeshLab show. mm, frame T.

A file is written whole or not at all, in constant memory. Looks without a point are listed in a table beside it; if
every look has one, a table of an earlier cloud is removed.
"""

from __future__ import annotations

import csv
import io
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import BinaryIO, ClassVar

import numpy as np

from tvsbayes.coordinates.cloud import CloudBlock
from tvsbayes.errors import InputError, escaped
from tvsbayes.files.csv_table import csv_bytes
from tvsbayes.files.disk import written_whole
from tvsbayes.results.records import Record

AXIS_NAMES = "x", "y", "z"
DIGITS = 4
"""Decimals in CSV, mm: a thousandth of the least uncertainty of a point."""
REFUSED_COLUMNS = "line", "code", "message"


class CloudFile(Record, frozen=True):
    """Summary of a written cloud.

    Attributes:
        cloud: file of the cloud.
        columns: its properties, in order.
        written: number of points.
        extrapolated: number of them outside the counters of the campaign's looks.
        refused: number of looks without a point.
        refused_file: table of these; None if there are none.
        reasons: their number by the code of the reason; not part of the document.
    """

    cloud: str
    columns: tuple[str, ...]
    written: int
    extrapolated: int
    refused: int
    refused_file: str | None
    reasons: dict[str, int]
    beside: ClassVar = ("reasons",)


def columns_of(names: Sequence[str]) -> tuple[str, ...]:
    """Return the properties of a point: coordinates, sds, quality, points by named calibrations, flag, line.

    `quality` is the root of the summed variances, the property by which MeshLab colours points.
    """
    joint = (*AXIS_NAMES, *(f"sd_{axis}" for axis in AXIS_NAMES), "quality")
    return (*joint, *(f"{name}_{axis}" for name in names for axis in AXIS_NAMES), "extrapolated", "line")


def _numbers(block: CloudBlock, names: Sequence[str]) -> np.ndarray:
    """Return the values of `columns_of` except the last two, shape (n, columns - 2)."""
    sd = block.sd_mm
    parts = [block.xyz_mm, sd, np.linalg.norm(sd, axis=1, keepdims=True)]
    return np.concatenate([*parts, *(block.simple_xyz_mm[name] for name in names)], axis=1)


class _Csv:
    """Points as lines of text."""

    def add(self, stream: BinaryIO, block: CloudBlock, names: Sequence[str]) -> None:
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        numbers = _numbers(block, names).tolist()
        for row, outside, line in zip(numbers, block.extrapolated.tolist(), block.lines.tolist(), strict=True):
            # A cell is empty where a simpler calibration has no point.
            cells = ["" if value != value else f"{value:.{DIGITS}f}" for value in row]
            writer.writerow([*cells, int(outside), line])
        stream.write(text.getvalue().encode())

    def header(self, names: Sequence[str], points: int) -> bytes:
        units = [f"{column}_mm" for column in columns_of(names)[:-2]]
        return (",".join([*units, "extrapolated", "line"]) + "\n").encode()


class _Ply:
    """Points as records of binary little-endian PLY."""

    def add(self, stream: BinaryIO, block: CloudBlock, names: Sequence[str]) -> None:
        *numbers, flag, line = columns_of(names)
        rows = np.zeros(len(block.lines), [*((name, "<f4") for name in numbers), (flag, "u1"), (line, "<i4")])
        for name, values in zip(numbers, _numbers(block, names).T, strict=True):
            rows[name] = values
        rows[flag], rows[line] = block.extrapolated, block.lines
        stream.write(rows.tobytes())

    def header(self, names: Sequence[str], points: int) -> bytes:
        *numbers, flag, line = columns_of(names)
        properties = [*(f"property float {name}" for name in numbers), f"property uchar {flag}", f"property int {line}"]
        lines = [
            *("ply", "format binary_little_endian 1.0"),
            "comment mm; x depth, y along the baseline towards the positioner, z up; origin mid-baseline",
            "comment sd_: standard uncertainty; quality: root of the summed variances",
            f"element vertex {points}",
            *(*properties, "end_header"),
        ]
        return ("\n".join(lines) + "\n").encode("ascii")


FORMATS: dict[str, type[_Csv] | type[_Ply]] = {".csv": _Csv, ".ply": _Ply}


def cloud_place(path: Path, looks: Path | None = None) -> Path:
    """Return the path after checking that its ending names a format.

    Args:
        path: path of the cloud.
        looks: file of its looks, which neither the cloud nor its table of refusals may replace.

    Raises:
        InputError: it names no format, or the looks would be replaced.
    """
    shown = escaped(str(path), 200)
    if path.suffix.lower() not in FORMATS:
        found, allowed = escaped(path.suffix or path.name), " or ".join(FORMATS)
        message = f"--cloud {shown}: the ending {found} names no format"
        raise InputError("usage", message, found=found, allowed=allowed, remedy=f"name a file {allowed}")
    written = path, _refused_table(path)
    if looks is not None and any(one.exists() and looks.exists() and one.samefile(looks) for one in written):
        message = f"--cloud {shown} would replace {escaped(str(looks), 200)}, which the looks are read from"
        raise InputError("usage", message, found=shown, allowed="another file", remedy="name another cloud")
    return path


def _refused_table(path: Path) -> Path:
    """Return the path of the table of looks without a point, beside that of the cloud."""
    return path.with_name(f"{path.stem}.refused.csv")


def _removed_if_ours(table: Path) -> None:
    """Remove the table of an earlier cloud of this name, which is out of date."""
    head = csv_bytes(REFUSED_COLUMNS, ())
    if table.is_file():
        with table.open("rb") as stream:
            ours = stream.read(len(head)) == head
        if ours:
            table.unlink()


def write_cloud(blocks: Iterable[CloudBlock], path: Path, names: Sequence[str]) -> CloudFile:
    """Write a cloud, whole or not at all.

    Args:
        blocks: from `cloud.cloud`.
        path: ending in .csv or .ply.
        names: names of the simpler calibrations in the blocks.

    Raises:
        InputError: the ending is unknown, the place cannot be written to or is full, or a block raises it.
    """
    body = FORMATS[cloud_place(path).suffix.lower()]()
    points = extrapolated = 0
    refused: list[tuple[int, str, str]] = []
    # The header has the number of points, which is known at the end. They are kept on the same disk until then.
    with written_whole(path) as stream, tempfile.TemporaryFile(dir=path.parent) as kept:
        for block in blocks:
            body.add(kept, block, names)
            points += len(block.lines)
            extrapolated += int(block.extrapolated.sum())
            refused += [(line, error.code, error.message) for line, error in block.refused]
        kept.seek(0)
        stream.write(body.header(names, points))
        shutil.copyfileobj(kept, stream)
    table = _refused_table(path)
    if refused:
        with written_whole(table) as stream:
            stream.write(csv_bytes(REFUSED_COLUMNS, refused))
    else:
        _removed_if_ours(table)
    reasons = Counter(code for _, code, _ in refused)
    named = str(table) if refused else None
    return CloudFile(str(path), columns_of(names), points, extrapolated, len(refused), named, reasons)

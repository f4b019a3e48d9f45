"""Notations of numbers in cells of somebody's table: degrees, minutes and seconds, fractions, numbers with a unit."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tvsbayes.errors import escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.instrument.column_names import READING_UNITS, unit_of_name

_SEXAGESIMAL = re.compile(
    r"(?P<sign>[+-]?)\s*(?P<d>\d+)\s*(?:\u00b0|deg|d|:|\s)\s*(?P<m>\d{1,2}(?:\.\d+)?)\s*(?:['\u2032m:]|\s|$)\s*"
    r"(?:(?P<s>\d{1,2}(?:\.\d+)?)\s*(?:\"|''|\u2033|s)?)?"
)
_FRACTION = re.compile(r"(?P<sign>[+-]?)(?:(?P<whole>\d+)[ -])?(?P<above>\d+)/(?P<below>\d+)")
_WITH_UNIT = re.compile(r"(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\d\s.,;+-].*)")


@dataclass(frozen=True)
class PlainColumn:
    """A column of numbers.

    Attributes:
        cells: as plain decimal numbers, what is none as it was.
        unit: that the cells state.
        remark: which notation they had, "" where they were plain.
    """

    cells: tuple[str, ...]
    unit: str | None
    remark: str


def plain_column(name: str, cells: Sequence[str]) -> PlainColumn:
    """A column whose cells may be in degrees, minutes and seconds, have fractions or carry one unit."""
    filled = [cell for cell in cells if cell]
    if all(NUMBER.fullmatch(cell) for cell in filled):
        return PlainColumn(tuple(cells), None, "")
    for read in (_in(_degrees, "deg", "degrees, minutes and seconds"), _one_unit, _in(_fraction, None, "fractions")):
        if (found := read(name, cells)) is not None:
            return found
    return PlainColumn(tuple(cells), None, "")


def _in(
    value_of: Callable[[str], float | None], unit: str | None, words: str
) -> Callable[[str, Sequence[str]], PlainColumn | None]:
    """A reader of columns in one notation."""

    def read(name: str, cells: Sequence[str]) -> PlainColumn | None:
        found = [value_of(cell) if cell else None for cell in cells]
        if any(value is None and cell for value, cell in zip(found, cells, strict=True)):
            return None
        plain = tuple("" if value is None else repr(value) for value in found)
        return PlainColumn(plain, unit, f"column {escaped(name)}: {words}, read as decimal numbers")

    return read


def _one_unit(name: str, cells: Sequence[str]) -> PlainColumn | None:
    """A column whose cells carry one unit each, all the same."""
    matches = [_WITH_UNIT.fullmatch(cell) if cell else None for cell in cells]
    units = {match["unit"].strip() for match in matches if match}
    if len(units) != 1 or any(match is None and cell for match, cell in zip(matches, cells, strict=True)):
        return None
    text = units.pop()
    unit = "inch" if text == '"' else unit_of_name(text, READING_UNITS)
    if unit is None:
        return None
    plain = tuple("" if match is None else match["number"] for match in matches)
    return PlainColumn(plain, unit, f"column {escaped(name)}: every cell is in {unit}")


def _degrees(cell: str) -> float | None:
    """Decimal degrees; the sign is of the whole, also of -0 deg 12 min."""
    match = _SEXAGESIMAL.fullmatch(cell)
    if match is None or NUMBER.fullmatch(cell):
        return None
    minutes, seconds = float(match["m"]), float(match["s"] or 0.0)
    if minutes >= 60 or seconds >= 60:
        return None
    return math.copysign(int(match["d"]) + minutes / 60.0 + seconds / 3600.0, -1.0 if match["sign"] == "-" else 1.0)


def _fraction(cell: str) -> float | None:
    """A number with a common fraction, of inches: 1 3/8; plain ones beside them stay."""
    text = cell.removesuffix('"').removesuffix("in").strip()
    if NUMBER.fullmatch(text):
        return float(text)
    match = _FRACTION.fullmatch(text)
    if match is None or not int(match["below"]):
        return None
    return (-1.0 if match["sign"] == "-" else 1.0) * (
        int(match["whole"] or 0) + int(match["above"]) / int(match["below"])
    )

"""Assign columns of a foreign table to fields of `moves.csv` and `spots.csv`, by the words in their names.

A name is split into words ("xLeft (px)" is x, left, px); a rule is a set of words that it must contain. Units in the
name are read too. A field that two columns match is ambiguous until the user names the column.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from tvsbayes.errors import InputError, closest, escaped
from tvsbayes.files.csv_kind import Column
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import MOVES, PIXELS, SPOTS

_COLUMNS = {**SPOTS.columns, **MOVES.columns}
FIELDS = tuple(dict.fromkeys((*MOVES.columns, *SPOTS.columns)))
"""All fields that a table can give, by the columns of this package's files."""
COUNTERS = ("pan_steps", "tilt_steps")
# English, German, Spanish, French; without accents, as `words_of` splits names.
_SIDES = {
    "left": {"left", "l", "links", "linke", "linker", "izq", "izquierda", "izquierdo", "gauche", "cam1", "1"},
    "right": {"right", "r", "rechts", "rechte", "rechter", "der", "derecha", "derecho", "droite", "droit", "cam2", "2"},
}
_IMAGE_AXES = {
    "u": {"u", "x", "col", "column", "spalte", "columna", "colonne"},
    "v": {"v", "y", "row", "zeile", "fila", "renglon", "ligne"},
}
SPREAD = {
    *("sd", "std", "sigma", "s", "stdev", "unc", "uncertainty", "err", "error", "streuung", "unsicherheit"),
    *("desviacion", "incertidumbre", "ecart", "incertitude"),
}
"""Words of standard uncertainties."""
# A word of an approach counts only beside a word of its axis.
_NAMED = [column for name, column in _COLUMNS.items() if not name.endswith("_approach")]
SECONDS = {"us": 1e-6, "ms": 1e-3, "min": 60.0, "h": 3600.0}
"""Units of time that a name may state, in s."""
DEGREES = {
    **{"deg": 1.0, "rad": math.degrees(1.0), "mrad": math.degrees(1e-3), "urad": math.degrees(1e-6)},
    **{"arcmin": 1 / 60, "arcsec": 1 / 3600, "gon": 0.9},
}
"""Units of angle that a name may state, in deg."""
READING_UNITS = (*DEGREES, "mm", "um", "nm", "thou", "counts", "inch")
"""Units of readings that a name may state."""
_UNITS = {
    "us": {"us", "usec", "micros", "microseconds", "mikrosekunden", "microsegundos", "microsecondes"},
    "ms": {"ms", "msec", "millis", "milliseconds", "millisekunden", "milisegundos", "millisecondes"},
    "min": {"min", "minutes", "minuten", "minutos"},
    "h": {"h", "hr", "hrs", "hour", "hours", "stunde", "stunden", "horas", "heures"},
    "rad": {"rad", "radians", "radianten", "radianes"},
    "mrad": {"mrad", "milliradians", "millirad"},
    "gon": {"gon", "gons", "neugrad"},
    "thou": {"thou", "mil", "mils"},
    "arcmin": {"arcmin", "arcminutes", "bogenminuten"},
    "arcsec": {"arcsec", "arcseconds", "bogensekunden"},
    "deg": {"deg", "degrees", "grad", "grados", "degres"},
    "urad": {"urad", "microradians", "microrad"},
    "mm": {"mm", "millimeter", "millimeters", "millimetre", "millimetres", "milimetros"},
    "um": {"um", "micron", "microns", "micrometer", "micrometers", "mikrometer", "micrometros", "micrometres"},
    "nm": {"nm", "nanometer", "nanometers", "nanometros", "nanometres"},
    "counts": {"counts", "count", "ticks", "inkremente"},
    # Last in `READING_UNITS`, because "in" is also a word.
    "inch": {"in", "inch", "inches", "zoll", "pulgadas", "pouces"},
}


DISTANCES = {
    *("distance", "dist", "depth", "range", "abstand", "distanz", "entfernung", "tiefe"),
    *("distancia", "profundidad", "profondeur", "eloignement"),
}
"""Words of a distance to the sheet."""
PLACEMENT_ROWS = 4
"""Fewest rows of a distance that stands for a placement of the sheet; distances of single rows are measured ones."""


@dataclass(frozen=True)
class ColumnMapping:
    """Columns of a table by the field to which they belong.

    Attributes:
        columns: column by field.
        ambiguous: fields that several columns match, with these columns.
        unused: columns that match no field.
    """

    columns: dict[str, str]
    ambiguous: dict[str, tuple[str, ...]]
    unused: tuple[str, ...]


def words_of(name: str) -> list[str]:
    """The words of a column's name in small letters without accents: "xLeft_px", "X left [px]" and "XL" alike."""
    # "Winkel [\u00b0]" is an angle; a temperature ("\u00b0C") and "N\u00b0" are not.
    name = re.sub("(?<![A-Za-z])\u00b0(?![ ]*[CF])", " deg ", name)
    # The ASCII letters alone of microseconds, and of all other millionths, would be another unit.
    plain = re.sub("\u03bc(?=[A-Za-z])", "u", unicodedata.normalize("NFKD", name)).encode("ascii", "ignore").decode()
    words = []
    for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+", plain):
        word = part.lower()
        # XL, ur, su: axis and camera written together.
        joined = re.fullmatch(r"(s?)([xyuv])([lr])|([lr])([xyuv])|(s)([xyuv])", word)
        words += [piece for piece in joined.groups() if piece] if joined else [word]
    return words


def unit_of_name(name: str, units: Iterable[str]) -> str | None:
    """The first of `units` that the name states, of `SECONDS`, `DEGREES` or `READING_UNITS`; "h" is no angle."""
    words = set(words_of(name))
    return next((unit for unit in units if words & _UNITS[unit]), None)


def _field_of(name: str) -> str | None:
    """The field to which a column belongs by its name."""
    listed = words_of(name)
    word_set = set(listed)
    axes = [axis for axis, spellings in _IMAGE_AXES.items() if word_set & spellings]
    sides = [side for side, spellings in _SIDES.items() if word_set & spellings]
    if len(axes) == len(sides) == 1:
        return f"{'s' if word_set & SPREAD else ''}{axes[0]}_{sides[0]}_px"
    for axis in AXES:
        fields = (_COLUMNS[f"{axis}_approach"], _COLUMNS[f"{axis}_steps"])
        if all(word_set.intersection(column.names.split()) for column in fields):
            return f"{axis}_approach"
    return field_by_word(listed, _NAMED)


def field_by_word(words: Sequence[str], columns: Iterable[Column]) -> str | None:
    """The column named by the first known word: "sheet_id" names the sheet, "id of sheet" the id."""
    known = {word: column.name for column in columns for word in column.names.split()}
    return next((known[word] for word in words if word in known), None)


def map_columns(
    columns: Iterable[str],
    stated: Mapping[str, str] | None = None,
    fields: Sequence[str] = FIELDS,
    field_of: Callable[[str], str | None] = _field_of,
) -> ColumnMapping:
    """Assigns columns to fields, by their names.

    Args:
        columns: their names.
        stated: column by field, as the user states it; "" where the table has no such column.
        fields: all fields.
        field_of: returns the field of a name.

    Raises:
        InputError: a field or column that does not exist.
    """
    names, stated = list(columns), stated or {}
    for field, name in stated.items():
        option = f"--column {escaped(field)}={escaped(name)}"
        if field not in fields:
            allowed, remedy = ", ".join(fields), closest(field, fields)
            raise InputError("usage", f"{option}: no such field; allowed: {allowed}", allowed=allowed, remedy=remedy)
        if name and name not in names:
            allowed, remedy = ", ".join(map(escaped, names)), closest(name, names)
            raise InputError("usage", f"{option}: no such column; allowed: {allowed}", allowed=allowed, remedy=remedy)
    mapping = {field: name for field, name in stated.items() if name}
    free = [name for name in names if name not in mapping.values()]
    mapping |= {name: name for name in free if name in fields and name not in stated}
    claims: dict[str, list[str]] = {}
    for name in (n for n in free if n not in mapping.values()):
        named = field_of(name)
        if named is not None and named not in mapping and named not in stated:
            claims.setdefault(named, []).append(name)
    mapping |= {field: candidates[0] for field, candidates in claims.items() if len(candidates) == 1}
    ambiguous = {field: tuple(candidates) for field, candidates in claims.items() if len(candidates) > 1}
    used = {*mapping.values(), *(name for candidates in ambiguous.values() for name in candidates)}
    return ColumnMapping(mapping, ambiguous, tuple(name for name in names if name not in used))


def with_placements(mapping: ColumnMapping, cells: Mapping[str, Sequence[str]], stated: Iterable[str]) -> ColumnMapping:
    """The mapping with the sheet named by its distance, where no column names it.

    That needs one unused column of a distance, whose every value fills one run of rows: a sheet that is put back to a
    distance is a new placement, and a distance of each row is none.

    Args:
        mapping: columns by field.
        cells: cells by column.
        stated: fields for which the user named a column, or none.
    """
    if "target" in {*mapping.columns, *mapping.ambiguous, *stated} or not set(PIXELS) <= set(mapping.columns):
        return mapping
    named = [name for name in mapping.unused if set(words_of(name)) & DISTANCES]
    if len(named) != 1:
        return mapping
    filled = [cell for cell in cells[named[0]] if cell]
    runs = [filled[k] for k in range(len(filled)) if k == 0 or filled[k] != filled[k - 1]]
    if not runs or len(set(runs)) < len(runs) or min(map(filled.count, runs)) < PLACEMENT_ROWS:
        return mapping
    unused = tuple(name for name in mapping.unused if name != named[0])
    return ColumnMapping({**mapping.columns, "target": named[0]}, mapping.ambiguous, unused)


def missing(columns: Iterable[str], moves_known: bool) -> list[str]:
    """Fields that a campaign requires and the table lacks.

    Args:
        columns: fields in the table.
        moves_known: whether moves are listed elsewhere already.
    """
    given = set(columns)
    looked, moved = bool(given & set(PIXELS)), bool(given & set(COUNTERS))
    needed = [*(PIXELS if looked or not moved else ()), *(COUNTERS if moved or not moves_known else ())]
    return [field for field in needed if field not in given]

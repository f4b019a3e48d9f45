"""Which column of somebody's table is which field of `moves.csv` and `spots.csv`, by the words in its name.

A name is taken apart into words ("xLeft (px)" is x, left, px); a rule is a set of words that all stand in it. Units in
the name are read too. What two columns claim is nobody's until it is said which.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from tvsbayes.errors import InputError, closest, escaped
from tvsbayes.instrument.campaign import MOVE_COLUMNS, PIXELS, SPOT_COLUMNS

FIELDS: tuple[str, ...] = tuple(dict.fromkeys((*MOVE_COLUMNS, *SPOT_COLUMNS)))
"""All that a table can give, by the columns of our files."""
COUNTERS = ("pan_steps", "tilt_steps")
# English, German, Spanish, French; without accents, as `words_of` takes names apart.
_SIDES = {
    "left": {"left", "l", "links", "linke", "linker", "izq", "izquierda", "izquierdo", "gauche", "cam1", "1"},
    "right": {"right", "r", "rechts", "rechte", "rechter", "der", "derecha", "derecho", "droite", "droit", "cam2", "2"},
}
_IMAGE_AXES = {
    "u": {"u", "x", "col", "column", "spalte", "columna", "colonne"},
    "v": {"v", "y", "row", "zeile", "fila", "renglon", "ligne"},
}
_SPREAD = {
    *("sd", "std", "sigma", "s", "stdev", "unc", "uncertainty", "err", "error", "streuung", "unsicherheit"),
    *("desviacion", "incertidumbre", "ecart", "incertitude"),
}
_APPROACH = {
    *(
        "approach",
        "side",
        "from",
        "anfahrt",
        "seite",
        "von",
        "lado",
        "desde",
        "aproximacion",
        "cote",
        "approche",
        "depuis",
    ),
}
_WORDS = {
    "move": {"move", "movement", "bewegung", "fahrt", "movimiento", "mouvement", "deplacement", "pose"},
    "segment": {
        *("segment", "seg", "homing", "homings", "home", "homed", "rehomed", "reference", "referenced"),
        *("referenzfahrt", "referenziert", "referenciado", "segmento"),
    },
    "time_s": {
        *("time", "t", "timestamp", "datetime", "date", "zeit", "uhrzeit", "zeitstempel", "datum"),
        *("tiempo", "hora", "fecha", "temps", "heure", "utc"),
    },
    "pan_steps": {
        *("pan", "azimuth", "azimut", "acimut", "horizontal", "horizontale", "horiz", "hor", "schwenk", "schwenken"),
        *("giro", "panoramique"),
    },
    "tilt_steps": {
        *("tilt", "elevation", "vertical", "vert", "vertikal", "vertikale", "verticale", "hohe", "hoehe", "neigung"),
        *("neigen", "kippen", "elevacion", "inclinacion", "inclinaison"),
    },
    "spot": {
        *("spot", "look", "id", "nr", "no", "num", "index", "shot", "nummer", "aufnahme", "fleck", "numero", "toma"),
        *("mancha", "tache", "vue"),
    },
    "target": {
        *("target", "sheet", "plane", "screen", "wall", "blatt", "schirm", "wand", "ebene", "tafel", "hoja", "plano"),
        *("pantalla", "pared", "feuille", "ecran", "mur", "cible"),
    },
    "experiment": {"experiment", "exp", "versuch", "experimento", "ensayo", "essai", "experience", "trial", "run"},
    "point": {"point", "pt", "punkt", "punto"},
    "aperture_deg": {
        *("aperture", "b", "receiver", "rx", "blende", "offnung", "empfanger", "apertura", "receptor", "ouverture"),
        *("recepteur", "apertur"),
    },
    "status": {
        *("status", "state", "ok", "valid", "quality", "zustand", "gultig", "qualitat", "estado", "valido", "calidad"),
        *("etat", "valide", "qualite"),
    },
}
SECONDS = {"us": 1e-6, "ms": 1e-3, "min": 60.0, "h": 3600.0}
"""Units of times that a name may say, in s."""
DEGREES = {
    **{"deg": 1.0, "rad": math.degrees(1.0), "mrad": math.degrees(1e-3), "urad": math.degrees(1e-6)},
    **{"arcmin": 1 / 60, "arcsec": 1 / 3600},
}
"""Units of angles that a name may say, in deg."""
READING_UNITS = (*DEGREES, "mm", "um", "nm", "counts")
"""Units of readings that a name may say."""
_UNITS = {
    "us": {"us", "usec", "micros", "microseconds", "mikrosekunden", "microsegundos", "microsecondes"},
    "ms": {"ms", "msec", "millis", "milliseconds", "millisekunden", "milisegundos", "millisecondes"},
    "min": {"min", "minutes", "minuten", "minutos"},
    "h": {"h", "hr", "hrs", "hour", "hours", "stunde", "stunden", "horas", "heures"},
    "rad": {"rad", "radians", "radianten", "radianes"},
    "mrad": {"mrad", "milliradians", "millirad"},
    "arcmin": {"arcmin", "arcminutes", "bogenminuten"},
    "arcsec": {"arcsec", "arcseconds", "bogensekunden"},
    "deg": {"deg", "degrees", "grad", "grados", "degres"},
    "urad": {"urad", "microradians", "microrad"},
    "mm": {"mm", "millimeter", "millimeters", "millimetre", "millimetres", "milimetros"},
    "um": {"um", "micron", "microns", "micrometer", "micrometers", "mikrometer", "micrometros", "micrometres"},
    "nm": {"nm", "nanometer", "nanometers", "nanometros", "nanometres"},
    "counts": {"counts", "count", "ticks", "inkremente"},
}


@dataclass(frozen=True)
class Understood:
    """Columns of a table by the field that they give.

    Attributes:
        columns: column by field.
        claimed: fields that several columns could give, with these.
        unused: columns that give nothing.
    """

    columns: dict[str, str]
    claimed: dict[str, tuple[str, ...]]
    unused: tuple[str, ...]


def words_of(name: str) -> list[str]:
    """The words of a column's name in small letters without accents: "xLeft_px", "X left [px]" and "XL" alike."""
    # "Winkel [\u00b0]", but no temperature, and no number as in "N\u00b0".
    name = re.sub("(?<![A-Za-z])\u00b0(?![ ]*[CF])", " deg ", name)
    # Of microseconds, and of all other millionths, the ascii letters alone would be another unit.
    plain = re.sub("\u03bc(?=[A-Za-z])", "u", unicodedata.normalize("NFKD", name)).encode("ascii", "ignore").decode()
    found = []
    for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+", plain):
        word = part.lower()
        # XL, ur, su: an axis and a camera written together.
        glued = re.fullmatch(r"(s?)([xyuv])([lr])|([lr])([xyuv])|(s)([xyuv])", word)
        found += [piece for piece in glued.groups() if piece] if glued else [word]
    return found


def unit_of_name(name: str, units: Iterable[str]) -> str | None:
    """The first of `units` that the name says, of `SECONDS`, `DEGREES` or `READING_UNITS`; "h" is no angle."""
    words = set(words_of(name))
    return next((unit for unit in units if words & _UNITS[unit]), None)


def _field_of(name: str) -> str | None:
    """The field that a column's name tells of."""
    listed = words_of(name)
    words = set(listed)
    axes = [axis for axis, spellings in _IMAGE_AXES.items() if words & spellings]
    sides = [side for side, spellings in _SIDES.items() if words & spellings]
    if len(axes) == len(sides) == 1:
        return f"{'s' if words & _SPREAD else ''}{axes[0]}_{sides[0]}_px"
    for axis in ("pan", "tilt"):
        if words & _APPROACH and words & _WORDS[f"{axis}_steps"]:
            return f"{axis}_approach"
    # The first word tells most: "sheet_id" is of the sheet, "id of sheet" of the id.
    return next((field for word in listed for field, spellings in _WORDS.items() if word in spellings), None)


AXIS_FIELDS = ("command", "value", "u", "time_s", "segment", "approach", "status")
"""All that a table of an axis can give."""
_AXIS_WORDS = {
    "command": {
        *("command", "commanded", "cmd", "counter", "steps", "step", "counts", "target", "goal", "position", "pos"),
        *("microsteps", "microstep", "mikroschritte", "mikroschritt", "usteps", "ustep", "micropasos", "micropas"),
        *("schritte", "soll", "sollwert", "zahler", "pasos", "contador", "consigna", "posicion", "pas", "consigne"),
    },
    "value": {
        *("value", "reading", "read", "measured", "encoder", "angle", "ist", "istwert", "messwert", "winkel", "lesung"),
        *("lectura", "medida", "valor", "angulo", "codificador", "lecture", "mesure", "codeur", "autocollimator"),
    },
    "u": {"u", "sd", "std", "sigma", "unc", "uncertainty", *_SPREAD} - {"s"},
    "approach": _APPROACH | {"direction", "richtung", "direccion"},
    # Of a scanner a run is an experiment; of an axis, what lies between two homings.
    "segment": {*_WORDS["segment"], "run", "lauf", "durchlauf"},
    **{name: _WORDS[name] for name in ("time_s", "status")},
}
_FOUND_BY_ENCODERS = {"position", "pos", "posicion", "counts", "zahler", "contador"}
"""Words of commands that name what was read where another column is the command for certain."""
_TEMPERATURE = {"temp", "temperature", "temperatur", "temperatura", "humidity"}
"""Degrees of these are no angle."""


def axis_field_of(name: str) -> str | None:
    """The field of an axis that a column's name tells of: by its first word that is known."""
    known = (field for word in words_of(name) for field, spellings in _AXIS_WORDS.items() if word in spellings)
    return next(known, None)


def understand(
    columns: Iterable[str],
    stated: Mapping[str, str] | None = None,
    fields: Sequence[str] = FIELDS,
    field_of: Callable[[str], str | None] = _field_of,
) -> Understood:
    """Guess what columns are.

    Args:
        columns: their names.
        stated: column by field, where somebody has said it; an empty column: the table has none.
        fields: all that there are.
        field_of: the field that a name tells of.

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
    found = {field: name for field, name in stated.items() if name}
    free = [name for name in names if name not in found.values()]
    found |= {name: name for name in free if name in fields and name not in stated}
    claims: dict[str, list[str]] = {}
    for name in (n for n in free if n not in found.values()):
        told = field_of(name)
        if told is not None and told not in found and told not in stated:
            claims.setdefault(told, []).append(name)
    found |= {field: own[0] for field, own in claims.items() if len(own) == 1}
    claimed = {field: tuple(own) for field, own in claims.items() if len(own) > 1}
    used = {*found.values(), *(name for own in claimed.values() for name in own)}
    return Understood(found, claimed, tuple(name for name in names if name not in used))


def understand_axis(columns: Iterable[str], stated: Mapping[str, str] | None = None) -> Understood:
    """Guess what columns of an axis are, as `understand`; some names are clear only beside others.

    Beside "microsteps" a "position [um]" is what was read; where nothing else is, "mm" alone, or the one other column
    that names a unit of readings, as "dial gauge mm".

    Args:
        columns: their names.
        stated: column by field of `AXIS_FIELDS`, where somebody has said it; an empty column: the table has none.

    Raises:
        InputError: a field or column that does not exist.
    """
    names, said = list(columns), dict(stated or {})
    known = understand(names, said, AXIS_FIELDS, axis_field_of)
    if "value" in known.columns or "value" in known.claimed or "value" in said:
        return known
    claims = known.claimed.get("command", ())
    found = [name for name in claims if _FOUND_BY_ENCODERS.intersection(words_of(name))]
    sure = [name for name in claims if name not in found]
    units = [name for name in known.unused if (words := words_of(name)) and all(map(_is_reading_unit, words))]
    if len(sure) == len(found) == 1 and not units and (unit_of_name(found[0], READING_UNITS) or not known.unused):
        return understand(names, {**said, "command": sure[0], "value": found[0]}, AXIS_FIELDS, axis_field_of)
    units = units or [
        name
        for name in known.unused
        if unit_of_name(name, READING_UNITS) and not _TEMPERATURE.intersection(words_of(name))
    ]
    if len(units) == 1 and not claims:
        return understand(names, {**said, "value": units[0]}, AXIS_FIELDS, axis_field_of)
    return known


def _is_reading_unit(word: str) -> bool:
    return any(word in _UNITS[unit] for unit in READING_UNITS)


def missing(columns: Iterable[str], moves_known: bool) -> list[str]:
    """Fields without which a table makes no campaign.

    Args:
        columns: fields that it gives.
        moves_known: whether moves are listed elsewhere already.
    """
    given = set(columns)
    seen, moved = bool(given & set(PIXELS)), bool(given & set(COUNTERS))
    needed = [*(PIXELS if seen or not moved else ()), *(COUNTERS if moved or not moves_known else ())]
    return [field for field in needed if field not in given]

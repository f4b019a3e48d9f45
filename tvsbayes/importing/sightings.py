"""Moves and sightings of a head from a foreign table: counters or encoder angles, and the directions that were found.

One row is a move, a sighting, or both. Encoder angles become counters of `STEP_DEG`. Everything ends in plain rows by
the names of `moves.csv` and `sightings.csv`. Degrees; u are standard uncertainties.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tvsbayes.errors import escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import listed, refused
from tvsbayes.importing.cells import FieldCells, Wishes, homings_of, say_left_out, status_of, without_status
from tvsbayes.importing.columns import Chooser, Column, Understood, ask_of_t, columns_of, restarts
from tvsbayes.importing.counters import AXES, COUNTER_MAX, COUNTERS, Pair, are_moves, moves_of_rows, whole_counters
from tvsbayes.importing.counters import FIELDS as MOVE_FIELDS
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import HOUR_ANGLE, Unit, means, name_of, place_of, unit_named

STEP_DEG = 1e-5
"""Size of a counter step: encoders are read in degrees, and 0.04 arcsec is far below telescopes' pointing errors."""
U_DEG = 0.01
"""Standard uncertainty of a sighting where a table states none; the fit estimates its scale."""
ANGLES = ("azimuth_deg", "elevation_deg")
FIELDS = (*MOVE_FIELDS, *ANGLES, "u_deg", "status")
"""All fields that a table of sightings can have."""
NEEDED = (*COUNTERS, *ANGLES)
TURNS_MAX = 3
"""Turns of azimuth that a table may count."""
UNITS_ASKED = ("mrad", "arcmin", "arcsec")
"""Units of elevations beyond 90 deg, in the order in which they are asked for."""
ELEVATION_MAX_DEG = 90.0
ERROR_SHARE = 0.05
"""Largest range of directions, as a share of that of encoders on the axes, at which they are errors."""
TURN_SHARE = 0.05
"""Largest distance from whole turns of a jump that is one, turns."""
LONG_DEG = 90.0
"""Least move beside which one of nearly a turn is nothing special."""
FOUND_MIN, FAR_DEG = 4, 5.0
"""Fewest directions by which others are judged, and distance from theirs of one that was not found."""
LIMITS_DEG = {
    "azimuth_deg": (-360.0 * TURNS_MAX, 360.0 * TURNS_MAX),
    "elevation_deg": (-ELEVATION_MAX_DEG, ELEVATION_MAX_DEG),
    "u_deg": (0.0, 30.0),
}


@dataclass(frozen=True)
class SightingRows:
    """A head's tables as plain rows.

    Attributes:
        moves: rows of `moves.csv` by column.
        sightings: rows of `sightings.csv` by column.
        encoders: axes whose counters are angles of an encoder.
        assumed: assumptions about what the table does not state, in words.
        understood: columns by field.
        units: unit by field, as shown.
    """

    moves: list[dict[str, Any]]
    sightings: list[dict[str, Any]]
    encoders: frozenset[str]
    assumed: tuple[str, ...]
    understood: Understood
    units: Mapping[str, str]


def sighting_rows(table: ForeignTable, wishes: Wishes) -> SightingRows:
    """Derive moves and sightings from a table.

    Raises:
        Question: two columns could be one field; angles without a unit that may be radians.
        InputError: a cell is not a value of its field, the table has no row or lacks a column.
    """
    table.require_rows()
    wishes = wishes.named_in(table)
    known = sighting_columns(table, wishes.columns)
    cells, written = FieldCells(table, known.columns, wishes, [*known.remarks]).with_plain(*NEEDED, "u_deg")
    units = _units(cells, columns_of(table), written)
    of_encoders = [name for name in COUNTERS if name in units]
    counters = _counters(cells, units)
    moves, move_of_row = moves_of_rows(cells, counters)
    limits = LIMITS_DEG | ({"elevation_deg": (0.0, 2 * ELEVATION_MAX_DEG)} if from_zenith(cells) else {})
    angles = {name: cells.scaled(name, units[name], *ends) for name, ends in limits.items() if name in cells}
    if from_zenith(cells):
        angles["elevation_deg"] = [None if z is None else ELEVATION_MAX_DEG - z for z in angles["elevation_deg"]]
        cells.assumed.append(f"elevation_deg: 90 deg less column {cells.shown('elevation_deg')}, from the zenith")
    _without_directions(cells, counters, angles)
    if not wishes.relative and not {*COUNTERS} & {*wishes.columns}:
        _ask_whether_moves(cells, counters, angles, of_encoders)
    if "u_deg" not in cells:
        u = U_DEG if wishes.u_deg is None else wishes.u_deg
        angles["u_deg"] = [u] * len(table)
        how = "; --assume u_deg=NUMBER states another, and the fit finds the scale"
        cells.assumed.append(f"standard uncertainty of a sighting: {u:g} deg{how}")
    elif (coverage := name_of(known.columns["u_deg"]).coverage) is not None:
        angles["u_deg"] = [None if u is None else u / coverage for u in angles["u_deg"]]
        cells.assumed.append(f"u_deg: column {cells.shown('u_deg')} is an expanded uncertainty, over {coverage:g}")
    statuses, sightings = cells.text("status"), list[dict[str, Any]]()
    unknown = [text.strip() and not means(text, "good") and not means(text, "bad") for text in statuses]
    if "status" in cells and "status" not in wishes.columns and all(unknown):
        cells = without_status(cells, "sighting")
        statuses = cells.text("status")
    for row in range(len(table)):
        values = {name: column[row] for name, column in angles.items()}
        if not statuses[row] and all(values[name] is None for name in ANGLES):
            continue
        status = status_of(cells, row, values, "sighting")
        sightings.append({"sighting": row, "move": move_of_row[row], **values, "status": status})
    say_left_out(cells, statuses, "sighting")
    encoders = frozenset(AXES[COUNTERS.index(name)] for name in of_encoders)
    shown = dict.fromkeys(COUNTERS, "steps") | {name: unit.name for name, unit in units.items()}
    shown |= {"time_s": "s"} if "time_s" in cells else {}
    return SightingRows(moves, sightings, encoders, tuple(cells.assumed), known, shown)


def from_zenith(cells: FieldCells) -> bool:
    """Whether elevations are written as angles from the zenith; V in gon is a total station's."""
    column = name_of(cells.columns["elevation_deg"])
    is_v = column.words == ("v",) and column.unit is not None and column.unit.name == "gon"
    return is_v or place_of(column.words, "zenith") is not None


def _without_directions(cells: FieldCells, counters: Sequence[Pair], angles: dict[str, list[float | None]]) -> None:
    """Leave out directions whose two angles are one number far from all others, as 0 where nothing was found."""
    pairs = list(zip(*(angles[name] for name in ANGLES), strict=True))
    alike = [azimuth is not None and azimuth == elevation for azimuth, elevation in pairs]
    others = [row for row, (azimuth, _) in enumerate(pairs) if azimuth is not None and not alike[row]]
    if not any(alike) or len(others) < FOUND_MIN or len({counters[row][0] for row in others}) < 2:
        return
    found = np.unwrap([float(pairs[row][0] or 0.0) for row in others], period=360.0)
    slope, start = np.polyfit([counters[row][0] for row in others], found, 1)
    off = {row: (pairs[row][0] or 0.0) - start - slope * counters[row][0] for row in map(int, np.flatnonzero(alike))}
    rows = [row for row, gap in off.items() if abs((gap + 180.0) % 360.0 - 180.0) > FAR_DEG]
    for row in rows:
        for name in ANGLES:
            angles[name][row] = None
    if rows:
        cells.assumed.append(
            f"directions: none in {len(rows)} rows whose two angles are one number, far from all others"
        )


def _ask_whether_moves(
    cells: FieldCells,
    counters: Sequence[Pair],
    angles: Mapping[str, Sequence[float | None]],
    encoders: Sequence[str],
) -> None:
    """Ask where directions follow the sum of the counters, or are far too small for them."""
    homings = homings_of(cells, silent=True)
    for k, angle in enumerate(ANGLES):
        pairs = [(STEP_DEG * p[k], v) for p, v in zip(counters, angles[angle], strict=True) if v is not None]
        span = [float(np.ptp(column)) for column in zip(*pairs, strict=True)] if len(pairs) > FOUND_MIN else [0.0]
        if COUNTERS[k] in encoders and span[-1] < ERROR_SHARE * span[0]:
            names = [cells.columns[name] for name in ANGLES]
            raise refused("errors-of-directions", cells.table.file, line=cells.table.first_line, names=names)
    for k, angle in enumerate(ANGLES):
        seen = [math.nan if value is None else value for value in angles[angle]]
        there = np.unwrap([value for value in seen if not math.isnan(value)], period=360.0)
        turned = iter(there.tolist())
        found = [None if math.isnan(value) else next(turned) for value in seen]
        read = np.array(
            [pair[k] for pair, value in zip(counters, seen, strict=True) if not math.isnan(value)], dtype=float
        )
        jumps = restarts(there, read, least=1) if len(read) > FOUND_MIN else read[:0]
        if len(jumps) and not _are_turns(jumps, there, read):
            said = {"name": cells.columns[COUNTERS[k]], "field": COUNTERS[k]}
            line = cells.table.first_line
            raise refused("counters-restart", cells.table.file, line=line, jump=float(jumps.mean()), **said)
        if are_moves([pair[k] for pair in counters], found, homings):
            raise cells.table.ask("moves-or-positions", column=cells.columns[COUNTERS[k]], field=COUNTERS[k])


def _are_turns(jumps: np.ndarray, there_deg: np.ndarray, counters: np.ndarray) -> bool:
    """Whether jumps are whole turns of a direction, which a large move leaves open."""
    moves = np.diff(counters)
    slope = np.median(np.diff(there_deg)[moves != 0] / moves[moves != 0])
    turns, others = slope * jumps.mean() / 360.0, np.abs(moves)[np.abs(moves) < 0.5 * jumps.mean()]
    # Where all other moves are short, an encoder has restarted after its turn.
    long = len(others) < len(moves) - 2 * len(jumps) or np.abs(slope) * others.max(initial=0.0) > LONG_DEG
    return bool(abs(turns - round(turns)) < TURN_SHARE and long)


def sighting_columns(table: ForeignTable, stated: Mapping[str, str]) -> Understood:
    """The columns of a table of sightings by field.

    Raises:
        Question: two columns could be one field.
        InputError: a field or column that does not exist, or no column for a needed field.
    """
    chooser = Chooser.of(table, stated, FIELDS, field_of)
    known, roles = chooser.known, chooser.roles
    for angle, counter in zip(ANGLES, COUNTERS, strict=True):
        # "M1 az" beside "azimuth_rad": whole numbers without a unit are the counters.
        names = [text for text, column in known.items() if field_of(column) == angle and text not in stated.values()]
        whole = [name for name in names if known[name].whole and known[name].name.unit is None]
        if len(names) == 2 and len(whole) == 1 and counter not in roles and chooser.is_open(counter):
            roles[counter], roles[angle] = whole, [name for name in names if name not in whole]
    ask_of_t(chooser)
    for role, names in roles.items():
        # Of two directions the one that was found.
        found = [name for name in names if place_of(known[name].name.words, "observed") is not None]
        found = found if len(found) == 1 and role in ANGLES else names
        chooser.take(role, found, optional=role not in NEEDED)
    if missing := [name for name in NEEDED if name not in chooser.taken]:
        units = {n: c.name.unit for n, c in known.items() if c.name.has("deviation")}
        units |= {n: c.name.unit for n, c in known.items() if re.match("d[A-Z]|\u0394", n)}
        errors = [n for n, unit in units.items() if unit is not None and unit.kind == "angle"]
        hint = f"; {listed(errors)} are errors: add columns of the directions, command plus error" if errors else ""
        raise chooser.missing(missing, hint)
    return chooser.understood()


def field_of(column: Column) -> str | None:
    """The field to which a column belongs by its name."""
    name = column.name
    words, kind = name.words, name.unit.kind if name.unit else ""
    of_axis = [k for k, concept in enumerate(("azimuth", "elevation")) if place_of(words, concept) is not None]
    # "s" stands for seconds here.
    if (
        name.has("expanded")
        or (name.has("u") and (words != ("s",)))
        or (name.has("deviation") and kind == "angle" and not of_axis and len(words) == 1)
    ):
        return "u_deg"
    if name.has("temperature") or kind == "temperature":
        return "temperature_degC"
    if place_of(words, "zenith") is not None:
        return ANGLES[1]
    if len(of_axis) == 1:
        if "approach" in words:
            return f"{AXES[of_axis[0]]}_approach"
        if name.has("deviation") or re.match("d[A-Z]|\u0394", name.text):
            # The error of a direction is none.
            return None
        counted = place_of(words, "counter") is not None and place_of(words, "observed") is None
        return COUNTERS[of_axis[0]] if counted else ANGLES[of_axis[0]]
    if name.has("excluded", "status") and not column.numeric:
        return "status"
    if name.has("aside") or of_axis:
        return None
    if name.is_time:
        return "time_s"
    if place_of(words, "move") is not None:
        return "move"
    if name.has("segment") and column.counts_homings:
        return "segment"
    return "status" if name.has("status") else None


def _units(cells: FieldCells, known: Mapping[str, Column], written: Mapping[str, Unit | None]) -> dict[str, Unit]:
    """Units of angles by field; whole counters have none."""
    stated = unit_named(cells.wishes.angle_unit) if cells.wishes.angle_unit else None
    units: dict[str, Unit] = {}
    for name in (*ANGLES, *COUNTERS, "u_deg"):
        if name not in cells:
            continue
        column = known[cells.columns[name]]
        unit = written.get(name) or column.name.unit
        unit = HOUR_ANGLE if name in ANGLES and unit is not None and unit.name == "h" else unit
        unknown = column.name.unknown or (unit.name if unit is not None and unit.kind != "angle" else "")
        unit = unit if unit is not None and unit.kind == "angle" else None
        if unit is None and unknown and name not in COUNTERS and stated is None:
            first, said = {column.name.text: column.first}, {"unit": unknown, "column": column.name.text}
            raise cells.table.ask("unknown-angles", each=("deg", "rad"), first=first, **said)
        if name in COUNTERS:
            # 200.0 is a counter that a program wrote as a float, 15.0000 an angle.
            written_angles = [c for c in cells.text(name) if len(c.partition(".")[2]) > 1 or not _is_whole(c)]
            counted = column.name.unit is not None and column.name.unit.kind == "count"
            if unit is None and written_angles and not counted:
                unit = stated or units[ANGLES[0]]
        elif unit is None and name == "u_deg":
            unit = units["azimuth_deg"]
        elif unit is None:
            unit = stated or units.get(ANGLES[0])
            possible = _possible_units(cells) if unit is None or name == ANGLES[1] else ["deg"]
            both_unnamed = all(known[cells.columns[angle]].name.unit is None for angle in ANGLES)
            if stated is None and both_unnamed and possible != ["deg"]:
                first = {column.name.text: column.first}
                raise cells.table.ask("angles", each=possible, first=first, column=column.name.text)
            if unit is None:
                unit = unit_named("deg")
                cells.assumed.append(
                    f"angles: no unit in column {escaped(column.name.text)}, so deg; --angles says another"
                )
        if unit is not None:
            units[name] = unit
    return units


def _is_whole(cell: str) -> bool:
    return not NUMBER.fullmatch(cell) or float(cell).is_integer()


def _possible_units(cells: FieldCells) -> list[str]:
    """Units in which angles without one lie within half a turn of elevation and some of azimuth; deg alone is usual.

    Most elevations decide on degrees: a single one beyond 90 is a wrong cell.
    """
    azimuths, elevations = (
        [abs(float(cell)) for cell in cells.text(name) if NUMBER.fullmatch(cell)] for name in ANGLES
    )
    if not elevations or not azimuths:
        return ["deg"]
    in_rad = max(elevations) <= math.pi / 2 and max(azimuths) <= 2 * math.pi * TURNS_MAX
    in_deg = 2 * sum(e <= ELEVATION_MAX_DEG for e in elevations) > len(elevations)
    larger = [unit for unit in UNITS_ASKED if max(elevations) * unit_named(unit).scale <= ELEVATION_MAX_DEG]
    return ["rad", "deg"] if in_rad else ["deg"] if in_deg else larger or ["deg"]


def _counters(cells: FieldCells, units: Mapping[str, Unit]) -> list[Pair]:
    """Counters of every row, with angles of encoders in steps of `STEP_DEG`."""
    if not units.keys() & {*COUNTERS}:
        return whole_counters(cells)
    columns = list[Sequence[int]]()
    for name in COUNTERS:
        if name not in units:
            columns.append([number or 0 for number in cells.whole(name, -COUNTER_MAX, COUNTER_MAX)])
            continue
        unit, scale = units[name], units[name].scale * units[name].per_number / STEP_DEG
        limit = COUNTER_MAX / scale
        columns.append([round(scale * (v or 0.0)) for v in cells.numbers(name, -limit, limit)])
        how = f"as they stand, without whole turns, in steps of {STEP_DEG:g} deg"
        cells.assumed.append(f"{name}: angles in {unit.name} {how}")
    return list(zip(*columns, strict=True))

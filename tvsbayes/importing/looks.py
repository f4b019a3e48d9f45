"""Moves and looks of a scanner from a foreign table, as plain rows by the names of `moves.csv` and `spots.csv`.

One row is one look, one move, or both; successive rows at the same counters are looks after one move. A lab book has
experiment and point in place of pixels, and may name pictures: its looks are `undetected`. Assumptions about what the
table does not state are listed in words. Px with the integer at the centre of a pixel, (0, 0) the first pixel.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from tvsbayes.errors import escaped
from tvsbayes.files.csv_kind import ID_MAX
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import refused
from tvsbayes.importing.cells import (
    FieldCells,
    Understood,
    ask_column,
    check_stated,
    choice,
    columns_of,
    date_time,
    is_segment,
    left_out,
    readable,
    status_of,
    time_of_day,
)
from tvsbayes.importing.counters import AXES, COUNTERS, moves_of_rows, whole_counters
from tvsbayes.importing.counters import FIELDS as MOVE_FIELDS
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import Unit, means, name_of, place_of, unit_named, vocabulary, words_of

PIXELS = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
PIXEL_SDS = ("su_left_px", "sv_left_px", "su_right_px", "sv_right_px")
CORRELATIONS = ("ruv_left", "ruv_right")
FOUR_POINT = ("experiment", "point")
"""Fields of the four-point method; a table has both or neither."""
PICTURES = ("picture", "picture_left", "picture_right")
"""Files of a look: of one camera, whose pair has the same name, or of either."""
LOOK_FIELDS = ("spot", "target", *FOUR_POINT, *PIXELS, *PIXEL_SDS, "aperture_deg", "status", *CORRELATIONS)
BOOKED = (*PICTURES, "direction")
"""Fields of a lab book alone."""
FIELDS = (*MOVE_FIELDS, *LOOK_FIELDS, *BOOKED)
"""All fields that a table can have."""
SD_PX = 0.1
"""Standard uncertainty of a centroid where a table states none; the fit estimates its scale."""
PIXEL_MAX, SD_MIN, SD_MAX, APERTURE_MAX_DEG, CORRELATION_MAX, POINT_MAX = 1e6, 1e-4, 100.0, 360.0, 0.999999, 4
PLACEMENT_ROWS = 4
"""Fewest rows of a distance that stands for a placement of the sheet; distances of single rows are measured ones."""
BOOK_PLACES_MAX = 8
"""Largest number of distances of the sheets of a lab book; more are measured ones."""
UNDETECTED = "undetected"
WORDS = "looks.toml"
_NAMED = (
    "spot",
    "target",
    *FOUR_POINT,
    "aperture_deg",
    "status",
    "move",
    "segment",
    "time_s",
    *COUNTERS,
    "temperature_degC",
)
"""Fields in the order of their lists of words."""
_MARKS = {"", *"01", "true", "false", "True", "False", "TRUE", "FALSE"}
_LABELLED = re.compile(r"[^\W\d]+[ _.#-]*([0-9]{1,9})")
"""A number behind a word: P1, exp 07."""


@dataclass(frozen=True)
class LookWishes:
    """What the user states about a table of moves and looks.

    Attributes:
        columns: column by field, "" for none.
        pixels_from: coordinate of the centre of the first pixel: 0, or 1 as in MATLAB.
        angle_unit: unit of aperture readings; None: that of the column's name, else deg.
        sd_px: standard uncertainty of a centroid where no column states it.
        relative: whether counters are the steps of each move.
        approach: side from which pan and tilt came to the first row; "unknown" where it was not recorded.
        pictures: whether the files that the table names are at hand.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    pixels_from: int = 0
    angle_unit: str | None = None
    sd_px: float = SD_PX
    relative: bool = False
    approach: tuple[str, str] = ("unknown", "unknown")
    pictures: bool = False


@dataclass(frozen=True)
class LookRows:
    """Tables of a scanner as plain rows.

    Attributes:
        moves: rows of `moves.csv` by column; None where the table has no counters.
        looks: rows of `spots.csv` by column; None where it has no looks.
        pictures: of each look the names of its files as written, one or left and right; empty ones where it has none.
        directions: of each look the direction of its experiment as written, "" where no column has it.
        lines: line of the table of each look.
        created: date and time of the first row, where the table states them.
        assumed: assumptions about what the table does not state, in words.
        understood: columns by field.
        units: unit by field, as shown.
    """

    moves: list[dict[str, Any]] | None
    looks: list[dict[str, Any]] | None
    pictures: list[tuple[str, ...]]
    directions: list[str]
    lines: list[int]
    created: datetime.datetime | None
    assumed: tuple[str, ...]
    understood: Understood
    units: Mapping[str, str]


# --- columns ---------------------------------------------------------------------------------------------------------
class Claims(NamedTuple):
    """Columns by field, fields that several columns match, and columns that match none."""

    columns: dict[str, str]
    ambiguous: dict[str, tuple[str, ...]]
    unused: tuple[str, ...]

    def open_fields(self, moves_listed: bool) -> list[str]:
        """Fields that are needed and not known, and those that several columns match."""
        looked, moved = not {*PIXELS}.isdisjoint(self.columns), not {*COUNTERS}.isdisjoint(self.columns)
        needed = [*(PIXELS if looked or not moved else ()), *(COUNTERS if moved or not moves_listed else ())]
        return [*(name for name in needed if name not in self.columns), *self.ambiguous]


def look_claims(table: ForeignTable, stated: Mapping[str, str]) -> Claims:
    """Assign columns to fields by their names.

    Raises:
        InputError: a field or column that does not exist is stated.
    """
    names = list(table.columns)
    check_stated(names, stated, FIELDS)
    taken = {name: text for name, text in stated.items() if text}
    free = [text for text in names if text not in taken.values()]
    taken |= {text: text for text in free if text in FIELDS and text not in stated}
    claims: dict[str, list[str]] = {}
    for text in (text for text in free if text not in taken.values()):
        role = field_of(text)
        # A reference or a home offset that changes with every row counts no homings.
        cells = table.columns[text]
        role = None if role == "segment" and not (is_segment(cells) or {*cells} <= _MARKS) else role
        if role is not None and role not in taken and role not in stated:
            claims.setdefault(role, []).append(text)
    taken |= {role: texts[0] for role, texts in claims.items() if len(texts) == 1}
    ambiguous = {role: tuple(texts) for role, texts in claims.items() if len(texts) > 1}
    used = {*taken.values(), *(text for texts in ambiguous.values() for text in texts)}
    return Claims(taken, ambiguous, tuple(text for text in names if text not in used))


def field_of(name: str) -> str | None:
    """The field to which a column belongs by its name."""
    words = words_of(name)

    def has(*concepts: str) -> list[str]:
        return [concept for concept in concepts if place_of(words, concept, WORDS) is not None]

    axes, sides = has("u", "v"), has("left", "right")
    if len(axes) == len(sides) == 1:
        return f"{'s' if has('spread') else ''}{axes[0]}_{sides[0]}_px"
    for axis, counter in zip(AXES, COUNTERS, strict=True):
        if len(has("approach", counter)) == 2:
            return f"{axis}_approach"
    if has("picture") and not has(*COUNTERS, "time_s"):
        return f"picture_{sides[0]}" if len(sides) == 1 else "picture"
    if has("direction") and not has(*COUNTERS, "approach"):
        return "direction"
    known = {word[0]: role for role in _NAMED for word in vocabulary(role, WORDS)}
    return next((known[word] for word in words if word in known), None)


def look_columns(table: ForeignTable, claims: Claims, moves_listed: bool) -> None:
    """Ask for columns that are needed and not known, or known twice.

    Raises:
        Question: several columns could be one field, and nothing else is missing.
        InputError: no column for a needed field.
    """
    wanted = list(dict.fromkeys(claims.open_fields(moves_listed)))
    missing = [name for name in wanted if name not in claims.ambiguous]
    if not wanted:
        return
    known = columns_of(table)
    if not missing:
        role, texts = next(iter(claims.ambiguous.items()))
        answers = [choice({role: text}, known) for text in texts]
        answers += [] if role in (*PIXELS, *COUNTERS) else [choice({role: ""}, known)]
        listed = " or ".join(map(escaped, texts))
        raise ask_column(table, f"{len(texts)} columns that could be {role} ({listed})", answers)
    ambiguous = [f"{role} ({' or '.join(map(escaped, texts))})" for role, texts in claims.ambiguous.items()]
    understood = ", ".join(f"{name} = {escaped(claims.columns[name])}" for name in FIELDS if name in claims.columns)
    options = " ".join(f"--column {name}=NAME" for name in wanted)
    optional = [name for name in wanted if name not in (*PIXELS, *COUNTERS)]
    hint = f"; --column {optional[0]}= where there is none" if optional else ""
    if {*claims.columns}.isdisjoint((*PIXELS, *COUNTERS)):
        hint += "; or --axis, where one axis and its readings are meant, --sightings, where a head says where it points"
    if not understood and not ambiguous:
        hint += "; if that line is a title, delete it, so that the first holds the names of the columns"
    said = {"fields": ", ".join([*missing, *ambiguous]), "known": understood or "nothing"}
    names = ", ".join(map(escaped, table.columns))
    raise refused("missing-column", table.file, line=table.first_line, names=names, options=options, hint=hint, **said)


def _by_distance(claims: Claims, table: ForeignTable, stated: Mapping[str, str]) -> str | None:
    """The column of distances that names the sheet where no other does.

    That needs one unused column of a distance, whose every value fills one run of rows: a sheet that is put back to a
    distance is a new placement, and a distance of each row is none. A lab book's sheet stands at two distances in turn.
    """
    seen, book = {*PIXELS} <= {*claims.columns}, {*FOUR_POINT} <= {*claims.columns}
    if "target" in {*claims.columns, *claims.ambiguous, *stated} or not (seen or book):
        return None
    named = [text for text in claims.unused if place_of(words_of(text), "distance", WORDS) is not None]
    if len(named) != 1:
        return None
    filled = [cell for cell in table.columns[named[0]] if cell]
    runs = [filled[k] for k in range(len(filled)) if k == 0 or filled[k] != filled[k - 1]]
    if book and not seen:
        return named[0] if len({*filled}) <= BOOK_PLACES_MAX else None
    is_placement = runs and len({*runs}) == len(runs) and min(map(filled.count, runs)) >= PLACEMENT_ROWS
    return named[0] if is_placement else None


# --- rows ------------------------------------------------------------------------------------------------------------
def look_rows(table: ForeignTable, claims: Claims, wishes: LookWishes, moves_listed: int | None = None) -> LookRows:
    """Derive moves and looks from a table.

    Args:
        table: the table.
        claims: its columns by field; see `look_claims`, `look_columns`.
        wishes: what the user states.
        moves_listed: number of moves that are known already, for a table of looks alone.

    Raises:
        Question: times that step back.
        InputError: a cell is not a value of its field, or the moves of looks are unknown.
    """
    table.require_rows()
    columns, unused, assumed = dict(claims.columns), list(claims.unused), list[str]()
    if (distance := _by_distance(claims, table, wishes.columns)) is not None:
        columns["target"] = distance
        unused.remove(distance)
    seen = not {*PIXELS}.isdisjoint(columns)
    if seen or not wishes.pictures:
        # Pictures of looks with centres are of no use here.
        named = [name for name in BOOKED if name in columns]
        unused += [
            columns.pop(name)
            for name in named
            if name not in wishes.columns and (seen or name == "direction" or not {*FOUR_POINT} <= {*columns})
        ]
    cells = FieldCells(table, columns)
    moves, units = None, _units(cells, wishes)
    if all(name in cells for name in COUNTERS):
        rows = moves_of_rows(cells, whole_counters(cells), assumed, relative=wishes.relative, approach=wishes.approach)
        moves, move_of_row = rows.moves, rows.move_of_row
    else:
        move_of_row = _listed_moves(cells, moves_listed or 0)
    book = not seen and ({*FOUR_POINT} <= {*columns} or any(name in columns for name in PICTURES))
    if moves is not None and (seen or book):
        what = "pixels" if seen else "a point or a picture"
        text = f"moves: those of the table; rows without {what} are moves without a look, which play remembers too"
        assumed.insert(len(assumed) - wishes.relative, text)
    if moves is not None and not seen and not book:
        assumed += _renumbered(cells, move_of_row)
    looks: list[dict[str, Any]] | None = None
    row_of_look: list[int] = []
    if seen or book:
        looks, row_of_look = _looks(cells, move_of_row, wishes, assumed, seen)
    if distance is not None:
        assumed.append(
            f"target: every value of {escaped(distance)} is one placement of the sheet; --column target= says no"
        )
    files = [cells.text(name) for name in PICTURES if name in cells]
    pictures = [tuple(column[row].strip() for column in files) for row in row_of_look] if files else []
    if files and not wishes.pictures:
        names = ", ".join(escaped(columns[name]) for name in PICTURES if name in columns)
        assumed.append(
            f"pictures: {names} names them; --pictures FOLDER brings them into frames/, for `tvsbayes detect`"
        )
    created = _created(cells.text("time_s")[0]) if moves is not None else None
    order = Understood({name: columns[name] for name in FIELDS if name in columns}, tuple(unused))
    lines = [table.lines[row] for row in row_of_look]
    directions = [cells.text("direction")[row] for row in row_of_look] if "direction" in cells else []
    return LookRows(
        moves, looks, pictures, directions or [""] * len(lines), lines, created, tuple(assumed), order, units
    )


def with_one_clock(table: ForeignTable, claims: Claims) -> tuple[ForeignTable, Claims]:
    """The table with a column of dates and one of times of day as one column of times."""
    names = claims.ambiguous.get("time_s", ())
    cells = [table.columns[name] for name in names]
    if len(names) != 2:
        return table, claims
    kinds = [
        {
            "day" if time_of_day(cell) is None and date_time(cell) else "hour" if time_of_day(cell) is not None else ""
            for cell in own
        }
        for own in cells
    ]
    if sorted(map(sorted, kinds)) != [["day"], ["hour"]]:
        return table, claims
    days, hours = cells if kinds[0] == {"day"} else cells[::-1]
    name = " ".join(names)
    stamps = tuple(f"{_day(day)}T{_hour(hour)}" for day, hour in zip(days, hours, strict=True))
    ambiguous = {role: texts for role, texts in claims.ambiguous.items() if role != "time_s"}
    columns = {**claims.columns, "time_s": name}
    return replace(table, columns={**table.columns, name: stamps}), Claims(columns, ambiguous, claims.unused)


def _created(cell: str) -> datetime.datetime | None:
    """The date and time of a cell, without a zone where it states none."""
    at = None if NUMBER.fullmatch(cell) else date_time(cell)
    zoned = re.search(r"(?:Z|[+-]\d\d:?\d\d)$", cell)
    return at if at is None or zoned else at.replace(tzinfo=None)


def _day(cell: str) -> str:
    at = date_time(cell)
    assert at is not None
    return at.date().isoformat()


def _hour(cell: str) -> str:
    seconds = time_of_day(cell) or 0.0
    return f"{int(seconds // 3600):02d}:{int(seconds // 60) % 60:02d}:{seconds % 60:09.6f}"


def _units(cells: FieldCells, wishes: LookWishes) -> dict[str, str]:
    """Unit by field, as shown."""
    units = {**dict.fromkeys(PIXELS, f"px from {wishes.pixels_from}"), **dict.fromkeys(PIXEL_SDS, "px")}
    units |= dict.fromkeys(COUNTERS, "steps")
    if "aperture_deg" in cells:
        units["aperture_deg"] = _aperture_unit(cells, wishes).name
    if "time_s" in cells:
        unit = name_of(cells.columns["time_s"]).unit
        units["time_s"] = unit.name if unit is not None and unit.kind == "time" else "s"
    return units


def _aperture_unit(cells: FieldCells, wishes: LookWishes) -> Unit:
    unit = name_of(cells.columns["aperture_deg"]).unit if wishes.angle_unit is None else unit_named(wishes.angle_unit)
    return unit if unit is not None and unit.kind == "angle" else unit_named("deg")


def _listed_moves(cells: FieldCells, known: int) -> list[int]:
    """Number of the move of every row of a table without counters."""
    table, count = cells.table, len(cells.table)
    if "move" not in cells:
        if known != count:
            raise refused("look-moves", table.file, looks=count, moves=known)
        return list(range(count))
    numbers = [number or 0 for number in cells.whole("move", -ID_MAX, ID_MAX)]
    for row, number in enumerate(numbers):
        if not 0 <= number < known:
            allowed = f"the number of a move, 0 to {known - 1}"
            raise cells.refuse(row, "move", allowed, "moves count from 0; list them first")
    return numbers


def _renumbered(cells: FieldCells, move_of_row: Sequence[int]) -> list[str]:
    """A note where a table without looks numbers its moves differently from `moves.csv`, by which pictures pair."""
    role = "move" if "move" in cells else "spot"
    if role not in cells:
        return []
    numbers = [float(cell) if NUMBER.fullmatch(cell) else None for cell in cells.text(role)]
    differing = [row for row, number in enumerate(numbers) if number is not None and number != move_of_row[row]]
    if not differing:
        return []
    name, row = escaped(cells.columns[role]), differing[0]
    count = f"{len(differing)} of {len(numbers)} rows"
    example = f"{name} {escaped(cells.text(role)[row])} is move {move_of_row[row]}"
    consequence = f"pictures are paired by the move, not by {name}"
    return [f"move: counted from 0, not as {name} does in {count}: {example}; {consequence}"]


def _looks(
    cells: FieldCells, move_of_row: Sequence[int], wishes: LookWishes, assumed: list[str], seen: bool
) -> tuple[list[dict[str, Any]], list[int]]:
    """The looks of a table, with centres or waiting for pictures, and the row of each."""
    pixels = [cells.numbers(name, -PIXEL_MAX, PIXEL_MAX, optional=True) for name in PIXELS]
    sds = [cells.numbers(name, -SD_MAX, SD_MAX, optional=True) if name in cells else None for name in PIXEL_SDS]
    if seen and any(column is None for column in sds):
        text = f"standard uncertainty of a centroid: {wishes.sd_px:g} px; --sd-px states another"
        assumed.append(f"{text}, the fit finds the scale" if all(c is None for c in sds) else text)
    numbers = cells.whole("spot", 0, ID_MAX, optional=True)
    statuses, targets = cells.text("status"), cells.text("target")
    remarks = list[str]()
    four = _four_point(cells, remarks, not seen)
    pictures = [cells.text(name) for name in PICTURES if name in cells]
    marks = [*pixels, [status or None for status in statuses]] if seen else [four["point"] if four else [], *pictures]
    # The other rows are moves without a look.
    is_look = [
        any(row) if not seen else any(v is not None for v in row) for row in zip(*(m for m in marks if m), strict=True)
    ]
    look_numbers = [number for number, is_one in zip(numbers, is_look, strict=True) if is_one]
    unique = None not in look_numbers and len({*look_numbers}) == len(look_numbers)
    if "spot" in cells and not unique:
        assumed.append("spot: numbers are missing or repeated, so looks are numbered by their rows")
    assumed += remarks
    correlations = {
        name: [
            0.0 if value is None else value
            for value in cells.numbers(name, -CORRELATION_MAX, CORRELATION_MAX, optional=True)
        ]
        for name in CORRELATIONS
        if name in cells
    }
    readings: list[float | None] = [None] * len(statuses)
    if "aperture_deg" in cells:
        unit = _aperture_unit(cells, wishes)
        limit = APERTURE_MAX_DEG / (scale := unit.scale * unit.per_number)
        readings = [
            None if v is None else scale * v for v in cells.numbers("aperture_deg", -limit, limit, optional=True)
        ]
    looks, row_of_look = list[dict[str, Any]](), list[int]()
    for row, move in enumerate(move_of_row):
        if not is_look[row]:
            continue
        centre = dict(zip(PIXELS, (column[row] for column in pixels), strict=True))
        if not seen:
            waits = means(statuses[row], "good") or statuses[row].strip().lower() in ("", UNDETECTED)
            status = UNDETECTED if waits else status_of(cells, row, {}, "look")
        else:
            no_centre = None in centre.values() and not statuses[row].strip()
            status = "no centre in the table" if no_centre else status_of(cells, row, centre, "look")
        values = {name: column[row] for name, column in (four | correlations).items()}
        if status == "ok":
            values |= {name: value - wishes.pixels_from for name, value in centre.items() if value is not None}
            values |= {n: _sd_px(cells, row, n, column, wishes) for n, column in zip(PIXEL_SDS, sds, strict=True)}
        number = numbers[row] if unique else row
        target = readable(targets[row], "sheet", 100)
        looks.append(
            {"spot": number, "move": move, "target": target, "aperture_deg": readings[row], "status": status, **values}
        )
        row_of_look.append(row)
    if "status" in cells:
        waiting = [
            s
            for s, is_one in zip(statuses, is_look, strict=True)
            if seen or (is_one and s.strip().lower() != UNDETECTED)
        ]
        assumed += left_out(cells, waiting, "look")
    return looks, row_of_look


def _four_point(cells: FieldCells, assumed: list[str], book: bool) -> dict[str, list[int | None]]:
    """The columns of the four-point method by field; none where the table has only one of them."""
    fields = [name for name in FOUR_POINT if name in cells]
    if len(fields) == 1:
        # A column "point" with 1 ... 200 counts looks.
        column = escaped(cells.columns[fields[0]])
        assumed.append(f"column {column} is left out: no column gives the other of {' and '.join(FOUR_POINT)}")
    if len(fields) < len(FOUR_POINT):
        return {}
    # A spreadsheet's merged cells: the number stands in the first row of an experiment alone.
    numbers, filled = cells.text("experiment"), 0
    if book:
        for row, point in enumerate(cells.text("point")):
            if point and not numbers[row] and row and numbers[row - 1]:
                numbers[row], filled = numbers[row - 1], filled + 1
    if filled:
        assumed.append(f"experiment: {filled} rows with a point alone are of the experiment above them")
    texts = {"experiment": numbers, "point": cells.text("point")}
    # P1, exp 07.
    plain = {
        cells.columns[name]: tuple(
            _LABELLED.sub(r"\1", cell) if _LABELLED.fullmatch(cell) else cell for cell in texts[name]
        )
        for name in fields
    }
    numbered = replace(cells, table=replace(cells.table, columns={**cells.table.columns, **plain}))
    limits = {"experiment": (0, ID_MAX), "point": (1, POINT_MAX)}
    rows = list(zip(*(numbered.whole(name, *limits[name], optional=True) for name in FOUR_POINT), strict=True))
    half = sum((experiment is None) != (point is None) for experiment, point in rows)
    if half:
        assumed.append(f"experiment, point: {half} row{'s' * (half != 1)} with only one of them, which is left out")
    whole = [(None, None) if None in row else row for row in rows]
    return {name: list(column) for name, column in zip(FOUR_POINT, zip(*whole, strict=True), strict=True)}


def _sd_px(cells: FieldCells, row: int, name: str, column: Sequence[float | None] | None, wishes: LookWishes) -> float:
    """The standard uncertainty of a centre; cells of rows without a centre are not checked."""
    if column is None:
        return wishes.sd_px
    sd = column[row]
    if sd is None or sd < SD_MIN:
        allowed = f"a number from {SD_MIN:g} to {SD_MAX:g} where the look is ok"
        raise cells.refuse(row, name, allowed, f"complete the cell, or write --column {name}= and --sd-px")
    return sd

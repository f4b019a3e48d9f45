"""Moves and looks of a scanner from a foreign table, as plain rows by the names of `moves.csv` and `spots.csv`.

One row is one look, one move, or both; successive rows at the same counters are looks after one move. A lab book has
experiment and point in place of pixels, and may name pictures: its looks are `undetected`. Assumptions about what the
table does not state are listed in words. Px with the integer at the centre of a pixel, (0, 0) the first pixel.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from tvsbayes.errors import InputError, escaped, plural
from tvsbayes.files.csv_kind import ID_MAX
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import listed, refused
from tvsbayes.importing.cells import FieldCells, Wishes, homings_of, readable, say_left_out, status_of
from tvsbayes.importing.clock import date_time, joined_clock, stamp_of, time_of_day
from tvsbayes.importing.columns import Chooser, Column, Understood, ask_of_t, columns_of, missing_columns
from tvsbayes.importing.counters import AXES, COUNTERS, Pair, are_moves, moves_of_rows, whole_counters
from tvsbayes.importing.counters import FIELDS as MOVE_FIELDS
from tvsbayes.importing.prepared import continued
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import Unit, means, name_of, place_of, unit_named, vocabulary, words_of

PIXELS = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
PIXEL_SDS = ("su_left_px", "sv_left_px", "su_right_px", "sv_right_px")
CORRELATIONS = ("ruv_left", "ruv_right")
NEEDED = (*PIXELS, *COUNTERS)
FOUR_POINT = ("experiment", "point")
"""Fields of the four-point method; a table has both or neither."""
PICTURES = ("picture", "picture_left", "picture_right")
"""Files of a look: of one camera, whose pair has the same name, or of either."""
LOOK_FIELDS = ("spot", "target", *FOUR_POINT, *PIXELS, *PIXEL_SDS, "aperture_deg", "status", *CORRELATIONS)
BOOKED = (*PICTURES, "direction")
"""Fields of a lab book alone."""
FIELDS = (*MOVE_FIELDS, *LOOK_FIELDS, *BOOKED)
"""All fields that a table can have."""
PIXEL_MAX, SD_MIN, SD_MAX, APERTURE_MAX_DEG, CORRELATION_MAX, POINT_MAX = 1e6, 1e-4, 100.0, 360.0, 0.999999, 4
FILLS = (4095.0, 32767.0, 65535.0)
"""Largest numbers of 12, 15 and 16 bits, which programs write for no spot."""
SHARE_MIN = 8
"""Fewest coordinates, all below 1, that are shares of the picture's width."""
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
PLACES = ("x", "y")
"""Words of columns that hold places of other things than spots as well."""
_MARKS = {"", *"01", "true", "false", "True", "False", "TRUE", "FALSE"}
_LABELLED = re.compile(r"\A[^\W\d]+[ _.#-]*([0-9]{1,9})\Z")
"""A number behind a word: P1, exp 07."""


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
def look_columns(table: ForeignTable, stated: Mapping[str, str]) -> Chooser:
    """The columns by field, as far as each field has one alone; a date and a time of day in two columns are one clock.

    Raises:
        InputError: a field or column that does not exist is stated.
    """
    stated = table.named(stated)
    table = by_look(table, stated)
    words = _names_counted(table)
    chooser = Chooser.of(table, stated, FIELDS, lambda column: _role(column, words[column.name.text]))
    clocks = chooser.roles.get("time_s", []) if chooser.is_open("time_s") else []
    ask_of_t(chooser)
    kinds = {_kind_of_clock(table.columns[name]): name for name in clocks}
    if len(clocks) == 2 and kinds.keys() == {"day", "hour"}:
        name = " ".join(clocks)
        stamps = joined_clock(table.columns[kinds["day"]], table.columns[kinds["hour"]])
        chooser.table = replace(table, columns={**table.columns, name: stamps})
        chooser.known = {n: c for n, c in columns_of(chooser.table).items() if n not in clocks}
        chooser.roles["time_s"] = [name]
    for role, names in chooser.roles.items():
        if len(names) == 1:
            chooser.take(role)
    return chooser


def by_look(table: ForeignTable, stated: Mapping[str, str]) -> ForeignTable:
    """A table with a row for each camera of a look as one with a row for each look; other tables are unchanged.

    Raises:
        InputError: a look has no row of either camera, or no column says which camera a row is of.
    """
    names = _names_counted(table)
    pixels = {text: found for text, words in names.items() if (found := _pixel_of(words))}
    axes = list(pixels.values())
    several = {"u", "v"} - {*axes} or len({*axes}) != len(axes)
    if several or {*stated, *(field_of(text, words) for text, words in names.items())} & {*PIXELS}:
        return table
    sides = {
        text: {cell: _side_of(words) for cell, words in _counted_from_1(cells).items()}
        for text, cells in table.columns.items()
        if text not in pixels
    }
    cameras = [text for text, found in sides.items() if {*found.values()} == {"left", "right"}]
    # A target "left wall", a star "R Leo", sheets 1 and 2 are no cameras beside a column that is called so.
    called = [text for text in cameras if place_of(names[text], "camera", WORDS) is not None]
    cameras = called if len(called) == 1 else cameras

    def refuse(what: str) -> InputError:
        return refused("rows-of-cameras", table.file, line=table.first_line, lack=what, columns=list(pixels))

    if len(cameras) != 1:
        of_cameras = any(place_of(words, "camera", WORDS) is not None for words in names.values())
        if all({*names[text]} & {*PLACES} for text in pixels) and not of_cameras:
            return table
        raise refuse("pixels that no column gives to a camera")
    camera = [sides[cameras[0]][cell] for cell in table.columns[cameras[0]]]
    others = [text for text in table.columns if text not in pixels and text != cameras[0]]
    pairs = list(zip(range(0, len(table) - 1, 2), range(1, len(table), 2), strict=True))
    same = all(
        camera[a] != camera[b] and all(table.columns[t][a] == table.columns[t][b] for t in others) for a, b in pairs
    )
    if len(table) % 2 or not same:
        raise refuse("a look without a row of either camera")
    columns = {text: tuple(table.columns[text][a] for a, _ in pairs) for text in others}
    for text, axis in pixels.items():
        for side in ("left", "right"):
            cells = tuple(table.columns[text][a if camera[a] == side else b] for a, b in pairs)
            columns[f"{axis}_{side}_px"] = cells
    kind = f"{table.kind}, two rows a look by column {escaped(cameras[0])}"
    return replace(table, kind=kind, columns=columns, lines=tuple(table.lines[a] for a, _ in pairs))


def _pixel_of(words: Sequence[str]) -> str:
    """Whether a column holds u or v, or their uncertainty su or sv, of a camera that it does not name."""
    found = [c for c in ("u", "v", "left", "right", "spread", "distance") if place_of(words, c, WORDS) is not None]
    if not found or found[0] not in ("u", "v") or found[1:] not in ([], ["spread"]):
        return ""
    return f"{'s' * (len(found) == 2)}{found[0]}"


def _counted_from_1(texts: Iterable[str], concepts: Sequence[str] = ()) -> dict[str, list[str]]:
    """Words of each text; cameras that are counted from 0, beside a word of a concept, are counted from 1."""
    words = {text: words_of(text) for text in texts}
    zeros = [own for own in words.values() if "0" in own]
    if any(not concepts or any(place_of(own, c, WORDS) is not None for c in concepts) for own in zeros):
        words = {text: [{"0": "1", "1": "2"}.get(word, word) for word in own] for text, own in words.items()}
    return words


def _names_counted(table: ForeignTable) -> dict[str, list[str]]:
    return _counted_from_1(table.columns, ("u", "v", "picture"))


def _side_of(words: Sequence[str]) -> str:
    sides = [side for side in ("left", "right") if place_of(words, side, WORDS) is not None]
    return sides[0] if len(sides) == 1 else ""


def _kind_of_clock(cells: Sequence[str]) -> str:
    """Whether all cells are days, or times of day; else ""."""
    kinds = {"hour" if time_of_day(cell) is not None else "day" if date_time(cell) else "" for cell in cells}
    return kinds.pop() if len(kinds) == 1 else ""


def _role(column: Column, words: Sequence[str]) -> str | None:
    """The field to which a column belongs; a reference that changes with every row counts no homings."""
    role = field_of(column.name.text, words)
    of_unit = column.name.unit.kind if column.name.unit else ""
    if of_unit == "temperature" and role in (None, "time_s"):
        return "temperature_degC"
    if role == "time_s" and column.name.words[:1] == ("t",) and not column.name.is_time:
        return None
    if role is None and column.name.has("status", "excluded") and not column.numeric:
        return "status"
    return role if role != "segment" or column.counts_homings or {*column.cells} <= _MARKS else None


def field_of(name: str, words: Sequence[str] | None = None) -> str | None:
    """The field to which a column belongs by its name, or by the words of it with cameras counted from 1."""
    words = words_of(name) if words is None else words

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


def _claimed_twice(chooser: Chooser) -> dict[str, list[str]]:
    return {role: names for role, names in chooser.roles.items() if len(names) > 1 and chooser.is_open(role)}


def open_fields(chooser: Chooser, moves_listed: bool) -> list[str]:
    """Fields that are needed and not known, and those that several columns match."""
    looked, moved = not {*PIXELS}.isdisjoint(chooser.taken), not {*COUNTERS}.isdisjoint(chooser.taken)
    needed = [*(PIXELS if looked or not moved else ()), *(COUNTERS if moved or not moves_listed else ())]
    missing = [name for name in needed if name not in chooser.taken]
    return list(dict.fromkeys([*missing, *_claimed_twice(chooser)]))


def _check_open(chooser: Chooser, moves_listed: bool) -> None:
    """Ask for columns that are needed and not known, or known twice."""
    twice, wanted = _claimed_twice(chooser), open_fields(chooser, moves_listed)
    missing = [name for name in wanted if name not in twice]
    texts = {role: " or ".join(map(escaped, names)) for role, names in twice.items()}
    unused = chooser.understood().unused
    left = {name: chooser.known[name] for name in unused}
    numbers = [n for n, c in left.items() if c.numeric and not c.name.has("temperature", "time", "index")]
    if not wanted and {*PIXELS}.isdisjoint(chooser.taken) and {*PIXELS}.isdisjoint(chooser.stated) and len(numbers) > 3:
        answers = [chooser.answer(dict(zip(PIXELS, numbers, strict=False))), chooser.answer({PIXELS[0]: ""})]
        raise chooser.ask(f"counters, and numbers that may be pixels ({listed(numbers)})", answers)
    if wanted and not missing:
        role, names = next(iter(twice.items()))
        answers = [chooser.answer({role: name}) for name in (*names, *([] if role in NEEDED else [""]))]
        raise chooser.ask(f"{len(names)} columns that could be {role} ({texts[role]})", answers)
    if wanted:
        optional = [name for name in wanted if name not in NEEDED]
        hint = f"; --column {optional[0]}= where there is none" if optional else ""
        if {*chooser.taken}.isdisjoint(NEEDED):
            hint += "; or --axis, where one axis and its readings are meant, --sightings, where a head says where it "
            hint += "points"
        known = {name: chooser.taken[name] for name in FIELDS if name in chooser.taken}
        fields = [*missing, *(f"{role} ({text})" for role, text in texts.items())]
        raise missing_columns(chooser.table, known, fields, wanted, hint)


def _by_distance(chooser: Chooser) -> str | None:
    """The column of distances that names the sheet where no other does.

    That needs one unused column of a distance, whose every value fills one run of rows: a sheet that is put back to a
    distance is a new placement, and a distance of each row is none. A lab book's sheet stands at two distances in turn.
    """
    seen, book = {*PIXELS} <= {*chooser.taken}, {*FOUR_POINT} <= {*chooser.taken}
    unused = chooser.understood().unused
    named = [text for text in unused if place_of(words_of(text), "distance", WORDS) is not None]
    if not chooser.is_open("target") or not (seen or book) or len(named) != 1:
        return None
    filled = [cell for cell in chooser.table.columns[named[0]] if cell]
    if book and not seen:
        return named[0] if len({*filled}) <= BOOK_PLACES_MAX else None
    runs = [filled[k] for k in range(len(filled)) if k == 0 or filled[k] != filled[k - 1]]
    is_placement = runs and len({*runs}) == len(runs) and min(map(filled.count, runs)) >= PLACEMENT_ROWS
    return named[0] if is_placement else None


# --- rows ------------------------------------------------------------------------------------------------------------
def look_rows(chooser: Chooser, wishes: Wishes, moves_listed: int | None = None) -> LookRows:
    """Derive moves and looks from a table.

    Args:
        chooser: its columns by field; see `look_columns`.
        wishes: what the user states.
        moves_listed: number of moves that are known already, for a table of looks alone.

    Raises:
        Question: a field of two columns; times that step back.
        InputError: no column for a needed field, a cell is not a value of its field, or the moves of looks are unknown.
    """
    table = chooser.table
    _check_open(chooser, moves_listed is not None)
    table.require_rows()
    if (distance := _by_distance(chooser)) is not None:
        chooser.taken["target"] = distance
    columns, unused = dict(chooser.taken), [*chooser.understood().unused]
    seen = not {*PIXELS}.isdisjoint(columns)
    if seen or not wishes.pictures:
        # Pictures of looks with centres are of no use here.
        named = [name for name in BOOKED if name in columns and name not in wishes.columns]
        numbered = not seen and {*FOUR_POINT} <= {*columns}
        unused += [columns.pop(name) for name in named if not numbered or name == "direction"]
    cells = FieldCells(table, columns, wishes)
    moves, aperture = None, _aperture_unit(cells)
    is_book = not seen and ({*FOUR_POINT} <= {*columns} or any(name in columns for name in PICTURES))
    if all(name in cells for name in COUNTERS):
        counters = whole_counters(cells)
        _refuse_other_pixels(cells)
        _ask_of_counters(cells, counters)
        moves, move_of_row = moves_of_rows(cells, counters)
        if seen or is_book:
            what = "pixels" if seen else "a point or a picture"
            text = f"moves: those of the table; rows without {what} are moves without a look, which play remembers too"
            cells.assumed.insert(len(cells.assumed) - wishes.relative, text)
        else:
            _say_renumbered(cells, move_of_row)
    else:
        move_of_row = _listed_moves(cells, moves_listed or 0)
    looks = _looks(cells, move_of_row, aperture, seen) if seen or is_book else {}
    if distance is not None:
        how = "is one placement of the sheet; --column target= says no"
        cells.assumed.append(f"target: every value of {escaped(distance)} {how}")
    files = {columns[name]: cells.text(name) for name in PICTURES if name in cells}
    if files and not wishes.pictures:
        how = "--pictures FOLDER brings them into frames/, for `tvsbayes detect`"
        cells.assumed.append(f"pictures: {', '.join(map(escaped, files))} names them; {how}")
    unit, directions = name_of(columns.get("time_s", "")).unit, cells.text("direction")
    units = dict.fromkeys(PIXELS, f"px from {wishes.pixels_from}") | dict.fromkeys(PIXEL_SDS, "px")
    units |= {**dict.fromkeys(COUNTERS, "steps"), "aperture_deg": aperture.name}
    units["time_s"] = unit.name if unit is not None and unit.kind == "time" else "s"
    return LookRows(
        moves,
        list(looks.values()) if seen or is_book else None,
        [tuple(column[row].strip() for column in files.values()) for row in looks] if files else [],
        [directions[row] for row in looks],
        [table.lines[row] for row in looks],
        stamp_of(cells.text("time_s")[0]) if moves is not None else None,
        tuple(cells.assumed),
        Understood({name: columns[name] for name in FIELDS if name in columns}, tuple(unused)),
        units,
    )


def _refuse_other_pixels(cells: FieldCells) -> None:
    """Refuse centres in another unit, of pictures that were turned, or as shares of the picture."""
    for pixel in PIXELS:
        text = cells.columns.get(pixel, "")
        if not text or pixel in cells.wishes.columns:
            continue
        name, values = name_of(text), [v for v in cells.numbers(pixel, -PIXEL_MAX, PIXEL_MAX, optional=True) if v]
        kinds = {
            name.unit.name if name.unit else "": name.unit is not None and name.unit.kind in ("length", "angle"),
            "shares of the picture": len(values) >= SHARE_MIN and all(v % 1 and abs(v) < 1 for v in values),
            "a rectified picture": place_of(name.words, "rectified", WORDS) is not None,
            "rows from the bottom": place_of(name.words, "upward", WORDS) is not None,
        }
        if what := next((word for word, is_one in kinds.items() if is_one), ""):
            said = {"name": text, "of": what, "field": pixel}
            raise refused("other-pixels", cells.table.file, line=cells.table.first_line, **said)


def _ask_of_counters(cells: FieldCells, counters: Sequence[Pair]) -> None:
    """Ask where counters are angles by their names, or lengths of moves by what was seen."""
    if {*COUNTERS} & {*cells.wishes.columns}:
        return
    names = {name: cells.columns[name] for name in COUNTERS}
    angles = [name for name, text in names.items() if (unit := name_of(text).unit) and unit.kind == "angle"]
    if angles:
        raise cells.table.ask("angles-of-motors", column=names[angles[0]], field=angles[0])
    if cells.wishes.relative:
        return
    homings = homings_of(cells, silent=True)
    seen = [cells.numbers(name, -PIXEL_MAX, PIXEL_MAX, optional=True) if name in cells else [] for name in PIXELS[:2]]
    for k, counter in enumerate(COUNTERS):
        moved = seen[k] and are_moves([pair[k] for pair in counters], seen[k], homings)
        if moved or _points_apart(cells, counters):
            raise cells.table.ask("moves-or-positions", column=names[counter], field=counter)


def _points_apart(cells: FieldCells, counters: Sequence[Pair]) -> bool:
    """Whether points 3 and 4 of every experiment, at one position, have two counters, the second of which is 0."""
    if not {*FOUR_POINT} <= {*cells.columns}:
        return False
    points = [_LABELLED.sub(r"\1", cell) for cell in cells.text("point")]
    fourth = [k for k in range(1, len(points)) if (points[k - 1], points[k]) == ("3", "4")]
    return bool(fourth) and all(counters[k] == (0, 0) != counters[k - 1] for k in fourth)


def _aperture_unit(cells: FieldCells) -> Unit:
    stated, named = cells.wishes.angle_unit, name_of(cells.columns.get("aperture_deg", "")).unit
    unit = unit_named(stated) if stated else named
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


def _say_renumbered(cells: FieldCells, move_of_row: Sequence[int]) -> None:
    """Say where a table without looks numbers its moves differently from `moves.csv`, by which pictures pair."""
    role = "move" if "move" in cells else "spot"
    numbers = [float(cell) if NUMBER.fullmatch(cell) else None for cell in cells.text(role)]
    differing = [row for row, number in enumerate(numbers) if number is not None and number != move_of_row[row]]
    if differing:
        name, row = cells.shown(role), differing[0]
        count = f"{len(differing)} of {len(numbers)} rows"
        example = f"{name} {escaped(cells.text(role)[row])} is move {move_of_row[row]}"
        consequence = f"pictures are paired by the move, not by {name}"
        cells.assumed.append(f"move: counted from 0, not as {name} does in {count}: {example}; {consequence}")


def _looks(cells: FieldCells, move_of_row: Sequence[int], aperture: Unit, seen: bool) -> dict[int, dict[str, Any]]:
    """The looks of a table by row, with centres or waiting for pictures; the other rows are moves without a look."""
    pixels, sd_px = _centres(cells), cells.wishes.sd_px
    sds = {name: cells.numbers(name, -SD_MAX, SD_MAX, optional=True) for name in PIXEL_SDS if name in cells}
    if seen and len(sds) < len(PIXEL_SDS):
        text = f"standard uncertainty of a centroid: {sd_px:g} px; --sd-px states another"
        cells.assumed.append(text if sds else f"{text}, the fit finds the scale")
    numbers, statuses, remarks = cells.whole("spot", 0, ID_MAX, optional=True), cells.text("status"), list[str]()
    four = _four_point(cells, remarks, not seen)
    waiting = [four.get("point", []), *(cells.text(name) for name in PICTURES if name in cells)]
    marks = zip(*(*pixels.values(), statuses) if seen else filter(None, waiting), strict=True)
    rows = [row for row, mark in enumerate(marks) if any(value not in (None, "") for value in mark)]
    given = [numbers[row] for row in rows]
    unique = None not in given and len({*given}) == len(given)
    if "spot" in cells and not unique:
        cells.assumed.append("spot: numbers are missing or repeated, so looks are numbered by their rows")
    cells.assumed.extend(remarks)
    values: dict[str, Sequence[Any]] = dict(four)
    for name in (name for name in CORRELATIONS if name in cells):
        values[name] = [v or 0.0 for v in cells.numbers(name, -CORRELATION_MAX, CORRELATION_MAX, optional=True)]
    readings = cells.scaled("aperture_deg", aperture, -APERTURE_MAX_DEG, APERTURE_MAX_DEG)
    looks, targets = dict[int, dict[str, Any]](), cells.text("target")
    if targets and targets[0] and 2 * targets.count("") > len(targets) and len({*targets}) > 2:
        # Merged cells: the name of a sheet stands in its first row alone.
        targets = list(continued(targets))
        cells.assumed.append("target: rows without one are of the sheet above them")
    for row in rows:
        centre, word = {name: column[row] for name, column in pixels.items()}, statuses[row].strip()
        waits = not seen and (means(word, "good") or word.lower() in ("", UNDETECTED))
        status = "no centre in the table" if seen and None in centre.values() and not word else UNDETECTED * waits
        status = status or status_of(cells, row, centre if seen else {}, "look")
        look: dict[str, Any] = {"spot": numbers[row] if unique else row, "move": move_of_row[row]}
        look |= {"target": readable(targets[row], "sheet", 100), "aperture_deg": readings[row], "status": status}
        look |= {name: column[row] for name, column in values.items()}
        if status == "ok":
            pixels_from = cells.wishes.pixels_from
            look |= {name: value - pixels_from for name, value in centre.items() if value is not None}
            look |= {name: _sd_px(cells, row, name, sds[name]) if name in sds else sd_px for name in PIXEL_SDS}
        looks[row] = look
    if "status" in cells:
        of_looks = statuses if seen else [statuses[r] for r in rows if statuses[r].strip().lower() != UNDETECTED]
        say_left_out(cells, of_looks, "look")
    return looks


def _centres(cells: FieldCells) -> dict[str, list[float | None]]:
    """Pixels by field; none where a camera's two are one number that programs write for no spot."""
    pixels = {name: cells.numbers(name, -PIXEL_MAX, PIXEL_MAX, optional=True) for name in PIXELS}
    empty = set[int]()
    for u, v in (PIXELS[:2], PIXELS[2:]):
        for row, (x, y) in enumerate(zip(pixels[u], pixels[v], strict=True)):
            if x is not None and x == y and (x <= 0 or x in FILLS or {*f"{x:g}"} == {"9"}):
                pixels[u][row] = pixels[v][row] = None
                empty.add(row)
    if empty:
        count = f"{plural(len(empty), 'look')}"
        cells.assumed.append(f"centres: none in {count} whose two pixels of a camera are one number, as -1 or 0")
    return pixels


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
    # P1, exp 07.
    texts = {cells.columns["experiment"]: numbers, cells.columns["point"]: cells.text("point")}
    plain = {name: tuple(_LABELLED.sub(r"\1", cell) for cell in own) for name, own in texts.items()}
    numbered = replace(cells, table=replace(cells.table, columns={**cells.table.columns, **plain}))
    limits = {"experiment": (0, ID_MAX), "point": (1, POINT_MAX)}
    rows = list(zip(*(numbered.whole(name, *limits[name], optional=True) for name in FOUR_POINT), strict=True))
    half = sum((experiment is None) != (point is None) for experiment, point in rows)
    if half:
        assumed.append(f"experiment, point: {plural(half, 'row')} with only one of them, which is left out")
    whole = [(None, None) if None in row else row for row in rows]
    return {name: list(column) for name, column in zip(FOUR_POINT, zip(*whole, strict=True), strict=True)}


def _sd_px(cells: FieldCells, row: int, name: str, column: Sequence[float | None]) -> float:
    """The standard uncertainty of a centre; cells of rows without a centre are not checked."""
    sd = column[row]
    if sd is None or sd < SD_MIN:
        allowed = f"a number from {SD_MIN:g} to {SD_MAX:g} where the look is ok"
        raise cells.refuse(row, name, allowed, f"complete the cell, or write --column {name}= and --sd-px")
    return sd

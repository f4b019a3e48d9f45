"""A table made plain before its columns are chosen: notations, units, merged cells, marks of rows, their order.

What is done is named in the kind of the table, which is shown. A column under another name keeps its title.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from itertools import pairwise

from tvsbayes.errors import escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import listed
from tvsbayes.importing.clock import date_time, dates_in_order, time_of_day
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import means, name_of, parse_unit, place_of, words_of

_PARTS = re.compile(
    r"(?P<stem>.*?)[ _.]*[\[(]?(?:(?P<d>d|deg|degr.s|\u00b0|grad)|(?P<m>m|min|minuten|minutes|arcmin|'|\u2032)"
    r"|(?P<s>s|sec|sekunden|secondes|seconds|arcsec|\"|''|\u2033))[\])]?$",
    re.IGNORECASE,
)
"""Degrees, minutes and seconds of one angle: az_d, az_m, az_s."""
FORMS = (
    (re.compile(r"[(\[]\s*([-+.\deE]+)\s*[,;\s]\s*([-+.\deE]+)\s*[)\]]"), ("{} x", "{} y")),
    (re.compile(r"([-+]?\d+[.,]?\d*)\s*(?:\u00b1|\+/-)\s*(\d+[.,]?\d*)"), ("{}", "u of {}")),
)
"""Two numbers in a cell, and what they are called."""
_LAST_DIGITS = re.compile(r"([-+]?\d+(?:[.,](\d+))?)\((\d+)\)")
"""A number with the uncertainty of its last digits: 12.34(5)."""
_DOUBTED = re.compile(r"[-+]?\d+(?:[.,]\d+)?\s*\?")
DOUBTED_SHARE = 0.2
"""Largest share of numbers with a mark of doubt in a column, above which the mark says something else."""
BESIDE = (
    ("angle", '"', "arcsec", ""),
    ("angle", "mils?", "angular mil", ""),
    ("angle", "grad", "gon", r"[(\[](?:deg|degrees?|\u00b0)[)\]]"),
    ("inch", "tenths", "0.0001 in", ""),
    ("inch", "thousandths", "0.001 in", ""),
)
"""Units in brackets that are another one beside a unit or one of its kind, by what one of the names must hold."""
_OF_ANGLE = re.compile(r"(angle|winkel|angul|azim|elev|pitch|yaw|tilt)\w* *[(\[](mils?|\")[)\]]", re.IGNORECASE)
"""A name of an angle with a unit that is one of a length elsewhere."""
WORDS_MAX = 1000
"""Largest number of different cells of a column that marks rows: with more they are measured, or written freely."""
CODES_MAX = 4
"""Largest number of different codes in a column of errors that marks rows."""
NEWEST_MIN = 4
"""Least number of rows of a table with the newest first."""
HOMED_WORDS = 5
"""Largest number of words of a remark that says "homed again"."""
SORTED_MIN = 3
"""Least number of rows of a block that is sorted against the direction in its first row."""
MERGED = ("run", "segment", "repeat", "approach", "command")
"""Concepts of columns whose cells may be merged over the rows of a block."""


def prepared(table: ForeignTable) -> ForeignTable:
    """The table with one column of marks, in the order of its rows, without merged cells and parts of angles."""
    return reduce(lambda plain, step: step(plain), STEPS, table)


def _changed(
    table: ForeignTable, columns: Mapping[str, Sequence[str]], note: str, names: Mapping[str, str] | None = None
) -> ForeignTable:
    """The table with other columns, a note on it, and the new names of columns."""
    titles = {title: (names or {}).get(name, name) for title, name in table.titles.items()} | {**(names or {})}
    plain = {name: tuple(cells) for name, cells in columns.items()}
    return replace(table, columns=plain, kind=f"{table.kind}, {note}" if note else table.kind, titles=titles)


# --- marks -----------------------------------------------------------------------------------------------------------
def _marked(table: ForeignTable) -> ForeignTable:
    """Columns that mark rows as good or bad, whatever their names and words, as one column of statuses."""
    marks = {text: found for text, cells in table.columns.items() if (found := _marks(text, cells, [*table.columns]))}
    inverted = [text for text in marks if name_of(text).has("excluded", "deviation") or not name_of(text).has("status")]
    if not inverted and len(marks) < 2:
        return table
    named = any(name_of(text).has("status", "excluded") for text in marks)
    name = " + ".join(marks) + " (status)" * (not named)
    columns = {name if text in marks else text: cells for text, cells in table.columns.items()}
    columns[name] = tuple(next(filter(None, row), "ok") for row in zip(*marks.values(), strict=True))
    return _changed(table, columns, f"rows marked by {listed(marks)}", dict.fromkeys(marks, name))


def _marks(text: str, cells: Sequence[str], others: Sequence[str]) -> list[str]:
    """Why each row is marked as bad, "" where it is not; [] where a column marks no rows."""
    name, words = name_of(text), {cell for cell in {*cells} if cell and not means(cell, "empty")}
    excluded, numbers = name.has("excluded"), [cell for cell in words if NUMBER.fullmatch(cell)]
    if name.unit is not None or name.has("command", "value", "temperature", "time", "approach"):
        return []
    if any(float(number) % 1 for number in numbers) if excluded else len(words) > WORDS_MAX:
        return []
    yes, no, good, bad = ({word for word in words if means(word, what)} for what in ("yes", "no", "good", "bad"))
    discarded = {word for word in words if place_of(words_of(word), "discard") is not None}
    filled = [cell for cell in cells if cell in words]
    sparse, zeros = 2 * len(filled) < len(cells), sum(cell in no for cell in filled)
    seldom = sparse or (len(words) <= CODES_MAX and 2 * zeros > len(filled))
    coded = name.has("deviation") and seldom and all(cell.isdigit() and len(words) > 1 for cell in numbers)
    # Out of tolerance is no fault of a reading.
    tolerances = any(place_of(words_of(other), "tolerance") is not None for other in others)
    verdicts = bool(bad) and not tolerances and words <= good | bad and all(w.lower() == "ok" for w in yes | no)
    label = escaped(text.strip(" ?"), 40)
    rules = (
        (excluded or coded, {w: label + f" {w}" * (w not in yes) for w in words - no if w in yes or w not in good}),
        (sparse and discarded and not numbers, {word: f"{label}: {word}" for word in discarded}),
        (name.has("status") and len(words) > 1 and words <= yes | no, {word: f"{label} {word}" for word in no}),
        (verdicts, {word: f"{label} {word}" for word in bad}),
    )
    said = next((said for applies, said in rules if applies), None)
    return [] if said is None else [said.get(cell, "") for cell in cells]


# --- order -----------------------------------------------------------------------------------------------------------
def _in_order(table: ForeignTable) -> ForeignTable:
    """Rows that are sorted by position, in the order that a column states; rows with the newest first, turned."""
    for text, cells in table.columns.items():
        name, in_file = name_of(text), [*range(len(cells))]
        if name.has("order", "index") and not name.unit and all(cell.isdigit() for cell in cells):
            numbers = list(map(int, cells))
            rows = sorted(in_file, key=numbers.__getitem__)
            is_order = len({*numbers}) == len(numbers) > 2 and rows not in (in_file, in_file[::-1])
            if is_order and (name.has("order") or _sorted_by_command(table)):
                return _with_rows(table, rows, f"rows in the order of column {escaped(text)}")
    for text, cells in table.columns.items():
        times = [_instant(cell) for cell in cells] if name_of(text).has("time") else [None]
        if len(times) >= NEWEST_MIN and None not in times and all(b < a for a, b in pairwise(times)):  # type: ignore[operator]
            return _with_rows(table, range(len(times))[::-1], f"newest first by column {escaped(text)}, turned")
    return table


def _with_rows(table: ForeignTable, rows: Sequence[int], note: str) -> ForeignTable:
    columns = {name: [column[row] for row in rows] for name, column in table.columns.items()}
    return _changed(replace(table, lines=tuple(table.lines[row] for row in rows)), columns, note)


def _instant(cell: str) -> float | None:
    """A number, or seconds of a date or a time of day, whichever a cell holds."""
    at = date_time(cell)
    return float(cell) if NUMBER.fullmatch(cell) else time_of_day(cell) if at is None else at.timestamp()


def _sorted_by_command(table: ForeignTable) -> bool:
    """Whether the only column of commands rises or falls through the whole file."""
    steps = _steps(table, "command")
    return steps is not None and (min(steps, default=1.0) >= 0 or max(steps) <= 0)


def _steps(table: ForeignTable, concept: str) -> list[float] | None:
    """Steps of the only column of a concept; None where there is none of numbers."""
    named = [cells for text, cells in table.columns.items() if name_of(text).has(concept)]
    if len(named) != 1 or not all(map(NUMBER.fullmatch, named[0])):
        return None
    return [float(b) - float(a) for a, b in pairwise(named[0])]


# --- merged cells ----------------------------------------------------------------------------------------------------
def _filled_down(table: ForeignTable) -> ForeignTable:
    """The table with merged cells filled: what stands in the first row of a block is that of the block."""
    columns, merged = dict(table.columns), list[str]()
    for text, cells in table.columns.items():
        filled, name = [cell for cell in cells if cell], name_of(text)
        # A mark, as "x" at a homing, is none of the rows below it.
        block = len({*filled}) > 1 and cells[:1] != ("",) and 2 * len(filled) <= len(cells)
        if not block or not name.has(*MERGED) or name.has("value", "status", "deviation"):
            continue
        others = [other for other_name, other in table.columns.items() if other_name != text]
        whole = all(any(other[row] for other in others) for row, cell in enumerate(cells) if not cell)
        if whole and (not name.has("approach") or _sides_hold(table, cells)):
            columns[text] = continued(cells)
            merged.append(text)
    return _changed(table, columns, f"merged cells of {listed(merged)} filled") if merged else table


def continued(cells: Sequence[str]) -> tuple[str, ...]:
    """Cells with what stands above them where they are empty."""
    done = [""]
    for cell in cells:
        done.append(cell or done[-1])
    return tuple(done[1:])


def _sides_hold(table: ForeignTable, cells: Sequence[str]) -> bool:
    """Whether a direction in the first row of a block is that of all its rows.

    The commands go there, or each block is sorted and no column says that the axis homed before it.
    """
    steps = _steps(table, "command") or _steps(table, "position")
    sides = continued(cells)
    ways = [means(side, "forward") - means(side, "backward") for side in sides]
    if steps is None or not all(ways):
        return False
    if all(way * step >= 0 for way, step in zip(ways[1:], steps, strict=True)):
        return True
    begins = [row for row, cell in enumerate(cells) if cell]
    blocks = [steps[a : b - 1] for a, b in pairwise([*begins, len(cells)])]
    homed = any(name_of(text).has("segment") for text in table.columns)
    return not homed and all(len(b) + 1 >= SORTED_MIN and (min(b) > 0 or max(b) < 0) for b in blocks)


# --- notations -------------------------------------------------------------------------------------------------------
def _split_pairs(table: ForeignTable) -> ForeignTable:
    """The table with a column for each number of pairs, as (783.6, 440.3), 5.01 \u00b1 0.02 and 5.01(2)."""
    columns, split = dict[str, Sequence[str]](), list[str]()
    for text, cells in table.columns.items():
        written = [_LAST_DIGITS.sub(_beside, cell) if _LAST_DIGITS.fullmatch(cell) else cell for cell in cells]
        form, names = next(((f, n) for f, n in FORMS if any(map(f.fullmatch, written))), FORMS[0])
        pairs = [form.fullmatch(cell) for cell in written]
        rest = [cell for pair, cell in zip(pairs, cells, strict=True) if not pair and cell]
        if any(pairs) and all(means(cell, "empty") for cell in rest):
            columns |= {n.format(text): [p[k] if p else "" for p in pairs] for k, n in enumerate(names, start=1)}
            split.append(text)
        else:
            columns[text] = cells
    return _changed(table, columns, f"pairs of {listed(split)} split") if split else table


def _beside(match: re.Match[str]) -> str:
    """The uncertainty of last digits as a number beside the other."""
    places = len(match[2] or "")
    return f"{match[1]} \u00b1 {int(match[3]) / 10**places:.{places}f}"


def _without_doubted(table: ForeignTable) -> ForeignTable:
    """The table without the few numbers that a question mark doubts."""
    columns, lines = dict[str, Sequence[str]](table.columns), list[str]()
    for text, cells in table.columns.items():
        doubted = [row for row, cell in enumerate(cells) if _DOUBTED.fullmatch(cell)]
        numbers = sum(NUMBER.fullmatch(cell) is not None for cell in cells)
        if 0 < len(doubted) <= DOUBTED_SHARE * numbers:
            columns[text] = ["" if row in doubted else cell for row, cell in enumerate(cells)]
            lines += [f"{escaped(cells[row])} in line {table.lines[row]}" for row in doubted]
    return _changed(table, columns, f"doubted numbers left out ({', '.join(lines)})") if lines else table


def _joined_angles(table: ForeignTable) -> ForeignTable:
    """The table with degrees, minutes and seconds in columns beside each other as one column of degrees."""
    columns, joined, texts = dict[str, Sequence[str]](table.columns), dict[str, str](), list(table.columns)
    for at, text in enumerate(texts):
        found = [_PARTS.fullmatch(name.strip()) for name in texts[at : at + 3]]
        kinds = [match.lastgroup if match and found[0] and match["stem"] == found[0]["stem"] else "" for match in found]
        size = 3 if kinds == ["d", "m", "s"] else 2 if kinds[:2] == ["d", "m"] else 0
        parts = [table.columns[name] for name in texts[at : at + size]]
        if not size or not all(NUMBER.fullmatch(cell) for cells in parts for cell in cells if cell):
            continue
        if any(not 0 <= float(cell) < 60 for cells in parts[1:] for cell in cells if cell):
            continue
        degrees = ["" if "" in cells else _degrees(cells) for cells in zip(*parts, strict=True)]
        stem = found[0]["stem"]  # type: ignore[index]
        if not stem and all(a <= b for a, b in pairwise(map(float, filter(None, parts[1])))):
            # Times in minutes.
            continue
        name = f"{stem or 'angle'} (deg)"
        columns = {name if n == text else n: degrees if n == text else c for n, c in columns.items()}
        columns = {n: c for n, c in columns.items() if n not in texts[at + 1 : at + size]}
        joined[text] = name
    note = f"degrees and minutes joined into {listed(joined.values())}"
    return _changed(table, columns, note, joined) if joined else table


def _degrees(parts: Sequence[str]) -> str:
    size = sum(abs(float(part)) / 60**power for power, part in enumerate(parts))
    return f"{'-' if parts[0].startswith('-') else ''}{size:.12g}"


def _joined_seconds(table: ForeignTable) -> ForeignTable:
    """The table with whole seconds and nanoseconds, as ROS writes them, as one column of times."""
    for text, cells in table.columns.items():
        stem = re.fullmatch(r"(.*?)(secs?)", text)
        parts = [f"{stem[1]}{word}" for word in ("nsecs", "nsec", "nanosec")] if stem else []
        part = next((name for name in parts if name in table.columns), None)
        if part and all(a.isdigit() and b.isdigit() for a, b in zip(cells, table.columns[part], strict=True)):
            stamps = [f"{a}.{b:0>9}" for a, b in zip(cells, table.columns[part], strict=True)]
            columns = {name: stamps if name == text else own for name, own in table.columns.items() if name != part}
            return _changed(table, columns, f"{part} added to {escaped(text)}")
    return table


def _dates(table: ForeignTable) -> ForeignTable:
    """The table with dates as year, month and day where their numbers tell the month; of one day alone, its times."""
    for text, cells in table.columns.items():
        if found := dates_in_order(cells):
            return _changed(table, {**table.columns, text: found[0]}, f"{found[1]} in column {escaped(text)}")
    return table


# --- units -----------------------------------------------------------------------------------------------------------
def _renamed(table: ForeignTable, names: Mapping[str, str], note: str, without: Sequence[str] = ()) -> ForeignTable:
    columns = {names.get(text, text): cells for text, cells in table.columns.items() if text not in without}
    return _changed(table, columns, note, names)


def _units_of_columns(table: ForeignTable) -> ForeignTable:
    """The table with the unit of a column of units in names: of the only one in all, else in the one before it."""
    units = {
        text: cells[0]
        for text, cells in table.columns.items()
        if cells and place_of(words_of(text), "unit") == 0 and {*cells} == {cells[0]}
        if (unit := parse_unit(cells[0])) is not None and unit.kind != "other"
    }
    order = [*table.columns]
    known = {text: name_of(text) for text in order if text not in units}
    bare = [n for n, own in known.items() if own.unit is None and not own.unknown]
    bare = [n for n in bare if known[n].has("command", "value", "position", "deviation")]
    names, notes = dict[str, str](), list[str]()
    for text, unit_text in units.items():
        own = [n for n in bare if len(units) == 1 or order.index(n) == order.index(text) - 1]
        names |= {n: f"{n} ({unit_text})" for n in own}
        notes.append(f"unit of {listed(own)} by column {escaped(text)}")
    return _renamed(table, names, ", ".join(notes), [*units]) if units else table


def _units_beside_others(table: ForeignTable) -> ForeignTable:
    """The table with units by another name where the others say so: beside an angle " is a second of arc."""
    units = [unit for text in table.columns if (unit := name_of(text).unit) is not None]
    others, names = {unit.kind for unit in units} | {unit.name for unit in units}, {n: n for n in table.columns}
    others |= {"angle"} if any(_OF_ANGLE.search(text) for text in names) else set()
    for other, written, word, held in BESIDE:
        if other in others and any(re.search(held, text) for text in table.columns):
            names = {
                n: re.sub(rf"([(\[])(?:{written})([)\]])", rf"\g<1>{word}\g<2>", text) for n, text in names.items()
            }
    names = {text: name for text, name in names.items() if text != name}
    note = ", ".join(f"{escaped(text)} taken as {escaped(name)}" for text, name in names.items())
    return _renamed(table, names, note) if names else table


def _in_one_unit(table: ForeignTable) -> ForeignTable:
    """The table with one column for readings that stand in one of two columns of one name, by their unit."""
    columns = table.columns
    units = {n: o.unit for n in columns if (o := name_of(n)).unit is not None and o.unit.kind in ("length", "angle")}
    for first, second in pairwise(units):
        factor = units[second].in_units_of(units[first])
        pairs = list(zip(columns[first], columns[second], strict=True))
        one_of = all(bool(a) != bool(b) for a, b in pairs) and all(map(any, zip(*pairs, strict=True)))
        turns = one_of and all(a or NUMBER.fullmatch(b) for a, b in pairs)
        if factor and turns and name_of(first).words == name_of(second).words:
            turned = [a or repr(float(f"{factor * float(b):.13g}")) for a, b in pairs]
            joined = {n: turned if n == first else own for n, own in columns.items() if n != second}
            return _changed(table, joined, f"{escaped(second)} turned into {escaped(first)}", {second: first})
    return table


def _homed(table: ForeignTable) -> ForeignTable:
    """The table with homings marked, where a column of events or remarks speaks of them in some rows."""
    for text, cells in table.columns.items():
        if name_of(text).has("segment", "command", "value", "approach", "status") or any(map(NUMBER.fullmatch, cells)):
            continue
        words = {cell: words_of(cell) for cell in {*cells}}
        says = {c: place_of(own[:2], "homing") == 0 and len(own) <= HOMED_WORDS for c, own in words.items()}
        homed = ["1" if says[cell] else "0" for cell in cells]
        if 0 < homed.count("1") < len(homed) / 2:
            columns = {**{n: own for n, own in table.columns.items() if n != text}, "homed": homed}
            return _changed(table, columns, f"homings by column {escaped(text)}", {text: "homed"})
    return table


STEPS = (
    *(_split_pairs, _without_doubted, _joined_angles, _joined_seconds, _dates),
    *(_units_of_columns, _units_beside_others, _in_one_unit, _filled_down, _homed, _marked, _in_order),
)
"""What is done to a table, in this order."""

"""A table made plain before its columns are chosen: marks of rows, their order, merged cells, angles in parts.

What is done is named in the kind of the table, which is shown.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from itertools import pairwise

from tvsbayes.errors import escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import listed
from tvsbayes.importing.clock import date_time, time_of_day
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import means, name_of, parse_unit, place_of, words_of

_PARTS = re.compile(
    r"(?P<stem>.+?)[ _.]*[\[(]?(?:(?P<d>d|deg|degr.s|\u00b0|grad)|(?P<m>m|min|minuten|minutes|arcmin|'|\u2032)"
    r"|(?P<s>s|sec|sekunden|secondes|seconds|arcsec|\"|''|\u2033))[\])]?$",
    re.IGNORECASE,
)
"""Degrees, minutes and seconds of one angle: az_d, az_m, az_s."""
FORMS = (
    (re.compile(r"[(\[]\s*([-+.\deE]+)\s*[,;\s]\s*([-+.\deE]+)\s*[)\]]"), ("{} x", "{} y")),
    (re.compile(r"([-+]?\d+[.,]?\d*)\s*(?:\u00b1|\+/-)\s*(\d+[.,]?\d*)"), ("{}", "u of {}")),
)
"""Two numbers in a cell, and what they are called."""
WORDS_MAX = 1000
"""Largest number of different cells of a column that marks rows: with more they are measured, or written freely."""
CODES_MAX = 4
"""Largest number of different codes in a column of errors that marks rows."""
NEWEST_MIN = 4
"""Least number of rows of a table with the newest first."""
HOMED_WORDS = 5
"""Largest number of words of a remark that says "homed again"."""
MERGED = ("run", "segment", "repeat", "approach", "command")
"""Concepts of columns whose cells may be merged over the rows of a block."""


def prepared(table: ForeignTable) -> ForeignTable:
    """The table with one column of marks, in the order of its rows, without merged cells and parts of angles."""
    return reduce(lambda plain, step: step(plain), STEPS, table)


def _noted(table: ForeignTable, columns: dict[str, tuple[str, ...]], note: str) -> ForeignTable:
    return replace(table, columns=columns, kind=f"{table.kind}, {note}")


# --- marks -----------------------------------------------------------------------------------------------------------
def _marked(table: ForeignTable) -> ForeignTable:
    """Columns that mark rows as good or bad, whatever their names and words, as one column of statuses."""
    marks = {text: found for text, cells in table.columns.items() if (found := _marks(text, cells, [*table.columns]))}
    inverted = [text for text in marks if name_of(text).has("excluded", "deviation") or not name_of(text).has("status")]
    if not inverted and len(marks) < 2:
        return table
    statuses = tuple(next(filter(None, row), "ok") for row in zip(*marks.values(), strict=True))
    named = any(name_of(text).has("status", "excluded") for text in marks)
    name = " + ".join(marks) + " (status)" * (not named)
    columns = {name if text in marks else text: cells for text, cells in table.columns.items()}
    return _noted(table, columns | {name: statuses}, f"rows marked by {listed(marks)}")


def _marks(text: str, cells: Sequence[str], others: Sequence[str]) -> list[str]:
    """Why each row is marked as bad, "" where it is not; [] where a column marks no rows."""
    name = name_of(text)
    if name.unit is not None or name.has("command", "value", "temperature", "time", "approach"):
        return []
    empty = {cell: not cell or means(cell, "empty") for cell in {*cells}}
    filled = {cell for cell, is_empty in empty.items() if not is_empty}
    if len(filled) > WORDS_MAX and not name.has("excluded"):
        return []
    rows = [cell for cell in cells if not empty[cell]]
    zeros = sum(map(rows.count, (cell for cell in filled if means(cell, "no"))))
    seldom = 2 * len(rows) < len(cells) or (len(filled) <= CODES_MAX and 2 * zeros > len(rows))
    codes = name.has("excluded") or (name.has("deviation") and seldom)
    label = escaped(text.strip(" ?"), 40)
    whole = all(not NUMBER.fullmatch(cell) or (cell.isdigit() and len(filled) > 1) for cell in filled)
    if name.has("excluded") or (codes and whole):
        if any(NUMBER.fullmatch(cell) and not float(cell).is_integer() for cell in filled):
            return []
        bad = {c: not means(c, "no") and (means(c, "yes") or not means(c, "good")) for c in filled}
        return [label + f" {cell}" * (not means(cell, "yes")) if bad.get(cell) else "" for cell in cells]
    said = {cell: place_of(words_of(cell), "discard") is not None for cell in filled}
    if any(said.values()) and not any(map(NUMBER.fullmatch, filled)) and 2 * len(rows) < len(cells):
        return [f"{label}: {cell}" if said.get(cell) else "" for cell in cells]
    if name.has("status") and all(means(c, "yes") or means(c, "no") for c in filled):
        return [f"{label} {cell}" if means(cell, "no") else "" for cell in cells] if len(filled) > 1 else []
    if any(place_of(words_of(other), "tolerance") is not None for other in others):
        # Out of tolerance is no fault of a reading.
        return []
    verdicts = {c: means(c, "bad") for c in filled if not (means(c, "yes") or means(c, "no")) or c.lower() == "ok"}
    if any(verdicts.values()) and all(bad or means(c, "good") for c, bad in verdicts.items()) and {*verdicts} == filled:
        return [f"{label} {cell}" if verdicts.get(cell) else "" for cell in cells]
    return []


# --- order -----------------------------------------------------------------------------------------------------------
def _in_order(table: ForeignTable) -> ForeignTable:
    """Rows that are sorted by position, in the order that a column states; rows with the newest first, turned."""
    for text, cells in table.columns.items():
        name = name_of(text)
        if not name.has("order", "index") or name.unit or not all(cell.isdigit() for cell in cells):
            continue
        numbers = list(map(int, cells))
        rows = sorted(range(len(numbers)), key=numbers.__getitem__)
        is_order = len({*numbers}) == len(numbers) > 2 and numbers not in (sorted(numbers), sorted(numbers)[::-1])
        if is_order and (name.has("order") or _sorted_by_command(table)):
            columns = {name: tuple(column[row] for row in rows) for name, column in table.columns.items()}
            moved = replace(table, lines=tuple(table.lines[row] for row in rows))
            return _noted(moved, columns, f"rows in the order of column {escaped(text)}")
    for text, cells in table.columns.items():
        times = [_instant(cell) for cell in cells] if name_of(text).has("time") else [None]
        if len(times) >= NEWEST_MIN and None not in times and all(b < a for a, b in pairwise(times)):  # type: ignore[operator]
            columns = {name: column[::-1] for name, column in table.columns.items()}
            turned = replace(table, lines=table.lines[::-1])
            return _noted(turned, columns, f"newest first by column {escaped(text)}, turned")
    return table


def _instant(cell: str) -> float | None:
    """A number, or seconds of a date or a time of day, whichever a cell holds."""
    at = date_time(cell)
    return float(cell) if NUMBER.fullmatch(cell) else time_of_day(cell) if at is None else at.timestamp()


def _sorted_by_command(table: ForeignTable) -> bool:
    """Whether the only column of commands rises or falls through the whole file."""
    steps = _command_steps(table)
    return steps is not None and (min(steps, default=1.0) >= 0 or max(steps) <= 0)


def _command_steps(table: ForeignTable) -> list[float] | None:
    """Steps of the only column of commands; None where there is none of numbers."""
    named = [cells for text, cells in table.columns.items() if name_of(text).has("command")]
    if len(named) != 1 or not all(map(NUMBER.fullmatch, named[0])):
        return None
    return [float(b) - float(a) for a, b in pairwise(named[0])]


# --- cells -----------------------------------------------------------------------------------------------------------
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
        if whole and (not name.has("approach") or _sides_hold(table, continued(cells))):
            columns[text] = continued(cells)
            merged.append(text)
    return _noted(table, columns, f"merged cells of {listed(merged)} filled") if merged else table


def continued(cells: Sequence[str]) -> tuple[str, ...]:
    """Cells with what stands above them where they are empty."""
    done = [""]
    for cell in cells:
        done.append(cell or done[-1])
    return tuple(done[1:])


def _sides_hold(table: ForeignTable, sides: Sequence[str]) -> bool:
    """Whether the commands go where filled cells say."""
    steps = _command_steps(table)
    if steps is None:
        return False
    ways = [means(side, "forward") - means(side, "backward") for side in sides[1:]]
    return all(ways) and all(way * step >= 0 for way, step in zip(ways, steps, strict=True))


def _split_pairs(table: ForeignTable) -> ForeignTable:
    """The table with a column for each number of pairs, as (783.6, 440.3) and 5.01 \u00b1 0.02."""
    columns, split = dict[str, tuple[str, ...]](), list[str]()
    for text, cells in table.columns.items():
        form, names = next(((f, n) for f, n in FORMS if any(map(f.fullmatch, cells))), FORMS[0])
        pairs = [form.fullmatch(cell) for cell in cells]
        rest = [cell for pair, cell in zip(pairs, cells, strict=True) if not pair and cell]
        if any(pairs) and all(means(cell, "empty") for cell in rest):
            columns |= {n.format(text): tuple(p[k] if p else "" for p in pairs) for k, n in enumerate(names, start=1)}
            split.append(text)
        else:
            columns[text] = cells
    return _noted(table, columns, f"pairs of {listed(split)} split") if split else table


def _joined_angles(table: ForeignTable) -> ForeignTable:
    """The table with degrees, minutes and seconds in columns beside each other as one column of degrees."""
    columns, joined, names = dict(table.columns), list[str](), list(table.columns)
    for at, text in enumerate(names):
        found = [_PARTS.fullmatch(name.strip()) for name in names[at : at + 3]]
        kinds = [match.lastgroup if match and found[0] and match["stem"] == found[0]["stem"] else "" for match in found]
        size = 3 if kinds == ["d", "m", "s"] else 2 if kinds[:2] == ["d", "m"] else 0
        parts = [table.columns[name] for name in names[at : at + size]]
        if not size or not all(map(NUMBER.fullmatch, (cell for cells in parts for cell in cells if cell))):
            continue
        if any(not 0 <= float(cell) < 60 for cells in parts[1:] for cell in cells if cell):
            continue
        degrees = tuple("" if "" in cells else _degrees(cells) for cells in zip(*parts, strict=True))
        name = f"{found[0]['stem']} (deg)"  # type: ignore[index]
        columns = {name if n == text else n: degrees if n == text else c for n, c in columns.items()}
        columns = {n: c for n, c in columns.items() if n not in names[at + 1 : at + size]}
        joined.append(name)
    return _noted(table, columns, f"degrees and minutes joined into {listed(joined)}") if joined else table


def _joined_seconds(table: ForeignTable) -> ForeignTable:
    """The table with whole seconds and nanoseconds, as ROS writes them, as one column of times."""
    for text, cells in table.columns.items():
        stem = re.fullmatch(r"(.*?)(secs?)", text)
        parts = [f"{stem[1]}{word}" for word in ("nsecs", "nsec", "nanosec")] if stem else []
        part = next((name for name in parts if name in table.columns), None)
        if part and all(a.isdigit() and b.isdigit() for a, b in zip(cells, table.columns[part], strict=True)):
            stamps = tuple(f"{a}.{b:0>9}" for a, b in zip(cells, table.columns[part], strict=True))
            columns = {name: stamps if name == text else own for name, own in table.columns.items() if name != part}
            return _noted(table, columns, f"{part} added to {escaped(text)}")
    return table


def _degrees(parts: Sequence[str]) -> str:
    size = sum(abs(float(part)) / 60**power for power, part in enumerate(parts))
    return f"{'-' if parts[0].startswith('-') else ''}{size:.12g}"


def _one_unit(table: ForeignTable) -> ForeignTable:
    """The table with units in its names: those of columns of units, and one unit for readings in two."""
    columns, notes, stated = dict(table.columns), list[str](), dict[str, str]()
    for text, cells in table.columns.items():
        unit = parse_unit(cells[0]) if cells and {*cells} == {cells[0]} else None
        if unit is not None and unit.kind != "other" and place_of(words_of(text), "unit") == 0:
            stated[text] = cells[0]
    bare = [n for n in columns if (o := name_of(n)).unit is None and not o.unknown and n not in stated]
    bare = [n for n in bare if name_of(n).has("command", "value", "position", "deviation")]
    names, order = {n: n for n in columns}, list(columns)
    for text, unit_text in stated.items():
        # Of several each is of the column before it.
        own = [n for n in bare if len(stated) == 1 or order.index(n) == order.index(text) - 1]
        names |= {n: f"{n} ({unit_text})" for n in own}
        notes.append(f"unit of {listed(own)} by column {escaped(text)}")
    angles = any((unit := name_of(n).unit) is not None and unit.kind == "angle" for n in columns)
    if angles:
        # Beside degrees " is a second of arc.
        names = {n: re.sub(r"([(\[])\"([)\]])", r"\1arcsec\2", text) for n, text in names.items()}
        # A mil of an angle is one of several; grad is no degree where another column is in degrees.
        names = {n: re.sub(r"([(\[])mils?([)\]])", r"\1angular mil\2", text) for n, text in names.items()}
        if any(re.search(r"[(\[](?:deg|degrees?|\u00b0)[)\]]", text) for text in columns):
            names = {n: re.sub(r"([(\[])grad([)\]])", r"\1gon\2", text) for n, text in names.items()}
    columns = {names[n]: own for n, own in columns.items() if n not in stated}
    units = {n: o.unit for n in columns if (o := name_of(n)).unit is not None and o.unit.kind in ("length", "angle")}
    for first, second in pairwise(units):
        factor = units[second].in_units_of(units[first])
        one_of = all(bool(a) != bool(b) for a, b in zip(columns[first], columns[second], strict=True))
        same = name_of(first).words == name_of(second).words
        if same and one_of and factor and any(columns[first]) and any(columns[second]):
            pairs = zip(columns[first], columns[second], strict=True)
            turned = [a or repr(float(f"{factor * float(b):.13g}")) for a, b in pairs if a or NUMBER.fullmatch(b)]
            if len(turned) == len(columns[first]):
                columns = {n: tuple(turned) if n == first else own for n, own in columns.items() if n != second}
                notes.append(f"{escaped(second)} turned into {escaped(first)}")
                break
    if not notes:
        return replace(table, columns=columns) if angles else table
    return _noted(table, columns, ", ".join(notes))


def _homed(table: ForeignTable) -> ForeignTable:
    """The table with homings marked, where a column of events or remarks speaks of them in some rows."""
    for text, cells in table.columns.items():
        if name_of(text).has("segment", "command", "value", "approach", "status") or any(map(NUMBER.fullmatch, cells)):
            continue
        words = {cell: words_of(cell) for cell in {*cells}}
        says = {c: place_of(own[:2], "homing") == 0 and len(own) <= HOMED_WORDS for c, own in words.items()}
        homed = ["1" if says[cell] else "0" for cell in cells]
        if 0 < homed.count("1") < len(homed) / 2:
            columns = {**{n: own for n, own in table.columns.items() if n != text}, "homed": tuple(homed)}
            return _noted(table, columns, f"homings by column {escaped(text)}")
    return table


STEPS = (_split_pairs, _joined_angles, _joined_seconds, _one_unit, _filled_down, _homed, _marked, _in_order)
"""What is done to a table, in this order."""

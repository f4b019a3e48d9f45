"""The table in a file of another program, of any kind that is known.

Beside texts and workbooks: LabVIEW's .lvm, Renishaw's .rtl, objects of JSON, and "name: value" lines of serial
monitors, a row on one line or over several.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from tvsbayes.errors import escaped, plural
from tvsbayes.files.csv_table import CSV_BYTES_MAX, CSV_ROWS_MAX, NUMBER
from tvsbayes.files.disk import read_bytes
from tvsbayes.importing.asking import refused
from tvsbayes.importing.clock import DAY_S, over_midnight
from tvsbayes.importing.prepared import prepared
from tvsbayes.importing.table import WORKBOOKS, ForeignTable, Row, Rows, headed, table_of_rows
from tvsbayes.importing.text import text_of, text_table_rows
from tvsbayes.importing.words import name_of
from tvsbayes.importing.workbook import sheet_rows

DEPTH_MAX = 4
_UNITS = {"LINEAR": ("mm", "mm"), "ANGULAR": ("deg", "arcsec")}
"""Units of targets and deviations by file type (Renishaw, LaserXL file formats)."""


def json_rows(text: str, file: str) -> Rows | None:
    """Rows of objects of JSON: one on each line, or a list of them; nested names are joined by dots."""
    if not re.match(r'\s*(\[\s*)?\{\s*"', text) or max(map(text.count, "{[")) > CSV_ROWS_MAX:
        return None
    lines = [(n, line.strip().rstrip(",")) for n, line in enumerate(text.splitlines(), start=1) if line.strip()]
    try:
        if text.lstrip().startswith("["):
            lines = [(n, json.dumps(item)) for n, item in enumerate(json.loads(text), start=1)]
        flat = [(n, _flat(json.loads(line))) for n, line in lines]
    except (ValueError, TypeError, RecursionError):
        return None
    names = list(dict.fromkeys(name for _, cells in flat for name in cells))
    if len(flat) < 2 or not names:
        return None
    rows = [Row(n, [cells.get(name, "") for name in names]) for n, cells in flat]
    return Rows([Row(rows[0].line, names), *rows], ["objects of JSON"])


def _flat(value: object, prefix: str = "", depth: int = 0) -> dict[str, str]:
    """Numbers, texts and marks of an object by name."""
    if isinstance(value, dict) and depth < DEPTH_MAX:
        return {
            n: c for key, of in value.items() for n, c in _flat(of, f"{prefix}.{key}".strip("."), depth + 1).items()
        }
    if not prefix or isinstance(value, list | dict):
        raise ValueError("no plain object")
    return {prefix: "" if value is None else str(value).lower() if isinstance(value, bool) else str(value)}


def labview_rows(text: str, file: str) -> Rows | None:
    """Rows below the last header of a LabVIEW measurement file (NI, "LabVIEW Measurement File specification")."""
    if not text.startswith("LabVIEW Measurement"):
        return None
    lines = text.splitlines()
    header = {key: value for key, _, value in (line.partition("\t") for line in lines[:40])}
    separator = {"Tab": "\t", "Comma": ","}.get(header.get("Separator", "Tab").strip(), header.get("Separator", "\t"))
    ends = [k for k, line in enumerate(lines) if line.startswith("***End_of_Header***")]
    if len(ends) < 2:
        raise refused("labview", file)
    rows, names = list[Row](), list[str]()
    # Of several blocks each has a header, which ends so, and names.
    for begin, end in pairwise([*ends[1:], len(lines)]):
        block = [
            (n, [c.strip() for c in line.split(separator)]) for n, line in enumerate(lines[:end], 1) if n > begin + 1
        ]
        heads = (k for k, (_, cells) in enumerate(block) if cells[0] == "Channels")
        filled = [Row(n, cells) for n, cells in block[: next(heads, None)] if any(cells)]
        names = names or (filled[0].cells if filled else [])
        rows += filled[1:] if rows and filled and filled[0].cells == names else filled
    labels = next((line.split(separator) for line in lines[ends[-2] :] if line.startswith("Y_Unit_Label")), [])
    for k, label in enumerate(labels[1:], start=1):
        if rows and label.strip() and k < len(rows[0].cells) and "(" not in rows[0].cells[k]:
            rows[0].cells[k] += f" ({label.strip()})"
    date = " ".join(header.get(key, "").strip() for key in ("Date", "Time"))
    return Rows(rows, ["LabVIEW measurement file", *([f"begun {date.strip()}"] if date.strip() else [])])


def renishaw_rows(text: str, file: str) -> Rows | None:
    """Targets and positions of a Renishaw laser file, in the order of its runs."""
    if not text.startswith("HEADER::") or "DEVIATIONS::" not in text:
        return None
    kind = re.search(r"Filetype:\s*(\w+)", text)
    targets = re.search(r"Targets\s*:\s*((?:[-+.\d eE]+\s*\n)+)", text.replace("\r", ""))
    units = _UNITS.get(kind[1].upper() if kind else "")
    if units is None or targets is None:
        raise refused("renishaw", file, type=kind[1] if kind else "an unnamed type")
    target = targets[1].split()
    lines = text.splitlines()
    begin = next(k for k, line in enumerate(lines) if line.startswith("DEVIATIONS::"))
    scale = 1.0 if units[0] == units[1] else 1 / 3600
    rows = [Row(begin + 1, [f"target ({units[0]})", f"measured ({units[0]})", "cycle"])]
    for number, line in enumerate(lines[begin + 1 :], start=begin + 2):
        if line.rstrip().endswith("::"):
            break
        cells = line.split()
        if len(cells) != 3 or not all(map(NUMBER.fullmatch, cells)):
            continue
        run, point, deviation = cells
        if not (point.isdigit() and 1 <= int(point) <= len(target)):
            raise refused("renishaw-target", file, line=number, number=point, most=len(target))
        at = float(target[int(point) - 1])
        rows.append(Row(number, [target[int(point) - 1], repr(round(at + scale * float(deviation), 12)), run]))
    return Rows(rows, ["Renishaw laser file: measured = target + deviation, runs in the order of the file"])


PAIRED_SHARE = 0.6
"""Least share of "name: value" lines in a file of pairs; the others are messages at a program's start."""
VALUES_MIN = 20
"""Least number of values of a name by whose decimals one can be seen to be cut."""
USUAL_SHARE = 0.97
"""Share of a name's values with one number of decimals, from which a value with fewer was cut."""
REPEATED_SHARE = 0.1
"""Largest share of lines equal to the line before, below which such a line was sent twice."""
NAMED_MAX = 6
TIME = "time (s)"
_PAIR = re.compile(
    r"(?P<name>[^\W\d][^:=,;|/\t]*?)(?P<mark>\s*[:=]\s*|\s+)(?P<value>[+-]?(?:\d+[.,]\d+|\d+\.?|\.\d+)(?:[eE][+-]?\d+)?)"
    r"(?:\s*(?P<unit>\u00b0|mm|um|\u00b5m|deg|rad|counts|steps|ms|us|s)(?![\w:]))?\s*(?:[,;|/\t]\s*|\s+|$)"
)
"""One pair of "Step: 200, Angle: 12.5 deg", or of "MOVE 200"."""
_PREFIX = re.compile(
    r"(?:\[?(?:(?P<day>\d{4}-\d\d-\d\d)[T ])?(?P<h>\d{1,2}):(?P<m>\d{2}):(?P<s>\d{2}(?:[.,]\d+)?)\]?"
    r"\s*(?:->|>|-\s)?\s*)?(?:(?:[\w.]+ - )?\[?(?:TRACE|DEBUG|INFO|NOTICE|WARN|WARNING|ERROR)\b\]?"
    r"(?::[\w.]+(?=:\s*[^\W\d]))?(?:\s*[:|-])?\s*)?"
)
"""What a serial monitor or a logger puts before a line: day and time of day, the logger's name, a level."""


class _Pair(NamedTuple):
    """A value of a line, with the time of day before the line."""

    line: int
    name: str
    value: str
    clock_s: float | None


def paired_rows(text: str, file: str) -> Rows | None:
    """Rows of a file whose lines are "name: value" pairs; None for any other file.

    The names of a row follow each other in the usual order. A value without its place in that order, after a line that
    was lost, repeated or cut, is left out and its line is named.
    """
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), start=1) if line.strip()]
    pairs_of = {n: found for n, line in lines if (found := _pairs(n, line))}
    if len(pairs_of) < PAIRED_SHARE * len(lines) or len(pairs_of) < 2:
        return None
    if any(len({pair.name for pair in found}) < len(found) for found in pairs_of.values()):
        return None
    damaged = _repeated_lines(lines, pairs_of)
    stream = [pair for n, found in pairs_of.items() if n not in damaged for pair in found]
    damaged |= (cut := _cut_lines(stream))
    stream = [pair for pair in stream if pair.line not in cut]
    counts = Counter(pair.name for pair in stream)
    usual = [name for name, count in counts.items() if 2 * count > max(counts.values())]
    rows, orphans = _blocks(stream, usual)
    if len(usual) < 2 or len(rows) < 2:
        return None
    names = [*usual, *(name for name in counts if name not in usual)]
    clocks_s = [clock_s for row in rows if (clock_s := row[usual[0]].clock_s) is not None]
    times_s = over_midnight(clocks_s) if len(clocks_s) == len(rows) and TIME not in names else []
    body = [
        Row(
            min(pair.line for pair in row.values()),
            [
                *(f"{times_s[k] - times_s[0]:.6f}" for _ in times_s[:1]),
                *(row[name].value if name in row else "" for name in names),
            ],
        )
        for k, row in enumerate(rows)
    ]
    others = [n for n, _ in lines if n not in pairs_of]
    before = [n for n in others if n <= body[0].line]
    damaged |= orphans | ({*others} - {*before})
    notes = ['lines of "name: value"']
    if n := len(before):
        notes.append(f"{plural(n, 'line')} before the first row left out")
    if damaged:
        named = ", ".join(map(str, sorted(damaged)[:NAMED_MAX])) + " ..." * (len(damaged) > NAMED_MAX)
        s, them = ("", "it") if len(damaged) == 1 else ("s", "them")
        notes.append(f"line{s} {named} left out: lost, repeated or cut beside {them}")
    return Rows([Row(body[0].line, [*([TIME] if times_s else []), *names]), *body], notes)


def _pairs(number: int, line: str) -> list[_Pair]:
    """The pairs of a line, [] where it holds anything else."""
    before = _PREFIX.match(line)
    content = line[before.end() if before else 0 :]
    found = list(_PAIR.finditer(content))
    marked = all(
        m["mark"].strip() or name_of(m["name"]).has("command", "increment", "value", "position") for m in found
    )
    if "".join(match.group() for match in found) != content or not marked:
        return []
    clock_s = None
    if before and before["h"]:
        day = date.fromisoformat(before["day"]).toordinal() if before["day"] else 0
        second = float(before["s"].replace(",", "."))
        clock_s = DAY_S * day + int(before["h"]) * 3600 + int(before["m"]) * 60 + second
    names = [m["name"].strip() + (f" ({m['unit']})" if m["unit"] else "") for m in found]
    return [_Pair(number, name, m["value"].replace(",", "."), clock_s) for name, m in zip(names, found, strict=True)]


def _repeated_lines(lines: list[tuple[int, str]], pairs_of: dict[int, list[_Pair]]) -> set[int]:
    """Lines sent twice: equal to the line before, where lines seldom are."""
    repeated = {n for (_, before), (n, line) in pairwise(lines) if line == before and n in pairs_of}
    return repeated if len(repeated) <= REPEATED_SHARE * len(lines) else set()


def _cut_lines(stream: list[_Pair]) -> set[int]:
    """Lines with a value of fewer decimals than nearly all others of its name."""
    cut = set[int]()
    for name in {pair.name for pair in stream}:
        places = [(len(pair.value.partition(".")[2]), pair.line) for pair in stream if pair.name == name]
        (usual, count), *_ = Counter(decimals for decimals, _ in places).most_common(1)
        if len(places) >= VALUES_MIN and count >= USUAL_SHARE * (len(places) - 1):
            cut |= {line for decimals, line in places if decimals < usual}
    return cut


def _blocks(stream: list[_Pair], usual: list[str]) -> tuple[list[dict[str, _Pair]], set[int]]:
    """Rows of the usual names, and the lines of values without a place in one.

    Where several values of the last names follow one of the first, each makes a row with it.
    """
    names = [pair.name for pair in stream if pair.name in usual]
    starts = {k for k, name in enumerate(names) if name == usual[0]}
    parts = Counter(tuple(names[a:b]) for a, b in pairwise(sorted({0, len(names)} | starts)))
    signature = parts.most_common(1)[0][0] if parts else ("",)
    heads = {name for name in signature if signature.count(name) == 1}
    repeats = [name for name in dict.fromkeys(signature) if name not in heads]
    rows, orphans = list[dict[str, _Pair]](), set[int]()
    block, extras = list[_Pair](), dict[str, _Pair]()
    for pair in (*stream, None):
        if block and (pair is None or pair.name == signature[0]):
            head = {of.name: of for of in block if of.name in heads}
            values = [[of for of in block if of.name == name] for name in repeats]
            # A move whose reading was lost is a move.
            together = zip(*values, strict=False) if values and len(head) == len(heads) else [()]
            rows += [{**head, **extras, **{of.name: of for of in part}} for part in together]
            block, extras = [], {}
        if pair is not None and pair.name not in usual:
            extras[pair.name] = pair
        elif pair is not None and len(block) < len(signature) and pair.name == signature[len(block)]:
            block.append(pair)
        elif pair is not None:
            orphans.add(pair.line)
    return rows, orphans


def read_foreign(path: Path, sheet: str | None = None) -> ForeignTable:
    """Read the table in a file.

    Args:
        path: a file of at most 64 MiB and 200 000 rows.
        sheet: sheet of a workbook; by default the first with content.

    Raises:
        InputError: unreadable, no table, too large, or another kind of file.
    """
    data, file = read_bytes(Path(path), CSV_BYTES_MAX), escaped(Path(path).name)
    if data.startswith(WORKBOOKS):
        return prepared(table_of_rows(file, *headed(sheet_rows(data, file, sheet))))
    if sheet is not None:
        raise refused("sheet-of-text", file)
    decoded = text_of(data, file)
    readers = (renishaw_rows, labview_rows, json_rows, paired_rows)
    rows = next((rows for read in readers if (rows := read(decoded.text, file)) is not None), None)
    return prepared(table_of_rows(file, *(rows or text_table_rows(decoded, file))))

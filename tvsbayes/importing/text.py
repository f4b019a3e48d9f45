"""Rows of a text: its encoding, the separator between cells, remarks, Markdown tables."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from tvsbayes.errors import CONTROL, refusal
from tvsbayes.files.csv_table import CSV_ROWS_MAX
from tvsbayes.importing.asking import refused
from tvsbayes.importing.table import (
    ABOVE_MAX,
    COLUMNS_MAX,
    KINDS,
    WORKBOOKS,
    Row,
    Rows,
    cleaned,
    filled_width,
    headed,
    is_number,
    names_first,
    side_named,
)
from tvsbayes.importing.words import means, parse_unit, place_of, words_of

SEPARATORS = {"\t": "tabs", ";": "semicolons", "|": "bars", ",": "commas", " ": "spaces"}
"""Separators in the order in which they are tried: a decimal comma must not be taken for one."""
ROWS_TRIED = 50
REMARKS_SHARE = 4
"""Least number of rows for each remark between them, from which remarks are titles of those below."""
REMARKS = ("#", "%", "!", "//")
_MARKS = (
    (b"\xff\xfe\x00\x00", "utf-32", "UTF-32"),
    (b"\x00\x00\xfe\xff", "utf-32", "UTF-32"),
    (b"\xff\xfe", "utf-16", "UTF-16"),
    (b"\xfe\xff", "utf-16", "UTF-16"),
    (b"\xef\xbb\xbf", "utf-8-sig", "UTF-8"),
)
_WIDE = {
    SEPARATORS[","]: "decimal commas beside commas between cells? export with semicolons, or with decimal points",
    SEPARATORS[" "]: "dates or texts with spaces? export with semicolons or tabs between cells",
}
"""Why rows may have more cells than names, with the remedy, by separator."""


class Decoded(NamedTuple):
    """A text and the name of its encoding."""

    text: str
    encoding: str


def text_of(data: bytes, file: str, allowed: str = KINDS, remedy: str = "export the table as CSV") -> Decoded:
    """Decode a text; `allowed` and `remedy` are used in the refusal of binary data."""
    marked = [(codec, name) for mark, codec, name in _MARKS if data.startswith(mark)]
    codec, name = marked[0] if marked else ("utf-8", "UTF-8")
    if not marked and b"\0" in data[:200]:
        codec, name = ("utf-16-le" if data[1:2] == b"\0" else "utf-16-be"), "UTF-16"
    try:
        text = data.decode(codec)
    except UnicodeDecodeError:
        # In this encoding every byte is a character: only column names can be decoded wrongly.
        text, name = data.decode("cp1252", errors="replace"), "Windows-1252"
    if control := CONTROL.search(text):
        line = text.count("\n", 0, control.start()) + 1
        raise refusal("kind", file=file, line=line, found="binary data", allowed=allowed, remedy=remedy)
    return Decoded(text, name)


def _text_rows(text: str, file: str) -> tuple[list[Row], str, list[tuple[int, str]]]:
    """Rows with their line numbers, the separator, and the remarks above the first row."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    declared = next((line[4:5] for _, line in lines[:1] if line.lower().startswith("sep=")), None)
    remarks = [(n, line.strip()) for n, line in lines if _is_remark(line)]
    body = [(n, line) for n, line in lines if not _is_remark(line)][declared is not None :]
    between = [Row(n, [line.strip("#%!/ -=*")]) for n, line in remarks if body and n > body[0][0] and _is_title(line)]
    remarks = [(n, line) for n, line in remarks if body and n < body[0][0]]
    if _is_markdown([line for _, line in body]):
        body, declared = _markdown_rows(lines), "|"
        remarks = [(n, line.strip()) for n, line in lines if n < body[0][0] and "|" not in line]
    if len(body) > CSV_ROWS_MAX + 1:
        raise refused("long-table", file, count=len(body), most=CSV_ROWS_MAX)
    if declared == '"':
        raise refused("separator", file, line=1)
    separator = declared or _separator([line for _, line in body])
    rows = _divided(body, separator, file)
    if REMARKS_SHARE * len(between) <= len(rows):
        rows = sorted([*rows, *between], key=lambda row: row.line)
    return rows, separator, remarks


def _is_title(remark: str) -> bool:
    """Whether a remark between rows speaks of all below it: the axis homed, a run goes in a direction, a state."""
    words = words_of(remark)
    named = any(place_of(words, concept) is not None for concept in ("condition", "machine"))
    named |= place_of(words, "target", "looks.toml") is not None
    return named or place_of(words, "homing") == 0 or bool(side_named(remark))


def _is_remark(line: str) -> bool:
    """Whether a line is a remark; "#;Position" begins with a name for the number of the row, "#N/A;5" with no value."""
    first = re.split(r"[;,|\t]", line, maxsplit=1)[0].strip(' "')
    is_value = first != line.strip() and (first == "#" or means(first, "empty"))
    return line.lstrip().startswith(REMARKS) and not is_value


def _divided(body: Sequence[tuple[int, str]], separator: str, file: str) -> list[Row]:
    """Cells of the lines."""
    if body and body[0][1].count(separator) > ABOVE_MAX * COLUMNS_MAX:
        count = body[0][1].count(separator) + 1
        raise refused("wide-table", file, line=body[0][0], count=count, most=COLUMNS_MAX)
    if separator == " ":
        spaced = [Row(number, line.split()) for number, line in body]
        # Names with spaces, apart by two or more.
        for number, line in body[:1]:
            names = re.split(r"\s{2,}|\t", line.strip())
            if len(spaced) > 1 and len(spaced[0].cells) > len(names) == len(spaced[1].cells) > 1:
                spaced[0] = Row(number, names)
        return spaced
    reader = csv.reader((line for _, line in body), delimiter=separator, skipinitialspace=True, strict=True)
    rows: list[Row] = []
    try:
        for row in reader:
            if reader.line_num > len(rows) + 1:
                raise csv.Error("a line break inside a cell")
            rows.append(Row(body[len(rows)][0], [cleaned(cell) for cell in row]))
    except csv.Error as error:
        raise refused("row", file, line=body[len(rows)][0], error=str(error)) from error
    return rows


def _is_markdown(lines: Sequence[str]) -> bool:
    return any(re.fullmatch(r"\s*\|?[\s:|-]*-{3,}[\s:|-]*\|[\s:|-]*", line) for line in lines[:ABOVE_MAX])


def _markdown_rows(lines: Sequence[tuple[int, str]]) -> list[tuple[int, str]]:
    """Rows of the Markdown tables of a text, and the lines between and below them."""
    rows = list[tuple[int, str]]()
    barred = [line.strip() for _, line in lines if "|" in line]
    outer = [all(line.startswith("|") for line in barred), all(line.endswith("|") for line in barred)]
    for number, line in lines:
        content = line.strip()[outer[0] :]
        content = content[:-1] if outer[1] and content.endswith("|") else content
        if ("|" in content and not re.fullmatch(r"[\s|:-]+", content)) or (rows and "|" not in line):
            # An inch is no quote; a cell that begins with a mark of repetition is.
            rows.append((number, re.sub(r'((?:^|\|)\s*)"', r"\1'", content)))
    return rows


def _separator(lines: Sequence[str]) -> str:
    """The first separator that gives nine of ten lines the same number of cells, two or more.

    The first lines are tried, then the last. If none fits, some row is damaged; the result is then the first separator
    that divides most lines and the names, else commas.
    """
    for sample in (lines[:ROWS_TRIED], lines[-ROWS_TRIED:]):
        # Separators after the last cell of a row divide nothing, or end an empty cell.
        widths = {s: [len(line.rstrip(s).split(None if s == " " else s)) for line in sample] for s in SEPARATORS}
        whole = {s: [line.count(s) + 1 for line in sample] for s in "\t;|,"}
        modes = {
            s: max((*Counter(w).items(), *Counter(whole.get(s, ())).items()), key=lambda item: item[1], default=(1, 0))
            for s, w in widths.items()
        }
        # Commas and spaces stand in numbers and titles too: there the first line must be divided alike.
        clear = (s for s, (cells, count) in modes.items() if s in "\t;|" and cells > 1 and 2 * count > len(sample))
        regular = (s for s, (cells, count) in modes.items() if cells > 1 and count >= 0.9 * len(sample))
        frequent = (s for s, (n, count) in modes.items() if n > 1 and 2 * count > len(sample) and n == widths[s][0])
        if separator := next(clear, None) or next(regular, None) or next(frequent, None):
            return separator
    # In a short table below a heading only names and rows are divided.
    totals = {s: Counter(len(line.split(None if s == " " else s)) for line in lines) for s in SEPARATORS}
    divided = {s: max(((n, c) for c, n in w.items() if c > 1), default=(0, 0)) for s, w in totals.items() if s != " "}
    return next((s for s, (count, _) in divided.items() if 2 * count > len(lines)), ",")


def _names_in_remark(remarks: Sequence[tuple[int, str]], rows: Sequence[Row], separator: str) -> Row | None:
    """Names of the columns in the last remark with as many words as the rows have cells, where no row holds names."""
    if not rows or names_first(rows):
        return None
    width = filled_width(rows[0].cells)
    for line, remark in reversed(remarks):
        # "#L" begins the names of SPEC files; "x_cmd x_read [mm]" has one unit for all.
        content = re.sub(r"^(?:[#%!]|//)+(?:L(?=\s))?\s*", "", remark)
        common = re.search(r"\s*([(\[][^()\[\]]+[)\]])$", content)
        bare = content[: common.start()] if common and parse_unit(common[1].strip("()[] ")) else content
        for names, unit in ((content, ""), (bare, f" {common[1]}" if common else "")):
            for divide in (separator, "\t", ",", ";", "  ", None):
                cells = re.split(r"\s{2,}", names) if divide == "  " else names.split(divide)
                cells = [cell.strip() for cell in cells]
                if len(cells) == width > 1 and all(cells) and not any(map(is_number, cells)):
                    return Row(line, [f"{cell}{unit}" for cell in cells])
    return None


def _refuse_wide(rows: Sequence[Row], separator: str, file: str) -> None:
    """Refuse rows with more cells than the first row: all cells after a divided one are under wrong names."""
    filled = [row for row in rows if any(row.cells)]
    width = len(filled[0].cells) if filled else 0
    for line, cells in filled:
        if (count := filled_width(cells)) <= width:
            continue
        remedy = _WIDE.get(
            SEPARATORS.get(separator, ""), "a separator inside a cell? put such cells in quotes; or a name is missing"
        )
        remedy = "put # before lines that stand above the names of the columns" if width == 1 else remedy
        names = f"{width} {'name' if width == 1 else 'names'}"
        raise refused("wide-row", file, line=line, count=count, names=names, head=filled[0].line, remedy=remedy)


def text_table_rows(decoded: Decoded, file: str) -> Rows:
    """Rows of a table in a text, the first with the names where it has some.

    Raises:
        InputError: rows that are damaged, or too many.
    """
    rows, separator, remarks = _text_rows(decoded.text, file)
    headed_rows, notes, above = headed(Rows(rows, []))
    names = _names_in_remark(remarks, headed_rows, separator)
    if names is not None:
        headed_rows, notes = [names, *rows], [*notes, "names in the remark above the first row"]
    _refuse_wide(headed_rows, separator, file)
    kind = f"CSV with {SEPARATORS.get(separator, separator)} between cells"
    return Rows(headed_rows, [kind, decoded.encoding, *notes], (*above, *(line for _, line in remarks)))


def is_foreign(head: bytes) -> bool:
    """Whether the first bytes show a foreign table: a workbook, UTF-16, other separators."""
    marks = tuple(mark for mark, codec, _ in _MARKS if codec != "utf-8-sig")
    return (
        head.startswith(WORKBOOKS)
        or head.startswith(marks)
        or re.search(rb"[;\t|]", head.partition(b"\n")[0]) is not None
    )

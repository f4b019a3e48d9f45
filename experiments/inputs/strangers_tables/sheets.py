"""A table of cells as a file: separators, decimal commas, encodings, workbooks, Markdown, lines above the names."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import NamedTuple

import numpy as np

from experiments.inputs.strangers_tables.measured import Stranger

Cell = Decimal | str
"""A number, or a text."""
Columns = dict[str, Sequence[Cell]]
"""By their names."""


@dataclass
class Sheet:
    """Names of columns and rows below them; `heads` are all lines of names, mostly one."""

    heads: list[list[str]]
    rows: list[list[Cell]]
    above: list[str] = field(default_factory=list)


class File(NamedTuple):
    """A file to import."""

    name: str
    data: bytes
    heads: tuple[str, ...] = ()
    """Names of the columns, one line of them."""


def columns_sheet(columns: Columns) -> Sheet:
    """A sheet of columns by their names."""
    return Sheet([list(columns)], [list(row) for row in zip(*columns.values(), strict=True)])


def number(cell: Cell, point: str, form: str = "plain") -> str:
    """A cell as text."""
    if isinstance(cell, str):
        return cell
    text = f"{cell:f}"
    if form == "plus" and cell > 0:
        text = f"+{text}"
    if form == "minus":
        text = text.replace("-", "\u2212")
    if form == "exponent" and "." in text:
        text = f"{float(cell):.9E}"
    return text.replace(".", point)


def preamble(by: Stranger) -> list[str]:
    """Lines that stand above the names."""
    lines = list(by.rng.permutation(np.array(by.words("PREAMBLE")))[: int(by.rng.integers(1, 4))])
    lines += [by.words("DATE")] if by.chance(0.6) else []
    return [str(line) for line in lines] + [""] * by.chance(0.5)


def named(sheet: Sheet) -> tuple[str, ...]:
    """Names of the columns, where they stand on one line."""
    return tuple(sheet.heads[0]) if len(sheet.heads) == 1 else ()


def text_file(by: Stranger, sheet: Sheet) -> File:
    """Text with separators, in an encoding of this language."""
    point = "," if by.language != "en" and by.chance(0.75) else "."
    separator = by.pick((";", ";", "\t") if point == "," else (",", ",", ";", "\t", "|"))
    form, all_quoted = by.pick(("plain",) * 20 + ("plus", "minus", "exponent")), by.chance(0.05)
    separator = "," if all_quoted and by.chance(0.5) else separator
    stream = io.StringIO()
    if by.chance(0.02):
        stream.write(f"sep={separator}\n")
    for line in sheet.above:
        # As a spreadsheet exports it: a label and its text in two cells.
        stream.write(line.replace(": ", separator) + "\n" if separator != "," and by.chance(0.3) else line + "\n")
    csv.register_dialect(
        "stranger", delimiter=separator, lineterminator="\n", quoting=csv.QUOTE_ALL if all_quoted else csv.QUOTE_MINIMAL
    )
    writer = csv.writer(stream, "stranger")
    empty = [""] * int(by.rng.integers(1, 4)) * by.chance(0.03)
    writer.writerows([*sheet.heads, *([number(cell, point, form) for cell in row] + empty for row in sheet.rows)])
    name = f"log.{by.pick(('csv', 'csv', 'txt', 'dat'))}"
    return File(name, encoded(by, stream.getvalue()), named(sheet))


def encoded(by: Stranger, text: str) -> bytes:
    """In an encoding that has all of its letters, with line ends of either kind."""
    text = text.replace("\n", "\r\n") if by.chance(0.4) else text
    encoding = by.pick(("utf-8", "utf-8", "utf-8", "utf-8-sig", "cp1252", "cp1252", "utf-16"))
    try:
        return text.encode(encoding)
    except UnicodeEncodeError:
        return text.encode("utf-8")


def workbook(by: Stranger, sheet: Sheet) -> File:
    """XLSX: numbers as numbers, seldom as texts with the point of the language."""
    import openpyxl

    book = openpyxl.Workbook()
    active = book.active
    assert active is not None
    as_text = by.chance(0.1)
    point = "," if by.language != "en" else "."
    heads = sheet.heads
    if by.chance(0.15):
        # Names on two lines of their cell.
        heads = [[name.replace(" (", "\n(").replace(" [", "\n[") for name in head] for head in heads]
    # The table begins somewhere below and to the right.
    left = [None] * int(by.rng.integers(1, 3)) * by.chance(0.12)
    above: list[list[str]] = [[line] for line in sheet.above]
    for line in [*([[]] * 2 if left else []), *above, *heads]:
        active.append([*left, *line])
    for row in sheet.rows:
        cells = [cell if isinstance(cell, str) else number(cell, point) if as_text else float(cell) for cell in row]
        active.append([*left, *(None if cell == "" else cell for cell in cells)])
    if by.chance(0.08):
        # A summary to the right of the rows.
        for k, cell in enumerate(("Max", 0.034, "Min", -0.021)):
            active.cell(len(heads) + len(above) + 3 + k // 2, len(left) + len(sheet.rows[0]) + 2 + k % 2, cell)
    if by.chance(0.2):
        book.create_sheet("Sheet2")
    if by.chance(0.08):
        # Words come first.
        info = book.create_sheet("Info", 0)
        for text in preamble(by):
            info.append([text])
    stream = io.BytesIO()
    book.save(stream)
    return File("log.xlsx", stream.getvalue(), named(sheet))


def markdown(by: Stranger, sheet: Sheet) -> File:
    """A table of a report: names, a rule, rows; bars at the ends or between the cells alone."""
    left, right = by.pick((("| ", " |"), ("| ", " |"), ("", "|"), ("", "")))
    rule = by.pick(("---", "---:", ":---:", "------"))
    names = [name.replace("|", "/") for name in sheet.heads[-1]]
    lines = [names, [rule] * len(names), *([number(cell, ".") for cell in row] for row in sheet.rows)]
    text = "\n".join(left + " | ".join(cells) + right for cells in lines) + "\n"
    title = "# Measurements\n\nTable 1, first day.\n\n" if by.chance(0.4) else ""
    above = "".join(f"{line}\n" for line in sheet.above if line)
    return File("report.md", encoded(by, title + above + "\n" * bool(above) + text), tuple(names))


def with_index(by: Stranger, sheet: Sheet) -> None:
    """A first column without a name that counts the rows, as a data frame is saved."""
    sheet.heads = [["", *head] for head in sheet.heads]
    sheet.rows = [[Decimal(k), *row] for k, row in enumerate(sheet.rows)]


def other_case(by: Stranger, sheet: Sheet) -> None:
    """Names without a space before the unit, or in capitals."""
    if by.chance(0.5):
        sheet.heads = [[name.replace(" (", "(").replace(" [", "[") for name in head] for head in sheet.heads]
    else:
        sheet.heads = [[_capitals(name) for name in head] for head in sheet.heads]


def _capitals(name: str) -> str:
    """Capitals up to the unit: "mm" is never "MM"."""
    begin = re.search(r"[(\[/_,]| in |\bmm$", name)
    word = name if begin is None else name[: begin.start()]
    if re.fullmatch(r"[^(]*\((mm|in|deg)\)", name) and len(name) % 3 == 0:
        return name.upper()
    # u is no U.
    return name if len(word.strip()) == 1 else word.upper() + name[len(word) :]


def blank_rows(by: Stranger, sheet: Sheet) -> None:
    """Empty rows between others."""
    for place in sorted(by.rng.choice(len(sheet.rows), 2, replace=False).tolist(), reverse=True):
        sheet.rows.insert(place, [""] * len(sheet.rows[0]))


def mean_row(by: Stranger, sheet: Sheet) -> None:
    """Means below the columns."""
    label = {"en": ("Mean", "Average"), "de": ("Mittelwert", "MW"), "es": ("Media", "Promedio"), "fr": ("Moyenne",)}
    row: list[Cell] = [by.pick(label[by.language])]
    for cells in list(zip(*sheet.rows, strict=True))[1:]:
        numbers = [float(cell) for cell in cells if isinstance(cell, Decimal)]
        row.append(Decimal(f"{np.mean(numbers):.3f}") if len(numbers) == len(cells) else "")
    sheet.rows.append(row)


def names_again(by: Stranger, sheet: Sheet) -> None:
    """The names at the top of another page."""
    sheet.rows.insert(len(sheet.rows) // 2, list(sheet.heads[0]))


def units_in_cells(by: Stranger, sheet: Sheet) -> None:
    """10.002 mm in each cell of a column, and no unit at its head."""
    for k, name in enumerate(sheet.heads[0]):
        found = re.fullmatch(r"(.*\w)\s*[(\[](mm|\u00b5m|cm|inch|deg|\u00b0|gon|mrad|in)[)\]]", name)
        if found and all(isinstance(row[k], Decimal) for row in sheet.rows):
            sheet.heads[0][k] = found[1]
            space = "" if found[2] == "\u00b0" else " "
            point = "," if by.language != "en" else "."
            for row in sheet.rows:
                row[k] = number(row[k], point) + space + found[2]


def footer(by: Stranger, sheet: Sheet) -> None:
    """A line of text below the rows."""
    for line in [[], [by.word("FOOTER")]][by.chance(0.5) :]:
        sheet.rows.append([*line, *[""] * (len(sheet.rows[0]) - len(line))])


QUIRKS = (with_index, other_case, other_case, blank_rows, mean_row, names_again, units_in_cells, footer)


def any_file(by: Stranger, sheet: Sheet, markdowns: bool = True) -> File:
    """Mostly text, a workbook, or Markdown."""
    if not sheet.above and by.chance(0.3):
        sheet.above = preamble(by)
    if len(sheet.heads) == 1 and by.chance(0.25):
        by.pick(QUIRKS)(by, sheet)
    which = by.rng.random()
    if which < 0.12:
        return workbook(by, sheet)
    if which < 0.17 and markdowns and len(sheet.heads) == 1:
        return markdown(by, sheet)
    return text_file(by, sheet)


def lines_of(file: File) -> list[str]:
    """A file for people to look at."""
    data = file.data
    if data.startswith(b"PK"):
        import openpyxl

        active = openpyxl.load_workbook(io.BytesIO(data)).active
        assert active is not None
        return [" | ".join("" if cell is None else str(cell) for cell in row) for row in active.values]
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16").splitlines()
    try:
        return data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        return data.decode("cp1252").splitlines()


def columns_file(by: Stranger, columns: Columns, markdowns: bool = True) -> File:
    """A file of columns by their names."""
    return any_file(by, columns_sheet(columns), markdowns)

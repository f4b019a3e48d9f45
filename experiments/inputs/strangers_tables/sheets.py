"""A table of cells as a file: separators, decimal commas, encodings, workbooks, Markdown, lines above the names."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import NamedTuple

import numpy as np

from experiments.inputs.strangers_tables import words
from experiments.inputs.strangers_tables.measured import chance, pick

Cell = Decimal | str
"""A number, or a text."""


@dataclass
class Sheet:
    """Names of columns and rows below them; `heads` are all lines of names, mostly one."""

    heads: list[list[str]]
    rows: list[list[Cell]]
    language: str = "en"
    above: list[str] = field(default_factory=list)


class File(NamedTuple):
    """A file to import."""

    name: str
    data: bytes


def columns_sheet(columns: dict[str, Sequence[Cell]], language: str) -> Sheet:
    """A sheet of columns by their names."""
    return Sheet([list(columns)], [list(row) for row in zip(*columns.values(), strict=True)], language)


def number(cell: Cell, point: str, form: str = "plain") -> str:
    """A cell as text."""
    if isinstance(cell, str):
        return cell
    text = f"{cell:f}"
    if form == "plus" and cell > 0:
        text = f"+{text}"
    if form == "minus":
        text = text.replace("-", "\u2212")
    return text.replace(".", point)


def preamble(rng: np.random.Generator, language: str) -> list[str]:
    """Lines that stand above the names."""
    lines = list(rng.permutation(np.array(words.PREAMBLE[language]))[: int(rng.integers(1, 4))])
    lines += [words.DATE[language]] if chance(rng, 0.6) else []
    return [str(line) for line in lines] + [""] * chance(rng, 0.5)


def text_file(rng: np.random.Generator, sheet: Sheet) -> File:
    """Text with separators, in an encoding of this language."""
    point = "," if sheet.language != "en" and chance(rng, 0.75) else "."
    separator = pick(rng, (";", ";", "\t") if point == "," else (",", ",", ";", "\t", "|"))
    form = pick(rng, ("plain",) * 12 + ("plus", "minus"))
    stream = io.StringIO()
    for line in sheet.above:
        # As a spreadsheet exports it: a label and its text in two cells.
        stream.write(line.replace(": ", separator) + "\n" if separator != "," and chance(rng, 0.3) else line + "\n")
    writer = csv.writer(stream, delimiter=separator, lineterminator="\n")
    # Quotes only where they are needed, as spreadsheets write them; some write all.
    if chance(rng, 0.05):
        writer = csv.writer(stream, delimiter=separator, lineterminator="\n", quoting=csv.QUOTE_ALL)
    writer.writerows([*sheet.heads, *([number(cell, point, form) for cell in row] for row in sheet.rows)])
    return File(f"log.{pick(rng, ('csv', 'csv', 'txt', 'dat'))}", encoded(rng, stream.getvalue()))


def encoded(rng: np.random.Generator, text: str) -> bytes:
    """In an encoding that has all of its letters, with line ends of either kind."""
    text = text.replace("\n", "\r\n") if chance(rng, 0.4) else text
    encoding = pick(rng, ("utf-8", "utf-8", "utf-8", "utf-8-sig", "cp1252", "cp1252", "utf-16"))
    try:
        return text.encode(encoding)
    except UnicodeEncodeError:
        return text.encode("utf-8")


def workbook(rng: np.random.Generator, sheet: Sheet) -> File:
    """XLSX: numbers as numbers, seldom as texts with the point of the language."""
    import openpyxl

    book = openpyxl.Workbook()
    active = book.active
    assert active is not None
    as_text = chance(rng, 0.1)
    point = "," if sheet.language != "en" else "."
    for line in (*([above] for above in sheet.above), *sheet.heads):
        active.append(line)
    for row in sheet.rows:
        active.append(
            [cell if isinstance(cell, str) else number(cell, point) if as_text else float(cell) for cell in row]
        )
    if chance(rng, 0.2):
        book.create_sheet("Sheet2")
    stream = io.BytesIO()
    book.save(stream)
    return File("log.xlsx", stream.getvalue())


def markdown(rng: np.random.Generator, sheet: Sheet) -> File:
    """A table of a report: names, a rule, rows; bars at the ends or between the cells alone."""
    left, right = pick(rng, (("| ", " |"), ("| ", " |"), ("", "|"), ("", "")))
    rule = pick(rng, ("---", "---:", ":---:", "------"))
    names = [name.replace("|", "/") for name in sheet.heads[-1]]
    lines = [names, [rule] * len(names), *([number(cell, ".") for cell in row] for row in sheet.rows)]
    text = "\n".join(left + " | ".join(cells) + right for cells in lines) + "\n"
    title = "# Measurements\n\nTable 1, first day.\n\n" if chance(rng, 0.4) else ""
    return File("report.md", encoded(rng, title + text))


def any_file(rng: np.random.Generator, sheet: Sheet, markdowns: bool = True) -> File:
    """Mostly text, a workbook, or Markdown."""
    if not sheet.above and chance(rng, 0.3):
        sheet.above = preamble(rng, sheet.language)
    which = rng.random()
    if which < 0.12:
        return workbook(rng, sheet)
    if which < 0.17 and markdowns and len(sheet.heads) == 1:
        return markdown(rng, sheet)
    return text_file(rng, sheet)


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

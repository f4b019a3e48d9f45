"""Strict files at the border: teaching errors, capped bytes, CSV, TOML, JSON, arrays, images, atomic writes.

Everything a stranger's folder can contain enters the package here. A reader either returns checked values or raises
`InputError` with file, line, column, what was found, what is allowed and what to do; sizes are capped before anything
is parsed. Numbers obey an own ASCII pattern: `float` alone would take "9_4.7", "infinity" and Arabic digits. A TOML
file of 40 kB with one key of 20 000 dotted parts holds `tomllib` for seconds and deep brackets exhaust the stack
(research: CPython gh-149231), so TOML and JSON are scanned in linear time first.

No JAX, no knowledge of what a campaign is. Lines count from 1.
"""

from __future__ import annotations

import csv
import datetime
import difflib
import errno
import io
import json
import math
import numbers
import os
import re
import secrets
import stat
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


class TvsError(Exception):
    """An error that a user can act on; the command line turns it into an exit code.

    Attributes:
        code: short stable identifier, e.g. "number", "unknown-key".
        exit_code: what the process returns (DESIGN section 8).
        file: name of the file as the user knows it, or None.
        line: line number, 1-based, or None.
        column: name of the column or dotted key, or None.
        found: what stood there, shortened, control characters escaped.
        allowed: what may stand there.
        remedy: what the user can do now.
    """

    exit_code = 1

    def __init__(
        self,
        code: str,
        message: str,
        *,
        file: str | None = None,
        line: int | None = None,
        column: str | None = None,
        found: str | None = None,
        allowed: str | None = None,
        remedy: str | None = None,
    ):
        super().__init__(message)
        self.code = code
        self.message = message
        self.file = file
        self.line = line
        self.column = column
        self.found = found
        self.allowed = allowed
        self.remedy = remedy

    def __reduce__(self):
        # Exceptions are pickled by their positional arguments alone; a worker process of a pool has to tell ours whole.
        named = ("file", "line", "column", "found", "allowed", "remedy")
        return partial(type(self), **{name: getattr(self, name) for name in named}), (self.code, self.message)


class InputError(TvsError):
    """A file, option or value that cannot be used as it is (exit 2)."""

    exit_code = 2


class NothingToEstimate(TvsError):
    """The data are readable but hold nothing to estimate from (exit 3)."""

    exit_code = 3


class NotConverged(TvsError):
    """An estimator did not reach its convergence criterion (exit 4)."""

    exit_code = 4


class DeviceFault(TvsError):
    """The positioner, a camera or the disk failed while an instrument was in use (exit 5)."""

    exit_code = 5


INTEGER = re.compile(r"[+-]?[0-9]{1,18}")
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


def escaped(text: str, limit: int = 60) -> str:
    """Text from a file made fit to print: what is not printable is escaped, what is long is cut."""
    cut = text if len(text) <= limit else text[:limit] + "..."
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in cut)


def shown(value: object) -> str:
    """A value as an error message quotes it."""
    if isinstance(value, str):
        return f'"{escaped(value)}"'
    if isinstance(value, dict):
        return "a table with " + (escaped(", ".join(map(str, value))) or "no keys")
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, bool):
        return str(value).lower()
    # An integer beyond Python's limit of digits cannot be printed at all.
    huge = isinstance(value, int) and abs(value) >= 10**60
    return "an integer of more than 60 digits" if huge else escaped(str(value))


def refusal(
    code: str,
    *,
    file: str,
    found: str,
    allowed: str,
    remedy: str,
    line: int | None = None,
    column: str | None = None,
) -> InputError:
    """Builds the `InputError` whose message says where, what was found, what is allowed and what to do."""
    where = file + (f" line {line}" if line else "") + (f", {escaped(column)}" if column else "")
    message = f"{where}: found {found}; allowed: {allowed}; {remedy}"
    where_parts = {"file": file, "line": line, "column": column}
    return InputError(code, message, **where_parts, found=found, allowed=allowed, remedy=remedy)


def closest(name: str, names: Iterable[str]) -> str:
    """The remedy for an unknown name: the nearest allowed one, where any is near."""
    near = difflib.get_close_matches(name[:100], list(names), n=1, cutoff=0.5)
    return f"did you mean {near[0]}?" if near else "remove it, or correct the spelling"


def listed(numbers: Sequence[int], most: int) -> str:
    """The first of them, and how many more there are."""
    more = f" and {len(numbers) - most} more" if len(numbers) > most else ""
    return ", ".join(map(str, numbers[:most])) + more


def other_format(found: str, allowed: Iterable[str]) -> str | None:
    """The remedy for a file of another kind or version of ours; None where it is neither."""
    kind, _, number = found[:100].rpartition("/")
    known = {name.rpartition("/")[0] for name in allowed}
    if not (kind.startswith("tvsbayes-") and number.isdecimal()):
        return None
    if kind in known:
        return "another version of tvsbayes wrote it: use that one, or make the file again"
    return f"this is a {escaped(kind)} file: name a {' or '.join(sorted(known))} file"


def read_bytes(path: Path, cap: int, folder: Path | None = None) -> bytes:
    """Reads a regular file of at most `cap` bytes.

    Args:
        path: the file.
        cap: largest size, bytes; checked before reading.
        folder: where given, the file must lie inside it after following links.

    Raises:
        InputError: missing, unreadable, not a regular file, outside `folder` or too large.
    """
    path = Path(path)
    file = escaped(path.name) or escaped(str(path))

    def bad(code: str, found: str, remedy: str) -> InputError:
        allowed = f"a readable file of at most {cap} bytes"
        return refusal(code, file=file, found=found, allowed=allowed, remedy=remedy)

    try:
        real = path.resolve(strict=True)
        if folder is not None and not real.is_relative_to(Path(folder).resolve()):
            raise bad("path", "a link that leaves the folder", "put the file itself into the folder")
        # Without O_NONBLOCK the opening of a pipe would wait for a writer for ever.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0)
        descriptor = os.open(real, flags | getattr(os, "O_BINARY", 0))
        try:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise bad("not-a-file", "a folder, pipe or device", "name a regular file")
            if status.st_size > cap:
                raise bad("size", f"{status.st_size} bytes", "split the data or remove what is not needed")
            with open(descriptor, "rb", closefd=False) as stream:
                # As much as there is: a read of the cap would allocate the cap for every file.
                data = stream.read(status.st_size + 1)
                if len(data) > status.st_size:
                    data += stream.read(cap + 1 - len(data))
        finally:
            os.close(descriptor)
    except FileNotFoundError as error:
        remedy = f"create it, or correct {escaped(str(path), 200)}"
        if Path(path).name == "stereo.json":
            remedy = f"`tvsbayes stereo` makes one of pictures or of OpenCV's, ROS' or Kalibr's calibration; {remedy}"
        raise bad("missing-file", "no such file", remedy) from error
    except (OSError, ValueError) as error:
        reason = escaped(getattr(error, "strerror", None) or str(error))
        raise bad("unreadable", reason, "check the path and its permissions") from error
    if len(data) > cap:
        raise bad("size", f"more than {cap} bytes", "split the data or remove what is not needed")
    return data


def decode(data: bytes, file: str) -> str:
    """UTF-8 text with or without BOM; refuses other encodings, NUL and other control characters."""
    bad = partial(refusal, file=file)
    utf16 = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = None if utf16 else data.count(b"\n", 0, error.start) + 1
        found = "UTF-16" if utf16 else f"the byte 0x{data[error.start]:02x}"
        allowed, remedy = "UTF-8 text", "save it as UTF-8"
        raise bad("encoding", line=line, found=found, allowed=allowed, remedy=remedy) from error
    if control := _CONTROL.search(text):
        line, found = text.count("\n", 0, control.start()) + 1, shown(control.group())
        raise bad("control-character", line=line, found=found, allowed="printable text", remedy="remove it")
    return text


FLUSHES_NO_FOLDER = frozenset({errno.EINVAL, errno.ENOTSUP})
"""How a file system (some network shares) says that it can flush files only, fsync(2): its own order has to do."""


def flush_folder(folder: Path, disk=os) -> None:
    """Make the names in a folder durable, where the system can: only POSIX flushes folders.

    Args:
        folder: which.
        disk: has `open`, `fsync` and `close` as the module `os` has.

    Raises:
        OSError: the disk failed.
    """
    if os.name != "posix":
        return
    descriptor = disk.open(folder, os.O_RDONLY)
    try:
        disk.fsync(descriptor)
    except OSError as error:
        if error.errno not in FLUSHES_NO_FOLDER:
            raise
    finally:
        disk.close(descriptor)


def write_atomically(path: Path, data: bytes) -> None:
    """Replaces `path` by `data` so that a reader, or a crash, sees the old file or the new, never a part.

    Raises:
        InputError: the folder is missing, full or not writable; there stands the old file, or where only the flush
            of the folder failed, the new one.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
    try:
        try:
            with open(temporary, "xb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        # The new name itself is durable only once its folder is.
        flush_folder(path.parent)
    except OSError as error:
        found, allowed = escaped(error.strerror or str(error)), "a writable folder with free space"
        remedy, file = "name another place or free this one", escaped(str(path), 200)
        raise refusal("write", file=file, found=found, allowed=allowed, remedy=remedy) from error


def make_folder(folder: Path, *, empty: bool = False) -> None:
    """Create a folder and those above it.

    Args:
        folder: where to.
        empty: refuse a folder that holds anything: nothing is overwritten.

    Raises:
        InputError: it cannot be created, or holds something.
    """
    place = escaped(str(folder), 200)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupied = empty and any(folder.iterdir())
    except OSError as error:
        found, allowed = escaped(error.strerror or str(error)), "a new or empty folder"
        raise refusal("write", file=place, found=found, allowed=allowed, remedy="name another") from error
    if occupied:
        allowed, remedy = "a new or empty folder", "name another folder; nothing is overwritten"
        raise refusal("occupied", file=place, found="a folder with files", allowed=allowed, remedy=remedy)


def output_place(folder: Path, *names: str) -> Path:
    """`folder / names`, a place for output that no link leads out of the folder.

    Raises:
        InputError: a link inside the folder leads elsewhere: a stranger's folder chooses no place to write to.
    """
    place = Path(folder).joinpath(*names)
    try:
        inside = place.resolve().is_relative_to(Path(folder).resolve())
    except (OSError, RuntimeError):
        inside = False
    if not inside:
        shown_place, allowed = escaped(str(place), 200), "a folder inside the campaign"
        remedy = "remove the link, or name the place for results with --out where the command has it"
        raise refusal("path", file=shown_place, found="a link that leaves it", allowed=allowed, remedy=remedy)
    return place


def shipped_data() -> Path:
    """The folder of twins, rigs, templates and reference values that travels with the package.

    In a wheel it lies inside the package; in a checkout (also an editable install) beside it.
    """
    inside = Path(str(resources.files("tvsbayes") / "data"))
    return inside if inside.is_dir() else Path(__file__).resolve().parents[1] / "data"


CSV_BYTES_MAX = 64 * 1024 * 1024
CSV_ROWS_MAX = 200_000
"""At these caps a table of spots takes 0.6 GB and 6 s of processor time to read (experiments/hostile.md)."""
CSV_LINE_CHARS_MAX = 16_384

NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


def number_remedy(cell: str, *, whole: bool = False) -> str:
    """What to do about a cell that is no plain number, or no plain whole number."""
    if cell.startswith(("=", "@")):
        return "save the value, not the formula"
    if cell.strip().lower().lstrip("+-") in ("nan", "inf", "infinity"):
        return "write a finite number; the pixels of a spot that was not seen are empty, its status says why"
    if "," in cell:
        return "write a decimal point, not a comma"
    if "_" in cell or any(c.isspace() for c in cell):
        return "write the digits without underscores or spaces"
    if not cell.isascii():
        return "write it in the digits 0 to 9"
    return "write a whole number such as 200" if whole else "write a decimal number such as 9.47"


def _plain(cells: Sequence[str], kind: type[float] | type[int], low: float, high: float) -> list | None:
    """The numbers of a column without a single odd cell, fast; else None, and each cell is looked at."""
    # Of what these characters can spell, float() and int() take exactly NUMBER and INTEGER.
    if not cells or not set().union(*cells) <= set("0123456789+-" if kind is int else "0123456789+-.eE"):
        return None
    try:
        values = list(map(kind, cells))
    except ValueError:
        return None
    return values if low <= min(values) and max(values) <= high else None


class Table:
    """A checked CSV table: cells by column name, each with its line for the errors.

    Attributes:
        file: name of the file.
        lines: line number of every row.
        columns: cells of every column present, as text.
    """

    def __init__(self, file: str, lines: list[int], columns: dict[str, Sequence[str]]):
        self.file, self.lines, self.columns = file, lines, columns

    def __len__(self) -> int:
        return len(self.lines)

    def refuse(
        self, row: int, column: str, code: str, allowed: str, remedy: str, found: str | None = None
    ) -> InputError:
        """The error of one cell; `found` defaults to what stands in it."""
        if found is None:
            found = shown(self.columns[column][row]) if self.columns[column][row] else "an empty cell"
        place = {"file": self.file, "line": self.lines[row], "column": column}
        return refusal(code, **place, found=found, allowed=allowed, remedy=remedy)

    def numbers(self, column: str, low: float, high: float, empty: bool = False) -> list[float | None]:
        """Finite numbers in [low, high]; None for an empty cell where `empty` allows it."""
        if (plain := _plain(self.columns[column], float, low, high)) is not None:
            return plain
        values: list[float | None] = []
        match, isfinite = NUMBER.fullmatch, math.isfinite
        for row, cell in enumerate(self.columns[column]):
            if not cell and empty:
                values.append(None)
                continue
            value = float(cell) if match(cell) else math.nan
            if not (isfinite(value) and low <= value <= high):
                allowed = f"a finite decimal number from {low:g} to {high:g}{', or an empty cell' * empty}"
                remedy = "mind the unit of the column" if isfinite(value) else number_remedy(cell)
                raise self.refuse(row, column, "number", allowed, remedy)
            values.append(value)
        return values

    def integers(self, column: str, low: int, high: int, empty: bool = False) -> list[int | None]:
        """Whole numbers in [low, high]; None for an empty cell where `empty` allows it."""
        if (plain := _plain(self.columns[column], int, low, high)) is not None:
            return plain
        values: list[int | None] = []
        for row, cell in enumerate(self.columns[column]):
            if not cell and empty:
                values.append(None)
                continue
            value = int(cell) if INTEGER.fullmatch(cell) else None
            if value is None or not low <= value <= high:
                allowed = f"a whole number from {low} to {high}{', or an empty cell' * empty}"
                remedy = "write a whole number, no point" if NUMBER.fullmatch(cell) else number_remedy(cell, whole=True)
                raise self.refuse(row, column, "integer", allowed, remedy)
            values.append(value)
        return values

    def texts(self, column: str, chars_max: int = 100, empty: bool = True) -> list[str]:
        """Printable text that a spreadsheet does not take for a formula."""
        allowed = f"printable text of at most {chars_max} characters that does not begin with = + - @"
        for row, cell in enumerate(self.columns[column]):
            if len(cell) > chars_max or not cell.isprintable() or cell.startswith(("=", "+", "-", "@")):
                raise self.refuse(row, column, "text", allowed, "shorten or reword it")
            if not cell and not empty:
                raise self.refuse(row, column, "missing", allowed, "fill the cell in")
        return list(self.columns[column])

    def check_counting(self, column: str, values: Sequence[int | None]) -> None:
        """Refuses a column that does not count 0, 1, 2 ..."""
        for row, value in enumerate(values):
            if value != row:
                raise self.refuse(row, column, "order", f"{row}", "number the rows 0, 1, 2 ... in time order")

    def check_unique(self, column: str, values: Sequence[object], what: str) -> None:
        """Refuses a value that stands twice; None does not count."""
        seen: dict[object, int] = {}
        for row, value in enumerate(values):
            if value is not None and seen.setdefault(value, row) != row:
                found = f"{shown(self.columns[column][row])} again (first on line {self.lines[seen[value]]})"
                raise self.refuse(row, column, "duplicate", what, "renumber one of them", found)


_CSV_LINE = re.compile(r"[^\r\n]*(?:\r\n?|\n)|[^\r\n]+")


def _csv_rows(text: str, file: str) -> Iterator[tuple[int, list[str]]]:
    """Rows of a CSV text with the line on which each begins."""
    bad = partial(refusal, file=file)

    def capped_lines() -> Iterator[str]:
        # A StringIO would hold the text once more, with four bytes a character.
        for number, found_line in enumerate(_CSV_LINE.finditer(text), start=1):
            line = found_line.group()
            if len(line) > CSV_LINE_CHARS_MAX:
                found, allowed = f"{len(line)} characters in one line", f"at most {CSV_LINE_CHARS_MAX}"
                raise bad("size", line=number, found=found, allowed=allowed, remedy="one row per line")
            yield line

    reader = csv.reader(capped_lines(), strict=True)
    start = 1
    try:
        for row in reader:
            if reader.line_num > start:
                raise csv.Error("a line break inside a cell")
            yield start, row
            start = reader.line_num + 1
    except csv.Error as error:
        allowed, remedy = "comma-separated cells, one row per line", 'close every quote " in its own line'
        found = escaped(str(error), 120)
        raise bad("csv", line=start, found=found, allowed=allowed, remedy=remedy) from error


def parse_table(data: bytes, file: str, columns: Sequence[str], optional: Sequence[str] = ()) -> Table:
    """A CSV table with exactly `columns` and any of `optional`, found by name in any order.

    Raises:
        InputError: not UTF-8, control characters, no or a wrong header, rows of another length than it.
    """
    bad = partial(refusal, file=file)
    rows = _csv_rows(decode(data, file), file)
    _, header = next(rows, (1, []))
    allowed = "the columns " + ",".join(columns) + (f" and optionally {','.join(optional)}" * bool(optional))
    bad_header = partial(bad, line=1, allowed=allowed)
    if not header:
        raise bad_header("empty", found="no header", remedy="write the column names into the first line")
    if len(header) == 1 and re.search(r"[;\t]", header[0]):
        raise bad_header("csv", found=shown(header[0]), remedy="use commas between cells, decimal points")
    known = (*columns, *optional)
    for name in header:
        if name not in known:
            found, remedy = f"an unknown column {shown(name)}", closest(name, known)
            raise bad_header("unknown-column", column=name, found=found, remedy=remedy)
        if header.count(name) > 1:
            raise bad_header("duplicate-column", column=name, found="the column twice", remedy="remove one")
    for name in columns:
        if name not in header:
            raise bad_header("missing-column", column=name, found="no such column", remedy=f"add {name}")

    lines: list[int] = []
    cells: list[list[str]] = []
    blank = None
    for line, row in rows:
        if not row:
            blank = blank or line
            continue
        if blank is not None or len(row) != len(header):
            found, cells_allowed = "an empty line" if blank else f"{len(row)} cells", f"{len(header)} cells"
            remedy = "one cell per column; a decimal comma splits a number in two: write a point"
            if blank:
                remedy = "remove it; only the end of the file may be empty"
            raise bad("row-length", line=blank or line, found=found, allowed=cells_allowed, remedy=remedy)
        if len(lines) >= CSV_ROWS_MAX:
            found, rows_allowed = "a row more", f"at most {CSV_ROWS_MAX} rows"
            raise bad("size", line=line, found=found, allowed=rows_allowed, remedy="split the campaign")
        lines.append(line)
        cells.append(row)
    by_column = list(zip(*cells, strict=True)) or [()] * len(header)
    return Table(file, lines, dict(zip(header, by_column, strict=True)))


def csv_bytes(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    """A CSV file: None is an empty cell, floats keep every digit."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return stream.getvalue().encode()


TOML_BYTES_MAX = 65_536
JSON_BYTES_MAX = 4 * 1024 * 1024
DOTTED_PARTS_MAX = 8
NESTING_MAX = 16

# Both patterns always match from an opening quote to its end or the end of the line (or file), never
# backtracking: a scan is linear whatever a stranger writes.
_JSON_STRING = re.compile(r'"(?:\\.|[^"\\])*+"?', re.DOTALL)
_TOML_STRING_OR_COMMENT = re.compile(
    r'"""(?:\\.|[^\\])*?(?:"""|\Z)|\'\'\'.*?(?:\'\'\'|\Z)|"(?:\\[^\n]|[^"\\\n])*+"?|\'[^\'\n]*+\'?|#[^\n]*+',
    re.DOTALL,
)


def _check_nesting(bare: str, file: str) -> None:
    """Refuses brackets nested too deeply for a recursive parser; `bare` is text without its strings."""
    depth = 0
    for bracket in re.finditer(r"[\[\]{}]", bare):
        depth = depth + 1 if bracket.group() in "[{" else max(depth - 1, 0)
        if depth > NESTING_MAX:
            raise refusal(
                "nesting",
                file=file,
                line=bare.count("\n", 0, bracket.start()) + 1,
                found=f"brackets nested more than {NESTING_MAX} deep",
                allowed=f"at most {NESTING_MAX} levels",
                remedy="flatten the file",
            )


class Keys:
    """One table of a TOML or JSON file, read key by key; its errors know file, line and dotted key."""

    def __init__(self, values: dict[str, object], file: str, text: str, path: tuple[str, ...] = ()):
        """`values` as parsed from `text`; `path` leads from the top of the file to this table."""
        self.values, self.file, self.text, self.path = values, file, text, path

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def refuse(self, key: str, code: str, allowed: str, remedy: str, found: str | None = None) -> InputError:
        """The error of one key; `found` defaults to the value that stands there."""
        if found is None:
            found = shown(self.values[key]) if key in self.values else "nothing"
        keys = (*self.path, key)
        return refusal(
            code,
            file=self.file,
            line=self._line(keys),
            column=".".join(escaped(k) for k in keys),
            found=found,
            allowed=allowed,
            remedy=remedy,
        )

    def _line(self, keys: tuple[str, ...]) -> int | None:
        """The line of the innermost of `keys` that can be found in the text, outside TOML comments."""
        text = _TOML_STRING_OR_COMMENT.sub(
            lambda m: " " * len(m.group()) if m.group().startswith("#") else m.group(), self.text
        )
        position = None
        for key in keys:
            pattern = rf"(?m)(?:^|[\[{{,.])[ \t]*[\"']?{re.escape(key)}[\"']?[ \t]*(?=[=.\]:])"
            if match := re.compile(pattern).search(text, position or 0):
                position = match.end() - 1
        return None if position is None else text.count("\n", 0, position) + 1

    def only(self, names: Iterable[str]) -> None:
        """Refuses keys outside `names`."""
        names = tuple(names)
        for key in self.values:
            if key not in names:
                allowed = "only " + ", ".join(names)
                raise self.refuse(key, "unknown-key", allowed, closest(key, names), found="an unknown key")

    def _get(self, key: str, allowed: str) -> object:
        if key not in self.values:
            raise self.refuse(key, "missing-key", allowed, f"add {key}")
        return self.values[key]

    def number(self, key: str, low: float, high: float) -> float:
        """A finite number in [low, high]; booleans are none."""
        allowed = f"a finite number from {low:g} to {high:g}" if low < high else f"exactly {low:g}"
        value = self._get(key, allowed)
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise self.refuse(key, "number", allowed, "correct the value and mind its unit")
        return float(value)

    def integer(self, key: str, low: int, high: int) -> int:
        """A whole number in [low, high]."""
        allowed = f"a whole number from {low} to {high}"
        value = self._get(key, allowed)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.refuse(key, "integer", allowed, "correct the value")
        return value

    def text_value(self, key: str, chars_max: int = 200) -> str:
        """Printable text without line breaks; `notes`-like fields raise `chars_max` and may hold breaks."""
        allowed = f"printable text of at most {chars_max} characters"
        value = self._get(key, allowed)
        breaks = "\n\t" if chars_max > 200 else ""
        if not isinstance(value, str) or len(value) > chars_max:
            raise self.refuse(key, "text", allowed, "shorten it, or put it in quotes")
        if not all(c.isprintable() or c in breaks for c in value):
            raise self.refuse(key, "text", allowed, "remove the control characters")
        return value

    def flag(self, key: str) -> bool:
        """Whether the switch is on."""
        value = self._get(key, "true or false")
        if not isinstance(value, bool):
            raise self.refuse(key, "boolean", "true or false", "write true or false without quotes")
        return value

    def word(self, key: str, words: tuple[str, ...]) -> str:
        """One of a few words."""
        allowed = " or ".join(shown(w) for w in words)
        value = self._get(key, allowed)
        if value not in words:
            remedy = other_format(str(value), words) if key == "format" else None
            raise self.refuse(key, "word", allowed, remedy or closest(str(value)[:100], words))
        return str(value)

    def table(self, key: str) -> Keys:
        """The table under `key`; an absent one is empty."""
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            place = escaped(".".join((*self.path, key)))
            raise self.refuse(key, "table", "a table", f"write it as [{place}] with keys below")
        return Keys(value, self.file, self.text, (*self.path, key))

    def quantity(self, key: str, low: float, high: float, u_max: float) -> tuple[float, float]:
        """`{ value, u }` with value in [low, high] and standard uncertainty u in [0, u_max]."""
        allowed = "{ value = number, u = standard uncertainty }, both and nothing else"
        value = self._get(key, allowed)
        if not isinstance(value, dict) or set(value) != {"value", "u"}:
            raise self.refuse(key, "quantity", allowed, "u = 0 states that the value is exact")
        entry = self.table(key)
        return entry.number("value", low, high), entry.number("u", 0.0, u_max)


def parse_toml(data: bytes, file: str) -> Keys:
    """The top table of a TOML file; size, nesting and dotted keys are capped before parsing."""
    if len(data) > TOML_BYTES_MAX:
        raise refusal(
            "size",
            file=file,
            found=f"{len(data)} bytes",
            allowed=f"at most {TOML_BYTES_MAX} bytes",
            remedy="shorten it",
        )
    text = decode(data, file)
    bare = _TOML_STRING_OR_COMMENT.sub(lambda m: "Q" + "\n" * m.group().count("\n"), text)
    _check_nesting(bare, file)
    for number, line in enumerate(bare.split("\n"), start=1):
        if any(part.count(".") >= DOTTED_PARTS_MAX for part in re.split(r"[^\w.\- \t]", line)):
            raise refusal(
                "nesting",
                file=file,
                line=number,
                found=f"a key of more than {DOTTED_PARTS_MAX} dotted parts",
                allowed=f"at most {DOTTED_PARTS_MAX}",
                remedy="use the keys of the format only",
            )
    try:
        values = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        place = re.search(r"\(at line (\d+), column \d+\)", str(error))
        raise refusal(
            "toml",
            file=file,
            line=int(place.group(1)) if place else None,
            found=escaped(re.sub(r" \(at .*\)", "", str(error)), 120),
            allowed="TOML 1.0",
            remedy="correct the syntax; text needs quotes, numbers a decimal point",
        ) from error
    return Keys(values, file, text)


def parse_json(data: bytes, file: str) -> Keys:
    """The top object of a JSON file: capped, no duplicate keys, finite numbers only."""

    def bad(code: str, found: str, allowed: str, remedy: str, line: int | None = None) -> InputError:
        return refusal(code, file=file, line=line, found=found, allowed=allowed, remedy=remedy)

    if len(data) > JSON_BYTES_MAX:
        raise bad("size", f"{len(data)} bytes", f"at most {JSON_BYTES_MAX} bytes", "shorten it")
    text = decode(data, file)
    _check_nesting(_JSON_STRING.sub(lambda m: '""' + "\n" * m.group().count("\n"), text), file)

    def number(literal: str) -> int | float:
        if INTEGER.fullmatch(literal):
            return int(literal)
        value = float(literal)
        if not math.isfinite(value) or literal.lstrip("-").isdigit():
            line = text.count("\n", 0, text.find(literal)) + 1
            raise bad("number", shown(literal), "finite numbers, integers of 18 digits", "correct it", line)
        return value

    def constant(literal: str) -> float:
        line = text.count("\n", 0, text.find(literal)) + 1
        raise bad("number", shown(literal), "finite numbers", "give the value", line)

    def unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
        values: dict[str, object] = {}
        for key, value in pairs:
            if key not in values:
                values[key] = value
                continue
            literal = json.dumps(key, ensure_ascii=False)
            line = text.count("\n", 0, text.find(literal, text.find(literal) + 1)) + 1
            raise bad("duplicate-key", f"{shown(key)} twice", "every key once", "remove one of them", line)
        return values

    try:
        values = json.loads(
            text, parse_float=number, parse_int=number, parse_constant=constant, object_pairs_hook=unique
        )
    except (ValueError, RecursionError) as error:
        found = escaped(getattr(error, "msg", str(error)), 120)
        raise bad("json", found, "JSON", "correct the syntax", getattr(error, "lineno", None)) from error
    if not isinstance(values, dict):
        raise bad("json", shown(values), "an object { ... } at the top", "write the keys of the format", 1)
    return Keys(values, file, text)


def toml_value(value: object) -> str:
    """One value in TOML; a dictionary becomes an inline table.

    Raises:
        TypeError: for what no campaign or rig file holds.
    """
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, numbers.Integral):
        return str(int(value))
    if isinstance(value, numbers.Real):
        return repr(float(value))
    if isinstance(value, datetime.datetime | datetime.date):
        return value.isoformat()
    if isinstance(value, dict):
        return "{ " + ", ".join(toml_line(k, v) for k, v in value.items()) + " }"
    raise TypeError(f"no TOML for {type(value).__name__}")


def toml_line(key: str, value: object) -> str:
    """`key = value`, the key quoted where TOML asks for it."""
    bare = re.fullmatch(r"[A-Za-z0-9_-]+", key)
    return f"{key if bare else json.dumps(key, ensure_ascii=False)} = {toml_value(value)}"


ARRAYS_MAX = 256
_NPY_HEADER = re.compile(
    rb"\x93NUMPY\x01\x00(?P<length>..)\{'descr': '(?P<kind>[<>|][biufU][0-9]{1,8})', 'fortran_order': "
    rb"(?P<fortran>True|False), 'shape': \((?P<shape>[0-9, ]{0,100})\),? ?\} *\n",
    re.DOTALL,
)
"""Version 1.0 of the header (NEP 1) as NumPy writes it; no code is evaluated to read it, as NumPy itself does."""


def _array_of(content: bytes, name: str) -> np.ndarray:
    """The array of an .npy; ValueError for anything but numbers and text of exactly the size that its header states."""
    import numpy as np

    match = _NPY_HEADER.match(content)
    if match is None or match.end() != 10 + int.from_bytes(match["length"], "little"):
        raise ValueError(f"{name} is no array of numbers or text")
    shape = tuple(int(length) for length in match["shape"].replace(b" ", b"").split(b",") if length)
    try:
        dtype = np.dtype(match["kind"].decode())
    except TypeError as error:
        raise ValueError(f"{name} is of the kind {match['kind'].decode()}") from error
    if len(shape) > 8 or not dtype.itemsize or math.prod(shape) * dtype.itemsize != len(content) - match.end():
        raise ValueError(f"{name} is not as long as its header says")
    order = "F" if match["fortran"] == b"True" else "C"
    return np.ndarray(shape, dtype, buffer=content, offset=match.end(), order=order).copy()


def read_arrays(path: Path, bytes_max: int, unpacked_max: int) -> dict[str, np.ndarray]:
    """The arrays of an .npz, by name; every size is checked against the header before anything is allocated.

    `numpy.load` alone turns 0.5 kB into gigabytes: by entries of no width, and by bzip2 members, which zipfile
    unpacks without a limit whatever size they state (experiments/hostile.md).

    Raises:
        InputError: what `read_bytes` refuses.
        ValueError: no .npz of plain numbers and text as NumPy writes it, or more than `unpacked_max` bytes.
    """
    data = read_bytes(path, bytes_max)
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) > ARRAYS_MAX or sum(member.file_size for member in members) > unpacked_max:
                raise ValueError(f"more than {ARRAYS_MAX} arrays or {unpacked_max} bytes when unpacked")
            for member in members:
                if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError("an array that is packed in another way than numpy packs it")
                with archive.open(member) as stream:
                    content = stream.read(member.file_size)
                name = member.filename.removesuffix(".npy")
                if name in arrays:
                    raise ValueError(f"{escaped(name)} twice")
                arrays[name] = _array_of(content, escaped(name))
    except ValueError:
        raise
    except (OSError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError) as error:
        raise ValueError(escaped(str(error), 120)) from error
    return arrays


IMAGE_BYTES_MAX = 64 * 1024 * 1024
IMAGE_PIXELS_MAX = 50_000_000
"""A PNG of 0.9 MB can ask for 30000 x 30000 pixels: 4 s and 1.8 GB in the decoder (research/vision.md 6)."""
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
"""The last chunk with its checksum: decoders forgive its loss, a copy cut short has lost more."""
_PNG_DEPTHS = {0: (1, 2, 4, 8), 2: (8,), 3: (1, 2, 4, 8), 6: (8,)}
"""Colour type of a PNG -> bit depths taken: grey, RGB, palette, RGBA (PNG specification 3, 11.2.1)."""
_JPEG_MAGIC = b"\xff\xd8\xff"
_JPEG_FRAMES = (0xC0, 0xC1, 0xC2)
"""Baseline, extended and progressive Huffman frames (ITU-T T.81, table B.1)."""
_JPEG_BARE = (0x01, 0xD8, *range(0xD0, 0xD8))
"""Markers without a length (ITU-T T.81 B.1.1.3)."""
IMAGES_ALLOWED = f"PNG or JPEG of 8 bits per channel, at most {IMAGE_PIXELS_MAX // 1_000_000} million pixels"


def image_size(data: bytes, file: str) -> tuple[int, int]:
    """Width and height in pixels that a PNG or JPEG announces, before anything is decoded.

    Raises:
        InputError: neither PNG nor JPEG, an unusual kind, or too many pixels.
    """

    def bad(code: str, found: str, remedy: str) -> InputError:
        return refusal(code, file=file, found=found, allowed=IMAGES_ALLOWED, remedy=remedy)

    if data.startswith(_PNG_MAGIC):
        if len(data) < 33 or data[8:16] != b"\x00\x00\x00\rIHDR":
            raise bad("image", "a PNG without its header", "copy the file again")
        if not data.endswith(_PNG_END):
            raise bad("image", "a PNG cut short", "copy the file again")
        width, height = int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
        if data[24] not in _PNG_DEPTHS.get(data[25], ()):
            raise bad("image", f"{data[24]} bits, colour type {data[25]}", "save it with 8 bits per channel")
    elif data.startswith(_JPEG_MAGIC):
        width, height = _jpeg_size(data, bad)
    else:
        raise bad("image", f"a file that begins with {data[:8].hex(' ') or 'nothing'}", "save it as PNG")
    if not 0 < width * height <= IMAGE_PIXELS_MAX:
        raise bad("image-size", f"{width} x {height} pixels", "crop or scale it")
    return width, height


def _jpeg_size(data: bytes, bad: Callable[[str, str, str], InputError]) -> tuple[int, int]:
    """Size in the first frame header of a JPEG."""
    position = 2
    while position + 9 <= len(data):
        if data[position] != 0xFF:
            raise bad("image", "a JPEG with bytes between its segments", "copy the file again")
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
        elif marker in _JPEG_BARE:
            position += 2
        elif marker in _JPEG_FRAMES:
            if data[position + 4] != 8:
                raise bad("image", f"{data[position + 4]} bits", "save it with 8 bits per channel")
            return int.from_bytes(data[position + 7 : position + 9]), int.from_bytes(data[position + 5 : position + 7])
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            raise bad("image", f"JPEG of kind SOF{marker - 0xC0}", "save it as PNG")
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4])
    raise bad("image", "a JPEG without a frame", "copy the file again")


def decode_image(data: bytes, file: str) -> np.ndarray:
    """The picture in `data` as (height, width, 3) uint8, channels blue, green, red (OpenCV's order).

    The orientation tag of a JPEG is left out of account: pixel coordinates are those of the sensor.

    Raises:
        InputError: what `image_size` refuses, and data that the decoder cannot read.
    """
    width, height = image_size(data, file)
    import cv2
    import numpy as np

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None or image.shape != (height, width, 3):
        found = "damaged image data" if image is None else f"{image.shape[1]} x {image.shape[0]} pixels in the data"
        raise refusal("image", file=file, found=found, allowed=IMAGES_ALLOWED, remedy="copy or record it again")
    return image


def read_image(path: Path, folder: Path | None = None) -> np.ndarray:
    """A PNG or JPEG as (height, width, 3) uint8, blue, green, red; inside `folder` where given.

    PNG is what the package writes: its checksum finds every damaged byte, a JPEG's damage shows only as wrong
    pixels.

    Raises:
        InputError: what `read_bytes` and `decode_image` refuse.
    """
    return decode_image(read_bytes(path, IMAGE_BYTES_MAX, folder), escaped(Path(path).name))


def png_bytes(image: np.ndarray) -> bytes:
    """PNG of (height, width) or (height, width, 3) uint8 pixels, blue, green, red."""
    import cv2
    import numpy as np

    if image.dtype != np.uint8:
        raise TypeError(f"pixels must be uint8, not {image.dtype}")
    done, data = cv2.imencode(".png", image)
    if not done:
        raise ValueError(f"no PNG of shape {image.shape}")
    return data.tobytes()

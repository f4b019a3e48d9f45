"""The small part of YAML in which OpenCV, ROS and Kalibr write calibrations, read strictly.

Block maps, lists of numbers, OpenCV's matrices. OpenCV's FileStorage has had memory errors on hostile files
(CVE-2019-5063, -5064; opencv #28619), and YAML loaders refuse OpenCV's header and tags. No anchors, no aliases, no
other tags; sizes are capped before parsing. Lines count from 1.
"""

from __future__ import annotations

import math
import re

from tvsbayes.errors import InputError, refusal, shown
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.disk import decode
from tvsbayes.files.documents import Keys

MATRIX_TAG = "!!opencv-matrix"
YAML_BYTES_MAX = 4 * 1024 * 1024
YAML_ENTRIES_MAX = 200_000
YAML_DEPTH_MAX = 3
_KEY = re.compile(r"""([ ]*)(?:"([^"]{1,80})"|([A-Za-z_][\w.-]{0,79}))[ ]*:(?:[ ]+(.*))?""", re.ASCII)
_TOKEN = re.compile(r"""\s*(\[|\]|,|"[^"]*"|'[^']*'|[^\s\[\],"']+)""")
_WORD = re.compile(r"[\w./+-]{1,200}", re.ASCII)
_ALLOWED = "key: value, nested keys, lists of numbers in [ ], OpenCV matrices"


def parse_yaml(data: bytes, file: str) -> Keys:
    """The top map of a YAML file as OpenCV, ROS and Kalibr write it.

    Raises:
        InputError: too large, not UTF-8, or anything outside that part of YAML; names file and line.
    """
    lines = _Lines(data, file)
    if not lines.lines:
        raise refusal("yaml", file=file, found="nothing", allowed=_ALLOWED, remedy="name a calibration file")
    values = _block(lines, 0, 1)
    return Keys(values, file, lines.text)


class _Lines:
    """The lines of a YAML file that say something, with indentation and line numbers."""

    def __init__(self, data: bytes, file: str):
        if len(data) > YAML_BYTES_MAX:
            found, allowed = f"{len(data)} bytes", f"at most {YAML_BYTES_MAX} bytes"
            raise refusal("size", file=file, found=found, allowed=allowed, remedy="remove what is not needed")
        self.file, self.text = file, decode(data, file)
        self.lines: list[tuple[int, str]] = []
        for number, line in enumerate(self.text.splitlines(), start=1):
            first = not self.lines and re.fullmatch(r"%YAML[: ]1\.[012]\s*", line)
            if not first and line.strip() not in ("", "---", "...") and not line.lstrip().startswith("#"):
                self.lines.append((number, line.rstrip()))
        self.at = 0
        self.entries = 0

    def bad(self, number: int, found: str, remedy: str = "write it as its own tool does") -> InputError:
        return refusal("yaml", file=self.file, line=number, found=found, allowed=_ALLOWED, remedy=remedy)

    def count(self, number: int, entries: int) -> None:
        self.entries += entries
        if self.entries > YAML_ENTRIES_MAX:
            raise self.bad(number, f"more than {YAML_ENTRIES_MAX} entries")


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))


def _block(lines: _Lines, indent: int, depth: int) -> dict[str, object]:
    """The map whose keys stand at `indent`."""
    values: dict[str, object] = {}
    while lines.at < len(lines.lines):
        number, line = lines.lines[lines.at]
        if _indent(line) < indent:
            break
        match = _KEY.fullmatch(line)
        if match is None or _indent(line) != indent:
            raise lines.bad(number, shown(line.strip()))
        key, rest = match[2] or match[3], (match[4] or "").strip()
        if key in values:
            raise lines.bad(number, f"{shown(key)} twice", "remove one of them")
        lines.count(number, 1)
        lines.at += 1
        values[key] = _value(lines, number, rest, indent, depth)
    return values


def _value(lines: _Lines, number: int, rest: str, indent: int, depth: int) -> object:
    if rest.startswith("["):
        # Counted piece by piece: a list of a million lines costs its own length only once.
        pieces, open_brackets = [rest], rest.count("[") - rest.count("]")
        while open_brackets > 0 and lines.at < len(lines.lines):
            pieces.append(lines.lines[lines.at][1])
            open_brackets += pieces[-1].count("[") - pieces[-1].count("]")
            lines.at += 1
        return _flow(lines, number, " ".join(pieces))
    if rest and rest != MATRIX_TAG:
        return _scalar(lines, number, rest)
    if lines.at == len(lines.lines):
        return None
    below, line = lines.lines[lines.at]
    if not rest and re.match(r" *- ", line) and _indent(line) >= indent:
        items, place = [], _indent(line)
        while lines.at < len(lines.lines) and re.match(rf" {{{place}}}- ", lines.lines[lines.at][1]):
            below, line = lines.lines[lines.at]
            lines.at += 1
            lines.count(below, 1)
            item = line.lstrip(" ")[2:].strip()
            if not item:
                raise lines.bad(below, "an empty entry of a list")
            items.append(_value(lines, below, item, place + 1, depth))
        return items
    if _indent(line) <= indent:
        return None
    if depth >= YAML_DEPTH_MAX:
        raise lines.bad(below, f"keys nested deeper than {YAML_DEPTH_MAX}")
    return _block(lines, _indent(line), depth + 1)


def _flow(lines: _Lines, number: int, text: str) -> list[object]:
    """A list in brackets, at most two deep."""
    stack: list[list[object]] = []
    done: list[object] | None = None
    position, wanted = 0, True
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None or done is not None:
            rest = text[position:].strip()
            if not rest or rest.startswith("#"):
                break
            raise lines.bad(number, shown(rest))
        token, position = match[1], match.end()
        if token == "[":
            if len(stack) == 2 or not wanted:
                raise lines.bad(number, "brackets nested deeper than 2, or without a comma before")
            stack.append([])
        elif token == "]":
            last = stack.pop()
            wanted = False
            if stack:
                stack[-1].append(last)
            else:
                done = last
        elif token == ",":
            if wanted:
                raise lines.bad(number, "a comma without an entry before it")
            wanted = True
        else:
            if not wanted:
                raise lines.bad(number, f"{shown(token)} without a comma before it")
            lines.count(number, 1)
            stack[-1].append(_scalar(lines, number, token))
            wanted = False
    if done is None:
        raise lines.bad(number, "a list without its closing bracket")
    return done


def _scalar(lines: _Lines, number: int, text: str) -> object:
    if text[0] in "\"'":
        if len(text) < 2 or text[-1] != text[0] or text[0] in text[1:-1] or "\\" in text:
            raise lines.bad(number, shown(text))
        return text[1:-1]
    text = re.split(r"\s+#", text, maxsplit=1)[0].strip()
    if NUMBER.fullmatch(text):
        value = float(text)
        if not math.isfinite(value):
            raise lines.bad(number, shown(text), "give a finite number")
        return int(text) if re.fullmatch(r"[+-]?[0-9]{1,15}", text) else value
    if text[0] in "&*!|>{%@`?" or not _WORD.fullmatch(text.replace(" ", "_").replace(":", "_")):
        raise lines.bad(number, shown(text))
    return text

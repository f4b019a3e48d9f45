"""Strict TOML and JSON: values read key by key, each error with its line and dotted key; and TOML written.

A TOML file of 40 kB with one key of 20 000 dotted parts occupies `tomllib` for seconds, and deep brackets exhaust the
stack (CPython gh-149231). Both formats are therefore scanned in linear time before they are parsed. The module does not
depend on the content of campaigns; lines count from 1.
"""

from __future__ import annotations

import datetime
import json
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from numbers import Integral, Real
from typing import Any, NamedTuple, TypeGuard

from tvsbayes.errors import INTEGER, InputError, closest, escaped, other_format, refusal, shown
from tvsbayes.files.disk import decode

TOML_BYTES_MAX = 65_536
JSON_BYTES_MAX = 4 * 1024 * 1024
LINES_CHARS_MAX = 1024 * 1024
"""Number of characters searched for the lines of keys: an error takes less than a second for any file."""
DOTTED_PARTS_MAX = 8
NESTING_MAX = 16
# Both patterns always match from an opening quote to its end or the end of the line (or file), never
# backtracking: the scan is linear for any content.
_JSON_STRING = re.compile(r'"(?:\\.|[^"\\])*+"?', re.DOTALL)
_TOML_STRING_OR_COMMENT = re.compile(
    r'"""(?:\\.|[^\\])*?(?:"""|\Z)|\'\'\'.*?(?:\'\'\'|\Z)|"(?:\\[^\n]|[^"\\\n])*+"?|\'[^\'\n]*+\'?|#[^\n]*+',
    re.DOTALL,
)
_TOKEN = re.compile(rf"{_TOML_STRING_OR_COMMENT.pattern}|[\[\]{{}}=:,.\n]|[^\s\[\]{{}}=:,.\"'#]++", re.DOTALL)
"""Tokens by which keys are located: strings and comments, marks, and the words between them."""


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value of TOML or JSON is a number; booleans are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


class StatedValue(NamedTuple):
    """A quantity as the user states it, with its standard uncertainty."""

    value: float
    u: float


def _refusal(file: str, code: str, found: str, allowed: str, remedy: str, line: int | None = None) -> InputError:
    return refusal(code, file=file, line=line, found=found, allowed=allowed, remedy=remedy)


def _check_nesting(bare: str, file: str) -> None:
    """Refuse brackets nested too deeply for a recursive parser; `bare` is text without its strings."""
    depth = 0
    for bracket in re.finditer(r"[\[\]{}]", bare):
        depth = depth + 1 if bracket.group() in "[{" else max(depth - 1, 0)
        if depth > NESTING_MAX:
            found, allowed = f"brackets nested more than {NESTING_MAX} deep", f"at most {NESTING_MAX} levels"
            line = bare.count("\n", 0, bracket.start()) + 1
            raise _refusal(file, "nesting", found, allowed, "flatten the file", line)


def _key_lines(text: str) -> dict[str, int]:
    """Find the first line of every key and table of a valid TOML or JSON text, by dotted path.

    Paths contain no list indices. Comments and the content of values are not keys.
    """
    explicit: dict[str, int] = {}
    implied: dict[str, int] = {}
    in_value = text.lstrip().startswith("{")
    # Open brackets with the path of their content; "" is the top level of a TOML file, where a line ends a value.
    brackets: list[tuple[str, tuple[str, ...]]] = [("[" if in_value else "", ())]
    key_parts: list[str] = []
    key_line, line = 1, 1

    def record_key(base: tuple[str, ...]) -> tuple[str, ...]:
        path = (*base, *key_parts)
        for count in range(len(base) + 1, len(path)):
            implied.setdefault(".".join(path[:count]), key_line)
        explicit.setdefault(".".join(path), key_line)
        key_parts.clear()
        return path

    path: tuple[str, ...] = ()
    for match in _TOKEN.finditer(text, 0, LINES_CHARS_MAX):
        token = match.group()
        kind, base = brackets[-1]
        if token == "\n" and not kind:
            in_value = False
        elif in_value and token in "{[":
            brackets.append((token, path))
            in_value = token == "["
        elif token in "}]" and kind:
            if kind == "header":
                brackets[0] = "", record_key(())
            brackets.pop()
            in_value = True
        elif token == "," and kind:
            path, in_value = base, kind == "["
        elif token == "[" and not kind:
            brackets.append(("header", ()))
        elif token in "=:" and not in_value:
            path, in_value = record_key(base), True
        elif not in_value and token[0] not in "#.\n[":
            key_line = key_line if key_parts else line
            key_parts.append(_unquoted(token))
        line += token.count("\n")
    return {**implied, **explicit}


def _unquoted(key: str) -> str:
    """A key without its quotes."""
    if key[0] != '"':
        return key.strip("'")
    try:
        return str(json.loads(key))
    except ValueError:
        # The escape exists only in TOML.
        return key.strip('"')


class Keys:
    """One table of a TOML or JSON file, read key by key; its errors state file, line and dotted key."""

    def __init__(self, values: dict[str, object], file: str, content: str, path: tuple[str, ...] = ()):
        """`values` as parsed from `content`; `path` is the path from the top of the file to this table."""
        self.values, self.file, self.content, self.path = values, file, content, path

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def refuse(self, key: str, code: str, allowed: str, remedy: str, found: str | None = None) -> InputError:
        """The error of one key; `found` defaults to its value."""
        if found is None:
            found = shown(self.values[key]) if key in self.values else "nothing"
        keys = (*self.path, key)
        line, column = self._line(keys), ".".join(map(escaped, keys))
        return refusal(code, file=self.file, line=line, column=column, found=found, allowed=allowed, remedy=remedy)

    def _line(self, keys: tuple[str, ...]) -> int | None:
        """The line of the innermost of `keys` that occurs in the text."""
        lines = _key_lines(self.content)
        paths = (".".join(keys[:count]) for count in range(len(keys), 0, -1))
        return next((lines[path] for path in paths if path in lines), None)

    def only(self, names: Iterable[str]) -> None:
        """Refuse keys outside `names`."""
        names = tuple(names)
        for key in self.values:
            if key not in names:
                allowed = "only " + ", ".join(names)
                raise self.refuse(key, "unknown-key", allowed, closest(key, names), found="an unknown key")

    def read(self, key: str, kind: Kind) -> Any:
        """The value under `key`, which must be of a kind."""
        method, *limits = kind if isinstance(kind, tuple) else (kind,)
        return method(self, key, *limits)

    def entries(self, kinds: Mapping[str, Kind], required: Iterable[str] = ()) -> dict[str, Any]:
        """The values of a table with these keys and no others, in the order of the file; `required` must be there."""
        self.only(kinds)
        return {key: self.read(key, kinds[key]) for key in dict.fromkeys((*self.values, *required))}

    def document(self, form: str, kinds: Mapping[str, Kind], required: Iterable[str] = ()) -> dict[str, Any]:
        """The values of a file of the format `form`, as `entries`, without the key `format`."""
        self.word("format", form)
        entries = self.entries({"format": Keys.text, **kinds}, required)
        return {key: value for key, value in entries.items() if key != "format"}

    def held(
        self,
        key: str,
        fits: Callable[[Any], object],
        code: str,
        allowed: str,
        remedy: str = "correct the value",
        kind: Kind | None = None,
    ) -> Any:
        """The value under `key`, as it stands or of a kind, which must fit."""
        if kind is None and key not in self.values:
            raise self.refuse(key, "missing-key", allowed, f"add {key}")
        value = self.values[key] if kind is None else self.read(key, kind)
        if not fits(value):
            raise self.refuse(key, code, allowed, remedy)
        return value

    def number(self, key: str, low: float, high: float) -> float:
        """A finite number in [low, high]; booleans are refused."""
        allowed = f"a finite number from {low:g} to {high:g}" if low < high else f"exactly {low:g}"
        remedy = "correct the value and check its unit"
        return float(self.held(key, lambda v: is_number(v) and low <= v <= high, "number", allowed, remedy))

    def numbers(self, key: str, low: float, high: float, most: int) -> tuple[float, ...]:
        """One number in [low, high], or a list of 1 to `most` different numbers."""
        stated: Any = self.values[key]
        values = stated if isinstance(stated, list) else [stated]
        inside = all(is_number(value) and low <= value <= high for value in values)
        if not inside or not 0 < len({*values}) == len(values) <= most:
            allowed = f"a number from {low:g} to {high:g}, or a list of up to {most} different ones"
            raise self.refuse(key, "numbers", allowed, "correct the values and check their unit")
        return tuple(map(float, values))

    def integer(self, key: str, low: int, high: int) -> int:
        """A whole number in [low, high]."""
        allowed = f"a whole number from {low} to {high}"
        return self.held(key, lambda v: type(v) is int and low <= v <= high, "integer", allowed)

    def text(self, key: str, chars_max: int = 200) -> str:
        """Printable text without line breaks; fields such as `notes` have a larger `chars_max` and may have breaks."""
        allowed, breaks = f"printable text of at most {chars_max} characters", "\n\t" * (chars_max > 200)
        remedy = "shorten it, or put it in quotes"
        value = self.held(key, lambda v: isinstance(v, str) and len(v) <= chars_max, "text", allowed, remedy)
        if not all(c.isprintable() or c in breaks for c in value):
            raise self.refuse(key, "text", allowed, "remove the control characters")
        return value

    def flag(self, key: str) -> bool:
        """The boolean under `key`."""
        remedy = "write true or false without quotes"
        return self.held(key, lambda v: isinstance(v, bool), "boolean", "true or false", remedy)

    def date(self, key: str) -> datetime.date:
        """A date, or a time."""
        allowed = "a date or time such as 2026-01-15T10:00:00Z"
        return self.held(key, lambda v: isinstance(v, datetime.date), "date", allowed, "write it without quotes")

    def word(self, key: str, *words: str) -> str:
        """One of a few words."""
        found = str(self.values.get(key))
        remedy = other_format(found, words) if key == "format" else None
        allowed = " or ".join(map(shown, words))
        return self.held(key, lambda v: v in words, "word", allowed, remedy or closest(found[:100], words))

    def some_words(self, key: str, *words: str) -> tuple[str, ...]:
        """A list of different words, in the order of `words`."""
        stated = self.values[key]
        entries: list[object] = stated if isinstance(stated, list) else []
        if not entries or any(entry not in words for entry in entries) or len({*entries}) != len(entries):
            allowed = f"a list of {' and '.join(map(shown, words))}, or of one of them"
            raise self.refuse(key, "words", allowed, f"write {key} = [{shown(words[0])}], or leave it out")
        return tuple(word for word in words if word in entries)

    def table(self, key: str) -> Keys:
        """The table under `key`; empty if it is absent."""
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            path = escaped(".".join((*self.path, key)))
            raise self.refuse(key, "table", "a table", f"write it as [{path}] with keys below")
        return Keys(value, self.file, self.content, (*self.path, key))

    def nested(self, key: str, kinds: Mapping[str, Kind]) -> dict[str, Any]:
        """The values of the table under `key`, as `entries`."""
        return self.table(key).entries(kinds)

    def quantity(self, key: str, low: float, high: float, u_max: float) -> StatedValue:
        """`{ value, u }` with value in [low, high] and standard uncertainty u in [0, u_max]."""
        allowed = "{ value = number, u = standard uncertainty }, both and nothing else"
        remedy = "u = 0 states that the value is exact"
        self.held(key, lambda v: isinstance(v, dict) and v.keys() == {"value", "u"}, "quantity", allowed, remedy)
        return StatedValue(**self.nested(key, {"value": (Keys.number, low, high), "u": (Keys.number, 0.0, u_max)}))


type Kind = Callable[..., Any] | tuple[Any, ...]
"""What reads the value under a key, a method of `Keys` or another function of keys and key, and its limits."""


def parse_toml(data: bytes, file: str) -> Keys:
    """Parse the top table of a TOML file; size, nesting and dotted keys are capped before parsing."""
    refuse = partial(_refusal, file)
    if len(data) > TOML_BYTES_MAX:
        raise refuse("size", f"{len(data)} bytes", f"at most {TOML_BYTES_MAX} bytes", "shorten it")
    text = decode(data, file)
    bare = _TOML_STRING_OR_COMMENT.sub(lambda m: "Q" + "\n" * m.group().count("\n"), text)
    _check_nesting(bare, file)
    for number, line in enumerate(bare.split("\n"), start=1):
        if any(part.count(".") >= DOTTED_PARTS_MAX for part in re.split(r"[^\w.\- \t]", line)):
            found, allowed = f"a key of more than {DOTTED_PARTS_MAX} dotted parts", f"at most {DOTTED_PARTS_MAX}"
            raise refuse("nesting", found, allowed, "use the keys of the format only", number)
    try:
        values = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        position = re.search(r"\(at line (\d+), column \d+\)", str(error))
        error_line = int(position[1]) if position else None
        if position and (repeated := re.match(r"Cannot declare \((.*?),?\) twice", str(error))):
            name = ".".join(re.findall(r"'([^']*)'", repeated[1]))
            first = _key_lines(text).get(name)
            found = f"the table [{escaped(name, 60)}] a second time" + (f", first in line {first}" if first else "")
            remedy = "put the entries below the first header, and remove the second"
            raise refuse("toml", found, "every table once", remedy, error_line) from error
        remedy = "correct the syntax; text needs quotes, numbers a decimal point"
        found = escaped(re.sub(r" \(at .*\)", "", str(error)), 120)
        raise refuse("toml", found, "TOML 1.0", remedy, error_line) from error
    return Keys(values, file, text)


def parse_json(data: bytes, file: str) -> Keys:
    """Parse the top object of a JSON file: limited size, no duplicate keys, finite numbers only."""
    refuse = partial(_refusal, file)
    if len(data) > JSON_BYTES_MAX:
        raise refuse("size", f"{len(data)} bytes", f"at most {JSON_BYTES_MAX} bytes", "shorten it")
    text = decode(data, file)
    _check_nesting(_JSON_STRING.sub(lambda m: '""' + "\n" * m.group().count("\n"), text), file)

    def number(literal: str) -> int | float:
        if INTEGER.fullmatch(literal):
            return int(literal)
        value = float(literal)
        if not math.isfinite(value) or literal.lstrip("-").isdigit():
            line = text.count("\n", 0, text.find(literal)) + 1
            raise refuse("number", shown(literal), "finite numbers, integers of 18 digits", "correct it", line)
        return value

    def constant(literal: str) -> float:
        line = text.count("\n", 0, text.find(literal)) + 1
        raise refuse("number", shown(literal), "finite numbers", "give the value", line)

    def unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
        values: dict[str, object] = {}
        for key, value in pairs:
            if key not in values:
                values[key] = value
                continue
            literal = json.dumps(key, ensure_ascii=False)
            line = text.count("\n", 0, text.find(literal, text.find(literal) + 1)) + 1
            raise refuse("duplicate-key", f"{shown(key)} twice", "every key once", "remove one of them", line)
        return values

    try:
        values = json.loads(
            text, parse_float=number, parse_int=number, parse_constant=constant, object_pairs_hook=unique
        )
    except (ValueError, RecursionError) as error:
        found = escaped(getattr(error, "msg", str(error)), 120)
        raise refuse("json", found, "JSON", "correct the syntax", getattr(error, "lineno", None)) from error
    if not isinstance(values, dict):
        raise refuse("json", shown(values), "an object { ... } at the top", "write the keys of the format", 1)
    return Keys(values, file, text)


def toml_value(value: object) -> str:
    """Format a value in TOML; a dictionary becomes an inline table, a list or tuple an array.

    Raises:
        TypeError: a type that no campaign or rig file contains.
    """
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, Integral):
        return str(int(value))
    if isinstance(value, Real):
        return repr(float(value))
    if isinstance(value, datetime.datetime | datetime.date):
        return value.isoformat()
    if isinstance(value, StatedValue):
        value = value._asdict()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(toml_line(k, v) for k, v in value.items()) + " }"
    raise TypeError(f"no TOML for {type(value).__name__}")


def toml_line(key: str, value: object) -> str:
    """Format `key = value`, the key quoted where TOML requires it."""
    bare = re.fullmatch(r"[A-Za-z0-9_-]+", key)
    return f"{key if bare else json.dumps(key, ensure_ascii=False)} = {toml_value(value)}"


def toml_text(tables: Mapping[str, Mapping[str, object]]) -> str:
    """Format tables by name, "" for the top of the file; entries that are None are left out."""
    lines = []
    for name, entries in tables.items():
        lines += [f"[{name}]"] * bool(name) + [
            toml_line(key, value) for key, value in entries.items() if value is not None
        ]
    return "\n".join(lines) + "\n"

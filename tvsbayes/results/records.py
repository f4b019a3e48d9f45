"""Frozen dataclasses as the plain values of a JSON document, and back, every field held to its annotation.

What is written is what is read: a record needs no code of its own for either way. Numbers keep their unit, which
stands in the field's name.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from itertools import repeat
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Protocol, get_args, get_origin, get_type_hints

import numpy as np

from tvsbayes.errors import shown
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import JSON_BYTES_MAX, Keys, parse_json


class HasFolder(Protocol):
    """A campaign of any kind; `path` is None of one that was never written."""

    @property
    def path(self) -> Path | None:
        """Its folder."""


TEXT_CHARS_MAX = 20_000
"""Of one text in a document that tvsbayes wrote."""
_KINDS = {float: "a finite number", int: "a whole number", str: "printable text", bool: "true or false"}


def plain(value: object) -> Any:
    """Dataclasses and dictionaries as dictionaries, tuples and arrays as lists, all else as it is."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, tuple | list):
        return [plain(inner) for inner in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


class _Unfit(Exception):
    """A value that its field cannot take: keys that lead there, and what may stand there."""

    def __init__(self, place: tuple[str, ...], allowed: str, found: str):
        super().__init__(allowed)
        self.place, self.allowed, self.found = place, allowed, found


def read_record[T](kind: type[T], keys: Keys, remedy: str) -> T:
    """A record from a table of a document; keys that it does not know are passed over, defaults may be missing.

    Args:
        kind: dataclass of numbers, texts, flags, arrays, other records, and tuples, dictionaries and None of these.
        keys: the table.
        remedy: what to do where it cannot be read.

    Raises:
        InputError: a key is missing or of another type, with its name.
    """
    try:
        return _of(kind, keys.values, ())
    except _Unfit as unfit:
        *path, key = unfit.place or ("",)
        table = Keys({}, keys.file, keys.text, (*keys.path, *path))
        raise table.refuse(key, "schema", unfit.allowed, remedy, unfit.found) from unfit


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _of(kind: Any, value: object, place: tuple[str, ...]) -> Any:
    """The value as the annotation `kind` has it; entries of a list are named by the key of the list."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is UnionType:
        return None if value is None and NoneType in inner else _of(inner[0], value, place)
    if origin is tuple:
        if not isinstance(value, list):
            raise _Unfit(place, "a list", shown(value))
        kinds: Iterable[Any] = repeat(inner[0], len(value)) if inner[-1] is Ellipsis else inner
        if inner[-1] is not Ellipsis and len(value) != len(inner):
            raise _Unfit(place, f"a list of {len(inner)}", shown(value))
        return tuple(_of(k, v, place) for k, v in zip(kinds, value, strict=True))
    if kind is np.ndarray:
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        if not np.all(np.isfinite(array)):
            raise _Unfit(place, "finite numbers of one shape", shown(value))
        return array
    if is_dataclass(kind) or origin is dict:
        if not isinstance(value, dict):
            raise _Unfit(place, "a table", shown(value))
        if origin is dict:
            return {key: _of(inner[1], v, (*place, key)) for key, v in value.items()}
        found = {}
        for field in fields(kind):
            if field.name in value:
                found[field.name] = _of(_hints(kind)[field.name], value[field.name], (*place, field.name))
            elif field.default is MISSING and field.default_factory is MISSING:
                raise _Unfit((*place, field.name), "this key", "nothing")
        return kind(**found)
    if not _is_a(kind, value):
        raise _Unfit(place, _KINDS[kind], shown(value))
    return value


def _is_a(kind: type, value: object) -> bool:
    """Whether a plain value is of a plain type; booleans are no numbers, whole numbers are."""
    if isinstance(value, bool):
        return kind is bool
    if isinstance(value, str):
        return kind is str and len(value) <= TEXT_CHARS_MAX and all(c.isprintable() or c in "\n\t" for c in value)
    if kind is int:
        return isinstance(value, int)
    return kind is float and isinstance(value, int | float) and math.isfinite(value)


def stored_document(campaign: HasFolder, name: str, formats: tuple[str, ...], inputs: Mapping[str, str]) -> Keys | None:
    """A document in `results/` that was made from the data and priors with these hashes; None where there is none.

    Raises:
        InputError: it is damaged, or of a version that cannot be read.
    """
    path = None if campaign.path is None else campaign.path / "results" / name
    if path is None or not path.exists():
        return None
    keys = parse_json(read_bytes(path, JSON_BYTES_MAX), f"results/{name}")
    if keys.values.get("inputs") != inputs:
        return None
    keys.word("format", formats)
    return keys

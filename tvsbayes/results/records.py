"""Records of results: one declaration gives the class, its JSON document, its reader and its schema.

A record is a frozen msgspec struct. Its fields are the keys of the document, in their order; a field with a default may
be missing in a document of an older version. The schema takes the meaning of the keys from the docstrings. Numbers are
finite and have the unit in the field's name.
"""

from __future__ import annotations

import inspect
import math
import re
from abc import ABCMeta
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, ClassVar, Protocol

import msgspec
import numpy as np
from msgspec import Meta, Struct, StructMeta

from tvsbayes.errors import shown
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import JSON_BYTES_MAX, Keys, parse_json
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.results.tiers import TIERS

type NotNegative = Annotated[float, Meta(ge=0)]
type Positive = Annotated[float, Meta(gt=0)]
type Probability = Annotated[float, Meta(ge=0, le=1)]
type Count = Annotated[int, Meta(ge=0)]
type FromOne = Annotated[int, Meta(ge=1)]
type AxisName = Annotated[str, Meta(extra_json_schema={"enum": AXES})]
type Direction = Annotated[str, Meta(extra_json_schema={"enum": DIRECTIONS})]
type ByAxis[T] = dict[AxisName, T]
"""Values for some axes."""
type ByDirection[T] = dict[Direction, T]
"""Values for some directions."""
type BothAxes[T] = Annotated[dict[AxisName, T], Meta(extra_json_schema={"required": AXES})]
type AllDirections[T] = Annotated[dict[Direction, T], Meta(extra_json_schema={"required": DIRECTIONS})]
type EstimatorName = Annotated[str, Meta(extra_json_schema={"enum": ("laplace", "posterior")})]
type Tier = Annotated[str, Meta(extra_json_schema={"enum": TIERS})]
type AnswerKind = Annotated[str, Meta(extra_json_schema={"enum": ("accepted", "rough", "laplace")})]

TEXT_CHARS_MAX = 20_000
"""Largest length of one text in a document that tvsbayes wrote."""
SCHEMA_PROBLEMS = 20
"""Number of problems among which the reported one is chosen: a foreign document has thousands."""
_ROW = {"type": "array", "minItems": 1, "items": {"type": "number"}}
type Matrix = Annotated[np.ndarray, Meta(extra_json_schema={"type": "array", "minItems": 1, "items": _ROW})]


class HasFolder(Protocol):
    """A campaign of any kind; `path` is None for one that was never written."""

    @property
    def path(self) -> Path | None:
        """Its folder."""


class _RecordType(StructMeta, ABCMeta):
    """Allows a record abstract bases such as `display.Shown`."""


class Record(Struct, frozen=True, metaclass=_RecordType):
    """Base of records; unknown keys are ignored.

    `always` names fields that every document contains although the class has defaults for them; `beside` names fields
    that are not part of the document.
    """

    always: ClassVar[tuple[str, ...]] = ()
    beside: ClassVar[tuple[str, ...]] = ()

    def as_json(self) -> dict[str, Any]:
        """The document, of plain types."""
        return {key: value for key, value in plain(self).items() if key not in self.beside}


class ClosedRecord(Record, frozen=True, forbid_unknown_fields=True):
    """A record whose document contains its keys and no others."""


def _encoded(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"no JSON for {type(value).__name__}")


def _lists(value: Any) -> Any:
    """Convert tuples to lists, since JSON has no tuples."""
    if isinstance(value, dict):
        return {key: _lists(inner) for key, inner in value.items()}
    return [_lists(inner) for inner in value] if isinstance(value, tuple | list) else value


def plain(value: object) -> Any:
    """Convert records and dataclasses to dictionaries, tuples and arrays to lists, all else unchanged."""
    return _lists(msgspec.to_builtins(value, enc_hook=_encoded))


def _decoded(kind: type, value: object) -> object:
    if kind is not np.ndarray:
        raise TypeError(f"no reader of {kind.__name__}")
    array = np.array(value, dtype=float)
    if not np.all(np.isfinite(array)):
        raise ValueError("numbers that are not finite")
    return array


def _array_schema(kind: type) -> dict[str, object]:
    if kind is not np.ndarray:
        raise NotImplementedError
    # Arrays have any number of axes; one without axes is a number.
    return {"type": ["number", "array"]}


def _meanings(attributes: str) -> dict[str, str]:
    """The description of each field by a docstring's section "Attributes"."""
    meanings = {}
    for entry in re.split(r"\n(?! )", inspect.cleandoc(attributes)):
        names, _, meaning = entry.partition(": ")
        # Python's None is JSON's null.
        meanings.update(dict.fromkeys(names.split(", "), re.sub(r"\bNone\b", "null", " ".join(meaning.split()))))
    return meanings


def _records() -> dict[str, type[Record]]:
    """Every declared record by its name."""
    records, kinds = {}, [Record]
    while kinds:
        kinds += (kind := kinds.pop()).__subclasses__()
        records[kind.__name__] = kind
    return records


def _alike(schema: Any) -> Any:
    """A schema that states the items of a list of fixed length once, where all have one type."""
    if isinstance(schema, list):
        return [_alike(inner) for inner in schema]
    if not isinstance(schema, dict):
        return schema
    plain_schema = {key: _alike(inner) for key, inner in schema.items()}
    items = plain_schema.get("prefixItems")
    if not items or any(item != items[0] for item in items):
        return plain_schema
    del plain_schema["prefixItems"]
    return plain_schema | {"items": items[0]}


def _described(component: dict[str, Any], kind: type[Record] | None) -> dict[str, Any]:
    """A schema completed by the declaration's descriptions and constraints; `kind` is None for a dataclass."""
    text, _, attributes = component.get("description", "").partition("\n\nAttributes:\n")
    keys = {} if kind is None else {field.name: field.encode_name for field in msgspec.structs.fields(kind)}
    for name, meaning in _meanings(attributes).items():
        if (key := keys.get(name, name)) in component["properties"]:
            component["properties"][key] |= {"description": meaning}
    always = () if kind is None else kind.always
    return component | {"description": " ".join(text.split()), "required": [*component["required"], *always]}


def schema_of(*kinds: type[Record], closed: bool = False, **keys: Any) -> dict[str, Any]:
    """The JSON schema of a document, from the declarations.

    Args:
        kinds: records whose fields stand side by side in the document.
        closed: whether the document, and every record in it, contains no other keys.
        keys: further keys of the document, or the type of a field of `kinds` in this document: a record or a schema.
    """
    named = {key: kind for key, kind in keys.items() if isinstance(kind, type)}
    references, components = msgspec.json.schema_components((*kinds, *named.values()), schema_hook=_array_schema)
    known = _records()
    for name, component in components.items():
        components[name] = _described(component, known.get(name))
        if closed:
            components[name]["additionalProperties"] = False
    properties: dict[str, Any] = {}
    required = list(keys)
    for kind in kinds:
        component = components.pop(kind.__name__)
        properties |= {key: value for key, value in component["properties"].items() if key not in kind.beside}
        required += (key for key in component["required"] if key not in (*keys, *kind.beside))
    properties |= keys | dict(zip(named, references[len(kinds) :], strict=True))
    body = {"type": "object", "properties": properties, "required": required, "$defs": components}
    return _alike(_lists(body | ({"additionalProperties": False} if closed else {})))


@cache
def _record_schema(kind: type[Record]) -> dict[str, Any]:
    return schema_of(kind)


type _Problem = tuple[Sequence[str | int], str]
"""A place in a document, as keys and list indices, and what is allowed there."""


def _schema_problem(values: object, schema: Mapping[str, Any]) -> _Problem | None:
    """The place that most likely violates the schema."""
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import best_match

    error = best_match(islice(Draft202012Validator(schema).iter_errors(values), SCHEMA_PROBLEMS))
    if error is None:
        return None
    place, rule = list(error.absolute_path), error.validator_value
    if "propertyNames" in error.absolute_schema_path:
        # jsonschema reports the table whose key is wrong.
        place.append(error.instance)
    match error.validator:
        case "required":
            return [*place, next(name for name in rule if name not in error.instance)], "this key"
        case "additionalProperties":
            known = error.schema.get("properties", {})
            return [*place, next(name for name in error.instance if name not in known)], "no such key"
        case "type":
            return place, rule if isinstance(rule, str) else " or ".join(rule)
        case "const":
            return place, shown(rule)
        case "enum":
            return place, " or ".join(map(shown, rule))
        case other:
            return place, f"{other} {shown(rule)}"


def _unfit_value(value: object, place: tuple[str, ...] = ()) -> _Problem | None:
    """The place of a text that cannot be printed or of a number that is not finite."""
    if isinstance(value, str):
        if len(value) > TEXT_CHARS_MAX or not all(c.isprintable() or c in "\n\t" for c in value):
            return place, "printable text"
    elif isinstance(value, float):
        if not math.isfinite(value):
            return place, "a finite number"
    elif isinstance(value, dict):
        return next(filter(None, (_unfit_value(inner, (*place, key)) for key, inner in value.items())), None)
    elif isinstance(value, list):
        return next(filter(None, (_unfit_value(inner, place) for inner in value)), None)
    return None


def hold_to_schema(keys: Keys, schema: Mapping[str, Any], remedy: str) -> None:
    """Refuse a document that violates its schema or contains text that cannot be printed; the error names the key.

    Raises:
        InputError: names the key; an entry of a list is named by the key of the list.
    """
    problem = _schema_problem(keys.values, schema) or _unfit_value(keys.values)
    if problem is None:
        return
    place, allowed = problem
    value: object = keys.values
    for part in place:
        if isinstance(value, list) and isinstance(part, int):
            value = value[part]
        else:
            value = value.get(str(part), "nothing") if isinstance(value, dict) else "nothing"
    *path, key = (part for part in place if isinstance(part, str))
    raise Keys({}, keys.file, keys.content, (*keys.path, *path)).refuse(key, "schema", allowed, remedy, shown(value))


def read_record[T: Record](kind: type[T], keys: Keys, remedy: str, *, held: bool = False) -> T:
    """Read a record from a table of a document; keys with defaults may be missing.

    Args:
        kind: class of the record.
        keys: the table.
        remedy: the remedy where it cannot be read.
        held: whether the table was checked against a schema before.

    Raises:
        InputError: a key is missing or of another type, with its name.
    """
    if not held:
        hold_to_schema(keys, _record_schema(kind), remedy)
    try:
        return msgspec.convert(keys.values, kind, dec_hook=_decoded)
    except UnicodeEncodeError as error:
        # JSON may hold a lone surrogate in a key.
        raise keys.refuse(error.object, "schema", "keys that UTF-8 can encode", remedy) from error
    except msgspec.ValidationError as error:
        # JSON schema does not detect 3.0 for a whole number, or array rows of different lengths.
        message, _, place = str(error).partition(" - at ")
        *path, key = re.findall(r"\.(\w+)", place) or [""]
        at = Keys({}, keys.file, keys.content, (*keys.path, *path))
        raise at.refuse(key, "schema", message, remedy, "") from error


def stored_document(campaign: HasFolder, name: str, formats: tuple[str, ...], inputs: Mapping[str, str]) -> Keys | None:
    """A document in `results/` made from the data and priors with these hashes; None if there is none.

    Raises:
        InputError: the file is damaged, or of a version that cannot be read.
    """
    path = None if campaign.path is None else campaign.path / "results" / name
    if path is None or not path.exists():
        return None
    keys = parse_json(read_bytes(path, JSON_BYTES_MAX), f"results/{name}")
    if keys.values.get("inputs") != inputs:
        return None
    keys.word("format", *formats)
    return keys

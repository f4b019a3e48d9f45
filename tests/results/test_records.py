"""Records as plain values and back: every field held to its annotation, refusals by key."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.documents import Keys
from tvsbayes.results.records import Record, plain, read_record, schema_of


class Inner(Record, frozen=True):
    """A number, whole or not, and a switch."""

    number: float
    on: bool = False


class Whole(Record, frozen=True):
    """Everything that a record may hold."""

    text: str
    count: int
    pair: tuple[float, float]
    many: tuple[Inner, ...]
    named: dict[str, Inner | None]
    array: np.ndarray
    maybe: float | None = None


WHOLE = Whole("a", 3, (1.0, 2.5), (Inner(1.0, True), Inner(2)), {"x": Inner(0.5), "y": None}, np.eye(2))


def read(values: dict[str, object]) -> Whole:
    return read_record(Whole, Keys(values, "a.json", ""), "make it again")


def test_what_is_written_is_read():
    assert plain(read(plain(WHOLE))) == plain(WHOLE)
    assert plain(read({**plain(WHOLE), "unknown": 1})) == plain(WHOLE), "of a later version"


@pytest.mark.parametrize(
    ("key", "value", "column"),
    [
        ("text", 3, "text"),
        ("text", "a\x1b[31m", "text"),
        ("count", 3.0, "count"),
        ("count", True, "count"),
        ("pair", [1.0], "pair"),
        ("pair", [1.0, "2"], "pair"),
        ("many", {}, "many"),
        ("many", [{"number": 1.0, "on": 1}], "many.on"),
        ("many", [{}], "many.number"),
        ("named", {"x": {"number": float("inf")}}, "named.x.number"),
        ("named", [], "named"),
        ("array", [[1.0], [1.0, 2.0]], "array"),
        ("array", "a", "array"),
        ("maybe", "no", "maybe"),
    ],
)
def test_what_does_not_fit_is_refused_by_key(key, value, column):
    with pytest.raises(InputError) as caught:
        read({**plain(WHOLE), key: value})
    assert (caught.value.column, caught.value.code) == (column, "schema")
    assert caught.value.allowed and caught.value.remedy == "make it again"


def test_a_missing_key_is_named():
    values = plain(WHOLE)
    del values["count"]
    with pytest.raises(InputError) as caught:
        read(values)
    assert caught.value.column == "count"


class Kept(Record, frozen=True, rename={"short": "a_long_key"}):
    """What a schema is made of.

    Attributes:
        short: a length, mm;
            None where unknown.
        known, hidden: two more.
    """

    short: float | None
    known: str = ""
    hidden: int = 0
    always: ClassVar = ("known",)
    beside: ClassVar = ("hidden",)


def test_a_declaration_is_the_document_and_its_schema():
    assert Kept(1.5).as_json() == {"a_long_key": 1.5, "known": ""}
    schema = schema_of(Kept, closed=True, format={"const": "kept/1"}, inner=Inner)
    assert set(schema["properties"]) == {"a_long_key", "known", "format", "inner"}
    assert set(schema["required"]) == {"a_long_key", "known", "format", "inner"}
    assert schema["properties"]["a_long_key"]["description"] == "a length, mm; null where unknown."
    assert not schema["additionalProperties"] and not schema["$defs"]["Inner"]["additionalProperties"]
    assert schema["$defs"]["Inner"]["description"] == "A number, whole or not, and a switch."

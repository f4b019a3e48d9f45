"""Shipped schemas; kept documents of `fit.json`, and copies with one value of their own."""

from __future__ import annotations

import copy
import json
from pathlib import Path

from jsonschema import Draft202012Validator

from tvsbayes.files.disk import shipped_data

KEPT = Path(__file__).parents[1] / "data"
"""Documents as older versions wrote them, on the shipped paper twin; white space and digits beyond seven cut away."""


OLD = sorted(KEPT.glob("fit-*.json"))


def shipped_schema(name: str) -> dict:
    """A schema by its name and version, such as `watch-1`."""
    return json.loads((shipped_data() / "schemas" / f"{name}.schema.json").read_text())


def schema_of(document: dict) -> dict:
    """The schema that the document names."""
    return shipped_schema(f"fit-{document['format'].removeprefix('tvsbayes-fit/')}")


def problems(document: object, schema: dict) -> list[str]:
    """The places that break the schema."""
    return [error.json_path for error in Draft202012Validator(schema).iter_errors(document)]


def kept(name: str) -> dict:
    return json.loads((KEPT / name).read_text())


def changed(document: dict, path: str, value: object) -> dict:
    """A copy with one value set, or taken out where `value` is ...; parts of the path are split at "/"."""
    result = copy.deepcopy(document)
    *way, last = (int(part) if part.isdigit() else part for part in path.split("/"))
    inner = result
    for part in way:
        inner = inner[part]
    if value is ...:
        del inner[last]
    else:
        inner[last] = value
    return result

"""A walk through a JSON Schema (draft 2020-12) for the keywords that tvsbayes' own schemas use.

jsonschema is no dependency. A keyword that the walk does not know is an error, so that no rule is passed over.
"""

from __future__ import annotations

import re
from typing import Any

TYPES = {
    "object": dict,
    "array": list,
    "string": str,
    "number": (int, float),
    "integer": int,
    "boolean": bool,
    "null": type(None),
}
ANNOTATIONS = {"$schema", "$id", "$defs", "title", "description"}


def is_type(value: Any, name: str) -> bool:
    """JSON's types: true is no number; 3.0 is an integer."""
    if isinstance(value, bool):
        return name == "boolean"
    if name == "integer" and isinstance(value, float):
        return value.is_integer()
    return isinstance(value, TYPES[name])


def problems(value: Any, schema: Any, root: dict[str, Any] | None = None, path: str = "$") -> list[str]:
    """What is wrong, one line each with its place; empty if the value is valid."""
    root = schema if root is None else root
    if schema is True:
        return []
    if schema is False:
        return [f"{path}: not allowed"]
    found: list[str] = []
    known = set(ANNOTATIONS)

    def rule(name: str) -> Any:
        known.add(name)
        return schema.get(name)

    def check(ok: bool, what: str) -> None:
        if not ok:
            found.append(f"{path}: {what}")

    if (target := rule("$ref")) is not None:
        assert target.startswith("#/$defs/"), target
        found += problems(value, root["$defs"][target.removeprefix("#/$defs/")], root, path)
    if (options := rule("anyOf")) is not None:
        tried = [problems(value, option, root, path) for option in options]
        if all(tried):
            found += min(tried, key=len)
    if (types := rule("type")) is not None:
        names = [types] if isinstance(types, str) else types
        check(any(is_type(value, name) for name in names), f"{type(value).__name__}, not {' or '.join(names)}")
    if "const" in schema:
        check(value == rule("const"), f"not {schema['const']!r}")
    if (choices := rule("enum")) is not None:
        check(value in choices, f"not one of {choices}")
    number = isinstance(value, int | float) and not isinstance(value, bool)
    for name, holds in (
        ("minimum", lambda limit: value >= limit),
        ("maximum", lambda limit: value <= limit),
        ("exclusiveMinimum", lambda limit: value > limit),
    ):
        if (limit := rule(name)) is not None and number:
            check(holds(limit), f"{value} against {name} {limit}")
    if (pattern := rule("pattern")) is not None and isinstance(value, str):
        check(re.search(pattern, value) is not None, f"{value!r} against {pattern}")
    fewest, most, items = rule("minItems"), rule("maxItems"), rule("items")
    if isinstance(value, list):
        check(fewest is None or len(value) >= fewest, "too few items")
        check(most is None or len(value) <= most, "too many items")
        if items is not None:
            found += [p for k, item in enumerate(value) for p in problems(item, items, root, f"{path}[{k}]")]
    properties, required = rule("properties") or {}, rule("required") or []
    names_schema, further = rule("propertyNames"), rule("additionalProperties")
    if isinstance(value, dict):
        found += [f"{path}: {name} is missing" for name in required if name not in value]
        for name, item in value.items():
            if names_schema is not None:
                found += problems(name, names_schema, root, f"{path}.{name} (its name)")
            inner = properties.get(name, True if further is None else further)
            found += problems(item, inner, root, f"{path}.{name}")
    unknown = set(schema) - known
    assert not unknown, f"{path}: the walk does not know {sorted(unknown)}"
    return found

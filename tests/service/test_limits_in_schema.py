"""What a client may send says its limits in the OpenAPI document: ranges, lengths, patterns."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DOCUMENT: dict[str, Any] = json.loads((Path(__file__).parents[2] / "docs" / "openapi.json").read_text())


def _sent() -> Iterator[tuple[str, dict[str, Any]]]:
    """Every parameter's and every body's schema, by name."""
    for path, operations in DOCUMENT["paths"].items():
        for method, operation in operations.items():
            for parameter in operation.get("parameters", ()):
                yield f"{method} {path} {parameter['name']}", parameter["schema"]
            for media, body in operation.get("requestBody", {}).get("content", {}).items():
                # Of other media the bytes count, against max_body_bytes.
                if media == "application/json":
                    yield f"{method} {path}", body["schema"]


def _unlimited(name: str, schema: dict[str, Any], seen: set[str]) -> Iterator[str]:
    if "$ref" in schema:
        model = schema["$ref"].rpartition("/")[2]
        if model not in seen:
            seen.add(model)
            yield from _unlimited(model, DOCUMENT["components"]["schemas"][model], seen)
        return
    for way in ("anyOf", "oneOf", "allOf"):
        for option in schema.get(way, ()):
            yield from _unlimited(name, option, seen)
    kind = schema.get("type")
    if "enum" in schema or "const" in schema:
        return
    if kind in ("number", "integer"):
        if not (
            {"minimum", "exclusiveMinimum"} & set(schema) and {"maximum", "exclusiveMaximum"} & set(schema)
        ):
            yield f"{name}: {kind} without a range"
    elif kind == "string":
        if not {"maxLength", "pattern", "format"} & set(schema):
            yield f"{name}: text of any length"
    elif kind == "array":
        if "maxItems" not in schema:
            yield f"{name}: a list of any length"
        for item in (*schema.get("prefixItems", ()), schema.get("items", {})):
            yield from _unlimited(f"{name}[]", item, seen)
    elif kind == "object" or "properties" in schema:
        if not {"properties", "maxProperties"} & set(schema):
            yield f"{name}: an object of any size"
        for field, inner in schema.get("properties", {}).items():
            yield from _unlimited(f"{name}.{field}", inner, seen)


def test_everything_that_is_sent_has_its_limits_in_the_schema() -> None:
    seen: set[str] = set()
    found = [fault for name, schema in _sent() for fault in _unlimited(name, schema, seen)]
    assert not found, "\n".join(sorted(set(found)))
    assert len(seen) > 20

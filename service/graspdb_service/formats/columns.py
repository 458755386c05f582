"""Answers in columns: numbers and poses of many rows in JSON or Arrow, without a model a row.

orjson keeps the interpreter to itself while it works, so that even ``/livez`` would wait: long columns become
text in pieces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import orjson
from fastapi import Response

from graspdb_service.formats import arrow
from graspdb_service.formats.negotiation import ARROW, JSON

_ROWS = 8_192


def columns_json(
    head: Mapping[str, Any], columns: Mapping[str, Any], headers: Mapping[str, str] | None = None
) -> Response:
    """A JSON object of ``head`` (as pydantic or orjson takes it) and of columns.

    A column is an array (n,) or (n, k), in which what is not finite becomes null, None, or a mapping of
    further members.
    """
    return Response(json_of_columns(head, columns), media_type=JSON, headers=dict(headers or {}))


def json_of_columns(head: Mapping[str, Any], columns: Mapping[str, Any]) -> bytes:
    """The body of :func:`columns_json`."""
    # Joined once: only so the interpreter goes on meanwhile.
    return b"".join(_value({**head, **columns}))


def _value(value: Any) -> Iterator[bytes]:
    if isinstance(value, Mapping):
        before = b"{"
        for name, member in value.items():
            yield before + orjson.dumps(name) + b":"
            yield from _value(member)
            before = b","
        yield b"}" if value else b"{}"
    elif isinstance(value, np.ndarray):
        yield b"["
        for start in range(0, len(value), _ROWS):
            piece = np.ascontiguousarray(value[start : start + _ROWS])
            if start:
                yield b","
            yield orjson.dumps(piece, option=orjson.OPT_SERIALIZE_NUMPY)[1:-1]
        yield b"]"
    else:
        yield orjson.dumps(value)


def _flat(columns: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Columns, those of mappings within mappings by all their names."""
    for name, value in columns.items():
        if isinstance(value, Mapping):
            yield from ((f"{name}_{part}", column) for part, column in _flat(value))
        else:
            yield name, value


def columns_arrow(
    head: Mapping[str, Any], columns: Mapping[str, Any], headers: Mapping[str, str] | None = None
) -> Response:
    """The same as an Arrow IPC stream: ``head`` as JSON in the schema's metadata, null for infinity and NaN.

    Members of a mapping become columns of their own, ``interval_low`` of ``interval.low``; those that are no
    arrays join the head.
    """
    arrays, told = {}, dict(head)
    for name, column in _flat(columns):
        if not isinstance(column, np.ndarray):
            told[name] = column
        else:
            arrays[name] = column if column.dtype == np.bool_ else arrow.numbers(column)
    batch = arrow.record_batch(arrays, told)
    content = b"".join(arrow.stream(batch.schema, [batch]))
    return Response(content, media_type=ARROW, headers=dict(headers or {}))

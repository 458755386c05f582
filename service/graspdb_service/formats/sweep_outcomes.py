"""Outcomes of a sweep's poses, as JSON columns or an Arrow stream."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import orjson
from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from graspdb.wire import OUTCOMES, SimulateResult
from graspdb.wire.jobs import ResultRows
from graspdb_service.formats import arrow
from graspdb_service.formats.columns import columns_json
from graspdb_service.formats.json_bodies import no_json, read_object, validated
from graspdb_service.formats.json_pieces import LongArray
from graspdb_service.formats.negotiation import ARROW
from graspdb_service.problems import invalid
from graspdb_service.trial_columns import Floats, Ints, TrialColumns

_HEADERS = {"Vary": "Accept"}
_SEVERAL = ("attempts", "successes")
_COLUMNS: dict[str, TypeAdapter[Any]] = {
    name: TypeAdapter(field.annotation or list) for name, field in ResultRows.model_fields.items()
}


@dataclass(frozen=True, eq=False)
class ChunkResult:
    """What a worker measured: an outcome code (n,) a pose of the chunk, of several draws how many succeeded,
    columns of those with physics, and in which engine, with its version."""

    outcomes: NDArray[np.uint8]
    successes: NDArray[np.uint8] | None
    pose_index: Ints
    width_m: Floats
    quality: Floats
    engine: str | None


def read_result(request: Request, body: bytes) -> ChunkResult:
    """A body as a chunk's result; refused as :class:`graspdb.wire.SimulateResult` would refuse it."""
    try:
        return _read_result(read_object(request, body, status=422))
    except orjson.JSONDecodeError as error:
        raise no_json(error, 422) from None


def _read_result(content: dict[str, Any]) -> ChunkResult:
    rows = content.get("rows")
    long: dict[str, list[NDArray[Any]]] = {}
    if isinstance(rows, dict):
        for name in [name for name, value in rows.items() if isinstance(value, LongArray)]:
            long[name] = [_numbers(name, items) for items in rows[name]] if name in _COLUMNS else []
            rows[name] = []
    result = validated(content, SimulateResult)
    short = {name: _array(name, getattr(result.rows, name)) for name in _COLUMNS}
    columns = {name: np.concatenate([short[name], *long.get(name, [])]) for name in _COLUMNS}
    won = None if result.successes is None else np.frombuffer(result.successes, dtype=np.uint8)
    return ChunkResult(np.frombuffer(result.outcomes, dtype=np.uint8), won, engine=result.engine, **columns)


def _numbers(name: str, items: list[Any]) -> NDArray[Any]:
    try:
        return _array(name, _COLUMNS[name].validate_python(items))
    except ValidationError as error:
        raise invalid(f"rows.{name}", error.errors(include_input=False)[0]["msg"]) from None


def _array(name: str, values: list[Any]) -> NDArray[Any]:
    # None becomes NaN, which stands for "none" in the columns.
    return np.array(values, dtype=np.int64 if name == "pose_index" else np.float64)


def stream_response(head: dict[str, Any], pages: Iterator[TrialColumns]) -> Response:
    """All outcomes as an Arrow stream, with ``head`` in its schema's metadata."""
    return StreamingResponse(_stream({**head, "next": None}, pages), media_type=ARROW, headers=_HEADERS)


def page_response(head: dict[str, Any], page: TrialColumns, kind: str) -> Response:
    """A page of outcomes; ``head``, and where the next one starts in it, stands beside them."""
    if kind == ARROW:
        return Response(b"".join(_stream(head, iter([page]))), media_type=ARROW, headers=_HEADERS)
    columns = {name: getattr(page, name) for name in ("pose_index", "position", "quaternion_xyzw")}
    told = {"outcome": np.array(OUTCOMES, dtype=object)[page.outcome].tolist()}
    if len(page.attempts):
        told |= {name: getattr(page, name).astype(int).tolist() for name in _SEVERAL}
    return columns_json({**head, **told}, columns, _HEADERS)


def _stream(told: dict[str, Any], pages: Iterator[TrialColumns]) -> Iterator[bytes]:
    batches = (
        arrow.record_batch(
            {
                "pose_index": page.pose_index,
                "position": arrow.vectors(page.position, 3),
                "quaternion_xyzw": arrow.vectors(page.quaternion_xyzw, 4),
                "outcome": arrow.outcome_names(page.outcome),
                **{name: getattr(page, name).astype(np.int32) for name in _SEVERAL if len(page.attempts)},
            },
            told,
        )
        for page in pages
    )
    first = next(batches)
    return arrow.stream(first.schema, chain([first], batches))

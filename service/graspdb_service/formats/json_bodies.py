"""JSON bodies that a route reads itself, because they are large or their bytes count."""

from __future__ import annotations

import json
from typing import Any, TypeVar

import orjson
from fastapi import Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError

from graspdb.wire.base import told_of
from graspdb_service.formats.json_pieces import Allowed, LongArray, loads
from graspdb_service.formats.negotiation import require_json
from graspdb_service.problems import ProblemError, invalid

Model = TypeVar("Model", bound=BaseModel)
#: Bytes that Python's own parser, which holds up all other requests, may look at once more.
_SHORT = 2**16


def read_object(
    request: Request, body: bytes, allowed: Allowed | None = None, *, status: int = 400
) -> dict[str, Any]:
    """A JSON object, its long arrays as :class:`LongArray`.

    415 for another media type, ``status`` where the body is no JSON, 422 where it is no object. A short one
    may hold NaN, Infinity and numbers beyond all floats, so that its model names the field.
    """
    require_json(request)
    try:
        value = loads(body, allowed=allowed)
    except orjson.JSONDecodeError as error:
        value = _with_any_number(body, error, status)
    if not isinstance(value, dict):
        raise invalid("body", "must be a JSON object")
    return value


def _with_any_number(body: bytes, error: orjson.JSONDecodeError, status: int) -> Any:
    """What orjson refused, where nothing but a number is wrong with it."""
    if len(body) > _SHORT:
        raise no_json(error, status)
    try:
        return json.loads(body)
    except (ValueError, RecursionError):
        raise no_json(error, status) from None


def validated(content: Any, model: type[Model], *, most: int = 0) -> Model:
    """What :func:`read_object` read as a model; long arrays are cut where no model takes over ``most``."""
    try:
        return model.model_validate(_as_lists(content, most))
    except ValidationError as error:
        raise RequestValidationError(told_of(error.errors(include_input=False), model)) from None


def _as_lists(content: Any, most: int) -> Any:
    if isinstance(content, dict):
        return {name: _as_lists(value, most) for name, value in content.items()}
    if not isinstance(content, LongArray):
        return content
    items: list[Any] = []
    try:
        for piece in content:
            items += piece
            if len(items) > most:
                break
    except orjson.JSONDecodeError as error:
        raise no_json(error) from None
    return items


def no_json(error: ValueError, status: int = 400) -> ProblemError:
    """A body that is no JSON."""
    return ProblemError(
        status,
        "invalid-json",
        "The body is not valid JSON (NaN and Infinity are none)",
        detail=str(error)[:200],
        errors=[("body", "not valid JSON")],
    )

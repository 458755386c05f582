"""JSON bodies that a route reads itself, because they are large or their bytes count."""

from __future__ import annotations

from typing import Any, TypeVar

import orjson
from fastapi import Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError

from graspdb_service.formats.json_pieces import Allowed, LongArray, loads
from graspdb_service.formats.negotiation import require_json
from graspdb_service.problems import ProblemError, invalid

Model = TypeVar("Model", bound=BaseModel)


def read_object(
    request: Request, body: bytes, allowed: Allowed | None = None, *, status: int = 400
) -> dict[str, Any]:
    """A JSON object, its long arrays as :class:`LongArray`; NaN and Infinity are refused here.

    415 for another media type, ``status`` where the body is no JSON, 422 where it is no object.
    """
    require_json(request)
    try:
        value = loads(body, allowed=allowed)
    except orjson.JSONDecodeError as error:
        raise no_json(error, status) from None
    if not isinstance(value, dict):
        raise invalid("body", "must be a JSON object")
    return value


def validated(content: Any, model: type[Model], *, most: int = 0) -> Model:
    """What :func:`read_object` read as a model; long arrays are cut where no model takes over ``most``."""
    try:
        return model.model_validate(_as_lists(content, most))
    except ValidationError as error:
        raise RequestValidationError(error.errors(include_input=False)) from None


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

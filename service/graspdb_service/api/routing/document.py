"""The OpenAPI document: what FastAPI derives, the bodies that routes read themselves, and the problems."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fastapi.openapi.utils import get_openapi
from pydantic.json_schema import models_json_schema
from starlette.routing import BaseRoute

from graspdb.wire import Problem
from graspdb_service.api.routing.scopes import BODY_MODELS

PROBLEM = {
    "description": "A problem (RFC 9457): `title` says what to do, `errors` name the fields",
    "content": {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}},
}


def document(routes: Sequence[BaseRoute], *, title: str, summary: str, version: str) -> dict[str, Any]:
    """The OpenAPI document of these routes."""
    found = get_openapi(
        title=title, version=version, summary=summary, routes=routes, separate_input_output_schemas=False
    )
    schemas: dict[str, Any] = found.setdefault("components", {}).setdefault("schemas", {})
    models = [(model, "validation") for model in (*BODY_MODELS.values(), Problem)]
    _, extra = models_json_schema(models, ref_template="#/components/schemas/{model}")  # type: ignore[arg-type]
    for name, schema in extra.get("$defs", {}).items():
        schemas.setdefault(name, schema)
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    for operations in found["paths"].values():
        for operation in operations.values():
            responses = operation["responses"]
            # Ours are problems, whatever the status; FastAPI's own 422 never leaves this service.
            responses.pop("422", None)
            responses["default"] = PROBLEM
    found["components"]["schemas"] = dict(sorted(schemas.items()))
    return found

"""The OpenAPI document: what FastAPI derives, the bodies that routes read themselves, and the problems."""

from __future__ import annotations

import ast
import functools
import inspect
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema
from starlette.routing import BaseRoute

from graspdb.wire import Problem
from graspdb.wire.access.keys import SCOPES
from graspdb_service.api.routing.scopes import ACCEPTED_FIELD, BODY_MODELS

PROBLEM = {
    "description": "A problem (RFC 9457): `title` says what to do, `errors` name the fields",
    "content": {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}},
}
COLUMNS = ("public", *SCOPES)
KEY = {
    "type": "http",
    "scheme": "bearer",
    "description": "An API key (`graspdb-server keys create`, `POST /keys`), where the service takes keys",
}


def describe(*bases: type[BaseModel]) -> None:
    """Give every field of the models below these bases the docstring under it as description, and build them.

    Before the routes are made, for they read it. Clients need no descriptions, and reading sources takes a
    third of a second: why pydantic's own ``use_attribute_docstrings`` is not set.
    """
    models = list(dict.fromkeys(model for base in bases for model in _below(base)))
    for model in models:
        for name, field in model.model_fields.items():
            told = (
                _docstrings(home).get(name)
                for home in model.__mro__
                if name in vars(home).get("__annotations__", {})
            )
            field.description = field.description or next(told, None)
    for model in models:
        model.model_config["defer_build"] = False
        model.model_rebuild(force=True)


def _below(base: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for model in base.__subclasses__():
        yield model
        yield from _below(model)


def _docstrings(model: type) -> Mapping[str, str]:
    """The docstring under each field of this class's own."""
    return _docstrings_of(model.__module__).get(model.__qualname__.split("[")[0], {})


@functools.cache
def _docstrings_of(module: str) -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = {}
    for node in ast.parse(inspect.getsource(sys.modules[module])).body:
        if isinstance(node, ast.ClassDef):
            found[node.name] = {
                field.target.id: inspect.cleandoc(text.value.value)
                for field, text in pairwise(node.body)
                if isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
                and isinstance(text.value.value, str)
            }
    return found


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
            accepted = operation.get(ACCEPTED_FIELD, [])
            # Without keys, too, where the service is told so.
            operation["security"] = [] if accepted == ["public"] else [{}, *({"key": [s]} for s in accepted)]
    found["components"]["securitySchemes"] = {"key": KEY}
    found["components"]["schemas"] = dict(sorted(schemas.items()))
    return found


def scope_matrix(found: dict[str, Any]) -> str:
    """Which scope each route takes, as Markdown; of an OpenAPI document."""
    lines = [
        "# Which key may call which route",
        "",
        "A key with any of a route's scopes may call it; `admin` implies all, `public` needs none.",
        "Made by `graspdb-server scopes`; see [security](security.md).",
        "",
        f"| route | {' | '.join(COLUMNS)} |",
        "|---" * (1 + len(COLUMNS)) + "|",
    ]
    for path, operations in found["paths"].items():
        for method, operation in operations.items():
            accepted = operation[ACCEPTED_FIELD]
            open_to = {*accepted, "admin"} if accepted != ["public"] else set(COLUMNS)
            cells = ["yes" if column in open_to else "" for column in COLUMNS]
            lines.append(f"| `{method.upper()} {path}` | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"

"""Declared scopes and parameters: a route without a scope stops the start, an unknown parameter a request."""

from __future__ import annotations

import copy
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, Literal, TypeAlias

from fastapi import Request
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from pydantic import BaseModel
from starlette.routing import BaseRoute

from graspdb.wire.access import keys
from graspdb_service.problems import ProblemError, invalid

RouteScope: TypeAlias = keys.Scope | Literal["public"]
SCOPES: frozenset[str] = frozenset(("public", *keys.SCOPES))
SCOPE_FIELD = "x-required-scope"
ACCEPTED_FIELD = "x-accepted-scopes"

Work = Literal["queries", "reports", "uploads", "meshes", "writes", "reads"]
PLACE_FIELD = "x-place"
BODY_FIELD = "x-body-limit"
"""Both name a limit that ``GET /info`` tells; without the first the method says which, see :func:`scope`."""


BODY_MODELS: dict[str, type[BaseModel]] = {}
"""Models of bodies that a route reads itself, for the OpenAPI document."""


def scope(
    name: RouteScope,
    *others: RouteScope,
    body: Mapping[str, Any] | None = None,
    work: Work | None = None,
    large: bool = False,
) -> dict[str, Any]:
    """Declare a route's scope: ``@router.get("/objects", **scope("read"))``, of several one suffices; and
    what it may take.

    ``body`` documents a body that the route reads itself (:data:`RawBody`): by media type a model, a tuple
    of models or a JSON schema. ``large`` bodies may have ``max_body_bytes``, others ``max_small_body_bytes``.
    ``work`` is the kind of place that a request takes: by default a read for GET, else a write; none for
    what is public.
    """
    extra: dict[str, Any] = {SCOPE_FIELD: name, ACCEPTED_FIELD: [name, *others]}
    if work is not None:
        extra[PLACE_FIELD] = f"max_{work}_at_once"
    if large:
        extra[BODY_FIELD] = "max_body_bytes"
    if body is not None:
        content = {media: {"schema": _schema(given)} for media, given in body.items()}
        extra["requestBody"] = {"required": True, "content": content}
    return {"openapi_extra": extra}


def _schema(given: Any) -> dict[str, Any]:
    if isinstance(given, tuple):
        return {"anyOf": [_schema(item) for item in given]}
    if isinstance(given, type) and issubclass(given, BaseModel):
        BODY_MODELS[given.__name__] = given
        return {"$ref": f"#/components/schemas/{given.__name__}"}
    schema: dict[str, Any] = given
    return schema


def accepted_scopes(route: APIRoute) -> tuple[str, ...]:
    """The scopes of which a route asks for one; RuntimeError where it declares none that there is."""
    declared = tuple((route.openapi_extra or {}).get(ACCEPTED_FIELD, ()))
    if not declared or not SCOPES.issuperset(declared):
        raise RuntimeError(f"{'/'.join(sorted(route.methods or ()))} {route.path} declares no scope")
    return declared


class DeclaredParameters:
    """The query parameters of routes, looked up when one is first asked: the document of all takes a second.

    RuntimeError if a route declares no scope: none may be open by oversight.
    """

    def __init__(self, routes: Iterable[BaseRoute]) -> None:
        self._routes: dict[tuple[str, str], APIRoute] = {}
        self._found: dict[tuple[str, str], dict[str, bool]] = {}
        for route in routes:
            if isinstance(route, APIRoute):
                accepted_scopes(route)
                self._routes.update(
                    dict.fromkeys(((method, route.path) for method in route.methods or ()), route)
                )

    def of(self, method: str, path: str | None) -> dict[str, bool] | None:
        """An operation's query parameters, and whether each may be repeated; None without the operation."""
        place = method, path or ""
        if place not in self._routes:
            return None
        if place not in self._found:
            self._found[place] = _query_parameters(self._routes[place], method)
        return self._found[place]


def _query_parameters(route: APIRoute, method: str) -> dict[str, bool]:
    bare = copy.copy(route)
    # What it takes and gives besides is most of a document.
    bare.body_field = bare.response_field = None
    bare.response_fields = {}
    found = get_openapi(title="", version="", routes=[bare], separate_input_output_schemas=False)
    operation = found["paths"][route.path_format][method.lower()]
    return {
        item["name"]: '"array"' in json.dumps(item["schema"])
        for item in operation.get("parameters", ())
        if item["in"] == "query"
    }


async def refuse_unknown_parameters(request: Request) -> None:
    """422 for a query parameter that the route does not know, or one of one value that stands twice.

    A typing error must not be ignored. No name has a NUL in it, which no database takes: 404 in a path.
    """
    if "\0" in request.url.path or any("\0" in str(value) for value in request.path_params.values()):
        raise ProblemError(404, "not-found", "There is nothing whose name has the NUL character in it")
    path = getattr(request.scope.get("route"), "path", None)
    known = request.app.state.parameters.of(request.method, path)
    if known is None or not request.query_params:
        return
    given = Counter(name for name, _ in request.query_params.multi_items())
    nul = [name for name, value in request.query_params.multi_items() if "\0" in value and name in known]
    if nul:
        raise invalid(nul[0], "text must not contain the NUL character")
    unknown = [name[:80] for name in sorted(given.keys() - known)][:20]
    twice = sorted(name for name, count in given.items() if count > 1 and not known.get(name, True))
    if twice:
        raise ProblemError(
            422,
            "repeated-parameter",
            f"Query parameter {', '.join(twice)} stands there twice: which of its values is meant?",
            errors=[(name, "given more than once") for name in twice],
        )
    if unknown:
        allowed = ", ".join(sorted(known)) or "none"
        raise ProblemError(
            422,
            "unknown-parameter",
            f"Unknown query parameter {', '.join(unknown)}; this route takes: {allowed}",
            errors=[(name, "unknown query parameter") for name in unknown],
        )

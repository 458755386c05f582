"""What every route shares: a declared scope, no unknown query parameters, idempotency and ETags."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

import orjson
from fastapi import Depends, Header, Query, Request, Response
from pydantic import BaseModel

from graspdb_service.api.context import Context
from graspdb_service.problems import ProblemError, invalid

Scope = Literal["public", "read", "trials:write", "jobs:work", "admin"]
SCOPES: tuple[Scope, ...] = get_args(Scope)
SCOPE_FIELD = "x-required-scope"


BODY_MODELS: dict[str, type[BaseModel]] = {}
"""Models of bodies that a route reads itself, for the OpenAPI document."""


def scope(name: Scope, *, body: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Declare a route's scope: ``@router.get("/objects", **scope("read"))``.

    ``body`` documents a body that the route reads itself (:data:`RawBody`): by media type a model, a tuple
    of models or a JSON schema.
    """
    extra: dict[str, Any] = {SCOPE_FIELD: name}
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


def declared_parameters(document: Mapping[str, Any]) -> dict[tuple[str, str], frozenset[str]]:
    """The query parameters of every operation of an OpenAPI document, by method and path.

    RuntimeError if an operation declares no scope: none may be open by oversight.
    """
    found = {}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            if operation.get(SCOPE_FIELD) not in SCOPES:
                raise RuntimeError(f"{method.upper()} {path} declares no scope")
            names = [item["name"] for item in operation.get("parameters", ()) if item["in"] == "query"]
            found[method.upper(), path] = frozenset(names)
    return found


def context(request: Request) -> Context:
    """The service's parts, as :func:`graspdb_service.app.create_app` put them together."""
    state: Context = request.app.state.context
    return state


Ctx = Annotated[Context, Depends(context)]


def _key(idempotency_key: Annotated[str | None, Header()] = None) -> str | None:
    if idempotency_key is not None and not re.fullmatch(r"[\x21-\x7e]{1,200}", idempotency_key):
        raise invalid("Idempotency-Key", "1 to 200 printable ASCII characters, best a UUID")
    return idempotency_key


IdempotencyKey = Annotated[str | None, Depends(_key)]


async def _raw_body(request: Request) -> bytes:
    return await request.body()


RawBody = Annotated[bytes, Depends(_raw_body)]
"""The body's bytes. A large body must never be a FastAPI parameter, which would validate it row by row."""

Limit = Annotated[int, Query(ge=1, le=1_000, description="At most this many items.")]
Cursor = Annotated[str | None, Query(max_length=500, description="`next` of the page before.")]


def encode_cursor(position: int | str | None) -> str | None:
    """An opaque cursor of the place after which the next page starts; None at the end."""
    if position is None:
        return None
    return base64.urlsafe_b64encode(json.dumps(position).encode()).decode().rstrip("=")


def number_cursor(cursor: str | None) -> int:
    """The number in a cursor that this service made, 0 without one."""
    position = 0 if cursor is None else _decode_cursor(cursor)
    if type(position) is not int or not 0 <= position < 2**63:
        raise _bad_cursor()
    return position


def name_cursor(cursor: str | None) -> str:
    """The name in a cursor that this service made, empty without one."""
    position = "" if cursor is None else _decode_cursor(cursor)
    if not isinstance(position, str) or not re.fullmatch(r"[A-Za-z0-9._-]{0,64}", position):
        raise _bad_cursor()
    return position


def _decode_cursor(cursor: str) -> Any:
    try:
        return json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
    except (ValueError, RecursionError, binascii.Error):
        raise _bad_cursor() from None


def _bad_cursor() -> ProblemError:
    return invalid("cursor", "a cursor is the `next` of the page before, unchanged")


def refuse_unknown_parameters(request: Request) -> None:
    """422 for a query parameter that the route does not know: a typing error must not be ignored."""
    path = getattr(request.scope.get("route"), "path", None)
    known = request.app.state.parameters.get((request.method, path))
    if known is None or not request.query_params:
        return
    unknown = sorted(set(request.query_params) - known)
    if unknown:
        allowed = ", ".join(sorted(known)) or "none"
        raise ProblemError(
            422,
            "unknown-parameter",
            f"Unknown query parameter {', '.join(unknown)}; this route takes: {allowed}",
            errors=[(name, "unknown query parameter") for name in unknown],
        )


def etag(*parts: object) -> str:
    """A weak ETag of what an answer depends on."""
    return 'W/"' + ".".join(str(part) for part in parts) + '"'


def not_modified(request: Request, tag: str) -> Response | None:
    """304 where the client already has this answer, else None."""
    seen = request.headers.get("if-none-match")
    if seen is None:
        return None
    tags = {item.strip().removeprefix("W/") for item in seen.split(",")}
    if "*" in tags or tag.removeprefix("W/") in tags:
        return Response(status_code=304, headers={"ETag": tag})
    return None


def tagged_json(request: Request, content: Any, *, tag: str | None = None) -> Response:
    """A JSON answer with an ETag (by default of its content), or 304 where the client has it already."""
    model = isinstance(content, BaseModel)
    body = content.model_dump_json().encode() if model else orjson.dumps(content)
    tag = tag or etag(hashlib.sha256(body).hexdigest()[:32])
    return not_modified(request, tag) or Response(body, media_type="application/json", headers={"ETag": tag})

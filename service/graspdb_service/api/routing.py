"""What every route shares: a declared scope, no unknown query parameters, idempotency and ETags."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, get_args

from fastapi import Depends, FastAPI, Header, Request, Response

from graspdb_service.problems import ProblemError, invalid
from graspdb_service.usecases.context import Context

Scope = Literal["public", "read", "trials:write", "jobs:work", "admin"]
SCOPES: tuple[Scope, ...] = get_args(Scope)
SCOPE_FIELD = "x-required-scope"


def scope(name: Scope) -> dict[str, Any]:
    """Declare a route's scope: ``@router.get("/objects", **scope("read"))``."""
    return {"openapi_extra": {SCOPE_FIELD: name}}


def declared_parameters(app: FastAPI) -> dict[tuple[str, str], frozenset[str]]:
    """The query parameters of every operation, by method and path, as the OpenAPI document has them.

    Raises
    ------
    RuntimeError
        If an operation declares no scope: none may be open by oversight.
    """
    found = {}
    for path, operations in app.openapi()["paths"].items():
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

"""Every route declares the scope it needs, as the contract gives them, or the service does not start."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fastapi import APIRouter, FastAPI

from graspdb_service.api.access.guard import GuardedRoute, refuse_unguarded
from graspdb_service.api.routing.document import scope_matrix
from graspdb_service.api.routing.scopes import ACCEPTED_FIELD, SCOPE_FIELD, DeclaredParameters, scope
from graspdb_service.app import create_app
from graspdb_service.settings import Settings

PUBLIC = {"/livez", "/readyz", "/metrics", "/info"}
FOR_WORKERS = {("get", "/objects/{id}/mesh"), ("get", "/objects/{id}/convex-parts")}
"""Routes that a worker needs, too, though it has only the scope for jobs."""
COMPUTING = ("/likelihood", "/reach", "/best-grasp", "/samples", "/proposals")


def _expected(method: str, path: str) -> str:
    if path in PUBLIC:
        return "public"
    if path.startswith(("/keys", "/audit")):
        return "admin"
    if path.startswith("/jobs"):
        return "jobs:work"
    # Who may have a report computed may stop it.
    if method == "get" or path.endswith(COMPUTING) or path == "/report-runs/{id}/cancel":
        return "read"
    # Whoever tries answers cleans up after the names that they gave them.
    if "/trials" in path or "/batches" in path or "/answers" in path:
        return "trials:write"
    return "objects:write"


def test_scopes_are_those_of_the_contract(sqlite_url: str) -> None:
    app = create_app(Settings(database_url=sqlite_url))
    found = {
        (method, path): operation[SCOPE_FIELD]
        for path, operations in app.openapi()["paths"].items()
        for method, operation in operations.items()
    }
    both = {
        (method, path)
        for path, operations in app.openapi()["paths"].items()
        for method, operation in operations.items()
        if operation[ACCEPTED_FIELD] == ["read", "jobs:work"]
    }
    app.state.context.close()
    assert both == FOR_WORKERS
    assert len(found) > 30
    assert found == {place: _expected(*place) for place in found}


def test_route_without_a_scope_is_refused() -> None:
    app = FastAPI()

    @app.get("/open")
    def open_to_all() -> None: ...

    with pytest.raises(RuntimeError, match="GET /open declares no scope"):
        DeclaredParameters(app.routes)


def test_route_with_an_unknown_scope_is_refused() -> None:
    app = FastAPI()

    @app.get("/odd", **scope("everyone"))  # type: ignore[arg-type]
    def odd() -> None: ...

    with pytest.raises(RuntimeError, match="GET /odd declares no scope"):
        DeclaredParameters(app.routes)


def test_route_that_nothing_guards_is_refused() -> None:
    router = APIRouter()

    @router.get("/open", **scope("read"))
    def open_to_all() -> None: ...

    with pytest.raises(RuntimeError, match="/open is not guarded"):
        refuse_unguarded(router.routes)


def test_guarded_route_without_a_scope_cannot_be_made() -> None:
    router = APIRouter(route_class=GuardedRoute)
    with pytest.raises(RuntimeError, match="GET /open declares no scope"):
        router.get("/open")(lambda: None)


def test_the_table_of_scopes_is_current() -> None:
    docs = Path(__file__).parents[2] / "docs"
    document = json.loads((docs / "openapi.json").read_text())
    assert scope_matrix(document) == (docs / "scopes.md").read_text(), (
        "a route or a scope changed: run `graspdb-server scopes > docs/scopes.md`"
    )

"""The ASGI application: routers, problems, request ids, limits."""

from __future__ import annotations

import asyncio
import functools
import json
import logging
import time
import uuid
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Any

import anyio.to_thread
import swagger_ui_bundle
from fastapi import Depends, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.responses import HTMLResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import Counter, Histogram
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from graspdb.wire.base import told_of
from graspdb_service import __version__
from graspdb_service.api import (
    grippers,
    jobs,
    kernels,
    meshes,
    objects,
    operations,
    pictures,
    reports,
    sweeps,
    trials,
)
from graspdb_service.api.access import keys
from graspdb_service.api.access.browsers import BrowserGuard
from graspdb_service.api.access.guard import Door, refuse_unguarded
from graspdb_service.api.cells import reach, robots, scenes
from graspdb_service.api.context import Context
from graspdb_service.api.questions import answers, queries
from graspdb_service.api.routing.admission import Admission
from graspdb_service.api.routing.document import document
from graspdb_service.api.routing.encodings import Decoding
from graspdb_service.api.routing.methods import METHODS, Methods, allowed
from graspdb_service.api.routing.prefix import Prefix
from graspdb_service.api.routing.scopes import DeclaredParameters, refuse_unknown_parameters
from graspdb_service.formats.negotiation import require_json
from graspdb_service.problems import ProblemError, invalid_fields
from graspdb_service.settings import Settings
from graspdb_service.storage import schema
from graspdb_service.storage.database import UNAVAILABLE, CommitUnknown, Database, is_full, why
from graspdb_service.storage.objects import ObjectGone
from graspdb_service.telemetry.requests import RequestLog
from graspdb_service.usecases.access.rates import Rates
from graspdb_service.usecases.grippers import seed

log = logging.getLogger("graspdb")

#: What is counted for an answer that nobody waited for.
CLIENT_GONE = 499

REQUESTS = Counter("graspdb_http_requests_total", "Requests answered.", ["method", "route", "status"])
LATENCY = Histogram(
    "graspdb_http_request_seconds", "Time to the last byte of the answer.", ["method", "route"]
)

ABOUT: dict[str, Any] = {
    "title": "GraspDB",
    "summary": "The grasp database that answers",
    "version": __version__,
}
ROUTERS = [
    operations.router,
    objects.router,
    meshes.router,
    pictures.router,
    grippers.router,
    robots.router,
    scenes.router,
    reach.router,
    trials.router,
    queries.router,
    answers.router,
    kernels.router,
    reports.router,
    sweeps.router,
    jobs.router,
    keys.router,
]


def create_app(settings: Settings | None = None) -> FastAPI:
    """The application over the database that the settings (by default the environment) name.

    SQLite is created and migrated here; a PostgreSQL schema that is not current is refused (StaleSchema).
    """
    settings = settings or Settings()
    ctx = Context.create(settings, _open_database(settings))

    admission = Admission(settings)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        admission.open()
        await anyio.to_thread.run_sync(ctx.health.start)
        watching = asyncio.create_task(_cut_what_hangs(ctx))
        ctx.upkeep.start()
        yield
        watching.cancel()
        ctx.close()

    app = FastAPI(
        **ABOUT,
        root_path=settings.root_path.rstrip("/"),
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        dependencies=[Depends(refuse_unknown_parameters)],
    )
    app.state.context = ctx
    app.state.admission = admission
    for router in ROUTERS:
        refuse_unguarded(router.routes)
        # Not included, which would make every route anew for every application at its first request.
        app.router.routes.extend(router.routes)
    app.openapi = openapi_document  # type: ignore[method-assign]
    app.state.parameters = DeclaredParameters(route for router in ROUTERS for route in router.routes)
    _add_docs(app)
    _add_problems(app)
    rates = Rates(settings.max_requests_per_s, settings.max_request_burst)
    app.state.door = Door(ctx.keys if settings.uses_keys else None, rates)
    app.add_middleware(Methods)
    app.add_middleware(Decoding, max_body_bytes=settings.max_body_bytes)
    hosts = None if settings.uses_keys else (settings.host, *settings.allowed_hosts)
    app.add_middleware(BrowserGuard, hosts=hosts, answer=problem_response)
    app.add_middleware(Prefix)
    app.add_middleware(RequestTrace)
    app.add_middleware(RequestLog)
    return app


def _open_database(settings: Settings) -> Database:
    """The database, its schema current, with the built-in grippers."""
    database = Database(
        settings.database_url,
        pool_size=settings.max_database_connections,
        statement_s=settings.max_statement_seconds,
        password_file=settings.database_password_file,
    )
    try:
        if database.is_sqlite:
            schema.upgrade(database)
        else:
            schema.check(database)
        seed(database)
    except BaseException:
        database.dispose()
        raise
    return database


async def _cut_what_hangs(ctx: Context) -> None:
    """Have nobody wait for a PostgreSQL that accepts and never answers."""
    while not ctx.database.is_sqlite:
        await asyncio.sleep(1.0)
        if ctx.health.down() is not None:
            await anyio.to_thread.run_sync(ctx.database.cut)


@functools.cache
def openapi_document() -> dict[str, Any]:
    """The OpenAPI document; it takes a second to make, and every application of a process has the same."""
    return document([route for router in ROUTERS for route in router.routes], **ABOUT)


def problem_response(problem: ProblemError, request_id: str) -> Response:
    """The problem as ``application/problem+json``."""
    # A field's name may be anything the client sent, half a surrogate pair included.
    body = json.dumps(problem.document(request_id), ensure_ascii=False).encode("utf-8", "replace")
    return Response(
        body, status_code=problem.status, headers=problem.headers, media_type="application/problem+json"
    )


class RequestTrace:
    """Gives every request an id, answers it as ``X-Request-ID``, and counts and times the request.

    What no handler caught ends here as a problem, with its traceback in the log under that id.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request_id = uuid.uuid4().hex
        scope.setdefault("state", {})["request_id"] = request_id
        started = time.perf_counter()
        status, begun = 500, False

        async def traced(message: Message) -> None:
            nonlocal status, begun
            if message["type"] == "http.response.start":
                status, begun = message["status"], True
                message.setdefault("headers", []).append((b"x-request-id", request_id.encode()))
            await send(message)

        try:
            await self.app(scope, receive, traced)
        except ClientDisconnect:
            status = CLIENT_GONE
        except Exception:
            log.exception("request %s failed", request_id)
            if begun:
                raise
            problem = ProblemError(
                500, "internal-error", "The service failed; the log has more under the request's id"
            )
            await problem_response(problem, request_id)(scope, receive, traced)
        finally:
            route = getattr(scope.get("route"), "path", "unmatched")
            method = scope["method"] if scope["method"] in METHODS else "other"
            REQUESTS.labels(method, route, status).inc()
            LATENCY.labels(method, route).observe(time.perf_counter() - started)


def _add_docs(app: FastAPI) -> None:
    """Swagger UI from a package: the page works without the internet."""
    app.mount("/docs/assets", StaticFiles(directory=Path(swagger_ui_bundle.swagger_ui_path)), name="docs")

    @app.get("/docs", include_in_schema=False)
    def docs() -> HTMLResponse:
        return get_swagger_ui_html(
            # Relative: right under whatever prefix a proxy serves the page.
            openapi_url="openapi.json",
            title="GraspDB",
            swagger_js_url="docs/assets/swagger-ui-bundle.js",
            swagger_css_url="docs/assets/swagger-ui.css",
            swagger_favicon_url="docs/assets/favicon-32x32.png",
        )


def _add_problems(app: FastAPI) -> None:
    def answer(request: Request, problem: ProblemError) -> Response:
        return problem_response(problem, getattr(request.state, "request_id", ""))

    @app.exception_handler(ProblemError)
    async def on_problem(request: Request, error: ProblemError) -> Response:
        return answer(request, error)

    @app.exception_handler(RequestValidationError)
    def on_invalid(request: Request, error: RequestValidationError) -> Response:
        errors = error.errors()
        if any(item["loc"] == ("body",) for item in errors):
            try:
                require_json(request)
            except ProblemError as problem:
                return answer(request, problem)
        body = getattr(request.scope.get("route"), "body_field", None)
        return answer(request, problem_of_validation(told_of(errors, body and body.field_info.annotation)))

    @app.exception_handler(ObjectGone)
    def on_gone(request: Request, _: ObjectGone) -> Response:
        return answer(request, ProblemError(404, "not-found", "The object has just been deleted"))

    def on_database(request: Request, error: Exception) -> Response:
        log.error("request %s: %s", getattr(request.state, "request_id", ""), why(error))
        return answer(request, _database_problem(error))

    for unavailable in UNAVAILABLE:
        app.exception_handler(unavailable)(on_database)

    @app.exception_handler(CommitUnknown)
    def on_unknown(request: Request, error: CommitUnknown) -> Response:
        log.error("request %s: lost while it was committed: %s", request.state.request_id, error)
        problem = ProblemError(
            503,
            "commit-unknown",
            "The database broke off while it stored this: nobody knows whether it is stored. Look for it, or"
            " send the same again under the same Idempotency-Key, which stores nothing twice",
            headers={"Retry-After": "2"},
        )
        return answer(request, problem)

    @app.exception_handler(HTTPException)
    async def on_http(request: Request, error: HTTPException) -> Response:
        if error.status_code == 413:
            return answer(request, ProblemError(413, "body-too-large", str(error.detail)))
        kind = HTTPStatus(error.status_code).phrase.lower().replace(" ", "-")
        title = {
            404: f"There is nothing at {request.url.path}",
            405: f"{request.method} is not for {request.url.path}",
        }.get(error.status_code, str(error.detail))
        headers = {"Allow": allowed(request.scope)} if error.status_code == 405 else error.headers
        return answer(request, ProblemError(error.status_code, kind, title, headers=headers))


def _database_problem(error: Exception) -> ProblemError:
    if is_full(error):
        title = "The database's disk is full, and nothing was stored: make room on it, then try again"
        return ProblemError(507, "disk-full", title, headers={"Retry-After": "30"})
    return ProblemError(
        503,
        "database-unavailable",
        "The database does not answer or is busy; nothing was stored: try again",
        detail=why(error),
        headers={"Retry-After": "2"},
    )


def problem_of_validation(errors: Any) -> ProblemError:
    """A 422 that names each field and never echoes the input, which may hold NaN or megabytes."""
    listed: list[tuple[str, str]] = []
    of_type: list[tuple[str, str]] = []
    for item in list(errors)[:20]:
        if item["type"] == "json_invalid":
            listed.append(("body", f"not valid JSON: {item.get('ctx', {}).get('error', item['msg'])}"))
            continue
        place = [str(part) for part in item["loc"] if part not in ("body", "query", "path", "header")]
        # pydantic names the branch of a union it tried; that is no part of the user's document.
        place = [part for part in place if "[" not in part and not part[:1].isupper()]
        place = [part for part in place if part != "constrained-str"]
        told = ".".join(place) or "body", str(item["msg"])
        (of_type if item["type"].endswith("_type") else listed).append(told)
    # Of a union's branches the one that took the value says what is wrong with it, not those of other types.
    fields = [f"{name}." for name, _ in listed]
    listed += [told for told in of_type if not any(name.startswith(f"{told[0]}.") for name in fields)]
    return invalid_fields(list(dict.fromkeys(listed)))

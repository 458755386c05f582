"""Reports on an object's trials, ``/objects/{id}/reports``, a route for each that is declared; and runs."""

from __future__ import annotations

import hashlib
import importlib.util
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from graspdb import figures
from graspdb.wire.reports import REPORTS, Report, ReportOptions, ReportRun, SummaryReport
from graspdb.wire.states import RunState
from graspdb_service import __version__
from graspdb_service.api.context import Context
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import etag, not_modified
from graspdb_service.api.routing.parameters import Ctx, ObjectId, RunId
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.negotiation import JSON, PNG, SVG, accepted
from graspdb_service.problems import ProblemError
from graspdb_service.usecases.reports import summary
from graspdb_service.usecases.runtime import runs

router = APIRouter(tags=["reports"], route_class=AdmittedRoute)

_FIGURES: dict[str, figures.Format] = {PNG: "png", SVG: "svg"}
_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The report; its figure where Accept prefers image/png or image/svg+xml",
        "content": {media: {} for media in _FIGURES},
    },
    202: {"model": ReportRun, "description": "Under way: Location says where it will be"},
}


def _add_route(name: str, report: type[Report]) -> None:
    def get_report(ctx: Ctx, id: ObjectId, request: Request, query: ReportOptions) -> Response:
        return _answer(ctx, id, name, request, query)

    get_report.__annotations__["query"] = Annotated[report.options, Query()]
    router.add_api_route(
        f"/objects/{{id}}/reports/{name}",
        get_report,
        name=f"get_{name.replace('-', '_')}",
        description=report.question,
        response_model=report,
        responses=_RESPONSES,
        **scope("read", work="reports"),
    )


for _name, _report in REPORTS.items():
    _add_route(_name, _report)


@router.get(
    "/reports/summary",
    response_model=SummaryReport,
    responses={200: _RESPONSES[200]},
    **scope("read", work="reports"),
)
def get_summary(ctx: Ctx, request: Request) -> Response:
    """What was tried on every object, by outcome, with the success rate by each way of counting (table I)."""
    media = _media(request)
    content = summary.summary(ctx.database).model_dump_json()
    return _tagged(request, media, SummaryReport, content, hashlib.sha256(content.encode()).hexdigest()[:24])


@router.get("/report-runs/{id}", **scope("read"))
def get_run(ctx: Ctx, id: RunId) -> ReportRun:
    """A report's computation: state, progress, and the report once it is done."""
    return runs.model(ctx.runs.get(id))


@router.post("/report-runs/{id}/cancel", **scope("read"))
def cancel_run(ctx: Ctx, id: RunId) -> ReportRun:
    """Stop computing; a run that has ended stays as it is."""
    return runs.model(ctx.runs.cancel(id))


def _answer(ctx: Context, slug: str, name: str, request: Request, options: ReportOptions) -> Response:
    """The report, or its figure; 202 and where it will be while it is computed."""
    media = _media(request)
    run = ctx.runs.ask(ctx.reports.key(slug, name, options))
    if run.state == RunState.RUNNING:
        return Response(
            runs.model(run).model_dump_json(),
            status_code=202,
            media_type=JSON,
            headers={"Location": f"/report-runs/{run.id}", "Retry-After": "2"},
        )
    assert run.result is not None
    tag = (run.object_id, run.revision, run.parameters_key[:24])
    return _tagged(request, media, REPORTS[name], run.result, *tag)


def _tagged(
    request: Request, media: str, model: type[Report | SummaryReport], content: str, *parts: object
) -> Response:
    """A report as JSON or its figure, under a tag; 304 where the client has it."""
    figure = _FIGURES.get(media)
    tag = etag(*parts, figure or "json", __version__)
    seen = not_modified(request, tag)
    if seen is not None:
        return seen
    body = figures.render(model.model_validate_json(content), figure) if figure else content
    return Response(body, media_type=media, headers={"ETag": tag, "Vary": "Accept"})


def _media(request: Request) -> str:
    """The media type to answer in; 406 where none of ours is accepted, or nothing can draw a figure."""
    media = accepted(request, JSON, *_FIGURES)
    if media != JSON and importlib.util.find_spec("matplotlib") is None:
        raise ProblemError(
            406,
            "not-acceptable",
            "Figures need matplotlib on the server: pip install 'graspdb[plot]'; take JSON",
        )
    return media

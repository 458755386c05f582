"""Reports on an object's trials: ``/objects/{id}/reports`` and the runs that compute them."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response
from pydantic import BeforeValidator

from graspdb.wire import Selection
from graspdb.wire.base import Direction, Slug, Source
from graspdb.wire.base import Request as StrictRequest
from graspdb.wire.kernels import Alignment
from graspdb.wire.queries import WidthDeg, WidthM
from graspdb.wire.reports import (
    REPORTS,
    AnisotropyReport,
    AnyReport,
    BandwidthReport,
    CalibrationReport,
    ConvergenceReport,
    KernelSimilarityReport,
    Matching,
    Method,
    ProjectionReport,
    ReportRun,
    SourcesReport,
    SummaryReport,
)
from graspdb_service import __version__
from graspdb_service.api.context import Context
from graspdb_service.api.queries import SelectionQuery
from graspdb_service.api.routing import Ctx, etag, not_modified, scope
from graspdb_service.formats.negotiation import accepted
from graspdb_service.problems import ProblemError
from graspdb_service.storage.report_runs import RunRow
from graspdb_service.usecases.reports import runs, summary

router = APIRouter(tags=["reports"])

Format = Literal["json", "png", "svg"]
_MEDIA: dict[str, Format] = {
    "application/json": "json",
    "image/png": "png",
    "image/svg+xml": "svg",
}
_TYPES = {name: media for media, name in _MEDIA.items()}
_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The report; its figure where Accept prefers image/png or image/svg+xml",
        "content": {"image/png": {}, "image/svg+xml": {}},
    },
    202: {"model": ReportRun, "description": "Under way: Location says where it will be"},
}


class ConvergenceQuery(SelectionQuery):
    """Which trials and kernel; ``matching`` says how the isotropic kernel beside a stored one is chosen."""

    matching: Matching | None = None


class AnisotropyQuery(SelectionQuery):
    """``empirical`` counts pairs of trials; ``density`` compares the density of successes with attempts'."""

    method: Method = "empirical"
    alignment: Alignment = "gripper"


def _alone(value: Any) -> Any:
    """The text in a list of one, as a query string gives it."""
    if isinstance(value, (list, tuple)) and len(value) == 1 and isinstance(value[0], str):
        return value[0].strip()
    return value


def _axis(value: Any) -> Any:
    """``x``, ``-z`` ... for a unit vector."""
    value = _alone(value)
    text = value.strip() if isinstance(value, str) else ""
    letter = text.removeprefix("-").removeprefix("+")
    if letter not in ("x", "y", "z"):
        return value
    sign = -1.0 if text.startswith("-") else 1.0
    return [sign if letter == name else 0.0 for name in "xyz"]


Axis = Annotated[Direction, BeforeValidator(_axis)]
ConeDeg = Annotated[float, Query(gt=0, le=180)]


class ProjectionQuery(SelectionQuery):
    """The plane, ``xy``, ``xz`` or ``yz`` or its normal ``nx,ny,nz`` (none: the one that shows most), and
    which way grasps point: ``approach`` is that of tool z, ``direction`` that of tool x, across the jaw, with
    either sign; each ``x,y,z`` or an axis such as ``-z``, within a cone whose half angle follows.
    """

    plane: Annotated[Literal["xy", "xz", "yz"] | Axis | None, BeforeValidator(_alone)] = None
    approach: Axis | None = None
    approach_cone_deg: ConeDeg = 30.0
    direction: Axis | None = None
    direction_cone_deg: Annotated[float, Query(gt=0, le=90)] = 30.0


@router.get(
    "/objects/{id}/reports/projection",
    response_model=ProjectionReport,
    responses=_RESPONSES,
    **scope("read"),
)
def get_projection(
    ctx: Ctx, id: str, request: Request, query: Annotated[ProjectionQuery, Query()]
) -> Response:
    """Where do grasps succeed? The density on a plane, of all grasps or of those that point one way."""
    vectors = {"plane": query.plane, "approach": query.approach, "direction": query.direction}
    options: dict[str, str | None] = {
        name: value if value is None or isinstance(value, str) else json.dumps(value)
        for name, value in vectors.items()
    }
    for name in ("approach_cone_deg", "direction_cone_deg"):
        options[name] = str(getattr(query, name))
    return _answer(ctx, id, "projection", request, query, options)


@router.get(
    "/objects/{id}/reports/convergence",
    response_model=ConvergenceReport,
    responses=_RESPONSES,
    **scope("read"),
)
def get_convergence(
    ctx: Ctx, id: str, request: Request, query: Annotated[ConvergenceQuery, Query()]
) -> Response:
    """Have we tried enough? Similarity and held-out likelihood against the number of successes."""
    return _answer(ctx, id, "convergence", request, query, {"matching": query.matching})


@router.get(
    "/objects/{id}/reports/anisotropy",
    response_model=AnisotropyReport,
    responses=_RESPONSES,
    **scope("read"),
)
def get_anisotropy(
    ctx: Ctx, id: str, request: Request, query: Annotated[AnisotropyQuery, Query()]
) -> Response:
    """How far off may the gripper be? Success by displacement from successes, tolerances by axis."""
    options = {"method": query.method, "alignment": query.alignment}
    return _answer(ctx, id, "anisotropy", request, query, options)


@router.get(
    "/objects/{id}/reports/calibration",
    response_model=CalibrationReport,
    responses=_RESPONSES,
    **scope("read"),
)
def get_calibration(
    ctx: Ctx, id: str, request: Request, query: Annotated[SelectionQuery, Query()]
) -> Response:
    """Can success probabilities be believed? Judged on outcomes of blocks of space left out."""
    return _answer(ctx, id, "calibration", request, query, {})


class TrialsQuery(StrictRequest):
    """Which trials: those with this gripper, protocol and source."""

    gripper: Slug | None = None
    protocol: Slug | None = None
    source: Source | None = None

    @property
    def selection(self) -> Selection:
        """With the kernel by default."""
        return Selection(gripper=self.gripper, protocol=self.protocol, source=self.source)


@router.get(
    "/objects/{id}/reports/bandwidth",
    response_model=BandwidthReport,
    responses=_RESPONSES,
    **scope("read"),
)
def get_bandwidth(ctx: Ctx, id: str, request: Request, query: Annotated[TrialsQuery, Query()]) -> Response:
    """How wide should the kernel be? By left-out blocks, and by draws that were simulated as checks."""
    return _answer(ctx, id, "bandwidth", request, query.selection, {})


class KernelSimilarityQuery(TrialsQuery):
    """Which displacements count (a cube's half edge, the largest turn), and the width of a component."""

    window_position_m: Annotated[float, Query(gt=0, le=1.0)] = 0.04
    window_rotation_deg: Annotated[float, Query(gt=0, le=180.0)] = 180.0
    component_position_m: Annotated[float, Query(ge=0.001, le=0.2)] = 0.01
    component_rotation_deg: Annotated[float, Query(ge=1.0, le=40.0)] = 10.0


@router.get(
    "/objects/{id}/reports/kernel-similarity",
    response_model=KernelSimilarityReport,
    responses=_RESPONSES,
    **scope("read"),
)
def get_kernel_similarity(
    ctx: Ctx, id: str, request: Request, query: Annotated[KernelSimilarityQuery, Query()]
) -> Response:
    """How many samples, or Gaussians, does a kernel need to be like its statistics? (figure 13)"""
    names = (
        "window_position_m",
        "window_rotation_deg",
        "component_position_m",
        "component_rotation_deg",
    )
    options: dict[str, str | None] = {name: str(getattr(query, name)) for name in names}
    return _answer(ctx, id, "kernel-similarity", request, query.selection, options)


class SourcesQuery(StrictRequest):
    """The gripper, the protocol of the simulated trials, and the widths of the kernel that predicts."""

    gripper: Slug | None = None
    protocol: Slug | None = None
    sigma_position_m: WidthM | None = None
    sigma_rotation_deg: WidthDeg | None = None


@router.get(
    "/objects/{id}/reports/sources",
    response_model=SourcesReport,
    responses=_RESPONSES,
    **scope("read"),
)
def get_sources(ctx: Ctx, id: str, request: Request, query: Annotated[SourcesQuery, Query()]) -> Response:
    """Does simulation tell what robots find? Predictions at real poses, and how alike densities are."""
    selection = Selection(**query.model_dump(), source="simulation")
    return _answer(ctx, id, "sources", request, selection, {})


@router.get(
    "/reports/summary", response_model=SummaryReport, responses={200: _RESPONSES[200]}, **scope("read")
)
def get_summary(ctx: Ctx, request: Request) -> Response:
    """What was tried on every object, by outcome, with the success rate by each way of counting (table I)."""
    wanted = _format(request)
    found = summary.summary(ctx.database)
    content = found.model_dump_json().encode()
    tag = etag(hashlib.sha256(content).hexdigest()[:24], wanted, __version__)
    headers = {"ETag": tag, "Vary": "Accept"}
    known = not_modified(request, tag)
    if known is not None:
        return known
    body = content if wanted == "json" else _drawn(found, wanted)
    return Response(body, media_type=_TYPES[wanted], headers=headers)


@router.get("/report-runs/{id}", **scope("read"))
def get_run(ctx: Ctx, id: str) -> ReportRun:
    """A report's computation: state, progress, and the report once it is done."""
    return runs.model(ctx.reports.get(id))


@router.post("/report-runs/{id}/cancel", **scope("read"))
def cancel_run(ctx: Ctx, id: str) -> ReportRun:
    """Stop computing; a run that has ended stays as it is."""
    return runs.model(ctx.reports.cancel(id))


def _answer(
    ctx: Context,
    slug: str,
    report: str,
    request: Request,
    query: Selection,
    options: Mapping[str, str | None],
) -> Response:
    wanted = _format(request)
    run = ctx.reports.report(slug, report, query, options)
    if run.state == "running":
        return Response(
            runs.model(run).model_dump_json(),
            status_code=202,
            media_type="application/json",
            headers={"Location": f"/report-runs/{run.id}", "Retry-After": "2"},
        )
    tag = etag(run.object_id, run.revision, run.parameters_key[:24], wanted, __version__)
    headers = {"ETag": tag, "Vary": "Accept"}
    known = not_modified(request, tag)
    if known is not None:
        return known
    assert run.result is not None
    body = run.result.encode() if wanted == "json" else _figure(run, wanted)
    return Response(body, media_type=_TYPES[wanted], headers=headers)


def _format(request: Request) -> Format:
    """The format to answer in.

    Raises
    ------
    ProblemError
        406 where none of ours is accepted, or a figure where nothing can draw it.
    """
    wanted = _MEDIA[accepted(request, *_MEDIA)]
    if wanted != "json" and importlib.util.find_spec("matplotlib") is None:
        raise ProblemError(
            406,
            "not-acceptable",
            "Figures need matplotlib on the server: pip install 'graspdb[plot]'; take JSON",
        )
    return wanted


def _figure(run: RunRow, wanted: Literal["png", "svg"]) -> bytes:
    return _drawn(REPORTS[run.report].model_validate_json(run.result or ""), wanted)


def _drawn(report: AnyReport | SummaryReport, wanted: Literal["png", "svg"]) -> bytes:
    from graspdb import figures

    return figures.render(report, wanted)

"""Sweeps: ``/objects/{id}/sweeps``, ``/sweeps``."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from graspdb.wire import Page, SweepCreate, SweepInfo, SweepOutcomes
from graspdb.wire.states import AnySweepState
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.cursors import Cursor, Limit, encode_cursor, name_cursor
from graspdb_service.api.routing.parameters import (
    Creating,
    Ctx,
    FramedAnswer,
    ObjectId,
    SweepId,
)
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.json_bodies import read_object, validated
from graspdb_service.formats.negotiation import ARROW, BINARY, JSON, accepted
from graspdb_service.formats.poses import read_densities, read_poses
from graspdb_service.formats.sweep_outcomes import page_response, stream_response
from graspdb_service.usecases.simulation import outcomes, planning, sweeps

router = APIRouter(tags=["sweeps"], route_class=AdmittedRoute)

PosesLimit = Annotated[
    int | None,
    Query(ge=1, le=100_000, description="At most this many poses; 10,000, or all in Arrow, if not given."),
]


@router.post(
    "/objects/{id}/sweeps",
    status_code=202,
    response_model=SweepInfo,
    **scope("objects:write", body={JSON: SweepCreate}, work="uploads", large=True),
)
def create_sweep(ctx: Ctx, id: ObjectId, request: Request, sent: Creating) -> object:
    """Queue a simulation of many grasps: of a grid about the object (the default), of given poses, or of
    draws from its density. Workers take its chunks."""
    content = read_object(request, sent.body or b"{}", status=422)
    given: planning.Given | None = None
    poses = content.get("poses")
    if poses is not None:
        # Many poses are read as arrays, and the first stands for all of them in the model.
        read = read_poses(poses)
        given = planning.Given(read, read_densities(content.get("proposal_density"), "proposal_density"))
        content |= {"poses": [{"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}]}
        content.pop("proposal_density", None)
    spec = validated(content, SweepCreate)
    return sent.answered(planning.create(ctx, id, spec, sent, given))


@router.get("/sweeps", **scope("read"))
def list_sweeps(
    ctx: Ctx,
    object: Annotated[str | None, Query(max_length=64, description="Of this object only.")] = None,
    state: Annotated[AnySweepState | None, Query(description="In this state only.")] = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[SweepInfo]:
    """The sweeps, the newest first."""
    items, after = sweeps.listing(
        ctx.database, slug=object, state=state, cursor=name_cursor(cursor) or None, limit=limit
    )
    return Page(items=items, next=encode_cursor(after))


@router.get("/sweeps/{id}", **scope("read"))
def get_sweep(ctx: Ctx, id: SweepId) -> SweepInfo:
    """How far a sweep has come, what it found, how long it will take, and what failed."""
    return sweeps.get(ctx.database, id)


@router.post("/sweeps/{id}/cancel", **scope("objects:write"))
def cancel_sweep(ctx: Ctx, id: SweepId) -> SweepInfo:
    """Stop a sweep; what is stored stays. A finished one is left as it is."""
    return sweeps.cancel(ctx.database, id)


@router.post("/sweeps/{id}/retry", **scope("objects:write"))
def retry_sweep(ctx: Ctx, id: SweepId) -> SweepInfo:
    """Queue a sweep's failed and cancelled chunks again. 409 once its batch was deleted."""
    return sweeps.retry(ctx.database, id)


@router.get(
    "/sweeps/{id}/outcomes",
    response_model=SweepOutcomes,
    responses={200: {"content": {ARROW: {"schema": BINARY}}}},
    **scope("read"),
)
def get_outcomes(
    ctx: Ctx,
    id: SweepId,
    request: Request,
    frame: FramedAnswer,
    limit: PosesLimit = None,
    cursor: Cursor = None,
) -> Response:
    """Every pose of the finished chunks with its outcome, collisions included, in columns.

    Pages are stable once the sweep has finished; while it runs, chunks join between those already read.
    As an Arrow stream (`Accept: application/vnd.apache.arrow.stream`) all of them come at once.
    """
    kind, start = accepted(request, JSON, ARROW), name_cursor(cursor) or None
    wanted = outcomes.frame_of_sweep(ctx.database, id, frame)
    head: dict[str, Any] = {"sweep": id, **wanted.told(), "warnings": list(wanted.warnings)}
    if kind == ARROW and limit is None:
        return stream_response(head, outcomes.pages(ctx.database, id, wanted, cursor=start))
    page, following = outcomes.page(ctx.database, id, wanted, limit=limit or 10_000, cursor=start)
    return page_response({**head, "next": encode_cursor(following)}, page, kind)

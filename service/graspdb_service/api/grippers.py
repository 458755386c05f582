"""Grippers: ``/grippers``."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from graspdb.wire import GripperCreate, GripperInfo, GripperUpdate, Page
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import tagged_json
from graspdb_service.api.routing.cursors import Cursor, Limit, encode_cursor, name_cursor, number_cursor
from graspdb_service.api.routing.parameters import Creating, Ctx, GripperId
from graspdb_service.api.routing.scopes import scope
from graspdb_service.usecases import grippers

router = APIRouter(tags=["grippers"], route_class=AdmittedRoute)


@router.post("/grippers", status_code=201, response_model=GripperInfo, **scope("objects:write"))
def create_gripper(ctx: Ctx, request: GripperCreate, sent: Creating) -> object:
    """Store a parallel-jaw gripper's profile."""
    return sent.answered(grippers.create(ctx.database, request, sent))


@router.get("/grippers", **scope("read"))
def list_grippers(ctx: Ctx, limit: Limit = 100, cursor: Cursor = None) -> Page[GripperInfo]:
    """The grippers, by id."""
    items, after = grippers.page(ctx.database, after=name_cursor(cursor), limit=limit)
    return Page(items=items, next=encode_cursor(after))


@router.get("/grippers/{gripper}", response_model=GripperInfo, **scope("read"))
def get_gripper(ctx: Ctx, gripper: GripperId, request: Request) -> Response:
    """One gripper's profile: the newest, or that of a version, as in `panda@1`."""
    return tagged_json(request, grippers.get(ctx.database, gripper))


@router.put("/grippers/{gripper}", **scope("objects:write"))
def update_gripper(ctx: Ctx, gripper: GripperId, request: GripperUpdate) -> GripperInfo:
    """Make a new version of a gripper, built-in ones too: its id stands for that from now on.

    What was tried keeps the version that it was made with (`panda@1`). The profile that the newest version
    has already makes none, so that the request can be sent again.
    """
    return grippers.update(ctx.database, gripper, request)


@router.get("/grippers/{gripper}/versions", **scope("read"))
def list_gripper_versions(
    ctx: Ctx, gripper: GripperId, limit: Limit = 100, cursor: Cursor = None
) -> Page[GripperInfo]:
    """The versions of a gripper, the first one first, each with the fields in which it differs from the one
    before."""
    items, after = grippers.versions(ctx.database, gripper, after=number_cursor(cursor), limit=limit)
    return Page(items=items, next=encode_cursor(after))


@router.delete("/grippers/{gripper}", status_code=204, **scope("objects:write"))
def delete_gripper(ctx: Ctx, gripper: GripperId) -> None:
    """Delete a gripper that nothing uses, with all its versions, so that its id is free; 409 while trials,
    sweeps or kernels use one."""
    grippers.remove(ctx.database, gripper)

"""Robots: ``/robots``."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from graspdb.wire import Page, RobotInfo, RobotShape, RobotUpdate
from graspdb.wire.cells.robots import URDF, ZIP
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import tagged_json
from graspdb_service.api.routing.cursors import Cursor, Limit, encode_cursor, name_cursor
from graspdb_service.api.routing.parameters import Ctx, RawBody, RobotId
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.negotiation import BINARY, one_of
from graspdb_service.usecases.cells import robots

router = APIRouter(tags=["robots"], route_class=AdmittedRoute)

_FILES = {URDF: BINARY, ZIP: BINARY}


@router.put(
    "/robots/{id}",
    responses={201: {"model": RobotInfo, "description": "A robot of a new id"}},
    **scope("objects:write", body=_FILES, work="meshes", large=True),
)
def put_robot(
    ctx: Ctx,
    id: RobotId,
    request: Request,
    response: Response,
    body: RawBody,
    flange: Annotated[
        str | None,
        Query(max_length=200, description="Name of the link that the gripper is mounted on."),
    ] = None,
) -> RobotInfo:
    """Store a robot, or replace it: its URDF as the body (`application/xml`), or a zip of it and its meshes.

    Meshes (STL, OBJ, PLY, GLB) are found in the zip by their file names. Without them links are not tested
    for collisions, which answers say. Where `flange` is missing the error lists the links.
    """
    info, new = robots.put(ctx, id, body, one_of(request, *_FILES), flange)
    response.status_code = 201 if new else 200
    return info


@router.get("/robots", **scope("read"))
def list_robots(ctx: Ctx, limit: Limit = 100, cursor: Cursor = None) -> Page[RobotInfo]:
    """The robots, by id."""
    items, after = robots.page(ctx.database, after=name_cursor(cursor), limit=limit)
    return Page(items=items, next=encode_cursor(after))


@router.get("/robots/{id}", response_model=RobotInfo, **scope("read"))
def get_robot(ctx: Ctx, id: RobotId, request: Request) -> Response:
    """One robot: joints with their limits, links, and which of them are tested for collisions."""
    return tagged_json(request, robots.get(ctx.database, id))


@router.get(
    "/robots/{id}/description",
    response_class=Response,
    responses={200: {"content": {media: {"schema": schema} for media, schema in _FILES.items()}}},
    **scope("read"),
)
def get_robot_description(ctx: Ctx, id: RobotId) -> Response:
    """The URDF, or the zip, as it came."""
    content, media_type = robots.content(ctx.database, id)
    return Response(content, media_type=media_type)


@router.get("/robots/{id}/shape", response_model=RobotShape, **scope("read"))
def get_robot_shape(ctx: Ctx, id: RobotId, request: Request) -> Response:
    """What draws its arm at any joint values: the chain of joints, and the solids that are tested."""
    return tagged_json(request, robots.shape(ctx.database, id))


@router.patch("/robots/{id}", **scope("objects:write"))
def update_robot(ctx: Ctx, id: RobotId, request: RobotUpdate) -> RobotInfo:
    """Change where the gripper is mounted, or the name."""
    return robots.change(ctx.database, id, request)


@router.delete("/robots/{id}", status_code=204, **scope("objects:write"))
def delete_robot(ctx: Ctx, id: RobotId) -> None:
    """Delete a robot; questions that name it are answered 404 from then on."""
    robots.remove(ctx.database, id)

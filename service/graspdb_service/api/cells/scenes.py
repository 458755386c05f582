"""Scenes: ``/scenes``."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from graspdb.wire import Page, SceneCreate, SceneInfo, SceneSummary
from graspdb.wire.queries import MAX_OBSTACLE_POINTS
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import tagged_json
from graspdb_service.api.routing.cursors import Cursor, Limit, encode_cursor, name_cursor
from graspdb_service.api.routing.parameters import Ctx, RawBody, SceneId
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.json_bodies import read_object, validated
from graspdb_service.formats.negotiation import JSON
from graspdb_service.usecases.cells import scenes

router = APIRouter(tags=["scenes"], route_class=AdmittedRoute)


@router.put(
    "/scenes/{id}",
    responses={201: {"model": SceneSummary, "description": "A scene of a new id"}},
    **scope("objects:write", body={JSON: SceneCreate}, large=True),
)
def put_scene(ctx: Ctx, id: SceneId, request: Request, response: Response, body: RawBody) -> SceneSummary:
    """Store what stands around, or replace it: boxes, points and objects, in the world's frame."""
    given = validated(read_object(request, body), SceneCreate, most=MAX_OBSTACLE_POINTS)
    summary, new = scenes.put(ctx.database, id, given)
    response.status_code = 201 if new else 200
    return summary


@router.get("/scenes", **scope("read"))
def list_scenes(ctx: Ctx, limit: Limit = 100, cursor: Cursor = None) -> Page[SceneSummary]:
    """The scenes, by id."""
    items, after = scenes.page(ctx.database, after=name_cursor(cursor), limit=limit)
    return Page(items=items, next=encode_cursor(after))


@router.get("/scenes/{id}", response_model=SceneInfo, **scope("read"))
def get_scene(ctx: Ctx, id: SceneId, request: Request) -> Response:
    """One scene with all that stands in it."""
    return tagged_json(request, scenes.get(ctx.database, id))


@router.delete("/scenes/{id}", status_code=204, **scope("objects:write"))
def delete_scene(ctx: Ctx, id: SceneId) -> None:
    """Delete a scene; questions that name it are answered 404 from then on."""
    scenes.remove(ctx.database, id)

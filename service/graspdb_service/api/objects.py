"""Objects, their meshes and convex parts: ``/objects``."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from graspdb.wire import CopyRequest, ObjectCreate, ObjectInfo, ObjectPatch, Page
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import etag, tagged_json
from graspdb_service.api.routing.cursors import Cursor, Limit, encode_cursor, name_cursor
from graspdb_service.api.routing.parameters import Creating, Ctx, ObjectId
from graspdb_service.api.routing.scopes import scope
from graspdb_service.usecases import copies, objects
from graspdb_service.usecases.runtime.quotas import check_metadata

router = APIRouter(tags=["objects"], route_class=AdmittedRoute)


@router.post("/objects", status_code=201, response_model=ObjectInfo, **scope("objects:write"))
def create_object(ctx: Ctx, request: ObjectCreate, sent: Creating) -> object:
    """Register an object; its mesh and its trials follow."""
    check_metadata(ctx.settings, request.metadata)
    return sent.answered(objects.create(ctx.database, request, sent))


@router.get("/objects", **scope("read"))
def list_objects(ctx: Ctx, limit: Limit = 100, cursor: Cursor = None) -> Page[ObjectInfo]:
    """The objects, by id."""
    items, after = objects.page(ctx.database, after=name_cursor(cursor), limit=limit)
    return Page(items=items, next=encode_cursor(after))


@router.get("/objects/{id}", response_model=ObjectInfo, **scope("read"))
def get_object(ctx: Ctx, id: ObjectId, request: Request) -> Response:
    """One object: properties, mesh, and how many trials it has by outcome."""
    row, info = objects.get(ctx.database, id)
    return tagged_json(request, info, tag=etag(row.id, row.revision))


@router.patch("/objects/{id}", **scope("objects:write"))
def change_object(ctx: Ctx, id: ObjectId, request: ObjectPatch) -> ObjectInfo:
    """Change properties: a field left out stays, an explicit null clears it."""
    check_metadata(ctx.settings, request.metadata)
    return objects.change(ctx.database, id, request)


@router.post("/objects/{id}/copies", status_code=201, response_model=ObjectInfo, **scope("objects:write"))
def copy_object(ctx: Ctx, id: ObjectId, request: CopyRequest, sent: Creating) -> object:
    """Copy an object with its mesh and convex parts, and its trials if asked: the copy takes one other mesh.

    What sweeps have finished is copied with the trials, checks are not; 409 while a sweep runs.
    """
    return sent.answered(copies.create(ctx.database, id, request, sent))


@router.delete("/objects/{id}", status_code=204, **scope("objects:write"))
def delete_object(ctx: Ctx, id: ObjectId) -> None:
    """Delete an object, its trials, densities and sweeps; 409 while a sweep of it runs."""
    objects.remove(ctx.database, id)

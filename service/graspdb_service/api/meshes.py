"""An object's mesh and convex parts: raw bodies under ``/objects/{id}``."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response

from graspdb.wire import MeshInfo, PartsInfo
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import not_modified
from graspdb_service.api.routing.parameters import Ctx, ObjectId, RawBody
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.negotiation import BINARY, GLB, one_of
from graspdb_service.usecases.geometry import meshes

router = APIRouter(tags=["objects"], route_class=AdmittedRoute)

MeshUnit = Annotated[
    Literal["m", "mm", "cm", "in"], Query(description="Unit of the mesh's coordinates; kept in metres.")
]
_MESH_BODY = dict.fromkeys(meshes.MEDIA_TYPES, BINARY)


@router.put("/objects/{id}/mesh", **scope("objects:write", body=_MESH_BODY, work="meshes", large=True))
def put_mesh(ctx: Ctx, id: ObjectId, request: Request, body: RawBody, unit: MeshUnit = "m") -> MeshInfo:
    """Store the mesh: STL, OBJ, PLY or GLB as the raw body, said by Content-Type."""
    return meshes.put_mesh(ctx, id, body, media=one_of(request, *meshes.MEDIA_TYPES), unit=unit)


@router.get(
    "/objects/{id}/mesh",
    response_class=Response,
    responses={200: {"content": {media: {"schema": BINARY} for media in meshes.MEDIA_TYPES}}},
    **scope("read", "jobs:work"),
)
def get_mesh(ctx: Ctx, id: ObjectId, request: Request) -> Response:
    """The mesh's bytes as they came."""
    return _bytes(request, *meshes.get_mesh(ctx, id))


@router.put(
    "/objects/{id}/convex-parts", **scope("objects:write", body={GLB: BINARY}, work="meshes", large=True)
)
def put_convex_parts(ctx: Ctx, id: ObjectId, request: Request, body: RawBody) -> PartsInfo:
    """Store the convex parts: a GLB in metres with one geometry a part, object frame."""
    one_of(request, GLB)
    return meshes.put_parts(ctx, id, body)


@router.get(
    "/objects/{id}/convex-parts",
    response_class=Response,
    responses={200: {"content": {GLB: {"schema": BINARY}}}},
    **scope("read", "jobs:work"),
)
def get_convex_parts(ctx: Ctx, id: ObjectId, request: Request) -> Response:
    """The convex parts' bytes."""
    return _bytes(request, *meshes.get_parts(ctx, id))


def _bytes(request: Request, content: bytes, media: str, sha256: str) -> Response:
    tag = f'"{sha256}"'
    return not_modified(request, tag) or Response(content, media_type=media, headers={"ETag": tag})

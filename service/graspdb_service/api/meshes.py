"""An object's mesh and convex parts: raw bodies under ``/objects/{id}``."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response

from graspdb.wire import MeshInfo, PartsInfo
from graspdb_geometry.meshes import MAX_SCALE
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import not_modified
from graspdb_service.api.routing.parameters import Ctx, ObjectId, RawBody
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.negotiation import BINARY, GLB, one_of
from graspdb_service.usecases.geometry import meshes
from graspdb_service.usecases.geometry.mesh_form import MeshForm

router = APIRouter(tags=["objects"], route_class=AdmittedRoute)

MeshUnit = Annotated[
    Literal["m", "mm", "cm", "in"], Query(description="Unit of the mesh's coordinates; kept in metres.")
]
MeshScale = Annotated[
    float,
    Query(
        gt=0,
        le=MAX_SCALE,
        description="Factor to the mesh's coordinates beside their unit, such as ACRONYM's `object/scale`.",
    ),
]
_MESH_BODY = dict.fromkeys(meshes.MEDIA_TYPES, BINARY)


@router.put("/objects/{id}/mesh", **scope("objects:write", body=_MESH_BODY, work="meshes", large=True))
def put_mesh(
    ctx: Ctx, id: ObjectId, request: Request, body: RawBody, unit: MeshUnit = "m", scale: MeshScale = 1.0
) -> MeshInfo:
    """Store the mesh: STL, OBJ, PLY or GLB as the raw body, said by Content-Type."""
    form = MeshForm(one_of(request, *meshes.MEDIA_TYPES), unit, scale)
    return meshes.put_mesh(ctx, id, body, form=form)


@router.get(
    "/objects/{id}/mesh",
    response_class=Response,
    responses={
        200: {
            "content": {media: {"schema": BINARY} for media in meshes.MEDIA_TYPES},
            "headers": {
                "Mesh-Unit": {"schema": {"type": "string"}, "description": "Unit of its coordinates."},
                "Mesh-Scale": {"schema": {"type": "number"}, "description": "Factor to them beside it."},
            },
        }
    },
    **scope("read", "jobs:work"),
)
def get_mesh(
    ctx: Ctx,
    id: ObjectId,
    request: Request,
    triangles: Annotated[
        bool,
        Query(description="What the service made of it instead, mended and in metres: binary STL."),
    ] = False,
) -> Response:
    """The mesh's bytes as they came, with unit and scale in headers: together they are metres."""
    content, form, sha256 = meshes.get_mesh(ctx, id)
    tag = f'"{sha256}-{form.unit}-{form.scale!r}{"-triangles" if triangles else ""}"'
    unchanged = not_modified(request, tag)
    if unchanged is not None:
        return unchanged
    if triangles:
        content, form = meshes.as_stl(ctx, content, form), MeshForm("model/stl")
    headers = {"ETag": tag, "Mesh-Unit": form.unit, "Mesh-Scale": repr(form.scale)}
    return Response(content, media_type=form.media_type, headers=headers)


@router.put(
    "/objects/{id}/convex-parts", **scope("objects:write", body={GLB: BINARY}, work="meshes", large=True)
)
def put_convex_parts(
    ctx: Ctx,
    id: ObjectId,
    request: Request,
    body: RawBody,
    accept_deviation: Annotated[
        bool, Query(description="Store parts, too, that lie too far from the mesh to stand for it.")
    ] = False,
) -> PartsInfo:
    """Store the convex parts: a GLB in metres with one geometry a part, object frame.

    They are what sweeps simulate. Parts more than 1 mm and 1 % of the longest side off a closed mesh, or with
    another volume by more than 5 %, are refused (`convex-parts-deviate`).
    """
    one_of(request, GLB)
    return meshes.put_parts(ctx, id, body, accept_deviation=accept_deviation)


@router.get(
    "/objects/{id}/convex-parts",
    response_class=Response,
    responses={200: {"content": {GLB: {"schema": BINARY}}}},
    **scope("read", "jobs:work"),
)
def get_convex_parts(ctx: Ctx, id: ObjectId, request: Request) -> Response:
    """The convex parts' bytes."""
    content, media, sha256 = meshes.get_parts(ctx, id)
    tag = f'"{sha256}"'
    return not_modified(request, tag) or Response(content, media_type=media, headers={"ETag": tag})

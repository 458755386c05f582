"""Pictures of objects and of grasps: ``/objects/{id}/picture``."""

from __future__ import annotations

import importlib.util
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from graspdb.wire.queries import PictureQuery
from graspdb_service import __version__
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import etag, not_modified
from graspdb_service.api.routing.parameters import Ctx, ObjectId
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.negotiation import BINARY, PNG
from graspdb_service.problems import ProblemError

router = APIRouter(tags=["objects"], route_class=AdmittedRoute)


@router.get(
    "/objects/{id}/picture",
    response_class=Response,
    responses={200: {"content": {PNG: {"schema": BINARY}}}},
    **scope("read", work="queries"),
)
def get_picture(
    ctx: Ctx, id: ObjectId, request: Request, query: Annotated[PictureQuery, Query()]
) -> Response:
    """A picture (PNG) of the object's mesh, and of the gripper at a grasp where a pose is given.

    Its tag changes with mesh, gripper and question alone, not with trials.
    """
    if not all(map(importlib.util.find_spec, ("embreex", "PIL"))):
        raise ProblemError(
            406,
            "pictures-not-installed",
            "Pictures need Embree and Pillow on the server: pip install 'graspdb[pictures]'",
        )
    asked = ctx.pictures.asked(id, query)
    tag = etag(*asked.tag, __version__)
    seen = not_modified(request, tag)
    return seen or Response(ctx.pictures.png(asked), media_type=PNG, headers={"ETag": tag})

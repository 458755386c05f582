"""What a robot reaches about an object: ``/objects/{id}/reach``."""

from __future__ import annotations

from fastapi import APIRouter

from graspdb.wire import ReachMap, ReachRequest
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.parameters import Ctx, ObjectId
from graspdb_service.api.routing.scopes import scope
from graspdb_service.usecases.answers.reaching import reach_map

router = APIRouter(tags=["queries"], route_class=AdmittedRoute)


@router.post("/objects/{id}/reach", **scope("read", work="queries"))
def post_reach(ctx: Ctx, id: ObjectId, request: ReachRequest) -> ReachMap:
    """Which of many grasps a robot's arm takes where it stands, and why not the others.

    Beside that, how many of them it takes from other places of its base.
    """
    return reach_map(ctx, id, request)

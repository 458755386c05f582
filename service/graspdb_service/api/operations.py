"""Operations: liveness, readiness, metrics, versions and limits."""

from __future__ import annotations

import platform
from typing import Any

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from graspdb_service import __version__
from graspdb_service.api.access.guard import GuardedRoute
from graspdb_service.api.routing.gauges import Gauges
from graspdb_service.api.routing.parameters import Ctx
from graspdb_service.api.routing.scopes import scope
from graspdb_service.settings import Settings

router = APIRouter(tags=["operations"], route_class=GuardedRoute)


@router.get("/livez", **scope("public"))
async def livez() -> dict[str, str]:
    """The process runs. Async, so that no computation keeps it waiting."""
    return {"status": "alive"}


@router.get("/readyz", **scope("public"))
async def readyz(ctx: Ctx) -> dict[str, Any]:
    """The database can be worked with: its schema, its file, the disk and a write were looked at `age_s` ago.

    503 where the last look found something wrong, or is too long ago. This request itself looks at nothing.
    """
    return ctx.health.ready()


@router.get("/metrics", **scope("public"), response_class=Response)
def metrics(ctx: Ctx) -> Response:
    """Prometheus metrics of this process."""
    own = generate_latest(Gauges(ctx).registry)
    return Response(generate_latest() + own, media_type=CONTENT_TYPE_LATEST)


@router.get("/info", **scope("public"))
def info(ctx: Ctx) -> dict[str, Any]:
    """Versions and limits."""
    settings = ctx.settings
    names = [name for name in Settings.model_fields if name.startswith(("max_", "min_"))]
    return {
        "version": __version__,
        "python": platform.python_version(),
        "database": ctx.database.url.get_backend_name(),
        "limits": {name: getattr(settings, name) for name in names},
        "retention_days": {
            name: getattr(settings, f"keep_{name}_days")
            for name in ("idempotency", "audit", "trials", "workers")
        },
        "lease_s": settings.lease_s,
        "chunk_poses": settings.chunk_poses,
    }

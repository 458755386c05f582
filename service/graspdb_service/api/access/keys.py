"""Keys and the audit: ``/keys``, ``/audit``."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response
from pydantic import AfterValidator

from graspdb.wire import Page, Slug
from graspdb.wire.access.audit import AuditAction, AuditEntry
from graspdb.wire.access.keys import KeyCreate, KeyInfo, KeyMade, KeyRotate
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.cursors import Cursor, Limit, encode_cursor, number_cursor
from graspdb_service.api.routing.parameters import Ctx
from graspdb_service.api.routing.scopes import scope
from graspdb_service.usecases.access import audit, keys

router = APIRouter(tags=["access"], route_class=AdmittedRoute)

KeyId = Annotated[
    str, Path(description="Id of the key, as making it answered it.", json_schema_extra={"maxLength": 200})
]


def _in_utc(at: datetime) -> datetime:
    try:
        return at.replace(tzinfo=timezone.utc) if at.tzinfo is None else at.astimezone(timezone.utc)
    except OverflowError:
        raise ValueError("no time that there is in UTC") from None


_Time = Annotated[datetime, AfterValidator(_in_utc)]


@router.post("/keys", status_code=201, **scope("admin"))
def create_key(ctx: Ctx, request: KeyCreate, response: Response) -> KeyMade:
    """Make a key. What to send is in the answer and nowhere else; no Idempotency-Key keeps it either."""
    _uncached(response)
    return keys.create(ctx.database, request)


@router.get("/keys", **scope("admin"))
def list_keys(ctx: Ctx, limit: Limit = 100, cursor: Cursor = None) -> Page[KeyInfo]:
    """The keys, oldest first, those that open nothing any more included."""
    items, after = keys.page(ctx.database, after=number_cursor(cursor), limit=limit)
    return Page(items=items, next=encode_cursor(after))


@router.post("/keys/{id}/rotate", **scope("admin"))
def rotate_key(ctx: Ctx, id: KeyId, request: KeyRotate, response: Response) -> KeyMade:
    """Give a key another secret under its id and name; the old one works on for ``overlap_s``."""
    _uncached(response)
    made = keys.rotate(ctx.database, id, request)
    ctx.keys.forget(id)
    return made


@router.delete("/keys/{id}", status_code=204, **scope("admin"))
def revoke_key(ctx: Ctx, id: KeyId) -> None:
    """Revoke a key: at once in this process, within two seconds in every other."""
    keys.revoke(ctx.database, id)
    ctx.keys.forget(id)


@router.get("/audit", **scope("admin"))
def list_audit(
    ctx: Ctx,
    object: Annotated[Slug | None, Query(description="Of this object only; by default of all.")] = None,
    key: Annotated[Slug | None, Query(description="By the key of this id or name; by default all.")] = None,
    action: Annotated[AuditAction | None, Query(description="What was done; by default anything.")] = None,
    since: Annotated[_Time | None, Query(description="From this time on, UTC; by default all.")] = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[AuditEntry]:
    """What was changed and which key did it, the newest first."""
    before = number_cursor(cursor) or None
    items, following = audit.page(
        ctx.database, before=before, limit=limit, object=object, key=key, action=action, since=since
    )
    return Page(items=items, next=encode_cursor(following))


def _uncached(response: Response) -> None:
    response.headers["Cache-Control"] = "no-store"

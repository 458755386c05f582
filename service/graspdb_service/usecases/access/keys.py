"""Keys: made, listed, rotated and revoked. A secret is told once and never stored."""

from __future__ import annotations

import hashlib
import re
import secrets
from datetime import datetime, timedelta

from graspdb.wire.access.keys import KeyCreate, KeyInfo, KeyMade, KeyRotate
from graspdb_service import principal
from graspdb_service.problems import conflict, found, invalid
from graspdb_service.storage.access import audit, keys
from graspdb_service.storage.access.keys import KeyRow
from graspdb_service.storage.database import Database, Tx, clock

#: What is sent: what it is, whose, and 256 random bits. The id finds the row, the whole is compared by hash.
_SENT = re.compile(r"graspdb_([0-9a-f]{12})_[A-Za-z0-9_-]{43}")


def create(database: Database, request: KeyCreate) -> KeyMade:
    """Make a key; 409 where a living one has its name, 422 for an admin limited to some objects."""
    if request.objects is not None and "admin" in request.scopes:
        raise invalid("objects", "an admin makes keys for any object: it can't be limited to some")
    id, sent = _secret(secrets.token_hex(6))
    values = {
        **request.model_dump(exclude={"scopes", "expires_days"}),
        "id": id,
        "sha256": digest(sent),
        "scopes": sorted(set(request.scopes)),
        "created_by": principal.actor().key,
    }
    with database.write() as tx:
        if not keys.create(tx, {**values, "expires_at": _expiry(clock(tx), request.expires_days)}):
            raise conflict(
                "already-exists",
                f"There is a key {request.name!r} already: choose another name, or revoke or rotate that one",
            )
        audit.record(tx, "key.create", subject=id)
        return _made(tx, id, sent)


def page(database: Database, *, after: int, limit: int) -> tuple[list[KeyInfo], int | None]:
    """A page of keys in the order of their making, and where the next one starts."""
    with database.read() as tx:
        rows, now = keys.page(tx, after=after, limit=limit + 1), clock(tx)
    return [_info(row, now) for row in rows[:limit]], rows[limit - 1].number if len(rows) > limit else None


def rotate(database: Database, id: str, request: KeyRotate) -> KeyMade:
    """Give a key another secret; the old one works on for the overlap. 409 for a key that opens nothing."""
    _, sent = _secret(id)
    with database.write() as tx:
        row, now = require(tx, id), clock(tx)
        expires = _expiry(now, request.expires_days) or row.expires_at
        if row.revoked_at is not None:
            raise conflict("key-unusable", f"Key {id} is revoked: make another one")
        if expires is not None and expires <= now:
            raise conflict("key-unusable", f"Key {id} has expired: say with expires_days until when it lives")
        overlaps = request.overlap_s > 0
        values = {
            "sha256": digest(sent),
            "previous_sha256": row.sha256 if overlaps else None,
            "previous_until": now + timedelta(seconds=request.overlap_s) if overlaps else None,
            "expires_at": expires,
        }
        keys.change(tx, id, values)
        audit.record(tx, "key.rotate", subject=id)
        return _made(tx, id, sent)


def revoke(database: Database, id: str) -> None:
    """Let a key open nothing any more (404); nothing where it is revoked already."""
    with database.write() as tx:
        require(tx, id)
        if keys.change(tx, id, {"revoked_at": clock(tx)}):
            audit.record(tx, "key.revoke", subject=id)


def require(tx: Tx, id: str) -> KeyRow:
    """The key, or a 404."""
    row = keys.find(tx, id) if re.fullmatch("[0-9a-f]{12}", id) else None
    return found(row, "key", id, "GET /keys lists them")


def id_in(sent: str) -> str | None:
    """The id in what was sent as a key; None where it can't be one."""
    match = _SENT.fullmatch(sent)
    return None if match is None else match[1]


def digest(sent: str) -> str:
    """What is stored of a key."""
    return hashlib.sha256(sent.encode()).hexdigest()


def _info(row: KeyRow, now: datetime) -> KeyInfo:
    has_expired = row.expires_at is not None and row.expires_at <= now
    state = "revoked" if row.revoked_at is not None else "expired" if has_expired else "usable"
    return KeyInfo.model_validate({**vars(row), "state": state})


def _made(tx: Tx, id: str, sent: str) -> KeyMade:
    return KeyMade(**_info(require(tx, id), clock(tx)).model_dump(), key=sent)


def _secret(id: str) -> tuple[str, str]:
    """An id, and a fresh key of it."""
    return id, f"graspdb_{id}_{secrets.token_urlsafe(32)}"


def _expiry(now: datetime, days: int | None) -> datetime | None:
    return None if days is None else now + timedelta(days=days)

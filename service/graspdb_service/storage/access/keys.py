"""Keys: what is stored of them, which is never the secret but its SHA-256."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, Select, exists, or_, select, update

from graspdb_service.storage.database import Tx, all_as, first_as, insert_new, insert_or, utc_now
from graspdb_service.storage.tables import api_keys, key_uses


@dataclass(frozen=True)
class KeyRow:
    """A key as stored. ``previous_sha256``, that of the secret before the last rotation, is good until
    ``previous_until``.
    """

    number: int
    id: str
    name: str
    sha256: str
    previous_sha256: str | None
    previous_until: datetime | None
    scopes: list[str]
    objects: str | None
    requests_per_s: float | None
    burst: int | None
    created_at: datetime
    created_by: str | None
    expires_at: datetime | None
    revoked_at: datetime | None
    last_used_at: datetime | None


def create(tx: Tx, values: Mapping[str, Any]) -> bool:
    """Insert a key; False where a key of this name is not revoked."""
    return insert_new(tx, api_keys, **values, created_at=utc_now())


def find(tx: Tx, id: str) -> KeyRow | None:
    """The key with this id, revoked or not."""
    return first_as(tx, _query().where(api_keys.c.id == id), KeyRow)


def page(tx: Tx, *, after: int, limit: int) -> list[KeyRow]:
    """Up to ``limit`` keys in the order of their making, from the one after the number ``after``."""
    query = _query().where(api_keys.c.number > after).order_by(api_keys.c.number).limit(limit)
    return all_as(tx, query, KeyRow)


def any_usable(tx: Tx) -> bool:
    """Whether there is a key that opens anything."""
    return bool(tx.scalar(select(exists().where(_alive()))))


def change(tx: Tx, id: str, values: Mapping[str, Any]) -> bool:
    """Set columns of a key; False where there is none, or it is revoked."""
    living = api_keys.c.id == id, api_keys.c.revoked_at.is_(None)
    return bool(tx.execute(update(api_keys).where(*living).values(dict(values))).rowcount)


def note_uses(tx: Tx, used: Collection[str]) -> None:
    """Keep that keys are in use now, in a table of its own so that nobody waits for a key's row."""
    for id in sorted(used):
        known = select(api_keys.c.id).where(api_keys.c.id == id)
        if tx.scalar(known) is None:
            continue
        statement = insert_or(tx, key_uses).values(key_id=id, last_used_at=utc_now())
        tx.execute(
            statement.on_conflict_do_update(
                index_elements=[key_uses.c.key_id],
                set_={"last_used_at": statement.excluded.last_used_at},
            )
        )


def _query() -> Select[Any]:
    return select(api_keys, key_uses.c.last_used_at).select_from(
        api_keys.outerjoin(key_uses, key_uses.c.key_id == api_keys.c.id)
    )


def _alive() -> ColumnElement[bool]:
    expires = or_(api_keys.c.expires_at.is_(None), api_keys.c.expires_at > utc_now())
    return api_keys.c.revoked_at.is_(None) & expires

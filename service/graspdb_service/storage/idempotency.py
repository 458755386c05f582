"""Idempotency keys: what was answered to a creating request, kept in the transaction that created."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import select, update

from graspdb_service.storage.database import Tx, first_as, insert_new, utc_now
from graspdb_service.storage.tables import idempotency_keys


@dataclass(frozen=True)
class Remembered:
    """An earlier request under the same key, and its answer."""

    request_sha256: str
    status: int
    location: str | None
    answer: Any
    revoked: bool


def claim(tx: Tx, scope: str, key: str, request_sha256: str) -> Remembered | None:
    """Take the key, or return the request that has it.

    Of two transactions claiming the same key at once the second waits here until the first has ended:
    PostgreSQL at the unique index, SQLite at BEGIN IMMEDIATE.
    """
    fresh = {"request_sha256": request_sha256, "status": 0, "answer": None, "revoked": False}
    if insert_new(tx, idempotency_keys, scope=scope, key=key, **fresh, created_at=utc_now()):
        return None
    found = find(tx, scope, key)
    assert found is not None
    return found


def find(tx: Tx, scope: str, key: str) -> Remembered | None:
    """The request that has a key."""
    columns = (idempotency_keys.c[name] for name in Remembered.__dataclass_fields__)
    query = select(*columns).where(idempotency_keys.c.scope == scope, idempotency_keys.c.key == key)
    return first_as(tx, query, Remembered)


def remember(
    tx: Tx,
    scope: str,
    key: str,
    *,
    status: int,
    location: str | None,
    answer: Any,
    batch_key: str | None,
) -> None:
    """Complete a claimed key with the answer; ``batch_key`` revokes it when that batch is deleted."""
    tx.execute(
        update(idempotency_keys)
        .where(idempotency_keys.c.scope == scope, idempotency_keys.c.key == key)
        .values(status=status, location=location, answer=answer, batch_key=batch_key)
    )

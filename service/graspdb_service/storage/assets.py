"""Meshes and convex parts by their SHA-256: stored once, whoever uses them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

from sqlalchemy import delete, exists, or_, select
from sqlalchemy.exc import IntegrityError

from graspdb_service.storage.database import Tx, insert_or, utc_now
from graspdb_service.storage.tables import assets, objects


def put(tx: Tx, content: bytes, media_type: str) -> str:
    """Store bytes unless they are there already; returns their SHA-256."""
    sha256 = hashlib.sha256(content).hexdigest()
    values = {"sha256": sha256, "media_type": media_type, "content": content, "created_at": utc_now()}
    # An update that changes nothing still locks a row that exists: nobody drops it before we refer to it.
    tx.execute(
        insert_or(tx, assets)
        .values(values)
        .on_conflict_do_update(index_elements=[assets.c.sha256], set_={"created_at": assets.c.created_at})
    )
    return sha256


def get(tx: Tx, sha256: str) -> tuple[bytes, str] | None:
    """The bytes and their media type."""
    row = tx.execute(select(assets.c.content, assets.c.media_type).where(assets.c.sha256 == sha256)).first()
    return None if row is None else (bytes(row.content), str(row.media_type))


def drop_unused(tx: Tx, hashes: Iterable[str]) -> None:
    """Delete those of the assets that no object refers to any more."""
    for sha256 in hashes:
        used = exists().where(or_(objects.c.mesh_sha256 == sha256, objects.c.parts_sha256 == sha256))
        try:
            with tx.begin_nested():
                tx.execute(delete(assets).where(assets.c.sha256 == sha256, ~used))
        except IntegrityError:
            # Another transaction has just begun to use it: then it stays.
            continue

"""Stored kernels."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Row, delete, insert, select

from graspdb_service.storage.database import Tx
from graspdb_service.storage.tables import kernels


@dataclass(frozen=True)
class KernelRow:
    """A kernel as stored: components and provenance as :mod:`graspdb.wire.kernels` has them."""

    number: int
    id: str
    kind: str
    alignment: str
    gripper: str | None
    object_id: int | None
    components: list[dict[str, Any]]
    provenance: dict[str, Any]
    created_at: datetime


def create(
    tx: Tx,
    id: str,
    *,
    kind: str,
    alignment: str,
    gripper: str | None,
    object_id: int | None,
    components: list[dict[str, Any]],
    provenance: dict[str, Any],
) -> KernelRow:
    """Insert a kernel."""
    statement = (
        insert(kernels)
        .values(
            id=id,
            kind=kind,
            alignment=alignment,
            gripper=gripper,
            object_id=object_id,
            components=components,
            provenance=provenance,
            created_at=datetime.now(UTC),
        )
        .returning(*kernels.c)
    )
    return _kernel(tx.execute(statement).one())


def find(tx: Tx, id: str) -> KernelRow | None:
    """The kernel with this id."""
    row = tx.execute(select(kernels).where(kernels.c.id == id)).first()
    return None if row is None else _kernel(row)


def newest(tx: Tx, object_id: int, gripper: str | None) -> str | None:
    """Id of the anisotropic kernel fitted last on this object's trials with this gripper."""
    query = (
        select(kernels.c.id)
        .where(
            kernels.c.object_id == object_id,
            kernels.c.gripper.is_not_distinct_from(gripper),
            kernels.c.kind == "anisotropic",
        )
        .order_by(kernels.c.number.desc())
        .limit(1)
    )
    found: str | None = tx.execute(query).scalar()
    return found


def page(tx: Tx, *, after: int, limit: int, object_id: int | None, gripper: str | None) -> list[KernelRow]:
    """Up to ``limit`` kernels in the order they were made, from the one after ``after``."""
    query = select(kernels).where(kernels.c.number > after).order_by(kernels.c.number).limit(limit)
    if object_id is not None:
        query = query.where(kernels.c.object_id == object_id)
    if gripper is not None:
        query = query.where(kernels.c.gripper == gripper)
    return [_kernel(row) for row in tx.execute(query)]


def remove(tx: Tx, id: str) -> bool:
    """Delete a kernel; False where there is none."""
    return bool(tx.execute(delete(kernels).where(kernels.c.id == id)).rowcount)


def _kernel(row: Row[Any]) -> KernelRow:
    return KernelRow(**row._mapping)

"""Stored kernels."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import delete, insert, select

from graspdb_service.storage.database import Tx, all_as, first_as, utc_now
from graspdb_service.storage.tables import kernels
from graspdb_service.trial_columns import gripper_parts


@dataclass(frozen=True, kw_only=True)
class NewKernel:
    """A kernel to store: components and provenance as :mod:`graspdb.wire.kernels` has them.

    ``gripper`` is its id, or one version of it, as in ``panda@1``.
    """

    kind: str
    alignment: str
    gripper: str | None
    object_id: int | None
    components: list[dict[str, Any]]
    provenance: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class KernelRow(NewKernel):
    """A kernel as stored."""

    number: int
    id: str
    created_at: datetime


def create(tx: Tx, id: str, kernel: NewKernel) -> KernelRow:
    """Insert a kernel."""
    values = {**vars(kernel), **_gripper_columns(kernel.gripper)}
    statement = insert(kernels).values(id=id, **values, created_at=utc_now())
    return _row(**tx.execute(statement.returning(*kernels.c)).one()._mapping)


def find(tx: Tx, id: str) -> KernelRow | None:
    """The kernel with this id."""
    return first_as(tx, select(kernels).where(kernels.c.id == id), _row)


def newest(tx: Tx, object_id: int, gripper: str | None) -> KernelRow | None:
    """The anisotropic kernel fitted last on this object's trials with this gripper."""
    query = (
        select(kernels)
        .where(
            kernels.c.object_id == object_id,
            *(
                kernels.c[column].is_not_distinct_from(value)
                for column, value in _gripper_columns(gripper).items()
            ),
            kernels.c.kind == "anisotropic",
        )
        .order_by(kernels.c.number.desc())
        .limit(1)
    )
    return first_as(tx, query, _row)


def page(tx: Tx, *, after: int, limit: int, object_id: int | None, gripper: str | None) -> list[KernelRow]:
    """Up to ``limit`` kernels in the order they were made, from the one after ``after``."""
    query = select(kernels).where(kernels.c.number > after).order_by(kernels.c.number).limit(limit)
    if object_id is not None:
        query = query.where(kernels.c.object_id == object_id)
    if gripper is not None:
        gripper, version = gripper_parts(gripper)
        query = query.where(kernels.c.gripper == gripper)
        if version is not None:
            query = query.where(kernels.c.gripper_version == version)
    return all_as(tx, query, _row)


def _gripper_columns(name: str | None) -> dict[str, str | int | None]:
    gripper, version = (None, None) if name is None else gripper_parts(name)
    return {"gripper": gripper, "gripper_version": version}


def _row(*, gripper: str | None, gripper_version: int | None, **columns: Any) -> KernelRow:
    name = gripper if gripper_version is None else f"{gripper}@{gripper_version}"
    return KernelRow(gripper=name, **columns)


def remove(tx: Tx, id: str) -> bool:
    """Delete a kernel; False where there is none."""
    return bool(tx.execute(delete(kernels).where(kernels.c.id == id)).rowcount)

"""Gripper profiles: the built-in ones and the user's, every version of each.

A name is an id, which stands for the newest version, or one version, as in ``panda@1``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Select, and_, delete, exists, func, insert, or_, select, update

from graspdb_service.storage.database import Tx, all_as, first_as, insert_new, utc_now
from graspdb_service.storage.tables import (
    gripper_versions,
    grippers,
    kernels,
    provenances,
    sweeps,
    trials,
)
from graspdb_service.trial_columns import gripper_parts

_OTHERS = gripper_versions.alias("others")
_NEWEST = (
    select(func.max(_OTHERS.c.version))
    .where(_OTHERS.c.gripper == grippers.c.id)
    .correlate(grippers)
    .scalar_subquery()
)


@dataclass(frozen=True)
class GripperRow:
    """A version of a gripper as stored; ``profile`` is a :class:`graspdb.wire.GripperProfile` as JSON.

    ``version_id`` is internal and never reused, whatever becomes of the gripper.
    """

    id: str
    name: str | None
    builtin: bool
    created_at: datetime
    version_id: int
    version: int
    profile: dict[str, Any]
    changed: list[str] | None
    version_created_at: datetime
    newest_version: int

    @property
    def versioned(self) -> str:
        """The name of this version."""
        return f"{self.id}@{self.version}"


def _query() -> Select[Any]:
    return select(
        *grippers.c,
        gripper_versions.c.id.label("version_id"),
        gripper_versions.c.version,
        gripper_versions.c.profile,
        gripper_versions.c.changed,
        gripper_versions.c.created_at.label("version_created_at"),
        _NEWEST.label("newest_version"),
    ).join(gripper_versions, gripper_versions.c.gripper == grippers.c.id)


def find(tx: Tx, name: str) -> GripperRow | None:
    """The gripper of this name."""
    gripper, version = gripper_parts(name)
    which = gripper_versions.c.version == (_NEWEST if version is None else version)
    return first_as(tx, _query().where(grippers.c.id == gripper, which), GripperRow)


def version_id(tx: Tx, name: str) -> int | None:
    """The internal id of what a name stands for now; None where it stands for nothing."""
    gripper, version = gripper_parts(name)
    query = select(gripper_versions.c.id).where(gripper_versions.c.gripper == gripper)
    if version is not None:
        query = query.where(gripper_versions.c.version == version)
    found: int | None = tx.scalar(query.order_by(gripper_versions.c.version.desc()).limit(1))
    return found


def versions(tx: Tx, gripper: str, *, after: int, limit: int) -> list[GripperRow]:
    """Up to ``limit`` versions of a gripper, the first one first, from the one after ``after``."""
    query = _query().where(grippers.c.id == gripper, gripper_versions.c.version > after)
    return all_as(tx, query.order_by(gripper_versions.c.version).limit(limit), GripperRow)


def profiles(tx: Tx, gripper: str, numbers: Collection[int]) -> dict[int, dict[str, Any]]:
    """Profiles of these versions of a gripper."""
    query = select(gripper_versions.c.version, gripper_versions.c.profile).where(
        gripper_versions.c.gripper == gripper, gripper_versions.c.version.in_(sorted(numbers))
    )
    return {int(number): profile for number, profile in tx.execute(query)}


def held(tx: Tx, names: Iterable[str]) -> Mapping[str, str]:
    """The version that each name stands for, as in ``panda@1``, without names that stand for nothing.

    None of these grippers is deleted before the transaction ends.
    """
    wanted = {gripper_parts(name)[0] for name in names}
    if not wanted:
        return {}
    # In one order, though holders of a key share never wait for each other.
    query = select(grippers.c.id).where(grippers.c.id.in_(sorted(wanted))).order_by(grippers.c.id)
    tx.execute(query.with_for_update(read=True, key_share=True)).all()
    found = {name: find(tx, name) for name in sorted(set(names))}
    return {name: row.versioned for name, row in found.items() if row is not None}


def first_versions(tx: Tx, ids: Collection[str]) -> dict[str, GripperRow]:
    """The first versions of those of these grippers that are stored."""
    query = _query().where(grippers.c.id.in_(sorted(ids)), gripper_versions.c.version == 1)
    return {row.id: row for row in all_as(tx, query, GripperRow)}


def complete(tx: Tx, gripper: str, profile: dict[str, Any]) -> None:
    """Store what a gripper's first version lacks; nothing that a grasp depends on may change by it."""
    which = (gripper_versions.c.gripper == gripper, gripper_versions.c.version == 1)
    tx.execute(update(gripper_versions).where(*which).values(profile=profile))


def page(tx: Tx, *, after: str, limit: int) -> list[GripperRow]:
    """Up to ``limit`` grippers, the newest version of each, in the order of their ids from the one after
    ``after``.
    """
    query = _query().where(grippers.c.id > after, gripper_versions.c.version == _NEWEST)
    return all_as(tx, query.order_by(grippers.c.id).limit(limit), GripperRow)


def create(tx: Tx, gripper: str, name: str | None, profile: dict[str, Any], *, builtin: bool = False) -> bool:
    """Insert a gripper with its first version; False where the id is taken."""
    now = utc_now()
    if not insert_new(tx, grippers, id=gripper, name=name, builtin=builtin, created_at=now):
        return False
    add_version(tx, gripper, 1, profile, None)
    return True


def lock(tx: Tx, gripper: str, *, deleting: bool = False) -> None:
    """Hold a gripper until the transaction ends, so that no other version of it is added; ``deleting``: and
    no trial of it either.
    """
    query = select(grippers.c.id).where(grippers.c.id == gripper)
    tx.execute(query.with_for_update(key_share=not deleting)).all()


def add_version(
    tx: Tx, gripper: str, version: int, profile: dict[str, Any], changed: Sequence[str] | None
) -> None:
    """Insert a version of a gripper, under its lock."""
    values = {"gripper": gripper, "version": version, "profile": profile, "created_at": utc_now()}
    told = None if changed is None else list(changed)
    tx.execute(insert(gripper_versions).values(**values, changed=told))


def rename(tx: Tx, gripper: str, name: str) -> None:
    """Give a gripper another name for people."""
    tx.execute(update(grippers).where(grippers.c.id == gripper).values(name=name))


def is_used(tx: Tx, gripper: str) -> bool:
    """Whether trials, sweeps or kernels name the gripper, any version of it; under its lock."""
    own = and_(trials.c.object_id == provenances.c.object_id, trials.c.provenance_id == provenances.c.id)
    query = select(
        or_(
            exists().where(sweeps.c.gripper == gripper),
            exists().where(kernels.c.gripper == gripper),
            exists().where(provenances.c.gripper == gripper, own),
        )
    )
    return bool(tx.scalar(query))


def remove(tx: Tx, gripper: str) -> None:
    """Delete a gripper that is not used, with its versions and what is left of those that used it; under
    its lock.
    """
    tx.execute(delete(provenances).where(provenances.c.gripper == gripper))
    tx.execute(delete(grippers).where(grippers.c.id == gripper))

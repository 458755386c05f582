"""Objects: their rows, which are their locks, and the revision and sequence numbers they hand out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import and_, delete, exists, or_, select, update

from graspdb_service.storage.database import Tx, all_as, begins_with, first_as, insert_new, utc_now
from graspdb_service.storage.simulation.jobs import OPEN
from graspdb_service.storage.tables import batches, idempotency_keys, jobs, objects, sweeps, trials


class ObjectGone(LookupError):
    """The object was deleted between two statements of this transaction."""


@dataclass(frozen=True)
class ObjectRow:
    """An object as stored; ``id`` is internal and never reused, ``slug`` the user's."""

    id: int
    slug: str
    name: str | None
    mass_kg: float | None
    density_kg_m3: float | None
    friction: float | None
    metadata: dict[str, Any] | None
    revision: int
    epoch: int
    last_seq: int
    mesh_sha256: str | None
    mesh_info: dict[str, Any] | None
    parts_sha256: str | None
    parts_info: dict[str, Any] | None
    created_at: datetime
    updated_at: datetime
    copied_from: dict[str, Any] | None
    quality_names: list[str] | None
    frames: dict[str, Any] | None


def create(tx: Tx, slug: str, properties: Mapping[str, Any]) -> bool:
    """Insert an object with these column values; False where the slug is taken."""
    now = utc_now()
    values = {"slug": slug, "revision": 0, "epoch": 0, "last_seq": 0, "created_at": now, "updated_at": now}
    return insert_new(tx, objects, **{**properties, **values})


def find(tx: Tx, slug: str, *, lock: bool = False) -> ObjectRow | None:
    """The object with this slug; ``lock`` holds its row until the transaction ends."""
    query = select(objects).where(objects.c.slug == slug)
    return first_as(tx, query.with_for_update() if lock else query, ObjectRow)


def page(tx: Tx, *, after: str, limit: int, prefix: str = "") -> list[ObjectRow]:
    """Up to ``limit`` objects whose slugs begin so, in the order of slugs, from the one after ``after``."""
    query = select(objects).where(objects.c.slug > after).order_by(objects.c.slug).limit(limit)
    if prefix:
        query = query.where(begins_with(objects.c.slug, prefix))
    return all_as(tx, query, ObjectRow)


def advance(tx: Tx, object_id: int, *, rows: int = 0, append: bool) -> tuple[int, int]:
    """Lock the object, give it a new revision, reserve ``rows`` sequence numbers: the revision, their first.

    ``append`` where trials are only added; anything else starts a new epoch, for what was derived from the
    object can't be extended then. ObjectGone without the object.
    """
    revision = objects.c.revision + 1
    statement = (
        update(objects)
        .where(objects.c.id == object_id)
        .values(
            revision=revision,
            epoch=objects.c.epoch if append else revision,
            last_seq=objects.c.last_seq + rows,
            updated_at=utc_now(),
        )
        .returning(objects.c.revision, objects.c.last_seq)
    )
    row = tx.execute(statement).first()
    if row is None:
        raise ObjectGone(f"object {object_id} was deleted")
    return int(row.revision), int(row.last_seq) - rows + 1


def change(tx: Tx, object_id: int, values: Mapping[str, Any]) -> None:
    """Set columns of an object; call :func:`advance` in the same transaction."""
    if values:
        tx.execute(update(objects).where(objects.c.id == object_id).values(dict(values)))


def has_running_sweep(tx: Tx, object_id: int, *, sweep_id: str | None = None) -> bool:
    """Whether a sweep of the object (or the one named) still has chunks to simulate."""
    which = sweeps.c.object_id == object_id if sweep_id is None else sweeps.c.id == sweep_id
    open_jobs = and_(jobs.c.sweep_id == sweeps.c.id, jobs.c.state.in_(OPEN))
    query = select(exists().where(which, sweeps.c.cancelled.is_(False), open_jobs))
    return bool(tx.execute(query).scalar_one())


def has_sweeps(tx: Tx, object_id: int) -> bool:
    """Whether any sweep of the object exists, whatever became of it."""
    return bool(tx.execute(select(exists().where(sweeps.c.object_id == object_id))).scalar_one())


def remove(tx: Tx, row: ObjectRow) -> None:
    """Delete an object and all that hangs on it; its idempotency keys are revoked, not forgotten."""
    keys = select(batches.c.key).where(batches.c.object_id == row.id)
    place = f"/objects/{row.slug}"
    owned = or_(
        idempotency_keys.c.batch_key.in_(keys),
        idempotency_keys.c.location == place,
        idempotency_keys.c.location.startswith(place + "/", autoescape=True),
    )
    tx.execute(update(idempotency_keys).where(owned).values(revoked=True))
    tx.execute(delete(trials).where(trials.c.object_id == row.id))
    tx.execute(delete(objects).where(objects.c.id == row.id))

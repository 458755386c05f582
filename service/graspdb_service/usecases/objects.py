"""Objects: make, find, change and delete them."""

from __future__ import annotations

from graspdb.wire import OUTCOMES, ObjectCreate, ObjectInfo, ObjectPatch
from graspdb.wire.frames.gripper_frames import IDENTITY
from graspdb.wire.frames.object_frames import MESH
from graspdb_service import principal
from graspdb_service.problems import conflict, found
from graspdb_service.storage import assets, objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.trials import provenances
from graspdb_service.usecases.identifiers import is_slug
from graspdb_service.usecases.runtime.idempotency import Created, Sent, replay_or


def create(database: Database, request: ObjectCreate, sent: Sent) -> Created:
    """Store a new object, without mesh and trials."""
    principal.refuse_hidden(request.id)

    def make(tx: Tx) -> Created:
        if not objects.create(tx, request.id, request.model_dump(mode="json", exclude={"id"})):
            raise conflict("already-exists", f"There is an object {request.id!r} already: choose another id")
        audit.record(tx, "object.create", object=request.id)
        return Created(
            info(require(tx, request.id), {}).model_dump(mode="json"), location=f"/objects/{request.id}"
        )

    return replay_or(database, "POST /objects", sent, make)


def require(tx: Tx, slug: str, *, object_id: int | None = None, lock: bool = False) -> ObjectRow:
    """The object of this slug (404), and of this internal id (409); ``lock`` holds it for the transaction.

    403 where the key that asks is limited to others.
    """
    principal.refuse_hidden(slug)
    known = objects.find(tx, slug, lock=lock) if is_slug(slug) else None
    row = found(known, "object", slug, "GET /objects lists them, POST /objects makes one")
    if object_id is not None and row.id != object_id:
        raise conflict("object-replaced", f"Object {slug!r} was deleted and created anew: ask again")
    return row


def get(database: Database, slug: str) -> tuple[ObjectRow, ObjectInfo]:
    """One object: as stored, and as the wire has it."""
    with database.read() as tx:
        row = require(tx, slug)
        return row, info(row, provenances.outcome_counts(tx, [row.id])[row.id])


def page(database: Database, *, after: str, limit: int) -> tuple[list[ObjectInfo], str | None]:
    """A page of objects by id, and where the next one starts."""
    with database.read() as tx:
        rows = objects.page(tx, after=after, limit=limit + 1, prefix=principal.object_prefix())
        counts = provenances.outcome_counts(tx, [row.id for row in rows])
    items = [info(row, counts[row.id]) for row in rows[:limit]]
    return items, items[-1].id if len(rows) > limit else None


def change(database: Database, slug: str, patch: ObjectPatch) -> ObjectInfo:
    """Set the properties that are given; an explicit null clears one."""
    given = patch.model_dump(mode="json", exclude_unset=True)
    with database.write() as tx:
        row = require(tx, slug, lock=True)
        different = {name: value for name, value in given.items() if getattr(row, name) != value}
        if different:
            objects.advance(tx, row.id, append=False)
            objects.change(tx, row.id, different)
            audit.record(tx, "object.change", object=slug)
            row = require(tx, slug)
        return info(row, provenances.outcome_counts(tx, [row.id])[row.id])


def remove(database: Database, slug: str) -> None:
    """Delete an object and everything of it; 409 while a sweep runs, which would write on."""
    with database.write() as tx:
        row = require(tx, slug, lock=True)
        if objects.has_running_sweep(tx, row.id):
            raise conflict(
                "sweep-running",
                f"A sweep of {slug!r} is running: cancel it (POST /sweeps/{{id}}/cancel) or wait for its end",
            )
        objects.remove(tx, row)
        audit.record(tx, "object.delete", object=slug)
    with database.write() as tx:
        assets.drop_unused(tx, {h for h in (row.mesh_sha256, row.parts_sha256) if h})


def info(row: ObjectRow, counts: dict[int, int]) -> ObjectInfo:
    """An object as the wire has it; ``counts`` are of all its collected trials by outcome code."""
    return ObjectInfo.model_validate(
        {
            **vars(row),
            "id": row.slug,
            "mesh": row.mesh_info,
            "convex_parts": row.parts_info,
            "frames": {MESH: IDENTITY, **(row.frames or {})},
            "trials": sum(counts.values()),
            "outcomes": {OUTCOMES[code]: number for code, number in sorted(counts.items())},
        }
    )

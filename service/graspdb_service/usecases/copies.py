"""Copies of objects, which may take another mesh in spite of their trials."""

from __future__ import annotations

from graspdb.wire import CopyRequest
from graspdb_service import principal
from graspdb_service.problems import conflict
from graspdb_service.storage import grippers, objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.trials import copies, provenances
from graspdb_service.usecases.objects import info, require
from graspdb_service.usecases.runtime.idempotency import Created, Sent, replay_or


def create(database: Database, slug: str, request: CopyRequest, sent: Sent) -> Created:
    """Copy an object; 409 for an id that is taken, and of trials while a sweep is adding to them."""
    principal.refuse_hidden(request.id)

    def make(tx: Tx) -> Created:
        row = require(tx, slug, lock=True)
        if request.trials and objects.has_running_sweep(tx, row.id):
            raise conflict(
                "sweep-running",
                f"A sweep of {slug!r} is running: cancel it (POST /sweeps/{{id}}/cancel) or wait for its end,"
                " then copy",
            )
        told = {"object": row.slug, "revision": row.revision, "last_seq": row.last_seq}
        told |= {"takes_mesh": request.trials, "other_mesh": False}
        copy = copies.create(tx, row, request.id, told, trials=request.trials)
        if copy is None:
            raise conflict("already-exists", f"There is an object {request.id!r} already: choose another id")
        audit.record(tx, "object.copy", object=request.id, subject=slug)
        if request.trials:
            grippers.held(tx, copies.grippers_of(tx, row.id))
            copies.copy_trials(tx, row.id, copy)
        made = info(require(tx, request.id), provenances.outcome_counts(tx, [copy])[copy])
        return Created(made.model_dump(mode="json"), location=f"/objects/{request.id}")

    return replay_or(database, f"POST /objects/{slug}/copies", sent, make)

"""Posting trials: a batch is stored whole or not at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graspdb_service.formats.trials import parse
from graspdb_service.problems import ProblemError
from graspdb_service.storage import grippers, objects
from graspdb_service.storage.database import Tx
from graspdb_service.storage.trials import batches, provenances, rows
from graspdb_service.trial_columns import TrialBatch
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.idempotency import Created, Sent, replay_or
from graspdb_service.usecases.runtime.runtime import Runtime


def add(ctx: Runtime, slug: str, sent: Sent, media: str) -> Created:
    """Store the trials of one request as a batch."""
    with ctx.database.read() as tx:
        require(tx, slug)
    batch = parse(sent.body, media, limit=ctx.settings.max_batch_trials)
    count = len(batch.columns)

    def make(tx: Tx) -> Created:
        row = require(tx, slug)
        _refuse_unknown_grippers(tx, batch)
        revision, first_seq = objects.advance(tx, row.id, rows=count, append=True)
        ids = np.array([provenances.ensure(tx, row.id, item) for item in batch.provenances])
        batch_id, batch_key = batches.create(tx, row.id, revision=revision, metadata=batch.metadata)
        columns = replace(batch.columns, provenance=ids[batch.columns.provenance])
        rows.insert(tx, row.id, batch_id, columns, revision=revision, first_seq=first_seq)
        last_seq = first_seq + count - 1
        batches.grow(tx, batch_id, first_seq=first_seq, last_seq=last_seq, inserted=count, packed=0)
        return Created(
            {"batch": batch_key, "inserted": count, "revision": revision},
            location=f"/objects/{slug}/batches/{batch_key}",
            batch_key=batch_key,
        )

    meant = Sent(sent.key, media.encode() + b"\n" + sent.body)
    return replay_or(ctx.database, f"POST /objects/{slug}/trials", meant, make)


def _refuse_unknown_grippers(tx: Tx, batch: TrialBatch) -> None:
    unknown = grippers.missing(tx, {item.gripper for item in batch.provenances if item.gripper is not None})
    if unknown:
        raise ProblemError(
            422,
            "unknown-gripper",
            f"There is no gripper {', '.join(map(repr, unknown))}:"
            " GET /grippers lists them, POST /grippers makes one",
            errors=[(batch.field_of_gripper(name), f"there is no gripper {name!r}") for name in unknown],
        )

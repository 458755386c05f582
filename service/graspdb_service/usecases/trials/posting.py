"""Trials: store a batch whole or not at all, and read rows back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson

from graspdb.wire import OUTCOME_CODES, OUTCOMES
from graspdb_service.formats import arrow, trial_arrow
from graspdb_service.formats.arrow import ARROW
from graspdb_service.formats.trial_json import TrialBatch, parse
from graspdb_service.problems import ProblemError
from graspdb_service.storage import batches, grippers, objects, trials
from graspdb_service.storage.database import Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.trials import TrialColumns
from graspdb_service.usecases.identifiers import is_uuid
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.idempotency import Created, replay_or
from graspdb_service.usecases.runtime.runtime import Runtime

STREAM_ROWS = 5_000


def add(ctx: Runtime, slug: str, *, body: bytes, media: str, key: str | None) -> Created:
    """Store the trials of one request as a batch."""
    with ctx.database.read() as tx:
        require(tx, slug)
    limit = ctx.settings.max_batch_trials
    batch = trial_arrow.parse(body, limit=limit) if media == ARROW else parse(body, media, limit=limit)

    def make(tx: Tx) -> Created:
        row = require(tx, slug)
        _refuse_unknown_grippers(tx, batch)
        revision, first_seq = objects.advance(tx, row.id, rows=len(batch), append=True)
        ids = np.array([trials.provenance(tx, row.id, *names) for names in batch.combinations])
        batch_id, batch_key = batches.create(tx, row.id, revision=revision, metadata=batch.metadata)
        columns = TrialColumns(
            position=batch.position,
            quaternion_xyzw=batch.quaternion_xyzw,
            outcome=batch.outcome,
            provenance=ids[batch.combination],
            proposal_density=batch.proposal_density,
            quality=batch.quality,
            width_m=batch.width_m,
            measured_at=batch.measured_at,
            pose_covariance=batch.pose_covariance,
            metadata=batch.row_metadata,
        )
        trials.insert(tx, row.id, batch_id, columns, revision=revision, first_seq=first_seq)
        last_seq = first_seq + len(batch) - 1
        batches.grow(tx, batch_id, first_seq=first_seq, last_seq=last_seq, inserted=len(batch), packed=0)
        return Created(
            {"batch": batch_key, "inserted": len(batch), "revision": revision},
            location=f"/objects/{slug}/batches/{batch_key}",
            batch_key=batch_key,
        )

    scope = f"POST /objects/{slug}/trials"
    return replay_or(ctx.database, scope=scope, key=key, request=media.encode() + b"\n" + body, create=make)


def _refuse_unknown_grippers(tx: Tx, batch: TrialBatch) -> None:
    named = {gripper for gripper, _, _ in batch.combinations if gripper is not None}
    unknown = grippers.missing(tx, named)
    if unknown:
        raise ProblemError(
            422,
            "unknown-gripper",
            f"There is no gripper {', '.join(map(repr, unknown))}:"
            " GET /grippers lists them, POST /grippers makes one",
            errors=[(batch.field_of_gripper(name), f"there is no gripper {name!r}") for name in unknown],
        )


@dataclass(frozen=True)
class TrialFilter:
    """Which rows to read: exact names, and ``since_revision`` for what was stored after it."""

    outcome: str | None = None
    source: str | None = None
    gripper: str | None = None
    protocol: str | None = None
    batch: str | None = None
    since_revision: int | None = None


def page(
    ctx: Runtime, slug: str, chosen: TrialFilter, *, after: int, limit: int
) -> tuple[list[dict[str, Any]], int | None]:
    """A page of trials in commit order, and the sequence number after which the next one starts."""
    with ctx.database.read() as tx:
        found = _page(tx, require(tx, slug), chosen, after, limit + 1, None)
    return found[:limit], found[limit - 1]["seq"] if len(found) > limit else None


def stream(ctx: Runtime, slug: str, chosen: TrialFilter, *, after: int) -> Iterator[bytes]:
    """Every trial there is now, as lines; no transaction outlasts a piece, however slow the reader."""
    pieces = _pieces(ctx, slug, chosen, after)
    return (
        b"".join(orjson.dumps(item, option=orjson.OPT_APPEND_NEWLINE) for item in found) for found in pieces
    )


def stream_arrow(ctx: Runtime, slug: str, chosen: TrialFilter, *, after: int) -> Iterator[bytes]:
    """As :func:`stream`, as an Arrow IPC stream.

    Raises
    ------
    ProblemError
        406 without pyarrow.
    """
    schema = trial_arrow.schema()
    pieces = _pieces(ctx, slug, chosen, after)
    return arrow.stream(schema, (trial_arrow.batch_of(found) for found in pieces if found))


def page_arrow(items: list[dict[str, Any]], following: str | None) -> bytes:
    """A page as an Arrow IPC stream; its cursor is in the schema's metadata."""
    schema = trial_arrow.schema({"next": following})
    return b"".join(arrow.stream(schema, [trial_arrow.batch_of(items)]))


def _pieces(ctx: Runtime, slug: str, chosen: TrialFilter, after: int) -> Iterator[list[dict[str, Any]]]:
    with ctx.database.read() as tx:
        row = require(tx, slug)

    def pieces(after: int) -> Iterator[list[dict[str, Any]]]:
        while True:
            with ctx.database.read() as tx:
                found = _page(tx, row, chosen, after, STREAM_ROWS, row.last_seq)
            yield found
            if len(found) < STREAM_ROWS:
                return
            after = found[-1]["seq"]

    return pieces(after)


def _page(
    tx: Tx, row: ObjectRow, chosen: TrialFilter, after: int, limit: int, up_to: int | None
) -> list[dict[str, Any]]:
    named = {item.id: item for item in trials.provenances(tx, row.id)}
    wanted = None
    if chosen.gripper is not None or chosen.source is not None or chosen.protocol is not None:
        wanted = [
            item.id
            for item in named.values()
            if chosen.gripper in (None, item.gripper)
            and chosen.source in (None, item.source)
            and chosen.protocol in (None, item.protocol)
        ]
    batch_id = None
    if chosen.batch is not None:
        batch = batches.find(tx, row.id, chosen.batch) if is_uuid(chosen.batch) else None
        if batch is None or batch.first_seq is None or batch.last_seq is None:
            return []
        batch_id, after = batch.id, max(after, batch.first_seq - 1)
        up_to = batch.last_seq if up_to is None else min(up_to, batch.last_seq)
    rows = trials.page(
        tx,
        row.id,
        after_seq=after,
        limit=limit,
        up_to_seq=up_to,
        outcome=None if chosen.outcome is None else OUTCOME_CODES[chosen.outcome],
        provenance_ids=wanted,
        batch_id=batch_id,
        since_revision=chosen.since_revision,
    )
    owners = batches.names(tx, {item.batch_id for item in rows})
    found = []
    for item in rows:
        key, sweep, metadata = owners[item.batch_id]
        origin = named[item.provenance_id]
        found.append(
            {
                "seq": item.seq,
                "revision": item.revision,
                "batch": key,
                "position": (item.px, item.py, item.pz),
                "quaternion_xyzw": (item.qx, item.qy, item.qz, item.qw),
                "outcome": OUTCOMES[item.outcome],
                "gripper": origin.gripper,
                "source": origin.source,
                "protocol": origin.protocol,
                "proposal_density": item.proposal_density,
                "quality": item.quality,
                "width_m": item.width_m,
                "pose_covariance": item.pose_covariance,
                "measured_at": item.measured_at,
                # What stood once beside the batch holds for each trial that did not say it itself.
                "metadata": metadata if item.metadata is None else item.metadata,
                "sweep": sweep,
                "pose_index": item.pose_index,
            }
        )
    return found

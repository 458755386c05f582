"""How much of what users make up an object may have: protocols, their combinations, names of qualities,
metadata."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import orjson

from graspdb.wire.base import MAX_METADATA_LENGTH
from graspdb_service.problems import ProblemError
from graspdb_service.settings import Settings
from graspdb_service.storage.database import Tx
from graspdb_service.storage.trials import provenances, qualities
from graspdb_service.trial_columns import Provenance, TrialBatch


def check_metadata(settings: Settings, metadata: Any, field: str = "metadata") -> None:
    """422 for metadata over a limit that is lower than the wire's own."""
    limit = settings.max_metadata_bytes
    if limit < MAX_METADATA_LENGTH and metadata is not None and len(orjson.dumps(metadata)) > limit:
        told = f"Metadata is at most {limit:,} bytes of JSON (max_metadata_bytes in /info)"
        raise _too_much("too-much-metadata", told, limit, field)


def check_batch(settings: Settings, batch: TrialBatch) -> None:
    """Refuse, before anything is asked of the database, what no object may have."""
    check_metadata(settings, batch.shared.metadata)
    for row, metadata in enumerate(batch.columns.metadata):
        check_metadata(settings, metadata, batch.field_of(row, "metadata"))
    _check_qualities(settings, batch, batch.qualities, 0)
    _check(settings, batch, dict(enumerate(batch.provenances)), frozenset(), 0)


def provenance_ids(
    tx: Tx, settings: Settings, object_id: int, batch: TrialBatch, named: Sequence[Provenance]
) -> list[int]:
    """Ids of a batch's combinations, made where they are new; 422 where that would be too many.

    ``named`` are those of the batch, each gripper as the version that it stands for. An object that has more
    already goes on with those. Call it under the object's lock.
    """
    known = provenances.find(tx, object_id, named)
    first = {item: place for place, item in reversed(list(enumerate(named))) if item not in known}
    new = {place: item for item, place in sorted(first.items(), key=lambda pair: pair[1])}
    if new:
        _check(settings, batch, new, *provenances.spread(tx, object_id))
        known |= provenances.make(tx, object_id, list(new.values()))
    return [known[item] for item in named]


def keep_quality_names(tx: Tx, settings: Settings, object_id: int, batch: TrialBatch) -> None:
    """Note the names of a batch's qualities as its object's; 422 where these would be too many.

    Call it under the object's lock.
    """
    if not batch.qualities:
        return
    known = qualities.names(tx, object_id)
    new = [name for name in batch.qualities if name not in known]
    if new:
        _check_qualities(settings, batch, new, len(known))
        qualities.keep_names(tx, object_id, [*known, *new])


def _check_qualities(settings: Settings, batch: TrialBatch, new: Sequence[str], known: int) -> None:
    limit = settings.max_object_qualities
    if new and known + len(new) > limit:
        name = new[max(0, limit - known)]
        row = int(np.argmax(~np.isnan(batch.columns.qualities[:, list(batch.qualities).index(name)])))
        title = (
            f"An object's trials have at most {limit:,} names of qualities (max_object_qualities in /info):"
            " what differs from trial to trial belongs in their metadata"
        )
        raise _too_much("too-many-qualities", title, limit, batch.field_of(row, f"qualities.{name}"))


def _check(
    settings: Settings,
    batch: TrialBatch,
    new: Mapping[int, Provenance],
    protocols: frozenset[str],
    count: int,
) -> None:
    """422 where new combinations, by place, are too many for an object of so many and these protocols."""
    added = {
        item.protocol: place
        for place, item in reversed(list(new.items()))
        if item.protocol is not None and item.protocol not in protocols
    }
    for kind, limit, told, before, places in (
        ("too-many-protocols", settings.max_object_protocols, "protocols", len(protocols), added.values()),
        (
            "too-many-provenances",
            settings.max_object_provenances,
            "combinations of gripper, source, protocol and engine",
            count,
            new.keys(),
        ),
    ):
        if places and before + len(places) > limit:
            place = sorted(places)[max(0, limit - before)]
            row = int(np.argmax(batch.columns.provenance == place))
            title = f"An object's trials have at most {limit:,} {told} (max_object_{kind[9:]} in /info)"
            way_out = ": what differs from trial to trial belongs in their metadata"
            raise _too_much(kind, title + way_out, limit, batch.field_of(row, "protocol"))


def _too_much(kind: str, title: str, limit: int, field: str) -> ProblemError:
    return ProblemError(
        422, kind, title, errors=[(field, f"over the limit of {limit:,}")], extra={"limit": limit}
    )

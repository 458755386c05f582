"""Posting trials: a batch is stored whole or not at all."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from graspdb.wire import BatchReceipt
from graspdb.wire.trials import BatchDefaults
from graspdb_service.formats.json_pieces import Allowed
from graspdb_service.formats.trials import parse
from graspdb_service.problems import ProblemError, invalid_fields
from graspdb_service.settings import Settings
from graspdb_service.storage import answers, grippers, objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Tx
from graspdb_service.storage.trials import batches, findings, qualities, rows
from graspdb_service.trial_columns import Ints, Provenance, TrialBatch
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime import quotas
from graspdb_service.usecases.runtime.idempotency import Created, Sent, replay_or, replayed
from graspdb_service.usecases.runtime.runtime import Runtime
from graspdb_service.usecases.trials.findings import inspection, words
from graspdb_service.usecases.trials.findings.inspection import Concern, Geometries
from graspdb_service.usecases.trials.frames import AskedFrame, into_tool, unknown_grippers


class GivenAnswers(Protocol):
    """The answers that trials may name."""

    def settle(self, references: Collection[str]) -> None:
        """Wait until what was given under these ids is stored."""


def add(
    ctx: Runtime,
    slug: str,
    geometries: Geometries,
    given: GivenAnswers,
    sent: Sent,
    media: str,
    *,
    accept_implausible: bool,
    told: BatchDefaults,
    frame: AskedFrame,
) -> Created:
    """Store the trials of one request as a batch, and say what is doubtful about them.

    ``told`` is what the request's address says of the batch, ``frame`` what its poses are of. 422
    ``implausible-poses`` for trials that can't be of the object, unless they are accepted.
    """
    scope = f"POST /objects/{slug}/trials"
    beside = told.model_dump_json(exclude_none=True).encode() if told.model_fields_set else b""
    beside += b"" if frame.is_tool else f"{frame.told()}\n".encode()
    meant = Sent(sent.key, sent.body, media.encode() + b"\n" + beside)
    with ctx.database.read() as tx:
        require(tx, slug)
    # What was stored once is answered so again, whatever is known of the object by now.
    earlier = replayed(ctx.database, scope, meant)
    if earlier is not None:
        return earlier
    limits = ctx.settings
    allowed = Allowed(limits.max_json_values, limits.max_json_depth)
    batch = _with_told(parse(sent.body, media, limit=limits.max_batch_trials, allowed=allowed), told)
    quotas.check_batch(limits, batch)
    with ctx.database.read() as tx:
        known = require(tx, slug)
        batch, turned = into_tool(tx, batch, frame)
        profiles = inspection.profiles_of(tx, batch)
    concerns = inspection.inspect(ctx.compute, geometries, known, profiles, batch)
    concerns += inspection.turned_frames(batch, turned, frame.convention)
    if not accept_implausible:
        _refuse_implausible(batch, concerns)
    given.settle(batch.answers)
    return replay_or(ctx.database, scope, meant, lambda tx: _store(tx, ctx.settings, slug, batch, concerns))


def _with_told(batch: TrialBatch, told: BatchDefaults) -> TrialBatch:
    """A batch with what the address says of it; 422 where the body says it, too."""
    given = {name: getattr(told, name) for name in told.model_fields_set}
    twice = [name for name, value in given.items() if value is not None and getattr(batch.shared, name)]
    if twice:
        raise invalid_fields([(name, "stands in the body and in the query: say it once") for name in twice])
    return replace(batch, shared=batch.shared.model_copy(update=given))


def _store(tx: Tx, settings: Settings, slug: str, batch: TrialBatch, concerns: Sequence[Concern]) -> Created:
    row = require(tx, slug)
    named = _held_grippers(tx, batch)
    count = len(batch.columns)
    revision, first_seq = objects.advance(tx, row.id, rows=count, append=True)
    ids = np.array(quotas.provenance_ids(tx, settings, row.id, batch, named))
    quotas.keep_quality_names(tx, settings, row.id, batch)
    layout = qualities.layout_of(batch.qualities, batch.columns.qualities)
    batch_id, batch_key = batches.create(
        tx, row.id, revision=revision, shared=batch.shared, quality_layout=layout
    )
    audit.record(tx, "batch.create", object=slug, subject=batch_key)
    columns = replace(
        batch.columns, provenance=ids[batch.columns.provenance], answer=_answers(tx, row.id, batch)
    )
    rows.insert(tx, row.id, batch_id, columns, revision=revision, first_seq=first_seq, layout=layout)
    last_seq = first_seq + count - 1
    batches.grow(tx, batch_id, first_seq=first_seq, last_seq=last_seq, inserted=count, packed=0)
    told = [concern.stored(ids) for concern in concerns]
    told += inspection.repeats(tx, row.id, batch_id, batch, ids)
    findings.add(tx, batch_id, told)
    receipt = BatchReceipt(
        batch=batch_key,
        inserted=count,
        revision=revision,
        findings=words.of_batch(told, count, batches.keys(tx, words.earlier_batches(told))),
    )
    return Created(
        receipt.model_dump(mode="json"),
        location=f"/objects/{slug}/batches/{batch_key}",
        batch_key=batch_key,
    )


def _answers(tx: Tx, object_id: int, batch: TrialBatch) -> Ints:
    """The numbers of the answers that trials tried (n,), -1 for none, counted as theirs; 422 for those there
    are not.
    """
    if not batch.answers:
        return batch.columns.answer
    found = answers.find_many(tx, object_id, batch.answers)
    unknown = [place for place, name in enumerate(batch.answers) if name not in found]
    if unknown:
        raise _unknown_answers(batch, unknown)
    numbers = np.array([*(found[name] for name in batch.answers), -1], dtype=np.int64)
    tried = numbers[batch.columns.answer]
    which, counts = np.unique(tried[tried >= 0], return_counts=True)
    if not answers.count_trials(tx, dict(zip(which.tolist(), counts.tolist(), strict=True))):
        raise _unknown_answers(batch, [place for place, number in enumerate(numbers[:-1]) if number in which])
    return tried


def _unknown_answers(batch: TrialBatch, places: Sequence[int]) -> ProblemError:
    errors = []
    for place in places[: inspection.FIRST]:
        row = int(np.flatnonzero(batch.columns.answer == place)[0])
        told = f"{batch.answers[place]!r} is no answer about this object"
        errors.append((batch.field_of(row, "answer"), told))
    return ProblemError(
        422,
        "unknown-answer",
        "Trials name an answer that is not about this object or is no longer kept; none was stored: name= in"
        " a question keeps its answer",
        errors=errors,
    )


def _refuse_implausible(batch: TrialBatch, concerns: Sequence[Concern]) -> None:
    """422 naming trials too far from the object, with what they look like."""
    impossible = [concern for concern in concerns if concern.code == "implausible-poses"]
    if not impossible:
        return
    ids = np.arange(len(batch.provenances))
    told = words.of_batch([concern.stored(ids) for concern in concerns], len(batch.columns), {})
    message = next(finding.message for finding in told if finding.code == "implausible-poses")
    raise ProblemError(
        422,
        "implausible-poses",
        f"{message[0].upper()}{message[1:]}; none was stored",
        detail=words.why_refused(told),
        errors=[
            (batch.field_of(int(place), "position"), f"more than {concern.detail} from the object")
            for concern in impossible
            for place in concern.rows[: inspection.FIRST]
        ],
        extra={"findings": [finding.model_dump(mode="json") for finding in told]},
    )


def _held_grippers(tx: Tx, batch: TrialBatch) -> list[Provenance]:
    """The batch's provenances, each gripper as the version that it stands for; 422 for one there is not."""
    names = {item.gripper for item in batch.provenances if item.gripper is not None}
    held = grippers.held(tx, names)
    unknown = sorted(names - held.keys())[: inspection.FIRST]
    if unknown:
        raise unknown_grippers(batch, unknown)
    return [
        item if item.gripper is None else item._replace(gripper=held[item.gripper])
        for item in batch.provenances
    ]

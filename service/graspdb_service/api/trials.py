"""Trials and batches: ``/objects/{id}/trials``, ``/objects/{id}/batches``."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response

from graspdb.wire import (
    BatchInfo,
    BatchReceipt,
    GripperRef,
    Outcome,
    Page,
    Slug,
    Source,
    TrialIn,
    TrialInfo,
    TrialPatch,
    TrialsIn,
)
from graspdb.wire.trials import TrialColumnsIn, TrialsPage
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import etag, not_modified, tagged_json
from graspdb_service.api.routing.cursors import Cursor, Limit, encode_cursor, number_cursor
from graspdb_service.api.routing.parameters import (
    BatchId,
    Creating,
    Ctx,
    Framed,
    FramedAnswer,
    ObjectId,
    ToldOfBatch,
    UnderLicence,
)
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.negotiation import ARROW, BINARY, JSON, NDJSON, accepted, media_type
from graspdb_service.formats.trials import page_response, stream_response
from graspdb_service.usecases import objects
from graspdb_service.usecases.runtime.quotas import check_metadata
from graspdb_service.usecases.trials import batches, corrections, listing, posting

router = APIRouter(tags=["trials"], route_class=AdmittedRoute)

Seq = Annotated[int, Path(ge=1, lt=2**63, description="The trial's number in its object.")]

BODY = {
    JSON: (TrialIn, TrialsIn, TrialColumnsIn),
    NDJSON: {"type": "string", "description": "One trial as JSON a line"},
    ARROW: {**BINARY, "description": "Columns as in TrialColumns; the rest as JSON in the schema's metadata"},
}


@router.post(
    "/objects/{id}/trials",
    status_code=201,
    response_model=BatchReceipt,
    **scope("trials:write", body=BODY, work="uploads", large=True),
)
def add_trials(
    ctx: Ctx,
    id: ObjectId,
    request: Request,
    sent: Creating,
    told: ToldOfBatch,
    frame: Framed,
    accept_implausible: Annotated[
        bool, Query(description="Store trials, too, that lie too far from the object to be grasps of it.")
    ] = False,
) -> object:
    """Store one trial, a list, columns, lines or an Arrow stream as one batch: whole, or not at all.

    Their poses, those achieved and covariances are of ``frame`` of each trial's gripper; kept, and used, are
    those of the tool.

    What is doubtful about them against mesh and gripper is answered as findings; trials farther from a known
    object than ten times its size and the gripper's together are refused (`implausible-poses`).
    """
    media = media_type(request)
    more: dict[str, Any] = {"accept_implausible": accept_implausible, "told": told, "frame": frame}
    made = posting.add(ctx, id, ctx.scenes, ctx.answers, sent, media, **more)
    return sent.answered(made)


@router.get(
    "/objects/{id}/trials",
    response_model=TrialsPage,
    responses={200: {"content": {NDJSON: {"schema": {"type": "string"}}, ARROW: {"schema": BINARY}}}},
    **scope("read"),
)
def list_trials(
    ctx: Ctx,
    id: ObjectId,
    request: Request,
    frame: FramedAnswer,
    outcome: Annotated[
        Outcome | None, Query(description="Only trials that ended so; by default all.")
    ] = None,
    source: Annotated[
        Source | None, Query(description="Only trials from this source; by default all.")
    ] = None,
    gripper: Annotated[
        GripperRef | None,
        Query(description="Only trials with this gripper, or this version of it; by default all."),
    ] = None,
    protocol: Annotated[Slug | None, Query(description="Only trials judged so; by default all.")] = None,
    batch: Annotated[
        str | None, Query(max_length=64, description="Only trials of this batch; by default all.")
    ] = None,
    since_revision: Annotated[
        int | None,
        Query(
            ge=0, lt=2**63, description="Only what was stored, corrected or withdrawn after this revision."
        ),
    ] = None,
    withdrawn: Annotated[
        bool | None, Query(description="Only withdrawn trials, or none; both, marked, if not given.")
    ] = None,
    licence: UnderLicence = None,
    limit: Annotated[
        int | None,
        Query(ge=1, le=1_000, description="At most this many; 100, or all as lines or Arrow, if not given."),
    ] = None,
    cursor: Cursor = None,
) -> Response:
    """Trial rows in commit order; as JSON a page, as lines (`Accept: application/x-ndjson`) or an Arrow
    stream (`Accept: application/vnd.apache.arrow.stream`) all of them."""
    chosen = listing.TrialFilter(
        outcome, source, gripper, protocol, batch, since_revision, withdrawn, licence
    )
    kind = accepted(request, JSON, NDJSON, ARROW)
    after = number_cursor(cursor)
    row, _ = objects.get(ctx.database, id)
    tag = etag(row.id, row.revision, kind.rpartition("/")[2], request.url.query)
    fresh = not_modified(request, tag)
    if fresh is not None:
        return fresh
    headers = {"ETag": tag, "Vary": "Accept"}
    if kind != JSON and limit is None:
        rows = listing.pages(ctx.database, id, chosen, frame, after=after)
        return stream_response(rows, kind, headers, frame.told())
    page, last = listing.page(ctx.database, id, chosen, frame, after=after, limit=limit or 100)
    return page_response(page, encode_cursor(last), kind, headers, frame.told())


@router.get("/objects/{id}/trials/{seq}", response_model=TrialInfo, **scope("read"))
def get_trial(ctx: Ctx, id: ObjectId, seq: Seq, request: Request, frame: FramedAnswer) -> Response:
    """One trial, and what it was before it was corrected."""
    return tagged_json(request, corrections.get(ctx.database, id, seq, frame))


@router.delete("/objects/{id}/trials/{seq}", status_code=204, **scope("trials:write"))
def withdraw_trial(
    ctx: Ctx,
    id: ObjectId,
    seq: Seq,
    reason: Annotated[str | None, Query(max_length=4_000, description="Why, for the history.")] = None,
) -> None:
    """Withdraw one trial: it is kept, marked, and out of every count and estimate; `PATCH` takes it back.

    409 for a trial of a sweep.
    """
    corrections.withdraw(ctx.database, id, seq, reason=reason)


@router.patch("/objects/{id}/trials/{seq}", **scope("trials:write"))
def correct_trial(ctx: Ctx, id: ObjectId, seq: Seq, request: TrialPatch, frame: FramedAnswer) -> TrialInfo:
    """Correct a trial's outcome or metadata, withdraw it or take it back; what it was stays in its history.

    409 for a trial of a sweep.
    """
    check_metadata(ctx.settings, request.metadata)
    return corrections.correct(ctx.database, id, seq, request, frame)


@router.get("/objects/{id}/batches", response_model=Page[BatchInfo], **scope("read"))
def list_batches(
    ctx: Ctx,
    id: ObjectId,
    request: Request,
    licence: UnderLicence = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Response:
    """An object's batches in the order of their making."""
    first = number_cursor(cursor)
    items, last = batches.page(ctx.database, id, after=first, limit=limit, licence=licence)
    return tagged_json(request, Page[BatchInfo](items=items, next=encode_cursor(last)))


@router.get("/objects/{id}/batches/{batch}", response_model=BatchInfo, **scope("read"))
def get_batch(ctx: Ctx, id: ObjectId, batch: BatchId, request: Request) -> Response:
    """One batch, with everything it holds by outcome."""
    return tagged_json(request, batches.get(ctx.database, id, batch))


@router.delete("/objects/{id}/batches/{batch}", status_code=204, **scope("trials:write"))
def delete_batch(ctx: Ctx, id: ObjectId, batch: BatchId) -> None:
    """Delete a batch and its trials; 409 while its sweep runs."""
    batches.remove(ctx.database, id, batch)

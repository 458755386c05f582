"""Jobs and workers: ``/jobs``, ``/workers``. The worker's side of the protocol is in graspdb.wire.jobs."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request

from graspdb.wire import (
    ClaimRequest,
    ClaimResponse,
    FailureReport,
    LeaseRenewed,
    Page,
    ResultAccepted,
    SimulateResult,
    WorkerInfo,
)
from graspdb.wire.jobs import FailureNoted
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.cursors import Cursor, Limit, encode_cursor, number_cursor
from graspdb_service.api.routing.parameters import Ctx, JobId, RawBody
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.negotiation import BINARY, GLB, JSON, media_type, unsupported
from graspdb_service.formats.sweep_outcomes import read_result
from graspdb_service.usecases.simulation import leases, results

router = APIRouter(tags=["jobs"], route_class=AdmittedRoute)

LeaseId = Annotated[
    str, Query(min_length=1, max_length=64, pattern=r"^[\x21-\x7e]+$", description="As the claim gave it.")
]
_RESULTS = {JSON: SimulateResult, GLB: BINARY}
ProgressText = Annotated[
    str | None,
    Query(max_length=200, pattern=r"^[^\x00-\x1f]+$", description="How far the work is, for a person."),
]


def _hidden(ctx: Ctx, id: JobId) -> None:
    leases.refuse_hidden(ctx, id)


_OWN = [Depends(_hidden)]


@router.post("/jobs/claim", **scope("jobs:work"))
def claim_jobs(ctx: Ctx, request: ClaimRequest) -> ClaimResponse:
    """Lease up to ``limit`` jobs that a worker with these capabilities can do, and register it."""
    return leases.claim(ctx, request)


@router.put("/jobs/{id}/lease", dependencies=_OWN, **scope("jobs:work"))
def renew_lease(ctx: Ctx, id: JobId, lease_id: LeaseId, progress: ProgressText = None) -> LeaseRenewed:
    """Keep a job; ``cancel`` says that it is no longer wanted. 409 ``lease-lost`` if another has it."""
    return leases.renew(ctx, id, lease_id, progress)


@router.delete("/jobs/{id}/lease", status_code=204, dependencies=_OWN, **scope("jobs:work"))
def release_lease(ctx: Ctx, id: JobId, lease_id: LeaseId) -> None:
    """Give a job back unfinished, as a worker does that is told to stop; it counts as no attempt."""
    leases.release(ctx, id, lease_id)


@router.put(
    "/jobs/{id}/result", dependencies=_OWN, **scope("jobs:work", body=_RESULTS, work="uploads", large=True)
)
def put_result(ctx: Ctx, id: JobId, lease_id: LeaseId, request: Request, body: RawBody) -> ResultAccepted:
    """Store a chunk's outcomes, or an object's convex parts, and complete the job, in one transaction.

    The same body under the same lease again is answered the same again.
    """
    try:
        if media_type(request) == GLB:
            return results.complete_parts(ctx, id, lease_id, body)
        return results.complete(ctx, id, lease_id, body, read_result(request, body))
    except results.WrongResult as error:
        wanted = {"simulate": f"JSON, as {JSON}", "decompose": f"a GLB, as {GLB}"}[error.kind]
        raise unsupported(f"The result of a {error.kind} job is {wanted}") from None


@router.put("/jobs/{id}/failure", dependencies=_OWN, **scope("jobs:work"))
def put_failure(ctx: Ctx, id: JobId, lease_id: LeaseId, report: FailureReport) -> FailureNoted:
    """Report that an attempt failed: the job is queued again, or failed after its last attempt."""
    return leases.fail(ctx, id, lease_id, report)


@router.get("/workers", **scope("read"))
def list_workers(ctx: Ctx, limit: Limit = 100, cursor: Cursor = None) -> Page[WorkerInfo]:
    """The workers that ever asked for jobs, by name."""
    items, after = leases.workers(ctx, skip=number_cursor(cursor), limit=limit)
    return Page(items=items, next=encode_cursor(after))

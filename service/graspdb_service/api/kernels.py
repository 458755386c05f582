"""Stored kernels: ``/kernels``."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import JSONResponse

from graspdb.wire import GripperRef, Page, Slug
from graspdb.wire.kernels import KernelCreate, StoredKernel
from graspdb.wire.reports import ReportRun
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import tagged_json
from graspdb_service.api.routing.cursors import Cursor, Limit, encode_cursor, number_cursor
from graspdb_service.api.routing.parameters import Creating, Ctx, KernelId
from graspdb_service.api.routing.scopes import scope
from graspdb_service.usecases.kernels import stored

router = APIRouter(tags=["kernels"], route_class=AdmittedRoute)


@router.post(
    "/kernels",
    status_code=201,
    response_model=StoredKernel,
    responses={202: {"model": ReportRun, "description": "Being fitted: Location says where it will be"}},
    **scope("objects:write", work="queries"),
)
def create_kernel(ctx: Ctx, request: KernelCreate, sent: Creating) -> object:
    """Fit a kernel on an object's successes, or store one given by its components.

    With ``components: "auto"`` this may take longer than a request should: then the answer is 202 with the
    run that fits it, whose ``result`` is the kernel.
    """
    made = stored.create(ctx, ctx.runs, request, sent)
    if made.status == 202:
        return JSONResponse(made.body, 202, headers={"Location": made.location, "Retry-After": "2"})
    return sent.answered(made)


@router.get("/kernels", **scope("read"))
def list_kernels(
    ctx: Ctx,
    limit: Limit = 100,
    cursor: Cursor = None,
    object: Annotated[Slug | None, Query(description="Only those fitted on this object.")] = None,
    gripper: Annotated[
        GripperRef | None, Query(description="Only those for this gripper, or for this version alone.")
    ] = None,
) -> Page[StoredKernel]:
    """The kernels, oldest first."""
    items, after = stored.page(ctx, after=number_cursor(cursor), limit=limit, object=object, gripper=gripper)
    return Page(items=items, next=encode_cursor(after))


@router.get("/kernels/{id}", response_model=StoredKernel, **scope("read"))
def get_kernel(ctx: Ctx, id: KernelId, request: Request) -> Response:
    """One kernel: components, widths, and what it was fitted on."""
    return tagged_json(request, stored.get(ctx, id))


@router.delete("/kernels/{id}", status_code=204, **scope("objects:write"))
def delete_kernel(ctx: Ctx, id: KernelId) -> None:
    """Delete a kernel; queries that name it are answered 404 from then on."""
    stored.remove(ctx, id)

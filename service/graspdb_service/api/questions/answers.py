"""Answers that are kept: ``/answers`` and ``/objects/{id}/answers``."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from graspdb.wire import Answer, AnswerInfo, Page, Slug
from graspdb.wire.queries import AnswerKind
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import tagged_json
from graspdb_service.api.routing.cursors import Cursor, Limit, encode_cursor, number_cursor
from graspdb_service.api.routing.parameters import AnswerRef, Ctx, ObjectId
from graspdb_service.api.routing.scopes import scope
from graspdb_service.usecases.answers import lookup

router = APIRouter(tags=["answers"], route_class=AdmittedRoute)


@router.get("/answers/{id}", response_model=Answer, **scope("read", work="queries"))
def get_answer(
    ctx: Ctx,
    id: AnswerRef,
    request: Request,
    now: Annotated[
        bool, Query(description="Ask the same question again, of today's trials: an answer of its own.")
    ] = False,
) -> Response:
    """An answer exactly as it was given, whatever became of the trials since, and the question to it."""
    return tagged_json(request, lookup.get(ctx, id, now=now))


@router.delete("/answers/{id}", status_code=204, **scope("trials:write"))
def delete_answer(ctx: Ctx, id: AnswerRef) -> None:
    """Delete an answer by its id, with its names; 409 where a trial names it.

    By a name: free the name, and delete the answer where neither another name nor a trial keeps it.
    """
    lookup.remove(ctx, id)


@router.get("/objects/{id}/answers", response_model=Page[AnswerInfo], **scope("read"))
def list_answers(
    ctx: Ctx,
    id: ObjectId,
    request: Request,
    name: Annotated[Slug | None, Query(description="Only the answer of this name.")] = None,
    kind: Annotated[AnswerKind | None, Query(description="Only answers to such questions.")] = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Response:
    """An object's answers that are kept, the newest first."""
    items, before = lookup.page(ctx, id, before=number_cursor(cursor), limit=limit, name=name, kind=kind)
    return tagged_json(request, Page[AnswerInfo](items=items, next=encode_cursor(before)))

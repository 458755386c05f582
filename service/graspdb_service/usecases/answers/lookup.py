"""Answers that are kept: found by id or name, listed, asked again, deleted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import orjson

from graspdb.wire import Answer, AnswerInfo
from graspdb_service import principal
from graspdb_service.problems import busy, conflict, found
from graspdb_service.storage import answers
from graspdb_service.storage.access import audit
from graspdb_service.storage.answers import AnswerRow
from graspdb_service.storage.database import Database, Tx
from graspdb_service.usecases.answers.asking import Asking, ask
from graspdb_service.usecases.answers.references import is_answer_id
from graspdb_service.usecases.identifiers import is_slug
from graspdb_service.usecases.objects import require

_UNKNOWN = "those without a name are deleted in time: keep one with name= in its question"


def get(ctx: Asking, reference: str, *, now: bool) -> Answer:
    """The answer with an id or name (404), as it was given; ``now``: to its question asked again today."""
    row = _find(ctx, reference)
    question, result = _content(ctx.database, row)
    if not now:
        return _answer(ctx.database, row, question, result)
    told = ask(ctx, row.object, row.kind, orjson.loads(question))
    if told.id is None:
        raise busy("Today's answer can't be kept now: ask the question itself again")
    row = _find(ctx, told.id)
    return _answer(ctx.database, row, *_content(ctx.database, row))


def page(
    ctx: Asking, slug: str, *, before: int, limit: int, name: str | None, kind: str | None
) -> tuple[list[AnswerInfo], int | None]:
    """A page of an object's answers, the newest first, and where the next one starts."""
    ctx.answers.settle_own()
    with ctx.database.read() as tx:
        row = require(tx, slug)
        rows = answers.page(tx, row.id, before=before, limit=limit + 1, name=name, kind=kind)
        items = _infos(tx, rows[:limit])
    return items, rows[limit - 1].number if len(rows) > limit else None


def remove(ctx: Asking, reference: str) -> None:
    """Delete an answer by its id, with its names; 409 where a trial names it.

    By a name: take that away, and delete the answer where nothing else keeps it.
    """
    row = _find(ctx, reference)
    by_name = not is_answer_id(reference)
    with ctx.database.write() as tx:
        if by_name:
            answers.drop_name(tx, reference)
            audit.record(tx, "answer.delete", object=row.object, subject=reference)
            if answers.names(tx, [row.number]):
                return
        removed = answers.remove(tx, row.number)
        if removed and not by_name:
            audit.record(tx, "answer.delete", object=row.object, subject=reference)
    if not removed and not by_name:
        raise conflict(
            "answer-in-use",
            f"Trials name the answer {row.id}, so it stays with them; a name is taken from it by"
            " DELETE /answers/{name}",
        )
    if removed:
        ctx.answers.forget(row.id)


def _find(ctx: Asking, reference: str) -> AnswerRow:
    row = ctx.answers.find(reference) if is_slug(reference) else None
    # Neither an id nor a name tells whose it is: one about a hidden object is answered as none.
    seen = row is not None and principal.sees(row.object)
    return found(row if seen else None, "answer", reference, _UNKNOWN)


def _content(database: Database, row: AnswerRow) -> tuple[bytes, bytes]:
    with database.read() as tx:
        return answers.content(tx, row.number)


def _answer(database: Database, row: AnswerRow, question: bytes, result: bytes) -> Answer:
    with database.read() as tx:
        (info,) = _infos(tx, [row])
    content: dict[str, Any] = orjson.loads(result)
    told = {"kernel": content["kernel"], "estimator": content.get("estimator")}
    return Answer(**info.model_dump(), **told, question=orjson.loads(question), result=content)


def _infos(tx: Tx, rows: Sequence[AnswerRow]) -> list[AnswerInfo]:
    names = answers.names(tx, [row.number for row in rows])
    return [
        AnswerInfo.model_validate(
            {
                **vars(row),
                "answer": row.id,
                "names": names.get(row.number, []),
                "trials": row.trial_count,
            }
        )
        for row in rows
    ]

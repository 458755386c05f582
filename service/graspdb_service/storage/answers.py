"""Answers as they were given: kept once each, found again by id or by a name of the user's."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import Select, and_, delete, or_, select, update

from graspdb_service.storage.database import Tx, all_as, clock, insert_or, utc_now
from graspdb_service.storage.tables import answer_names, answers, objects

#: However many were given since, an answer is kept for so long: who asked may still be on the way with it.
SHORTEST_LIFE = timedelta(minutes=10)
_KEPT_COLUMNS = ("id", "object_id", "kind", "revision", "gripper", "protocol", "source", "version")


@dataclass(frozen=True, eq=False)
class GivenAnswer:
    """An answer as it was given to a question about an object: ``question`` and ``result`` are JSON.

    ``object_id`` is internal; ``gripper``, ``protocol`` and ``source`` are the selection as it was resolved.
    """

    id: str
    object_id: int
    kind: str
    revision: int
    gripper: str | None
    protocol: str | None
    source: str | None
    version: str
    question: bytes
    result: bytes


@dataclass(frozen=True)
class AnswerRow:
    """What is stored of an answer beside question and result; ``object`` is the object's slug."""

    number: int
    id: str
    object_id: int
    object: str
    object_revision: int
    kind: str
    revision: int
    gripper: str | None
    protocol: str | None
    source: str | None
    version: str
    trial_count: int
    created_at: datetime
    asked_at: datetime


def add(tx: Tx, given: Iterable[GivenAnswer]) -> None:
    """Store answers that are not there yet, and note when the others were given again; those of objects that
    are gone are left out.
    """
    now = clock(tx)
    # In one order everywhere, so that two writers never wait for each other.
    ordered = sorted(given, key=lambda item: item.id)
    query = select(objects.c.id).where(objects.c.id.in_({item.object_id for item in ordered}))
    living = set(tx.execute(query).scalars())
    rows = [
        {
            **{name: getattr(item, name) for name in _KEPT_COLUMNS},
            "question": zlib.compress(item.question, 1),
            "result": zlib.compress(item.result, 1),
            "trial_count": 0,
            "created_at": now,
            "asked_at": now,
        }
        for item in ordered
        if item.object_id in living
    ]
    if rows:
        statement = insert_or(tx, answers)
        again = statement.on_conflict_do_update(index_elements=["id"], set_={"asked_at": now})
        tx.execute(again, rows)


def purge(tx: Tx, object_id: int, kind: str, *, most: int) -> None:
    """Delete answers of an object that neither a name nor a trial keeps: all but the ``most`` given last."""
    newest = (
        select(answers.c.asked_at)
        .where(answers.c.object_id == object_id, answers.c.kind == kind)
        .order_by(answers.c.asked_at.desc())
        .limit(1)
        .offset(most)
        .scalar_subquery()
    )
    tx.execute(
        delete(answers).where(
            answers.c.object_id == object_id,
            answers.c.kind == kind,
            answers.c.trial_count == 0,
            answers.c.asked_at < newest,
            answers.c.asked_at < clock(tx) - SHORTEST_LIFE,
            answers.c.number.not_in(select(answer_names.c.answer_number)),
        )
    )


def find(tx: Tx, reference: str) -> AnswerRow | None:
    """The answer with this id or name."""
    named = select(answer_names.c.answer_number).where(answer_names.c.name == reference)
    query = _query().where(or_(answers.c.id == reference, answers.c.number.in_(named)))
    return next(iter(all_as(tx, query, AnswerRow)), None)


def content(tx: Tx, number: int) -> tuple[bytes, bytes]:
    """Question and result of an answer, JSON."""
    query = select(answers.c.question, answers.c.result).where(answers.c.number == number)
    question, result = tx.execute(query).one()
    return zlib.decompress(question), zlib.decompress(result)


def is_kept(tx: Tx, id: str) -> bool:
    """Whether there is an answer with this id."""
    return tx.execute(select(answers.c.number).where(answers.c.id == id)).first() is not None


def names(tx: Tx, numbers: Collection[int]) -> dict[int, list[str]]:
    """The names of each of these answers, those without any left out."""
    found: dict[int, list[str]] = {}
    query = select(answer_names).where(answer_names.c.answer_number.in_(sorted(numbers)))
    for name, number in tx.execute(query.order_by(answer_names.c.name)):
        found.setdefault(int(number), []).append(str(name))
    return found


def page(
    tx: Tx, object_id: int, *, before: int, limit: int, name: str | None, kind: str | None
) -> list[AnswerRow]:
    """Up to ``limit`` answers of an object, the newest first, from the one before the number ``before`` (0:
    the newest of all).
    """
    query = _query().where(answers.c.object_id == object_id)
    if before:
        query = query.where(answers.c.number < before)
    if kind is not None:
        query = query.where(answers.c.kind == kind)
    if name is not None:
        named = select(answer_names.c.answer_number).where(answer_names.c.name == name)
        query = query.where(answers.c.number.in_(named))
    return all_as(tx, query.order_by(answers.c.number.desc()).limit(limit), AnswerRow)


def put_name(tx: Tx, id: str, name: str) -> bool:
    """Name a stored answer; False where the name is another's."""
    # The row is written, so that whoever is about to purge the answer looks at it again.
    touched = update(answers).where(answers.c.id == id).values(asked_at=utc_now())
    number = tx.execute(touched.returning(answers.c.number)).scalar_one()
    new = insert_or(tx, answer_names).values(name=name, answer_number=number).on_conflict_do_nothing()
    tx.execute(new)
    holder = select(answer_names.c.answer_number).where(answer_names.c.name == name)
    return bool(tx.execute(holder).scalar_one() == number)


def drop_name(tx: Tx, name: str) -> None:
    """Take a name away."""
    tx.execute(delete(answer_names).where(answer_names.c.name == name))


def remove(tx: Tx, number: int) -> bool:
    """Delete an answer and its names; False where a trial names it."""
    free = and_(answers.c.number == number, answers.c.trial_count == 0)
    return bool(tx.execute(delete(answers).where(free)).rowcount)


def _query() -> Select[Any]:
    stored = [answers.c[name] for name in AnswerRow.__dataclass_fields__ if name in answers.c]
    columns = (*stored, objects.c.slug.label("object"), objects.c.revision.label("object_revision"))
    return select(*columns).join(objects, objects.c.id == answers.c.object_id)

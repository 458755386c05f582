"""Answers as they were given: kept once each, found again by id or by a name of the user's."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import Select, and_, bindparam, delete, func, or_, select, update

from graspdb_service.storage.database import Tx, all_as, clock, insert_or, utc_now
from graspdb_service.storage.tables import answer_names, answers, objects

#: However many were given since, an answer is kept for so long: who asked may still be on the way with it.
SHORTEST_LIFE = timedelta(minutes=10)
#: Ids and names that one statement looks for.
_AT_ONCE = 500
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


def find_many(tx: Tx, object_id: int, references: Collection[str]) -> dict[str, int]:
    """Numbers of an object's answers by the ids or names that they are called by here."""
    found: dict[str, int] = {}
    listed = sorted(references)
    own = answers.c.object_id == object_id
    for start in range(0, len(listed), _AT_ONCE):
        some = listed[start : start + _AT_ONCE]
        by_id = select(answers.c.id, answers.c.number).where(own, answers.c.id.in_(some))
        by_name = (
            select(answer_names.c.name, answers.c.number)
            .join(answers, answers.c.number == answer_names.c.answer_number)
            .where(own, answer_names.c.name.in_(some))
        )
        for query in (by_id, by_name):
            found |= {str(reference): int(number) for reference, number in tx.execute(query)}
    return found


def count_trials(tx: Tx, more: Mapping[int, int]) -> bool:
    """Count trials that name answers, by the answers' numbers; False where one of these is gone."""
    statement = (
        update(answers)
        .where(answers.c.number == bindparam("which"))
        .values(trial_count=answers.c.trial_count + bindparam("more"))
    )
    counts = [tx.execute(statement, {"which": n, "more": more[n]}).rowcount for n in sorted(more)]
    return all(counts)


def ids(tx: Tx, numbers: Collection[int]) -> dict[int, str]:
    """Ids of answers by number."""
    if not numbers:
        return {}
    query = select(answers.c.number, answers.c.id).where(answers.c.number.in_(sorted(numbers)))
    return {int(number): str(id) for number, id in tx.execute(query)}


def content(tx: Tx, number: int) -> tuple[bytes, bytes]:
    """Question and result of an answer, JSON."""
    query = select(answers.c.question, answers.c.result).where(answers.c.number == number)
    question, result = tx.execute(query).one()
    return zlib.decompress(question), zlib.decompress(result)


def many(tx: Tx, numbers: Collection[int]) -> Iterator[tuple[int, str, bytes, bytes]]:
    """Answers by their numbers: number, kind, question and result."""
    listed = sorted(numbers)
    columns = (answers.c.number, answers.c.kind, answers.c.question, answers.c.result)
    for start in range(0, len(listed), _AT_ONCE):
        query = select(*columns).where(answers.c.number.in_(listed[start : start + _AT_ONCE]))
        for number, kind, question, result in tx.execute(query):
            yield int(number), str(kind), zlib.decompress(question), zlib.decompress(result)


def tally(tx: Tx, object_id: int, kind: str) -> tuple[int, int]:
    """How many answers of an object and kind are kept, and how many of these trials name."""
    tried = func.count().filter(answers.c.trial_count > 0)
    query = select(func.count(), tried).where(answers.c.object_id == object_id, answers.c.kind == kind)
    given, named = tx.execute(query).one()
    return int(given), int(named)


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

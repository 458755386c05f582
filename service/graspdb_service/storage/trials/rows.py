"""Rows of trials: columns in, columns out, on the drivers' fast paths.

SQLAlchemy builds no statement a row here: SQLite takes tuples by ``executemany``, PostgreSQL binary COPY.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import closing
from datetime import datetime, timezone
from itertools import chain
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import bindparam, update

from graspdb_service.storage.database import Tx
from graspdb_service.storage.tables import trials
from graspdb_service.storage.trials import binary_copy, provenances, qualities
from graspdb_service.storage.trials.qualities import Layout
from graspdb_service.trial_columns import Ints, TrialColumns, json_text

SUCCESS = 1
COPY_ROWS = 50_000

_POSE = ("px", "py", "pz", "qx", "qy", "qz", "qw")
_SEVERAL = ("attempts", "successes")
_OPTIONAL = ("proposal_density", "quality", "width_m", "pose_index", *_SEVERAL)
_ACHIEVED = tuple(f"achieved_{name}" for name in _POSE)
_DOCUMENTS = ("pose_covariance", "metadata")


def insert(
    tx: Tx,
    object_id: int,
    batch_id: int,
    columns: TrialColumns,
    *,
    revision: int,
    first_seq: int,
    layout: Layout | None = None,
) -> None:
    """Store trials under the sequence numbers that ``objects.advance`` reserved, and count them; their
    qualities as the batch's ``layout`` says.
    """
    if len(columns) == 0:
        return
    shared = {"object_id": object_id, "revision": revision, "batch_id": batch_id}
    store = _insert_tuples if tx.dialect.name == "sqlite" else _copy_in
    for start in range(0, len(columns), COPY_ROWS):
        block = columns[start : start + COPY_ROWS]
        scores = None if layout is None else qualities.packed(block, layout)
        store(tx, shared, block, first_seq + start, scores)
    # As one number: rows of two would be sorted by Python's comparisons.
    kinds, counts = np.unique(columns.provenance * 256 + columns.outcome, return_counts=True)
    for kind, number in zip(kinds.tolist(), counts.tolist(), strict=True):
        provenances.add_tally(tx, kind // 256, kind % 256, rows=number)


def _numbers(columns: TrialColumns, first_seq: int) -> dict[str, NDArray[Any]]:
    """The columns of numbers that some of the trials have, NaN for null."""
    found = {
        "seq": np.arange(first_seq, first_seq + len(columns)),
        "provenance_id": columns.provenance,
        "outcome": columns.outcome,
        **dict(zip(_POSE, (*columns.position.T, *columns.quaternion_xyzw.T), strict=True)),
        **{name: getattr(columns, name) for name in _OPTIONAL},
        "answer_number": np.where(columns.answer < 0, np.nan, columns.answer),
        **dict(zip(_ACHIEVED, columns.achieved.T if len(columns.achieved) else (), strict=False)),
    }
    return {name: values for name, values in found.items() if not np.isnan(values).all()}


def _insert_tuples(
    tx: Tx, shared: dict[str, int], columns: TrialColumns, first_seq: int, scores: NDArray[Any] | None
) -> None:
    # What all rows share stands in the statement, and what none has is left out: binding is half the time.
    lists: dict[str, list[Any]] = {}
    for name, values in _numbers(columns, first_seq).items():
        missing = np.isnan(values)
        if missing.any():
            values = values.astype(object)
            values[missing] = None
        lists[name] = values.tolist()
    converters: dict[str, Callable[[Any], str]] = {"measured_at": _sqlite_time}
    for name in ("measured_at", *_DOCUMENTS):
        items, convert = getattr(columns, name), converters.get(name, json_text)
        if items:
            lists[name] = [None if item is None else convert(item) for item in items]
    if scores is not None:
        cells = scores.tolist()
        for row in np.flatnonzero(np.isnan(columns.qualities).all(axis=1)):
            cells[row] = None
        lists["qualities"] = cells
    names = ", ".join([*shared, *lists])
    places = ", ".join([str(int(value)) for value in shared.values()] + ["?"] * len(lists))
    rows = zip(*lists.values(), strict=True)
    with closing(tx.connection.cursor()) as cursor:
        # The driver takes any iterator: no list of tuples is built.
        cursor.executemany(f"INSERT INTO trials ({names}) VALUES ({places})", rows)  # type: ignore[arg-type]


def _sqlite_time(value: datetime) -> str:
    return value.astimezone(timezone.utc).strftime("%Y-%m-%d %H:%M:%S.%f")


def _copy_in(
    tx: Tx, shared: dict[str, int], columns: TrialColumns, first_seq: int, scores: NDArray[Any] | None
) -> None:
    values: dict[str, Any] = {**shared, **_numbers(columns, first_seq)}
    maybe = (*_OPTIONAL, "answer_number", *_ACHIEVED)
    nulls = {name: np.isnan(values[name]) for name in maybe if name in values}
    # What is no float has no NaN.
    for name in ("answer_number", *_SEVERAL):
        if name in values:
            values[name] = np.where(nulls[name], 0, values[name])
    times = columns.measured_at
    if times:
        nulls["measured_at"] = np.array([time is None for time in times])
        values["measured_at"] = np.array([binary_copy.microseconds(time) for time in times], dtype=np.int64)
    if scores is not None:
        nulls["qualities"] = np.isnan(columns.qualities).all(axis=1)
        values["qualities"] = scores
    documents = {name: getattr(columns, name) for name in _DOCUMENTS if getattr(columns, name)}
    content = binary_copy.encode(len(columns), values, nulls, list(documents.values()))
    names = ", ".join([*values, *documents])
    with (
        closing(tx.connection.cursor()) as cursor,
        cursor.copy(f"COPY trials ({names}) FROM STDIN (FORMAT BINARY)") as copy,
    ):
        copy.write(content)


def move(
    tx: Tx, object_id: int, *, from_batch: int, to_batch: int, ranges: Sequence[tuple[int, int]]
) -> None:
    """Give the trials of a batch in these ranges of sequence numbers to another; under the object's lock."""
    statement = (
        update(trials)
        .where(
            trials.c.object_id == object_id,
            trials.c.batch_id == from_batch,
            trials.c.seq.between(bindparam("first"), bindparam("last")),
        )
        .values(batch_id=to_batch)
    )
    tx.execute(statement, [{"first": first, "last": last} for first, last in ranges])


# --- reading columns ------------------------------------------------------------------------------------

_READ = ("seq", *_POSE, "proposal_density", "provenance_id", "outcome")


def successes(tx: Tx, object_id: int, provenance_ids: Collection[int], *, after_seq: int = 0) -> TrialColumns:
    """Successes after a sequence number, ascending ``seq``, with the batch each came in, and what succeeded
    in some of several attempts, if in few; none withdrawn.

    Each at the pose that was achieved, where that is known.
    """
    # Said literally, as the partial index has it.
    once, several = (f"outcome = {SUCCESS}",), ("successes > 0",)
    return _read(tx, object_id, provenance_ids, after_seq, (*_READ, "batch_id"), once, several)


def posted(
    tx: Tx,
    object_id: int,
    provenance_ids: Collection[int],
    *,
    after_seq: int = 0,
    without: Collection[int] = (),
) -> TrialColumns:
    """Trials that no sweep stored, at the poses achieved, ascending ``seq``, but for those with the outcome
    codes ``without`` and those withdrawn.
    """
    codes = ", ".join(str(int(code)) for code in without)
    # Only a sweep's trials have a place in a plan.
    conditions = ["pose_index IS NULL", *([f"outcome NOT IN ({codes})"] if codes else [])]
    return _read(tx, object_id, provenance_ids, after_seq, _READ, conditions, conditions)


def _read(
    tx: Tx,
    object_id: int,
    provenance_ids: Collection[int],
    after_seq: int,
    columns: Sequence[str],
    of_once: Iterable[str],
    of_several: Iterable[str],
) -> TrialColumns:
    """Trials by conditions for those tried once, and for those tried several times."""
    asked = tx, object_id, provenance_ids, after_seq
    once = _read_some(*asked, columns, "attempts IS NULL", *of_once)
    # Said literally, as the partial index has it.
    several = _read_some(*asked, (*columns, *_SEVERAL), "attempts IS NOT NULL", *of_several)
    if not len(several):
        return once
    return (both := TrialColumns.joined([once, several]))[np.argsort(both.seq)]


def _read_some(
    tx: Tx,
    object_id: int,
    provenance_ids: Collection[int],
    after_seq: int,
    columns: Sequence[str],
    *conditions: str,
) -> TrialColumns:
    where = [*_after(object_id, after_seq), "withdrawn IS NULL", *conditions, _of_provenances(provenance_ids)]
    # NULL would make an array of Python objects; no proposal density is negative. What held or failed was
    # the achieved pose.
    known = {name: f"coalesce({achieved}, {name})" for name, achieved in zip(_POSE, _ACHIEVED, strict=True)}
    known["proposal_density"] = "coalesce(proposal_density, -1.0)"
    names = ", ".join(known.get(name, name) for name in columns)
    query = f"SELECT {names} FROM trials WHERE {' AND '.join(where)} ORDER BY seq"
    table = (_tuples if tx.dialect.name == "sqlite" else _copied)(tx, query, columns)
    proposal = table["proposal_density"].astype(np.float64)
    return TrialColumns(
        seq=table["seq"].astype(np.int64),
        position=np.stack([table[name].astype(np.float64) for name in _POSE[:3]], axis=1),
        quaternion_xyzw=np.stack([table[name].astype(np.float64) for name in _POSE[3:]], axis=1),
        proposal_density=np.where(proposal < 0, np.nan, proposal),
        provenance=table["provenance_id"].astype(np.int64),
        outcome=table["outcome"].astype(np.uint8),
        batch=table["batch_id"].astype(np.int64) if "batch_id" in columns else np.empty(0, dtype=np.int64),
        attempts=table["attempts"].astype(np.float64) if "attempts" in columns else np.empty(0),
        successes=table["successes"].astype(np.float64) if "successes" in columns else np.empty(0),
    )


def _after(object_id: int, after_seq: int) -> list[str]:
    return [f"object_id = {int(object_id)}", f"seq > {int(after_seq)}"]


def _of_provenances(ids: Collection[int]) -> str:
    return f"provenance_id IN ({', '.join(str(int(number)) for number in ids) or 'NULL'})"


def _tuples(tx: Tx, query: str, columns: Sequence[str]) -> Mapping[str, NDArray[Any]]:
    with closing(tx.connection.cursor()) as cursor:
        cursor.execute(query)
        # Straight into an array: lists of rows would take longer, and much more memory.
        rows = cast("Iterable[Sequence[float]]", cursor)
        table = np.fromiter(chain.from_iterable(rows), dtype=np.float64).reshape(-1, len(columns))
    return dict(zip(columns, table.T, strict=True))


def _copied(tx: Tx, query: str, columns: Sequence[str]) -> Mapping[str, NDArray[Any]]:
    with (
        closing(tx.connection.cursor()) as cursor,
        cursor.copy(f"COPY ({query}) TO STDOUT (FORMAT BINARY)") as copy,
    ):
        table = binary_copy.decode(b"".join(copy), columns)
    return {name: table[name] for name in columns}


def read_swept(tx: Tx, object_id: int, batch_id: int, first: int, last: int) -> tuple[Ints, Ints]:
    """Sequence numbers and pose indices of the trials a sweep's batch stored, ascending ``seq``."""
    table = _fetch(
        tx,
        f"SELECT seq, pose_index FROM trials WHERE object_id = {int(object_id)}"
        f" AND seq BETWEEN {int(first)} AND {int(last)} AND batch_id = {int(batch_id)} ORDER BY seq",
    )
    pairs = np.array(table, dtype=np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _fetch(tx: Tx, query: str) -> list[Any]:
    with closing(tx.connection.cursor()) as cursor:
        cursor.execute(query)
        return list(cursor.fetchall())


# --- reading everything ---------------------------------------------------------------------------------

_ALL = (
    "seq", "revision", "batch_id", "provenance_id", "outcome", *_POSE, "proposal_density", "quality",
    "width_m", "coalesce(pose_index, -1)", "measured_at", *_DOCUMENTS, "withdrawn IS NOT NULL",
    "coalesce(answer_number, -1)", *_ACHIEVED, "qualities", *_SEVERAL,
)  # fmt: skip


# long: every column of a trial in one list.
def page(
    tx: Tx,
    object_id: int,
    *,
    after_seq: int,
    limit: int,
    up_to_seq: int | None = None,
    outcome: int | None = None,
    provenance_ids: Sequence[int] | None = None,
    batch_ids: Collection[int] | None = None,
    since_revision: int | None = None,
    withdrawn: bool | None = None,
    answered: bool = False,
) -> TrialColumns:
    """Up to ``limit`` trials after a sequence number; ``since_revision`` keeps what was stored, corrected or
    withdrawn after it, ``answered`` what names an answer.
    """
    where = _after(object_id, after_seq)
    if provenance_ids is not None:
        where.append(_of_provenances(provenance_ids))
    for condition, value in (
        ("seq <=", up_to_seq),
        # Said literally, as the partial index has it.
        ("outcome =", outcome),
        ("revision >", since_revision),
    ):
        if value is not None:
            where.append(f"{condition} {int(value)}")
    if batch_ids is not None:
        where.append(f"batch_id IN ({', '.join(str(int(number)) for number in batch_ids) or 'NULL'})")
    if withdrawn is not None:
        where.append(f"withdrawn IS {'NOT NULL' if withdrawn else 'NULL'}")
    if answered:
        # Said literally, as the partial index has it.
        where.append("answer_number IS NOT NULL")
    rows = _fetch(
        tx,
        f"SELECT {', '.join(_ALL)} FROM trials WHERE {' AND '.join(where)} ORDER BY seq LIMIT {int(limit)}",
    )
    cells = list(zip(*rows, strict=True)) or [()] * len(_ALL)
    integers = [np.array(cells[i], dtype=np.int64) for i in (0, 1, 2, 3, 15)]
    # None becomes NaN.
    numbers = [np.array(cells[i], dtype=np.float64) for i in range(5, 15)]
    scores = qualities.unpacked(tx, cells[2], cells[28])
    return TrialColumns(
        seq=integers[0],
        revision=integers[1],
        batch=integers[2],
        provenance=integers[3],
        outcome=np.array(cells[4], dtype=np.uint8),
        position=np.stack(numbers[:3], axis=1),
        quaternion_xyzw=np.stack(numbers[3:7], axis=1),
        proposal_density=numbers[7],
        # A batch's first name stands in where only named ones were given.
        quality=np.where(np.isnan(numbers[8]), scores[:, 0], numbers[8]) if len(scores) else numbers[8],
        width_m=numbers[9],
        pose_index=integers[4],
        measured_at=[_time(value) for value in cells[16]],
        pose_covariance=[_document(value) for value in cells[17]],
        metadata=[_document(value) for value in cells[18]],
        withdrawn=np.array(cells[19], dtype=np.bool_),
        answer=np.array(cells[20], dtype=np.int64),
        achieved=np.array(cells[21:28], dtype=np.float64).T.reshape(-1, 7),
        attempts=np.array(cells[29], dtype=np.float64),
        successes=np.array(cells[30], dtype=np.float64),
        qualities=scores,
    )


def _time(value: Any) -> datetime | None:
    """PostgreSQL's driver makes times of them, SQLite keeps text."""
    if isinstance(value, str):
        return datetime.fromisoformat(value).replace(tzinfo=timezone.utc)
    return None if value is None else cast("datetime", value).astimezone(timezone.utc)


def _document(value: Any) -> Any:
    return json.loads(value) if isinstance(value, str) else value

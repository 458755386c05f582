"""Trials: rows, tallies and provenances; columns in, columns out, on the drivers' fast paths.

SQLAlchemy builds no statement a row here: SQLite takes tuples by ``executemany``, PostgreSQL binary COPY,
whose bytes NumPy lays out for a whole batch at once.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from sqlalchemy import and_, bindparam, func, select, update
from sqlalchemy import insert as plain_insert

from graspdb_service.storage.database import Tx
from graspdb_service.storage.tables import provenances as provenance_table
from graspdb_service.storage.tables import tallies as tally_table
from graspdb_service.storage.tables import trials as trial_table
from graspdb_service.storage.upsert import insert as upsert

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

SUCCESS = 1
COPY_ROWS = 50_000


@dataclass
class TrialColumns:
    """Trials to store, in columns.

    Shapes: ``position`` (n, 3) metres and ``quaternion_xyzw`` (n, 4), unit, of the tool in the object frame;
    ``outcome`` (n,) codes; ``provenance`` (n,) ids of :func:`provenance`. In the optional float columns NaN
    means none; ``measured_at`` is aware, ``pose_covariance`` 6x6 nested lists.
    """

    position: FloatArray
    quaternion_xyzw: FloatArray
    outcome: npt.NDArray[np.uint8]
    provenance: IntArray
    proposal_density: FloatArray | None = None
    quality: FloatArray | None = None
    width_m: FloatArray | None = None
    pose_index: IntArray | None = None
    measured_at: Sequence[datetime | None] | None = None
    pose_covariance: Sequence[list[list[float]] | None] | None = None
    metadata: Sequence[dict[str, Any] | None] | None = None

    def __len__(self) -> int:
        return len(self.position)


@dataclass(frozen=True)
class Columns:
    """Stored trials in columns, ascending ``seq``; NaN where a trial has no ``proposal_density``.

    ``batch`` is the internal id of each trial's batch, where it was asked for.
    """

    seq: IntArray
    position: FloatArray
    quaternion_xyzw: FloatArray
    outcome: npt.NDArray[np.uint8]
    proposal_density: FloatArray
    provenance: IntArray
    batch: IntArray | None = None

    def __len__(self) -> int:
        return len(self.seq)


@dataclass(frozen=True)
class ProvenanceRow:
    """What some of an object's trials have in common."""

    id: int
    gripper: str | None
    source: str | None
    protocol: str | None


def provenance(tx: Tx, object_id: int, gripper: str | None, source: str | None, protocol: str | None) -> int:
    """The id of this combination, made if it is new. Call it under the object's lock."""
    names = {"gripper": gripper, "source": source, "protocol": protocol}
    same = [provenance_table.c[name].is_not_distinct_from(value) for name, value in names.items()]
    known = tx.execute(
        select(provenance_table.c.id).where(provenance_table.c.object_id == object_id, and_(*same)).limit(1)
    ).scalar()
    if known is not None:
        return int(known)
    statement = (
        plain_insert(provenance_table).values(object_id=object_id, **names).returning(provenance_table.c.id)
    )
    return int(tx.execute(statement).scalar_one())


def provenances(tx: Tx, object_id: int) -> list[ProvenanceRow]:
    """Every combination the object's trials (or planned sweeps) have."""
    columns = (
        provenance_table.c.id,
        provenance_table.c.gripper,
        provenance_table.c.source,
        provenance_table.c.protocol,
    )
    query = select(*columns).where(provenance_table.c.object_id == object_id).order_by(provenance_table.c.id)
    return [ProvenanceRow(**row._mapping) for row in tx.execute(query)]


def insert(
    tx: Tx, object_id: int, batch_id: int, columns: TrialColumns, *, revision: int, first_seq: int
) -> None:
    """Store trials under the sequence numbers that ``objects.advance`` reserved, and count them."""
    if len(columns) == 0:
        return
    if tx.dialect.name == "sqlite":
        _insert_tuples(tx, object_id, batch_id, columns, revision, first_seq)
    else:
        for start in range(0, len(columns), COPY_ROWS):
            part = slice(start, start + COPY_ROWS)
            _copy_in(tx, object_id, batch_id, columns, revision, first_seq, part)
    pairs, counts = np.unique(
        np.stack([columns.provenance, columns.outcome.astype(np.int64)], axis=1), axis=0, return_counts=True
    )
    for (provenance_id, outcome), number in zip(pairs.tolist(), counts.tolist(), strict=True):
        add_tally(tx, provenance_id, outcome, rows=number)


def add_tally(tx: Tx, provenance_id: int, outcome: int, *, rows: int = 0, packed: int = 0) -> None:
    """Count trials of a provenance and an outcome code; negative numbers take them out."""
    statement = upsert(tx, tally_table).values(
        provenance_id=provenance_id, outcome=outcome, row_count=rows, packed_count=packed
    )
    tx.execute(
        statement.on_conflict_do_update(
            index_elements=[tally_table.c.provenance_id, tally_table.c.outcome],
            set_={
                "row_count": tally_table.c.row_count + statement.excluded.row_count,
                "packed_count": tally_table.c.packed_count + statement.excluded.packed_count,
            },
        )
    )


def add_packed(tx: Tx, provenance_id: int, counts: dict[int, int]) -> None:
    """Count packed outcomes by code; negative numbers take them out."""
    for outcome, number in sorted(counts.items()):
        if number:
            add_tally(tx, provenance_id, outcome, packed=number)


def tallies(tx: Tx, object_id: int) -> list[tuple[int, int, int, int]]:
    """``(provenance_id, outcome_code, rows, packed)`` for all the object's trials."""
    query = (
        select(tally_table)
        .join(provenance_table, provenance_table.c.id == tally_table.c.provenance_id)
        .where(provenance_table.c.object_id == object_id)
        .order_by(tally_table.c.provenance_id, tally_table.c.outcome)
    )
    return [(int(p), int(o), int(r), int(k)) for p, o, r, k in tx.execute(query)]


def outcome_counts(tx: Tx, object_ids: Sequence[int]) -> dict[int, dict[int, int]]:
    """Rows and packed outcomes together, by object and outcome code."""
    found: dict[int, dict[int, int]] = {object_id: {} for object_id in object_ids}
    total = func.sum(tally_table.c.row_count + tally_table.c.packed_count)
    query = (
        select(provenance_table.c.object_id, tally_table.c.outcome, total)
        .join(tally_table, provenance_table.c.id == tally_table.c.provenance_id)
        .where(provenance_table.c.object_id.in_(object_ids))
        .group_by(provenance_table.c.object_id, tally_table.c.outcome)
    )
    for object_id, outcome, number in tx.execute(query):
        if number:
            found[int(object_id)][int(outcome)] = int(number)
    return found


def swept_rows(tx: Tx, object_id: int, batch_id: int, first: int, last: int) -> tuple[IntArray, IntArray]:
    """Sequence numbers and pose indices of the trials a sweep's batch stored, ascending ``seq``."""
    cursor = tx.connection.cursor()
    try:
        cursor.execute(
            f"SELECT seq, pose_index FROM trials WHERE object_id = {int(object_id)}"
            f" AND seq BETWEEN {int(first)} AND {int(last)} AND batch_id = {int(batch_id)} ORDER BY seq"
        )
        table = np.array(cursor.fetchall(), dtype=np.int64).reshape(-1, 2)
    finally:
        cursor.close()
    return table[:, 0], table[:, 1]


def move(
    tx: Tx, object_id: int, *, from_batch: int, to_batch: int, ranges: Sequence[tuple[int, int]]
) -> None:
    """Give the trials of a batch in these ranges of sequence numbers to another; under the object's lock."""
    statement = (
        update(trial_table)
        .where(
            trial_table.c.object_id == object_id,
            trial_table.c.batch_id == from_batch,
            trial_table.c.seq.between(bindparam("first"), bindparam("last")),
        )
        .values(batch_id=to_batch)
    )
    tx.execute(statement, [{"first": first, "last": last} for first, last in ranges])


# --- reading columns ------------------------------------------------------------------------------------

_READ = ("seq", "px", "py", "pz", "qx", "qy", "qz", "qw", "proposal_density", "provenance_id", "outcome")
_KINDS = {"seq": ">i8", "provenance_id": ">i8", "batch_id": ">i8", "outcome": ">i2"}


def _binary_row(names: Sequence[str]) -> np.dtype[Any]:
    """A row of binary COPY without nulls."""
    fields = [item for n in names for item in ((f"{n}_bytes", ">i4"), (n, _KINDS.get(n, ">f8")))]
    return np.dtype([("fields", ">i2"), *fields])


def read(
    tx: Tx,
    object_id: int,
    *,
    provenance_ids: Sequence[int] | None,
    successes_only: bool,
    after_seq: int = 0,
    swept: bool = True,
    without: Sequence[int] = (),
    batches: bool = False,
) -> Columns:
    """An object's trials as arrays, ascending ``seq``, those after ``after_seq``.

    ``swept=False`` leaves out those that a sweep stored, ``without`` those with these outcome codes;
    ``batches`` reads which batch each is of.
    """
    where = f"object_id = {int(object_id)} AND seq > {int(after_seq)}"
    if not swept:
        # Only a sweep's trials have a place in a plan.
        where += " AND pose_index IS NULL"
    if without:
        where += f" AND outcome NOT IN ({', '.join(str(int(code)) for code in without)})"
    if successes_only:
        # Said literally, as the partial index has it.
        where += f" AND outcome = {SUCCESS}"
    if provenance_ids is not None:
        where += f" AND provenance_id IN ({', '.join(str(int(p)) for p in provenance_ids) or 'NULL'})"
    columns = (*_READ, "batch_id") if batches else _READ
    if tx.dialect.name == "sqlite":
        return _read_tuples(tx, columns, where)
    return _copy_out(tx, columns, where)


def _read_tuples(tx: Tx, columns: Sequence[str], where: str) -> Columns:
    # NULL would make an array of Python objects; no proposal density is negative.
    names = ", ".join(f"coalesce({name}, -1.0)" if name == "proposal_density" else name for name in columns)
    cursor = tx.connection.cursor()
    try:
        cursor.execute(f"SELECT {names} FROM trials WHERE {where} ORDER BY seq")
        # Straight into an array: lists of rows would take longer, and much more memory.
        rows = cast("Iterable[Sequence[float]]", cursor)
        table = np.fromiter(chain.from_iterable(rows), dtype=np.float64).reshape(-1, len(columns))
    finally:
        cursor.close()
    proposal = np.where(table[:, 8] < 0, np.nan, table[:, 8])
    return Columns(
        seq=table[:, 0].astype(np.int64),
        position=np.ascontiguousarray(table[:, 1:4]),
        quaternion_xyzw=np.ascontiguousarray(table[:, 4:8]),
        outcome=table[:, 10].astype(np.uint8),
        proposal_density=proposal,
        provenance=table[:, 9].astype(np.int64),
        batch=table[:, 11].astype(np.int64) if len(columns) > len(_READ) else None,
    )


def _copy_out(tx: Tx, columns: Sequence[str], where: str) -> Columns:
    names = ", ".join(
        f"coalesce({name}, 'NaN'::float8)" if name == "proposal_density" else name for name in columns
    )
    cursor = tx.connection.cursor()
    try:
        query = f"COPY (SELECT {names} FROM trials WHERE {where} ORDER BY seq) TO STDOUT (FORMAT BINARY)"
        with cursor.copy(query) as copy:
            content = b"".join(copy)
    finally:
        cursor.close()
    # No column is null, so every row has the same width.
    layout = _binary_row(columns)
    rows = (len(content) - len(_COPY_HEADER) - len(_COPY_END)) // layout.itemsize
    table = np.frombuffer(content, dtype=layout, count=rows, offset=len(_COPY_HEADER))
    return Columns(
        seq=table["seq"].astype(np.int64),
        position=np.stack([table[name].astype(np.float64) for name in ("px", "py", "pz")], axis=1),
        quaternion_xyzw=np.stack(
            [table[name].astype(np.float64) for name in ("qx", "qy", "qz", "qw")], axis=1
        ),
        outcome=table["outcome"].astype(np.uint8),
        proposal_density=table["proposal_density"].astype(np.float64),
        provenance=table["provenance_id"].astype(np.int64),
        batch=table["batch_id"].astype(np.int64) if "batch_id" in columns else None,
    )


# --- writing rows ---------------------------------------------------------------------------------------

_PLAIN = (
    "object_id", "seq", "revision", "batch_id", "provenance_id", "outcome",
    "px", "py", "pz", "qx", "qy", "qz", "qw",
    "proposal_density", "quality", "width_m", "pose_index", "measured_at",
)  # fmt: skip
_DOCUMENTS = ("pose_covariance", "metadata")
_COPY_HEADER = b"PGCOPY\n\xff\r\n\x00" + struct.pack(">ii", 0, 0)
_COPY_END = struct.pack(">h", -1)
_POSTGRES_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)


def _insert_tuples(
    tx: Tx, object_id: int, batch_id: int, columns: TrialColumns, revision: int, first_seq: int
) -> None:
    count = len(columns)
    # What all rows share stands in the statement, and what none has is left out: binding is half the time.
    shared = {"object_id": object_id, "revision": revision, "batch_id": batch_id}
    lists: dict[str, Iterable[Any]] = {
        "seq": range(first_seq, first_seq + count),
        "provenance_id": columns.provenance.tolist(),
        "outcome": columns.outcome.tolist(),
        **dict(zip(("px", "py", "pz"), columns.position.T.tolist(), strict=True)),
        **dict(zip(("qx", "qy", "qz", "qw"), columns.quaternion_xyzw.T.tolist(), strict=True)),
    }
    for name in ("proposal_density", "quality", "width_m"):
        values = getattr(columns, name)
        if values is not None:
            given = values.astype(object)
            given[np.isnan(values)] = None
            lists[name] = given.tolist()
    if columns.pose_index is not None:
        lists["pose_index"] = columns.pose_index.tolist()
    for name, convert in (
        ("measured_at", _sqlite_time),
        ("pose_covariance", _json_text),
        ("metadata", _json_text),
    ):
        values = getattr(columns, name)
        if values is not None:
            lists[name] = [None if value is None else convert(value) for value in values]
    names = ", ".join([*shared, *lists])
    places = ", ".join([str(int(value)) for value in shared.values()] + ["?"] * len(lists))
    rows = zip(*lists.values(), strict=True)
    cursor = tx.connection.cursor()
    try:
        # The driver takes any iterator: no list of tuples is built.
        cursor.executemany(f"INSERT INTO trials ({names}) VALUES ({places})", rows)  # type: ignore[arg-type]
    finally:
        cursor.close()


def _sqlite_time(value: datetime) -> str:
    return value.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S.%f")


def _json_text(value: Any) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))


def _copy_in(
    tx: Tx,
    object_id: int,
    batch_id: int,
    columns: TrialColumns,
    revision: int,
    first_seq: int,
    part: slice,
) -> None:
    start, stop, _ = part.indices(len(columns))
    count = stop - start
    documents = [
        (name, items[part])
        for name in _DOCUMENTS
        if (items := getattr(columns, name)) is not None and any(item is not None for item in items[part])
    ]
    values: dict[str, Any] = {
        "object_id": object_id,
        "seq": np.arange(first_seq + start, first_seq + stop),
        "revision": revision,
        "batch_id": batch_id,
        "provenance_id": columns.provenance[part],
        "outcome": columns.outcome[part],
        **{name: columns.position[part, i] for i, name in enumerate(("px", "py", "pz"))},
        **{name: columns.quaternion_xyzw[part, i] for i, name in enumerate(("qx", "qy", "qz", "qw"))},
    }
    nulls: dict[str, npt.NDArray[np.bool_]] = {}
    for name in ("proposal_density", "quality", "width_m"):
        column = getattr(columns, name)
        if column is not None:
            values[name] = column[part]
            nulls[name] = np.isnan(column[part])
    if columns.pose_index is not None:
        values["pose_index"] = columns.pose_index[part]
    if columns.measured_at is not None:
        times = [_postgres_time(value) for value in columns.measured_at[part]]
        nulls["measured_at"] = np.array([value is None for value in times])
        values["measured_at"] = np.array([value or 0 for value in times], dtype=np.int64)
    rows, kept = _binary_rows(count, values, nulls, fields=len(_PLAIN) + len(documents))
    if documents:
        content = _append_documents(rows, kept, [items for _, items in documents])
    else:
        content = rows.tobytes() if kept is None else rows[kept].tobytes()
    names = ", ".join([*_PLAIN, *(name for name, _ in documents)])
    cursor = tx.connection.cursor()
    try:
        with cursor.copy(f"COPY trials ({names}) FROM STDIN (FORMAT BINARY)") as copy:
            copy.write(_COPY_HEADER + content + _COPY_END)
    finally:
        cursor.close()


def _binary_rows(
    count: int, values: dict[str, Any], nulls: dict[str, npt.NDArray[np.bool_]], *, fields: int
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_] | None]:
    """PostgreSQL's binary COPY rows as bytes (count, width), and which bytes to keep (None: all).

    A field is its length as int32 and its value, big-endian; null is the length -1 and no value. A column
    that is null throughout has no value bytes; one that is null here and there has them masked out.
    """
    layout: list[tuple[str, str]] = [("fields", ">i2")]
    for name in _PLAIN:
        layout.append((f"{name}_bytes", ">i4"))
        if name in values:
            integer = name in ("object_id", "seq", "revision", "batch_id", "provenance_id", "pose_index")
            kind = ">i8" if integer or name == "measured_at" else ">i2" if name == "outcome" else ">f8"
            layout.append((name, kind))
    dtype = np.dtype(layout)
    table = np.zeros(count, dtype=dtype)
    table["fields"] = fields
    kept: npt.NDArray[np.bool_] | None = None
    for name in _PLAIN:
        if name not in values:
            table[f"{name}_bytes"] = -1
            continue
        table[name] = values[name]
        table[f"{name}_bytes"] = dtype[name].itemsize
        missing = nulls.get(name)
        if missing is not None and missing.any():
            table[f"{name}_bytes"][missing] = -1
            if kept is None:
                kept = np.ones((count, dtype.itemsize), dtype=np.bool_)
            field = dtype.fields
            assert field is not None
            offset = field[name][1]
            kept[missing, offset : offset + dtype[name].itemsize] = False
    return table.view(np.uint8).reshape(count, dtype.itemsize), kept


def _append_documents(
    rows: npt.NDArray[np.uint8], kept: npt.NDArray[np.bool_] | None, documents: list[Sequence[Any]]
) -> bytes:
    pieces = []
    for number, row in enumerate(rows):
        pieces.append((row if kept is None else row[kept[number]]).tobytes())
        for items in documents:
            item = items[number]
            text = None if item is None else _json_text(item).encode()
            pieces.append(struct.pack(">i", -1) if text is None else struct.pack(">i", len(text)) + text)
    return b"".join(pieces)


def _postgres_time(value: datetime | None) -> int | None:
    if value is None:
        return None
    since = value.astimezone(UTC) - _POSTGRES_EPOCH
    return (since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds


# --- reading rows ---------------------------------------------------------------------------------------


class TrialRow(NamedTuple):
    """One stored trial, column by column."""

    seq: int
    revision: int
    batch_id: int
    provenance_id: int
    outcome: int
    px: float
    py: float
    pz: float
    qx: float
    qy: float
    qz: float
    qw: float
    proposal_density: float | None
    quality: float | None
    width_m: float | None
    pose_index: int | None
    measured_at: datetime | None
    pose_covariance: list[list[float]] | None
    metadata: dict[str, Any] | None


def page(
    tx: Tx,
    object_id: int,
    *,
    after_seq: int,
    limit: int,
    up_to_seq: int | None = None,
    outcome: int | None = None,
    provenance_ids: Sequence[int] | None = None,
    batch_id: int | None = None,
    since_revision: int | None = None,
) -> list[TrialRow]:
    """Up to ``limit`` trials after a sequence number; ``since_revision`` keeps what was stored after it."""
    where = [f"object_id = {int(object_id)}", f"seq > {int(after_seq)}"]
    if up_to_seq is not None:
        where.append(f"seq <= {int(up_to_seq)}")
    if outcome is not None:
        # Said literally, as the partial index has it.
        where.append(f"outcome = {int(outcome)}")
    if provenance_ids is not None:
        where.append(f"provenance_id IN ({', '.join(str(int(p)) for p in provenance_ids) or 'NULL'})")
    if batch_id is not None:
        where.append(f"batch_id = {int(batch_id)}")
    if since_revision is not None:
        where.append(f"revision > {int(since_revision)}")
    query = (
        f"SELECT {', '.join(TrialRow._fields)} FROM trials WHERE {' AND '.join(where)}"
        f" ORDER BY seq LIMIT {int(limit)}"
    )
    cursor = tx.connection.cursor()
    try:
        cursor.execute(query)
        rows = [TrialRow._make(row) for row in cursor.fetchall()]
    finally:
        cursor.close()
    return [row if row[-3:] == _NOTHING else _decoded(row) for row in rows]


_NOTHING = (None, None, None)


def _decoded(row: TrialRow) -> TrialRow:
    """With times and documents as Python's own: PostgreSQL's driver has done that, SQLite keeps text."""
    time, covariance, metadata = row[-3:]
    if isinstance(time, str):
        time = datetime.fromisoformat(time).replace(tzinfo=UTC)
    elif time is not None:
        time = time.astimezone(UTC)
    return row._replace(
        measured_at=time,
        pose_covariance=json.loads(covariance) if isinstance(covariance, str) else covariance,
        metadata=json.loads(metadata) if isinstance(metadata, str) else metadata,
    )

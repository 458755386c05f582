"""Trials in Arrow: a request's stream to a checked batch, and stored rows to record batches."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES, OUTCOMES
from graspdb.wire.base import MAX_QUALITIES
from graspdb_service.formats import arrow
from graspdb_service.formats.trial_fields import (
    NAMES,
    QUALITIES,
    SCALARS,
    SEVERAL,
    Faults,
    blocks_of,
    check_blocks,
    defaults_of,
    refuse_too_many,
    sliced,
)
from graspdb_service.formats.trial_json import columns_of
from graspdb_service.problems import invalid
from graspdb_service.trial_columns import Floats, Provenance, TrialBatch, TrialPage


def parse(body: bytes, *, limit: int) -> TrialBatch:
    """Check a stream of trials; refused as in :mod:`graspdb_service.formats.trial_json`, 415 without pyarrow.

    Columns have the names of a trial's fields; ``outcome`` is text (or a dictionary of it) or boolean,
    ``measured_at`` a timestamp (UTC where it names no zone) or text, ``metadata`` a struct or JSON text,
    ``pose_covariance`` lists of lists or of 36 numbers, ``achieved_pose`` a struct, ``qualities`` a struct of
    numbers or a column ``qualities.NAME`` each. What holds for the whole
    batch stands as JSON in the schema's metadata, key ``graspdb``.
    """
    table = arrow.Table(body, NAMES, family="qualities")
    if not table.count:
        raise invalid("columns.position", "at least one trial")
    refuse_too_many(table.count, limit)
    lists: dict[str, Sequence[Any] | NDArray[Any]] = {
        "position": table.vectors("position", 3),
        "quaternion_xyzw": table.vectors("quaternion_xyzw", 4),
        "outcome": _outcomes(table),
    }
    scores = [name for name in table.names if name.startswith(QUALITIES)]
    if len(scores) > MAX_QUALITIES:
        raise invalid("columns.qualities", f"numbers of at most {MAX_QUALITIES} names")
    for name in (*SCALARS, *scores):
        values = table.scalars(name)
        if values is not None:
            lists[name] = values
    for name in (*Provenance._fields, "answer"):
        found = table.texts(name)
        if found is not None:
            texts, which = found
            # The last one stands for null, whose place is -1.
            lists[name] = np.array([*texts, None], dtype=object)[which].tolist()
    converted = {
        "measured_at": None,
        "achieved_pose": None,
        "pose_covariance": _square,
        "metadata": _document,
    }
    for name, convert in converted.items():
        items = table.objects(name)
        if items is not None:
            lists[name] = items if convert is None else [None if x is None else convert(x) for x in items]
    faults = Faults()
    defaults = defaults_of(table.options, faults, "columns")
    blocks = blocks_of({name: sliced(values) for name, values in lists.items()}, _place, faults)
    return check_blocks(blocks, defaults, _place, limit)


def _place(row: int, name: str) -> str:
    return f"columns.{name}.{row}"


def _outcomes(table: arrow.Table) -> NDArray[np.uint8]:
    flags = table.booleans("outcome")
    if flags is not None:
        return flags.astype(np.uint8)
    found = table.texts("outcome")
    assert found is not None
    names, which = found
    codes = np.array([OUTCOME_CODES.get(name, -1) for name in names], dtype=np.int64)[which]
    wrong = np.flatnonzero(codes < 0)
    if wrong.size:
        table.fault("outcome", int(wrong[0]), f"one of {', '.join(OUTCOMES)}, true or false")
    return codes.astype(np.uint8)


def _square(value: Any) -> Any:
    """36 numbers as 6 rows; anything else as it is, for its check to refuse."""
    if isinstance(value, list) and len(value) == 36:
        return [value[i : i + 6] for i in range(0, 36, 6)]
    return value


def _document(value: Any) -> Any:
    """JSON text as what it says; anything else as it is."""
    if not isinstance(value, str):
        return value
    try:
        return orjson.loads(value)
    except orjson.JSONDecodeError:
        return value


# -- out -----------------------------------------------------------------------------------------------------


def stream(pages: Iterable[TrialPage], told: dict[str, Any]) -> Iterator[bytes]:
    """Stored trials of one object as an Arrow IPC stream, of one page at least; what else is ``told``, and
    what the first page warns of, stands in its schema's metadata.
    """
    rest = iter(pages)
    first = next(rest)
    schema = _schema(first.qualities, {**told, "warnings": list(first.warnings)})
    return arrow.stream(
        schema, (_record_batch(page, schema) for page in chain([first], rest) if len(page.columns))
    )


def _schema(qualities: Sequence[str], told: dict[str, Any]) -> Any:
    """The columns of stored trials, as ``GET /objects/{id}/trials`` has them."""
    pa = arrow.library()
    achieved = [("position", arrow.vector_type(3)), ("quaternion_xyzw", arrow.vector_type(4))]
    return arrow.schema_of(
        [
            ("seq", pa.int64()),
            ("revision", pa.int64()),
            ("batch", pa.string()),
            ("position", arrow.vector_type(3)),
            ("quaternion_xyzw", arrow.vector_type(4)),
            ("outcome", arrow.outcome_type()),
            ("gripper", pa.string()),
            ("gripper_version", pa.int64()),
            ("source", pa.string()),
            ("protocol", pa.string()),
            ("engine", pa.string()),
            *((name, pa.float64()) for name in SCALARS if name not in SEVERAL),
            *((name, pa.int32()) for name in SEVERAL),
            ("pose_covariance", pa.list_(pa.list_(pa.float64()))),
            ("measured_at", pa.timestamp("us", "UTC")),
            ("metadata", pa.string()),
            ("sweep", pa.string()),
            ("pose_index", pa.int64()),
            ("answer", pa.string()),
            ("achieved_pose", pa.struct(achieved)),
            ("withdrawn", pa.bool_()),
            *((f"{QUALITIES}{name}", pa.float64()) for name in qualities),
        ],
        told,
    )


def _record_batch(page: TrialPage, schema: Any) -> Any:
    pa, columns = arrow.library(), dict[str, Any](columns_of(page))
    texts = [None if value is None else orjson.dumps(value).decode() for value in columns["metadata"]]
    columns |= {
        "position": arrow.vectors(columns["position"], 3),
        "quaternion_xyzw": arrow.vectors(columns["quaternion_xyzw"], 4),
        "outcome": arrow.outcome_names(columns["outcome"]),
        **{name: arrow.numbers(columns[name]) for name in SCALARS if name not in SEVERAL},
        **{name: arrow.numbers(columns[name]).cast(pa.int32()) for name in SEVERAL},
        "metadata": texts,
        "pose_index": pa.array(columns["pose_index"], mask=columns["pose_index"] < 0),
    }
    columns |= {f"{QUALITIES}{name}": arrow.numbers(x) for name, x in _scores(page).items()}
    filled = [
        column if isinstance(column, pa.Array) else pa.array(column, schema.field(name).type)
        for name, column in columns.items()
    ]
    return pa.record_batch(filled, schema=schema)


def _scores(page: TrialPage) -> dict[str, Floats]:
    """Each quality of the object's trials as a column (n,), NaN for none."""
    columns = page.columns
    scores = {name: np.full(len(columns), np.nan) for name in page.qualities}
    if len(columns.qualities):
        for number in np.unique(columns.batch).tolist():
            rows = columns.batch == number
            for place, name in enumerate(page.batches[number].qualities):
                scores[name][rows] = columns.qualities[rows, place]
    return scores

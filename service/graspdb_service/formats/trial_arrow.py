"""Trials in Arrow: a request's stream to a checked batch, and stored rows to record batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES, OUTCOMES
from graspdb_service.formats import arrow
from graspdb_service.formats.trial_json import COLUMNS, Fields, TrialBatch, check, refuse_too_many
from graspdb_service.problems import invalid

_SCALARS = ("proposal_density", "quality", "width_m")
_TEXTS = ("gripper", "source", "protocol")


def parse(body: bytes, *, limit: int) -> TrialBatch:
    """Check a stream of trials.

    Columns have the names of a trial's fields; ``outcome`` is text (or a dictionary of it) or boolean,
    ``measured_at`` a timestamp (UTC where it names no zone) or text, ``metadata`` a struct or JSON text,
    ``pose_covariance`` lists of lists or of 36 numbers. What holds for the whole batch stands as JSON in the
    schema's metadata, key ``graspdb``.

    Raises
    ------
    ProblemError
        As :func:`graspdb_service.formats.trial_json.parse`.
    """
    table = arrow.Table(body, COLUMNS)
    if not table.count:
        raise invalid("columns.position", "at least one trial")
    refuse_too_many(table.count, limit)
    lists: dict[str, Sequence[Any] | NDArray[Any]] = {
        "position": table.vectors("position", 3),
        "quaternion_xyzw": table.vectors("quaternion_xyzw", 4),
        "outcome": _outcomes(table),
    }
    for name in _SCALARS:
        values = table.scalars(name)
        if values is not None:
            lists[name] = values
    for name in _TEXTS:
        found = table.texts(name)
        if found is not None:
            texts, which = found
            # The last one stands for null, whose place is -1.
            lists[name] = np.array([*texts, None], dtype=object)[which].tolist()
    for name, convert in (("measured_at", None), ("pose_covariance", _square), ("metadata", _document)):
        items = table.objects(name)
        if items is not None:
            lists[name] = items if convert is None else [None if x is None else convert(x) for x in items]
    return check(Fields(lists, table.count, lambda i, name: f"columns.{name}.{i}"), table.options)


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


def schema(told: dict[str, Any] | None = None) -> Any:
    """The columns of stored trials, as ``GET /objects/{id}/trials`` has them."""
    pa = arrow.library()
    return arrow.schema_of(
        [
            ("seq", pa.int64()),
            ("revision", pa.int64()),
            ("batch", pa.string()),
            ("position", arrow.vector_type(3)),
            ("quaternion_xyzw", arrow.vector_type(4)),
            ("outcome", arrow.outcome_type()),
            *((name, pa.string()) for name in _TEXTS),
            *((name, pa.float64()) for name in _SCALARS),
            ("pose_covariance", pa.list_(pa.list_(pa.float64()))),
            ("measured_at", pa.timestamp("us", "UTC")),
            ("metadata", pa.string()),
            ("sweep", pa.string()),
            ("pose_index", pa.int64()),
        ],
        told,
    )


def batch_of(items: Sequence[dict[str, Any]]) -> Any:
    """Rows as :mod:`graspdb_service.usecases.trials.posting` reads them, in columns."""
    pa, columns = arrow.library(), []
    for field in schema():
        values = [item[field.name] for item in items]
        if field.name in ("position", "quaternion_xyzw"):
            width = field.type.list_size
            columns.append(arrow.vectors(np.array(values, dtype=np.float64).reshape(-1, width), width))
        elif field.name == "outcome":
            codes = np.array([OUTCOME_CODES[name] for name in values], dtype=np.uint8)
            columns.append(arrow.outcome_names(codes))
        elif field.name == "metadata":
            texts = [None if value is None else orjson.dumps(value).decode() for value in values]
            columns.append(pa.array(texts, pa.string()))
        else:
            columns.append(pa.array(values, field.type))
    return pa.record_batch(columns, schema=schema())

"""PostgreSQL's binary COPY of trials, laid out by NumPy for a whole batch at once.

A row is the number of its fields (int16) and the fields; a field is its length (int32) and its value, both
big-endian; null is the length -1 and no value.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from datetime import datetime, timezone
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb_service.trial_columns import Bools, json_text

HEADER = b"PGCOPY\n\xff\r\n\x00" + struct.pack(">ii", 0, 0)
END = struct.pack(">h", -1)

_INTEGERS = (
    "object_id",
    "seq",
    "revision",
    "batch_id",
    "provenance_id",
    "pose_index",
    "measured_at",
    "answer_number",
)
_SHORT = {"outcome": ">i2", "attempts": ">i4", "successes": ">i4"}
_EPOCH = datetime(2000, 1, 1, tzinfo=timezone.utc)


def _kind(name: str, values: Any = None) -> Any:
    if name == "qualities":
        return values.dtype
    return ">i8" if name in _INTEGERS else _SHORT.get(name, ">f8")


def encode(
    count: int,
    values: dict[str, Any],
    nulls: dict[str, Bools],
    documents: Sequence[Sequence[Any]],
) -> bytes:
    """``count`` rows of the columns ``values``, null where ``nulls`` says so, and of JSON ``documents``."""
    layout: list[tuple[str, Any]] = [("fields", ">i2")]
    for name, value in values.items():
        layout += [(f"{name}_bytes", ">i4"), (name, _kind(name, value))]
    dtype = np.dtype(layout)
    table = np.zeros(count, dtype=dtype)
    table["fields"] = len(values) + len(documents)
    # Which bytes to keep (None: all): a null's value has none.
    kept: Bools | None = None
    for name, value in values.items():
        table[name] = value
        table[f"{name}_bytes"] = dtype[name].itemsize
        missing = nulls.get(name)
        if missing is not None and missing.any():
            table[f"{name}_bytes"][missing] = -1
            if kept is None:
                kept = np.ones((count, dtype.itemsize), dtype=np.bool_)
            assert dtype.fields is not None
            offset = dtype.fields[name][1]
            kept[missing, offset : offset + dtype[name].itemsize] = False
    rows = table.view(np.uint8).reshape(count, dtype.itemsize)
    if documents:
        body = _with_documents(rows, kept, documents)
    else:
        body = rows.tobytes() if kept is None else rows[kept].tobytes()
    return HEADER + body + END


def _with_documents(rows: NDArray[np.uint8], kept: Bools | None, documents: Sequence[Sequence[Any]]) -> bytes:
    pieces = []
    for number, row in enumerate(rows):
        pieces.append((row if kept is None else row[kept[number]]).tobytes())
        for items in documents:
            item = items[number]
            text = None if item is None else json_text(item).encode()
            pieces.append(struct.pack(">i", -1) if text is None else struct.pack(">i", len(text)) + text)
    return b"".join(pieces)


def decode(content: bytes, names: Sequence[str]) -> NDArray[Any]:
    """A structured array of columns none of which is null, so that every row has the same width."""
    fields = [item for name in names for item in ((f"{name}_bytes", ">i4"), (name, _kind(name)))]
    layout = np.dtype([("fields", ">i2"), *fields])
    count = (len(content) - len(HEADER) - len(END)) // layout.itemsize
    return np.frombuffer(content, dtype=layout, count=count, offset=len(HEADER))


def microseconds(value: datetime | None) -> int:
    """A time as PostgreSQL counts it, from 2000 on; 0 for None."""
    if value is None:
        return 0
    since = value.astimezone(timezone.utc) - _EPOCH
    return (since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds

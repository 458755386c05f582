"""Named scores of trials, packed: numbers in a row's column, their names and types once in its batch's.

A million rows of five scores would take 300 MB as JSON with names, and take 40 MB or less so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select, update

from graspdb_service.storage.database import Tx
from graspdb_service.storage.tables import batches, objects
from graspdb_service.trial_columns import Floats, TrialColumns

#: Narrowest first: flags and counts take two bytes, what was measured in single precision four.
_TYPES = ("<f2", "<f4", "<f8")

Layout = list[list[str]]
"""The name and the type of each score, in their order."""


def layout_of(names: Sequence[str], scores: Floats) -> Layout | None:
    """How scores (n, k), NaN for none, are packed without loss; None without any."""
    return [[name, _type(column)] for name, column in zip(names, scores.T, strict=True)] if names else None


def _type(column: Floats) -> str:
    for kind in _TYPES[:-1]:
        with np.errstate(over="ignore"):
            narrow = column.astype(kind).astype(np.float64)
        if np.array_equal(narrow, column, equal_nan=True):
            return kind
    return _TYPES[-1]


def _dtype(layout: Layout) -> np.dtype[Any]:
    return np.dtype([(f"{place}", kind) for place, (_, kind) in enumerate(layout)])


def packed(columns: TrialColumns, layout: Layout) -> NDArray[Any]:
    """The scores of each trial as bytes of one width (n,)."""
    dtype = _dtype(layout)
    table = np.empty(len(columns), dtype=dtype)
    for place, column in enumerate(columns.qualities.T):
        table[str(place)] = column
    return table.view(f"V{dtype.itemsize}")


def unpacked(tx: Tx, batch_ids: Sequence[int], cells: Sequence[bytes | None]) -> Floats:
    """Scores (n, k) of rows of these batches, in the order of each batch's names; empty without any."""
    with_some = {number for number, cell in zip(batch_ids, cells, strict=True) if cell is not None}
    layouts = _layouts(tx, with_some)
    if not layouts:
        return np.empty(0)
    scores = np.full((len(cells), max(map(len, layouts.values()))), np.nan)
    rows: dict[int, list[int]] = {number: [] for number in layouts}
    for row, (number, cell) in enumerate(zip(batch_ids, cells, strict=True)):
        if cell is not None:
            rows[number].append(row)
    for number, layout in layouts.items():
        # PostgreSQL's driver gives bytes, or a view of them.
        content = b"".join(bytes(cells[row] or b"") for row in rows[number])
        table = np.frombuffer(content, dtype=_dtype(layout))
        for place in range(len(layout)):
            scores[rows[number], place] = table[str(place)]
    return scores


def _layouts(tx: Tx, batch_ids: set[int]) -> Mapping[int, Layout]:
    if not batch_ids:
        return {}
    query = select(batches.c.id, batches.c.quality_layout).where(batches.c.id.in_(sorted(batch_ids)))
    return {int(number): layout for number, layout in tx.execute(query)}


def names_of(layout: Layout | None) -> tuple[str, ...]:
    """The names that a layout has."""
    return tuple(name for name, _ in layout or ())


def names(tx: Tx, object_id: int) -> list[str]:
    """Names of the qualities that an object's trials have, or had."""
    return tx.scalar(select(objects.c.quality_names).where(objects.c.id == object_id)) or []


def keep_names(tx: Tx, object_id: int, all_names: Sequence[str]) -> None:
    """Store the names of all qualities of an object's trials. Call it under the object's lock."""
    tx.execute(update(objects).where(objects.c.id == object_id).values(quality_names=list(all_names)))

"""Reading hostile JSON of a glTF document: every value is checked before it is used."""

from __future__ import annotations

from typing import Any

import numpy as np

from graspdb_geometry.mesh_reading.content import FloatArray, FormatError


def entries_of(document: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """The objects of a list, none where it is missing."""
    entries = document.get(name, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise FormatError(f"'{name}' of the GLB is not a list of objects")
    return entries


def entry_at(entries: list[dict[str, Any]], number: int, kind: str) -> dict[str, Any]:
    """An object that another one refers to."""
    if number >= len(entries):
        raise FormatError(f"the GLB refers to {kind} {number}, which does not exist")
    return entries[number]


def integer_of(entry: dict[str, Any], name: str, default: int | None = None) -> int:
    """A number that counts or refers."""
    value = entry.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**40:
        raise FormatError(f"'{name}' in the GLB is not a sensible integer")
    return value


def integers_of(entry: dict[str, Any], name: str) -> list[int]:
    """Numbers that refer, none where the list is missing."""
    values = entry.get(name, [])
    if not isinstance(values, list):
        raise FormatError(f"'{name}' in the GLB is not a list")
    return [integer_of({name: value}, name) for value in values]


def numbers_of(entry: dict[str, Any], name: str, count: int) -> FloatArray:
    """A list of so many numbers, finite or not."""
    values = entry[name]
    if (
        not isinstance(values, list)
        or len(values) != count
        or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    ):
        raise FormatError(f"'{name}' in the GLB is not a list of {count} numbers")
    try:
        return np.array(values, dtype=np.float64)
    except OverflowError:
        raise FormatError(f"'{name}' in the GLB is too large") from None

"""Tables with our own columns: CSV, JSON Lines and Parquet."""

from __future__ import annotations

import csv
import json
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from graspdb.interop.formats.source import extra
from graspdb.interop.grasps import Report
from graspdb.interop.writers.content import Content
from graspdb.poses import POSE_COLUMNS


def csv_file(path: Path, content: Content, report: Report) -> None:
    """A header line and a grasp a line; numbers so that they are read as they were."""
    columns = dict(zip(POSE_COLUMNS, content.poses.rows.T.tolist(), strict=True))
    columns |= _others(content)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*([_cell(x) for x in column] for column in columns.values()), strict=True))


def json_lines(path: Path, content: Content, report: Report) -> None:
    """A JSON object a line, with the fields of a trial over HTTP."""
    columns = content.poses.columns() | _others(content)
    with path.open("w", encoding="utf-8") as file:
        for values in zip(*columns.values(), strict=True):
            row = {name: value for name, value in zip(columns, values, strict=True) if not _missing(value)}
            file.write(json.dumps(row, allow_nan=False, default=_plain) + "\n")


def parquet(path: Path, content: Content, report: Report) -> None:
    """Lists of three and four numbers, and a column for each of what else is known."""
    pa, pq = extra("pyarrow", "Parquet"), extra("pyarrow.parquet", "Parquet")
    arrays = {}
    for name, values in (
        ("position", content.poses.position),
        ("quaternion_xyzw", content.poses.quaternion_xyzw),
    ):
        flat = pa.array(np.ascontiguousarray(values).reshape(-1))
        arrays[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    arrays |= {name: pa.array(values) for name, values in _others(content, text=True).items()}
    pq.write_table(pa.table(arrays), path)


def _others(content: Content, *, text: bool = False) -> dict[str, list[Any]]:
    """Outcomes, qualities and further columns; metadata as ``text`` where a column can't hold any object."""
    columns: dict[str, list[Any]] = {}
    if content.outcomes is not None:
        columns["outcome"] = content.outcomes.tolist()
    for name, values in content.qualities.items():
        key = "quality" if name == "quality" else f"qualities.{name}"
        columns[key] = [None if x != x else x for x in values.tolist()]
    for name, entries in content.more.items():
        columns[name] = [json.dumps(x) if text and isinstance(x, dict) else x for x in entries]
    return columns


def _cell(value: Any) -> Any:
    if _missing(value):
        return ""
    return (
        json.dumps(value)
        if isinstance(value, dict)
        else _plain(value)
        if isinstance(value, datetime)
        else value
    )


def _missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and value != value)


def _plain(value: object) -> Any:
    if isinstance(value, datetime):
        return value.isoformat()
    raise TypeError(f"{value!r} can't be written as JSON")

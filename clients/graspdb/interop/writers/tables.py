"""Tables with our own columns: CSV, JSON Lines and Parquet."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from graspdb.interop.formats.columns import STATED
from graspdb.interop.grasps import Report
from graspdb.interop.parsing.events import extra
from graspdb.interop.writers.content import Content
from graspdb.poses import POSE_COLUMNS
from graspdb.wire.frames.gripper_frames import TOOL

_NUMBERS = ("quality", "width_m", "proposal_density", "attempts", "successes")


def csv_file(path: Path, contents: Iterator[Content], report: Report) -> None:
    """A header line and a grasp a line; numbers so that they are read as they were."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        for content in contents:
            columns = dict(zip(POSE_COLUMNS, content.poses.rows.T.tolist(), strict=True))
            columns |= _others(content)
            if not content.first:
                writer.writerow(columns)
            writer.writerows(zip(*([_cell(x) for x in column] for column in columns.values()), strict=True))


def json_lines(path: Path, contents: Iterator[Content], report: Report) -> None:
    """A JSON object a line, with the fields of a trial over HTTP."""
    with path.open("w", encoding="utf-8") as file:
        for content in contents:
            columns = content.poses.columns() | _others(content)
            for values in zip(*columns.values(), strict=True):
                row = {
                    name: value for name, value in zip(columns, values, strict=True) if not _missing(value)
                }
                file.write(json.dumps(row, allow_nan=False, default=_plain) + "\n")


def parquet(path: Path, contents: Iterator[Content], report: Report) -> None:
    """Lists of three and four numbers, and a column for each of what else is known."""
    pa, pq = extra("pyarrow", "Parquet"), extra("pyarrow.parquet", "Parquet")
    with ExitStack() as open_files:
        writer = None
        for content in contents:
            table = _arrow(pa, content)
            if writer is None:
                writer = open_files.enter_context(pq.ParquetWriter(path, table.schema))
            writer.write_table(table)


def _arrow(pa: Any, content: Content) -> Any:
    arrays = {}
    for name, values in (
        ("position", content.poses.position),
        ("quaternion_xyzw", content.poses.quaternion_xyzw),
    ):
        flat = pa.array(np.ascontiguousarray(values).reshape(-1))
        arrays[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    for name, entries in _others(content).items():
        # Of one type in every run, also where a run has no value.
        if name == "measured_at":
            arrays[name] = pa.array([_time(x) for x in entries], pa.timestamp("us", "UTC"))
        elif name in _NUMBERS or name.startswith("qualities."):
            arrays[name] = pa.array(entries, pa.float64())
        else:
            texts = [json.dumps(x, allow_nan=False) if isinstance(x, dict) else x for x in entries]
            arrays[name] = pa.array(texts, pa.string())
    return pa.table(arrays)


def _time(value: Any) -> Any:
    """A time, whether or not it is text; without a zone it is UTC."""
    if isinstance(value, str):
        value = datetime.fromisoformat(value.replace("Z", "+00:00"))
    naive = isinstance(value, datetime) and value.tzinfo is None
    return value.replace(tzinfo=timezone.utc) if naive else value


def _others(content: Content) -> dict[str, list[Any]]:
    """Outcomes, qualities and further columns."""
    columns: dict[str, list[Any]] = {}
    if content.outcomes is not None:
        columns["outcome"] = content.outcomes.tolist()
    for name, values in content.qualities.items():
        key = "quality" if name == "quality" else f"qualities.{name}"
        columns[key] = [None if x != x else x for x in values.tolist()]
    columns |= {name: list(entries) for name, entries in content.more.items()}
    if (content.frame, content.convention) != (TOOL, "graspdb"):
        columns |= {name: [getattr(content, name)] * len(content) for name in STATED}
    return columns


def _cell(value: Any) -> Any:
    if _missing(value):
        return ""
    if isinstance(value, dict):
        return json.dumps(value, allow_nan=False)
    return _plain(value) if isinstance(value, datetime) else value


def _missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and value != value)


def _plain(value: object) -> Any:
    if isinstance(value, datetime):
        return value.isoformat()
    raise TypeError(f"{value!r} can't be written as JSON")

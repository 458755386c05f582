"""Trials and poses in files: JSON, NDJSON and CSV, and poses in .npy.

CSV has a header line. A pose is ``x,y,z,qx,qy,qz,qw``; a trial adds ``outcome`` and, where wanted,
``gripper``, ``source``, ``protocol``, ``engine``, ``proposal_density``, ``attempts``, ``successes``,
``quality``, ``width_m``, ``measured_at``, ``answer``, the pose that was achieved as ``achieved_x`` to
``achieved_qw``, and named scores as ``qualities.NAME``; an empty cell is a value not given. JSON is what the
HTTP interface takes: one trial, a list of trials, ``{"trials": [...]}`` or ``{"columns": {...}}``, the latter
two with values shared by all beside them.
"""

from __future__ import annotations

import csv
import io
import json
import math
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from graspdb.poses import POSE_COLUMNS, as_poses

OUTCOME_COLUMNS = ("outcome", "success", "label", "result", "held", "object_in_gripper")
"""What tables call the column of what became of a grasp; the first that is there counts."""
_TEXT_COLUMNS = frozenset({"outcome", "gripper", "source", "protocol", "engine", "measured_at", "answer"})
_ACHIEVED_COLUMNS = tuple(f"achieved_{name}" for name in POSE_COLUMNS)
_COUNT_COLUMNS = frozenset({"attempts", "successes"})
_NUMBER_COLUMNS = frozenset({"proposal_density", "quality", "width_m", *_COUNT_COLUMNS})
_QUALITIES = "qualities."

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Metres per unit that positions in a file may be in."""


class FileProblem(ValueError):
    """A file that cannot be read as trials or poses; the message names it and the line."""


def read_trials(path: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Trials as mappings, and the values shared by all; ``-`` reads NDJSON or JSON from standard input."""
    if path.lower().endswith(".csv"):
        return _csv(path, trials=True), {}
    data = _json_or_ndjson(path)
    if isinstance(data, list):
        records, shared = data, {}
    elif isinstance(data, dict) and "trials" in data:
        shared = {key: value for key, value in data.items() if key != "trials"}
        records = data["trials"]
    elif isinstance(data, dict) and "columns" in data:
        shared = {key: value for key, value in data.items() if key != "columns"}
        records = _rows(path, data["columns"])
    else:
        records, shared = [data], {}
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise FileProblem(f"{path}: trials are JSON objects, in a list or one a line")
    if not records:
        raise FileProblem(f"{path} has no trials")
    return records, shared


def as_stated(
    records: list[dict[str, Any]], *, unit: str = "m", quaternion_order: str = "xyzw"
) -> list[dict[str, Any]]:
    """Trials with positions in metres and quaternions xyzw, from those in another unit (:data:`METRES`) or
    with w first (``wxyz``). What is no pose is left for the service to name; ValueError for an unknown unit
    or order.
    """
    if unit not in METRES:
        raise ValueError(f"unit is {unit!r}; expected one of {', '.join(METRES)}")
    if quaternion_order not in ("xyzw", "wxyz"):
        raise ValueError(f"quaternion_order is {quaternion_order!r}; expected xyzw or wxyz")
    converted = []
    for record in records:
        changed = _pose_as_stated(record, unit, quaternion_order)
        if isinstance(record.get("achieved_pose"), dict):
            changed["achieved_pose"] = _pose_as_stated(record["achieved_pose"], unit, quaternion_order)
        converted.append(changed)
    return converted


def _pose_as_stated(record: dict[str, Any], unit: str, quaternion_order: str) -> dict[str, Any]:
    changed = dict(record)
    with suppress(KeyError, TypeError, ValueError, IndexError):
        changed["position"] = [float(x) * METRES[unit] for x in record["position"]]
    with suppress(KeyError, TypeError, ValueError, IndexError):
        rows = [list(row) for row in record["matrix"]]
        for row in rows[:3]:
            row[3] = float(row[3]) * METRES[unit]
        changed["matrix"] = rows
    if quaternion_order == "wxyz":
        with suppress(KeyError, TypeError, ValueError):
            w, x, y, z = record["quaternion_xyzw"]
            changed["quaternion_xyzw"] = [x, y, z, w]
    return changed


class DrawnPoses(NamedTuple):
    """N poses of a file, (N, 3) metres and (N, 4), and the density (N,) that each was drawn with,
    1/(m^3 rad^3), NaN where it says none.
    """

    position: NDArray[np.float64]
    quaternion_xyzw: NDArray[np.float64]
    proposal_density: NDArray[np.float64]


def read_poses(path: str) -> NDArray[np.float64]:
    """Poses as rows x y z qx qy qz qw (N, 7), from .csv, .npy, .json or NDJSON; FileProblem says where."""
    return np.concatenate(read_drawn_poses(path)[:2], axis=1)


def read_drawn_poses(path: str) -> DrawnPoses:
    """Poses as :func:`read_poses` reads them, with their ``proposal_density`` where the file has it."""
    if path.lower().endswith(".npy"):
        position, quaternion = as_poses(np.load(path, allow_pickle=False))
        return DrawnPoses(position, quaternion, np.full(len(position), np.nan))
    if path.lower().endswith(".csv"):
        records = _csv(path, trials=False)
    else:
        data = _json_or_ndjson(path)
        if isinstance(data, dict) and "poses" in data:
            data = data["poses"]
        if isinstance(data, dict) and "columns" in data:
            data = data["columns"]
        if isinstance(data, dict) and isinstance(data.get("quaternion_xyzw"), list):
            nested = data["quaternion_xyzw"] and isinstance(data["quaternion_xyzw"][0], list)
            columns = {key: data.get(key) for key in ("position", "quaternion_xyzw", "proposal_density")}
            data = _rows(path, columns) if nested else [data]
        records = data if isinstance(data, list) else [data]
    if not records:
        raise FileProblem(f"{path} has no poses")
    rows, densities = [], []
    for number, record in enumerate(records):
        try:
            pose: Any = record
            if isinstance(record, dict) and "matrix" in record:
                pose = record["matrix"]
            elif isinstance(record, dict):
                pose = [*record["position"], *record["quaternion_xyzw"]]
            rows.append(as_poses(pose).rows[0])
            drawn = record.get("proposal_density") if isinstance(record, dict) else None
            densities.append(math.nan if drawn is None else float(drawn))
        except (KeyError, TypeError, ValueError) as error:
            reason = f"has no {error}" if isinstance(error, KeyError) else str(error)
            raise FileProblem(f"{path}, pose {number}: {reason}") from error
    table = np.array(rows)
    return DrawnPoses(table[:, :3], table[:, 3:], np.array(densities))


def _json_or_ndjson(path: str) -> Any:
    text = sys.stdin.read().removeprefix("\ufeff") if path == "-" else _text(path)

    def refuse(name: str) -> Any:
        raise FileProblem(f"{path}: {name} is no JSON number; leave the field out where it is not known")

    try:
        return json.loads(text, parse_constant=refuse)
    except FileProblem:
        raise
    except ValueError as error:
        whole = error
    records = []
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.strip():
            continue
        try:
            records.append(json.loads(line, parse_constant=refuse))
        except FileProblem as error:
            raise FileProblem(f"{error} (line {number})") from error
        except ValueError as error:
            if number == 1:
                raise FileProblem(f"{path} is neither JSON nor NDJSON: {whole}") from error
            raise FileProblem(f"{path}, line {number}: {error}") from error
    return records


def _text(path: str) -> str:
    """A file's text, with or without a byte order mark; FileProblem where it is not UTF-8."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileProblem(
            f"{path} is not UTF-8 ({error.reason} at byte {error.start}): save it as that"
        ) from None


def _rows(path: str, columns: Any) -> list[dict[str, Any]]:
    if isinstance(columns, dict) and isinstance(columns.get("qualities"), dict):
        scores = {f"{_QUALITIES}{name}": values for name, values in columns["qualities"].items()}
        columns = {name: values for name, values in columns.items() if name != "qualities"} | scores
    if not isinstance(columns, dict) or not all(
        isinstance(c, list) for c in columns.values() if c is not None
    ):
        raise FileProblem(f"{path}: columns are lists of equal length")
    given = {name: values for name, values in columns.items() if values is not None}
    lengths = {name: len(values) for name, values in given.items()}
    if len(set(lengths.values())) > 1:
        raise FileProblem(f"{path}: the columns differ in length: {lengths}")
    count = next(iter(lengths.values()), 0)
    return [
        _gathered({name: values[i] for name, values in given.items() if values[i] is not None})
        for i in range(count)
    ]


def _gathered(row: dict[str, Any]) -> dict[str, Any]:
    """A row of columns as a trial, whose ``qualities.NAME`` are one mapping."""
    scores = {name.removeprefix(_QUALITIES): x for name, x in row.items() if name.startswith(_QUALITIES)}
    if not scores:
        return row
    others = {name: value for name, value in row.items() if not name.startswith(_QUALITIES)}
    return {**others, "qualities": scores}


def _csv(path: str, *, trials: bool) -> list[dict[str, Any]]:
    with io.StringIO(_text(path), newline="") as file:
        reader = csv.DictReader(file, skipinitialspace=True)
        names = set(reader.fieldnames or ())
        told = next((name for name in OUTCOME_COLUMNS if name in names), "outcome") if trials else "outcome"
        known = _TEXT_COLUMNS | _NUMBER_COLUMNS | set(_ACHIEVED_COLUMNS)
        wanted = {*POSE_COLUMNS, told} if trials else set(POSE_COLUMNS)
        if missing := sorted(wanted - names):
            line = f"{path} needs a header line with {','.join(POSE_COLUMNS)}; it lacks {missing}"
            raise FileProblem(f"{line}. `graspdb import` reads tables of other columns" if trials else line)
        scores = [name for name in reader.fieldnames or () if name.startswith(_QUALITIES)]
        if trials and (unknown := sorted(names - wanted - known - set(scores))):
            raise FileProblem(
                f"{path} has unknown columns {unknown}: leave them out, or use `graspdb import`"
            )
        records = []
        for row in reader:
            where = f"{path}, line {reader.line_num}"
            if None in row or any(value is None for value in row.values()):
                raise FileProblem(f"{where}: the number of cells differs from the header's")
            numbers = [_number(where, name, row[name]) for name in POSE_COLUMNS]
            record: dict[str, Any] = {"position": numbers[:3], "quaternion_xyzw": numbers[3:]}
            if trials:
                for name in (_TEXT_COLUMNS | _NUMBER_COLUMNS) & names:
                    text = row[name].strip()
                    if text:
                        record[name] = _number(where, name, text) if name in _NUMBER_COLUMNS else text
                for name in _COUNT_COLUMNS & record.keys():
                    # Tables with gaps have 10.0; the service names what is no whole number.
                    record[name] = int(record[name]) if record[name].is_integer() else record[name]
                record |= {name: _number(where, name, row[name]) for name in scores if row[name].strip()}
                record = _gathered(record)
                record["outcome"] = _outcome(row[told].strip() or None)
                cells = [(row.get(name) or "").strip() for name in _ACHIEVED_COLUMNS]
                if any(cells):
                    achieved = [_number(where, *cell) for cell in zip(_ACHIEVED_COLUMNS, cells, strict=True)]
                    record["achieved_pose"] = {"position": achieved[:3], "quaternion_xyzw": achieved[3:]}
            elif (row.get("proposal_density") or "").strip():
                record["proposal_density"] = _number(where, "proposal_density", row["proposal_density"])
            records.append(record)
    if not records:
        raise FileProblem(f"{path} has a header but no rows")
    return records


def _outcome(text: Any) -> Any:
    """CSV has no booleans, and tables with gaps have 1.0 and 0.0; the service names what is left wrong."""
    known = {"true": True, "1": True, "1.0": True, "false": False, "0": False, "0.0": False}
    return known.get(str(text).lower(), text)


def _number(where: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise FileProblem(f"{where}: {name} is {text!r}, which is no number") from error
    if not math.isfinite(value):
        raise FileProblem(f"{where}: {name} is {text}; numbers must be finite")
    return value

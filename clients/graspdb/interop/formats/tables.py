"""Tables of grasps: CSV, JSON Lines (or JSON) and Parquet with any columns, and VGN's CSV; read by pieces."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from graspdb.interop.formats.columns import MORE, STATED, Plan, plan
from graspdb.interop.formats.source import CHUNK, SourceFile, Wishes
from graspdb.interop.grasps import NO_OUTCOME, Codes, Floats, Raw, Report, problem
from graspdb.interop.outcomes import WORDS, code_of
from graspdb.interop.parsing.events import extra
from graspdb.wire import OUTCOMES

VGN_COLUMNS = ("scene_id", "qx", "qy", "qz", "qw", "x", "y", "z", "width", "label")
VGN_TIP_M = 0.05
"""How far the fingertips lie ahead of VGN's origin, the root of the fingers."""

_LONGEST_LINE = 4_000_000
_NUMBER_COLUMNS = ("width_m", "proposal_density", "attempts", "successes")


class Table(Protocol):
    """A run of a table's rows; ``names`` are of its columns."""

    names: Sequence[str]

    def __len__(self) -> int: ...

    def values(self, name: str) -> Sequence[Any]:
        """A column as Python's values, None where there is none."""

    def distinct(self, name: str) -> tuple[list[Any], NDArray[np.intp]]:
        """A column's different values, in the order in which they come, and the place of each row's."""

    def floats(self, name: str) -> Floats:
        """A column of numbers (N,), NaN where there is none."""

    def vectors(self, names: tuple[str, ...]) -> Floats:
        """One column of lists or several of numbers, as (N, k)."""


def stated(source: SourceFile, kind: str) -> dict[str, str]:
    """What a table says itself of its poses, by the columns :data:`STATED`, as our own tables do."""
    if kind == "parquet":
        found = _first_of_parquet(source)
    elif kind == "csv":
        text = source.head.decode("utf-8-sig", "replace").splitlines()[:2]
        rows = csv.reader(text, delimiter=";" if _semicolons(source) else ",", skipinitialspace=True)
        found = dict(zip(*rows, strict=False)) if len(text) == 2 else {}
    else:
        found = next(_records(source), {})
    told = {name.strip(): value for name, value in found.items() if isinstance(value, str)}
    return {name: told[name] for name in STATED if _is_word(told.get(name))}


def _is_word(value: Any) -> bool:
    """Whether a cell may name a frame or a convention; a number is a video's frame, not a gripper's."""
    return isinstance(value, str) and re.fullmatch(r"-?[A-Za-z][\w./-]*", value) is not None


def _first_of_parquet(source: SourceFile) -> dict[str, Any]:
    pq, pa = extra("pyarrow.parquet", "Parquet"), extra("pyarrow", "Parquet")
    with suppress(pa.ArrowException, OSError), pq.ParquetFile(source.path) as file:
        names = [name for name in STATED if name in file.schema_arrow.names]
        for batch in file.iter_batches(batch_size=1, columns=names) if names else ():
            found: list[dict[str, Any]] = batch.to_pylist()
            return found[0] if found else {}
    return {}


def read_csv(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """A header line and a grasp a line."""
    return _rows(source, _csv_tables(source, report), wishes, report)


def read_json_lines(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """A JSON object a line, or a JSON list of them; what is nested is named with dots."""
    return _rows(source, _json_tables(source), wishes, report)


def read_parquet(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """Columns of numbers or lists of numbers."""
    pq = extra("pyarrow.parquet", "Parquet")
    pa = extra("pyarrow", "Parquet")
    try:
        with pq.ParquetFile(source.path) as file:
            names = list(file.schema_arrow.names)
            chosen = _planned(source.name, names, wishes, report)
            first = 0
            wanted = [name for name in names if name in chosen.names or name in STATED]
            for batch in file.iter_batches(batch_size=CHUNK, columns=wanted):
                yield _raw(source.name, _Arrow(source.name, batch), chosen, first, wishes)
                first += len(batch)
    except (pa.ArrowException, OSError) as error:
        raise problem(source.name, f"can't be read as Parquet: {error}") from None


def read_vgn(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """VGN's grasps.csv: poses in a scene, fingertips 0.05 m ahead of the origin, label 1 or 0."""
    scenes: set[str] = set()
    wanted = wishes.only.get("scene_id")
    chosen = Plan(
        position=("x", "y", "z"),
        quaternion=("qx", "qy", "qz", "qw"),
        order=wishes.quaternion_order or "xyzw",
        outcome="label",
        more={"width_m": "width"},
    )
    report.map("width to width_m; label 1 to success, 0 to failure")
    first = 0
    for table in _csv_tables(source, report):
        _complete(source.name, table, VGN_COLUMNS)
        here = np.array([str(scene) for scene in table.values("scene_id")])
        scenes |= set(here.tolist())
        if wanted is None and len(scenes) > 1:
            raise problem(
                source.name,
                "has grasps in several scenes, in each of which the object lies elsewhere: name one with"
                f" --only scene_id={sorted(scenes)[0]}",
            )
        raw = _raw(source.name, table, chosen, first, wishes)
        first += len(table)
        raw = Raw(
            raw.first, raw.position, raw.quaternion, order=raw.order, outcome=raw.outcome, more=raw.more,
            ahead_m=np.full(len(raw), VGN_TIP_M),
        )  # fmt: skip
        yield raw if wanted is None else raw.part(here == wanted)
    if wanted is not None and wanted not in scenes:
        raise problem(
            source.name, f"has no grasps in scene {wanted}; there are {', '.join(sorted(scenes)[:8])}"
        )
    if wanted is not None and len(scenes) > 1:
        report.drop(f"grasps in {len(scenes) - 1:,} other scenes")


def _complete(file: str, table: Table, names: Sequence[str]) -> None:
    there = getattr(table, "names", names)
    missing = [name for name in names if name not in there]
    if missing:
        raise problem(file, f"lacks the columns {', '.join(missing)}")


def _rows(source: SourceFile, tables: Iterator[_Lists], wishes: Wishes, report: Report) -> Iterator[Raw]:
    chosen: Plan | None = None
    first = 0
    for table in tables:
        if chosen is None:
            chosen = _planned(source.name, table.names, wishes, report)
        yield _raw(source.name, table, chosen, first, wishes)
        first += len(table)
    if chosen is None:
        raise problem(source.name, "has no grasps")


def _planned(file: str, names: Sequence[str], wishes: Wishes, report: Report) -> Plan:
    try:
        chosen = plan(names, wishes.columns, wishes.quaternion_order, wishes.qualities, list(wishes.stated))
    except ValueError as error:
        raise problem(file, str(error)) from None
    if chosen.quaternion:
        report.recognise(
            f"positions in {_told(chosen.position)}, quaternions {chosen.order} in {_told(chosen.quaternion)}"
        )
        if not chosen.order_told and wishes.quaternion_order is None:
            report.assume("quaternions xyzw")
    else:
        report.recognise(
            f"matrices in {_told(chosen.matrix)}"
            if chosen.matrix
            else f"positions in {_told(chosen.position)}, rotations in {_told(chosen.rotation)}"
        )
    if not (chosen.position or chosen.matrix):
        raise problem(file, "which columns are the position? Name them, as in --columns position=px:py:pz")
    for name in chosen.stated:
        report.recognise(f"{name} {wishes.stated[name]}, by the column {name}")
    if chosen.object_position:
        where = f"{_told(chosen.object_position)} and {_told(chosen.object_quaternion)}"
        report.recognise(f"the object's pose at each grasp in {where}")
    if chosen.outcome is not None:
        report.map(f"{chosen.outcome} to the outcome")
    for name, column in chosen.more.items():
        report.map(f"{column} to {name}")
    for name, column in chosen.qualities.items():
        if name != column:
            report.map(f"{column} to the quality {name}")
    left = [name for name in names if name not in chosen.names]
    if left:
        shown = ", ".join(left[:12]) + (f" and {len(left) - 12} more" if len(left) > 12 else "")
        report.drop(f"columns {shown} (--columns quality.NAME=COLUMN keeps numbers)")
    return chosen


def _told(names: tuple[str, ...]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"


def _raw(file: str, table: Table, chosen: Plan, first: int, wishes: Wishes) -> Raw:
    for name in STATED:
        if name not in chosen.stated and (name in wishes.said or name not in table.names):
            continue
        # Of rows that say nothing the poses are of the tool, with its own axes.
        first_said = wishes.stated.get(name, "none")
        words = {str(value) for value in table.values(name) if name in chosen.stated or _is_word(value)}
        others = sorted(words - {first_said})
        if others:
            several = f"{first_said!r} and {others[0]!r}"
            raise problem(
                file,
                f"has poses of several {name}s ({several}) by the column {name}: import one's at a time,"
                f" or say --{name} where the column is about something else",
            )
    position: Floats
    quaternion = rotation = None
    if chosen.matrix:
        rows = table.vectors(chosen.matrix)
        if rows.shape[1] not in (12, 16):
            raise problem(file, f"{_told(chosen.matrix)} must be matrices of 16 or 12 numbers")
        if rows.shape[1] == 16:
            wrong = np.flatnonzero(~(np.abs(rows[:, 12:] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) <= 1e-6))
            if wrong.size and wishes.drop_unusable:
                rows[wrong] = np.nan
            elif wrong.size:
                place = first + int(wrong[0])
                raise problem(file, f"grasp {place}: the last row of its matrix must be 0, 0, 0, 1")
        matrix = rows[:, :12].reshape(-1, 3, 4)
        position, rotation = matrix[:, :, 3], matrix[:, :, :3]
    else:
        position = _wide(file, table, chosen.position, 3)
        if chosen.rotation:
            rotation = _wide(file, table, chosen.rotation, 9).reshape(-1, 3, 3)
        else:
            numbers4 = _wide(file, table, chosen.quaternion, 4)
            quaternion = numbers4 if chosen.order == "xyzw" else numbers4[:, [1, 2, 3, 0]]
    return Raw(
        first,
        position,
        quaternion,
        rotation,
        None if quaternion is None else chosen.order,
        None if chosen.outcome is None else _codes(file, table, chosen.outcome, first, wishes),
        {name: table.floats(column) for name, column in chosen.qualities.items()},
        more={name: _more(file, table, name, column, first) for name, column in chosen.more.items()},
        **_object_poses(file, table, chosen),
    )


def _object_poses(file: str, table: Table, chosen: Plan) -> dict[str, Any]:
    if not chosen.object_position:
        return {}
    turn = _wide(file, table, chosen.object_quaternion, 4)
    return {
        "object_position": _wide(file, table, chosen.object_position, 3),
        "object_order": chosen.object_order,
        "object_quaternion": turn if chosen.object_order == "xyzw" else turn[:, [1, 2, 3, 0]],
    }


def _wide(file: str, table: Table, names: tuple[str, ...], width: int) -> Floats:
    found = table.vectors(names)
    if found.shape[1] != width:
        raise problem(file, f"{_told(names)} must have {width} numbers a grasp, not {found.shape[1]}")
    return found


def _more(file: str, table: Table, name: str, column: str, first: int) -> Sequence[Any]:
    if name in _NUMBER_COLUMNS:
        return [None if np.isnan(x) else x for x in table.floats(column).tolist()]
    values = [None if value in (None, "") else value for value in table.values(column)]
    return (
        [_object(file, first + row, value) for row, value in enumerate(values)]
        if name == "metadata"
        else values
    )


def _object(file: str, row: int, value: Any) -> Any:
    """Metadata as an object, which tables have as text; None for none."""
    with suppress(ValueError, RecursionError):
        value = json.loads(value) if isinstance(value, str) else value
    if value is not None and not isinstance(value, dict):
        raise problem(file, f"grasp {row}: metadata is {str(value)[:60]!r}, no JSON object")
    return value


def _codes(file: str, table: Table, name: str, first: int, wishes: Wishes) -> Codes:
    values, places = table.distinct(name)
    known = np.empty(len(values), dtype=np.uint8)
    for place, value in enumerate(values):
        code = code_of(value)
        missing = value in (None, "") or value != value
        if code is None and missing and wishes.drop_unusable:
            code = NO_OUTCOME
        if code is None:
            told = "missing (--drop-unusable leaves such grasps out)" if missing else repr(value)[:60]
            raise problem(
                file,
                f"grasp {first + int(np.argmax(places == place))}: {name} is {told}, no outcome. Outcomes are"
                f" {', '.join(OUTCOMES)}, or {', '.join(WORDS)}; where it is a score, say what is a"
                " success: --success-from QUALITY --success-above X",
            )
        known[place] = code
    return known[places]


def _distinct(values: Sequence[Any]) -> tuple[list[Any], NDArray[np.intp]]:
    """The different values, in the order in which they come, and the place of each among them."""
    found: dict[Any, tuple[int, Any]] = {}
    places = np.empty(len(values), dtype=np.intp)
    for row, value in enumerate(values):
        key = value if isinstance(value, (str, bool, int, float)) else str(value)
        places[row], _ = found.setdefault(key, (len(found), value))
    return [value for _, value in found.values()], places


class _Lists:
    """Rows as lists of Python's values, a list a column."""

    def __init__(self, file: str, columns: Mapping[str, list[Any]], first: int) -> None:
        self._file, self._columns, self._first = file, columns, first
        self.names: Sequence[str] = list(columns)

    def __len__(self) -> int:
        return len(next(iter(self._columns.values()), ()))

    def values(self, name: str) -> Sequence[Any]:
        return self._columns.get(name) or [None] * len(self)

    def distinct(self, name: str) -> tuple[list[Any], NDArray[np.intp]]:
        return _distinct(self.values(name))

    def floats(self, name: str) -> Floats:
        values = self.values(name)
        try:
            return np.array(values, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            return np.array([self._number(name, row, value) for row, value in enumerate(values)])

    def _number(self, name: str, row: int, value: Any) -> float:
        if value is None or value == "":
            return np.nan
        try:
            if isinstance(value, (list, dict)):
                raise TypeError
            return float(value)
        except (TypeError, ValueError, OverflowError):
            told = f"{name} is {str(value)[:60]!r}, which is no number"
            if isinstance(value, str) and re.fullmatch(r"\s*[+-]?\d+,\d+\s*", value):
                told += ": decimals are written with a point"
            raise problem(self._file, f"grasp {self._first + row}: {told}") from None

    def vectors(self, names: tuple[str, ...]) -> Floats:
        if len(names) > 1:
            return np.stack([self.floats(name) for name in names], axis=1)
        rows = []
        for row, value in enumerate(self.values(names[0])):
            rows.append(self._vector(names[0], row, value))
        if len({len(row) for row in rows}) > 1:
            raise problem(self._file, f"{names[0]} has lists of different lengths")
        return np.array(rows, dtype=np.float64)

    def _vector(self, name: str, row: int, value: Any) -> list[float]:
        try:
            if isinstance(value, str):
                return [
                    float(part)
                    for part in re.split(r"[\s,;]+", value.strip(" []()\n\t"))
                    if part.strip("[]()")
                ]
            flat = np.ravel(np.array(value, dtype=np.float64))
            if not isinstance(value, list):
                raise TypeError
            return list(flat)
        except (TypeError, ValueError, OverflowError):
            told = f"{name} is {str(value)[:60]!r}, no list of numbers"
            raise problem(self._file, f"grasp {self._first + row}: {told}") from None


def _csv_tables(source: SourceFile, report: Report) -> Iterator[_Lists]:
    def number(row: list[str]) -> str:
        return f"line {reader.line_num}"

    try:
        with source.path.open(encoding="utf-8-sig", newline="") as file:
            dialect = ";" if _semicolons(source) else ","
            reader = csv.reader(file, delimiter=dialect, skipinitialspace=True)
            header = [name.strip() for name in next(reader, [])]
            if not header or len(set(header)) != len(header):
                twice = sorted({name for name in header if header.count(name) > 1})
                told = f"names {', '.join(twice)} twice" if twice else "has no header line"
                raise problem(source.name, told)
            rows: list[list[str]] = []
            first = 0
            for row in reader:
                if not row:
                    continue
                if len(row) != len(header):
                    told = f"{number(row)} has {len(row)} cells, the header {len(header)}"
                    raise problem(source.name, told)
                rows.append(row)
                if len(rows) == CHUNK:
                    yield _Lists(source.name, _turned(header, rows), first)
                    first, rows = first + len(rows), []
            if rows or not first:
                if not rows:
                    raise problem(source.name, "has a header but no rows")
                yield _Lists(source.name, _turned(header, rows), first)
    except UnicodeDecodeError as error:
        raise problem(source.name, _no_utf8(source, error)) from None
    except csv.Error as error:
        raise problem(source.name, f"can't be read as CSV: {error}") from None


def _no_utf8(source: SourceFile, error: UnicodeDecodeError) -> str:
    """What a text is instead, as far as its first bytes tell, and the way out."""
    wide = source.head.startswith((b"\xff\xfe", b"\xfe\xff"))
    likely = "UTF-16" if wide else "Latin-1 or Windows-1252"
    return (
        f"is not UTF-8 ({error.reason} at byte {error.start}) but likely {likely}: save it as UTF-8 (iconv -f"
        f" {'UTF-16' if wide else 'WINDOWS-1252'} -t UTF-8 OLD > NEW)"
    )


def _semicolons(source: SourceFile) -> bool:
    line = source.head.split(b"\n", 1)[0]
    return line.count(b";") > line.count(b",")


def _turned(header: Sequence[str], rows: list[list[str]]) -> dict[str, list[Any]]:
    return {name: list(column) for name, column in zip(header, zip(*rows, strict=True), strict=True)}


def _json_tables(source: SourceFile) -> Iterator[_Lists]:
    first, records = 0, list[dict[str, Any]]()
    for record in _records(source):
        records.append(record)
        if len(records) == CHUNK:
            yield _Lists(source.name, _columns(records), first)
            first, records = first + len(records), []
    if records:
        yield _Lists(source.name, _columns(records), first)


def _columns(records: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    names = list(dict.fromkeys(name for record in records for name in record))
    return {name: [record.get(name) for record in records] for name in names}


def _records(source: SourceFile) -> Iterator[dict[str, Any]]:
    if not many_texts(source) and source.suffix not in (".jsonl", ".ndjson"):
        for number, record in enumerate(source.grasps(("trials", "items", "poses", "grasps"))):
            yield _record(source.name, f"grasp {number}", record)
        return
    try:
        with source.path.open(encoding="utf-8-sig") as file:
            number = 0
            while line := file.readline(_LONGEST_LINE):
                number += 1
                if len(line) == _LONGEST_LINE and not line.endswith("\n"):
                    raise problem(source.name, f"line {number} is longer than {_LONGEST_LINE:,} characters")
                if line.strip():
                    yield _record(source.name, f"line {number}", _loaded(source.name, number, line))
    except UnicodeDecodeError as error:
        raise problem(source.name, _no_utf8(source, error)) from None


def _loaded(name: str, number: int, line: str) -> Any:
    def refuse(constant: str) -> Any:
        raise problem(name, f"line {number}: {constant} is no JSON number")

    try:
        return json.loads(line, parse_constant=refuse)
    except json.JSONDecodeError as error:
        raise problem(name, f"line {number} is no JSON: {error}") from None
    except RecursionError:
        raise problem(name, f"line {number} nests too deeply") from None


def _record(name: str, where: str, record: Any) -> dict[str, Any]:
    if not isinstance(record, dict):
        raise problem(name, f"{where} is no JSON object")
    flat: dict[str, Any] = {}
    todo: list[tuple[str, Any]] = [("", record)]
    while todo:
        prefix, at = todo.pop(0)
        for key, value in at.items():
            path = f"{prefix}{key}"
            if isinstance(value, dict) and path not in MORE and path.count(".") < 4:
                todo.append((f"{path}.", value))
            else:
                flat[path] = value
    return flat


class _Arrow:
    """A record batch of Parquet."""

    def __init__(self, file: str, batch: Any) -> None:
        self._file, self._batch = file, batch
        self.names: Sequence[str] = batch.schema.names

    def __len__(self) -> int:
        return int(self._batch.num_rows)

    def _column(self, name: str) -> Any:
        column = self._batch.column(self._batch.schema.get_field_index(name))
        return column.dictionary_decode() if hasattr(column, "dictionary_decode") else column

    def values(self, name: str) -> Sequence[Any]:
        found: list[Any] = self._column(name).to_pylist()
        return found

    def distinct(self, name: str) -> tuple[list[Any], NDArray[np.intp]]:
        column = self._column(name)
        if hasattr(column.type, "num_fields") and column.type.num_fields:
            return _distinct(column.to_pylist())
        coded = column.dictionary_encode(null_encoding="encode")
        return coded.dictionary.to_pylist(), coded.indices.to_numpy(zero_copy_only=False).astype(np.intp)

    def floats(self, name: str) -> Floats:
        column = self._column(name)
        try:
            return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise problem(self._file, f"{name} must be numbers; it is {column.type}") from None

    def vectors(self, names: tuple[str, ...]) -> Floats:
        if len(names) > 1:
            return np.stack([self.floats(name) for name in names], axis=1)
        column, width = self._column(names[0]), 1
        while hasattr(column.type, "value_type"):
            if column.null_count:
                raise problem(self._file, f"{names[0]} is missing in some grasps")
            flat = column.flatten()
            if len(column) and len(flat) % len(column):
                raise problem(self._file, f"{names[0]} has lists of different lengths")
            lengths = column.value_lengths() if not hasattr(column.type, "list_size") else None
            if lengths is not None and len(set(lengths.unique().to_pylist())) > 1:
                raise problem(self._file, f"{names[0]} has lists of different lengths")
            width *= len(flat) // max(1, len(column))
            column = flat
        try:
            values = np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)
        except (TypeError, ValueError):
            raise problem(self._file, f"{names[0]} must be lists of numbers; it is {column.type}") from None
        return values.reshape(len(self), width)


def many_texts(source: SourceFile) -> bool:
    """Whether each line is a JSON text of its own."""
    first, _, rest = source.head.partition(b"\n")
    try:
        json.loads(first)
    except (ValueError, RecursionError):
        return False
    return bool(rest.strip())


def vgn_like(source: SourceFile) -> bool:
    """Whether a CSV has VGN's header."""
    line = source.head.split(b"\n", 1)[0].decode("utf-8-sig", "replace")
    return {name.strip() for name in line.split(",")} >= set(VGN_COLUMNS)

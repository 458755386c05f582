"""Trials from a request's body: one, many, in columns or in lines, all checked as arrays.

A large batch is never validated row by row: each field becomes one list, whose types, shapes and ranges are
checked at once; only where that fails does a loop look for the places to name.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt
import orjson
from pydantic import TypeAdapter, ValidationError

from graspdb.wire import OUTCOME_CODES, OUTCOMES, SOURCES
from graspdb.wire.base import MAX_COORDINATE_M, UNIT_TOLERANCE, Metadata, expand_matrix
from graspdb.wire.trials import TrialDefaults
from graspdb_service.formats.arrow import ARROW
from graspdb_service.problems import ProblemError

FloatArray = npt.NDArray[np.float64]
Combination = tuple[str | None, str | None, str | None]

JSON = "application/json"
NDJSON = "application/x-ndjson"

_DEFAULTS = frozenset(TrialDefaults.model_fields)
_REQUIRED = ("position", "quaternion_xyzw", "outcome")
_OPTIONAL = ("quality", "width_m", "pose_covariance", "measured_at")
_TRIAL = frozenset(_REQUIRED) | frozenset(_OPTIONAL) | _DEFAULTS
COLUMNS = _TRIAL
_SLUG = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_SLUG_RULE = "letters, digits, '.', '_', '-'; at most 64 characters, the first a letter or digit"
_METADATA: TypeAdapter[Any] = TypeAdapter(Metadata)
_TIME: TypeAdapter[datetime] = TypeAdapter(datetime)
_MOST_ERRORS = 20


@dataclass
class TrialBatch:
    """A checked batch, ready to store.

    ``combination`` (n,) indexes ``combinations`` of (gripper, source, protocol); ``field_of_gripper``
    names the field that a gripper came in, for what only the database can tell.
    """

    position: FloatArray
    quaternion_xyzw: FloatArray
    outcome: npt.NDArray[np.uint8]
    combinations: list[Combination]
    combination: npt.NDArray[np.int64]
    proposal_density: FloatArray | None
    quality: FloatArray | None
    width_m: FloatArray | None
    measured_at: list[datetime | None] | None
    pose_covariance: list[list[list[float]] | None] | None
    row_metadata: list[dict[str, Any] | None] | None
    metadata: dict[str, Any] | None
    field_of_gripper: Callable[[str], str]

    def __len__(self) -> int:
        return len(self.position)


@dataclass
class _Faults:
    """What is wrong so far; ends the search for more at a number that helps."""

    found: list[tuple[str, str]] = field(default_factory=list)

    def add(self, place: str, message: str) -> None:
        self.found.append((place, message))
        if len(self.found) >= _MOST_ERRORS:
            self.raise_if_any()

    def raise_if_any(self) -> None:
        if self.found:
            raise ProblemError(
                422, "invalid-request", "The trials are not valid; none was stored", errors=self.found
            )


@dataclass
class Fields:
    """Trials as one list a field, and how a field of a trial is called in the request.

    Numbers and outcome codes may be arrays already, finite, with NaN for null.
    """

    lists: Mapping[str, Sequence[Any] | npt.NDArray[Any]]
    count: int
    place: Callable[[int, str], str]


def parse(body: bytes, media: str, *, limit: int) -> TrialBatch:
    """Check a body of ``POST /objects/{id}/trials``.

    Raises
    ------
    ProblemError
        415 for another media type, 413 for more than ``limit`` trials, 422 naming the fields that are wrong.
    """
    if media in ("", JSON):
        return _parse_json(body, limit)
    if media in (NDJSON, "application/ndjson", "application/jsonl"):
        return _parse_lines(body, limit)
    raise ProblemError(
        415,
        "unsupported-media-type",
        f"Trials come as {JSON}, {NDJSON} or {ARROW}: say which by Content-Type",
        detail=f"Content-Type was {media}",
    )


def _parse_json(body: bytes, limit: int) -> TrialBatch:
    document, flaw = _loads(body)
    if not isinstance(document, dict):
        raise _body_problem(flaw or "the body is a JSON object: a trial, {trials: [...]} or {columns: {...}}")
    faults = _Faults()
    defaults = TrialDefaults()
    if "columns" in document or "trials" in document:
        form = "columns" if "columns" in document else "trials"
        for name in sorted(set(document) - {form} - _DEFAULTS):
            faults.add(name, f"unknown field beside {form}")
        defaults = _defaults({name: document[name] for name in _DEFAULTS & set(document)}, faults)
        fields = (_from_columns if form == "columns" else _from_trials)(document[form], faults, limit)
    else:
        fields = _from_rows([document], faults, lambda _, name: name)
    batch = _check(fields, defaults, faults)
    if flaw:
        raise _body_problem(flaw)
    return batch


def _parse_lines(body: bytes, limit: int) -> TrialBatch:
    lines = [line for line in body.split(b"\n") if line.strip()]
    refuse_too_many(len(lines), limit)
    rows, faults, flaws = [], _Faults(), _Faults()
    for number, line in enumerate(lines):
        row, flaw = _loads(line)
        if flaw:
            flaws.add(f"trials.{number}", flaw)
        rows.append({} if flaw and row is None else row)
    if not rows:
        raise _body_problem("no trial in the body: one JSON object a line")
    if any(row == {} for row in rows):
        flaws.raise_if_any()
    batch = _check(_from_rows(rows, faults, lambda i, name: f"trials.{i}.{name}"), TrialDefaults(), faults)
    flaws.raise_if_any()
    return batch


def _loads(text: bytes) -> tuple[Any, str | None]:
    """JSON, and what is wrong with it.

    Python's own parser takes NaN, Infinity and 1e999, which are no JSON: they are let through with the flaw
    so that the fields that hold them can be named.
    """
    try:
        return orjson.loads(text), None
    except orjson.JSONDecodeError as error:
        flaw = f"not valid JSON: {error}"
    try:
        return json.loads(text), flaw
    except (ValueError, RecursionError):
        return None, flaw


def _body_problem(message: str) -> ProblemError:
    return ProblemError(422, "invalid-request", "The request is not valid", errors=[("body", message)])


def refuse_too_many(count: int, limit: int) -> None:
    if count > limit:
        raise ProblemError(
            413,
            "too-many-trials",
            f"{count:,} trials in one request are too many: send them in batches of at most {limit:,},"
            " each with an Idempotency-Key of its own",
            extra={"limit": limit},
        )


def _defaults(given: dict[str, Any], faults: _Faults) -> TrialDefaults:
    try:
        return TrialDefaults.model_validate(given)
    except ValidationError as error:
        for item in error.errors(include_input=False, include_context=False):
            faults.add(".".join(map(str, item["loc"])), item["msg"].removeprefix("Value error, "))
    return TrialDefaults()


# --- the three forms to one list a field ----------------------------------------------------------------


def _from_columns(columns: Any, faults: _Faults, limit: int) -> Fields:
    if not isinstance(columns, dict):
        faults.add("columns", "an object of lists, one a field")
        faults.raise_if_any()
    for name in sorted(set(columns) - COLUMNS):
        faults.add(f"columns.{name}", f"unknown column; there are {', '.join(sorted(COLUMNS))}")
    lists: dict[str, Sequence[Any]] = {}
    for name in sorted(set(columns) & COLUMNS):
        if isinstance(columns[name], list):
            lists[name] = columns[name]
        elif columns[name] is not None or name in _REQUIRED:
            faults.add(f"columns.{name}", "a list with one value a trial")
    for name in _REQUIRED:
        if name not in columns:
            faults.add(f"columns.{name}", "required")
    faults.raise_if_any()
    count = len(lists["position"])
    refuse_too_many(count, limit)
    for name, values in lists.items():
        if len(values) != count:
            faults.add(f"columns.{name}", f"has {len(values)} rows and position {count}")
    if count == 0:
        faults.add("columns.position", "at least one trial")
    faults.raise_if_any()
    return Fields(lists, count, lambda i, name: f"columns.{name}.{i}")


def _from_trials(trials: Any, faults: _Faults, limit: int) -> Fields:
    if not isinstance(trials, list) or not trials:
        faults.add("trials", "a list of at least one trial")
        faults.raise_if_any()
    refuse_too_many(len(trials), limit)
    return _from_rows(trials, faults, lambda i, name: f"trials.{i}.{name}" if name else f"trials.{i}")


def _from_rows(rows: list[Any], faults: _Faults, place: Callable[[int, str], str]) -> Fields:
    if set(map(type, rows)) != {dict}:
        for i, row in enumerate(rows):
            if not isinstance(row, dict):
                faults.add(place(i, "").rstrip("."), "a trial is a JSON object")
        faults.raise_if_any()
    names: set[str] = set().union(*rows)
    if "matrix" in names:
        rows = [_expanded(row, i, faults, place) for i, row in enumerate(rows)]
        faults.raise_if_any()
        names = set().union(*rows)
    if not names <= _TRIAL:
        for i, row in enumerate(rows):
            for name in sorted(row.keys() - _TRIAL):
                faults.add(place(i, str(name)), "unknown field")
    for name in _REQUIRED:
        missing = [i for i, row in enumerate(rows) if row.get(name) is None]
        for i in missing:
            faults.add(place(i, name), "required")
    faults.raise_if_any()
    lists = {name: [row.get(name) for row in rows] for name in sorted(names & _TRIAL)}
    return Fields(lists, len(rows), place)


def _expanded(
    row: dict[str, Any], i: int, faults: _Faults, place: Callable[[int, str], str]
) -> dict[str, Any]:
    try:
        row = expand_matrix(row)
    except ValueError as error:
        faults.add(place(i, "matrix"), str(error))
        return row
    # As JSON would have brought them.
    return {key: list(value) if isinstance(value, tuple) else value for key, value in row.items()}


# --- one list a field to arrays -------------------------------------------------------------------------


def check(fields: Fields, beside: dict[str, Any]) -> TrialBatch:
    """Fields with what stands once beside them for the whole batch."""
    faults = _Faults()
    for name in sorted(set(beside) - _DEFAULTS):
        faults.add(name[:80], "unknown field beside columns")
    defaults = _defaults({name: beside[name] for name in _DEFAULTS & set(beside)}, faults)
    return _check(fields, defaults, faults)


def _check(fields: Fields, defaults: TrialDefaults, faults: _Faults) -> TrialBatch:
    position = _vectors(fields, "position", 3, faults)
    quaternion = _vectors(fields, "quaternion_xyzw", 4, faults)
    outcome = _outcomes(fields, faults)
    if position is not None:
        far = (np.abs(position) > MAX_COORDINATE_M).any(axis=1)
        for i in np.flatnonzero(far):
            faults.add(
                fields.place(int(i), "position"),
                f"coordinates are metres and at most {MAX_COORDINATE_M:g} from the origin:"
                " is the unit right?",
            )
    if quaternion is not None:
        with np.errstate(over="ignore"):  # an infinite norm is far enough from 1
            norm = np.sqrt((quaternion**2).sum(axis=1))
        for i in np.flatnonzero(~(np.abs(norm - 1.0) <= UNIT_TOLERANCE)):
            faults.add(
                fields.place(int(i), "quaternion_xyzw"),
                f"a quaternion (x, y, z, w) must have norm 1 within {UNIT_TOLERANCE:g};"
                f" this one has {norm[i]:.6g}",
            )
        quaternion = quaternion / np.where(norm > 0, norm, 1.0)[:, None]
    combinations, combination = _combinations(fields, defaults, faults)
    proposal = _scalars(fields, "proposal_density", faults, 0.0, 1e15, above=True)
    if defaults.proposal_density is not None:
        if proposal is None:
            proposal = np.full(fields.count, defaults.proposal_density)
        else:
            proposal[np.isnan(proposal)] = defaults.proposal_density
    batch = {
        "proposal_density": proposal,
        "quality": _scalars(fields, "quality", faults, -1e9, 1e9),
        "width_m": _scalars(fields, "width_m", faults, 0.0, 10.0),
        "measured_at": _each(fields, "measured_at", faults, _time),
        "pose_covariance": _each(fields, "pose_covariance", faults, _covariance),
        "row_metadata": _each(fields, "metadata", faults, _METADATA.validate_python),
    }
    faults.raise_if_any()
    assert position is not None
    assert quaternion is not None
    assert outcome is not None
    return TrialBatch(
        position=position,
        quaternion_xyzw=quaternion,
        outcome=outcome,
        combinations=combinations,
        combination=combination,
        metadata=defaults.metadata,
        field_of_gripper=lambda gripper: _field_of_gripper(fields, gripper),
        **batch,  # type: ignore[arg-type]
    )


def _vectors(fields: Fields, name: str, width: int, faults: _Faults) -> FloatArray | None:
    """(n, width) finite numbers, or None with the faults."""
    values = fields.lists[name]
    if isinstance(values, np.ndarray):
        return values
    if set(map(type, values)) == {list} and set(map(len, values)) == {width}:
        flat = chain.from_iterable(values)
        if set(map(type, flat)) <= {int, float}:
            try:
                table = np.fromiter(chain.from_iterable(values), np.float64, len(values) * width)
            except OverflowError:
                table = np.array([_float(x) for x in chain.from_iterable(values)])
            table = table.reshape(-1, width)
            finite = np.isfinite(table).all(axis=1)
            if finite.all():
                return table
            for row in np.flatnonzero(~finite):
                faults.add(fields.place(int(row), name), "every number must be finite")
            return None
    for i, value in enumerate(values):
        numbers = isinstance(value, list) and all(type(x) in (int, float) for x in value)
        if not numbers or len(value) != width:
            faults.add(fields.place(i, name), f"a list of {width} numbers")
    return None


def _float(number: float) -> float:
    try:
        return float(number)
    except OverflowError:
        return np.inf


def _scalars(
    fields: Fields, name: str, faults: _Faults, lower: float, upper: float, *, above: bool = False
) -> FloatArray | None:
    """(n,) numbers between the bounds with NaN for null; None where the field is absent throughout."""
    values = fields.lists.get(name)
    if values is None:
        return None
    if isinstance(values, np.ndarray):
        table, given = values.copy(), ~np.isnan(values)
    else:
        kinds = set(map(type, values))
        if kinds <= {type(None)}:
            return None
        if not kinds <= {int, float, type(None)}:
            for i, value in enumerate(values):
                if type(value) not in (int, float, type(None)):
                    faults.add(fields.place(i, name), "a number or null")
            return None
        given = np.array([value is not None for value in values])
        table = np.array([np.nan if value is None else _float(value) for value in values])
    inside = (table > lower if above else table >= lower) & (table <= upper)
    bounds = f"above {lower:g} and at most {upper:g}" if above else f"from {lower:g} to {upper:g}"
    for row in np.flatnonzero(given & ~inside):
        faults.add(fields.place(int(row), name), f"a finite number {bounds}")
    return table


def _outcomes(fields: Fields, faults: _Faults) -> npt.NDArray[np.uint8] | None:
    values = fields.lists["outcome"]
    if isinstance(values, np.ndarray):
        return values
    if set(map(type, values)) <= {str, bool}:
        codes = [int(v) if v is True or v is False else OUTCOME_CODES.get(v, -1) for v in values]
        if min(codes) >= 0:
            return np.array(codes, dtype=np.uint8)
    for i, value in enumerate(values):
        if not isinstance(value, bool) and not (isinstance(value, str) and value in OUTCOME_CODES):
            faults.add(fields.place(i, "outcome"), f"one of {', '.join(OUTCOMES)}, true or false")
    return None


def _combinations(
    fields: Fields, defaults: TrialDefaults, faults: _Faults
) -> tuple[list[Combination], npt.NDArray[np.int64]]:
    columns: list[list[str | None]] = []
    for name in ("gripper", "source", "protocol"):
        default = getattr(defaults, name)
        values = fields.lists.get(name)
        if values is None:
            columns.append([default])
            continue
        if set(map(type, values)) <= {str, type(None)}:
            wrong = {value for value in set(values) if value is not None and not _named(name, value)}
        else:
            wrong = None
        if wrong is None or wrong:
            rule = f"one of {', '.join(SOURCES)}" if name == "source" else _SLUG_RULE
            for i, value in enumerate(values):
                if value is not None and not (isinstance(value, str) and _named(name, value)):
                    faults.add(fields.place(i, name), rule)
            columns.append([default])
            continue
        columns.append([default if value is None else value for value in values])
    if all(len(column) == 1 for column in columns):
        only = (columns[0][0], columns[1][0], columns[2][0])
        return [only], np.zeros(fields.count, dtype=np.int64)
    full = [column if len(column) == fields.count else column * fields.count for column in columns]
    rows = list(zip(*full, strict=True))
    number = {combination: i for i, combination in enumerate(dict.fromkeys(rows))}
    return list(number), np.array([number[row] for row in rows], dtype=np.int64)


def _named(name: str, value: str) -> bool:
    return value in SOURCES if name == "source" else _SLUG.fullmatch(value) is not None


def _field_of_gripper(fields: Fields, gripper: str) -> str:
    for i, value in enumerate(fields.lists.get("gripper", ())):
        if value == gripper:
            return fields.place(i, "gripper")
    return "gripper"


def _each(fields: Fields, name: str, faults: _Faults, check: Callable[[Any], Any]) -> list[Any] | None:
    """Values of a field that has no array form, each checked; None where it is absent throughout."""
    values = fields.lists.get(name)
    if values is None or set(map(type, values)) <= {type(None)}:
        return None
    checked: list[Any] = []
    for i, value in enumerate(values):
        try:
            checked.append(None if value is None else check(value))
        except ValidationError as error:
            first = error.errors(include_input=False, include_context=False)[0]
            faults.add(fields.place(i, name), first["msg"].removeprefix("Value error, "))
        except (ValueError, OverflowError) as error:
            faults.add(fields.place(i, name), str(error))
    return checked


def _time(value: Any) -> datetime:
    if not isinstance(value, str | datetime):
        raise ValueError("a time as text, such as 2026-01-31T12:00:00Z")
    time = _TIME.validate_python(value)
    if not 1900 <= time.year <= 2500:
        raise ValueError("a time between the years 1900 and 2500")
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def _covariance(value: Any) -> list[list[float]]:
    rows = (
        isinstance(value, list)
        and len(value) == 6
        and all(isinstance(r, list) and len(r) == 6 for r in value)
    )
    if not rows or not set(map(type, chain.from_iterable(value))) <= {int, float}:
        raise ValueError("a 6x6 list of numbers, translation first")
    matrix = np.array([[_float(x) for x in row] for row in value])
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > 1e6:
        raise ValueError("every number must be finite, at most 1e6 (m^2, m rad, rad^2)")
    scale = max(float(np.abs(matrix).max()), 1e-300)
    if np.abs(matrix - matrix.T).max() > 1e-6 * scale:
        raise ValueError("a covariance is symmetric")
    if np.linalg.eigvalsh((matrix + matrix.T) / (2 * scale)).min() < -1e-6:
        raise ValueError("a covariance has no negative eigenvalue")
    listed: list[list[float]] = matrix.tolist()
    return listed

"""Trials as one list a field, checked as arrays: what every form of a request is brought to.

A large batch is never validated row by row: each field's types, shapes and ranges are checked at once; only
where that fails does a loop look for the places to name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from graspdb.wire import OUTCOME_CODES, OUTCOMES, SOURCES
from graspdb.wire.base import MAX_COORDINATE_M, UNIT_TOLERANCE, Metadata
from graspdb.wire.trials import TrialDefaults
from graspdb_service.problems import ProblemError, invalid_fields
from graspdb_service.trial_columns import Floats, Ints, Provenance, TrialBatch, TrialColumns

DEFAULTS = frozenset(TrialDefaults.model_fields)
REQUIRED = ("position", "quaternion_xyzw", "outcome")
_OPTIONAL = ("quality", "width_m", "pose_covariance", "measured_at")
NAMES = frozenset(REQUIRED) | frozenset(_OPTIONAL) | DEFAULTS
_SLUG = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_SLUG_RULE = "letters, digits, '.', '_', '-'; at most 64 characters, the first a letter or digit"
_METADATA: TypeAdapter[Any] = TypeAdapter(Metadata)
_TIME: TypeAdapter[datetime] = TypeAdapter(datetime)
_MOST_ERRORS = 20


@dataclass
class Faults:
    """What is wrong so far; ends the search for more at a number that helps."""

    found: list[tuple[str, str]] = field(default_factory=list)

    def add(self, place: str, message: str) -> None:
        self.found.append((place, message))
        if len(self.found) >= _MOST_ERRORS:
            self.raise_if_any()

    def raise_if_any(self) -> None:
        if self.found:
            raise invalid_fields(self.found, "The trials are not valid; none was stored")


@dataclass
class Fields:
    """Trials as one list a field, and how a field of a trial is called in the request.

    Numbers and outcome codes may be arrays already, finite, with NaN for null.
    """

    lists: Mapping[str, Sequence[Any] | NDArray[Any]]
    count: int
    place: Callable[[int, str], str]


def refuse_too_many(count: int, limit: int) -> None:
    """413 for more trials than one request may have."""
    if count > limit:
        raise ProblemError(
            413,
            "too-many-trials",
            f"{count:,} trials in one request are too many: send them in batches of at most {limit:,},"
            " each with an Idempotency-Key of its own",
            extra={"limit": limit},
        )


def defaults_of(beside: Mapping[str, Any], faults: Faults, form: str) -> TrialDefaults:
    """What stands once for the whole batch, beside its ``form``: ``columns`` or ``trials``."""
    for name in sorted(set(beside) - DEFAULTS):
        faults.add(name[:80], f"unknown field beside {form}")
    try:
        return TrialDefaults.model_validate({name: beside[name] for name in DEFAULTS & set(beside)})
    except ValidationError as error:
        for item in error.errors(include_input=False, include_context=False):
            faults.add(".".join(map(str, item["loc"])), item["msg"].removeprefix("Value error, "))
    return TrialDefaults()


def check(fields: Fields, defaults: TrialDefaults, faults: Faults) -> TrialBatch:
    """Checked trials, or 422 naming the fields that are wrong, those in ``faults`` included."""
    position = _positions(fields, faults)
    quaternion = _quaternions(fields, faults)
    outcome = _outcomes(fields, faults)
    provenances, provenance = _provenances(fields, defaults, faults)
    proposal = _scalars(fields, "proposal_density", faults, 0.0, 1e15, above=True)
    if defaults.proposal_density is not None:
        if not len(proposal):
            proposal = np.full(fields.count, np.nan)
        proposal[np.isnan(proposal)] = defaults.proposal_density
    quality = _scalars(fields, "quality", faults, -1e9, 1e9)
    width_m = _scalars(fields, "width_m", faults, 0.0, 10.0)
    measured_at = _each(fields, "measured_at", faults, _time)
    covariance = _each(fields, "pose_covariance", faults, _covariance)
    metadata = _each(fields, "metadata", faults, _METADATA.validate_python)
    faults.raise_if_any()
    assert position is not None
    assert quaternion is not None
    assert outcome is not None
    columns = TrialColumns(
        position=position,
        quaternion_xyzw=quaternion,
        outcome=outcome,
        provenance=provenance,
        proposal_density=proposal,
        quality=quality,
        width_m=width_m,
        measured_at=measured_at,
        pose_covariance=covariance,
        metadata=metadata,
    )
    return TrialBatch(
        columns, provenances, defaults.metadata, lambda gripper: _field_of_gripper(fields, gripper)
    )


def _positions(fields: Fields, faults: Faults) -> Floats | None:
    position = _vectors(fields, "position", 3, faults)
    if position is not None:
        for i in np.flatnonzero((np.abs(position) > MAX_COORDINATE_M).any(axis=1)):
            faults.add(
                fields.place(int(i), "position"),
                f"coordinates are metres and at most {MAX_COORDINATE_M:g} from the origin:"
                " is the unit right?",
            )
    return position


def _quaternions(fields: Fields, faults: Faults) -> Floats | None:
    quaternion = _vectors(fields, "quaternion_xyzw", 4, faults)
    if quaternion is None:
        return None
    with np.errstate(over="ignore"):  # an infinite norm is far enough from 1
        norm = np.sqrt((quaternion**2).sum(axis=1))
    for i in np.flatnonzero(~(np.abs(norm - 1.0) <= UNIT_TOLERANCE)):
        faults.add(
            fields.place(int(i), "quaternion_xyzw"),
            f"a quaternion (x, y, z, w) must have norm 1 within {UNIT_TOLERANCE:g};"
            f" this one has {norm[i]:.6g}",
        )
    return np.asarray(quaternion / np.where(norm > 0, norm, 1.0)[:, None])


def _vectors(fields: Fields, name: str, width: int, faults: Faults) -> Floats | None:
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
    fields: Fields, name: str, faults: Faults, lower: float, upper: float, *, above: bool = False
) -> Floats:
    """(n,) numbers between the bounds with NaN for null; empty where the field is absent throughout."""
    values = fields.lists.get(name)
    if values is None:
        return np.empty(0)
    if isinstance(values, np.ndarray):
        table, given = values.copy(), ~np.isnan(values)
    else:
        kinds = set(map(type, values))
        if kinds <= {type(None)}:
            return np.empty(0)
        if not kinds <= {int, float, type(None)}:
            for i, value in enumerate(values):
                if type(value) not in (int, float, type(None)):
                    faults.add(fields.place(i, name), "a number or null")
            return np.empty(0)
        given = np.array([value is not None for value in values])
        table = np.array([np.nan if value is None else _float(value) for value in values])
    inside = (table > lower if above else table >= lower) & (table <= upper)
    bounds = f"above {lower:g} and at most {upper:g}" if above else f"from {lower:g} to {upper:g}"
    for row in np.flatnonzero(given & ~inside):
        faults.add(fields.place(int(row), name), f"a finite number {bounds}")
    return table


def _outcomes(fields: Fields, faults: Faults) -> NDArray[np.uint8] | None:
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


def _provenances(fields: Fields, defaults: TrialDefaults, faults: Faults) -> tuple[list[Provenance], Ints]:
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
        return [Provenance(columns[0][0], columns[1][0], columns[2][0])], np.zeros(
            fields.count, dtype=np.int64
        )
    full = [column if len(column) == fields.count else column * fields.count for column in columns]
    rows = list(zip(*full, strict=True))
    number = {names: i for i, names in enumerate(dict.fromkeys(rows))}
    return [Provenance(*names) for names in number], np.array([number[row] for row in rows], dtype=np.int64)


def _named(name: str, value: str) -> bool:
    return value in SOURCES if name == "source" else _SLUG.fullmatch(value) is not None


def _field_of_gripper(fields: Fields, gripper: str) -> str:
    for i, value in enumerate(fields.lists.get("gripper", ())):
        if value == gripper:
            return fields.place(i, "gripper")
    return "gripper"


def _each(fields: Fields, name: str, faults: Faults, check: Callable[[Any], Any]) -> list[Any]:
    """Values of a field that has no array form, each checked; empty where it is absent throughout."""
    values = fields.lists.get(name)
    if values is None or set(map(type, values)) <= {type(None)}:
        return []
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

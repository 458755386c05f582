"""Poses of a request's body, JSON or Arrow, as arrays; and what numbers of a pose are refused for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Any

import numpy as np
import orjson
from fastapi.exceptions import RequestValidationError
from pydantic import TypeAdapter, ValidationError

from graspdb.wire import Pose
from graspdb.wire.base import MAX_COORDINATE_M, UNIT_TOLERANCE, no_such_field
from graspdb.wire.trials import ProposalDensity
from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_service.formats import arrow
from graspdb_service.formats.json_bodies import no_json
from graspdb_service.formats.json_pieces import LongArray
from graspdb_service.problems import invalid, invalid_fields
from graspdb_service.trial_columns import Floats

Refuse = Callable[[str, int, str], None]
"""Told a field, a row of it and what is wrong there."""

_ROWS = 16_384
_FIELDS = ("position", "quaternion_xyzw")
_FINITE = "every number must be finite"
_DENSITIES: TypeAdapter[list[float | None]] = TypeAdapter(list[ProposalDensity | None])


# -- numbers, wherever they come from ------------------------------------------------------------------------


def vectors(rows: Sequence[Any], width: int) -> Floats:
    """Lists of ``width`` finite numbers as an array (n, width); ValueError says what one of them is not."""
    if not rows:
        return np.empty((0, width))
    lists = set(map(type, rows)) == {list} and set(map(len, rows)) == {width}
    if not lists or not set(map(type, chain.from_iterable(rows))) <= {int, float}:
        raise ValueError(f"a list of {width} numbers")
    try:
        table = np.fromiter(chain.from_iterable(rows), np.float64, len(rows) * width)
    except OverflowError:  # an integer beyond all floats
        raise ValueError(_FINITE) from None
    if not np.isfinite(table).all():
        raise ValueError(_FINITE)
    return table.reshape(-1, width)


def no_vectors(rows: Sequence[Any], width: int) -> Iterator[tuple[int, str]]:
    """The rows that :func:`vectors` refuses, and why."""
    for i, row in enumerate(rows):
        try:
            vectors([row], width)
        except ValueError as error:
            yield i, str(error)


def near(position: Floats, refuse: Refuse) -> Floats:
    """Positions (n, 3), those refused that no object can be meant to have."""
    for row in np.flatnonzero((np.abs(position) > MAX_COORDINATE_M).any(axis=1)):
        told = f"coordinates are metres and at most {MAX_COORDINATE_M:g} from the origin: is the unit right?"
        refuse("position", int(row), told)
    return position


def unit(quaternion: Floats, refuse: Refuse) -> Floats:
    """Quaternions (n, 4) scaled to length 1, those refused that are farther from it than rounding."""
    with np.errstate(over="ignore"):  # an infinite norm is far enough from 1
        norm = np.linalg.norm(quaternion, axis=1)
    for row in np.flatnonzero(~(np.abs(norm - 1.0) <= UNIT_TOLERANCE)):
        told = f"a quaternion (x, y, z, w) must have norm 1 within {UNIT_TOLERANCE:g};"
        refuse("quaternion_xyzw", int(row), f"{told} this one has {norm[row]:.6g}")
    return np.asarray(quaternion / np.where(norm > 0, norm, 1.0)[:, None])


# -- a request's poses ---------------------------------------------------------------------------------------


def read_arrow_poses(body: bytes) -> tuple[dict[str, Any], Poses]:
    """What an Arrow stream says beside its poses, and these."""
    table = arrow.Table(body, _FIELDS, prefix="poses")
    if not table.count:
        raise invalid("poses", "at least one pose")
    poses = table.vectors("position", 3), table.vectors("quaternion_xyzw", 4)
    return table.options, _checked(*poses, "poses.{field}.{row}")


def read_poses(value: Any) -> Poses:
    """Those of a list of poses or of pose columns.

    422 names the first bad field, as the wire's models would.
    """
    if isinstance(value, dict):
        errors = [(f"poses.{name}", no_such_field(name, _FIELDS)) for name in value if name not in _FIELDS]
        errors += [(f"poses.{name}", "is missing") for name in _FIELDS if name not in value]
        if errors:
            raise invalid_fields(errors[:20])
        position, quaternion = _column(value, "position", 3), _column(value, "quaternion_xyzw", 4)
        if len(position) != len(quaternion):
            told = f"has {len(quaternion)} rows and position {len(position)}"
            raise invalid("poses.quaternion_xyzw", told)
        return _checked(position, quaternion, "poses.{field}.{row}")
    if not isinstance(value, list | LongArray):
        raise invalid("poses", "a list of poses, or columns {position, quaternion_xyzw}")
    rows = [_rows(items, first) for first, items in _pieces(value)]
    if not rows:
        raise invalid("poses", "at least one pose")
    position, quaternion = (np.concatenate(part) for part in zip(*rows, strict=True))
    return _checked(position, quaternion, "poses.{row}.{field}")


def read_densities(value: Any, field: str) -> Floats:
    """(n,) proposal densities of a list with NaN for null; a number alone (), null NaN."""
    if not isinstance(value, list | LongArray):
        return np.array(_densities([value], field, None)[0])
    parts = [np.empty(0), *(_densities(items, field, first) for first, items in _pieces(value))]
    return np.concatenate(parts)


def _densities(items: list[Any], field: str, first: int | None) -> Floats:
    try:
        found = _DENSITIES.validate_python(items)
    except ValidationError as error:
        wrong = error.errors(include_input=False)[0]
        place = field if first is None else f"{field}.{first + int(wrong['loc'][0])}"
        raise invalid(place, wrong["msg"]) from None
    return np.array(found, dtype=np.float64)


def _pieces(value: list[Any] | LongArray) -> Iterator[tuple[int, list[Any]]]:
    """A list, or a long array of a body, as consecutive lists, each with the index of its first item."""
    if isinstance(value, list):
        for start in range(0, len(value), _ROWS):
            yield start, value[start : start + _ROWS]
        return
    start = 0
    try:
        for items in value:
            yield start, items
            start += len(items)
    except orjson.JSONDecodeError as error:
        raise no_json(error) from None


def _checked(position: Floats, quaternion: Floats, place: str) -> Poses:
    """Poses with unit quaternions; ``place`` is what a field of a row is called."""
    if not len(position):
        raise invalid("poses", "at least one pose")

    def refuse(field: str, row: int, message: str) -> None:
        raise invalid(place.format(field=field, row=row), message)

    return Poses(near(position, refuse), unit(quaternion, refuse))


def _column(columns: dict[str, Any], name: str, width: int) -> Floats:
    if not isinstance(columns[name], list | LongArray):
        raise invalid(f"poses.{name}", f"a list of rows of {width} numbers")
    parts = [np.empty((0, width))]
    for first, items in _pieces(columns[name]):
        try:
            parts.append(vectors(items, width))
        except ValueError:
            row, told = next(no_vectors(items, width))
            raise invalid(f"poses.{name}.{first + row}", told) from None
    return np.concatenate(parts)


def _rows(items: list[Any], first: int) -> tuple[Floats, Floats]:
    """Poses as rows: the fast way where all have the plain form, else each by its model."""
    try:
        if all(item.keys() == set(_FIELDS) for item in items):
            position = vectors([item["position"] for item in items], 3)
            return position, vectors([item["quaternion_xyzw"] for item in items], 4)
        if all(item.keys() == {"matrix"} for item in items):
            return _from_matrices([item["matrix"] for item in items])
    except (AttributeError, TypeError, ValueError):
        pass  # One is wrong: its model says which and why.
    position, quaternion = np.empty((len(items), 3)), np.empty((len(items), 4))
    for i, item in enumerate(items):
        try:
            pose = Pose.model_validate(item)
        except ValidationError as error:
            raise RequestValidationError(
                [{**e, "loc": ("poses", first + i, *e["loc"])} for e in error.errors(include_input=False)]
            ) from None
        position[i], quaternion[i] = pose.position, pose.quaternion_xyzw
    return position, quaternion


def _from_matrices(values: list[Any]) -> tuple[Floats, Floats]:
    matrices = vectors(list(chain.from_iterable(values)), 4).reshape(-1, 4, 4)
    if len(matrices) != len(values) or not all(len(matrix) == 4 for matrix in values):
        raise ValueError("shape")
    if np.abs(matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise ValueError("last row")
    return matrices[:, :3, 3].copy(), se3.from_matrix(matrices[:, :3, :3])

"""Poses of a request's body, JSON or Arrow, as arrays."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import orjson
from fastapi.exceptions import RequestValidationError
from numpy.typing import NDArray
from pydantic import ValidationError

from graspdb.wire import Pose
from graspdb.wire.base import MAX_COORDINATE_M, UNIT_TOLERANCE
from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_service.formats import arrow
from graspdb_service.formats.json_bodies import no_json
from graspdb_service.formats.json_pieces import LongArray
from graspdb_service.problems import ProblemError, invalid

Floats = NDArray[np.float64]

_ROWS = 16_384


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


def read_arrow_poses(body: bytes) -> tuple[dict[str, Any], Poses]:
    """What an Arrow stream says beside its poses, and these."""
    table = arrow.Table(body, ("position", "quaternion_xyzw"), prefix="poses")
    if not table.count:
        raise invalid("poses", "at least one pose")
    names = ("poses.position.{}", "poses.quaternion_xyzw.{}")
    poses = table.vectors("position", 3), table.vectors("quaternion_xyzw", 4)
    return table.options, _checked(*poses, names)


def read_poses(value: Any, field: str = "poses") -> Poses:
    """Those of a list of poses or of pose columns.

    422 names the first bad field, as the wire's models would.
    """
    if isinstance(value, dict):
        _check_keys(value, {"position", "quaternion_xyzw"}, field)
        position = _matrix(value["position"], 3, f"{field}.position")
        quaternion = _matrix(value["quaternion_xyzw"], 4, f"{field}.quaternion_xyzw")
        if len(position) != len(quaternion):
            raise invalid(
                f"{field}.quaternion_xyzw", f"has {len(quaternion)} rows and position {len(position)}"
            )
        names = (f"{field}.position.{{}}", f"{field}.quaternion_xyzw.{{}}")
    elif isinstance(value, list | LongArray):
        rows = [_rows(items, field, first) for first, items in _pieces(value)]
        if not rows:
            raise invalid(field, "at least one pose")
        position, quaternion = (np.concatenate(part) for part in zip(*rows, strict=True))
        names = (f"{field}.{{}}.position", f"{field}.{{}}.quaternion_xyzw")
    else:
        raise invalid(field, "a list of poses, or columns {position, quaternion_xyzw}")
    if not len(position):
        raise invalid(field, "at least one pose")
    return _checked(position, quaternion, names)


def _checked(position: Floats, quaternion: Floats, names: tuple[str, str]) -> Poses:
    """Poses with unit quaternions, near enough; ``names`` are those of a row's fields."""
    far = np.flatnonzero(~(np.abs(position) <= MAX_COORDINATE_M).all(axis=1))
    if far.size:
        raise invalid(
            names[0].format(far[0]),
            f"finite metres, at most {MAX_COORDINATE_M:g} from the origin: is the unit right?",
        )
    norm = np.linalg.norm(quaternion, axis=1)
    wrong = np.flatnonzero(~(np.abs(norm - 1.0) <= UNIT_TOLERANCE))
    if wrong.size:
        raise invalid(
            names[1].format(wrong[0]),
            f"a quaternion (x, y, z, w) must have norm 1 within {UNIT_TOLERANCE:g};"
            f" this one has {norm[wrong[0]]:.6g}",
        )
    return Poses(position, quaternion / norm[:, None])


def _check_keys(value: dict[str, Any], wanted: set[str], field: str) -> None:
    errors = [(f"{field}.{name}", "unknown field") for name in value if name not in wanted]
    errors += [(f"{field}.{name}", "is missing") for name in sorted(wanted) if name not in value]
    if errors:
        raise ProblemError(422, "invalid-request", "The request is not valid", errors=errors[:20])


def _rows(items: list[Any], field: str, first: int) -> tuple[Floats, Floats]:
    """Poses as rows: the fast way where all have the plain form, else each by its model."""
    plain = {"position", "quaternion_xyzw"}
    try:
        if all(item.keys() == plain for item in items):
            return (
                _numbers([item["position"] for item in items], 3),
                _numbers([item["quaternion_xyzw"] for item in items], 4),
            )
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
                [{**e, "loc": (field, first + i, *e["loc"])} for e in error.errors(include_input=False)]
            ) from None
        position[i], quaternion[i] = pose.position, pose.quaternion_xyzw
    return position, quaternion


def _from_matrices(values: list[Any]) -> tuple[Floats, Floats]:
    matrices = _numbers([row for matrix in values for row in matrix], 4).reshape(-1, 4, 4)
    if len(matrices) != len(values) or not all(len(matrix) == 4 for matrix in values):
        raise ValueError("shape")
    if np.abs(matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise ValueError("last row")
    return matrices[:, :3, 3].copy(), se3.from_matrix(matrices[:, :3, :3])


def _matrix(value: Any, width: int, field: str) -> Floats:
    if not isinstance(value, list | LongArray):
        raise invalid(field, f"a list of rows of {width} numbers")
    parts = [np.empty((0, width))]
    for first, items in _pieces(value):
        try:
            parts.append(_numbers(items, width))
        except (TypeError, ValueError):
            for i, row in enumerate(items):
                try:
                    _numbers([row], width)
                except (TypeError, ValueError):
                    raise invalid(f"{field}.{first + i}", f"must be {width} finite numbers") from None
            raise invalid(field, f"a list of rows of {width} numbers") from None
    return np.concatenate(parts)


def _numbers(rows: list[Any], width: int) -> Floats:
    """Rows of numbers as an array; ValueError or TypeError where they are none."""
    values = np.array(rows)
    # Not "O" (null, ragged rows), "U" (text), "b" (true).
    if values.dtype.kind not in "iuf" or values.shape[1:] != (width,):
        raise ValueError("not numbers")
    if not np.isfinite(values).all():
        raise ValueError("not finite")
    return values.astype(np.float64)

"""Poses as arrays: what the SDK accepts, and 4x4 matrices of what it gives back.

Positions in metres, quaternions xyzw, matrices homogeneous and row-major. Rotations within 1e-3 of
exact are normalised and anything farther off is refused, as the service does, so that a bad pose is
named before anything is sent.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspdb import wire
from graspdb.wire.base import MAX_COORDINATE_M, UNIT_TOLERANCE

__all__ = [
    "POSE_COLUMNS",
    "Poses",
    "as_poses",
    "as_vector7",
    "first_masked",
    "matrices",
    "pose_documents",
    "pose_frame",
    "pose_trials",
    "quaternions_of",
    "vector",
]

Floats = NDArray[np.float64]

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""A pose's columns in tables: metres, and a unit quaternion."""


class Poses(NamedTuple):
    """N poses: ``position`` (N, 3) in metres, and unit ``quaternion_xyzw`` (N, 4)."""

    position: Floats
    quaternion_xyzw: Floats

    @classmethod
    def of(cls, matrices: Floats) -> Poses:
        """The poses of (N, 4, 4) homogeneous matrices."""
        return cls(matrices[:, :3, 3].copy(), quaternions_of(matrices[:, :3, :3]))

    @property
    def matrices(self) -> Floats:
        """(N, 4, 4) homogeneous matrices."""
        return matrices(self.position, self.quaternion_xyzw)

    @property
    def rows(self) -> Floats:
        """(N, 7) rows x y z qx qy qz qw."""
        return np.concatenate([self.position, self.quaternion_xyzw], axis=1)

    def followed_by(self, fixed: wire.Pose) -> Poses:
        """Each with a fixed pose on its right: what ``fixed`` is of, where these are its parent frame.

        With ``gripper.profile.in_tool("flange")`` poses of the tool become those of the flange, and with its
        :func:`graspdb.wire.frames.gripper_frames.inverse` go back.
        """
        return Poses.of(self.matrices @ matrices(fixed.position, fixed.quaternion_xyzw))

    def columns(self, part: slice = slice(None)) -> dict[str, Any]:
        """As requests take them, all or a part."""
        return {
            "position": self.position[part].tolist(),
            "quaternion_xyzw": self.quaternion_xyzw[part].tolist(),
        }


def as_poses(poses: ArrayLike | Any) -> Poses:
    """One or many poses, checked, their quaternions normalised.

    (N, 4, 4) or (4, 4) homogeneous matrices, or (N, 7) or (7,) rows ``x y z qx qy qz qw``; anything with
    ``position`` and ``quaternion_xyzw`` (a grasp, samples) is taken too, and a list of such; a DataFrame by
    the names of these columns; a SciPy RigidTransform. A ValueError names the first pose that is not finite,
    masked, beyond 1 km, or whose rotation is farther than 1e-3 from exact.
    """
    if hasattr(poses, "position") and hasattr(poses, "quaternion_xyzw"):
        given = Poses(*(np.atleast_2d(np.asarray(x, float)) for x in (poses.position, poses.quaternion_xyzw)))
        return as_poses(given.rows)
    if isinstance(poses, (list, tuple)) and len(poses) and all(hasattr(p, "quaternion_xyzw") for p in poses):
        return Poses(*(np.concatenate(columns) for columns in zip(*map(as_poses, poses), strict=True)))
    if (row := first_masked(poses)) is not None:
        raise ValueError(f"pose {row} is masked: leave it out")
    poses = _numbers_of(poses)
    try:
        array = np.asarray(poses, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            "poses must be numbers of shape (N, 4, 4), (N, 7) [x y z qx qy qz qw], (4, 4) or (7,)"
        ) from error
    if array.shape == (4, 4) or array.shape == (7,):
        array = array[None]
    if array.ndim == 3 and array.shape[1:] == (4, 4):
        _refuse(~np.isfinite(array).all(axis=(1, 2)), "has numbers that are not finite")
        last = np.abs(array[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1, initial=0.0)
        _refuse(last > 1e-6, "must have the last row 0, 0, 0, 1")
        position, quaternion = array[:, :3, 3].copy(), quaternions_of(array[:, :3, :3])
    elif array.ndim == 2 and array.shape[1] == 7:
        _refuse(~np.isfinite(array).all(axis=1), "has numbers that are not finite")
        position, quaternion = array[:, :3].copy(), array[:, 3:].copy()
        norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
        _refuse(
            np.abs(norm[:, 0] - 1.0) > UNIT_TOLERANCE,
            f"must have a unit quaternion (x, y, z, w) in its last four numbers, within {UNIT_TOLERANCE:g}",
        )
        quaternion /= norm
    else:
        raise ValueError(
            f"poses have shape {array.shape}; expected (N, 4, 4), (N, 7) [x y z qx qy qz qw], (4, 4) or (7,)"
        )
    if len(position) == 0:
        raise ValueError("give at least one pose")
    _refuse(
        np.abs(position).max(axis=1) > MAX_COORDINATE_M,
        "lies more than 1 km from the origin: coordinates are metres",
    )
    return Poses(position, quaternion)


def pose_frame(poses: Any, frame: str | None, convention: str | None) -> dict[str, str]:
    """What poses are of, as requests take it: as is said, else as a grasp or samples say it themselves.

    ValueError where they say otherwise, or each otherwise.
    """
    each = list(poses) if isinstance(poses, (list, tuple)) and len(poses) else [poses]
    found: dict[str, str] = {}
    for name, said, default in (("frame", frame, "tool"), ("convention", convention, "graspdb")):
        own = {value for item in each if isinstance(value := getattr(item, name, None), str)}
        if len(own) > 1 or (own and said is not None and own != {said}):
            raise ValueError(f"{name}: these poses are of {' and '.join(sorted(own))}; asked was {said}")
        value = said or next(iter(own), default)
        if value != default:
            found[name] = value
    return found


def pose_trials(poses: Any, given: Mapping[str, Any]) -> dict[str, str]:
    """The gripper and protocol that a question about poses is about besides those ``given``: of grasps and
    samples those of the trials that they were chosen from.

    Nothing where what is given contradicts them, or each is of another.
    """
    each = list(poses) if isinstance(poses, (list, tuple)) and len(poses) else [poses]
    found: dict[str, str] = {}
    for name in ("gripper", "protocol"):
        own = {value if isinstance(value := getattr(item, name, None), str) else None for item in each}
        said = given.get(name)
        if said is not None and own != {said}:
            return {}
        if said is None and len(own) == 1 and (value := own.pop()) is not None:
            found[name] = value
    return found


def _numbers_of(poses: Any) -> Any:
    """What a table's named columns or a rigid transform hold; anything else as it is."""
    if hasattr(poses, "as_matrix"):
        return poses.as_matrix()
    names = getattr(poses, "columns", None)
    if names is None or callable(names):
        return poses
    if missing := [name for name in POSE_COLUMNS if name not in names]:
        raise ValueError(f"poses of a table have the columns {', '.join(POSE_COLUMNS)}; it lacks {missing}")
    return np.column_stack([poses[name] for name in POSE_COLUMNS])


def first_masked(values: Any) -> int | None:
    """The first entry of a masked array that has anything masked; None without."""
    if not np.ma.is_masked(values):
        return None
    return int(np.ma.getmaskarray(values).reshape(len(values), -1).any(axis=1).argmax())


def numbers(name: str, values: ArrayLike, count: int) -> list[float | None]:
    """A number a pose as JSON, None for NaN and what is masked; one goes for all."""
    if np.ma.is_masked(values):
        values = np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)
    found = listed(name, np.asarray(values, dtype=np.float64), count)
    return [None if np.isnan(value) else value for value in found]


def listed(name: str, array: NDArray[Any], count: int, one: tuple[int, ...] = ()) -> list[Any]:
    """A value of shape ``one`` a trial; one goes for all."""
    if array.shape not in {one, (count, *one)}:
        raise ValueError(
            f"{name}: shape {array.shape}; expected {(count, *one)}, one a pose, or {one} for all"
        )
    found: list[Any] = np.broadcast_to(array, (count, *one)).tolist()
    return found


def _refuse(bad: ArrayLike, what: str) -> None:
    if np.any(bad):
        raise ValueError(f"pose {int(np.argmax(bad))} {what}")


def as_vector7(pose: ArrayLike | Any, name: str = "pose") -> tuple[float, ...]:
    """One pose as ``(x, y, z, qx, qy, qz, qw)``; see :func:`as_poses` for what is accepted.

    ``name`` is what a ValueError calls it.
    """
    try:
        rows = as_poses(pose).rows
    except ValueError as error:
        said = str(error)
        alone = said.removeprefix("pose 0 ")
        raise ValueError(f"{name}: {said}" if alone == said else f"{name} {alone}") from None
    if len(rows) != 1:
        raise ValueError(f"{name}: expected one pose, got {len(rows)}")
    return tuple(rows[0].tolist())


def pose_documents(named: Mapping[str, Any]) -> dict[str, Any]:
    """Poses by name as requests take them: given as such, or as (4, 4) or ``x y z qx qy qz qw``."""
    documents: dict[str, Any] = {}
    for name, pose in named.items():
        if isinstance(pose, Mapping):
            documents[name] = dict(pose)
        elif isinstance(pose, wire.Pose):
            documents[name] = pose.model_dump(mode="json")
        else:
            x, y, z, *quaternion = as_vector7(pose, name)
            documents[name] = {"position": [x, y, z], "quaternion_xyzw": quaternion}
    return documents


def vector(name: str, values: ArrayLike, of: str) -> list[float]:
    """A vector as JSON, its numbers named by ``of``; ValueError for another shape."""
    array, count = np.asarray(values, dtype=np.float64), of.count(",") + 1
    if array.shape != (count,):
        raise ValueError(f"{name} has shape {array.shape}; expected {count} numbers: {of}")
    listed: list[float] = array.tolist()
    return listed


def quaternions_of(rotations: Floats) -> Floats:
    """Unit quaternions xyzw (N, 4) of rotation matrices (N, 3, 3): Shepperd's method (1978), vectorised.

    ValueError names the first matrix that is no rotation within 1e-3.
    """
    gram = np.einsum("nki,nkj->nij", rotations, rotations)
    _refuse(
        np.abs(gram - np.eye(3)).max(axis=(1, 2), initial=0.0) > 2 * UNIT_TOLERANCE,
        "must have a rotation in its upper left 3x3 block: the columns are not orthonormal",
    )
    _refuse(np.linalg.det(rotations) < 0, "must have a rotation, not a reflection, in its upper left block")
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(rotations, 0, 2)
    # Row k is the quaternion times four times its k-th component: the largest of the four divides safest.
    rows = np.array(
        [
            [1 + a - e - i, b + d, c + g, h - f],
            [b + d, 1 - a + e - i, f + h, c - g],
            [c + g, f + h, 1 - a - e + i, d - b],
            [h - f, c - g, d - b, 1 + a + e + i],
        ]
    )
    best = np.argmax(np.einsum("kkn->kn", rows), axis=0)
    quaternion = rows[best, :, np.arange(len(rotations))]
    return np.asarray(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True), dtype=np.float64)


def matrices(position: ArrayLike, quaternion_xyzw: ArrayLike) -> Floats:
    """Homogeneous matrices (..., 4, 4) of positions (..., 3) and unit quaternions xyzw (..., 4)."""
    p, q = np.asarray(position, dtype=np.float64), np.asarray(quaternion_xyzw, dtype=np.float64)
    x, y, z, w = np.moveaxis(q, -1, 0)
    out = np.zeros((*p.shape[:-1], 4, 4))
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[..., :3, :3] = np.moveaxis(np.array(rotation), (0, 1), (-2, -1))
    out[..., :3, 3] = p
    out[..., 3, 3] = 1.0
    return out

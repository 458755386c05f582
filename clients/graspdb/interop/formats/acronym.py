"""ACRONYM, as HDF5 and as JSON, and GraspGen's JSON, which grew out of it.

Matrices of the gripper's base in the frame of the *scaled* mesh, metres; z approaches, x closes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from graspdb.interop.formats.source import (
    CHUNK,
    MIB,
    SourceFile,
    Wishes,
    column_of,
    mapping_of,
    numbers,
    same_length,
    split_matrices,
)
from graspdb.interop.grasps import Floats, Raw, Report, problem
from graspdb.interop.outcomes import FAILURE, SUCCESS
from graspdb.interop.parsing.events import extra
from graspdb.interop.parsing.reader import Column

HELD = "object_in_gripper"
_LARGEST_CHUNK = 256 * MIB
_MARKER_TIP_M = 0.11217
"""Where ACRONYM's drawing of the Panda has its fingertips, ahead of the base."""


def read_hdf5(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """``grasps/transforms`` and everything below ``grasps/qualities``, by slices."""
    h5py = extra("h5py", "HDF5")
    try:
        with h5py.File(source.path, "r") as file:
            _say_hdf5(h5py, source.name, file, report)
            transforms = _dataset(h5py, source.name, file, "grasps/transforms")
            if transforms is None:
                raise problem(source.name, "has no grasps/transforms: ACRONYM's HDF5 has its poses there")
            if transforms.ndim != 3 or transforms.shape[1:] != (4, 4):
                raise problem(source.name, f"grasps/transforms must be N x 4 x 4, not {transforms.shape}")
            qualities = dict(_qualities(h5py, source.name, file))
            same_length(source.name, len(transforms), qualities)
            for first in range(0, len(transforms), CHUNK):
                part = slice(first, first + CHUNK)
                values = {
                    name: numbers(source.name, name, data[part], (None,)) for name, data in qualities.items()
                }
                yield _raw(source.name, np.asarray(transforms[part], dtype=np.float64), values, first, wishes)
    except (OSError, KeyError, RuntimeError) as error:
        raise problem(source.name, f"can't be read as HDF5: {error}") from None


def _dataset(h5py: Any, name: str, file: Any, path: str) -> Any:
    """Numbers of the file itself, None without: links that lead elsewhere are not followed."""
    at = file
    for part in path.split("/"):
        if not isinstance(at, h5py.Group) or part not in at:
            return None
        if not isinstance(at.get(part, getlink=True), h5py.HardLink):
            raise problem(name, f"{path} is a link, which is not followed")
        at = at[part]
    if not isinstance(at, h5py.Dataset):
        return None
    if at.is_virtual or at.external:
        raise problem(name, f"{path} lies in another file, which is not opened")
    if at.dtype.kind not in "fiub":
        raise problem(name, f"{path} must be numbers")
    if at.chunks and np.prod(at.chunks, dtype=float) * at.dtype.itemsize > _LARGEST_CHUNK:
        raise problem(name, f"{path} is stored in pieces of more than {_LARGEST_CHUNK // MIB} MiB")
    return at


def _qualities(h5py: Any, name: str, file: Any) -> Iterator[tuple[str, Any]]:
    """Every quality of the grasps by its name; those of FleX without that."""
    kinds = file.get("grasps/qualities")
    for kind in kinds if isinstance(kinds, h5py.Group) else ():
        link = kinds.get(kind, getlink=True)
        if not isinstance(link, h5py.HardLink):
            raise problem(name, f"grasps/qualities/{kind} is a link, which is not followed")
        inner = kinds[kind]
        for quality in inner if isinstance(inner, h5py.Group) else ():
            data = _dataset(h5py, name, file, f"grasps/qualities/{kind}/{quality}")
            if data is not None and data.ndim == 1:
                yield (quality if kind == "flex" else f"{kind}/{quality}"), data
        if isinstance(inner, h5py.Dataset):
            data = _dataset(h5py, name, file, f"grasps/qualities/{kind}")
            if data.ndim == 1:
                yield kind, data


def _say_hdf5(h5py: Any, name: str, file: Any, report: Report) -> None:
    def scalar(path: str) -> float | None:
        data = _dataset(h5py, name, file, path)
        return None if data is None or data.size != 1 else float(np.ravel(data[()])[0])

    def text(path: str) -> str | None:
        group, _, last = path.rpartition("/")
        parent = file.get(group)
        if not isinstance(parent, h5py.Group) or not isinstance(
            parent.get(last, getlink=True), h5py.HardLink
        ):
            return None
        value = parent[last][()] if isinstance(parent[last], h5py.Dataset) else None
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else None

    _say(
        name,
        report,
        file=text("object/file"),
        scale=scalar("object/scale"),
        gripper=text("gripper/type"),
        volume=scalar("object/volume"),
    )
    known = [what for what in ("mass", "density", "friction", "com", "inertia") if f"object/{what}" in file]
    if known:
        report.drop(f"the object's {', '.join(known)}: set them with graspdb objects change")


def read_json(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """ACRONYM's other form: ``object``, ``object_scale``, ``transforms``, ``quality_flex_...``."""
    data = source.mapping(lambda path: path[0] == "transforms" or path[0].startswith("quality_"))
    _say(
        source.name,
        report,
        file=data.get("object"),
        scale=data.get("object_scale"),
        gripper=data.get("gripper"),
    )
    qualities = {
        key.removeprefix("quality_").removeprefix("flex_"): values
        for key, values in data.items()
        if key.startswith("quality_")
    }
    yield from _of_columns(source.name, data.get("transforms"), qualities, wishes)


def read_graspgen(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """GraspGen's: ``object {file, scale}``, ``grasps {transforms, object_in_gripper}``."""
    data = source.mapping(lambda path: path[0] == "grasps" and len(path) == 2)
    about = mapping_of(source.name, data.get("object", {}), "object")
    grasps = mapping_of(source.name, data.get("grasps"), "grasps")
    gripper = data.get("gripper")
    if isinstance(gripper, dict):
        gripper = gripper.get("type") or gripper.get("name")
    _say(source.name, report, file=about.get("file"), scale=about.get("scale"), gripper=gripper)
    transforms = column_of(source.name, "transforms", grasps.get("transforms"), (4, 4))
    qualities = {
        key: values
        for key, values in grasps.items()
        if key == HELD
        or (
            isinstance(values, Column)
            and values.regular
            and values.count == len(transforms)
            and not values.shape
        )
    }
    for key in grasps.keys() - qualities.keys() - {"transforms"}:
        report.drop(f"grasps.{key}")
    yield from _of_columns(source.name, transforms, qualities, wishes)


def _of_columns(name: str, transforms: Any, qualities: Mapping[str, Any], wishes: Wishes) -> Iterator[Raw]:
    poses = column_of(name, "transforms", transforms, (4, 4))
    if not len(poses):
        raise problem(name, "has no grasps")
    columns = {key: column_of(name, key, column, truths=True) for key, column in qualities.items()}
    same_length(name, len(poses), columns)
    for first in range(0, len(poses), CHUNK):
        values = {key: column.take(first, first + CHUNK) for key, column in columns.items()}
        yield _raw(name, poses.take(first, first + CHUNK), values, first, wishes)


def _raw(name: str, transforms: Floats, qualities: dict[str, Floats], first: int, wishes: Wishes) -> Raw:
    position, rotation = split_matrices(name, transforms, first, drop=wishes.drop_unusable)
    held = qualities.get(HELD)
    outcome = None
    if held is not None:
        wrong = np.flatnonzero(~np.isin(held, (0.0, 1.0)))
        if wrong.size:
            row = int(wrong[0])
            raise problem(name, f"grasp {first + row}: {HELD} is {held[row]:g}; expected 0 or 1")
        outcome = np.where(held == 1.0, SUCCESS, FAILURE).astype(np.uint8)
    return Raw(first, position, rotation=rotation, outcome=outcome, qualities=qualities)


def _say(
    name: str, report: Report, *, file: Any, scale: Any, gripper: Any, volume: float | None = None
) -> None:
    if scale is not None:
        if isinstance(scale, (list, tuple)) and len(set(map(str, scale))) == 1:
            scale = scale[0]
        given = float(numbers(name, "the object's scale", scale, ()))
        if not (np.isfinite(given) and given > 0):
            raise problem(name, f"the object's scale is {given}; expected a positive number")
        report.object_scale = given
        report.recognise(
            f"poses of the mesh{f' {file}' if isinstance(file, str) else ''} at scale {given:.9g}"
        )
    elif isinstance(file, str):
        report.recognise(f"poses of the mesh {file}")
    if volume is not None and volume > 0:
        report.object_volume_m3 = volume
    if isinstance(gripper, str):
        if "suction" in gripper.lower():
            raise problem(name, "has grasps of a suction cup; GraspDB knows parallel jaws")
        report.recognise(f"gripper {gripper}")
        if gripper.lower() == "panda":
            report.recognise(f"ACRONYM draws the Panda's fingertips {_MARKER_TIP_M:.4f} m ahead of its base")

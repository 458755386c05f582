"""Untrusted robots are read in a child process of bounded memory and time, which ends with the service.

Run as ``python -m graspdb_service.usecases.cells.robot_child``: order and content on the standard input,
result on the standard output. Meshes are those that came along, by their file names: nothing else is opened.
"""

from __future__ import annotations

import io
import json
import sys
import zipfile
from collections.abc import Mapping
from pathlib import PurePosixPath

import numpy as np

from graspdb_geometry.mesh_reading.content import FormatError
from graspdb_geometry.mesh_reading.formats import READERS
from graspdb_geometry.meshes import MAX_TRIANGLES
from graspdb_robots.arm import Arm, Floats
from graspdb_service.usecases.geometry.bounded_child import ChildFailed, ChildLimits, begin, bounded

_MOST_FILES = 2_000
_MEDIA = {".stl": "model/stl", ".obj": "model/obj", ".ply": "model/ply", ".glb": "model/gltf-binary"}


class RobotRefused(ValueError):
    """What is wrong with a robot, for a person, and which field of the request says it."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field
        self.message = message


def read_robot(
    data: bytes, zipped: bool, flange: str | None, *, max_bytes: int, memory_bytes: int, seconds: float
) -> tuple[str, Arm]:
    """The robot's name and its arm to the link ``flange``; RobotRefused for what can't be used.

    ``zipped`` says that the URDF is in a zip with its meshes; ``max_bytes`` is what that may unpack to
    in all; the rest as for `ChildLimits`.
    """
    order = {"zipped": zipped, "flange": flange, "max_bytes": max_bytes}
    try:
        answer = bounded(__name__, order, data, ChildLimits(memory_bytes, seconds))
    except ChildFailed as error:
        raise RobotRefused("robot", str(error)) from None
    head, _, rest = answer.partition(b"\n")
    told = json.loads(head)
    if "error" in told:
        raise RobotRefused(told["error"]["field"], told["error"]["message"])
    return told["name"], Arm.from_bytes(rest)


def main() -> int:
    """Limit this process, read one robot, write the result; 0 also for a robot that was refused."""
    order = begin()
    # Here and not above: the service itself starts without it.
    from graspdb_robots.urdf import UrdfError, read_arm  # extra: robot

    try:
        xml, meshes = _unpacked(sys.stdin.buffer.read(), order["zipped"], order["max_bytes"])
        name, arm = read_arm(xml, order["flange"], lambda name: _points(meshes, name))
        answer = json.dumps({"name": name}).encode() + b"\n" + arm.to_bytes()
    except (UrdfError, RobotRefused) as error:
        answer = json.dumps({"error": {"field": error.field, "message": error.message}}).encode() + b"\n"
    sys.stdout.buffer.write(answer)
    sys.stdout.buffer.flush()
    return 0


def _unpacked(data: bytes, zipped: bool, max_bytes: int) -> tuple[bytes, Mapping[str, bytes]]:
    """The URDF, and the other files by their paths."""
    if not zipped:
        return data, {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = [item for item in archive.infolist() if not item.is_dir()]
            if len(entries) > _MOST_FILES or sum(item.file_size for item in entries) > max_bytes:
                raise RobotRefused(
                    "robot",
                    f"it unpacks to over {max_bytes:,} bytes or {_MOST_FILES:,} files: leave out visual ones",
                )
            files = {item.filename: _member(archive, item) for item in entries}
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, EOFError) as error:
        raise RobotRefused("robot", f"not a zip that can be read: {error}") from None
    urdfs = [name for name in files if name.lower().endswith(".urdf")]
    if len(urdfs) != 1:
        raise RobotRefused("robot", f"a zip holds one .urdf and its meshes; this one has {len(urdfs)}")
    return files.pop(urdfs[0]), files


def _member(archive: zipfile.ZipFile, item: zipfile.ZipInfo) -> bytes:
    with archive.open(item) as stream:
        # No more than it says: that was counted.
        return stream.read(item.file_size)


def _points(meshes: Mapping[str, bytes], name: str) -> Floats | None:
    """Points of a mesh that came along: the file that shares the longest end of the path with ``name``."""
    wanted = PurePosixPath(name.split("://")[-1].replace("\\", "/")).parts
    if not wanted:
        return None
    same = [path for path in meshes if PurePosixPath(path.replace("\\", "/")).name == wanted[-1]]
    if not same:
        return None
    nearest = max(same, key=lambda path: _shared(PurePosixPath(path.replace("\\", "/")).parts, wanted))
    reader = READERS.get(_MEDIA.get(PurePosixPath(wanted[-1]).suffix.lower(), ""))
    if reader is None:
        return None
    try:
        found = reader(meshes[nearest], MAX_TRIANGLES).geometries
    except (FormatError, ValueError):
        return None
    return np.concatenate([item.vertices for item in found]) if found else None


def _shared(one: tuple[str, ...], other: tuple[str, ...]) -> int:
    count = 0
    while count < min(len(one), len(other)) and one[-1 - count] == other[-1 - count]:
        count += 1
    return count


if __name__ == "__main__":
    sys.exit(main())

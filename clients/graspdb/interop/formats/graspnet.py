"""GraspNet: grasps as 17 floats in .npy, and its label files, .npz.

17 floats are score, width, height, depth, rotation (9, row-major), translation (3) and object id, in the
*camera's* frame; x approaches, y closes, and the fingertips lie ``depth`` ahead of the translation. Labels
are in the object's frame: every point with 300 views, 12 turns and 4 depths, the score the least coefficient
of friction that holds, -1 where nothing does.
"""

from __future__ import annotations

import ast
import zipfile
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from graspdb.interop.formats.source import CHUNK, MIB, SourceFile, Wishes
from graspdb.interop.grasps import Floats, Raw, Report, problem
from graspdb.interop.outcomes import COLLISION, FAILURE, SUCCESS

VIEWS, TURNS, DEPTHS = 300, 12, 4
HOLDS_AT_FRICTION = 0.4
"""Labels that hold at this coefficient of friction are those that GraspNet's own loader takes."""

#: Labels have single precision.
_ROUNDING = 1e-6

_PICKLED = (
    "holds pickled Python objects, which are never read: save plain arrays, or a table (CSV, JSON Lines,"
    " Parquet)"
)
_LONGEST_HEADER = 65_536


def read_array(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """(N, 17) floats of a .npy file, read by pieces."""
    try:
        array = np.load(source.path, allow_pickle=False, mmap_mode="r")
    except ValueError as error:
        told = (
            _pickled(source) if "allow_pickle" in str(error) or "object" in str(error).lower() else str(error)
        )
        raise problem(source.name, told) from None
    except (OSError, EOFError, SyntaxError, OverflowError) as error:
        raise problem(source.name, f"can't be read as .npy: {error}") from None
    if array.shape == (17,):
        array = array[None]
    if array.ndim != 2 or array.shape[1] != 17 or array.dtype.kind not in "fiu":
        raise problem(source.name, f"has an array of shape {array.shape}; GraspNet's has N x 17 numbers")
    report.map("width, height and depth to qualities, depth to the fingertips' place")
    wanted = wishes.only.get("object_id")
    others: set[float] = set()
    for first in range(0, len(array), CHUNK):
        rows = np.asarray(array[first : first + CHUNK], dtype=np.float64)
        others |= set(np.unique(rows[:, 16]).tolist())
        if wanted is None and len(others) > 1:
            raise problem(
                source.name,
                f"has grasps of several objects ({_some(others)}): name one with --only object_id=...",
            )
        if wanted is not None:
            rows = rows[rows[:, 16] == _float(source.name, wanted)]
        yield Raw(
            first,
            rows[:, 13:16],
            rotation=rows[:, 4:13].reshape(-1, 3, 3),
            qualities={"score": rows[:, 0], "width": rows[:, 1], "height": rows[:, 2], "depth": rows[:, 3]},
            ahead_m=rows[:, 3],
        )
    if wanted is not None and float(wanted) not in others:
        raise problem(source.name, f"has no grasps of object {wanted}; there are {_some(others)}")
    if wanted is not None and len(others) > 1:
        report.drop(f"grasps of objects {_some(others - {float(wanted)})}: only those of {wanted} are taken")


def read_labels(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """``points`` (P, 3), ``offsets`` (P, 300, 12, 4, 3), ``collision``, ``scores``; by pieces."""
    try:
        with zipfile.ZipFile(source.path) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
            if not {"points", "offsets", "scores"} <= names:
                raise problem(source.name, _other_archive(archive, names))
            points = _Member(source.name, archive, "points", (3,)).take(None)
            grid = (VIEWS, TURNS, DEPTHS)
            with_depth = _Member(source.name, archive, "offsets", (*grid, 3))
            scores = _Member(source.name, archive, "scores", grid)
            collision = _Member(source.name, archive, "collision", grid) if "collision" in names else None
            for member in (with_depth, scores, collision):
                if member is not None and member.count != len(points):
                    raise problem(
                        source.name, f"{member.what} has {member.count} points, points {len(points)}"
                    )
            yield from _labels(points, with_depth, scores, collision, report)
    except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError, RuntimeError) as error:
        raise problem(source.name, f"can't be read as .npz: {error}") from None


def _labels(
    points: Floats, offsets: _Member, scores: _Member, collision: _Member | None, report: Report
) -> Iterator[Raw]:
    approach = -views(VIEWS)
    first, dropped = 0, 0
    step = max(1, CHUNK // (VIEWS * TURNS * DEPTHS))
    for start in range(0, len(points), step):
        part = points[start : start + step]
        friction = np.asarray(scores.take(len(part)), dtype=np.float64)
        about = np.asarray(offsets.take(len(part)), dtype=np.float64)
        collides = None if collision is None else np.asarray(collision.take(len(part)), dtype=bool)
        valid = friction > 0
        # Without a number a score says nothing either.
        dropped += int((~valid).sum())
        point, view, turn, depth = np.nonzero(valid)
        angle, ahead, width = np.moveaxis(about[point, view, turn, depth], -1, 0)
        held = friction[valid]
        outcome = np.where(held <= HOLDS_AT_FRICTION + _ROUNDING, SUCCESS, FAILURE).astype(np.uint8)
        if collides is not None:
            outcome[collides[valid]] = COLLISION
        yield Raw(
            first,
            part[point],
            rotation=rotations(approach[view], angle),
            outcome=outcome,
            qualities={"friction": held, "width": width, "depth": ahead},
            ahead_m=ahead,
        )
        first += len(held)
    report.drop(f"{dropped:,} candidates that nothing holds (score -1)")
    report.map(
        f"collision to outcome collision; else success where friction is at most {HOLDS_AT_FRICTION:g}, as"
        " GraspNet's own loader has it, else failure"
    )


class _Member:
    """An array of an archive, read from its beginning on; ``shape`` is of one entry."""

    def __init__(self, file: str, archive: zipfile.ZipFile, what: str, shape: tuple[int, ...]) -> None:
        self._file, self.what = file, what
        self._stream: BinaryIO = archive.open(f"{what}.npy")  # type: ignore[assignment]
        self._dtype, whole = _header(file, what, self._stream)
        if not whole or whole[1:] != shape:
            expected = " x ".join(["N", *map(str, shape)])
            raise problem(file, f"{what} must be {expected}, not {whole}")
        self.count, self._shape = whole[0], shape
        if self.entry_bytes * max(1, CHUNK // max(1, int(np.prod(shape)))) > 512 * MIB:
            raise problem(file, f"{what} is too large")

    @property
    def entry_bytes(self) -> int:
        return int(np.prod(self._shape)) * self._dtype.itemsize

    def take(self, entries: int | None) -> NDArray[Any]:
        """The next entries; None: all."""
        entries = self.count if entries is None else entries
        if entries * self.entry_bytes > 1024 * MIB:
            raise problem(self._file, f"{self.what} is too large")
        content = self._stream.read(entries * self.entry_bytes)
        if len(content) != entries * self.entry_bytes:
            raise problem(self._file, f"{self.what} ends too early")
        return np.frombuffer(content, self._dtype).reshape(entries, *self._shape)


def _header(file: str, what: str, stream: BinaryIO) -> tuple[np.dtype[Any], tuple[int, ...]]:
    """The type and shape that an array's header tells; its text is a literal and nothing is run."""
    start = stream.read(8)
    if start[:6] != b"\x93NUMPY":
        raise problem(file, f"{what} is no array")
    size = int.from_bytes(stream.read(2 if start[6] == 1 else 4), "little")
    if size > _LONGEST_HEADER:
        raise problem(file, f"{what} has too long a header")
    try:
        told = ast.literal_eval(stream.read(size).decode("latin1"))
        dtype, shape, turned = np.dtype(told["descr"]), tuple(map(int, told["shape"])), told["fortran_order"]
    except (ValueError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError):
        raise problem(file, f"{what} has a header that can't be read") from None
    if dtype.hasobject:
        raise problem(file, _PICKLED)
    if dtype.kind not in "fiub" or turned or any(n < 0 for n in shape):
        raise problem(file, f"{what} must be numbers in rows")
    return dtype, shape


def _other_archive(archive: zipfile.ZipFile, names: set[str]) -> str:
    if {"pred_grasps_cam", "scores"} & names:
        return (
            "looks like contact_graspnet's, a dictionary of arrays pickled for each segment, which is never"
            " read: save the matrices of one object (camera's frame, z approach, x closing, 0.1034 m behind"
            " the contact) as a table and import that"
        )
    known = ", ".join(sorted(names)[:8])
    return f"has the arrays {known}; GraspNet's labels are points, offsets, collision, scores"


def _pickled(source: SourceFile) -> str:
    if b"qpos" in source.head:
        return "looks like DexGraspNet's: a hand of many joints, and GraspDB knows parallel jaws"
    return _PICKLED


def views(count: int) -> Floats:
    """Unit vectors (count, 3) from a Fibonacci lattice, by which labels number the directions of view."""
    index = np.arange(count, dtype=np.float64)
    z = (2.0 * index + 1.0) / count - 1.0
    angle = 2.0 * np.pi * index * (np.sqrt(5.0) - 1.0) / 2.0
    across = np.sqrt(1.0 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def rotations(approach: Floats, angle: Floats) -> Floats:
    """Rotations (N, 3, 3) whose x is the approach (N, 3), y level before a turn by ``angle`` (N,) about x."""
    level = np.stack([-approach[:, 1], approach[:, 0], np.zeros(len(approach))], axis=1)
    upright = np.linalg.norm(level, axis=1) == 0
    level[upright] = [0.0, 1.0, 0.0]
    x = approach / np.linalg.norm(approach, axis=1, keepdims=True)
    y = level / np.linalg.norm(level, axis=1, keepdims=True)
    z = np.cross(x, y)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.stack([x, cos * y + sin * z, cos * z - sin * y], axis=2)


def _some(values: set[float]) -> str:
    return ", ".join(f"{value:g}" for value in sorted(values)[:8])


def _float(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise problem(name, f"--only object_id={text}: expected a number") from None

"""A file that is read with no trust in it: bounded, never unpickled, without entities and links."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar
from xml.etree.ElementTree import Element

import numpy as np

from graspdb.interop.grasps import Floats, problem
from graspdb.interop.parsing.elements import elements, root_tag
from graspdb.interop.parsing.events import json_events, yaml_events
from graspdb.interop.parsing.reader import Column, Reader

MIB = 2**20
CHUNK = 65_536
"""Grasps that are read at a time."""

#: What a folder with a bag of ROS 2 has, and the files that lie beside it.
_BAG, _IN_BAGS = "metadata.yaml", (".db3", ".mcap")
BOM = b"\xef\xbb\xbf"
#: How compressed files begin.
_COMPRESSED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ": "xz", b"\x28\xb5\x2f\xfd": "zstd"}
T = TypeVar("T")


@dataclass(frozen=True)
class Wishes:
    """What somebody says of a file that its format leaves open; see :func:`graspdb.interop.read`."""

    quaternion_order: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    only: Mapping[str, str] = field(default_factory=dict)
    qualities: tuple[str, ...] = ()
    drop_unusable: bool = False
    stated: Mapping[str, str] = field(default_factory=dict)
    said: tuple[str, ...] = ()


class SourceFile:
    """A file, and what was parsed of it, kept while it is looked at and sent."""

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        self.name = str(path)
        folder = self.path if self.path.is_dir() else self.path.parent
        #: The bag that the file is, or is a part of; None where it is none.
        self.bag: Path | None = None
        if self.path.suffix.lower() == ".bag":
            self.bag = self.path
        elif (folder == self.path or self.path.suffix.lower() in _IN_BAGS) and (folder / _BAG).is_file():
            self.bag, self.path = folder, folder / _BAG
        if not self.path.is_file():
            raise FileNotFoundError(f"{self.name}: {'is no file' if self.path.exists() else 'no such file'}")
        with self.path.open("rb") as file:
            self.head = file.read(65_536)
        if not self.head:
            raise problem(self.name, "is empty")
        for start, kind in _COMPRESSED.items():
            if self.head.startswith(start):
                raise problem(self.name, f"is compressed ({kind}): unpack it first")
        self._mapping: dict[str, Any] | None = None

    @property
    def suffix(self) -> str:
        """How its name ends, in lower case."""
        return self.path.suffix.lower()

    @property
    def is_json(self) -> bool:
        """Whether it is JSON rather than YAML: by its name, else by its beginning."""
        if self.suffix in (".yaml", ".yml"):
            return False
        return self.suffix == ".json" or self.head.removeprefix(BOM).lstrip()[:1] in (b"{", b"[")

    def reader(self) -> Reader:
        """Its JSON or YAML from the beginning."""
        events = json_events if self.is_json else yaml_events
        return Reader(self.name, events(self.name, self.path))

    def judged(self, judge: Callable[[Any], T | None]) -> T | None:
        """What ``judge`` says of the outline of its JSON or YAML, as soon as that is anything but None."""
        for outline in self.reader().outlines():
            found = judge(outline)
            if found is not None:
                return found
        return None

    def mapping(self, is_column: Callable[[tuple[str, ...]], bool]) -> dict[str, Any]:
        """Its JSON, a mapping: lists that ``is_column`` names by their path are columns; it is kept."""
        if self._mapping is None:
            self._mapping = self.reader().mapping(is_column)
        return self._mapping

    def entries(self, under: Sequence[str] = ()) -> Iterator[tuple[str, Any, Any]]:
        """Entries of its JSON or YAML, one at a time: see :meth:`Reader.entries`."""
        return self.reader().entries(under)

    def grasps(self, under: Sequence[str]) -> Iterator[Any]:
        """What its JSON or YAML lists, itself or under one of these keys; else each document is one."""
        alone: dict[Any, Any] | None = {}
        for kind, key, value in self.entries(under):
            if kind == "entry":
                yield value
            elif kind == "under":
                alone = None
            elif kind == "head" and alone is not None:
                alone[key] = value
            elif kind == "end":
                if alone:
                    yield alone
                alone = {}

    @functools.cached_property
    def root_tag(self) -> str:
        """The name of the outermost element of its XML."""
        return root_tag(self.name, self.path)

    def elements(self, kept: Collection[str], within: str = "") -> Iterator[tuple[int, Element]]:
        """Elements of its XML, one at a time: see :func:`graspdb.interop.parsing.elements.elements`."""
        return elements(self.name, self.path, kept, within)


def numbers(file: str, what: str, values: Any, shape: tuple[int | None, ...]) -> Floats:
    """Numbers of this shape (None: any length), else one line that names them."""
    wanted = " x ".join("N" if n is None else str(n) for n in shape) or "1"
    try:
        # Text and truth values are no numbers, whatever NumPy makes of them.
        array = np.asarray(values)
        if array.dtype.kind not in "fiu" and array.size:
            raise TypeError
        array = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise problem(file, f"{what} must be numbers of shape {wanted}") from None
    if array.size == 0 and array.ndim >= 1 and shape and shape[0] is None:
        return np.zeros((0, *(n or 0 for n in shape[1:])))
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits:
        raise problem(file, f"{what} must be numbers of shape {wanted}; these have {array.shape}")
    return array


def column_of(
    file: str, what: str, value: Any, shape: tuple[int, ...] = (), *, truths: bool = False
) -> Column:
    """A column of numbers, or of numbers of this shape, with ``truths`` true and false among them; else one
    line that names it.
    """
    wanted = " x ".join(["N", *map(str, shape)])
    if not isinstance(value, Column):
        raise problem(file, f"has no list of {what}" if value is None else f"{what} must be a list")
    numbers_alone = value.regular and not value.gaps and (truths or not value.truths)
    if not numbers_alone or (value.count and value.shape != shape):
        told = f"; these have {(value.count, *value.shape)}" if numbers_alone else ""
        raise problem(file, f"{what} must be numbers of shape {wanted}{told}")
    return value


def split_matrices(
    file: str, transforms: Floats, first: int = 0, *, drop: bool = False
) -> tuple[Floats, Floats]:
    """Positions (N, 3) and rotations (N, 3, 3) of homogeneous matrices, whose last rows are checked; with
    ``drop`` NaN where they are wrong.
    """
    off = np.abs(transforms[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1, initial=0.0)
    wrong = np.flatnonzero(~(off <= 1e-6))
    if wrong.size and drop:
        transforms = np.where((off <= 1e-6)[:, None, None], transforms, np.nan)
    elif wrong.size:
        row = int(wrong[0])
        turned = np.allclose(transforms[row, :3, 3], 0.0) and np.any(transforms[row, 3, :3])
        hint = ": it looks transposed" if turned else ""
        raise problem(file, f"grasp {first + row}: the last row of its matrix must be 0, 0, 0, 1{hint}")
    return transforms[:, :3, 3], transforms[:, :3, :3]


def same_length(file: str, count: int, columns: Mapping[str, Any]) -> None:
    """Refuse columns of another length than there are grasps."""
    for name, values in columns.items():
        if len(values) != count:
            raise problem(file, f"{name} has {len(values)} entries for {count} grasps")


def mapping_of(file: str, value: Any, what: str) -> dict[str, Any]:
    """A mapping, else one line that names it."""
    if not isinstance(value, dict):
        raise problem(file, f"{what} must be a mapping, not {type(value).__name__}")
    return value

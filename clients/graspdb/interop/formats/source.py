"""A file that is read with no trust in it: bounded, never unpickled, without entities and links."""

from __future__ import annotations

import functools
import importlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

from graspdb.interop.grasps import Floats, problem

MIB = 2**20
CHUNK = 65_536
"""Grasps that are read at a time."""

#: What is parsed as a whole takes many times its size in memory.
_LARGEST = {"JSON": 512 * MIB, "YAML": 128 * MIB, "XML": 256 * MIB}
_DEEPEST = 100
#: What a folder with a bag of ROS 2 has, and the files that lie beside it.
_BAG, _IN_BAGS = "metadata.yaml", (".db3", ".mcap")
_MOST_YAML_NODES = 50_000_000
_EXTRA = "pip install 'graspdb[interop]'"


def extra(module: str, what: str) -> Any:
    """A package of the extra ``interop``; ImportError that says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{what} needs {module.split('.')[0]}: {_EXTRA}") from error


@dataclass(frozen=True)
class Wishes:
    """What somebody says of a file that its format leaves open; see :func:`graspdb.interop.read`."""

    quaternion_order: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    only: Mapping[str, str] = field(default_factory=dict)
    qualities: tuple[str, ...] = ()


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

    @property
    def suffix(self) -> str:
        """How its name ends, in lower case."""
        return self.path.suffix.lower()

    @functools.cached_property
    def text(self) -> str:
        """All of it as text."""
        try:
            return self.path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise problem(self.name, f"is not UTF-8 ({error.reason} at byte {error.start})") from None

    @functools.cached_property
    def json(self) -> Any:
        """What its JSON says."""
        self._bounded("JSON")

        def refuse(constant: str) -> Any:
            raise problem(self.name, f"{constant} is no JSON number")

        try:
            return json.loads(self.text, parse_constant=refuse)
        except RecursionError:
            raise problem(self.name, "its JSON nests too deeply") from None
        except json.JSONDecodeError as error:
            raise problem(self.name, f"is no JSON: {error}") from None
        finally:
            vars(self).pop("text", None)

    @functools.cached_property
    def yaml(self) -> list[Any]:
        """The documents of its YAML, plain data only."""
        self._bounded("YAML")
        yaml = extra("yaml", "YAML")
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        try:
            self._check_yaml(yaml, loader)
            return list(yaml.load_all(self.text, Loader=loader))
        except yaml.YAMLError as error:
            raise problem(self.name, f"is no YAML of plain data: {error}") from None
        except (ValueError, RecursionError, TypeError, OverflowError) as error:
            raise error if str(error).startswith(self.name) else problem(self.name, f"{error}") from None
        finally:
            vars(self).pop("text", None)

    def _check_yaml(self, yaml: Any, loader: Any) -> None:
        """Refuse what nests deeply, or what aliases would blow up to more than any file holds."""
        sizes: dict[str, int] = {}
        open_nodes: list[tuple[str | None, int]] = []
        total = 0
        for event in yaml.parse(self.text, Loader=loader):
            size = 0
            if isinstance(event, yaml.AliasEvent):
                size = sizes.get(event.anchor, 1)
            elif isinstance(event, yaml.ScalarEvent):
                size = 1
                if event.anchor:
                    sizes[event.anchor] = 1
            elif isinstance(event, (yaml.SequenceStartEvent, yaml.MappingStartEvent)):
                open_nodes.append((event.anchor, total))
                size = 1
                if len(open_nodes) > _DEEPEST:
                    raise problem(self.name, "its YAML nests too deeply")
            elif isinstance(event, (yaml.SequenceEndEvent, yaml.MappingEndEvent)):
                anchor, before = open_nodes.pop()
                if anchor:
                    sizes[anchor] = total - before
            total += size
            if total > _MOST_YAML_NODES:
                raise problem(self.name, "its YAML's aliases stand for more than a file of grasps can hold")

    @functools.cached_property
    def xml(self) -> Element:
        """The root of its XML; declarations of types and entities are refused."""
        self._bounded("XML")
        builder, depth = TreeBuilder(), 0
        parser = expat.ParserCreate(namespace_separator="}")

        def start(tag: str, attributes: dict[str, str]) -> None:
            nonlocal depth
            depth += 1
            if depth > _DEEPEST:
                raise problem(self.name, "its XML nests too deeply")
            builder.start(local_name(tag), attributes)

        def end(tag: str) -> None:
            nonlocal depth
            depth -= 1
            builder.end(local_name(tag))

        def refuse(*_: Any) -> Any:
            raise problem(self.name, "its XML declares types or entities, which are not read")

        parser.StartElementHandler, parser.EndElementHandler = start, end
        parser.CharacterDataHandler = builder.data
        parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
        parser.ExternalEntityRefHandler = refuse
        try:
            with self.path.open("rb") as file:
                parser.ParseFile(file)
        except expat.ExpatError as error:
            raise problem(self.name, f"is no whole XML: {error}") from None
        return builder.close()

    def _bounded(self, kind: str) -> None:
        size = self.path.stat().st_size
        if size > _LARGEST[kind]:
            raise problem(
                self.name,
                f"has {size / MIB:,.0f} MiB; {kind} is read up to {_LARGEST[kind] // MIB} MiB: split it, or"
                " save it as Parquet or JSON Lines",
            )


def local_name(tag: str) -> str:
    """A name of XML without its name space."""
    return tag.rpartition("}")[2]


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


def split_matrices(file: str, transforms: Floats, first: int = 0) -> tuple[Floats, Floats]:
    """Positions (N, 3) and rotations (N, 3, 3) of homogeneous matrices, whose last rows are checked."""
    off = np.abs(transforms[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1, initial=0.0)
    wrong = np.flatnonzero(~(off <= 1e-6))
    if wrong.size:
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

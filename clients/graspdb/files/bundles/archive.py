"""A bundle's file: a zip whose members are named and measured by its manifest, read without trusting it.

Members are written and read piece by piece, and none is ever extracted: names in the file lead nowhere.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from graspdb import wire

FORMAT = "graspdb-bundle"
VERSION = 1
#: What of a file is held in memory at once: a line, a mesh, the manifest.
MOST_LINE_BYTES = 8 * 2**20
MOST_MESH_BYTES = 256 * 2**20
MOST_MANIFEST_BYTES = 16 * 2**20
#: Text of numbers packs to a tenth or so, a bomb to a thousandth.
MOST_TIMES_LARGER = 500
_MANIFEST = "manifest.json"
_NAME = re.compile(r"(objects/[0-9]{1,6}/(mesh|convex-parts|batches|trials)|kernels)")
_OF_LINES = ("batches", "trials", "kernels")
_PIECE = 2**20


class BundleProblem(ValueError):
    """A file that is no bundle, is damaged or can't be taken in: the message says why."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


class Member(_Part):
    """A member of the file, as it is unpacked."""

    bytes: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    lines: int = Field(default=0, ge=0)


class MeshMember(_Part):
    """How an object's mesh is read."""

    media_type: str
    unit: str = "m"
    scale: float = 1.0


class BundledObject(_Part):
    """An object of a bundle; its members are those of its place in the manifest's list."""

    id: str
    properties: wire.ObjectCreate
    mesh: MeshMember | None = None
    convex_parts: bool = False
    batches: int = 0
    trials: int = 0
    withdrawn: int = 0
    #: Outcomes of its sweeps that are no trials, and stay behind.
    packed: int = 0


class BundledGripper(_Part):
    """One version of a gripper."""

    name: str | None = None
    profile: wire.GripperProfile


class BundledBatch(_Part):
    """What stood once for the trials of a batch."""

    licence: str | None = None
    citation: str | None = None
    origin: wire.Origin | None = None
    metadata: dict[str, Any] | None = None
    qualities: list[str] = Field(default_factory=list)


class Manifest(_Part):
    """What a bundle holds."""

    format: Literal["graspdb-bundle"] = "graspdb-bundle"
    version: int = VERSION
    made_by: str = ""
    objects: list[BundledObject] = Field(default_factory=list)
    #: By name and version, as in ``panda@1``: every version that trials or kernels name.
    grippers: dict[wire.GripperRef, BundledGripper] = Field(default_factory=dict)
    kernels: int = 0
    licences: list[str] = Field(default_factory=list)
    members: dict[str, Member] = Field(default_factory=dict)


def member_of(place: int, what: Literal["mesh", "convex-parts", "batches", "trials"]) -> str:
    """The name of an object's member."""
    return f"objects/{place}/{what}"


class BundleWriter:
    """Members one after the other, and the manifest last."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        self._members: dict[str, Member] = {}

    @contextmanager
    def lines(self, name: str) -> Iterator[LineSink]:
        """A member of one JSON document a line."""
        with self._archive.open(_packed(name), "w", force_zip64=True) as file:
            sink = LineSink(file)
            yield sink
        self._members[name] = sink.member()

    def content(self, name: str, content: bytes) -> None:
        """A member of these bytes."""
        with self._archive.open(_packed(name), "w", force_zip64=True) as file:
            sink = LineSink(file)
            sink.bytes(content)
        self._members[name] = sink.member()

    def manifest(self, manifest: Manifest) -> Manifest:
        """Close with what the bundle holds."""
        manifest = manifest.model_copy(update={"members": self._members})
        self._archive.writestr(_packed(_MANIFEST), manifest.model_dump_json(indent=1))
        return manifest


def _packed(name: str) -> zipfile.ZipInfo:
    """A member without the time of its making: the same content makes the same file."""
    info = zipfile.ZipInfo(name)
    info.compress_type = zipfile.ZIP_DEFLATED
    return info


class LineSink:
    """A member being written, measured as it goes."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._digest = hashlib.sha256()
        self._bytes = self._lines = 0

    def line(self, value: Any) -> None:
        """One JSON document."""
        text = value.model_dump_json(exclude_none=True) if isinstance(value, BaseModel) else _text(value)
        self.bytes(text.encode() + b"\n")
        self._lines += 1

    def bytes(self, content: bytes) -> None:
        self._file.write(content)
        self._digest.update(content)
        self._bytes += len(content)

    def member(self) -> Member:
        return Member(bytes=self._bytes, sha256=self._digest.hexdigest(), lines=self._lines)


def _text(value: Any) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))


@contextmanager
def writing(path: Path) -> Iterator[BundleWriter]:
    """A new bundle at this path, which has it once it is whole."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with zipfile.ZipFile(partial, "w") as archive:
            yield BundleWriter(archive)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


class BundleReader:
    """A bundle that was checked: every member is there, of the size and SHA-256 in the manifest."""

    def __init__(self, path: Path, archive: zipfile.ZipFile) -> None:
        self._path, self._archive = path, archive
        self._check_names()
        self.manifest = self._manifest()
        self._check_members()

    def content(self, name: str) -> bytes:
        """A member that is held whole: a mesh, or parts."""
        if self.manifest.members[name].bytes > MOST_MESH_BYTES:
            raise self.problem(f"{name} has more than {MOST_MESH_BYTES:,} bytes")
        return b"".join(self._pieces(name))

    def lines(self, name: str) -> Iterator[Any]:
        """The documents of a member, one after the other."""
        if name not in self.manifest.members:
            return
        with self._reading(), self._archive.open(name) as file:
            number = 0
            while line := file.readline(MOST_LINE_BYTES + 1):
                number += 1
                if len(line) > MOST_LINE_BYTES:
                    raise self.problem(f"line {number} of {name} has more than {MOST_LINE_BYTES:,} bytes")
                try:
                    yield json.loads(line)
                except (ValueError, RecursionError) as error:
                    raise self.problem(f"line {number} of {name} is no JSON ({error})") from None

    def _check_names(self) -> None:
        names = self._archive.namelist()
        if _MANIFEST not in names:
            raise self.problem(f"it has no {_MANIFEST}: was it made by graspdb bundle?")
        strange = [name for name in names if name != _MANIFEST and not _NAME.fullmatch(name)]
        if strange or len(set(names)) != len(names):
            raise self.problem(f"it holds what no bundle does ({(strange or ['a name twice'])[0][:80]!r})")
        total = sum(info.file_size for info in self._archive.infolist())
        if total > MOST_TIMES_LARGER * self._path.stat().st_size + 2**20:
            raise self.problem(
                f"unpacked it would be over {MOST_TIMES_LARGER} times as large as it is, which no bundle is"
            )

    def _manifest(self) -> Manifest:
        info = self._archive.getinfo(_MANIFEST)
        if info.file_size > MOST_MANIFEST_BYTES:
            raise self.problem(f"{_MANIFEST} has more than {MOST_MANIFEST_BYTES:,} bytes")
        try:
            told = json.loads(b"".join(self._pieces(_MANIFEST)))
            if isinstance(told, dict) and told.get("format") == FORMAT and told.get("version") != VERSION:
                raise self.problem(
                    f"it is of version {told.get('version')!r}, and this graspdb reads version {VERSION}:"
                    " use the one that made it, or a newer one"
                )
            return Manifest.model_validate(told)
        except ValidationError as error:
            first = error.errors(include_input=False, include_url=False)[0]
            where = ".".join(map(str, first["loc"]))
            raise self.problem(f"{_MANIFEST} does not say what it holds ({where}: {first['msg']})") from None
        except (ValueError, RecursionError) as error:
            if isinstance(error, BundleProblem):
                raise
            raise self.problem(f"{_MANIFEST} is no JSON ({error})") from None

    def _check_members(self) -> None:
        members = self.manifest.members
        there = set(self._archive.namelist()) - {_MANIFEST}
        wanted = {"kernels"} if self.manifest.kernels else set()
        for place, item in enumerate(self.manifest.objects):
            wanted |= {member_of(place, "batches"), member_of(place, "trials")}
            wanted |= {member_of(place, "mesh")} if item.mesh else set()
            wanted |= {member_of(place, "convex-parts")} if item.convex_parts else set()
        for name in sorted(wanted | there | members.keys()):
            if name not in there or name not in members or name not in wanted:
                raise self.problem(f"its manifest and its members disagree about {name}")
        for name, member in members.items():
            if self._archive.getinfo(name).file_size != member.bytes:
                raise self.problem(f"{name} is not as large as the manifest says")
            digest, lines = hashlib.sha256(), 0
            for piece in self._pieces(name):
                digest.update(piece)
                lines += piece.count(b"\n")
            if digest.hexdigest() != member.sha256:
                raise self.problem(f"{name} is not what it was when the bundle was made (SHA-256)")
            if name.endswith(_OF_LINES) and lines != member.lines:
                raise self.problem(f"{name} has {lines:,} lines, and the manifest says {member.lines:,}")
        for place, item in enumerate(self.manifest.objects):
            for what, count in (("trials", item.trials), ("batches", item.batches)):
                if members[f"objects/{place}/{what}"].lines != count:
                    raise self.problem(f"{_MANIFEST} says that {item.id} has another number of {what}")
        kernels = members["kernels"].lines if "kernels" in members else 0
        if kernels != self.manifest.kernels:
            raise self.problem(f"{_MANIFEST} tells another number of kernels")

    def _pieces(self, name: str) -> Iterator[bytes]:
        with self._reading(), self._archive.open(name) as file:
            while piece := file.read(_PIECE):
                yield piece

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        # RuntimeError: encrypted; NotImplementedError, which is one, packed in another way.
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError) as error:
            raise self.problem(f"it is damaged, or was not transferred whole ({error})") from None

    def problem(self, told: str) -> BundleProblem:
        """What is wrong with the bundle, in words."""
        return BundleProblem(f"{self._path} can't be taken in: {told}")


@contextmanager
def reading(path: Path) -> Iterator[BundleReader]:
    """A bundle, checked whole before anything of it is used; BundleProblem says what is wrong with it."""
    try:
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, EOFError, ValueError) as error:
        raise BundleProblem(f"{path} is no bundle, or was not transferred whole ({error})") from None
    with archive:
        yield BundleReader(path, archive)

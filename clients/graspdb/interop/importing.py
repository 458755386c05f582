"""An import: files looked at as a whole before the first trial is sent, then sent by pieces."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from typing_extensions import Unpack

from graspdb.errors import GraspDBError, add_note
from graspdb.interop.first_look import FirstLook, first_look, gathered, target_of
from graspdb.interop.grasps import FileGrasps, Report, joined, problem, together
from graspdb.interop.reading import Reading, ReadOptions, opened
from graspdb.poses import matrices
from graspdb.resources.objects import GraspObject
from graspdb.resources.trials import CHUNK_TRIALS, Receipt, Sending
from graspdb.wire import GripperInfo

T = TypeVar("T")
_LOOKED_AT = 2_000
_SAME_AGAIN = "To go on, run the same import again: what is stored already is not stored twice."
#: What a refused key means of the key that an import has by itself.
_NOT_THE_SAME = {
    "idempotency-key-reused": (
        "These files were imported before, read alike, about this object and gripper, but told otherwise:"
        " another name, source, protocol, licence, citation or chunk, or by another version. Repeat it as it"
        " was told then and nothing is stored twice, or store all anew with ?again=true (on the command line"
        " --again)."
    ),
    "idempotency-key-revoked": (
        "These files were imported before, and a batch of it was deleted: store all anew with ?again=true"
        " (on the command line --again)."
    ),
}


class Import:
    """Files of one format about one object and one gripper, read and looked at; :meth:`send` stores them.

    ``report`` says what was recognised, assumed, mapped and dropped, ``look`` whether they can be grasps of
    the object. FileProblem where a file, anywhere in it, can't be read: nothing is sent then.
    """

    def __init__(
        self,
        item: GraspObject,
        gripper: GripperInfo,
        files: Sequence[str | PathLike[str]],
        **options: Unpack[ReadOptions],
    ) -> None:
        if not files:
            raise ValueError("give at least one file")
        self._item, self._gripper, self._options = item, gripper, options
        self._readings = [opened(file, gripper, _frames_of(item), **options) for file in files]
        reports = [_read_through(reading, gripper.id) for reading in self._readings]
        self.report = together(reports)
        if not self.report.grasps:
            raise problem(self.report.file, "no grasp of it is left")
        self.look = self._looked_at(reports[0])

    def _looked_at(self, report: Report) -> FirstLook:
        most = max(1, _LOOKED_AT // len(self._readings))
        firsts = [_first(reading) for reading in self._readings[:_LOOKED_AT]]
        raw = gathered(firsts, max(_LOOKED_AT, most))
        triangles = None if self._item.info.mesh is None else self._item.mesh_triangles()
        target = target_of(self._item.info, self._gripper.profile, triangles)
        return first_look(raw, self._readings[0].placing_by(report), target, report)

    def send(
        self,
        *,
        source: str | None = "import",
        protocol: str | None = None,
        licence: str | None = None,
        citation: str | None = None,
        again: bool = False,
        **upload: Unpack[Sending],
    ) -> Receipt:
        """Store all of it, in batches of ``chunk`` trials; ``source``, ``protocol``, ``licence`` and
        ``citation`` are of all of them.

        The same import once more, of the same files, read alike, about the same object and gripper, stores
        nothing twice, and so goes on where it broke off; what it is of (``source`` and the others) and
        ``chunk`` must be the same then (InvalidInput). ``again`` stores all of it anew.
        """
        chunk = upload.pop("chunk", CHUNK_TRIALS)
        if chunk < 1:
            raise ValueError("chunk must be at least 1")
        given = upload.pop("idempotency_key", None)
        if given is not None and again:
            raise ValueError("again stores all anew, idempotency_key nothing twice: give one of them")
        own = given is None and not again
        upload["idempotency_key"] = self._key() if own else given or str(uuid.uuid4())
        about = {"source": source, "protocol": protocol, "gripper": self._gripper_name()}
        about = {name: value for name, value in about.items() if value is not None}
        try:
            return self._item.trials.add_columns(
                _ahead(_columns(part) for part in self._pieces(chunk)),
                self.report.grasps,
                **about,
                licence=licence,
                citation=citation,
                origin=_origin(self._readings),
                known_revision=self._item.refresh().info.revision,
                way_on=_SAME_AGAIN if own else None,
                **upload,
            )
        except GraspDBError as error:
            kind = "" if error.problem is None else error.problem.type.rpartition(":")[2]
            if own and kind in _NOT_THE_SAME:
                add_note(error, _NOT_THE_SAME[kind])
            raise

    def _key(self) -> str:
        """What the same import has again: its files, how they are read, and about what."""
        told = {
            "files": [[_digest(path) for path in _parts(reading)] for reading in self._readings],
            "format": [reading.kind.name for reading in self._readings],
            "object": [self._item.info.id, self._item.info.created_at.isoformat()],
            "gripper": f"{self._gripper.id}@{self._gripper.version}",
            "frame": [[reading.placing.frame, reading.placing.convention] for reading in self._readings],
            "options": {
                name: value
                for name, value in self._options.items()
                if value is not None and name not in ("format", "frame", "convention")
            },
        }
        text = json.dumps(told, sort_keys=True, default=lambda value: np.asarray(value).tolist())
        return f"import-{hashlib.sha256(text.encode()).hexdigest()[:40]}"

    def _gripper_name(self) -> str:
        known = self._gripper
        return known.id if known.version == known.newest_version else f"{known.id}@{known.version}"

    def _pieces(self, size: int) -> Iterator[FileGrasps]:
        """The grasps of all files, so many at a time, the last ones fewer."""
        waiting: list[FileGrasps] = []
        count = 0
        for reading in self._readings:
            for found in reading.chunks(reading.new_report()):
                waiting.append(found)
                count += len(found)
                while count >= size:
                    whole = joined(waiting)
                    yield whole.part(slice(0, size))
                    waiting, count = [whole.part(slice(size, None))], count - size
        if count:
            yield joined(waiting)


def _frames_of(item: GraspObject) -> dict[str, Any]:
    """Poses (4, 4) of the object's frames in its own, by name; its own has its id."""
    frames = {
        name: np.asarray(matrices(pose.position, pose.quaternion_xyzw))
        for name, pose in item.info.frames.items()
    }
    return {item.info.id: np.eye(4), **frames}


def _read_through(reading: Reading, gripper: str) -> Report:
    """The report of a whole file: what can't be read is found before anything is sent."""
    report, named = reading.new_report(), set[str]()
    for found in reading.chunks(report):
        named |= {name for name in found.more.get("gripper", ()) if name}
    others = sorted(name for name in named if name.partition("@")[0] != gripper)
    if others:
        report.assume(
            f"grasps of {', '.join(others[:8])} where the column gripper says so; frames and the first look"
            f" take them for those of {gripper}"
        )
    return report


def _first(reading: Reading) -> Any:
    return next(raw for raw in reading.raws(reading.new_report()) if len(raw))


def _ahead(items: Iterator[T]) -> Iterator[T]:
    """The same items, each made while the one before it is sent."""
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = pool.submit(next, items, None)
            yield item


def _columns(grasps: FileGrasps) -> dict[str, Any]:
    """A piece as columns of the HTTP interface."""
    columns: dict[str, Any] = {
        "position": grasps.position,
        "quaternion_xyzw": grasps.quaternion_xyzw,
        "outcome": grasps.outcomes,
    }
    columns |= {name: values for name, values in grasps.more.items() if any(x is not None for x in values)}
    known = {name: values for name, values in grasps.qualities.items() if not np.isnan(values).all()}
    # "quality" has a column of its own.
    if "quality" in known:
        columns["quality"] = known.pop("quality")
    return columns | ({"qualities": known} if known else {})


def _origin(readings: Sequence[Reading]) -> dict[str, str]:
    """What a batch was read from; of several files the first one's name."""
    first = readings[0].source
    name = Path(first.name).name
    if len(readings) > 1:
        told = f" and {len(readings) - 1:,} more"
        return {"file": name[: 255 - len(told)] + told, "format": readings[0].kind.name}
    origin = {"file": name[-255:], "format": readings[0].kind.name}
    # Of a bag that is a folder no one file is all of it.
    return origin if first.bag not in (None, first.path) else origin | {"sha256": _digest(first.path)}


def _parts(reading: Reading) -> list[Path]:
    """The files that a file is: of a bag that is a folder all in it."""
    source = reading.source
    if source.bag is None or not source.bag.is_dir():
        return [source.path]
    return sorted(path for path in source.bag.rglob("*") if path.is_file())


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()

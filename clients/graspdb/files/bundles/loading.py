"""Taking a bundle in: all of it, or nothing as far as what was stored can be deleted again."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

from graspdb import wire
from graspdb.client import Client
from graspdb.errors import GraspDBError, NotFound, add_note
from graspdb.files.bundles import archive
from graspdb.files.bundles.archive import (
    BundledBatch,
    BundledGripper,
    BundledObject,
    BundleProblem,
    BundleReader,
    member_of,
)
from graspdb.files.bundles.saving import Progress, silent
from graspdb.resources.objects import GraspObject
from graspdb.resources.trials import CHUNK_TRIALS, DoubtfulTrials

_REASON = "withdrawn where the bundle was made"


@dataclass
class Loaded:
    """What a bundle became: objects, grippers and kernels by what they were called in it."""

    objects: dict[str, str] = field(default_factory=dict)
    grippers: dict[str, str] = field(default_factory=dict)
    kernels: dict[str, str] = field(default_factory=dict)
    trials: int = 0
    batches: int = 0


def load(
    db: Client,
    path: Path,
    *,
    renamed: Mapping[str, str] | None = None,
    new_gripper_versions: bool = False,
    progress: Progress = silent,
) -> Loaded:
    """Take a bundle in; ``renamed`` gives objects other ids than theirs.

    It is checked whole before anything is stored, and what was stored goes again where the rest can't be. A
    gripper that is here under the same id with another profile stays as it is: BundleProblem, or with
    ``new_gripper_versions`` the bundle's profile becomes its newest version.
    """
    with archive.reading(path) as reader:
        names = _new_names(reader, renamed or {})
        taken = [new for new in names.values() if _is_taken(db, new)]
        if taken:
            raise BundleProblem(
                f"there is an object {taken[0]!r} already, perhaps from this bundle: take it in under another"
                " id (renamed; on the command line --as OLD=NEW), or delete the one that is there"
            )
        loading = _Loading(db, reader, names, progress)
        plan = _gripper_plan(db, reader.manifest.grippers, new_gripper_versions)
        try:
            loading.grippers(plan)
            for place, item in enumerate(reader.manifest.objects):
                loading.object(place, item)
            loading.kernels()
        except BaseException as error:
            left = loading.undo()
            if left:
                add_note(error, f"What was stored before could not all be deleted: {', '.join(left)} is left")
            raise
        return loading.made


def _new_names(reader: BundleReader, renamed: Mapping[str, str]) -> dict[str, str]:
    ids = [item.id for item in reader.manifest.objects]
    for old in renamed:
        if old not in ids:
            raise ValueError(f"the bundle has no object {old!r}: it has {', '.join(ids)}")
    names = {id: renamed.get(id, id) for id in ids}
    if len(set(names.values())) != len(ids):
        raise ValueError("two objects of a bundle can't have one id")
    return names


def _is_taken(db: Client, id: str) -> bool:
    try:
        db.objects.get(id)
    except NotFound:
        return False
    return True


@dataclass(frozen=True)
class _GripperStep:
    """A version of the bundle's, whether its gripper is here, and which version of that is the same."""

    name: str
    gripper: BundledGripper
    known: bool
    same: str | None


def _gripper_plan(db: Client, wanted: Mapping[str, BundledGripper], new_versions: bool) -> list[_GripperStep]:
    """What becomes of the bundle's grippers, the earlier versions first; BundleProblem before any is made."""
    steps = []

    def version(name: str) -> int:
        return int(name.partition("@")[2] or 0)

    for id, group in groupby(sorted(wanted, key=lambda n: (n.partition("@")[0], version(n))), _id):
        try:
            here = list(db.grippers.versions(id))
        except NotFound:
            here = []
        for name in group:
            mine = wanted[name]
            alike = [info for info in here if not mine.profile.differences(info.profile)]
            if here and not alike and not new_versions:
                differs = mine.profile.differences(here[-1].profile)
                raise BundleProblem(
                    f"the gripper {id!r} here differs from the bundle's in {', '.join(differs)}: make the"
                    " bundle's profile its newest version (new_gripper_versions; on the command line"
                    " --new-gripper-versions), or take the bundle in elsewhere"
                )
            same = f"{alike[-1].id}@{alike[-1].version}" if alike else None
            steps.append(_GripperStep(name, mine, bool(here), same))
    return steps


def _id(name: str) -> str:
    return name.partition("@")[0]


class _Loading:
    """A bundle on its way in, and what has been made of it so far."""

    def __init__(
        self, db: Client, reader: BundleReader, names: Mapping[str, str], progress: Progress
    ) -> None:
        self._db, self._reader, self._names, self._progress = db, reader, names, progress
        self._total = sum(item.trials for item in reader.manifest.objects)
        self._objects: list[GraspObject] = []
        self._new_grippers: list[str] = []
        self._versions: list[str] = []
        self.made = Loaded()

    def grippers(self, plan: list[_GripperStep]) -> None:
        for step in plan:
            found = step.same
            if found is None:
                fields = {
                    name: getattr(step.gripper.profile, name) for name in wire.GripperProfile.model_fields
                }
                id = _id(step.name)
                if not step.known and id not in self._new_grippers:
                    info = self._db.grippers.create(id, name=step.gripper.name, **fields)
                    self._new_grippers.append(id)
                else:
                    info = self._db.grippers.update(id, **fields)
                    if id not in self._new_grippers:
                        self._versions.append(f"{id}@{info.version}")
                found = f"{info.id}@{info.version}"
            self.made.grippers[step.name] = found

    def object(self, place: int, item: BundledObject) -> None:
        properties = item.properties.model_dump(exclude_unset=True, exclude_none=True)
        properties["id"] = self._names[item.id]
        mesh: dict[str, Any] = {}
        if item.mesh is not None:
            content = self._reader.content(member_of(place, "mesh"))
            mesh = {"mesh": content, **item.mesh.model_dump()}
        if item.convex_parts:
            mesh["convex_parts"] = self._reader.content(member_of(place, "convex-parts"))
            # As accepted as they were where they come from.
            mesh["accept_deviation"] = True
        made = self._db.objects.create(**properties, **mesh)
        self._objects.append(made)
        self.made.objects[item.id] = made.id
        heads = self._reader.lines(member_of(place, "batches"))
        number, batch = -1, BundledBatch()
        for wanted, records in self._runs(place):
            while number < wanted < item.batches:
                number, batch = number + 1, BundledBatch.model_validate(next(heads))
            if number != wanted:
                raise self._reader.problem("its trials are not in the order of its batches")
            self._post(made, batch, records)

    def _runs(self, place: int) -> Iterator[tuple[int, list[dict[str, Any]]]]:
        """Trials of one batch after the other, at most so many together."""
        lines = self._reader.lines(member_of(place, "trials"))
        for number, rows in groupby(lines, key=self._batch_of):
            run: list[dict[str, Any]] = []
            for row in rows:
                run.append(row)
                if len(run) == CHUNK_TRIALS:
                    yield number, run
                    run = []
            if run:
                yield number, run

    def _batch_of(self, row: Any) -> int:
        number = row.pop("batch", None) if isinstance(row, dict) else None
        if not isinstance(number, int):
            raise self._reader.problem("a trial of it names no batch")
        return number

    def _post(self, made: GraspObject, batch: BundledBatch, records: list[dict[str, Any]]) -> None:
        withdrawn = [place for place, row in enumerate(records) if row.pop("withdrawn", False)]
        for row in records:
            if "gripper" in row:
                row["gripper"] = self.made.grippers.get(row["gripper"], row["gripper"])
        if batch.qualities:
            # So that the batch has the names in their order.
            own = records[0].get("qualities", {})
            records[0]["qualities"] = {name: own.get(name) for name in batch.qualities}
        with warnings.catch_warnings():
            # Who stored them has been told.
            warnings.simplefilter("ignore", DoubtfulTrials)
            shared = batch.model_dump(mode="json", exclude={"qualities"})
            receipt = made.trials.add_records(records, accept_implausible=True, **shared)
        if withdrawn:
            # The trials of a request are numbered in their order.
            first = made.trials.list(batch=receipt.batch).first(1)[0].seq
            for place in withdrawn:
                made.trials.withdraw(first + place, reason=_REASON)
        self.made.trials += receipt.inserted
        self.made.batches += 1
        self._progress(self.made.trials, self._total)

    def kernels(self) -> None:
        for line in self._reader.lines("kernels"):
            kernel = wire.StoredKernel.model_validate(line)
            options: dict[str, Any] = {"kind": kernel.kind, "alignment": kernel.alignment}
            if kernel.gripper is not None:
                options["gripper"] = self.made.grippers.get(kernel.gripper, kernel.gripper)
            if kernel.kind == "sampled" and kernel.provenance.component_widths is not None:
                options["component_widths"] = kernel.provenance.component_widths
            made = self._db.kernels.create(kernel.components, **options)
            self.made.kernels[kernel.id] = made.id

    def undo(self) -> list[str]:
        """Delete what was made, the last first: what is left."""
        made: list[tuple[str, Callable[[], None]]] = []
        for id in self.made.kernels.values():
            made.append((f"kernel {id}", partial(self._db.kernels.delete, id)))
        for item in reversed(self._objects):
            made.append((f"object {item.id}", item.delete))
        for id in reversed(self._new_grippers):
            made.append((f"gripper {id}", partial(self._db.grippers.delete, id)))
        left = [f"gripper {name}" for name in self._versions]
        for what, delete in made:
            try:
                delete()
            except GraspDBError:
                left.append(what)
        return left

"""Saving objects as a bundle, streamed over the public API."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from graspdb import __version__, wire
from graspdb.client import Client
from graspdb.files.bundles import archive
from graspdb.files.bundles.archive import (
    BundledBatch,
    BundledGripper,
    BundledObject,
    BundleProblem,
    BundleWriter,
    Manifest,
    MeshMember,
    member_of,
)
from graspdb.resources.objects import GraspObject

Progress = Callable[[int, int], None]
"""Told the trials so far and their total."""


def silent(done: int, total: int) -> None:
    """Tells nobody."""


#: Fields of a trial that it has to itself: an answer is only where it was given.
_OWN = tuple(name for name in wire.TrialIn.model_fields if name != "answer")
_TOLD_EVERY = 1_000


def save(db: Client, ids: Sequence[str], path: Path, progress: Progress = silent) -> Manifest:
    """Save objects with mesh, parts, trials, kernels fitted on them, and the grippers of both: what it holds.

    Trials keep all of their own, withdrawn ones too. Left behind are answers, the history of corrections, and
    outcomes of sweeps that are no trials. BundleProblem where an object changed meanwhile.
    """
    if not ids or len(set(ids)) != len(ids):
        raise ValueError("name the objects to bundle, each once")
    items = [db.objects.get(id) for id in ids]
    total = sum(batch.inserted for item in items for batch in item.batches)
    kernels = [kernel for kernel in db.kernels if kernel.provenance.object in ids]
    grippers = {kernel.gripper for kernel in kernels if kernel.gripper is not None}
    licences: set[str] = set()
    bundled, done = [], 0
    with archive.writing(path) as writer:
        for place, item in enumerate(items):
            saved = _ObjectSaving(writer, place, item, partial(_told, progress, done, total))
            bundled.append(saved.save())
            done += bundled[-1].trials
            grippers |= saved.grippers
            licences |= saved.licences
        if kernels:
            with writer.lines("kernels") as sink:
                for kernel in kernels:
                    sink.line(kernel)
        return writer.manifest(
            Manifest(
                made_by=f"graspdb {__version__}",
                objects=bundled,
                grippers=_profiles(db, grippers),
                kernels=len(kernels),
                licences=sorted(licences),
            )
        )


def _told(progress: Progress, before: int, total: int, done: int) -> None:
    progress(before + done, total)


def _profiles(db: Client, names: set[str]) -> dict[str, BundledGripper]:
    """Grippers by name and version, the newest where no version is named."""
    found = {}
    for name in sorted(names):
        info = db.grippers.get(name)
        found[f"{info.id}@{info.version}"] = BundledGripper(name=info.name, profile=info.profile)
    return found


class _ObjectSaving:
    """One object on its way into a bundle."""

    def __init__(
        self, writer: BundleWriter, place: int, item: GraspObject, progress: Callable[[int], None]
    ) -> None:
        self._writer, self._place, self._item, self._progress = writer, place, item, progress
        self.grippers: set[str] = set()
        self.licences: set[str] = set()

    def save(self) -> BundledObject:
        item, info = self._item, self._item.info
        mesh = info.mesh
        if mesh is not None:
            self._writer.content(member_of(self._place, "mesh"), item.download_mesh())
        if info.convex_parts is not None:
            self._writer.content(member_of(self._place, "convex-parts"), item.download_convex_parts())
        batches = [batch for batch in item.batches if batch.inserted]
        with self._writer.lines(member_of(self._place, "batches")) as sink:
            for batch in batches:
                sink.line(_head(batch))
        trials, withdrawn = self._trials(batches)
        packed = sum(batch.packed for batch in item.batches)
        if item.refresh().info.revision != info.revision:
            raise BundleProblem(f"{info.id} was changed while it was being read: bundle it again")
        kept = {
            name: value for name, value in info.model_dump().items() if name in wire.ObjectCreate.model_fields
        }
        return BundledObject(
            id=info.id,
            properties=wire.ObjectCreate.model_validate(kept),
            mesh=None if mesh is None else MeshMember.model_validate(mesh.model_dump()),
            convex_parts=info.convex_parts is not None,
            batches=len(batches),
            trials=trials,
            withdrawn=withdrawn,
            packed=packed,
        )

    def _trials(self, batches: Sequence[wire.BatchInfo]) -> tuple[int, int]:
        trials = withdrawn = 0
        with self._writer.lines(member_of(self._place, "trials")) as sink:
            for number, batch in enumerate(batches):
                if batch.licence is not None:
                    self.licences.add(batch.licence)
                of_batch = batch.model_dump(mode="json")["metadata"]
                for trial in self._item.trials.list(batch=batch.batch).documents():
                    sink.line(self._own(trial, of_batch, number))
                    withdrawn += bool(trial["withdrawn"])
                    trials += 1
                    if trials % _TOLD_EVERY == 0:
                        self._progress(trials)
                self._progress(trials)
        return trials, withdrawn

    def _own(self, trial: dict[str, Any], of_batch: Any, number: int) -> dict[str, Any]:
        fields = {name: trial[name] for name in _OWN if trial.get(name) is not None}
        if trial["gripper"] is not None:
            fields["gripper"] = f"{trial['gripper']}@{trial['gripper_version']}"
            self.grippers.add(fields["gripper"])
        if trial["metadata"] == of_batch:
            fields.pop("metadata", None)
        if trial["withdrawn"]:
            fields["withdrawn"] = True
        return {"batch": number, **fields}


def _head(batch: wire.BatchInfo) -> BundledBatch:
    return BundledBatch.model_validate(batch.model_dump())

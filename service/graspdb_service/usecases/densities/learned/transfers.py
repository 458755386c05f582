"""What attempts at other objects tell of an object, with the same gripper: learned, kept, and kept up.

Of every object with a shape that the gripper tried often enough, attempts are drawn, and trees learn of what
the jaw closed on (:mod:`graspdb_estimators.transfer`). It is one thing for all objects that a gripper tried:
an object that taught it is answered by the trees that know nothing of it. Whose key sees some objects only is
answered by what these taught. It is learned again once objects have come that matter, and at once where one
that taught it is gone or was corrected.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graspdb.wire import OUTCOME_CODES
from graspdb_estimators import GraspFeatures, Lesson, Transfer, fit_transfer
from graspdb_estimators.transfer import LEAST_OBJECTS, LEAST_OF_AN_OBJECT, LEAST_OF_EACH, MOST_OF_AN_OBJECT
from graspdb_geometry.closing import FEATURES
from graspdb_geometry.grippers import shape_of
from graspdb_service import principal
from graspdb_service.problems import ProblemError
from graspdb_service.storage import objects
from graspdb_service.storage.database import UNAVAILABLE, CommitUnknown, Database
from graspdb_service.storage.derived import learned_transfers
from graspdb_service.storage.derived.learned_transfers import Teacher
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases.densities.learned.background import Background
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.trials import attempts
from graspdb_service.usecases.trials.attempts import Stored, Swept
from graspdb_service.usecases.trials.selection import Selected, resolve

log = logging.getLogger("graspdb")

#: Another one whenever what is kept is not what an earlier version learned.
_FORMAT = "1"
#: Objects that it is learned of at most, and of each the newest trials posted one by one, and outcomes.
_MOST_OBJECTS, _NEWEST_ROWS, _OUTCOMES = 48, 20_000, 200_000
#: How often it is looked whether there is more to learn from, and whether a replica has learned anything.
_LOOK_AGAIN_S, _ASK_AGAIN_S = 30.0, 1.0
#: Learned again once so large a share of the objects, or of their attempts, are others.
_CHANGED = 0.25
#: Grippers that are held in memory, those asked for last.
_MOST_HELD = 8
_LEFT_OUT = [OUTCOME_CODES["collision"], OUTCOME_CODES["simulation_error"]]


@dataclass(frozen=True, eq=False)
class _Known:
    """What was learned last, None where that was nothing, and by whom it was taught."""

    number: int
    taught_by: dict[str, list[int]]
    transfer: Transfer | None


@dataclass(frozen=True, eq=False)
class Untried:
    """What other objects tell of one object; its ``shape`` chooses the trees that know nothing of it."""

    transfer: Transfer
    shape: str
    features: GraspFeatures


class Transfers:
    """What one service process knows of the objects of every gripper, over a database that others share."""

    def __init__(self, database: Database, scenes: Scenes, background: Background) -> None:
        self._database = database
        self._scenes = scenes
        self._background = background
        self._lock = threading.Lock()
        self._held: OrderedDict[str, _Known | None] = OrderedDict()
        self._asked: dict[str, float] = {}
        self._looked: dict[str, float] = {}

    def of(self, selected: Selected) -> Untried | None:
        """What other objects tell of this one now; None where they tell nothing, or it has no shape. What is
        not known yet is learned.
        """
        if selected.gripper is None or selected.profile is None:
            return None
        prefix = principal.object_prefix()
        name = _digest(selected, prefix)
        known = self._known(name)
        now = time.monotonic()
        with self._lock:
            look = now - self._looked.get(name, -_LOOK_AGAIN_S) >= _LOOK_AGAIN_S
            if look:
                self._looked[name] = now
        if look:
            self._background.do(name, lambda: self._keep_up(name, selected, prefix))
        if known is None or known.transfer is None:
            return None
        features = features_of(self._scenes, selected)
        return None if features is None else Untried(known.transfer, shape_name(selected.row), features)

    def wait(self, selected: Selected, within_s: float) -> bool:
        """Until what is being learned of a gripper's objects is; False where that takes longer."""
        return self._background.wait(_digest(selected, principal.object_prefix()), within_s)

    def _known(self, name: str) -> _Known | None:
        """What this process knows, or another one has learned meanwhile."""
        now = time.monotonic()
        with self._lock:
            known = self._held.get(name)
            if name in self._held:
                self._held.move_to_end(name)
            if now - self._asked.get(name, -_ASK_AGAIN_S) < _ASK_AGAIN_S:
                return known
            self._asked[name] = now
        row = None
        with contextlib.suppress(*UNAVAILABLE), self._database.read() as tx:
            number = learned_transfers.newest(tx, name)
            if number is not None and (known is None or number > known.number):
                row = learned_transfers.find(tx, name)
        if row is None:
            return known
        try:
            transfer = None if row.content is None else Transfer.of_bytes(row.content)
        except ValueError:
            log.warning("what was learned of a gripper's objects can't be read and is learned again")
            return known
        return self._hold(name, _Known(row.number, row.objects, transfer))

    def _hold(self, name: str, known: _Known) -> _Known:
        with self._lock:
            self._held[name] = known
            self._held.move_to_end(name)
            while len(self._held) > _MOST_HELD:
                gone = self._held.popitem(last=False)[0]
                self._asked.pop(gone, None)
                self._looked.pop(gone, None)
        return known

    def _keep_up(self, name: str, selected: Selected, prefix: str) -> None:
        """Learn anew where there is more to learn from, or less."""
        assert selected.gripper is not None
        known = self._known(name)
        try:
            with self._database.read() as tx:
                found = learned_transfers.teachers(
                    tx,
                    selected.gripper.partition("@")[0],
                    prefix=prefix,
                    least=LEAST_OF_AN_OBJECT,
                    least_of_each=LEAST_OF_EACH,
                    most=_MOST_OBJECTS,
                )
            if _nearly_the_same(known, found) or (known is None and len(found) < LEAST_OBJECTS):
                return
            lessons = self._lessons(selected, found)
            transfer = fit_transfer(lessons, breathe=self._background.breathe)
            content = None if transfer is None else transfer.to_bytes()
            with self._database.write() as tx:
                taught_by = {str(each.id): [each.epoch, each.attempts] for each in found}
                learned_transfers.put(tx, name, taught_by, content)
        except (*UNAVAILABLE, CommitUnknown) as error:
            log.debug("what other objects tell can't be learned now: %s", error)
            return
        with self._lock:
            self._asked.pop(name, None)
        self._known(name)

    def _lessons(self, selected: Selected, teachers: Sequence[Teacher]) -> list[Lesson]:
        """What objects teach, of one protocol: that which was asked for, or which most of them have."""
        found: dict[str | None, list[Lesson]] = {}
        for each in teachers:
            self._background.breathe()
            try:
                protocol, lesson = self._lesson(selected, each)
            except ProblemError as error:
                # Several protocols, or geometry that was replaced just now.
                log.debug("object %r teaches nothing: %s", each.slug, error)
                continue
            if lesson is not None:
                found.setdefault(protocol, []).append(lesson)
        return max(found.values(), key=len, default=[])

    def _lesson(self, selected: Selected, teacher: Teacher) -> tuple[str | None, Lesson | None]:
        """The protocol of an object's attempts, and some of those that closed on something."""
        with self._database.read() as tx:
            row = objects.find(tx, teacher.slug)
            if row is None or row.id != teacher.id:
                return None, None
            its = resolve(tx, row, selected.filters)
            newest = max(0, row.last_seq - _NEWEST_ROWS)
            stored = attempts.fetch(tx, its, without=_LEFT_OUT, after_seq=newest)
        tried = attempts.joined(replace(stored, swept=_some(stored)))
        features = features_of(self._scenes, its)
        if features is None or not len(tried):
            return its.protocol, None
        closed = features.closing.features(tried.poses, features.shape)
        rows = np.flatnonzero(np.isfinite(closed[:, FEATURES.index("width")]))
        if len(rows) > MOST_OF_AN_OBJECT:
            rows = np.sort(np.random.default_rng(0).choice(rows, MOST_OF_AN_OBJECT, replace=False))
        drawn = closed[rows].astype(np.float32)
        lesson = Lesson(shape_name(row), tried.poses[rows], tried.shares[rows], tried.weight[rows], drawn)
        return its.protocol, lesson


def features_of(scenes: Scenes, selected: Selected) -> GraspFeatures | None:
    """What a selection's jaw closes on; None without its shape or the object's."""
    if selected.profile is None:
        return None
    closing = scenes.closing(selected.row)
    if closing is None:
        return None
    return GraspFeatures(closing, shape_of(selected.profile), symmetric=selected.jaw_symmetric)


def shape_name(row: ObjectRow) -> str:
    """Equal where objects have one shape, as copies do."""
    form = None if row.mesh_info is None else (row.mesh_info["unit"], row.mesh_info.get("scale", 1.0))
    told = f"{row.mesh_sha256} {form}" if row.mesh_sha256 is not None else f"parts {row.parts_sha256}"
    return hashlib.sha256(told.encode()).hexdigest()


def _some(stored: Stored) -> list[Swept]:
    """Chunks of sweeps with about as many outcomes as are looked at, drawn at random."""
    order = np.random.default_rng(0).permutation(len(stored.swept))
    sizes = np.cumsum([len(stored.swept[place].chunk.outcomes) for place in order])
    kept = order[: int(np.searchsorted(sizes, _OUTCOMES)) + 1]
    return [stored.swept[place] for place in np.sort(kept)]


def _nearly_the_same(known: _Known | None, found: Sequence[Teacher]) -> bool:
    """Whether nearly the same attempts would teach it: none gone or corrected, and few come."""
    if known is None:
        return False
    now = {str(each.id): each for each in found}
    for name, (epoch, _) in known.taught_by.items():
        each = now.get(name)
        if each is None:
            # Of many objects some are not among those looked at any more.
            if len(found) < _MOST_OBJECTS:
                return False
        elif each.epoch != epoch:
            return False

    def worth(count: int) -> int:
        return min(count, MOST_OF_AN_OBJECT)

    before = sum(worth(count) for _, count in known.taught_by.values())
    after = sum(worth(each.attempts) for each in found)
    few = len(now) - len(known.taught_by) <= _CHANGED * len(known.taught_by)
    return few and after - before <= _CHANGED * before


def _digest(selected: Selected, prefix: str) -> str:
    """Of all that decides what is learned but the attempts themselves."""
    profile = selected.profile
    jaw = None if profile is None else profile.model_dump_json()
    asked = selected.filters.model_dump_json()
    return hashlib.sha256(f"{_FORMAT} {asked} {jaw} {FEATURES} {prefix}".encode()).hexdigest()

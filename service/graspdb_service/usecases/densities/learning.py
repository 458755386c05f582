"""Success probabilities that are learned: fitted in the background, kept in the database, and kept up.

The kernel estimate answers at once and everywhere. From enough attempts of both kinds a thread learns to set
it right, and where object and gripper have shapes, trees on what the jaw closes on that are stacked on it
(:mod:`graspdb_estimators`). What was learned answers in its place from then on, if it predicts attempts whose
block of space was left out better. It is learned again once a quarter of the attempts are others, and after a
correction, until which the kernel estimate answers; it is known by what it was learned from, so that replicas
share it, and a restarted service has it at once.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace

from graspdb.wire import EstimatorInfo
from graspdb_density import Reach, SuccessModel
from graspdb_estimators import GraspFeatures, Stack, StackedModel, fit_stack
from graspdb_estimators.stack import LEAST_ATTEMPTS, LEAST_OF_EACH
from graspdb_geometry.closing import FEATURES
from graspdb_geometry.grippers import shape_of
from graspdb_service.problems import ProblemError
from graspdb_service.storage.database import UNAVAILABLE, CommitUnknown, Database
from graspdb_service.storage.derived import learned_estimators
from graspdb_service.storage.derived.learned_estimators import LearnedRow
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.trials.selection import Selected

log = logging.getLogger("graspdb")

#: Another one whenever what is kept is not what an earlier version learned.
_FORMAT = "2"
#: Learned again once so large a share of the attempts are others.
_CHANGED = 0.25
#: What is held in memory takes so much, that asked for last; and how much waits to be learned of.
_MAX_BYTES, _MOST_WAITING = 64 * 2**20, 16
#: Looks at the database are remembered so many.
_MOST_LOOKS = 1_024
#: How long it is relied on that no replica has learned anything either.
_LOOK_AGAIN_S = 1.0
#: How long a service that stops waits for what is being fitted.
_ENDS_WITHIN_S = 2.0
#: Below other threads, which answer.
_NICE = 10


@dataclass(frozen=True, eq=False)
class Model:
    """All attempts, and the ones to search by: a random sample where all would take too long, and the kernel
    estimate where what was learned takes longer; how far from them they tell; who estimates; ``plain`` is the
    kernel estimate alone, None where this is it.
    """

    whole: SuccessModel
    quick: SuccessModel
    reach: Reach
    estimator: EstimatorInfo
    plain: Model | None = None


@dataclass(frozen=True, eq=False)
class _Learned:
    """What attempts of an epoch taught; None where they taught nothing better than the kernel estimate."""

    epoch: int
    attempts: int
    stack: Stack | None

    @property
    def info(self) -> EstimatorInfo:
        if self.stack is None:
            return EstimatorInfo()
        skill, of_kernel = self.stack.left_out.skills
        return EstimatorInfo(
            name="kernel" if self.stack.trees is None else "stack",
            recalibrated=True,
            attempts=self.stack.attempts,
            skill=round(skill, 3),
            kernel_skill=round(of_kernel, 3),
        )

    @property
    def nbytes(self) -> int:
        return 1_024 + (0 if self.stack is None else self.stack.nbytes)

    def is_of(self, epoch: int, attempts: int) -> bool:
        """Whether nearly the same attempts would teach it."""
        return self.epoch == epoch and abs(attempts - self.attempts) <= _CHANGED * self.attempts


@dataclass(frozen=True, eq=False)
class _Task:
    """Attempts to learn from: those to search by, how many there are, and what the jaw closes on."""

    object_id: int
    digest: str
    epoch: int
    attempts: int
    model: SuccessModel
    reach: Reach
    features: Callable[[], GraspFeatures | None]


class _Stopped(Exception):
    """The service is about to stop."""


class Learning:
    """What one service process has learned, over a database that others may share."""

    def __init__(self, database: Database, scenes: Scenes, *, enabled: bool) -> None:
        self._database = database
        self._scenes = scenes
        self._enabled = enabled
        self._changed = threading.Condition()
        self._held: OrderedDict[str, _Learned] = OrderedDict()
        self._looked: dict[str, float] = {}
        self._waiting: OrderedDict[str, _Task] = OrderedDict()
        self._closed = False
        self._thread: threading.Thread | None = None

    def improved(self, selected: Selected, kernel: str, plain: Model, *, trees: bool) -> Model:
        """What was learned of a selection's attempts under a ``kernel`` in their place, if it is known; it is
        learned where it is not. With ``trees`` the object's shape and the gripper's tell.
        """
        if not self._enabled or not _enough(plain.whole):
            return plain
        row, attempts = selected.row, plain.whole.size
        digest = _digest(selected, kernel, trees)
        known = self._known(row.id, digest, row.epoch, attempts)
        if known is None or not known.is_of(row.epoch, attempts):

            def features() -> GraspFeatures | None:
                return self._features(selected) if trees else None

            self._learn(_Task(row.id, digest, row.epoch, attempts, plain.quick, plain.reach, features))
        if known is None or known.epoch != row.epoch:
            return replace(plain, estimator=EstimatorInfo(state="fitting"))
        if known.stack is None:
            return plain
        features_now = self._features(selected) if known.stack.trees is not None else None
        whole = StackedModel(plain.whole, known.stack, features_now)
        return Model(whole, plain.quick, known.stack.reach(plain.reach), known.info, plain)

    def held(self, selected: Selected, kernel: str, *, trees: bool) -> tuple[Stack | None, EstimatorInfo]:
        """What was learned last of a selection's attempts and is in use, None where nothing is; who estimates
        success probabilities, as far as that is known without a look at any attempt.
        """
        known = None
        if self._enabled:
            digest, epoch = _digest(selected, kernel, trees), selected.row.epoch
            known = self._known(selected.row.id, digest, epoch, attempts=None)
            known = None if known is None or known.epoch != epoch else known
        return (None, EstimatorInfo()) if known is None else (known.stack, known.info)

    def wait(self, selected: Selected, kernel: str, *, trees: bool, within_s: float) -> bool:
        """Until what is being learned of a selection's attempts is; False where that takes longer."""
        digest = _digest(selected, kernel, trees)
        with self._changed:
            return self._changed.wait_for(lambda: digest not in self._waiting or self._closed, within_s)

    def close(self) -> None:
        """Stop; what is half learned is learned again by whoever needs it."""
        with self._changed:
            self._closed = True
            thread = self._thread
            self._changed.notify_all()
        if thread is not None:
            # What scikit-learn fits is not ended: nothing of it is lost that the next start can't learn.
            thread.join(_ENDS_WITHIN_S)

    def _features(self, selected: Selected) -> GraspFeatures | None:
        if selected.profile is None:
            return None
        closing = self._scenes.closing(selected.row)
        return (
            None
            if closing is None
            else GraspFeatures(closing, shape_of(selected.profile), symmetric=selected.jaw_symmetric)
        )

    def _known(self, object_id: int, digest: str, epoch: int, attempts: int | None) -> _Learned | None:
        """What this process has learned, or another one meanwhile: of so many attempts, or of whichever."""
        now = time.monotonic()
        with self._changed:
            known = self._held.get(digest)
            if known is not None:
                self._held.move_to_end(digest)
                if known.is_of(epoch, known.attempts if attempts is None else attempts):
                    return known
            if now - self._looked.get(digest, -_LOOK_AGAIN_S) < _LOOK_AGAIN_S:
                return known
            if len(self._looked) > _MOST_LOOKS:
                self._looked.clear()
            self._looked[digest] = now
        found = None
        with contextlib.suppress(*UNAVAILABLE), self._database.read() as tx:
            found = learned_estimators.find(tx, object_id, digest)
        if found is None:
            return known
        if known is not None and (found.epoch, found.attempts) <= (known.epoch, known.attempts):
            # As old, or older: what this process learned last could not be kept.
            return known
        try:
            stack = None if found.content is None else Stack.of_bytes(found.content)
        except ValueError:
            log.warning("what was learned of object %d can't be read and is learned again", object_id)
            return known
        return self._hold(digest, _Learned(found.epoch, found.attempts, stack))

    def _hold(self, digest: str, learned: _Learned) -> _Learned:
        with self._changed:
            self._held[digest] = learned
            self._held.move_to_end(digest)
            bytes_held = sum(each.nbytes for each in self._held.values())
            while bytes_held > _MAX_BYTES and len(self._held) > 1:
                bytes_held -= self._held.popitem(last=False)[1].nbytes
        return learned

    def _learn(self, task: _Task) -> None:
        """Have it learned soon, after what is being learned."""
        with self._changed:
            if self._closed or task.digest in self._waiting:
                return
            self._waiting[task.digest] = task
            if len(self._waiting) > _MOST_WAITING:
                # Who asks for it again has it learned then. The first is being learned.
                self._waiting.pop(list(self._waiting)[1])
            if self._thread is None:
                self._thread = threading.Thread(target=self._learn_on, name="graspdb-learning", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def _learn_on(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # Linux only: there threads have their own
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                task = next(iter(self._waiting.values()))
            try:
                self._one(task)
            except _Stopped:
                return
            finally:
                with self._changed:
                    self._waiting.pop(task.digest, None)
                    self._changed.notify_all()

    def _one(self, task: _Task) -> None:
        """Learn of one selection, and keep it; nothing is tried again with the same attempts."""
        learned, keep = _Learned(task.epoch, task.attempts, None), True
        try:
            stack = fit_stack(task.model, task.features(), reach=task.reach, breathe=self._breathe)
            if stack is not None and stack.left_out.verdict == "better":
                learned = replace(learned, stack=stack)
        except _Stopped:
            raise
        except (ProblemError, *UNAVAILABLE) as error:
            # The geometry was replaced, or can't be read now: whoever asks next has it learned.
            log.info("object %d can't be learned of now: %s", task.object_id, error)
            return
        except Exception:
            log.exception("object %d can't be learned of", task.object_id)
            keep = False
        self._hold(task.digest, learned)
        if not keep:
            return
        content = None if learned.stack is None else learned.stack.to_bytes()
        try:
            with self._database.write() as tx:
                row = LearnedRow(task.epoch, task.attempts, content)
                learned_estimators.put(tx, task.object_id, task.digest, row)
        except (*UNAVAILABLE, CommitUnknown) as error:
            log.debug("what was learned can't be kept now: %s", error)
        except Exception:
            log.exception("what was learned could not be kept")

    def _breathe(self) -> None:
        if self._closed:
            raise _Stopped
        # Others take the interpreter meanwhile.
        time.sleep(0.0)


def _enough(model: SuccessModel) -> bool:
    won = sum(part.size for part in model.parts if part.share >= 0.5)
    return model.size >= LEAST_ATTEMPTS and min(won, model.size - won) >= LEAST_OF_EACH


def _digest(selected: Selected, kernel: str, trees: bool) -> str:
    """Of all that decides what is learned but the attempts themselves."""
    row, shapes = selected.row, ""
    if trees:
        profile = selected.profile
        jaw = None if profile is None else profile.model_dump_json()
        form = None if row.mesh_info is None else (row.mesh_info["unit"], row.mesh_info.get("scale", 1.0))
        shapes = f"{row.mesh_sha256} {form} {row.parts_sha256} {jaw} {FEATURES}"
    told = f"{_FORMAT} {selected.filters.model_dump_json()} {sorted(selected.tried)} {kernel} {shapes}"
    return hashlib.sha256(told.encode()).hexdigest()

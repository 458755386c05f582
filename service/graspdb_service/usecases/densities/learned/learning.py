"""Success probabilities that are learned: fitted in the background, kept in the database, and kept up.

The kernel estimate answers at once and everywhere. From enough attempts of both kinds a thread learns to set
it right, and where object and gripper have shapes, trees on what the jaw closes on that are stacked on it
(:mod:`graspdb_estimators`); the attempts choose the kernel's widths along every axis, too. What was learned
answers in its place from then on, if it predicts attempts whose block of space was left out better. It is
learned again once a quarter of the attempts are others, and after a correction, until which the kernel
estimate answers; it is known by what it was learned from, so that replicas share it, and a restarted service
has it at once. Until an object has taught enough of itself, what others tell of it answers, where they do
(:mod:`transfers`).
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

from graspdb.wire import EstimatorInfo, OwnWidths
from graspdb_density import DiagonalKernel, Reach, SuccessModel
from graspdb_density.success.kernel_regression import SuccessKernel
from graspdb_estimators import BoostedTrees, LeftOut, Stack, StackedModel, fit_stack
from graspdb_estimators.fitting import LEAST_ATTEMPTS, LEAST_OF_EACH
from graspdb_geometry.closing import FEATURES
from graspdb_service.problems import ProblemError
from graspdb_service.storage.database import UNAVAILABLE, CommitUnknown, Database
from graspdb_service.storage.derived import learned_estimators
from graspdb_service.storage.derived.learned_estimators import LearnedRow
from graspdb_service.usecases.densities.learned.background import Background, Stopped
from graspdb_service.usecases.densities.learned.transfers import Transfers, Untried, features_of, shape_name
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.trials.selection import Selected

log = logging.getLogger("graspdb")

#: Another one whenever what is kept is not what an earlier version learned.
_FORMAT = "3"
#: Learned again once so large a share of the attempts are others.
_CHANGED = 0.25
#: Up to so many attempts others may tell more of an object than these do by kernels alone, and it is learned
#: of again once they tell anything.
_FEW, _OTHERS_HELP = 1_000, 3_000
#: What is held in memory takes so much, that asked for last.
_MAX_BYTES = 64 * 2**20
#: Looks at the database are remembered so many.
_MOST_LOOKS = 1_024
#: How long it is relied on that no replica has learned anything either.
_LOOK_AGAIN_S = 1.0


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
    """What attempts of an epoch taught; None where they taught nothing better than the kernel estimate.
    ``others``: whether other objects had their say.
    """

    epoch: int
    attempts: int
    stack: Stack | None
    others: bool

    @property
    def info(self) -> EstimatorInfo:
        if self.stack is None:
            return EstimatorInfo()
        name = "kernel" if self.stack.trees is None else "stack"
        return _info(name, self.stack.left_out, self.stack.attempts, self.stack.kernel)

    @property
    def nbytes(self) -> int:
        return 1_024 + (0 if self.stack is None else self.stack.nbytes)

    def is_of(self, epoch: int, attempts: int) -> bool:
        """Whether nearly the same attempts would teach it."""
        return self.epoch == epoch and abs(attempts - self.attempts) <= _CHANGED * self.attempts


def _info(name: str, held: LeftOut, attempts: int, kernel: DiagonalKernel | None) -> EstimatorInfo:
    skill, of_kernel = held.skills
    widths = None
    if kernel is not None:
        widths = OwnWidths(
            sigma_position_m=list(kernel.sigmas[:3]),
            sigma_rotation_deg=[math.degrees(each) for each in kernel.sigmas[3:]],
            axes="gripper" if kernel.axes is None else "object",
        )
    return EstimatorInfo(
        name=name,
        recalibrated=True,
        attempts=attempts,
        skill=round(skill, 3),
        kernel_skill=round(of_kernel, 3),
        widths=widths,
    )


def _info_of(untried: Untried) -> EstimatorInfo:
    stack = untried.transfer.stack
    info = _info("transfer", stack.left_out, stack.attempts, None)
    return info.model_copy(update={"objects": untried.transfer.objects})


@dataclass(frozen=True, eq=False)
class Lookup:
    """A selection of which something may be learned: under a ``kernel``, in words, which attempts may replace
    where it is a density's (``default``); ``trees`` tell where the object's shape and the gripper's may.
    """

    selected: Selected
    kernel: str
    default: SuccessKernel | None
    trees: bool

    @cached_property
    def digest(self) -> str:
        """Of all that decides what is learned but the attempts themselves."""
        row, shapes = self.selected.row, ""
        if self.trees:
            profile = self.selected.profile
            jaw = None if profile is None else profile.model_dump_json()
            shapes = f"{shape_name(row)} {row.parts_sha256} {jaw} {FEATURES}"
        tried = sorted(self.selected.tried)
        told = f"{_FORMAT} {self.selected.filters.model_dump_json()} {tried} {self.kernel} {shapes}"
        return hashlib.sha256(told.encode()).hexdigest()


class Learning:
    """What one service process has learned, over a database that others may share."""

    def __init__(self, database: Database, scenes: Scenes, *, enabled: bool) -> None:
        self._database = database
        self._scenes = scenes
        self._enabled = enabled
        self._background = Background()
        self._transfers = Transfers(database, scenes, self._background)
        self._lock = threading.Lock()
        self._held: OrderedDict[str, _Learned] = OrderedDict()
        self._looked: dict[str, float] = {}

    def improved(self, of: Lookup, plain: Model, prepare: Callable[[DiagonalKernel], None]) -> Model | None:
        """What was learned of a selection's attempts in their place, if it is known; it is learned where it
        is not, and used once all is prepared for it. Of few attempts what others tell, if they do. None where
        the attempts have chosen another kernel meanwhile than this model's.
        """
        if not self._enabled:
            return plain
        row, attempts = of.selected.row, plain.whole.size
        untried = self.untried(of.selected) if of.trees else None
        fewer = self._of_others(plain, untried)
        if not _enough(plain.whole):
            return fewer
        known = self._known(row.id, of.digest, row.epoch, attempts)
        others = None
        if untried is not None and untried.transfer.better_untried:
            others = untried.transfer.trees_for(untried.shape)
        late = others is not None and known is not None and not known.others and attempts <= _OTHERS_HELP
        if known is None or late or not known.is_of(row.epoch, attempts):
            self._background.do(of.digest, lambda: self._learn(of, plain, others, prepare))
        if known is None or known.epoch != row.epoch:
            return replace(fewer, estimator=fewer.estimator.model_copy(update={"state": "fitting"}))
        if known.stack is None:
            return fewer
        if of.default is not None and plain.whole.kernel != (known.stack.kernel or of.default):
            return None
        features = features_of(self._scenes, of.selected) if known.stack.trees is not None else None
        whole = StackedModel(plain.whole, known.stack, features)
        return Model(whole, plain.quick, known.stack.reach(plain.reach), known.info, plain)

    def own_kernel(self, of: Lookup) -> DiagonalKernel | None:
        """The kernel that a selection's attempts chose themselves, where that is in use."""
        if of.default is None:
            return None
        stack = self.held(of)[0]
        return None if stack is None else stack.kernel

    def held(self, of: Lookup) -> tuple[Stack | None, EstimatorInfo]:
        """What was learned last of a selection's attempts and is in use, and its name; None and the kernel
        estimate where nothing is.
        """
        known = None
        if self._enabled:
            epoch = of.selected.row.epoch
            known = self._known(of.selected.row.id, of.digest, epoch, attempts=None)
            known = None if known is None or known.epoch != epoch else known
        return (None, EstimatorInfo()) if known is None else (known.stack, known.info)

    def estimator(self, of: Lookup) -> EstimatorInfo:
        """Who estimates success probabilities, as far as that is known without a look at any attempt."""
        stack, info = self.held(of)
        outcomes = of.selected.outcomes
        tried = sum(outcomes.values()) - outcomes.get("simulation_error", 0) - outcomes.get("collision", 0)
        if stack is not None or not of.trees or not 0 < tried <= _FEW:
            return info
        untried = self.untried(of.selected)
        return info if untried is None or not untried.transfer.better_with_few else _info_of(untried)

    def untried(self, selected: Selected) -> Untried | None:
        """What other objects that the gripper tried tell of this one; None where that is nothing."""
        return self._transfers.of(selected) if self._enabled else None

    def wait(self, of: Lookup, within_s: float) -> bool:
        """Until what is being learned of a selection's attempts is; False where that takes longer."""
        return self._background.wait(of.digest, within_s)

    def close(self) -> None:
        """Stop; what is half learned is learned again by whoever needs it."""
        self._background.close()

    def _of_others(self, plain: Model, untried: Untried | None) -> Model:
        """Few attempts beside what others tell, where objects that were left out show that to be better."""
        if untried is None or plain.whole.size > _FEW or not untried.transfer.better_with_few:
            return plain
        whole = StackedModel(plain.whole, untried.transfer.stack_for(untried.shape), untried.features)
        return Model(whole, plain.quick, plain.reach, _info_of(untried), plain)

    def _known(self, object_id: int, digest: str, epoch: int, attempts: int | None) -> _Learned | None:
        """What this process has learned, or another one meanwhile: of so many attempts, or of whichever."""
        now = time.monotonic()
        with self._lock:
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
        others = stack is not None and stack.others is not None
        return self._hold(digest, _Learned(found.epoch, found.attempts, stack, others))

    def _hold(self, digest: str, learned: _Learned) -> _Learned:
        with self._lock:
            self._held[digest] = learned
            self._held.move_to_end(digest)
            bytes_held = sum(each.nbytes for each in self._held.values())
            while bytes_held > _MAX_BYTES and len(self._held) > 1:
                bytes_held -= self._held.popitem(last=False)[1].nbytes
        return learned

    def _learn(
        self,
        of: Lookup,
        plain: Model,
        others: BoostedTrees | None,
        prepare: Callable[[DiagonalKernel], None],
    ) -> None:
        """Learn of one selection, and keep it; nothing is tried again with the same attempts."""
        row, attempts = of.selected.row, plain.whole.size
        learned, keep = _Learned(row.epoch, attempts, None, others is not None), True
        try:
            stack = fit_stack(
                plain.quick,
                features_of(self._scenes, of.selected) if of.trees else None,
                reach=plain.reach,
                kernel=of.default,
                own_widths=of.default is not None,
                others=others,
                breathe=self._background.breathe,
            )
            if stack is not None and stack.left_out.verdict == "better":
                if stack.kernel is not None:
                    prepare(stack.kernel)
                learned = replace(learned, stack=stack)
        except Stopped:
            raise
        except (ProblemError, *UNAVAILABLE) as error:
            # The geometry was replaced, or can't be read now: whoever asks next has it learned.
            log.info("object %d can't be learned of now: %s", row.id, error)
            return
        except Exception:
            log.exception("object %d can't be learned of", row.id)
            keep = False
        self._hold(of.digest, learned)
        if not keep:
            return
        content = None if learned.stack is None else learned.stack.to_bytes()
        try:
            with self._database.write() as tx:
                kept = LearnedRow(row.epoch, attempts, content)
                learned_estimators.put(tx, row.id, of.digest, kept)
        except (*UNAVAILABLE, CommitUnknown) as error:
            log.debug("what was learned can't be kept now: %s", error)
        except Exception:
            log.exception("what was learned could not be kept")


def _enough(model: SuccessModel) -> bool:
    won = sum(part.size for part in model.parts if part.share >= 0.5)
    return model.size >= LEAST_ATTEMPTS and min(won, model.size - won) >= LEAST_OF_EACH

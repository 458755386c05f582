"""Whether trials contradict the collision test: grasps that held where the gripper should overlap the object.

A scanned mesh, a profile from a data sheet or a pose as a camera saw it may be some millimetres off, and
geometry then calls impossible what a robot has done. Where that is so of more than a few grasps, collisions
are still told and best grasps still keep clear of them, but they decide no success probability: the attempts
there do. Likewise for what closes on nothing by geometry: a mesh may lack what a robot has gripped.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.geometry.collision import CollisionTest, Scenes
from graspdb_service.usecases.runtime.compute import Compute

#: Successes looked at, drawn at random, and how many of them, and which share, may collide for other reasons.
_LOOKED_AT, _STRAY, _STRAY_SHARE = 256, 1, 0.05


@dataclass(frozen=True)
class Contradiction:
    """So many of the real successes that were looked at collide by geometry."""

    collided: int
    looked_at: int

    @property
    def warning(self) -> str:
        return (
            f"in {self.collided:,} of {self.looked_at:,} grasps that held (simulation left aside) the open"
            " gripper overlaps the object by geometry: collisions therefore decide no success probability"
            " here. Check the gripper's profile, the mesh's frame and how the object's pose was measured"
        )


class _Seen(NamedTuple):
    """What successes that were not simulated say: against collisions, and whether they close on something."""

    against: Contradiction | None = None
    closed: bool = True


def _seen(built: Built, test: CollisionTest, threads: int) -> _Seen:
    if built.density is None:
        return _Seen()
    rows = np.flatnonzero(~built.weighing.simulated)
    rows = np.random.default_rng(0).permutation(rows)[:_LOOKED_AT]
    if len(rows) <= _STRAY:
        return _Seen()
    poses, most = built.density.poses[rows], max(_STRAY, _STRAY_SHARE * len(rows))
    free = test.free(poses, threads)
    collided, empty = int((~free).sum()), int((free & ~test.holds(poses, threads)).sum())
    return _Seen(Contradiction(collided, len(rows)) if collided > most else None, empty <= most)


def contradiction(built: Built, test: CollisionTest, threads: int) -> Contradiction | None:
    """What successes that were not simulated say against the collision test; None where they agree."""
    return _seen(built, test, threads).against


class CollisionEvidence:
    """What trials say of the collision tests of one service process, looked at once for every density."""

    def __init__(self, scenes: Scenes, compute: Compute) -> None:
        self._scenes = scenes
        self._compute = compute
        self._found: WeakKeyDictionary[Built, _Seen] = WeakKeyDictionary()
        self._lock = threading.Lock()

    def believed(self, built: Built) -> CollisionTest | None:
        """The collision test where it may decide success probabilities; None where it is not known, too."""
        test = self._scenes.test(built.selected)
        return test if test is not None and self._look(built, test).against is None else None

    def closing(self, built: Built) -> CollisionTest | None:
        """As :meth:`believed`, where what closes on nothing by geometry may be taken to hold nothing."""
        test = self.believed(built)
        return test if test is not None and self._look(built, test).closed else None

    def warnings(self, built: Built) -> list[str]:
        """What is to be said of a selection and of what geometry tells about it."""
        test = self._scenes.test(built.selected)
        found = None if test is None else self._look(built, test).against
        return [*built.selected.warnings, *([] if found is None else [found.warning])]

    def _look(self, built: Built, test: CollisionTest) -> _Seen:
        with self._lock:
            if built in self._found:
                return self._found[built]
        found = self._compute.run(lambda: _seen(built, test, self._compute.threads))
        with self._lock:
            self._found[built] = found
        return found

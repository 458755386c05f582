"""Getting a server ready: compiled functions loaded before the first query needs them."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import math
import sys
import threading
import time
from collections.abc import Callable

import numpy as np
from numba.core import event

from graspdb.wire.presets.grippers import PRESETS
from graspdb_density import (
    GraspDensity,
    IsotropicKernel,
    ModeSearch,
    Region,
    SuccessModel,
    choose_widths,
    se3,
    validate_reach,
)
from graspdb_density.kde.rows import Rows
from graspdb_density.se3 import Poses
from graspdb_density.success.motions import Motions
from graspdb_geometry.collision import Scene, Surface
from graspdb_geometry.grippers import shape_of
from graspdb_service.trial_columns import Bools
from graspdb_service.usecases.runtime.compute import Compute

#: Seconds after which a thread that computes in Python lets others have the interpreter; by default 5 ms,
#: which a short answer that gives it up ten times would wait for ten times.
_SWITCH_S = 0.0005
_M_ARENA_MAX, _ARENAS = -8, 2
#: The collector looks at young objects alone: at all of them, those of a large request included, it would
#: hold the interpreter for half a second. All are looked at by `keep_tidy`, when there are few.
_COLLECT = (20_000, 10, 1_000_000)
_TIDY_S = 10.0


def settle() -> None:
    """Make this process one in which many threads share the interpreter, and that gives memory back."""
    sys.setswitchinterval(_SWITCH_S)
    gc.set_threshold(*_COLLECT)
    gc.enable()
    with contextlib.suppress(OSError, AttributeError):  # glibc only
        # Else every thread has an arena of its own, whose free pages no other thread can use.
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, _ARENAS)


def keep_tidy(is_quiet: Callable[[], bool]) -> None:
    """Free what refers to itself, and give free memory back to the system, now and then while it is quiet."""
    while True:
        time.sleep(_TIDY_S)
        if is_quiet():
            gc.collect()
            with contextlib.suppress(OSError, AttributeError):  # glibc only
                ctypes.CDLL(None).malloc_trim(0)


class NotCompiled(Exception):
    """What queries call is not among what Numba keeps on disk."""


class _Refusing(event.Listener):
    """Ends a call of this thread that would compile."""

    def __init__(self) -> None:
        self._thread = threading.get_ident()

    def on_start(self, event: event.Event) -> None:
        if threading.get_ident() == self._thread:
            raise NotCompiled

    def on_end(self, event: event.Event) -> None:
        """Nothing: what does not start does not end."""


def load(compute: Compute) -> None:
    """As :func:`warm_up`, but raise :class:`NotCompiled` before anything is compiled."""
    with event.install_listener("numba:compile", _Refusing()):
        warm_up(compute)


def warm_up(compute: Compute) -> None:
    """Load what queries call, and take what is loaded out of the garbage collector's sight.

    A full collection looks at every object there is, a few hundred thousand once everything is imported, and
    holds the interpreter meanwhile: 0.2 s in which not even ``/livez`` answers.
    """
    compute.run(_exercise)
    gc.collect()
    gc.freeze()


def _exercise() -> None:
    rng = np.random.default_rng(0)
    poses = Poses(rng.normal(size=(300, 3)) * 0.01, se3.random_quaternions(300, rng))
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]) * 0.02
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7]])
    scene = Scene([(corners, faces)])
    jaw = shape_of(PRESETS["pg70"].profile)
    surface = Surface(corners, faces, watertight=False)
    surface.collides(poses, jaw)
    surface.widths(poses, jaw)
    kernel = IsotropicKernel(0.015, math.radians(15.0))
    region = Region([[0.0, 0.0, 1.0, 0.0]], approach=(0.0, 0.0, 1.0), approach_angle=1.0)

    def free(asked: Poses) -> Bools:
        return ~scene.collides(asked, jaw)

    choose_widths(Rows.of(poses))
    success = rng.random(300) < 0.5
    model = SuccessModel.build(poses, success, kernel=kernel)
    model.extend(poses, success).evaluate(poses[:5])
    model.evaluate_near(Poses(poses.positions[:3] + 1.0, poses.quaternions_xyzw[:3]))
    validate_reach(model)
    density = GraspDensity.build(poses, kernel=kernel)
    density = density.extend(density.sample(10, rng))
    density.log_density(poses)
    density.log_density(Poses(poses.positions[:3] + 1.0, poses.quaternions_xyzw[:3]), cutoff=None)
    search = ModeSearch(density)
    search.maxima(region, count=2, admissible=free)
    top = search.global_maximum()

    def elsewhere(asked: Poses) -> Bools:
        return np.asarray(np.linalg.norm(asked.positions - top.position, axis=1) > 0.005)

    search.maxima(admissible=elsewhere)
    density.nearest_rows(poses[0], 5)
    density.nearest_each(poses[:5], within=2.0)
    model.lower_end(poses[:5])
    for axis in (None, (0.0, 0.0, 1.0)):
        model.shared(Motions.of(np.eye(3)[None], np.zeros(3), axis=axis)).evaluate_near(poses[:5])

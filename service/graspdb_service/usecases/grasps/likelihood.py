"""How likely poses are: the density there, the success probability, whether the gripper collides."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import KernelInfo, Selection
from graspdb.wire.queries import LikelihoodColumn
from graspdb_density.kde.density import SearchedDensity
from graspdb_density.se3 import Poses
from graspdb_service.problems import ProblemError
from graspdb_service.usecases.densities.cache import kernel_of
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.densities.success_models import LEVEL
from graspdb_service.usecases.geometry.collision import CollisionTest

Floats = NDArray[np.float64]

#: Poses a computation takes at a time, so that short questions get between the blocks of a long one.
_BLOCK = 16_384


@dataclass(frozen=True, eq=False)
class LikelihoodAnswer:
    """Columns (n,) in the poses' order, None where not asked for or not known.

    ``log_density`` is minus infinity where the density is exactly zero; NaN stands for not known.
    """

    object_id: int
    revision: int
    kernel: KernelInfo
    density: Floats | None = None
    log_density: Floats | None = None
    relative: Floats | None = None
    collision_free: NDArray[np.bool_] | None = None
    success_probability: Floats | None = None
    interval: tuple[Floats, Floats] | None = None
    effective_trials: Floats | None = None

    def columns(self) -> dict[str, Any]:
        """Those there are, by their names in an answer."""
        names = (
            "density",
            "log_density",
            "relative",
            "success_probability",
            "effective_trials",
            "collision_free",
        )
        columns = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        if self.interval is not None:
            columns["interval"] = {"level": LEVEL, "low": self.interval[0], "high": self.interval[1]}
        return columns


def likelihood(
    ctx: Estimators,
    slug: str,
    request: Selection,
    poses: Poses,
    include: Collection[LikelihoodColumn] | None,
) -> LikelihoodAnswer:
    """How likely poses (n,) in the object frame are under the density of the successes."""
    count = len(poses)
    if count > ctx.settings.max_query_poses:
        raise ProblemError(
            413,
            "too-many-poses",
            f"{count} poses are over the limit of {ctx.settings.max_query_poses}: send several requests",
            errors=[("poses", f"at most {ctx.settings.max_query_poses}")],
        )
    _, cutoff = kernel_of(request)

    def asked(*names: LikelihoodColumn) -> bool:
        return include is None or any(name in include for name in names)

    with ctx.compute.admitted():
        built = ctx.densities.requested(slug, request)
        logs = relative = free = None
        if asked("density", "log_density", "relative"):
            search = built.search
            if search is None:
                logs, relative = np.full(count, -np.inf), np.zeros(count)
            else:
                logs = log_density(ctx, search.density, poses, cutoff)
                if asked("relative"):
                    relative = ctx.compute.run(partial(search.relative, logs, ctx.compute.threads))
        chances = asked("success_probability", "interval", "effective_trials")
        if chances or asked("collision_free"):
            test = ctx.scenes.test(built.selected)
            if test is not None:
                free = _free(ctx, test, poses)
        estimates = None
        if chances:
            model = ctx.successes.model(built, collisions_known=free is not None)
            estimates = ctx.successes.estimate(model, poses, free)
    return LikelihoodAnswer(
        object_id=built.object_row.id,
        revision=built.revision,
        kernel=built.kernel,
        density=np.exp(logs) if logs is not None and asked("density") else None,
        log_density=logs if asked("log_density") else None,
        relative=relative if asked("relative") else None,
        collision_free=free if asked("collision_free") else None,
        success_probability=estimates.probability if estimates and asked("success_probability") else None,
        interval=(estimates.low, estimates.high) if estimates and asked("interval") else None,
        effective_trials=estimates.effective_trials if estimates and asked("effective_trials") else None,
    )


def log_density(
    ctx: Estimators,
    density: SearchedDensity,
    poses: Poses,
    cutoff: float | None,
) -> Floats:
    """Log densities (n,) of poses, computed in blocks."""
    logs = np.empty(len(poses))

    def work(part: slice) -> None:
        logs[part] = density.log_density(poses[part], cutoff=cutoff, threads=ctx.compute.threads)

    ctx.compute.blocks(len(poses), _BLOCK, work)
    return logs


def _free(ctx: Estimators, test: CollisionTest, poses: Poses) -> NDArray[np.bool_]:
    free = np.empty(len(poses), dtype=bool)

    def work(part: slice) -> None:
        free[part] = test.free(poses[part], threads=ctx.compute.threads)

    ctx.compute.blocks(len(poses), _BLOCK, work)
    return free

"""How likely poses are: the density there, the success probability, whether the gripper collides."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from typing import Any

import numpy as np

from graspdb.wire import Selection
from graspdb.wire.queries import LikelihoodColumn
from graspdb_density.kde.density import SearchedDensity
from graspdb_density.se3 import Poses
from graspdb_service.problems import ProblemError
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.cache import kernel_of
from graspdb_service.usecases.densities.estimators import Estimators


def likelihood(
    ctx: Estimators,
    slug: str,
    request: Selection,
    poses: Poses,
    include: Collection[LikelihoodColumn] | None,
) -> tuple[Built, dict[str, Any]]:
    """How likely poses (n,) in the object frame are under the density of the successes, and that density.

    Columns (n,) in the poses' order, by their names in an answer: those asked for and known. ``log_density``
    is minus infinity where the density is exactly zero; NaN stands for not known.
    """
    count = len(poses)
    if count > ctx.settings.max_query_poses:
        raise ProblemError(
            413,
            "too-many-poses",
            f"{count} poses are over the limit of {ctx.settings.max_query_poses}: send several requests",
            errors=[("poses", f"at most {ctx.settings.max_query_poses}")],
        )
    _, cutoff = kernel_of(request)

    def asked(*names: str) -> bool:
        return include is None or any(name in include for name in names)

    with ctx.compute.admitted():
        built = ctx.densities.requested(slug, request)
        columns: dict[str, Any] = {}
        free, threads = None, ctx.compute.threads
        if asked("density", "log_density", "relative"):
            search, relative = built.search, np.zeros(count)
            logs = np.full(count, -np.inf)
            if search is not None:
                logs = log_density(ctx, search.density, poses, cutoff)
                if asked("relative"):
                    relative = ctx.compute.run(partial(search.relative, logs, threads))
            density = np.exp(logs) if asked("density") else None
            columns |= {"density": density, "log_density": logs, "relative": relative}
        chances = asked("success_probability", "interval", "effective_trials")
        if chances or asked("collision_free"):
            test = ctx.scenes.test(built.selected)
            if test is not None:
                free = np.concatenate(ctx.compute.blocks(poses, partial(test.free, threads=threads)))
        if chances:
            model = ctx.successes.model(built, collisions_known=free is not None)
            estimate = ctx.successes.estimate(model, poses, free)
            columns["success_probability"] = estimate.probability
            columns["interval"] = {"level": estimate.level, "low": estimate.low, "high": estimate.high}
            columns["effective_trials"] = estimate.effective_trials
        columns["collision_free"] = free
    return built, {name: column for name, column in columns.items() if column is not None and asked(name)}


def log_density(ctx: Estimators, density: SearchedDensity, poses: Poses, cutoff: float | None) -> Floats:
    """Log densities (n,) of poses, computed in blocks."""
    work = partial(density.log_density, cutoff=cutoff, threads=ctx.compute.threads)
    return np.concatenate(ctx.compute.blocks(poses, work))

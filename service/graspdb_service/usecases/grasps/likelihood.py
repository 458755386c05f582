"""How likely poses are: the density there, the success probability, whether the gripper collides."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from graspdb.wire import CalibrationInfo, EstimatorInfo, ReachInfo, SymmetryInfo
from graspdb.wire.queries import LikelihoodColumn, LikelihoodOptions, LikelihoodQuery, PreOpening
from graspdb_density.kde.density import SearchedDensity
from graspdb_density.se3 import Poses
from graspdb_service.problems import ProblemError
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.cache import kernel_of
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.densities.evidence.calibrations import calibrated, of_simulation
from graspdb_service.usecases.densities.success_models import LEVEL
from graspdb_service.usecases.densities.support import reach_info, support_columns
from graspdb_service.usecases.trials.pose_frames import PoseFrame, frame_of

#: Columns that take a model of the attempts.
CHANCES = (
    "success_probability",
    "interval",
    "effective_trials",
    "support",
    "prior_success_probability",
)


class Likelihood(NamedTuple):
    """An answer: the density, the frame that poses were of, how far from an attempt success probabilities are
    told, how they were calibrated and shared by symmetry, who estimated them, and the columns.
    """

    built: Built
    frame: PoseFrame
    reach: ReachInfo | None
    calibration: CalibrationInfo | None
    symmetry: SymmetryInfo | None
    estimator: EstimatorInfo
    columns: dict[str, Any]


def likelihood(
    ctx: Estimators,
    slug: str,
    request: LikelihoodOptions | LikelihoodQuery,
    poses: Poses,
    include: Collection[LikelihoodColumn] | None,
) -> Likelihood:
    """How likely poses (n,) in the object frame are under the density of the successes.

    Columns (n,) in the poses' order, by their names in an answer: those asked for and known. ``log_density``
    is minus infinity where the density is exactly zero; NaN stands for not known.
    """
    _refuse_many(ctx, len(poses))
    _, cutoff = kernel_of(request)
    request = of_simulation(request)
    source: str | None = getattr(request, "calibrated_for", None)
    pre_opening_m: PreOpening = getattr(request, "pre_opening_m", None)
    calibration = symmetry = None
    estimator = EstimatorInfo()

    def asked(*names: str) -> bool:
        return include is None or any(name in include for name in names)

    columns: dict[str, Any] = {}
    free = test = reach = None
    with ctx.compute.within(request):
        built, threads = ctx.densities.requested(slug, request), ctx.compute.threads
        frame = frame_of(built.selected, request.frame, request.convention)
        poses = frame.to_tool(poses)
        if asked("density", "log_density", "relative"):
            columns |= _densities(ctx, built, poses, cutoff, relative=asked("relative"))
        chances = asked(*CHANCES)
        if chances or asked("collision_free"):
            test = ctx.scenes.test(built.selected, pre_opening_m)
            if test is not None:
                free = np.concatenate(ctx.compute.blocks(poses, partial(test.free, threads=threads)))
        if chances:
            believed = ctx.evidence.believed(built)
            believed = None if believed is None else believed.preshaped(pre_opening_m)
            model = ctx.successes.model(built, collisions_known=believed is not None)
            model, symmetry = ctx.symmetries.applied(request, built, model)
            if model is not None and source is not None:
                model, calibration = calibrated(ctx, built, model, believed, source)
            reach = reach_info(model)
            estimator = estimator if model is None else model.estimator
            estimates = ctx.successes.estimate(model, poses, None if believed is None else free)
            columns["success_probability"] = estimates.probability
            columns["interval"] = {"level": LEVEL, "low": estimates.low, "high": estimates.high}
            columns["effective_trials"] = estimates.effective_trials
            columns["support"] = support_columns(estimates)
            untried = ctx.successes.untried(built.selected, believed)
            if untried is not None and asked("prior_success_probability"):
                estimator = estimator.model_copy(update={"prior": untried.info})
                columns["prior_success_probability"] = untried.told(poses, ~estimates.enough, free, model)
        columns["collision_free"] = free
        known = {name: column for name, column in columns.items() if column is not None and asked(name)}
        if test is not None and pre_opening_m is not None:
            blocks = ctx.compute.blocks(poses, partial(test.openings, threads=threads))
            known["opening_m"] = np.concatenate(blocks)
    return Likelihood(built, frame, reach, calibration, symmetry, estimator, known)


def _densities(
    ctx: Estimators, built: Built, poses: Poses, cutoff: float | None, *, relative: bool
) -> dict[str, Floats]:
    """Columns of the density of successes at poses (n,), the relative one where it is asked for."""
    search, ranks, logs = built.search, np.zeros(len(poses)), np.full(len(poses), -np.inf)
    if search is not None:
        logs = log_density(ctx, search.density, poses, cutoff)
        if relative:
            ranks = ctx.compute.run(partial(search.relative, logs, ctx.compute.threads))
    return {"density": np.exp(logs), "log_density": logs, "relative": ranks}


def _refuse_many(ctx: Estimators, count: int) -> None:
    """413 for more poses than the service allows."""
    if count > ctx.settings.max_query_poses:
        raise ProblemError(
            413,
            "too-many-poses",
            f"{count} poses are over the limit of {ctx.settings.max_query_poses}: send several requests",
            errors=[("poses", f"at most {ctx.settings.max_query_poses}")],
        )


def log_density(ctx: Estimators, density: SearchedDensity, poses: Poses, cutoff: float | None) -> Floats:
    """Log densities (n,) of poses, computed in blocks."""
    work = partial(density.log_density, cutoff=cutoff, threads=ctx.compute.threads)
    return np.concatenate(ctx.compute.blocks(poses, work))

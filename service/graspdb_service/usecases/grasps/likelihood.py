"""Questions to a density: what it is, how likely poses are, which grasp is best, draws from it."""

from __future__ import annotations

import secrets
from collections.abc import Collection
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import (
    DensityInfo,
    KernelInfo,
    Selection,
)
from graspdb.wire.queries import LikelihoodColumn
from graspdb_density import GraspDensity, MixtureDensity, se3
from graspdb_density.kde.importance_weights import LOW_EFFECTIVE_SHARE
from graspdb_service.problems import ProblemError, conflict
from graspdb_service.usecases.densities.cache import Built, kernel_of
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.trials.selection import Filters

Floats = NDArray[np.float64]

#: Poses a computation takes at a time, so that short questions get between the blocks of a long one.
_BLOCK = 16_384
_NEAREST_TRIALS = 5
#: Successes shown to the collision test at a time while looking for the nearest admissible one.
_CANDIDATES = 1_024
#: Ratios and draws see more of the kernels' tails than a plain question.
_PRECISE_CUTOFF = 5.0


def built_for(ctx: Estimators, slug: str, request: Selection) -> Built:
    """The density that a request is about."""
    choice, _ = kernel_of(request)
    return ctx.densities.get(slug, Filters.of(request), choice)


# -- the density itself ------------------------------------------------------------------------------------


def density_info(ctx: Estimators, slug: str, request: Selection) -> tuple[DensityInfo, int]:
    """What is known of a density, and the object's internal id."""
    with ctx.compute.admitted():
        built = built_for(ctx, slug, request)
    density, selected = built.density, built.selected
    size = 0 if density is None else density.size
    effective = 0.0 if density is None else density.effective_sample_size
    warnings = []
    if size and effective < LOW_EFFECTIVE_SHARE * size:
        warnings.append(
            f"the weights are very uneven: {size} successes count like {effective:.0f};"
            " check the proposal densities of the trials"
        )
    info = DensityInfo(
        object=slug,
        revision=built.revision,
        epoch=built.epoch,
        gripper=selected.gripper,
        protocol=selected.protocol,
        source=selected.source,
        kernel=built.kernel,
        size=size,
        outcomes=dict(selected.outcomes),
        effective_sample_size=effective,
        weights=built.weights_info,
        bytes=built.nbytes,
        warnings=warnings,
    )
    return info, built.object_row.id


# -- likelihood ----------------------------------------------------------------------------------------------


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


def likelihood(
    ctx: Estimators,
    slug: str,
    request: Selection,
    positions: Floats,
    quaternions: Floats,
    include: Collection[LikelihoodColumn] | None,
) -> LikelihoodAnswer:
    """How likely poses (n, 3), (n, 4) in the object frame are under the density of the successes."""
    count = len(positions)
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
        built = built_for(ctx, slug, request)
        logs = relative = free = None
        if asked("density", "log_density", "relative"):
            search = built.search
            if search is None:
                logs, relative = np.full(count, -np.inf), np.zeros(count)
            else:
                logs = _log_density(ctx, search.density, positions, quaternions, cutoff)
                if asked("relative"):
                    relative = ctx.compute.run(partial(search.relative, logs, ctx.compute.threads))
        chances = asked("success_probability", "interval", "effective_trials")
        if chances or asked("collision_free"):
            test = ctx.scenes.test(built.object_row, built.selected)
            if test is not None:
                free = _free(ctx, test, positions, quaternions)
        estimates = ctx.successes.estimate(slug, built, positions, quaternions, free) if chances else None
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


def _log_density(
    ctx: Estimators,
    density: GraspDensity | MixtureDensity,
    positions: Floats,
    quaternions: Floats,
    cutoff: float | None,
) -> Floats:
    logs = np.empty(len(positions))
    threads = ctx.compute.threads

    def work(part: slice) -> None:
        p, q = positions[part], quaternions[part]
        if isinstance(density, GraspDensity):
            logs[part] = density.log_density(se3.Poses.of(p, q), cutoff=cutoff, threads=threads)
        else:
            # It sums whatever matters, however far.
            logs[part] = density.log_density(se3.Poses.of(p, q), threads=threads)

    ctx.compute.blocks(len(positions), _BLOCK, work)
    return logs


def _free(ctx: Estimators, test: CollisionTest, positions: Floats, quaternions: Floats) -> NDArray[np.bool_]:
    free = np.empty(len(positions), dtype=bool)

    def work(part: slice) -> None:
        free[part] = test.free(positions[part], quaternions[part], threads=ctx.compute.threads)

    ctx.compute.blocks(len(positions), _BLOCK, work)
    return free


# -- samples -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Draw:
    """Poses (n, 3), (n, 4) drawn from a density, and the density (n,) they were drawn with."""

    object_id: int
    revision: int
    kernel: KernelInfo
    seed: int
    position: Floats
    quaternion_xyzw: Floats
    proposal_density: Floats


def draw(ctx: Estimators, slug: str, selection: Selection, count: int, seed: int | None) -> Draw:
    """Draw grasps; the same revision, selection, kernel, count and seed give the same ones.

    Without a seed one is made up, and answered. 413 over the limit; 409 ``no-successes`` without any.
    """
    check_count(ctx, count)
    chosen = secrets.randbits(63) if seed is None else seed
    with ctx.compute.admitted():
        built = built_for(ctx, slug, selection)
        density = built.asked
        if density is None:
            raise no_successes(slug)
        position, quaternion = ctx.compute.run(lambda: density.sample(count, np.random.default_rng(chosen)))
        densities = density_at(ctx, density, position, quaternion)
    return Draw(
        object_id=built.object_row.id,
        revision=built.revision,
        kernel=built.kernel,
        seed=chosen,
        position=position,
        quaternion_xyzw=se3.canonical(quaternion),
        proposal_density=densities,
    )


def check_count(ctx: Estimators, count: int) -> None:
    """413 for more draws than the service allows."""
    limit = ctx.settings.max_samples
    if count > limit:
        raise ProblemError(
            413,
            "too-many-samples",
            f"{count} samples are over the limit of {limit}: draw them in several requests with other seeds",
            errors=[("count", f"at most {limit}")],
        )


def no_successes(slug: str) -> ProblemError:
    """409 where there is nothing to draw from."""
    return conflict(
        "no-successes",
        "No trial of this selection succeeded, so there is no density to draw from:"
        f" post trials (POST /objects/{slug}/trials) or sweep a grid first",
    )


def density_at(
    ctx: Estimators, density: GraspDensity | MixtureDensity, positions: Floats, quaternions: Floats
) -> Floats:
    """The density (n,) at draws from it."""
    return np.exp(_log_density(ctx, density, positions, quaternions, _PRECISE_CUTOFF))

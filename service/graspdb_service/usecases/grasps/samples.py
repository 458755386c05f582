"""Grasps drawn from a density, with the density they were drawn with: sent back, it weights them."""

from __future__ import annotations

import secrets
from dataclasses import dataclass

import numpy as np

from graspdb.wire import KernelInfo, Selection
from graspdb_density import se3
from graspdb_density.kde.density import SearchedDensity
from graspdb_service.problems import ProblemError, conflict
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.grasps.likelihood import log_density

#: Draws see more of the kernels' tails than a plain question.
_CUTOFF = 5.0


@dataclass(frozen=True, eq=False)
class Draw:
    """Poses (n, 3), (n, 4) drawn from a density, and the density (n,) they were drawn with."""

    revision: int
    kernel: KernelInfo
    seed: int
    position: Floats
    quaternion_xyzw: Floats
    proposal_density: Floats


def draw(ctx: Estimators, slug: str, selection: Selection, count: int, seed: int | None) -> Draw:
    """Draw grasps; the same revision, selection, kernel, count and seed (None: made up) give the same ones.

    413 over the limit; 409 ``no-successes`` where there is nothing to draw from; as the selection.
    """
    check_count(ctx, count)
    with ctx.compute.admitted():
        built = ctx.densities.requested(slug, selection)
        if built.asked is None:
            raise no_successes(slug)
        return drawn_from(ctx, built.asked, built.object_row, built.kernel, count, seed)


def drawn_from(
    ctx: Estimators,
    density: SearchedDensity,
    row: ObjectRow,
    kernel: KernelInfo,
    count: int,
    seed: int | None,
) -> Draw:
    """Draws from a density of an object as it was at a revision."""
    chosen = secrets.randbits(63) if seed is None else seed
    poses = ctx.compute.run(lambda: density.sample(count, np.random.default_rng(chosen)))
    return Draw(
        revision=row.revision,
        kernel=kernel,
        seed=chosen,
        position=poses.positions,
        quaternion_xyzw=se3.canonical(poses.quaternions_xyzw),
        proposal_density=np.exp(log_density(ctx, density, poses, _CUTOFF)),
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

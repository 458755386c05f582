"""Grasps drawn from a density, with the density they were drawn with: sent back, it weights them."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graspdb.wire import EstimatorInfo, KernelInfo, Selection, SymmetryInfo
from graspdb_density import se3
from graspdb_density.kde.density import SearchedDensity
from graspdb_service.problems import ProblemError, conflict
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.densities.support import support_columns
from graspdb_service.usecases.grasps.likelihood import log_density
from graspdb_service.usecases.grasps.question import FEW_ATTEMPTS
from graspdb_service.usecases.trials.pose_frames import PoseFrame
from graspdb_service.usecases.trials.selection import Selected

#: Draws see more of the kernels' tails than a plain question.
_CUTOFF = 5.0


@dataclass(frozen=True, eq=False)
class Draw:
    """Poses (n, 3), (n, 4) drawn from a density, and the density (n,) they were drawn with; ``built`` are the
    object's trials.

    ``selected`` are the trials that it is about; ``support``: columns of how far the draws are from what was
    tried, where attempts tell and it was asked; ``prior``: geometry drew them, no trial. ``opening_m`` (n,)
    is how far open the jaw comes to each, where that was asked; ``symmetry`` what shares attempts;
    ``expected_gain`` (n,) what the best grasp gains by each, where they were chosen by that; ``estimator``
    told the success probabilities that chose them.
    """

    built: Built
    kernel: KernelInfo
    seed: int
    position: Floats
    quaternion_xyzw: Floats
    proposal_density: Floats
    support: dict[str, Any] | None = None
    prior: bool = False
    opening_m: Floats | None = None
    symmetry: SymmetryInfo | None = None
    expected_gain: Floats | None = None
    estimator: EstimatorInfo = field(default_factory=EstimatorInfo)

    @property
    def selected(self) -> Selected:
        return self.built.selected

    def columns(self, frame: PoseFrame) -> dict[str, Any]:
        """Those of an answer, by name, the poses of a frame."""
        position, quaternion = frame.from_tool(se3.Poses(self.position, self.quaternion_xyzw))
        known = [name for name in ("opening_m", "expected_gain") if getattr(self, name) is not None]
        names = ["proposal_density", "support", *known]
        rest = {name: getattr(self, name) for name in names}
        return {"position": position, "quaternion_xyzw": quaternion, **rest}


def draw(
    ctx: Estimators,
    slug: str,
    selection: Selection,
    count: int,
    seed: int | None,
    *,
    support: bool = True,
) -> Draw:
    """Draw grasps; the same revision, selection, kernel, count and seed (None: made up) give the same ones.

    ``support``: whether it is told how far they are from what was tried.

    413 over the limit; 409 ``no-successes`` where there is nothing to draw from; as the selection.
    """
    check_count(ctx, count)
    with ctx.compute.within(selection):
        built = ctx.densities.requested(slug, selection)
        if built.asked is None:
            raise no_successes(slug)
        asking = selection if support else None
        return drawn_from(ctx, built.asked, built, built.kernel, count, seed, asking)


def drawn_from(
    ctx: Estimators,
    density: SearchedDensity,
    built: Built,
    kernel: KernelInfo,
    count: int,
    seed: int | None,
    asking: Selection | None,
    *,
    prior: bool = False,
) -> Draw:
    """Draws from a density of an object as it was at a revision; ``built`` are its trials. Without ``asking``
    (the request) it is not told how far they are from those.
    """
    chosen = seed_of(seed)
    poses = ctx.compute.run(lambda: density.sample(count, np.random.default_rng(chosen)))
    return told_of(ctx, density, poses, built, kernel, chosen, asking, prior=prior)


def seed_of(seed: int | None) -> int:
    """The seed that was asked for, else one that is made up."""
    return secrets.randbits(63) if seed is None else seed


def told_of(
    ctx: Estimators,
    density: SearchedDensity,
    poses: se3.Poses,
    built: Built,
    kernel: KernelInfo,
    seed: int,
    asking: Selection | None,
    *,
    prior: bool = False,
) -> Draw:
    """As :func:`drawn_from`, of poses that were drawn from the density already, by a seed."""
    support, symmetry = (None, None) if asking is None else _support(ctx, built, poses, asking)
    return Draw(
        built=built,
        kernel=kernel,
        seed=seed,
        position=poses.positions,
        quaternion_xyzw=se3.canonical(poses.quaternions_xyzw),
        proposal_density=np.exp(log_density(ctx, density, poses, _CUTOFF)),
        support=support,
        prior=prior,
        symmetry=symmetry,
    )


def _support(
    ctx: Estimators, built: Built, poses: se3.Poses, asking: Selection
) -> tuple[dict[str, Any] | None, SymmetryInfo | None]:
    """How far draws are from what was tried, also by symmetry; None without attempts, and with too many to
    read at once.
    """
    if sum(built.selected.outcomes.values()) > FEW_ATTEMPTS:
        return None, None
    known = ctx.evidence.believed(built) is not None
    model = ctx.successes.model(built, collisions_known=known)
    model, symmetry = ctx.symmetries.applied(asking, built, model)
    support = None if model is None else support_columns(ctx.successes.support(model, poses))
    return support, symmetry


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

"""Which grasps to try next, drawn so that their successes can be weighted.

Every strategy draws from a density that integrates to 1 over R^3 x SO(3), both twins of a symmetric jaw, and
tells it at each draw: sent back with the trial, it undoes the choice (eq 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from graspdb.wire import ProposalsRequest
from graspdb.wire.queries import Strategy
from graspdb_density import GraspDensity, IsotropicKernel, SuccessModel, se3
from graspdb_density.se3 import Poses
from graspdb_density.success.kernel_regression import PRIOR_TRIALS
from graspdb_service.problems import conflict, invalid
from graspdb_service.usecases.densities.build import KernelChoice
from graspdb_service.usecases.densities.cache import kernel_of
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.grasps import samples
from graspdb_service.usecases.grasps.admissible import NearSuccesses
from graspdb_service.usecases.grasps.improvement import improving, refuse_bounds
from graspdb_service.usecases.grasps.samples import Draw

#: Poses whose uncertainty is asked for.
_PLACES = 2_048
#: They are drawn from the density of successes with a kernel this much wider, to reach its fringes, ...
_WIDER = 2.0
#: ... and kept within so many standard deviations of a success: beyond, nothing tells how little is known.
_REACH = 3.0
#: Width of the kernels drawn from, as a share of the density's own.
_NARROWER = 0.5

CRITERIA: dict[Strategy, str] = {
    "density": "draws from the density of successes",
    "uncertainty": (
        "where one more trial is expected to lower the posterior variance of the success probability most,"
        " P (1 - P) / (n + 2)^2 for n effective trials, times the density of successes under a kernel twice"
        " as wide; poses that collide are left out"
    ),
    "edges": (
        "about grasps that close on opposed surfaces, edges or points, at any angle about the closing axis,"
        " without those at which the open gripper collides; the draws themselves are not tested, and some"
        " collide"
    ),
    "expected_improvement": (
        "about grasps of which more knowledge is expected to raise the success probability of the best grasp"
        " within the bounds most, one after the other, those before taken as tried; draws are from kernels a"
        " fifth as wide as the one that tells of success, and some may collide or leave the bounds by as much"
    ),
}


def propose(ctx: Estimators, slug: str, request: ProposalsRequest) -> tuple[Draw, str]:
    """Poses to try next, and how they were chosen; the same revision, request and seed give the same ones.

    409 without what the strategy needs; as :func:`graspdb_service.usecases.grasps.samples.draw`.
    """
    if request.strategy != "expected_improvement":
        refuse_bounds(request)
    if request.strategy == "density":
        drawn = samples.draw(ctx, slug, request, request.count, request.seed)
    else:
        samples.check_count(ctx, request.count)
        drawn = _DRAWN[request.strategy](ctx, slug, request)
    return _preshaped(ctx, request, drawn), CRITERIA[request.strategy]


def _preshaped(ctx: Estimators, request: ProposalsRequest, drawn: Draw) -> Draw:
    """The draws with how far open the jaw comes to each, where that was asked."""
    asked = request.pre_opening_m
    if asked is None:
        return drawn
    poses = Poses(drawn.position, drawn.quaternion_xyzw)
    with ctx.compute.within(request):
        test = ctx.scenes.test(drawn.selected, asked)
        if test is None:
            return replace(drawn, opening_m=np.full(len(poses), float(asked)))
        found = ctx.compute.blocks(poses, partial(test.openings, threads=ctx.compute.threads))
    return replace(drawn, opening_m=np.concatenate(found))


def _uncertain(ctx: Estimators, slug: str, request: ProposalsRequest) -> Draw:
    with ctx.compute.within(request):
        built = ctx.densities.requested(slug, request)
        density = built.density
        if density is None:
            raise samples.no_successes(slug)
        test = ctx.scenes.test(built.selected, request.pre_opening_m)
        model = ctx.successes.model(built, collisions_known=ctx.evidence.believed(built) is not None)
        model, _ = ctx.symmetries.applied(request, built, model)
        if model is None:
            raise conflict(
                "no-attempts",
                "Only successes are known, so nothing tells where a trial would teach most:"
                " post failures, too, or use strategy=density",
            )
        quick, threads = model.quick, ctx.compute.threads
        proposal = ctx.compute.run(lambda: uncertain(density, quick, test, threads=threads))
        if proposal is None:
            raise conflict(
                "nothing-uncertain",
                "Every pose near the successes collides or is known: use strategy=density, or sweep a grid",
            )
        return samples.drawn_from(ctx, proposal, built, built.kernel, request.count, request.seed, request)


def _from_edges(ctx: Estimators, slug: str, request: ProposalsRequest) -> Draw:
    """Draws from the prior: no trial is needed, nor does any change it."""
    choice, _ = kernel_of(request)
    if choice.stored is not None:
        raise invalid("kernel", "strategy=edges takes the isotropic kernel: leave it out, or give its widths")
    with ctx.compute.within(request):
        selected = ctx.densities.selections.resolve(slug, request)
        prior = ctx.priors.get(selected, choice, request.pre_opening_m)
        built = ctx.densities.get(selected, KernelChoice())
        return samples.drawn_from(
            ctx, prior.density, built, prior.kernel, request.count, request.seed, request, prior=True
        )


_DRAWN: dict[Strategy, Callable[[Estimators, str, ProposalsRequest], Draw]] = {
    "uncertainty": _uncertain,
    "edges": _from_edges,
    "expected_improvement": improving,
}


def uncertain(
    density: GraspDensity, model: SuccessModel, test: CollisionTest | None, *, threads: int = 1
) -> GraspDensity | None:
    """A density to draw trials from that teach most; None where nothing is left to learn.

    The success probability P at a pose is that of a Beta distribution worth nu = a + n trials, whose variance
    P (1 - P) / (nu + 1) one more trial is expected to lower by the share 1 / (nu + 1).
    """
    kernel = density.kernel
    rng = np.random.default_rng(0)
    extra = math.sqrt(_WIDER**2 - 1.0)
    p, q = density.sample(_PLACES, rng)
    p = p + rng.standard_normal(p.shape) * extra * kernel.sigma_position_m
    turns = se3.from_rotation_vector(rng.standard_normal(p.shape) * extra * kernel.sigma_rotation)
    poses = Poses(p, se3.multiply(q, turns))
    kept = NearSuccesses(density, _REACH)(poses)
    if test is not None:
        kept &= test.free(poses, threads=threads)
    poses = poses[kept]
    if not len(poses):
        return None
    found = model.evaluate(poses, threads=threads)
    trials = PRIOR_TRIALS + found.effective_trials
    gain = found.probability * (1.0 - found.probability) / (trials + 1.0) ** 2
    # Weights are told apart in float32.
    taught = gain > 1e-6 * gain.max(initial=0.0)
    if not taught.any():
        return None
    narrow = IsotropicKernel(_NARROWER * kernel.sigma_position_m, _NARROWER * kernel.sigma_rotation)
    symmetric = bool(density.symmetric.all())
    return GraspDensity.build(poses[taught], kernel=narrow, weights=gain[taught], symmetric=symmetric)

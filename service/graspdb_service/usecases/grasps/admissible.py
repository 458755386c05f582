"""Which poses a question admits, beyond what a region says: collisions, widths, what is known nearby."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from graspdb_density import GraspDensity, se3
from graspdb_density.se3 import Poses
from graspdb_density.search.scored_poses import Admissible
from graspdb_geometry.grippers import GripperShape
from graspdb_geometry.openings import STEP_M, at_each
from graspdb_geometry.poses import PoseArrays
from graspdb_service.trial_columns import Bools
from graspdb_service.usecases.densities.learned.learning import Model
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.grasps.constraints import Constraints
from graspdb_service.usecases.runtime.compute import breathing

#: A chance is told within so many standard deviations of a success, position and rotation together. Farther
#: out all kernels are tails, whose ratio is no smaller for it: a few far successes would promise anything.
_NEAR = 2.0


def all_of(checks: Sequence[Admissible]) -> Admissible | None:
    """Whether poses pass every check, the first ones first: those that fail it see no other."""
    if not checks:
        return None

    def admissible(poses: Poses) -> Bools:
        left = np.arange(len(poses))
        for check in checks:
            if len(left):
                left = left[check(poses[left])]
        allowed = np.zeros(len(poses), dtype=np.bool_)
        allowed[left] = True
        return allowed

    return breathing(admissible, "testing poses")


def clear_of(
    limits: Constraints, jaw: GripperShape, test: CollisionTest | None, distance: float, threads: int
) -> Admissible:
    """Whether the gripper touches no obstacle, all along an approach of this length.

    It is as far open as a collision test has it, or as ``jaw`` where there is none. Tips that move on arcs
    come closer while it closes, and must be clear of obstacles, too, once they touch the object.
    """

    def free(shape: GripperShape, poses: PoseArrays, retreat_m: float = 0.0) -> Bools:
        hit = np.zeros(len(np.asarray(poses.positions)), dtype=np.bool_)
        for solid in limits.obstacles:
            hit |= solid.collides(poses, shape, threads=threads, retreat_m=retreat_m)
        return ~hit

    def clear(poses: Poses) -> Bools:
        if test is None:
            return free(jaw, poses, distance)
        clear = test.with_jaw(poses, partial(free, retreat_m=distance), threads)
        rows = np.flatnonzero(clear)
        if jaw.tip_offsets and rows.size:
            widths = test.widths(poses[rows], threads)
            closed = np.floor(widths / STEP_M) * STEP_M
            rows, closed = rows[~np.isnan(widths)], closed[~np.isnan(widths)]
            clear[rows] = at_each(closed, poses[rows], jaw, free)
        return clear

    return clear


def likely_enough(model: Model, probability: float, trials: float, threads: int) -> Admissible:
    """Whether poses have a success probability, at least so high and from at least so many effective trials.

    Of those that collide nothing is asked: what may collide has failed another check, or is wanted.
    """

    def likely(poses: Poses) -> Bools:
        chances, worth, nearest = model.whole.without_interval(poses, threads=threads)
        return np.asarray((chances >= probability) & (worth >= trials) & model.reach.covers(nearest))

    return likely


@dataclass(frozen=True, eq=False)
class NearSuccesses:
    """Whether some success is within so many standard deviations, position and rotation together."""

    density: GraspDensity
    reach: float = _NEAR

    def __call__(self, poses: Poses) -> Bools:
        _, distance = self.density.nearest_each(poses, within=self.reach)
        return np.asarray(distance <= self.reach)

    def pull(self, poses: Poses) -> Poses:
        """Poses a little farther from a success moved straight towards it as far as the reach."""
        density, reach = self.density, self.reach * (1.0 - 1e-4)
        rows, distance = density.nearest_each(poses, within=1.5 * self.reach)
        far = np.flatnonzero((distance > reach) & (rows >= 0))
        if not len(far):
            return poses
        positions, quaternions = poses
        p, q = positions.copy(), quaternions.copy()
        rows = rows[far]
        centre, to = density.positions[rows], density.quaternions_xyzw[rows]
        # The end of the success's rotation, of its twin's and of both antipodes that is nearest.
        twin = se3.jaw_twin(to)
        own, other = (np.einsum("ij,ij->i", end, q[far]) for end in (to, twin))
        turned = density.symmetric[rows] & (np.abs(other) > np.abs(own))
        to = np.where(turned[:, None], twin, to) * np.sign(np.where(turned, other, own))[:, None]
        kernel = density.kernel
        share = np.ones(len(far))
        for _ in range(3):
            at = centre + share[:, None] * (positions[far] - centre)
            mixed = se3.normalise(to + share[:, None] * (quaternions[far] - to))
            squared = np.sum((at - centre) ** 2, axis=1) / kernel.sigma_position_m**2
            squared += 2.0 * kernel.kappa * (1.0 - np.einsum("ij,ij->i", mixed, to))
            share *= np.minimum(reach / np.sqrt(np.maximum(squared, 1e-12)), 1.0)
        p[far] = centre + share[:, None] * (positions[far] - centre)
        q[far] = se3.normalise(to + share[:, None] * (quaternions[far] - to))
        return Poses(p, q)

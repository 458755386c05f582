"""The paper's sampled kernel (eq 5 and 6): a sum of isotropic kernels at displacements from a grasp.

A template of C displacements, drawn from measured statistics, is placed at every row; so a density of N rows
is one of N C isotropic components and costs that much more than one Gaussian. It follows any shape and is
what fitted mixtures are measured against; the number of components is limited.

A symmetric jaw and its turn are one grasp: the template is placed at a row and at its turn, and every
component has its own twin, so that neither the row's nor the pose's orientation of the jaw matters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..kernels.isotropic import IsotropicKernel
from ..se3 import Poses
from .isotropic import GraspDensity
from .rows import Rows

__all__ = ["MOST_COMPONENTS", "SampledKernel"]

#: Most isotropic components a density of sampled kernels may have: some 200 MB.
MOST_COMPONENTS = 2_000_000


class SampledKernel:
    """Isotropic components at displacements from a grasp, in the gripper's frame.

    Parameters
    ----------
    displacements : (C)
        Along the gripper's axes, and turns in its frame.
    component
        Width of every component.
    weights : (C,) positive, normalised here

    Raises
    ------
    ValueError
        For no component, wrong shapes, or weights that are not positive and finite.
    """

    def __init__(self, displacements: Poses, component: IsotropicKernel, weights: ArrayLike) -> None:
        if not len(displacements):
            raise ValueError("a sampled kernel needs at least one component")
        self.displacements, self.component = displacements, component
        given = Rows.of(displacements, weights).weights
        self.weights = given / given.sum()

    @property
    def size(self) -> int:
        """Components."""
        return len(self.displacements)

    def placed(
        self,
        poses: Poses,
        *,
        weights: ArrayLike | None = None,
        symmetric: ArrayLike | bool = True,
    ) -> GraspDensity:
        """The density of grasps under this kernel (eq 6), with all that a `GraspDensity` can do.

        Its rows are the components; extend it by what `placed` makes of further grasps. More than
        `MOST_COMPONENTS` are the caller's to refuse.

        Raises
        ------
        ValueError
            As `GraspDensity.build`.
        """
        if not len(poses):
            raise ValueError("a density needs at least one grasp")
        rows = Rows.of(poses, weights, symmetric)
        flags = rows.symmetric
        # A symmetric row's template stands at the row and at its turn, half of the weight each.
        at, to = Poses.concatenate([poses, poses[flags].turned()])
        share = np.concatenate([rows.twin_weights, rows.twin_weights[flags]])
        twin = np.concatenate([flags, flags[flags]])
        moved, turned = se3.compose(Poses(at[:, None], to[:, None]), self.displacements)
        return GraspDensity.build(
            Poses(moved.reshape(-1, 3), se3.normalise(turned.reshape(-1, 4))),
            kernel=self.component,
            weights=(share[:, None] * self.weights).reshape(-1),
            symmetric=np.repeat(twin, self.size),
        )

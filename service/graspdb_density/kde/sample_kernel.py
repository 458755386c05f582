"""The paper's sampled kernel (eq 5 and 6): a sum of isotropic kernels at displacements from a grasp.

A template of C displacements, drawn from measured statistics, is placed at every row; so a density of N rows
is one of N C isotropic components and costs that much more than one Gaussian. It follows any shape and is
what fitted mixtures are measured against; the number of components is limited.

A symmetric jaw and its turn are one grasp: the template is placed at a row and at its turn, and every
component has its own twin, so that neither the row's nor the pose's orientation of the jaw matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..kernels.isotropic import IsotropicKernel
from ..se3 import Floats, Poses
from .isotropic import GraspDensity
from .rows import Rows

__all__ = ["MOST_COMPONENTS", "SampledKernel"]

#: Most isotropic components a density of sampled kernels may have: some 200 MB.
MOST_COMPONENTS = 2_000_000


@dataclass(frozen=True, eq=False)
class SampledKernel:
    """Isotropic components at displacements from a grasp, in the gripper's frame.

    Parameters
    ----------
    translations : (C, 3) metres, along the gripper's axes
    quaternions_xyzw : (C, 4) turns, in the gripper's frame
    component
        Width of every component.
    weights : (C,) positive, normalised here; None: equal

    Raises
    ------
    ValueError
        For no component, wrong shapes, values that are not finite, or weights that are not positive.
    """

    translations: Floats
    quaternions_xyzw: Floats
    component: IsotropicKernel
    weights: Floats | None = None

    def __post_init__(self) -> None:
        t, q = Poses.of(self.translations, self.quaternions_xyzw)
        if not len(t):
            raise ValueError("a sampled kernel needs at least one component")
        w = Rows.of(Poses(t, q), self.weights).weights
        object.__setattr__(self, "translations", t)
        object.__setattr__(self, "quaternions_xyzw", q)
        object.__setattr__(self, "weights", w / w.sum())

    @property
    def size(self) -> int:
        """Components."""
        return len(self.translations)

    @property
    def shares(self) -> Floats:
        """Weights (C,), summing to 1."""
        assert self.weights is not None
        return self.weights

    def log_kernel(self, displacements: Poses) -> Floats:
        """Log density at displacements (M): eq 5, nats of 1/(m^3 rad^3), integrating to 1."""
        template = GraspDensity.build(
            Poses(self.translations, self.quaternions_xyzw),
            kernel=self.component,
            weights=self.weights,
            symmetric=False,
        )
        return template.log_density(displacements, cutoff=None)

    def sample_displacements(self, count: int, rng: np.random.Generator) -> Poses:
        """Draw displacements."""
        which = rng.choice(self.size, size=count, p=self.shares)
        move, turn = self.component.sample_displacements(count, rng)
        return Poses(self.translations[which] + move, se3.multiply(self.quaternions_xyzw[which], turn))

    def placed(
        self,
        poses: Poses,
        *,
        weights: ArrayLike | None = None,
        symmetric: ArrayLike | bool = True,
    ) -> GraspDensity:
        """The density of grasps under this kernel (eq 6), with all that a `GraspDensity` can do.

        Its rows are the components; extend it by what `placed` makes of further grasps.

        Raises
        ------
        ValueError
            As `GraspDensity.build`, and for more than `MOST_COMPONENTS` components.
        """
        if not len(poses):
            raise ValueError("a density needs at least one grasp")
        rows = Rows.of(poses, weights, symmetric)
        flags = rows.symmetric
        many = self.size * (len(poses) + int(flags.sum()))
        if many > MOST_COMPONENTS:
            raise ValueError(
                f"{len(poses)} grasps of {self.size} components each, those of symmetric jaws twice, are "
                f"{many}: more than {MOST_COMPONENTS}; fit a mixture of a few, or take fewer grasps or "
                "components"
            )
        # A symmetric row's template stands at the row and at its turn, half of the weight each.
        at, to = Poses.concatenate([poses, poses[flags].turned()])
        share = np.concatenate([rows.twin_weights, rows.twin_weights[flags]])
        twin = np.concatenate([flags, flags[flags]])
        moved, turned = se3.compose(
            Poses(at[:, None], to[:, None]), Poses(self.translations, self.quaternions_xyzw)
        )
        return GraspDensity.build(
            Poses(moved.reshape(-1, 3), se3.normalise(turned.reshape(-1, 4))),
            kernel=self.component,
            weights=(share[:, None] * self.shares[None]).reshape(-1),
            symmetric=np.repeat(twin, self.size),
        )

"""Where an arm's flange is for its joints, and which joints take it somewhere: along straight ways, too."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from ._compiled import chain
from .arm import Arm, Floats
from .reach_map import ReachMap

#: A joint that goes farther between two steps of a straight way would have to jump; radians or metres.
_JUMP = 0.6
#: Steps of a straight way are at most so long, metres.
STEP_M = 0.025
#: Joints to start from that the map gives, and others drawn from a fixed seed.
_MAPPED, _DRAWN = 8, 4
#: Solutions of one grasp that are worth testing for collisions.
MOST_SOLUTIONS = 6


@dataclass(frozen=True, eq=False)
class Straight:
    """Straight ways about a grasp, in the root's frame: ``back`` (3,) to its pregrasp and ``lift`` (3,) to
    where it is lifted, metres; zero for none.
    """

    back: Floats
    lift: Floats

    @functools.cached_property
    def parts(self) -> tuple[int, int]:
        """How many steps either way is made in."""
        first, last = (
            math.ceil(float(np.linalg.norm(way)) / STEP_M - 1e-9) for way in (self.back, self.lift)
        )
        return first, last


class Kinematics:
    """An arm's kinematics; immutable but for its map, which is built at the first use. Thread-safe."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self._chain = (
            np.ascontiguousarray(arm.sliding),
            np.ascontiguousarray(arm.placements),
            np.ascontiguousarray(arm.axes),
            np.ascontiguousarray(arm.flange),
        )
        lower, upper = arm.range_of(2.0 * math.pi)
        self._limits = lower, upper
        rng = np.random.default_rng(0)
        low, high = arm.range_of()
        self._drawn = np.concatenate(
            [arm.middle[None], low + (high - low) * rng.uniform(0.1, 0.9, (_DRAWN, len(low)))]
        )
        self.map = ReachMap.build(self.forward, *arm.range_of())

    @property
    def nbytes(self) -> int:
        """Bytes that it keeps."""
        return self.arm.nbytes + self.map.nbytes

    def forward(self, joints: Floats) -> Floats:
        """Poses (N, 4, 4) of the flange in the root's frame for joints (N, n), radians and metres."""
        q = np.ascontiguousarray(joints, dtype=np.float64)
        out = np.empty((len(q), 4, 4))
        chain.forward_many(q, *self._chain, out)
        return out

    def jacobian(self, joints: Floats) -> Floats:
        """Geometric Jacobian (6, n) of the flange's origin, root's frame: translation first."""
        n = len(joints)
        frames, directions, out = np.zeros((n, 4, 4)), np.empty((n, 3)), np.empty((6, n))
        _, position = chain.forward(np.ascontiguousarray(joints), *self._chain, frames, directions)
        chain.jacobian(position, self._chain[0], frames, directions, out)
        return out

    def manipulability(self, joints: Floats) -> float:
        """Yoshikawa's measure sqrt(det(J J^T)) at joints (n,): 0 where the arm is singular, metres cubed for
        arms whose joints turn (The International Journal of Robotics Research 4, 1985).
        """
        jacobian = self.jacobian(joints)
        return float(np.prod(np.linalg.svd(jacobian, compute_uv=False)[:6])) if jacobian.shape[1] > 5 else 0.0

    def margin(self, joints: Floats) -> float:
        """Distance of joints (..., n) to the nearest limit, radians or metres; infinite without limits."""
        return float(np.min(np.minimum(joints - self.arm.lower, self.arm.upper - joints)))

    def solutions(
        self,
        flange: Floats,
        seeds: Floats | None = None,
        *,
        within_limits: bool = True,
        most: int = MOST_SOLUTIONS,
    ) -> tuple[Floats, float]:
        """Joints (m, n) that take the flange to a pose (4, 4), root's frame, and how far off it stays if none
        do: metres, radians counted as 0.3 m.

        ``seeds`` (k, n) are tried before those of the map. Without limits joints may turn on: what fails then
        does not fail by limits.
        """
        target = np.ascontiguousarray(flange, dtype=np.float64)
        n = len(self.arm.joints)
        mapped = np.empty((_MAPPED, n))
        count = self.map.seeds(target, mapped)
        given = [] if seeds is None else [np.reshape(seeds, (-1, n))]
        starts = np.concatenate([*given, mapped[:count], self._drawn])
        out = np.empty((most, n))
        found, left = chain.solutions(starts, target, *self._bounds(within_limits), *self._chain, most, out)
        return out[:found], 0.3 * math.sqrt(left)

    def way(
        self, joints: Floats, flange: Floats, ways: Straight, *, within_limits: bool = True
    ) -> Floats | None:
        """Joints (steps, n) from the pregrasp through the grasp at ``joints`` (n,), where the flange is at a
        pose (4, 4), to the lift; None where straight ways with small steps of all joints don't lead there.
        """
        target = np.ascontiguousarray(flange, dtype=np.float64)
        parts, lifts = ways.parts
        out = np.empty((parts + 1 + lifts, len(joints)))
        found = chain.straight(
            joints, target, ways.back, ways.lift, parts, lifts, *self._bounds(within_limits), *self._chain,
            _JUMP, out,
        )  # fmt: skip
        return out if found else None

    def _bounds(self, within_limits: bool) -> tuple[Floats, Floats]:
        n = len(self.arm.joints)
        return self._limits if within_limits else (np.full(n, -1e3), np.full(n, 1e3))

"""Searches with a dear test: what they answer passed it, and is nearly the best of all that do."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb_density import GraspDensity, IsotropicKernel, ModeSearch, Region, Separation, se3
from graspdb_density.se3 import Poses
from graspdb_density.search.lazy_search import DearTest

Bools = NDArray[np.bool_]
WIDTHS = IsotropicKernel(0.005, np.radians(8.0))


@pytest.fixture(scope="module")
def search() -> ModeSearch:
    rng = np.random.default_rng(0)
    centres, turns = rng.uniform(-0.05, 0.05, (40, 3)), se3.random_quaternions(40, rng)
    which = rng.integers(0, 40, 8_000)
    p = centres[which] + rng.normal(0, 0.008, (8_000, 3))
    q = se3.multiply(turns[which], se3.from_rotation_vector(rng.normal(0, 0.2, (8_000, 3))))
    poses = Poses(p, se3.normalise(q))
    return ModeSearch(GraspDensity.build(poses, kernel=WIDTHS, symmetric=np.zeros(8_000, dtype=bool)))


class Cone:
    """Passes what approaches within some angle of a direction, and counts how many it was asked of."""

    def __init__(self, seed: int, cosine: float) -> None:
        axis = np.random.default_rng(seed).normal(size=3)
        self.axis, self.cosine, self.asked = axis / np.linalg.norm(axis), cosine, 0

    def passes(self, poses: Poses) -> Bools:
        self.asked += len(poses)
        return np.asarray(se3.to_matrix(poses.quaternions_xyzw)[:, :, 2] @ self.axis >= self.cosine)

    def likely(self, poses: Poses) -> Bools:
        """Right for two in three."""
        odd = np.abs(poses.positions[:, 0] * 1e6).astype(int) % 3 == 0
        return np.asarray((se3.to_matrix(poses.quaternions_xyzw)[:, :, 2] @ self.axis >= self.cosine) ^ odd)


@pytest.mark.parametrize("scored", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_the_answer_passes_and_is_nearly_the_best_that_does(
    search: ModeSearch, seed: int, scored: bool
) -> None:
    cone = Cone(seed, 0.95)
    score = (lambda poses: search.density.log_density(poses)) if scored else None
    found = search.maxima(dear=DearTest(cone.passes, cone.likely), score=score)
    passing = cone.passes(search.density.poses)
    assert passing.any() == bool(found)
    if found:
        answer = Poses(found[0].position[None], found[0].quaternion_xyzw[None])
        assert cone.passes(answer).all()
        best = search.density.log_density(search.density.poses[passing]).max()
        assert np.exp(found[0].log_density - best) >= 0.98


def test_few_are_asked_where_most_pass(search: ModeSearch) -> None:
    cone = Cone(0, -1.0)
    found = search.maxima(dear=DearTest(cone.passes, lambda poses: np.ones(len(poses), dtype=bool)))
    assert len(found) == 1
    assert cone.asked < 400


def test_a_hint_that_is_always_wrong_costs_time_alone(search: ModeSearch) -> None:
    cone = Cone(1, 0.9)
    right = search.maxima(dear=DearTest(cone.passes, cone.passes))
    wrong = search.maxima(dear=DearTest(cone.passes, lambda poses: ~cone.passes(poses)))
    assert wrong
    assert wrong[0].log_density >= right[0].log_density + np.log(0.98)


def test_other_constraints_are_kept_and_runners_up_are_distinct(search: ModeSearch) -> None:
    cone, region = Cone(2, 0.3), Region(half_spaces=[[0, 0, 1, 0.0]])
    separation = Separation(0.02, 0.5)
    found = search.maxima(
        region,
        count=4,
        separation=separation,
        admissible=lambda poses: poses.positions[:, 0] > 0,
        dear=DearTest(cone.passes, cone.likely),
    )
    assert len(found) == 4
    p = np.array([item.position for item in found])
    q = np.array([item.quaternion_xyzw for item in found])
    assert cone.passes(Poses(p, q)).all()
    assert (p[:, 2] >= -1e-9).all()
    assert (p[:, 0] > 0).all()
    for i in range(4):
        for j in range(i):
            apart = np.linalg.norm(p[i] - p[j]) > 0.02, se3.angle_between(q[i], q[j]) > 0.5
            assert any(apart)


def test_nothing_passes_nothing_is_answered(search: ModeSearch) -> None:
    def none(poses: Poses) -> Bools:
        return np.zeros(len(poses), dtype=bool)

    assert search.maxima(dear=DearTest(none, none)) == []
    assert search.maxima(dear=DearTest(none, none), score=search.density.log_density) == []


def test_of_equal_ones_the_cheapest_is_first() -> None:
    centres = np.array([[0.0, 0, 0], [0.2, 0, 0], [0.4, 0, 0]])
    turns = np.tile([0.0, 0, 0, 1], (3, 1))
    alike = ModeSearch(
        GraspDensity.build(Poses(centres, turns), kernel=WIDTHS, symmetric=np.zeros(3, dtype=bool))
    )

    def all_of(poses: Poses) -> Bools:
        return np.ones(len(poses), dtype=bool)

    for near in centres[:, 0]:
        cost = lambda poses, near=near: np.abs(poses.positions[:, 0] - near)  # noqa: E731
        (found,) = alike.maxima(dear=DearTest(all_of, all_of, cost))
        assert abs(found.position[0] - near) < 0.01

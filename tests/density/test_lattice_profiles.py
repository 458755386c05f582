"""Profiles and half widths of trials on a grid, against regions of success that are known exactly."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import isotonic_regression

from graspdb_density import se3
from graspdb_density.se3 import Floats, Poses
from graspdb_density.vicinity.anisotropy import empirical_anisotropy
from graspdb_density.vicinity.displacement_bins import Anisotropy
from graspdb_density.vicinity.lattice_profiles import LatticeProfiles
from graspdb_geometry.grids import hopf_grid

STEP = 0.01
#: Whether grasps at positions (..., 3) with axes (..., 3, 3) hold.
Region = Callable[[Floats, Floats], np.ndarray]


def half_of_rotations() -> Floats:
    """A grid of 15 degrees, one of each pair that the jaw's half turn exchanges."""
    grid = hopf_grid(15.0)
    index = np.arange(grid.size)
    return grid.quaternions(index[index % grid.psi_count < grid.psi_count // 2])


def box(*half: float) -> Region:
    """Positions within half extents of the origin, along the gripper's own axes."""
    return lambda p, axes: (np.abs(np.einsum("...ji,...j->...i", axes, p)) <= half).all(axis=-1)


def ellipsoid(*half: float) -> Region:
    return lambda p, axes: (np.square(np.einsum("...ji,...j->...i", axes, p) / half)).sum(axis=-1) <= 1.0


def cone(p: Floats, axes: Floats) -> np.ndarray:
    """A body that narrows along z, held between fingers that close across it."""
    closing = axes[..., :, 1]
    side = np.cross(closing, [0.0, 0.0, 1.0])
    across = np.array([1.0, 1.0, 0.0]) * p
    thick = 0.018 - 0.08 * p[..., 2]
    return np.asarray(
        (np.abs((closing * across).sum(axis=-1)) < thick)
        & (np.abs((side * across).sum(axis=-1)) < 0.018)
        & (np.abs(p[..., 2]) < 0.07)
        & (np.linalg.norm(side, axis=-1) > 0.75)
    )


@dataclass(frozen=True)
class Grid:
    positions: Floats
    quaternions: Floats
    success: np.ndarray
    rotation_keys: np.ndarray

    def found(self, **options: int) -> Anisotropy:
        return empirical_anisotropy(
            Poses.of(self.positions, self.quaternions),
            self.success,
            rotation_keys=self.rotation_keys,
            position_keys=np.arange(len(self.positions)),
            **options,
        )


def swept(region: Region, rotations: int, rng: np.random.Generator) -> Grid:
    """A grid of 10 mm, shifted, at some of the rotations of one of 15 degrees."""
    side = np.arange(-9, 10) * STEP
    lattice = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    lattice = lattice + rng.uniform(-0.5, 0.5, 3) * STEP
    every = half_of_rotations()
    chosen = rng.permutation(len(every))[:rotations]
    held = [region(lattice, se3.to_matrix(every[r])) for r in chosen]
    keys = np.repeat(chosen, len(lattice))
    return Grid(np.tile(lattice, (rotations, 1)), every[keys], np.concatenate(held), keys)


def exact_half_widths(region: Region, grid: Grid, rng: np.random.Generator) -> Floats:
    """Where half of the successes, displaced exactly along an axis of theirs, are out of the region."""
    some = rng.permutation(np.flatnonzero(grid.success))[:1_500]
    p, axes = grid.positions[some], se3.to_matrix(grid.quaternions[some])
    distance = np.linspace(0.0, 0.08, 161)
    ends = []
    for axis in range(3):
        moved = np.multiply.outer(np.concatenate([distance, -distance]), axes[:, :, axis])
        share = region(p + moved, axes).mean(axis=1).reshape(2, -1).mean(axis=0)
        ends.append(distance[np.argmax(share < 0.5)])
    return np.array(ends)


@pytest.mark.parametrize(
    ("region", "rotations"),
    [(box(0.04, 0.015, 0.025), 50), (ellipsoid(0.05, 0.02, 0.03), 50), (cone, 100)],
    ids=["box", "ellipsoid", "cone"],
)
def test_half_widths_on_a_grid_are_those_of_the_region(region: Region, rotations: int) -> None:
    rng = np.random.default_rng(7)
    grid = swept(region, rotations, rng)
    truth = exact_half_widths(region, grid, rng)
    found = grid.found(max_grasps=400).tolerances[:3]
    for item, expected in zip(found, truth, strict=True):
        assert item.half_width == pytest.approx(expected, abs=0.0025), item.axis
        # The interval is of which grasps were looked at; what is finer than the grid adds a little.
        assert item.high - item.low < 0.006
        assert item.low - 0.0015 <= expected <= item.high + 0.0015
    assert sum(item.low <= t <= item.high for item, t in zip(found, truth, strict=True)) >= 2


def test_profiles_do_not_zigzag() -> None:
    """Rotations along the lattice fill every second bin only, and forgive more than the others here."""

    def upright(p: Floats, axes: Floats) -> np.ndarray:
        reach = 0.01 + 0.05 * axes[..., 2, 0] ** 4
        along = np.abs(np.einsum("...ji,...j->...i", axes, p)) <= [1.0, 0.014, 0.02]
        return np.asarray(along.all(axis=-1) & (np.abs(p[..., 2]) < reach))

    every = half_of_rotations()
    steep = np.abs(se3.to_matrix(every)[:, 2, 0])
    side = np.arange(-9, 10) * STEP
    lattice = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    chosen = np.concatenate([np.flatnonzero(steep > 0.999), np.flatnonzero(steep < 0.8)[::40]])
    keys = np.repeat(chosen, len(lattice))
    p = np.tile(lattice, (len(chosen), 1))
    grid = Grid(p, every[keys], upright(p, se3.to_matrix(every[keys])), keys)
    profile = grid.found(max_grasps=600).tolerances[0]
    for sign in (1.0, -1.0):
        distance = sign * profile.displacement
        near = np.flatnonzero((distance > 0.0) & (distance < 0.06))
        share = profile.probability[near[np.argsort(distance[near])]]
        falling = isotonic_regression(share, increasing=False).x
        assert len(share) > 8
        assert np.abs(share - falling).max() < 0.02


def test_a_part_of_a_grid_is_less_sure_but_not_elsewhere() -> None:
    rng = np.random.default_rng(3)
    region = box(0.04, 0.015, 0.025)
    grid = swept(region, 150, rng)
    kept = rng.random(len(grid.success)) < 0.2
    part = Grid(grid.positions[kept], grid.quaternions[kept], grid.success[kept], grid.rotation_keys[kept])
    whole, some = grid.found(max_grasps=500).tolerances[:3], part.found(max_grasps=500).tolerances[:3]
    for a, b, expected in zip(whole, some, (0.04, 0.015, 0.025), strict=True):
        assert b.high - b.low > 1.3 * (a.high - a.low)
        assert b.low - 0.002 <= expected <= b.high + 0.002


def test_turns_at_one_position() -> None:
    """Success within 20, 50 and 30 degrees of a rotation that is another at every position."""
    rng = np.random.default_rng(1)
    every = half_of_rotations()
    middle = se3.random_quaternions(120, rng)
    limits = np.radians([20.0, 50.0, 30.0])

    def held(q: Floats, about: Floats) -> np.ndarray:
        turned = se3.multiply(about * [-1.0, -1.0, -1.0, 1.0], q)
        ways = [se3.to_rotation_vector(way) for way in (turned, se3.jaw_twin(turned))]
        return np.asarray((np.abs(ways[0]) <= limits).all(-1) | (np.abs(ways[1]) <= limits).all(-1))

    won = np.concatenate([held(every, about) for about in middle])
    keys = np.repeat(np.arange(len(middle)), len(every))
    p, q = rng.uniform(-1.0, 1.0, (len(middle), 3))[keys], np.tile(every, (len(middle), 1))
    found = empirical_anisotropy(
        Poses.of(p, q), won, rotation_keys=np.arange(len(p)), position_keys=keys, max_grasps=600
    ).tolerances[3:]
    some = rng.permutation(np.flatnonzero(won))[:600]
    angle = np.radians(np.arange(1.0, 80.0))
    for axis, item in enumerate(found):
        share = np.zeros(len(angle))
        for i, turn in enumerate(angle):
            for sign in (1.0, -1.0):
                way = se3.from_rotation_vector(sign * turn * np.eye(3)[axis])
                share[i] += 0.5 * held(se3.multiply(q[some], way), middle[keys[some]]).mean()
        expected = angle[np.argmax(share < 0.5)]
        assert item.half_width == pytest.approx(expected, abs=math.radians(4.0)), item.axis
        assert item.low - math.radians(1.0) <= expected <= item.high + math.radians(1.0)


def test_pairs_on_the_axis_are_shares_themselves() -> None:
    """At the lattice's own displacements nothing is corrected or blurred; between them shares are linear."""
    profiles = LatticeProfiles(2, 9, 0.005, 0.005)
    middle = profiles.pair_sums.shape[2] // 2
    for grasp, (way, hit) in ((0, (2, 1.0)), (0, (4, 0.0)), (1, (2, 0.0)), (1, (4, 0.0))):
        for sign in (-1, 1):
            at = sign * way * 0.005
            profiles.pair_sums[grasp, :, middle + sign * way] += [1.0, hit, at, 0.0, 0.0]
    share, weight = profiles.shares(np.ones((2, 1), dtype=np.float32), mirrored=False)
    x = share[:9, 0]
    np.testing.assert_allclose(x, x[::-1])
    np.testing.assert_allclose(x[4:], [1.0, 0.75, 0.5, 0.25, 0.0], atol=1e-6)
    np.testing.assert_allclose(weight[4:9, 0], 2.0)
    twins, _ = profiles.shares(np.ones((2, 1), dtype=np.float32), mirrored=True)
    np.testing.assert_allclose(twins, share)

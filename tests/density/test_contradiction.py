"""Outcomes against a symmetry: refused where they differ by side, seldom where they are only noisy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graspdb_density import IsotropicKernel, SuccessModel
from graspdb_density.se3 import Poses
from graspdb_density.success.contradiction import SymmetryVerdict, contradiction
from graspdb_density.success.motions import Motions

Floats = NDArray[np.float64]
KERNEL = IsotropicKernel(0.01, math.radians(15.0))
MIRROR = np.array([np.eye(3), np.diag([1.0, -1.0, 1.0])])
REVOLUTION = Motions.of(MIRROR, np.zeros(3), axis=[0.0, 0.0, 1.0])
PLANE = Motions.of(MIRROR, np.zeros(3))


def tried(count: int, seed: int, *, spread: float = math.pi) -> tuple[Poses, Floats, Floats]:
    """Grasps from the side towards the z axis, their azimuths, and the chance of each: of a thing that is the
    same from everywhere.
    """
    rng = np.random.default_rng(seed)
    azimuth, miss = rng.uniform(-spread, spread, count), rng.normal(0.0, 0.015, count)
    out = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
    along = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(count)], axis=1)
    position = miss[:, None] * out
    position[:, 2] = rng.uniform(-0.05, 0.05, count)
    axes = np.stack([np.cross(along, -out), along, -out], axis=2)
    turned = Rotation.from_matrix(axes) * Rotation.from_rotvec(rng.normal(0.0, 0.2, (count, 3)))
    chance = np.where(np.abs(position[:, 2]) < 0.03, 0.95, 0.2) / (
        1.0 + np.exp((np.abs(miss) - 0.012) / 1e-3)
    )
    return Poses(position, turned.as_quat()), azimuth, chance


def judged(poses: Poses, chance: Floats, seed: int, motions: Motions) -> SymmetryVerdict:
    won = np.random.default_rng(seed).random(len(chance)) < chance
    return contradiction(SuccessModel.build(poses, won, kernel=KERNEL), motions)


@pytest.mark.parametrize("motions", [REVOLUTION, PLANE])
@pytest.mark.parametrize(("count", "spread"), [(40, math.pi), (300, math.pi), (1_500, 1.2)])
def test_noise_alone_refuses_few(count: int, spread: float, motions: Motions) -> None:
    runs = 25
    refused = sum(
        judged(poses, chance, 100 + seed, motions).refused
        for seed in range(runs)
        for poses, _, chance in [tried(count, seed, spread=spread)]
    )
    # One in twenty at most: of 25, four or more would be chance once in 30.
    assert refused <= 3


@pytest.mark.parametrize("motions", [REVOLUTION, PLANE])
def test_a_handle_that_the_mesh_lacks_is_found_where_it_is(motions: Motions) -> None:
    poses, azimuth, chance = tried(6_000, 1)
    chance[np.abs(azimuth - 2.0) < 0.6] = 0.02
    found = judged(poses, chance, 2, motions)
    assert found.refused
    assert found.told
    worst = found.against[0]
    assert abs(worst.share - worst.other_share) > 0.3
    assert worst.chance <= found.places[-1].chance


@pytest.mark.parametrize("motions", [REVOLUTION, PLANE])
def test_a_mass_off_the_middle_is_found(motions: Motions) -> None:
    poses, azimuth, chance = tried(4_000, 3)
    assert judged(poses, chance * (0.75 - 0.25 * np.tanh(2.0 * np.sin(azimuth))), 4, motions).refused


def test_too_few_attempts_tell_nothing() -> None:
    poses, _, chance = tried(6, 5, spread=0.3)
    found = judged(poses, chance, 6, PLANE)
    assert not found.told
    assert not found.refused


def test_the_same_attempts_give_the_same_verdict() -> None:
    poses, _, chance = tried(400, 7)
    first, again = (judged(poses, chance, 8, REVOLUTION) for _ in range(2))
    assert [place.chance for place in first.places] == [place.chance for place in again.places]

"""How densely attempts were made by their own poses, and densities whose rows are weighed anew."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspdb_density import GraspDensity, IsotropicKernel, se3
from graspdb_density.kde.attempt_exposure import attempts_per_volume, own_exposure
from graspdb_density.se3 import Poses

KERNEL = IsotropicKernel(0.01, math.radians(15.0))


def some(count: int, seed: int) -> Poses:
    rng = np.random.default_rng(seed)
    return Poses(rng.normal(size=(count, 3)) * 0.02, se3.random_quaternions(count, rng))


@given(st.integers(1, 40), st.integers(0, 99))
def test_repeats_of_one_grasp_weigh_as_much_as_one(repeats: int, seed: int) -> None:
    one = some(1, seed)
    many = one[np.zeros(repeats, dtype=np.int64)]
    exposure = attempts_per_volume(GraspDensity.build(many, kernel=KERNEL), one)
    own = own_exposure(KERNEL, np.array([True]))
    np.testing.assert_allclose(exposure, repeats * own, rtol=1e-5)


@given(st.integers(2, 60), st.integers(0, 99))
def test_it_is_the_number_of_attempts_times_their_density(count: int, seed: int) -> None:
    attempts = GraspDensity.build(some(count, seed), kernel=KERNEL)
    found = attempts_per_volume(attempts, attempts.poses)
    np.testing.assert_allclose(found, count * attempts.density(attempts.poses, cutoff=None), rtol=2e-2)
    assert (found >= own_exposure(KERNEL, attempts.symmetric) * (1 - 1e-5)).all()


def test_far_from_every_attempt_nothing_was_tried() -> None:
    attempts = GraspDensity.build(some(5, 0), kernel=KERNEL)
    away = Poses(attempts.positions + 1.0, attempts.quaternions_xyzw)
    assert not attempts_per_volume(attempts, away).any()


@pytest.mark.parametrize("extended", [False, True])
def test_weighed_anew_equals_built_so(*, extended: bool) -> None:
    poses, rng = some(300, 1), np.random.default_rng(2)
    first, second = rng.uniform(0.5, 2.0, (2, 300))
    flags = rng.random(300) < 0.5
    density = GraspDensity.build(poses[:200], kernel=KERNEL, weights=first[:200], symmetric=flags[:200])
    density = density.extend(poses[200:], first[200:], flags[200:])
    again = density.reweighted(second)
    if extended:
        more = some(50, 3)
        again = again.extend(more, np.full(50, 0.7))
        poses = Poses.concatenate([poses, more])
        second, flags = np.append(second, np.full(50, 0.7)), np.append(flags, np.ones(50, dtype=bool))
    built = GraspDensity.build(poses, kernel=KERNEL, weights=second, symmetric=flags)
    at = some(100, 4)
    np.testing.assert_allclose(again.log_density(at), built.log_density(at), atol=2e-3)
    np.testing.assert_allclose(again.weights, built.weights, rtol=1e-12)
    # What it was made of is as it was.
    np.testing.assert_allclose(density.weights, first / first.sum(), rtol=1e-12)

"""Attempts shared by an object's symmetry: what they tell elsewhere, and that they stay single attempts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graspdb_density import DiagonalKernel, IsotropicKernel, SuccessModel, se3
from graspdb_density.se3 import Poses
from graspdb_density.success.fuller import FullerModel
from graspdb_density.success.motions import Motions

Floats = NDArray[np.float64]
CENTRE = np.array([0.02, -0.01, 0.05])
MIRROR = np.diag([1.0, -1.0, 1.0])
ISOTROPIC = IsotropicKernel(0.01, math.radians(15.0))
DIAGONAL = DiagonalKernel.of([0.008, 0.012, 0.01, 0.3, 0.2, 0.25])
FIXED = DiagonalKernel.of(
    [0.008, 0.012, 0.01, 0.3, 0.2, 0.25], Rotation.from_rotvec([0.3, 0.2, 0.5]).as_matrix()
)


def poses(count: int, seed: int, spread_m: float = 0.04) -> Poses:
    rng = np.random.default_rng(seed)
    return Poses(CENTRE + rng.uniform(-spread_m, spread_m, (count, 3)), se3.random_quaternions(count, rng))


def moved(matrix: Floats, at: Poses) -> Poses:
    """M T N for a mirror, M T for a turn, by matrices."""
    r = matrix @ se3.to_matrix(at.quaternions_xyzw)
    if np.linalg.det(matrix) < 0.0:
        r = r @ np.diag([1.0, -1.0, 1.0])
    return Poses(CENTRE + (at.positions - CENTRE) @ matrix.T, se3.from_matrix(r))


def about_z(angle: float) -> Floats:
    return np.asarray(Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix())


REVOLUTION = Motions.of(np.array([np.eye(3), MIRROR]), CENTRE, axis=[0.0, 0.0, 1.0])


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), mirrored=st.booleans())
def test_an_image_is_the_grasp_that_the_motion_shows(seed: int, mirrored: bool) -> None:
    turn = Rotation.random(random_state=seed).as_matrix()
    matrix = turn @ MIRROR if mirrored else turn
    at = poses(4, seed)
    seen = Motions.of(np.array([np.eye(3), matrix]), CENTRE).images(at)
    back = Poses(seen.positions[:, 1], seen.quaternions_xyzw[:, 1])
    again = moved(matrix, back)
    assert again.positions == pytest.approx(at.positions, abs=1e-12)
    assert se3.angle_between(again.quaternions_xyzw, at.quaternions_xyzw) == pytest.approx(0.0, abs=1e-7)
    # The approach is mirrored, and so is the line along which the jaw closes.
    axes = se3.to_matrix(back.quaternions_xyzw), se3.to_matrix(at.quaternions_xyzw)
    assert matrix @ axes[0][0][:, 2] == pytest.approx(axes[1][0][:, 2], abs=1e-9)
    assert abs((matrix @ axes[0][0][:, 1]) @ axes[1][0][:, 1]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("kernel", [ISOTROPIC, DIAGONAL, IsotropicKernel(0.01, 0.5)])
def test_sharing_by_a_mirror_is_posting_the_mirrored_attempts(
    kernel: IsotropicKernel | DiagonalKernel,
) -> None:
    tried, asked = poses(400, 1), poses(300, 2)
    won = np.random.default_rng(3).random(400) < 0.4
    shared = SuccessModel.build(tried, won, kernel=kernel).shared(
        Motions.of(np.array([np.eye(3), MIRROR]), CENTRE)
    )
    both = Poses.concatenate([tried, moved(MIRROR, tried)])
    copied = SuccessModel.build(both, np.tile(won, 2), kernel=kernel)
    mine, theirs = shared.evaluate_near(asked), copied.evaluate_near(asked)
    assert (theirs[0].effective_trials > 0.5).sum() > 100
    assert mine[1].widths == pytest.approx(theirs[1].widths, rel=1e-3, abs=1e-3)
    # Where no attempt tells twice, the sums are the same; nowhere do copies make more of it.
    alike = np.isclose(mine[0].effective_trials, theirs[0].effective_trials, rtol=1e-2)
    assert alike.mean() > 0.4
    assert (mine[0].effective_trials <= theirs[0].effective_trials * (1.0 + 1e-3) + 1e-9).all()
    assert mine[0].probability[alike] == pytest.approx(theirs[0].probability[alike], abs=5e-3)


@pytest.mark.parametrize("kernel", [ISOTROPIC, DIAGONAL, FIXED])
def test_an_attempt_is_one_wherever_it_tells(kernel: IsotropicKernel | DiagonalKernel) -> None:
    one = Poses(CENTRE + np.array([[0.004, 0.001, 0.0]]), np.array([[1.0, 0.0, 0.0, 0.0]]))
    model = SuccessModel.build(one, np.array([True]), kernel=kernel).shared(REVOLUTION)
    asked = moved(about_z(1.2), one)
    spread = np.random.default_rng(0).normal(0.0, 5e-3, (50, 3))
    near = Poses(asked.positions + spread, np.repeat(asked.quaternions_xyzw, 50, axis=0))
    told = model.evaluate(near).effective_trials
    assert told[told > 0.0] == pytest.approx(1.0, abs=1e-9)
    assert (told > 0.0).sum() > 40


@settings(max_examples=15, deadline=None)
@given(angle=st.floats(-3.1, 3.1), seed=st.integers(0, 1000))
def test_about_an_axis_every_direction_is_told_alike(angle: float, seed: int) -> None:
    tried = poses(300, seed)
    won = tried.positions[:, 2] > CENTRE[2]
    model = SuccessModel.build(tried, won, kernel=ISOTROPIC).shared(REVOLUTION)
    asked = poses(100, seed + 1)
    here = model.evaluate_near(asked)
    for there in (
        model.evaluate_near(moved(about_z(angle), asked)),
        model.evaluate_near(moved(MIRROR, asked)),
    ):
        assert there[0].probability == pytest.approx(here[0].probability, abs=0.01)
        assert there[0].effective_trials == pytest.approx(here[0].effective_trials, rel=0.03, abs=0.05)
        assert there[1].widths == pytest.approx(here[1].widths, abs=0.25)


@pytest.mark.parametrize("kernel", [ISOTROPIC, DIAGONAL])
def test_the_nearest_turn_is_the_nearest_of_all(kernel: IsotropicKernel | DiagonalKernel) -> None:
    one, asked = poses(1, 11, 0.02), poses(200, 12, 0.02)
    model = SuccessModel.build(one, np.array([True]), kernel=kernel)
    around = Motions.of(np.eye(3)[None], CENTRE, axis=[0.0, 0.0, 1.0])
    told = model.shared(around).evaluate_near(asked)[1].widths
    turned = [model.evaluate_near(moved(about_z(a), asked))[1].widths for a in np.arange(0.0, math.tau, 0.02)]
    least = np.min(turned, axis=0)
    near = least < 5.0
    assert near.sum() > 20
    assert told[near] == pytest.approx(least[near], abs=0.03)


def test_what_lies_at_another_side_is_near_an_attempt() -> None:
    tried = poses(50, 5)
    won = np.arange(50) % 2 == 0
    alone = SuccessModel.build(tried, won, kernel=ISOTROPIC)
    asked = moved(about_z(2.0) @ MIRROR, tried)
    assert np.median(alone.evaluate_near(asked)[1].widths) > 3.0
    nearest = alone.shared(REVOLUTION).evaluate_near(asked)[1]
    assert nearest.widths.max() < 0.1
    assert nearest.displacement is not None
    assert np.abs(nearest.displacement[:, :3]).max() < 1e-3


def test_attempts_far_from_every_image_are_found() -> None:
    model = SuccessModel.build(poses(20, 7), np.ones(20, dtype=bool), kernel=ISOTROPIC).shared(REVOLUTION)
    far = Poses(CENTRE + np.array([[0.0, 0.5, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]))
    _, nearest = model.evaluate_near(far)
    assert 0.43 < nearest.position_m[0] < 0.5


def test_matrices_that_are_no_motions_are_refused() -> None:
    for wrong in (np.eye(3)[None] * 2.0, MIRROR[None], np.empty((0, 3, 3)), np.eye(3)):
        with pytest.raises(ValueError, match=r"elements"):
            Motions.of(wrong, CENTRE)


def test_of_a_sample_that_is_shared_what_all_attempts_tell_is_not_lost() -> None:
    tried = poses(9_000, 21, 0.05)
    tried = tried[tried.positions[:, 1] > CENTRE[1] + 0.025]
    won = tried.positions[:, 2] > CENTRE[2]
    own = SuccessModel.build(tried, won, kernel=ISOTROPIC)
    motions = Motions.of(np.array([np.eye(3), MIRROR]), CENTRE)
    model = FullerModel(own.shared(motions, most=800), own)
    assert model.size == len(tried)
    here, there = tried[:50], moved(MIRROR, tried[:50])
    told, alone = model.evaluate_near(here), own.evaluate_near(here)
    assert (told[0].effective_trials >= alone[0].effective_trials).all()
    assert (told[1].widths <= alone[1].widths + 1e-9).all()
    mirrored, blind = model.evaluate_near(there), own.evaluate_near(there)
    assert np.median(mirrored[0].effective_trials) > 2.0 * np.median(blind[0].effective_trials)
    assert mirrored[1].widths.mean() < blind[1].widths.mean()
    for asked, found in ((here, told[0]), (there, mirrored[0])):
        assert model.probability(asked) == pytest.approx(found.probability)
        assert model.lower_end(asked) == pytest.approx(found.low)
        assert model.without_interval(asked)[1] == pytest.approx(found.effective_trials)

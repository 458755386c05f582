"""Group axioms and conversions of rotations, near the identity and near half a turn too."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from graspdb_density import se3

ANGLES = st.one_of(
    st.floats(0.0, math.pi),
    st.sampled_from([0.0, 1e-12, 1e-9, 1e-7, 1e-4, math.pi - 1e-4, math.pi - 1e-7, math.pi - 1e-9, math.pi]),
)
SEEDS = st.integers(0, 2**32 - 1)


@st.composite
def rotations(draw: st.DrawFn) -> se3.Floats:
    axis = np.random.default_rng(draw(SEEDS)).standard_normal(3)
    q = se3.from_rotation_vector(axis / np.linalg.norm(axis) * draw(ANGLES))
    return -q if draw(st.booleans()) else q


def same(a: se3.Floats, b: se3.Floats) -> bool:
    return float(se3.angle_between(a, b)) < 1e-14 * 50


@given(rotations(), rotations(), rotations())
def test_group_axioms(a: se3.Floats, b: se3.Floats, c: se3.Floats) -> None:
    assert same(se3.multiply(se3.multiply(a, b), c), se3.multiply(a, se3.multiply(b, c)))
    assert same(se3.multiply(a, se3.IDENTITY), a)
    assert same(se3.multiply(a, se3.conjugate(a)), se3.IDENTITY)
    v = np.array([0.3, -1.2, 0.7])
    np.testing.assert_allclose(se3.rotate(se3.multiply(a, b), v), se3.rotate(a, se3.rotate(b, v)), atol=1e-14)


@given(rotations())
def test_conversions_agree_with_scipy(q: se3.Floats) -> None:
    reference = Rotation.from_quat(q)
    np.testing.assert_allclose(se3.to_matrix(q), reference.as_matrix(), atol=1e-14)
    v = np.array([1.0, 2.0, -0.5])
    np.testing.assert_allclose(se3.rotate(q, v), reference.apply(v), atol=1e-14)
    assert np.linalg.norm(se3.to_rotation_vector(q)) == pytest.approx(reference.magnitude(), abs=1e-14)


@given(rotations())
def test_round_trips(q: se3.Floats) -> None:
    assert same(se3.from_rotation_vector(se3.to_rotation_vector(q)), q)
    assert float(se3.angle_between(se3.from_matrix(se3.to_matrix(q)), q)) < 1e-7 * 0.1
    assert same(se3.canonical(q), q)
    np.testing.assert_array_equal(se3.canonical(q), se3.canonical(-q))


@given(SEEDS, ANGLES)
def test_log_inverts_exp(seed: int, angle: float) -> None:
    axis = np.random.default_rng(seed).standard_normal(3)
    vector = axis / np.linalg.norm(axis) * min(angle, math.pi - 1e-9)
    np.testing.assert_allclose(se3.to_rotation_vector(se3.from_rotation_vector(vector)), vector, atol=1e-13)


@given(rotations(), SEEDS, ANGLES)
def test_angle_is_that_of_the_turn(q: se3.Floats, seed: int, angle: float) -> None:
    axis = np.random.default_rng(seed).standard_normal(3)
    turn = se3.from_rotation_vector(axis / np.linalg.norm(axis) * angle)
    assert float(se3.angle_between(q, se3.multiply(q, turn))) == pytest.approx(angle, abs=2e-15 * 10)


@given(rotations())
def test_jaw_twin_keeps_approach_and_swaps_fingers(q: se3.Floats) -> None:
    twin = se3.jaw_twin(q)
    np.testing.assert_allclose(se3.rotate(twin, [0.0, 0.0, 1.0]), se3.rotate(q, [0.0, 0.0, 1.0]), atol=1e-14)
    np.testing.assert_allclose(se3.rotate(twin, [0.0, 1.0, 0.0]), -se3.rotate(q, [0.0, 1.0, 0.0]), atol=1e-14)
    assert same(se3.jaw_twin(twin), q)


def test_rigid_motions_compose_and_invert() -> None:
    rng = np.random.default_rng(0)
    p, q = rng.standard_normal((20, 3)), se3.random_quaternions(20, rng)
    back_p, back_q = se3.inverse(se3.Poses(p, q))
    at, turn = se3.compose(se3.Poses(p, q), se3.Poses(back_p, back_q))
    np.testing.assert_allclose(at, 0.0, atol=1e-14)
    assert se3.angle_between(turn, se3.IDENTITY).max() < 1e-14


def test_random_quaternions_are_uniform() -> None:
    q = se3.random_quaternions(40_000, np.random.default_rng(1))
    # Second moments of the uniform distribution on S3 are 1/4, with standard error 1e-3 here.
    np.testing.assert_allclose(q.T @ q / len(q), np.eye(4) / 4.0, atol=5e-3)
    angle = se3.angle_between(q, se3.IDENTITY)
    assert angle.mean() == pytest.approx(math.pi / 2.0 + 2.0 / math.pi, abs=0.015)


def test_matrices_that_are_no_rotations_are_refused() -> None:
    with pytest.raises(ValueError, match="right-handed"):
        se3.from_matrix(np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(ValueError, match="orthonormal"):
        se3.from_matrix(1.1 * np.eye(3))
    with pytest.raises(ValueError, match=r"\(\.\.\., 3, 3\)"):
        se3.from_matrix(np.eye(4))


@pytest.mark.parametrize(
    ("positions", "quaternions", "message"),
    [
        (np.zeros((2, 2)), np.tile(se3.IDENTITY, (2, 1)), "positions have shape"),
        (np.zeros((2, 3)), np.tile(se3.IDENTITY, (3, 1)), "quaternions_xyzw have shape"),
        (np.full((1, 3), np.nan), se3.IDENTITY[None], "finite"),
        (np.zeros((1, 3)), np.zeros((1, 4)), "quaternion 0 has length 0"),
        (np.zeros((1, 3)), 1.01 * se3.IDENTITY[None], "within 0.001"),
    ],
)
def test_bad_poses_are_refused(positions: se3.Floats, quaternions: se3.Floats, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        se3.Poses.of(positions, quaternions)


def test_nearly_unit_quaternions_are_normalised() -> None:
    _, q = se3.Poses.of(np.zeros((1, 3)), 1.0005 * se3.IDENTITY[None])
    np.testing.assert_allclose(q, se3.IDENTITY[None], atol=1e-15)

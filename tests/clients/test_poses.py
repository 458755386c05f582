"""Poses as arrays: shapes, round trips and what is refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from graspdb.poses import as_poses, as_vector7, matrices
from graspdb.wire.base import rotation_to_quaternion

quaternions = (
    arrays(np.float64, (4,), elements=st.floats(-1, 1))
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
positions = arrays(np.float64, (3,), elements=st.floats(-10, 10))


@given(positions, quaternions)
def test_matrix_and_quaternion_are_the_same_pose(position: np.ndarray, quaternion: np.ndarray) -> None:
    matrix = matrices(position, quaternion)
    assert np.allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-12)
    assert np.isclose(np.linalg.det(matrix[:3, :3]), 1)
    back, turned = as_poses(matrix)
    assert np.array_equal(back[0], position)
    assert np.isclose(abs(turned[0] @ quaternion), 1, atol=1e-12)
    # The models that cross the wire, which work without arrays, agree.
    assert np.isclose(abs(np.dot(rotation_to_quaternion(matrix.tolist()), quaternion)), 1, atol=1e-12)


@given(st.integers(1, 5), st.data())
def test_rows_keep_their_order_and_are_normalised(count: int, data: st.DataObject) -> None:
    rows = np.array([np.concatenate([data.draw(positions), data.draw(quaternions)]) for _ in range(count)])
    rows[:, 3:] *= 1.0005
    position, quaternion = as_poses(rows)
    assert np.array_equal(position, rows[:, :3])
    assert np.allclose(np.linalg.norm(quaternion, axis=1), 1, atol=1e-12)
    assert np.allclose(np.sum(quaternion * rows[:, 3:], axis=1), 1.0005)


def test_z_is_the_approach_and_y_the_closing_direction() -> None:
    # A quarter turn about x takes y to z and z to -y.
    half = np.sqrt(0.5)
    matrix = matrices([0, 0, 0], [half, 0, 0, half])
    assert np.allclose(matrix[:3, 2], [0, -1, 0])
    assert np.allclose(matrix[:3, 1], [0, 0, 1])


def test_one_pose_in_every_form() -> None:
    expected = (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)
    matrix = np.eye(4)
    matrix[:3, 3] = 0.1, 0.2, 0.3
    for given_pose in (expected, list(expected), matrix, matrix.tolist(), [matrix], [expected]):
        assert as_vector7(given_pose) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("poses", "reason"),
    [
        ([[0, 0, 0, 0, 0, 0, 2]], "pose 0 must have a unit quaternion"),
        ([[0, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0, 0]], "pose 1 must have a unit quaternion"),
        ([[np.nan, 0, 0, 0, 0, 0, 1]], "pose 0 has numbers that are not finite"),
        ([[0, np.inf, 0, 0, 0, 0, 1]], "not finite"),
        ([[2000, 0, 0, 0, 0, 0, 1]], "1 km"),
        (np.zeros((3, 6)), "shape"),
        (np.zeros((0, 7)), "at least one"),
        ("mug", "numbers of shape"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "reflection"),
        (np.diag([2.0, 1.0, 1.0, 1.0]), "orthonormal"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "last row"),
    ],
)
def test_what_is_no_pose_is_refused(poses: object, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        as_poses(poses)


def test_tables_and_rigid_transforms_are_taken() -> None:
    rows = np.array([[0.1, 0.2, 0.3, 0, 0, 0.6, 0.8], [0, 0, 0.1, 1, 0, 0, 0]])
    table = pd.DataFrame(rows[:, ::-1], columns=["qw", "qz", "qy", "qx", "z", "y", "x"]).assign(outcome=True)
    np.testing.assert_allclose(as_poses(table).rows, rows)
    with pytest.raises(ValueError, match="lacks \\['qw'\\]"):
        as_poses(table.drop(columns="qw"))
    # SciPy's RigidTransform (since 1.16) and what looks like it.
    as_matrix = SimpleNamespace(as_matrix=lambda: matrices(rows[:, :3], rows[:, 3:]))
    np.testing.assert_allclose(as_poses(as_matrix).rows, rows)
    with pytest.raises(ValueError, match="shape"):
        as_poses(Rotation.from_quat(rows[:, 3:]))


def test_masked_poses_are_refused() -> None:
    rows = np.tile([0.1, 0.2, 0.3, 0, 0, 0, 1], (3, 1))
    mask = np.zeros(rows.shape, dtype=bool)
    np.testing.assert_allclose(as_poses(np.ma.masked_array(rows, mask)).rows, rows)
    mask[1, 2] = True
    with pytest.raises(ValueError, match="pose 1 is masked"):
        as_poses(np.ma.masked_array(rows, mask))

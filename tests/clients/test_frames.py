"""Frames and conventions: fixed poses on the right, out and back without loss."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspdb import wire
from graspdb.poses import as_poses, matrices
from graspdb.wire.frames import gripper_frames
from graspdb.wire.frames.conventions import axes_in_graspdb, to_graspdb
from graspdb.wire.frames.gripper_frames import NoSuchFrame, ToolUnknown

SHAPE = {
    "max_opening_m": 0.08,
    "finger": {"width_m": 0.02, "thickness_m": 0.01, "length_m": 0.05},
    "palm_size_m": [0.06, 0.2, 0.06],
}
FLANGE = {"position": [0, 0, -0.01], "quaternion_xyzw": [0, 0, -math.sin(math.pi / 8), math.cos(math.pi / 8)]}
TOOL = {"position": [0, 0, 0.1034], "quaternion_xyzw": [0, 0, 0, 1]}

_numbers = st.floats(-1.0, 1.0, allow_nan=False)
_quaternions = (
    st.tuples(_numbers, _numbers, _numbers, _numbers)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: tuple(x / math.hypot(*q) for x in q))
)
_poses = st.builds(
    lambda p, q: wire.Pose(position=p, quaternion_xyzw=q),
    st.tuples(_numbers, _numbers, _numbers),
    _quaternions,
)


def _profile(**more: object) -> wire.GripperProfile:
    return wire.GripperProfile.model_validate({**SHAPE, **more})


def _matrix(pose: wire.Pose) -> NDArray[np.float64]:
    return matrices(pose.position, pose.quaternion_xyzw)


@pytest.mark.parametrize("convention", wire.CONVENTIONS)
def test_a_convention_is_a_rotation_of_the_axes_alone(convention: wire.Convention) -> None:
    rotation = np.array(to_graspdb(convention))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    back = matrices((0, 0, 0), axes_in_graspdb(convention))[:3, :3]
    np.testing.assert_allclose(rotation @ back, np.eye(3), atol=1e-12)


def test_the_conventions_are_those_of_the_field() -> None:
    from_xy = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    from_zx = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    for convention, rotation in {"graspnet": from_xy, "acronym": from_zx, "graspgen": from_zx}.items():
        np.testing.assert_array_equal(to_graspdb(convention), rotation)
    for convention in ("graspdb", "vgn", "moveit"):
        np.testing.assert_array_equal(to_graspdb(convention), np.eye(3))


@pytest.mark.parametrize("convention", wire.CONVENTIONS)
@settings(max_examples=25, deadline=None)
@given(tool=_poses, other=_poses, grasp=_poses)
def test_out_of_the_tool_and_back_is_the_same_pose(
    convention: wire.Convention, tool: wire.Pose, other: wire.Pose, grasp: wire.Pose
) -> None:
    profile = _profile(base_to_tool=tool, frames={"mine": other})
    for frame in ("tool", "base", "mine"):
        fixed = profile.in_tool(frame, convention)
        given = as_poses([*grasp.position, *grasp.quaternion_xyzw])
        there = given.followed_by(fixed)
        back = there.followed_by(gripper_frames.inverse(fixed))
        np.testing.assert_allclose(back.matrices, given.matrices, atol=1e-9)
        # The pose of a frame in the base, once more by matrices.
        base = {"tool": _matrix(tool), "base": np.eye(4), "mine": _matrix(other)}[frame]
        expected = given.matrices @ np.linalg.inv(_matrix(tool)) @ base
        expected[:, :3, :3] = expected[:, :3, :3] @ np.array(to_graspdb(convention)).T
        np.testing.assert_allclose(there.matrices, expected, atol=1e-9)


def test_a_profile_has_base_and_tool_by_either_name() -> None:
    for told in (
        {"base_to_tool": TOOL},
        {"frames": {"tool": TOOL}},
        {"base_to_tool": TOOL, "frames": {"tool": TOOL}},
    ):
        profile = _profile(**told)
        assert profile.base_to_tool is not None
        assert profile.base_to_tool.position == (0, 0, 0.1034)
        assert list(profile.frames) == ["base", "tool"]
        assert wire.GripperProfile.model_validate(profile.model_dump()) == profile
    assert list(_profile().frames) == ["base"]


def test_what_a_profile_does_not_say_can_not_be_used() -> None:
    unknown = _profile(frames={"flange": FLANGE})
    assert _matrix(unknown.in_tool("tool")) == pytest.approx(np.eye(4))
    for frame in ("base", "flange"):
        with pytest.raises(ToolUnknown, match="not known"):
            unknown.in_tool(frame)
    with pytest.raises(NoSuchFrame, match="it has base, tool, flange"):
        unknown.in_tool("wrist")


def test_profiles_differ_in_frames_and_joints_by_name() -> None:
    one = _profile(base_to_tool=TOOL, frames={"flange": FLANGE}, joints={"left": {"open": 0.04, "closed": 0}})
    assert one.differences(_profile(**one.model_dump(exclude={*SHAPE}))) == []
    other = _profile(frames={"camera": TOOL}, joints={"left": {"open": 0.05, "closed": 0}})
    named = ["base_to_tool", "frames.camera", "frames.flange", "joints.left"]
    assert one.differences(other) == other.differences(one) == named

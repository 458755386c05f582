"""Frames and conventions: fixed poses on the right, out and back without loss."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspdb import Client, wire
from graspdb.errors import InvalidInput
from graspdb.poses import as_poses, matrices, quaternions_of
from graspdb.resources.objects import GraspObject
from graspdb.wire.frames import gripper_frames
from graspdb.wire.frames.conventions import OWN_AXES, axes_in_graspdb, to_graspdb
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
        if convention not in OWN_AXES:
            expected[:, :3, :3] = given.matrices[:, :3, :3] @ np.array(to_graspdb(convention)).T
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


# -- through the SDK and the command line


@pytest.fixture
def mine(db: Client, fresh_id: str) -> wire.GripperInfo:
    """A gripper whose flange is turned and whose camera is elsewhere."""
    flange = np.eye(4)
    flange[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    frames = {"flange": flange, "camera": [0.05, 0.02, 0.03, 0.5, 0.5, -0.5, 0.5]}
    return db.grippers.create(f"g-{fresh_id}", base_to_tool=TOOL, frames=frames, **SHAPE)


@pytest.fixture
def grasped(
    db: Client, fresh_id: str, mine: wire.GripperInfo, clusters: Callable[..., NDArray[np.float64]]
) -> GraspObject:
    item = db.objects.create(fresh_id, frames={"tracker": [0, 0.1, 0, 0, 0, 1, 0]})
    above = clusters([([0.0, 0.0, 0.06], [1.0, 0.0, 0.0, 0.0])], 150)
    item.trials.add(above, True, gripper=mine.id, source="robot")
    item.trials.add(above[:20], False, gripper=mine.id, source="robot")
    return item.refresh()


def _fixed(
    gripper: wire.GripperInfo, frame: str, convention: wire.Convention = "graspdb"
) -> NDArray[np.float64]:
    return _matrix(gripper.profile.in_tool(frame, convention))


def test_a_grasp_knows_what_it_is_of_and_goes_back_so(
    db: Client, mine: wire.GripperInfo, grasped: GraspObject
) -> None:
    tool = grasped.best_grasp()
    best = grasped.best_grasp(frame="camera", convention="graspnet")
    assert (best.frame, best.convention) == ("camera", "graspnet")
    np.testing.assert_allclose(best.matrix, tool.matrix @ _fixed(mine, "camera", "graspnet"), atol=1e-9)
    np.testing.assert_allclose(best.tool_matrix, tool.matrix, atol=1e-9)
    np.testing.assert_allclose(best.approach, tool.approach, atol=1e-9)
    assert best.summary()["pose of"] == "camera, axes as graspnet, in the object frame"
    assert "of the camera, axes as graspnet in the object frame, density" in repr(best)
    moved = grasped.best_grasp(frame="camera", object_pose=[1, 0, 0, 0, 0, 0, 1])
    assert f"world position=[{moved.position[0] + 1:.4f}, " in repr(moved)
    # The flange is turned against the tool, and graspnet's axes are not its own: it says so.
    turned = grasped.best_grasp(frame="flange", convention="graspnet")
    assert turned.warnings
    assert all(f"mind: {warning}" in repr(turned) for warning in turned.warnings)
    # Given back, it is what it says.
    likely = grasped.likelihood(best)
    np.testing.assert_allclose(likely.log_density, grasped.likelihood(tool).log_density, rtol=1e-6)
    with pytest.raises(ValueError, match="these poses are of camera"):
        grasped.likelihood(best, frame="tool")
    ranked = grasped.best_grasps(count=2, candidates=[best], frame="camera", convention="graspnet")
    assert ranked[0].candidate == 0
    receipt = best.report(True, achieved_pose=best.matrix)
    (trial,) = grasped.trials.list(batch=receipt.batch)
    np.testing.assert_allclose(matrices(trial.position, trial.quaternion_xyzw), tool.matrix, atol=1e-9)
    assert trial.achieved_pose is not None
    np.testing.assert_allclose(trial.achieved_pose.position, tool.position, atol=1e-9)
    grasped.batches.delete(receipt.batch)


def test_draws_and_trials_in_a_frame(mine: wire.GripperInfo, grasped: GraspObject) -> None:
    drawn = grasped.samples(20, seed=3, frame="flange")
    assert drawn.frame == "flange"
    plain = grasped.samples(20, seed=3)
    np.testing.assert_allclose(drawn.matrices, plain.matrices @ _fixed(mine, "flange"), atol=1e-9)
    receipt = grasped.trials.add(drawn, False, gripper=mine.id)
    stored = grasped.trials.list(batch=receipt.batch).arrays()
    np.testing.assert_allclose(stored.matrices, plain.matrices, atol=1e-9)
    there = grasped.trials.list(batch=receipt.batch, frame="flange").arrays()
    assert there.frame == "flange"
    np.testing.assert_allclose(there.matrices, drawn.matrices, atol=1e-9)
    one = grasped.trials.get(int(stored.seq[0]), frame="flange")
    np.testing.assert_allclose(one.position, drawn.position[0], atol=1e-9)
    records = [{**pose, "outcome": False} for pose in ({"matrix": m.tolist()} for m in drawn.matrices[:2])]
    again = grasped.trials.add_records(records, gripper=mine.id, frame="flange")
    rows = grasped.trials.list(batch=again.batch).arrays()
    np.testing.assert_allclose(rows.matrices, plain.matrices[:2], atol=1e-9)


def test_the_nearer_twin_and_a_frame_of_the_object(grasped: GraspObject) -> None:
    tool = grasped.best_grasp()
    twin = tool.matrix @ np.diag([-1.0, -1.0, 1.0, 1.0])
    for wanted in (tool.matrix, twin):
        found = grasped.best_grasp(near=quaternions_of(wanted[None, :3, :3])[0])
        np.testing.assert_allclose(found.matrix, wanted, atol=1e-9)
    world = matrices([0.4, 0.1, 0.2], [0, 0, 0.6, 0.8])
    tracker = world @ matrices([0, 0.1, 0], [0, 0, 1, 0])
    seen = grasped.best_grasp(object_pose=tracker, object_frame="tracker")
    np.testing.assert_allclose(seen.world, grasped.best_grasp(object_pose=world).world, atol=1e-9)
    assert list(grasped.info.frames) == ["mesh", "tracker"]
    assert list(grasped.patch(frames=None).info.frames) == ["mesh"]


def test_a_sweep_takes_and_tells_poses_of_a_frame(db: Client, mine: wire.GripperInfo, fresh_id: str) -> None:
    item = db.objects.create(f"s-{fresh_id}", mesh=trimesh.creation.box([0.04, 0.05, 0.08]), mass_kg=0.1)
    item.upload_convex_parts([trimesh.creation.box([0.04, 0.05, 0.08])])
    tool = matrices([[0, 0, 0.04]], [[1.0, 0, 0, 0]])
    sweep = item.sweep(poses=tool @ _fixed(mine, "camera"), frame="camera", gripper=mine.id)
    assert sweep.info.poses == 1
    outcomes = sweep.outcomes(frame="camera")
    assert (len(outcomes), outcomes.frame) == (0, "camera")
    with pytest.raises(InvalidInput, match="frame"):
        item.sweep(max_poses=10, frame="camera", gripper=mine.id)
    sweep.cancel()


def test_frames_on_the_command_line(
    run: Callable[..., tuple[int, str, str]],
    grasped: GraspObject,
    mine: wire.GripperInfo,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / "frames.png"
    code, told, error = run("frames", mine.id, "--pose=0,0,0.1,1,0,0,0", "--frame", "flange", "-o", str(file))
    assert (code, error) == (0, "")
    assert "camera in the base" in told
    assert file.read_bytes().startswith(b"\x89PNG")
    assert run("frames", mine.id, "-o", str(tmp_path / "frames.gif"))[0] == 2
    monkeypatch.chdir(tmp_path)
    assert run("frames", mine.id)[0] == 0
    assert (tmp_path / f"{mine.id}.svg").read_bytes().startswith(b"<?xml")
    assert run("frames", mine.id, "--frame", "wrist", "-o", str(file))[0] == 1
    code, told, _ = run("best-grasp", grasped.id, "--frame", "flange", "--near=1,0,0,0", "--prior")
    assert code == 0
    assert "pose of" in told
    code, told, _ = run("--json", "best-grasp", grasped.id, "--convention", "acronym")
    assert json.loads(told)["convention"] == "acronym"
    assert run("trials", "list", grasped.id, "--frame", "base")[0] == 0
    assert run("samples", grasped.id, "--frame", "base", "--count", "3")[0] == 0
    code, told, _ = run("objects", "change", grasped.id, "--frame", "lid=0,0,0.1,0,0,0,1")
    assert (code, "mesh, lid, tracker" in told or "mesh, tracker, lid" in told) == (0, True)
    assert run("objects", "change", grasped.id, "--frame", "lid")[0] == 2
    shown = json.loads(run("grippers", "show", mine.id)[1])
    assert set(shown["frames"]) == {"base", "tool", "flange", "camera"}
    (tmp_path / "copy.json").write_text(json.dumps(shown))
    assert run("grippers", "create", f"{mine.id}-copy", str(tmp_path / "copy.json"))[0] == 0

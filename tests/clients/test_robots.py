"""Robots and scenes by the SDK, awaited, on the command line, and as the guide has it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import known_robots
from graspdb import AsyncClient, Client
from graspdb.cli import app
from graspdb.errors import Infeasible, NotFound
from graspdb.files.robots import zipped_robot
from pages import DOCS, blocks, execute

pytest.importorskip("pinocchio")

AT = [0.5, 0, 0.1, 0, 0, 0, 1]


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory, serve_module: Callable[..., str]) -> Iterator[Client]:
    """A service with some grasps of a mug from above, without a mesh."""
    path = tmp_path_factory.mktemp("cell") / "graspdb.sqlite"
    rng = np.random.default_rng(0)
    with Client(serve_module(f"sqlite:///{path}")) as db:
        mug = db.objects.create("mug")
        poses = np.tile([0.0, 0, 0.1, 1, 0, 0, 0], (200, 1))
        poses[:, :3] += rng.normal(size=(200, 3)) * 0.01
        mug.trials.add(poses, True, gripper="panda", source="human")
        yield db


def test_the_guide_s_page_runs(cell: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "franka_panda").symlink_to(known_robots.PANDA.parent)
    monkeypatch.chdir(tmp_path)
    place = np.eye(4)
    place[:3, 3] = AT[:3]
    mug = cell.objects.get("mug")
    # Without a mesh nothing can be said of the approach.
    names: dict[str, Any] = {"db": cell, "mug": mug, "T_world_mug": place}
    page = DOCS / "guide/robots.md"
    for line, block in blocks(page, "python"):
        execute(page, line, block.replace("pregrasp_distance_m=0.08,", ""), names)
    joints = names["grasp"].joints
    assert (joints.pregrasp, len(joints.grasp), len(joints.lift)) == (None, 7, 7)
    assert "joints, grasp" in names["grasp"].summary()
    assert names["grasp"].joint_margin > 0


def test_only_meshes_beside_the_urdf_are_sent(tmp_path: Path) -> None:
    secret = tmp_path / "secret.stl"
    secret.write_bytes(b"solid")
    folder = tmp_path / "robot"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes/a.stl").write_bytes(b"solid a")
    shape = "<link name='{0}'><collision><geometry><mesh filename='{0}'/></geometry></collision></link>"
    links = "".join(shape.format(name) for name in ("package://x/meshes/a.stl", "../secret.stl", str(secret)))
    (folder / "a.urdf").write_text(f"<robot name='a'>{links}</robot>")
    content, missing = zipped_robot(folder / "a.urdf", [folder])
    assert missing == ["../secret.stl", str(secret)]
    assert b"solid a" in content or content.startswith(b"PK")


def test_a_robot_and_a_scene_come_and_go(cell: Client) -> None:
    with pytest.warns(UserWarning, match="not sent"):
        robot = cell.robots.put("kuka", known_robots.KUKA, flange="lbr_iiwa_link_7", meshes="/nowhere")
    assert (len(robot.joints), robot.untested != []) == (7, True)
    assert cell.robots.update("kuka", gripper_mount=[0, 0, 0.05, 0, 0, 0, 1]).gripper_mount is not None
    assert cell.robots.description("kuka").startswith(b"PK")
    summary = cell.scenes.put("s", points=np.zeros((3, 3)), objects={})
    assert summary.points == 3
    assert "s" in [scene.id for scene in cell.scenes]
    assert cell.scenes.get("s").scene.points == [(0, 0, 0)] * 3
    cell.scenes.delete("s")
    cell.robots.delete("kuka")
    with pytest.raises(NotFound):
        cell.robots.get("kuka")


def test_a_shape_s_frames_are_where_pinocchio_has_them(cell: Client) -> None:
    import pinocchio as pin

    cell.robots.put("drawn", known_robots.PANDA, flange="panda_link8")
    shape = cell.robots.shape("drawn")
    model = pin.buildModelFromUrdf(str(known_robots.PANDA))
    data = model.createData()
    drawn = np.random.default_rng(0).uniform(-1, 1, (10, 7))
    for row, frames in zip(drawn, shape.frames(drawn), strict=True):
        q = pin.neutral(model)
        q[:7] = row
        pin.framesForwardKinematics(model, data, q)
        for i in range(9):
            there = data.oMf[model.getFrameId(f"panda_link{i}")].homogeneous
            assert np.allclose(frames[i], there, atol=1e-6)
    with pytest.raises(ValueError, match="7"):
        shape.frames([0.0] * 6)
    mug = cell.objects.get("mug")
    found = mug.reach([0, 0, 0.1, 1, 0, 0, 0], robot="drawn", object_pose=AT, gripper="panda")
    assert found.reached == [True]


def test_it_is_typed_and_awaited(cell: Client, tmp_path: Path) -> None:
    bench = tmp_path / "bench.json"
    bench.write_text(json.dumps({"boxes": [{"position": [0.5, 0, -0.1], "size_m": [1, 1, 0.1]}]}))
    url = ["--url", cell.url]

    def typed(*words: str) -> Any:
        return CliRunner().invoke(app, [*url, *words])

    stored = typed(
        "robots",
        "put",
        "arm",
        str(known_robots.PANDA),
        "--flange",
        "panda_link8",
        "--gripper-mount",
        "0,0,0,0,0,0,1",
    )
    assert "7 joints to panda_link8" in stored.output, stored.output
    assert "1 boxes" in typed("scenes", "put", "bench", str(bench)).output
    assert "panda_joint1" in typed("robots", "show", "arm").output
    assert json.loads(typed("scenes", "show", "bench").output)["boxes"][0]["size_m"] == [1, 1, 0.1]
    told = typed(
        *("best-grasp", "mug", "--object-pose", ",".join(map(str, AT)), "--robot", "arm"),
        *("--scene", "bench", "--gripper", "panda"),
    )
    assert "joints, grasp" in told.output, told.output
    far = typed("best-grasp", "mug", "--object-pose", "2,0,0,0,0,0,1", "--robot", "arm", "--gripper", "panda")
    assert "out of the arm's reach" in str(far.exception)

    async def awaited() -> list[str]:
        async with AsyncClient(cell.url) as db:
            mug = await db.objects.get("mug")
            with pytest.raises(Infeasible):
                await mug.best_grasp(gripper="panda", object_pose=[2, 0, 0, 0, 0, 0, 1], robot="arm")
            return [robot.id async for robot in db.robots.list()]

    assert "arm" in asyncio.run(awaited())

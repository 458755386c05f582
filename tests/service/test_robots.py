"""Robots: what is uploaded, what is refused, and the grasps that an arm can take."""

from __future__ import annotations

import importlib.util
import io
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

import known_robots
from graspdb_density import se3

pytest.importorskip("pinocchio")

XML, ZIP = {"Content-Type": "application/xml"}, {"Content-Type": "application/zip"}
#: The object stands so far in front of the robot, upright.
AT = [0.5, 0.1, 0.2, 0, 0, 0, 1]
TABLE = {"position": [0.5, 0, -0.05], "size_m": [1.0, 1.4, 0.1]}


@pytest.fixture(scope="module")
def cell(
    tmp_path_factory: pytest.TempPathFactory,
    serve_module: Callable[..., str],
    make_object: Callable[..., str],
    put_box: Callable[..., Any],
    post: Callable[..., Any],
    clusters: Callable[..., Any],
) -> Iterator[httpx.Client]:
    """The Panda, and a box with successful grasps from above and from the side."""
    path = tmp_path_factory.mktemp("cell") / "graspdb.sqlite"
    with httpx.Client(base_url=serve_module(f"sqlite:///{path}"), timeout=120) as http:
        _furnish(http, make_object, put_box, post, clusters)
        yield http


def _furnish(
    http: httpx.Client,
    make_object: Callable[..., str],
    put_box: Callable[..., Any],
    post: Callable[..., Any],
    clusters: Callable[..., Any],
) -> None:
    make_object(http)
    put_box(http, "thing")
    poses = clusters([((0, 0, 0.05), (1, 0, 0, 0)), ((-0.02, 0, 0), (0, 0.5**0.5, 0, 0.5**0.5))], 200)
    post(http, "thing", poses, gripper="panda")
    answer = http.put("/robots/panda?flange=panda_link8", content=known_robots.panda_zip(), headers=ZIP)
    assert answer.status_code == 201, answer.text


def best(http: httpx.Client, **asked: Any) -> dict[str, Any]:
    answer = http.post("/objects/thing/best-grasp", json={"robot": "panda", "object_pose": AT, **asked})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_a_robot_is_stored_with_joints_and_links(http: httpx.Client) -> None:
    sent = http.put("/robots/panda?flange=panda_link8", content=known_robots.panda_zip(), headers=ZIP)
    robot = sent.json()
    assert http.get("/robots/panda").json() == robot
    assert [joint["name"] for joint in robot["joints"]] == [f"panda_joint{i}" for i in range(1, 8)]
    assert robot["joints"][3]["upper"] == 0.0
    assert robot["joints"][0]["lower"] == pytest.approx(-2.9671)
    assert (robot["links"][0], robot["links"][-1], robot["untested"]) == ("panda_link0", "panda_link8", [])
    assert "panda_hand" not in robot["tested"]
    assert http.get("/robots").json()["items"] == [robot]
    assert http.get("/robots/panda/description").headers["content-type"] == "application/zip"
    mount = {"position": [0, 0, 0.01], "quaternion_xyzw": [0, 0, 0, 1]}
    changed = http.patch("/robots/panda", json={"gripper_mount": mount}).json()
    assert changed["gripper_mount"]["position"] == [0, 0, 0.01]
    assert http.delete("/robots/panda").status_code == 204
    assert http.get("/robots/panda").status_code == 404
    assert http.delete("/robots/panda").status_code == 404


def test_without_meshes_links_are_told_to_be_untested(cell: httpx.Client) -> None:
    answer = cell.put("/robots/bare?flange=panda_link8", content=known_robots.PANDA.read_bytes(), headers=XML)
    assert answer.status_code == 201
    assert "panda_link3" in answer.json()["untested"]
    assert any("not tested for collisions" in text for text in best(cell, robot="bare")["warnings"])
    assert not any("not tested for collisions" in text for text in best(cell)["warnings"])


@pytest.mark.parametrize(
    ("content", "flange", "field", "told"),
    [
        (b"<robot", "tip", "robot", "not XML"),
        (b"<!DOCTYPE robot [<!ENTITY a 'b'>]><robot name='a'/>", "tip", "robot", "DOCTYPE"),
        (b"<sdf/>", "tip", "robot", "not <robot>"),
        (known_robots.PANDA.read_bytes(), "hand", "flange", "panda_link8"),
        (known_robots.PANDA.read_bytes(), None, "flange", "panda_link8"),
        (known_robots.PANDA.read_bytes(), "panda_link0", "flange", "0 joints"),
    ],
)
def test_what_is_no_robot_is_refused_by_its_field(
    cell: httpx.Client, content: bytes, flange: str | None, field: str, told: str
) -> None:
    query = {} if flange is None else {"flange": flange}
    answer = cell.put("/robots/r", params=query, content=content, headers=XML)
    assert answer.status_code == 422
    (error,) = answer.json()["errors"]
    assert error["field"] == field
    assert told in error["message"]


def test_a_service_without_the_extra_says_how_to_get_it(
    cell: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = importlib.util.find_spec
    missing = lambda name: None if name == "coal" else found(name)  # noqa: E731
    monkeypatch.setattr("graspdb_service.usecases.cells.robots.importlib.util.find_spec", missing)
    for answer in (
        cell.put("/robots/r?flange=tip", content=b"<robot/>", headers=XML),
        cell.post("/objects/thing/best-grasp", json={"robot": "panda", "object_pose": AT}),
    ):
        assert answer.status_code == 501
        assert answer.json()["type"].endswith("robots-not-installed")
        assert "graspdb[service,robot]" in answer.json()["title"]


def test_the_service_starts_without_loading_it() -> None:
    code = "import sys, graspdb_service.app; print(sorted({'pinocchio', 'coal'} & set(sys.modules)))"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"


def test_a_zip_is_bounded_and_holds_one_urdf(cell: httpx.Client) -> None:
    def sent(**files: bytes) -> httpx.Response:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return cell.put("/robots/r?flange=tip", content=stream.getvalue(), headers=ZIP)

    for answer, told in (
        (cell.put("/robots/r?flange=tip", content=b"PK\0\0", headers=ZIP), "not a zip"),
        (sent(readme=b"no robot"), "one .urdf"),
        (sent(**{"a.urdf": b"<robot/>", "bomb.stl": bytes(300 * 2**20)}), "unpacks to over"),
    ):
        assert answer.status_code == 422, answer.text
        assert told in answer.json()["errors"][0]["message"]


def _flange(joints: list[float]) -> NDArray[np.float64]:
    import pinocchio as pin

    model = pin.buildModelFromXML(known_robots.PANDA.read_text())
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.array([*joints, 0.0, 0.0]))
    return np.array(data.oMf[model.getFrameId("panda_link8")].homogeneous)


def test_joints_lead_to_the_grasp_its_pregrasp_and_its_lift(cell: httpx.Client) -> None:
    asked = {"pregrasp_distance_m": 0.1, "lift_m": 0.08, "obstacles": {"boxes": [TABLE]}}
    answer = best(cell, **asked, robot_base_pose=[0.05, 0, 0.02, 0, 0, 0, 1])
    (grasp,) = answer["grasps"]
    assert answer["status"] == "ok"
    robot = cell.get("/robots/panda").json()
    profile = cell.get("/grippers/panda").json()["profile"]
    hand = np.eye(4)
    hand[:3, :3] = se3.to_matrix(np.array(profile["frames"]["flange"]["quaternion_xyzw"]))
    tool = np.eye(4)
    tool[2, 3] = 0.1034
    root = np.eye(4)
    root[:3, 3] = [0.05, 0, 0.02]
    world = np.eye(4)
    world[:3, :3] = se3.to_matrix(np.array(grasp["world"]["quaternion_xyzw"]))
    world[:3, 3] = grasp["world"]["position"]
    for name, shift in (("grasp", 0.0), ("pregrasp", -0.1), ("lift", 0.0)):
        joints = np.array(grasp["joints"][name])
        for value, joint in zip(joints, robot["joints"], strict=True):
            assert joint["lower"] <= value <= joint["upper"]
        reached = root @ _flange(joints.tolist()) @ np.linalg.inv(hand) @ tool
        wanted = world.copy()
        wanted[:3, 3] += shift * world[:3, 2]
        wanted[2, 3] += 0.08 if name == "lift" else 0.0
        assert np.allclose(reached, wanted, atol=1e-5)
    assert 0 < grasp["joint_margin"] < 2
    assert grasp["manipulability"] > 0


def test_of_equal_grasps_the_joints_nearest_to_now(cell: httpx.Client) -> None:
    free = best(cell)["grasps"][0]["joints"]["grasp"]
    near = best(cell, joints_now=free)["grasps"][0]["joints"]["grasp"]
    assert np.abs(np.array(near) - free).sum() < 0.5


def test_what_stands_in_the_way_is_named(cell: httpx.Client) -> None:
    wall = {"position": [0.25, 0, 0.4], "size_m": [0.05, 3.0, 1.6]}
    answer = best(cell, obstacles={"boxes": [wall]})
    assert (answer["status"], answer["conflict"], answer["grasps"]) == ("infeasible", ["robot"], [])
    reach = answer["reach"]
    assert (reach["reason"], reach["other"]) == ("collision", "obstacles.boxes.0")
    assert reach["link"].startswith("panda_link")
    assert answer["nearest"] is not None


def test_too_far_says_how_far_and_where_the_robot_should_stand(cell: httpx.Client) -> None:
    answer = best(cell, object_pose=[1.4, 0, 0.2, 0, 0, 0, 1])
    reach = answer["reach"]
    assert (answer["status"], reach["reason"]) == ("infeasible", "too_far")
    assert 0.3 < reach["off_m"] < 1.2
    base = reach["nearest_base_pose"]
    assert base["position"][0] > 0.1
    moved = best(cell, object_pose=[1.4, 0, 0.2, 0, 0, 0, 1], robot_base_pose=base)
    assert moved["status"] == "ok"


def test_candidates_are_tested_too(cell: httpx.Client) -> None:
    grasps = best(cell, count=3)["grasps"]
    candidates = [{"position": [5, 5, 5], "quaternion_xyzw": [0, 0, 0, 1]}, grasps[0]["world"]]
    (found,) = best(cell, candidates=candidates, collision_free=False)["grasps"]
    assert found["candidate"] == 1
    assert len(found["joints"]["grasp"]) == 7


def test_a_change_of_the_robot_makes_another_answer(cell: httpx.Client) -> None:
    before = best(cell)["answer"]
    assert best(cell)["answer"] == before
    mount = {"position": [0, 0, 0.02], "quaternion_xyzw": [0, 0, 0, 1]}
    cell.patch("/robots/panda", json={"gripper_mount": mount})
    assert best(cell)["answer"] != before
    cell.patch("/robots/panda", json={"gripper_mount": None})
    assert best(cell)["answer"] == before


@pytest.mark.parametrize(
    ("asked", "field"),
    [
        ({"robot": "panda"}, "object_pose"),
        ({"robot": "nobody", "object_pose": AT}, None),
        ({"scene": "s"}, "object_pose"),
        ({"joints_now": [0.0], "object_pose": AT}, "robot"),
        ({"robot": "panda", "object_pose": AT, "near": [0, 0, 0, 1]}, "near"),
        ({"robot": "panda", "object_pose": AT, "joints_now": [0.0]}, "joints_now"),
    ],
)
def test_what_does_not_fit_is_refused(cell: httpx.Client, asked: dict[str, Any], field: str | None) -> None:
    answer = cell.post("/objects/thing/best-grasp", json=asked)
    assert answer.status_code == (404 if field is None else 422), answer.text
    if field is not None:
        assert field in [error["field"] for error in answer.json()["errors"]]


def test_a_scene_is_named_instead_of_sent(cell: httpx.Client) -> None:
    scene = {"boxes": [TABLE], "points": [[0.3, 0.3, 0.1]], "objects": []}
    assert cell.put("/scenes/table", json=scene).status_code == 201
    assert cell.put("/scenes/table", json=scene).status_code == 200
    summary = {"id": "table", "boxes": 1, "points": 1, "objects": []}
    (item,) = cell.get("/scenes").json()["items"]
    assert {name: item[name] for name in summary} == summary
    assert cell.get("/scenes/table").json()["scene"]["boxes"][0]["size_m"] == [1.0, 1.4, 0.1]
    (sent,) = best(cell, obstacles={"boxes": [TABLE], "points": [[0.3, 0.3, 0.1]]})["grasps"]
    (named,) = best(cell, scene="table")["grasps"]
    assert named["position"] == sent["position"]
    wall = {"position": [0.25, 0, 0.4], "size_m": [0.05, 3.0, 1.6]}
    cell.put("/scenes/table", json={"boxes": [wall]})
    assert best(cell, scene="table")["reach"]["other"] == "scene.boxes.0"
    assert cell.delete("/scenes/table").status_code == 204
    gone = cell.post("/objects/thing/best-grasp", json={"object_pose": AT, "scene": "table"})
    assert gone.status_code == 404


def test_an_object_in_a_scene_is_an_obstacle_of_gripper_and_links(
    cell: httpx.Client, make_object: Callable[..., str], put_box: Callable[..., Any]
) -> None:
    make_object(cell, "wall")
    refused = cell.put("/scenes/s", json={"objects": [{"object": "wall", "pose": AT}]})
    assert refused.status_code == 422
    put_box(cell, "wall", (0.05, 2.0, 1.4))
    around = {"objects": [{"object": "wall", "pose": [0.25, 0, 0.4, 0, 0, 0, 1]}]}
    assert cell.put("/scenes/s", json=around).status_code == 201
    assert best(cell, scene="s")["reach"]["other"] == "scene.objects.0"
    put_box(cell, "wall", (0.4, 2.0, 1.4))
    over = {"objects": [{"object": "wall", "pose": AT}]}
    cell.put("/scenes/s", json=over)
    answer = cell.post("/objects/thing/best-grasp", json={"object_pose": AT, "scene": "s"}).json()
    assert answer["status"] == "infeasible"


def test_a_map_of_reach_tells_of_each_grasp_and_of_places_for_the_base(cell: httpx.Client) -> None:
    down, half = [1.0, 0.0, 0.0, 0.0], 0.5**0.5
    poses = [
        {"position": [0, 0, 0.05], "quaternion_xyzw": down},
        {"position": [0, 0, 3.0], "quaternion_xyzw": down},
    ]
    asked = {"robot": "panda", "gripper": "panda", "object_pose": AT, "poses": poses, "lift_m": 0.1}
    bases = [[0, 0, 0, 0, 0, 0, 1], [9, 0, 0, 0, 0, 0, 1], [0.5, -0.4, 0, 0, 0, half, half]]
    found = cell.post("/objects/thing/reach", json={**asked, "bases": bases}).json()
    assert (found["reached"], found["reason"]) == ([True, False], [None, "too_far"])
    assert found["base_share"] == [0.5, 0.0, 0.5]
    columns = {name: [pose[name] for pose in poses] for name in ("position", "quaternion_xyzw")}
    assert cell.post("/objects/thing/reach", json={**asked, "poses": columns}).json()["reached"] == [
        True,
        False,
    ]
    wall = {"boxes": [{"position": [0.5, 0.1, 0.3], "size_m": [0.5, 0.5, 0.02]}]}
    met = cell.post("/objects/thing/reach", json={**asked, "obstacles": wall}).json()
    assert met["reason"] == ["collision", "too_far"]
    many = cell.post("/objects/thing/reach", json={**asked, "poses": poses[:1] * 100, "bases": bases * 100})
    assert many.status_code == 422
    assert "20,000" in many.text
    assert cell.post("/objects/thing/reach", json={**asked, "robot": "none"}).status_code == 404


def test_what_draws_an_arm_is_closed_and_known_to_whoever_has_it(cell: httpx.Client) -> None:
    first = cell.get("/robots/panda/shape")
    shape = first.json()
    assert [joint["name"] for joint in shape["joints"]] == [f"panda_joint{i}" for i in range(1, 8)]
    assert [solid["joint"] for solid in shape["solids"]] == list(range(8))
    for solid in shape["solids"]:
        corners = np.array(solid["vertices"])[np.array(solid["faces"])]
        # By the divergence theorem: what faces outward has a volume, and a link's is litres at most.
        assert 0 < np.linalg.det(corners - corners.mean(axis=(0, 1))).sum() / 6 < 0.02
        edges = {(a, b) for face in solid["faces"] for a, b in zip(face, [*face[1:], face[0]], strict=True)}
        assert edges == {(b, a) for a, b in edges}
    again = cell.get("/robots/panda/shape", headers={"If-None-Match": first.headers["ETag"]})
    assert again.status_code == 304
    assert cell.get("/robots/none/shape").status_code == 404


def test_an_arm_in_the_way_is_told_where_it_collides(cell: httpx.Client) -> None:
    wall = {"position": [0.3, 0, 0.5], "size_m": [0.02, 2.0, 1.0]}
    found = best(cell, obstacles={"boxes": [wall]}, pregrasp_distance_m=0.05)
    assert found["status"] == "infeasible"
    reach = found["reach"]
    assert reach["reason"] == "collision"
    assert reach["colliding"][0] == {"link": reach["link"], "other": reach["other"]}
    assert len(reach["joints"]) == 7
    robot = cell.get("/robots/panda").json()
    for value, joint in zip(reach["joints"], robot["joints"], strict=True):
        assert joint["lower"] - 1e-6 <= value <= joint["upper"] + 1e-6
    far = best(cell, robot_base_pose=[-2, 0, 0, 0, 0, 0, 1])["reach"]
    assert (far["reason"], far["joints"], far["colliding"]) == ("too_far", None, [])

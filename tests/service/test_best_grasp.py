"""Best grasps under constraints, in either frame, against search by brute force."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

import brute_force
from graspdb_density import GraspDensity, IsotropicKernel, Region, se3
from graspdb_geometry.collision import Scene
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

KERNEL = IsotropicKernel(0.015, np.deg2rad(15))


def best(http: httpx.Client, **query: Any) -> dict[str, Any]:
    """The answer to GET, which must equal the answer to POST; at 15 mm / 15 degrees."""
    query |= {"sigma_position_m": 0.015, "sigma_rotation_deg": 15}
    joined = {
        name: ",".join(map(repr, map(float, value)))
        if isinstance(value, (list, tuple, np.ndarray))
        else value
        for name, value in query.items()
    }
    answer = http.get("/objects/thing/best-grasp", params=joined)
    assert answer.status_code == 200, answer.text
    plain = {
        name: list(map(float, value)) if isinstance(value, (tuple, np.ndarray)) else value
        for name, value in query.items()
    }
    posted = http.post("/objects/thing/best-grasp", json=plain)
    assert posted.json() == answer.json()
    body: dict[str, Any] = answer.json()
    return body


def fields(answer: httpx.Response, status: int = 422) -> set[str]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    return {item["field"] for item in answer.json()["errors"]}


def exact(trials: Poses, grasp: dict[str, Any]) -> float:
    pose = np.array([grasp["position"]]), np.array([grasp["quaternion_xyzw"]])
    return float(brute_force.log_density(KERNEL, se3.Poses.of(*trials), se3.Poses.of(*pose))[0])


@pytest.fixture
def thing(http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses) -> httpx.Client:
    make_object(http)
    post(http, "thing", two_clusters)
    return http


def test_unconstrained_equals_brute_force(thing: httpx.Client, two_clusters: Poses) -> None:
    answer = best(thing)
    assert answer["status"] == "ok"
    (grasp,) = answer["grasps"]
    assert grasp["log_density"] == pytest.approx(exact(two_clusters, grasp), abs=2e-3)
    assert grasp["density"] == pytest.approx(np.exp(grasp["log_density"]))
    assert grasp["relative"] == pytest.approx(1)
    assert grasp["active_constraints"] == []
    assert grasp["collision_free"] is None
    rng = np.random.default_rng(0)
    rows = rng.integers(0, 500, 20_000)
    positions = two_clusters[0][rows] + rng.normal(size=(20_000, 3)) * 0.005
    turns = se3.from_rotation_vector(rng.normal(size=(20_000, 3)) * 0.1)
    rivals = GraspDensity.build(se3.Poses.of(*two_clusters), kernel=KERNEL).log_density(
        se3.Poses.of(positions, se3.multiply(two_clusters[1][rows], turns))
    )
    assert grasp["log_density"] >= rivals.max() - 1e-3


def test_constraints_hold_and_are_named(thing: httpx.Client, two_clusters: Poses) -> None:
    """The upper cluster's peak is near (0, 0, 60) mm; each constraint cuts it off."""
    free = best(thing)["grasps"][0]
    for query, active, region in (
        ({"box_min": [-1, -1, 0.07]}, ["box_min"], Region([[0, 0, 1, 0.07]])),
        (
            {"box_min": [-1, -1, 0.02], "box_max": [1, 1, 0.05]},
            ["box_max"],
            Region([[0, 0, 1, 0.02], [0, 0, -1, -0.05]]),
        ),
        ({"above_plane": [2, 0, 0, 0.02]}, ["above_plane"], Region([[1, 0, 0, 0.01]])),
        ({"sphere": [0, 0, 0.08, 0.01]}, ["sphere"], Region(spheres=[[0, 0, 0.08, 0.01]])),
        (
            {"approach": [1, 0, -1], "approach_cone_deg": 30, "sphere": [0, 0, 0.06, 0.05]},
            ["approach"],
            Region(spheres=[[0, 0, 0.06, 0.05]], approach=[1, 0, -1], approach_angle=np.deg2rad(30)),
        ),
        (
            {"closing": [1, -1, 0], "closing_cone_deg": 20, "sphere": [0, 0, 0.06, 0.05]},
            ["closing"],
            Region(spheres=[[0, 0, 0.06, 0.05]], closing=[1, -1, 0], closing_angle=np.deg2rad(20)),
        ),
    ):
        answer = best(thing, **query)
        assert answer["status"] == "ok", query
        (grasp,) = answer["grasps"]
        position, quaternion = np.array(grasp["position"]), np.array(grasp["quaternion_xyzw"])
        assert region.contains(position[None], quaternion[None])[0], query
        assert grasp["active_constraints"] == active, query
        assert grasp["log_density"] < free["log_density"]
        assert grasp["relative"] == pytest.approx(
            np.exp(grasp["log_density"] - free["log_density"]), rel=1e-3
        )
        assert grasp["log_density"] == pytest.approx(exact(two_clusters, grasp), abs=5e-3)
        # No success inside the region is better than what was found.
        inside = region.contains(*two_clusters)
        if inside.any():
            there = two_clusters[0][inside], two_clusters[1][inside]
            rivals = brute_force.log_density(KERNEL, se3.Poses.of(*two_clusters), se3.Poses.of(*there))
            assert grasp["log_density"] >= rivals.max() - 1e-3


def test_world_frame_equals_object_frame(thing: httpx.Client) -> None:
    """A box in the world, of a tilted object, is askew in the object frame."""
    rng = np.random.default_rng(2)
    shift, turn = np.array([0.5, -0.3, 0.8]), se3.normalise(rng.normal(size=4))
    object_pose = [*shift, *turn]
    top = shift + se3.rotate(turn, np.array([0, 0, 0.06]))
    lower, upper = top + np.array([-0.1, -0.1, 0.005]), top + np.array([0.1, 0.1, 0.1])
    plane_normal = se3.rotate(turn, np.array([1.0, 0, 0]))
    query = {
        "object_pose": object_pose,
        "box_min": lower,
        "box_max": upper,
        "approach": se3.rotate(turn, np.array([0.2, 0, -1.0])),
        "approach_cone_deg": 10,
        "above_plane": [*plane_normal, float(plane_normal @ shift) - 0.004],
        "sphere": [*top, 0.05],
        "closing": se3.rotate(turn, np.array([0, 1.0, 0])),
        "closing_cone_deg": 40,
    }
    answer = best(thing, **query)
    assert answer["status"] == "ok"
    (grasp,) = answer["grasps"]
    position, quaternion = np.array(grasp["position"]), np.array(grasp["quaternion_xyzw"])
    world = np.array(grasp["world"]["position"]), np.array(grasp["world"]["quaternion_xyzw"])
    np.testing.assert_allclose(world[0], shift + se3.rotate(turn, position), atol=1e-12)
    assert se3.angle_between(world[1], se3.multiply(turn, quaternion)) < 1e-7
    assert (world[0] >= lower - 1e-6).all()
    assert (world[0] <= upper + 1e-6).all()
    assert np.linalg.norm(world[0] - top) <= 0.05 + 1e-6
    assert plane_normal @ world[0] >= query["above_plane"][3] - 1e-6
    axis = query["approach"] / np.linalg.norm(query["approach"])
    assert np.degrees(np.arccos(se3.rotate(world[1], [0, 0, 1.0]) @ axis)) <= 10 + 1e-4
    assert "box_min" in grasp["active_constraints"]

    # The same in the object frame: the box's faces as its planes, one query a face would be six.
    in_object = best(
        thing,
        object_pose=object_pose,
        frame="object",
        approach=[0.2, 0, -1],
        approach_cone_deg=10,
        above_plane=[1, 0, 0, -0.004],
        sphere=[0, 0, 0.06, 0.05],
    )["grasps"][0]
    in_world = best(
        thing,
        object_pose=object_pose,
        approach=query["approach"],
        approach_cone_deg=10,
        above_plane=query["above_plane"],
        sphere=query["sphere"],
    )["grasps"][0]
    np.testing.assert_allclose(in_object["position"], in_world["position"], atol=1e-4)
    np.testing.assert_allclose(in_object["log_density"], in_world["log_density"], atol=1e-3)
    np.testing.assert_allclose(
        in_object["world"]["position"], shift + se3.rotate(turn, np.array(in_object["position"])), atol=1e-9
    )


def test_several_distinct_grasps(thing: httpx.Client) -> None:
    answer = best(thing, count=5, min_separation_m=0.01, min_separation_deg=25)
    grasps = answer["grasps"]
    assert (answer["status"], len(grasps)) == ("ok", 5)
    logs = [grasp["log_density"] for grasp in grasps]
    assert logs == sorted(logs, reverse=True)
    for i, a in enumerate(grasps):
        for b in grasps[:i]:
            qa, qb = np.array(a["quaternion_xyzw"]), np.array(b["quaternion_xyzw"])
            angle = min(se3.angle_between(qa, qb), se3.angle_between(qa, se3.jaw_twin(qb)))
            apart = np.linalg.norm(np.subtract(a["position"], b["position"]))
            assert apart > 0.01 - 1e-9 or angle > np.deg2rad(25) - 1e-7
    two = best(thing, count=10, min_separation_m=0.12, min_separation_deg=180)
    assert two["status"] == "fewer"
    assert 1 <= len(two["grasps"]) < 10


def test_nearest_trials_are_the_nearest_successes(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    post(http, "thing", two_clusters, "dropped")
    post(http, "thing", two_clusters)
    (grasp,) = best(http)["grasps"]
    seqs = grasp["nearest_trials"]
    assert len(seqs) == 5
    assert min(seqs) > 500
    position, quaternion = np.array(grasp["position"]), np.array(grasp["quaternion_xyzw"])
    angle = np.minimum(
        se3.angle_between(two_clusters[1], quaternion),
        se3.angle_between(two_clusters[1], se3.jaw_twin(quaternion)),
    )
    squared = (np.linalg.norm(two_clusters[0] - position, axis=1) / 0.015) ** 2
    measure = 0.5 * squared + KERNEL.kappa * (1 - np.cos(angle / 2))
    assert seqs == (np.argsort(measure)[:5] + 501).tolist()


def test_infeasible_says_the_nearest(thing: httpx.Client) -> None:
    answer = best(thing, box_min=[1, 1, 1], box_max=[2, 2, 2])
    assert (answer["status"], answer["grasps"]) == ("infeasible", [])
    assert answer["nearest"]["position"][2] > 0.05
    assert answer["nearest"]["nearest_trials"]
    answer = best(thing, approach=[0, 0, 1], approach_cone_deg=5)
    assert answer["status"] == "infeasible"
    assert answer["nearest"] is not None


def test_no_successes(http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses) -> None:
    make_object(http)
    for outcome in (None, "missed"):
        if outcome:
            post(http, "thing", two_clusters, outcome)
        answer = best(http)
        assert (answer["status"], answer["grasps"], answer["nearest"]) == ("no_successes", [], None)


def test_collision_free(
    http: httpx.Client,
    make_object: Make,
    put_box: Callable[..., Scene],
    post: Post,
    clusters: Callable[..., Poses],
) -> None:
    """Grasps of a box from above, half of them so deep that the palm is inside it."""
    make_object(http)
    scene = put_box(http, "thing")
    centres = [((0, 0, 0.045), (1.0, 0, 0, 0)), ((0, 0, -0.01), (1.0, 0, 0, 0))]
    shallow, deep = clusters(centres[:1], 100, seed=1), clusters(centres[1:], 300, seed=2)
    trials = np.concatenate([shallow[0], deep[0]]), np.concatenate([shallow[1], deep[1]])
    post(http, "thing", trials)

    # Trials without a gripper: nothing is known of collisions, until a gripper is named.
    assert best(http)["grasps"][0]["collision_free"] is None
    refused = http.get("/objects/thing/best-grasp?collision_free=true")
    assert refused.status_code == 409
    assert "gripper" in refused.json()["title"]

    blind = best(http, gripper="pg70", collision_free=False)["grasps"][0]
    assert blind["collision_free"] is False
    free = best(http, gripper="pg70", count=3)
    assert free["grasps"]
    for grasp in free["grasps"]:
        assert grasp["collision_free"] is True
        assert not scene.collides(ToolPoses([grasp["position"]], [grasp["quaternion_xyzw"]]), PG70)[0]
        assert grasp["log_density"] < blind["log_density"]
    answer = http.post(
        "/objects/thing/likelihood",
        json={
            "poses": {"position": trials[0].tolist(), "quaternion_xyzw": trials[1].tolist()},
            "gripper": "pg70",
        },
    ).json()
    assert answer["collision_free"] == (~scene.collides(ToolPoses(*trials), PG70)).tolist()
    assert len(set(answer["collision_free"])) == 2
    # Where everything in reach collides, that is infeasible.
    inside = best(http, gripper="pg70", box_min=[-0.01, -0.01, -0.03], box_max=[0.01, 0.01, 0.0])
    assert inside["status"] == "infeasible"
    assert inside["nearest"]["collision_free"] is True


def test_collision_needs_a_mesh(
    sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(sqlite_http)
    post(sqlite_http, "thing", two_clusters, gripper="pg70")
    assert best(sqlite_http)["grasps"][0]["collision_free"] is None
    refused = sqlite_http.post("/objects/thing/best-grasp", json={"collision_free": True})
    assert refused.status_code == 409
    assert refused.json()["type"].endswith("collision-unknown")
    assert "mesh" in refused.json()["title"]


def test_asymmetric_jaw_has_a_signed_closing_direction(
    sqlite_http: httpx.Client, make_object: Make, post: Post, clusters: Callable[..., Poses]
) -> None:
    http = sqlite_http
    make_object(http)
    profile = {
        "max_opening_m": 0.07,
        "finger": {"width_m": 0.02, "thickness_m": 0.01, "length_m": 0.05},
        "palm_size_m": [0.05, 0.05, 0.05],
        "symmetric": False,
    }
    assert http.post("/grippers", json={"id": "hook", **profile}).status_code == 201
    post(http, "thing", clusters([((0, 0, 0.06), (1.0, 0, 0, 0))], 100), gripper="hook")
    # Turned about x by half a turn, the tool's y points along -y.
    assert best(http, closing=[0, -1, 0], closing_cone_deg=40)["status"] == "ok"
    assert best(http, closing=[0, 1, 0], closing_cone_deg=40)["status"] == "infeasible"


BAD = [
    ({"box_min": [0, 0, 1], "box_max": [1, 1, 0]}, {"box_min", "box_max"}),
    ({"box_min": [0, 0]}, {"box_min.2"}),
    ({"box_min": [0, 0, 0, 0]}, {"box_min"}),
    ({"box_max": [0, 0, 5000]}, {"box_max"}),
    ({"approach": [0, 0, 1]}, {"approach_cone_deg"}),
    ({"approach_cone_deg": 10}, {"approach"}),
    ({"closing": [0, 0, 1]}, {"closing_cone_deg"}),
    ({"closing_cone_deg": 10}, {"closing"}),
    ({"approach": [0, 0, 0], "approach_cone_deg": 10}, {"approach"}),
    ({"approach": [0, 0, 1], "approach_cone_deg": 0}, {"approach_cone_deg"}),
    ({"approach": [0, 0, 1], "approach_cone_deg": 181}, {"approach_cone_deg"}),
    (
        {"approach": [0, 0, 1], "approach_cone_deg": 5, "closing": [0, 0, 1], "closing_cone_deg": 5},
        {"approach_cone_deg", "closing_cone_deg"},
    ),
    ({"box_min": [1, 1, 1], "sphere": [0, 0, 0, 0.1], "above_plane": [0, 0, 1, 0]}, {"box_min", "sphere"}),
    (
        {"above_plane": [0, 0, 1, 0.5], "box_max": [1, 1, 0.4], "box_min": [0, 0, 0]},
        {"above_plane", "box_max"},
    ),
    ({"objective": "robust"}, {"pose_noise_m", "pose_noise_deg", "tool_noise_m", "tool_noise_deg"}),
    ({"pose_noise_m": 0.01}, {"pose_noise_m"}),
    ({"objective": "success_probability", "tool_noise_deg": 3}, {"tool_noise_deg"}),
    ({"robust_of": "density"}, {"robust_of"}),
    ({"objective": "robust", "pose_noise_m": -1}, {"pose_noise_m"}),
    ({"objective": "robust", "pose_noise_deg": 91}, {"pose_noise_deg"}),
    ({"pregrasp_distance_m": 0.1, "collision_free": False}, {"pregrasp_distance_m", "collision_free"}),
    ({"pregrasp_distance_m": 3}, {"pregrasp_distance_m"}),
    ({"max_width_m": 0}, {"max_width_m"}),
    ({"include": ["luck"]}, {"include.0"}),
    ({"sphere": [0, 0, 0, 0]}, {"sphere"}),
    ({"sphere": [0, 0, 0, -1]}, {"sphere"}),
    ({"above_plane": [0, 0, 0, 1]}, {"above_plane"}),
    ({"frame": "world"}, {"object_pose"}),
    ({"frame": "a camera"}, {"frame"}),
    ({"object_pose": [0, 0, 0, 0, 0, 0, 0]}, {"object_pose"}),
    ({"object_pose": [0, 0, 0, 0, 0, 0, 2]}, {"object_pose"}),
    ({"count": 0}, {"count"}),
    ({"count": 10**6}, {"count"}),
    ({"objective": "luck"}, {"objective"}),
    ({"min_separation_m": 0}, {"min_separation_m"}),
    ({"min_separation_deg": 400}, {"min_separation_deg"}),
    ({"collision_free": "perhaps"}, {"collision_free"}),
    ({"box_mim": [0, 0, 0]}, {"box_mim"}),
]


POSTED_BAD = [
    ({"half_spaces": [[0, 0, 0, 1]]}, {"half_spaces.0"}),
    ({"half_spaces": [[0, 0, 1, 1], [0, 0, -1, 0]]}, {"half_spaces.0", "half_spaces.1"}),
    ({"half_spaces": [[0, 0, 1]]}, {"half_spaces.0.3"}),
    ({"half_spaces": [[0, 0, 1, 0]] * 201}, {"half_spaces"}),
    (
        {"obstacles": {"boxes": [{"size_m": [1, 1, 0], "position": [0, 0, 0]}]}},
        {"obstacles.boxes.0.size_m.2"},
    ),
    ({"obstacles": {"boxes": [{"size_m": [1, 1, 1]}]}}, {"obstacles.boxes.0.position"}),
    ({"obstacles": {"points": [[0, 0]]}}, {"obstacles.points.0.2"}),
    ({"obstacles": {"points": [[0, 0, 0]] * 50_001}}, {"obstacles.points"}),
    ({"obstacles": {"point_radius_m": -1}}, {"obstacles.point_radius_m"}),
    ({"obstacles": {"ponits": []}}, {"obstacles.ponits"}),
]


def test_bad_requests_name_the_field(
    sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    http = sqlite_http
    make_object(http)
    post(http, "thing", two_clusters)
    path = "/objects/thing/best-grasp"
    for query, named in BAD:
        assert fields(http.post(path, json=query)) == named, query
        joined = {k: ",".join(map(str, v)) if isinstance(v, list) else v for k, v in query.items()}
        assert fields(http.get(path, params=joined)) == named, query
    for query, named in POSTED_BAD:
        assert fields(http.post(path, json=query)) == named, query
        assert fields(http.get(path, params={next(iter(query)): "1"})) == {next(iter(query))}
    for name in ("candidates", "exclude"):
        bad = {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 2]}
        named = fields(http.post(path, json={name: [bad]}))
        assert any(item.startswith(f"{name}.") for item in named), named
    floats = ("box_min", "sphere", "above_plane", "approach", "object_pose")
    for name in floats:
        width = {"box_min": 3, "approach": 3, "object_pose": 7}.get(name, 4)
        for bad in ("nan", "inf", "1e999", "x", ""):
            value = ",".join(["0"] * (width - 1) + [bad])
            named = fields(http.get(path, params={name: value, "approach_cone_deg": 10}))
            assert any(item.split(".")[0] == name for item in named), (name, bad, named)
        raw = f'{{"{name}": [{",".join(["0"] * (width - 1) + ["1e999"])}]}}'
        answer = http.post(path, content=raw, headers={"Content-Type": "application/json"})
        assert answer.status_code in (400, 422), raw
    assert http.get("/objects/none/best-grasp").status_code == 404


def pose_of(grasp: dict[str, Any]) -> Poses:
    return np.array([grasp["position"]]), np.array([grasp["quaternion_xyzw"]])


def posted(http: httpx.Client, **body: Any) -> dict[str, Any]:
    body |= {"sigma_position_m": 0.015, "sigma_rotation_deg": 15}
    answer = http.post("/objects/thing/best-grasp", json=body)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_half_spaces_in_either_frame(thing: httpx.Client) -> None:
    free = best(thing)["grasps"][0]
    shift, turn = np.array([0.5, -0.3, 0.8]), se3.normalise(np.array([0.3, -0.2, 0.5, 0.7]))
    rows = [[0.0, 0.0, 2.0, 0.14], [1.0, 1.0, 0.0, 0.005]]
    in_object = posted(thing, half_spaces=rows)["grasps"][0]
    assert set(in_object["active_constraints"]) == {"half_spaces.0", "half_spaces.1"}
    assert in_object["position"][2] == pytest.approx(0.07, abs=1e-6)
    assert in_object["log_density"] < free["log_density"]
    turned = [[*(n := se3.rotate(turn, np.array(row[:3]))), row[3] + float(n @ shift)] for row in rows]
    in_world = posted(thing, half_spaces=turned, object_pose=[*shift, *turn])["grasps"][0]
    np.testing.assert_allclose(in_world["position"], in_object["position"], atol=1e-4)
    in_object = posted(thing, half_spaces=rows, object_pose=[*shift, *turn], frame="object")["grasps"][0]
    assert in_object["active_constraints"] == ["half_spaces.0", "half_spaces.1"]


def test_candidates_are_ranked_as_they_are(thing: httpx.Client, two_clusters: Poses) -> None:
    density = GraspDensity.build(se3.Poses.of(*two_clusters), kernel=KERNEL)
    rows = np.arange(0, 500, 7)
    p, q = two_clusters[0][rows], two_clusters[1][rows]
    candidates = {"position": p.tolist(), "quaternion_xyzw": q.tolist()}
    answer = posted(thing, candidates=candidates, count=10)
    order = np.argsort(-density.log_density(se3.Poses.of(p, q)))[:10]
    assert [grasp["candidate"] for grasp in answer["grasps"]] == order.tolist()
    np.testing.assert_allclose(answer["grasps"][0]["position"], p[order[0]], atol=1e-12)
    assert [grasp["score"] for grasp in answer["grasps"]] == [g["density"] for g in answer["grasps"]]
    # Under constraints, and more of them than there are.
    answer = posted(thing, candidates=candidates, count=100, box_max=[1, 1, 0.03])
    assert answer["status"] == "fewer"
    assert {g["candidate"] for g in answer["grasps"]} == set(np.flatnonzero(p[:, 2] <= 0.03).tolist())
    # In the world, where the object stands elsewhere, they are poses in the world.
    shift, turn = np.array([0.5, -0.3, 0.8]), se3.normalise(np.array([0.3, -0.2, 0.5, 0.7]))
    there = se3.compose(se3.Poses(shift, turn), se3.Poses(p, q))
    listed = [
        {"position": a, "quaternion_xyzw": b}
        for a, b in zip(there.positions.tolist(), there.quaternions_xyzw.tolist(), strict=True)
    ]
    answer = posted(thing, candidates=listed, object_pose=[*shift, *turn])
    (grasp,) = answer["grasps"]
    assert grasp["candidate"] == order[0]
    np.testing.assert_allclose(grasp["world"]["position"], there.positions[order[0]], atol=1e-9)
    # None fits: the nearest one is said.
    answer = posted(thing, candidates=candidates, box_min=[1, 1, 1])
    assert (answer["status"], answer["grasps"]) == ("infeasible", [])
    assert answer["nearest"]["candidate"] is not None
    # Distinct where that is asked for.
    answer = posted(thing, candidates=candidates, count=10, min_separation_m=0.05, min_separation_deg=180)
    first, *rest = answer["grasps"]
    assert first["candidate"] == order[0]
    for grasp in rest:
        assert np.linalg.norm(np.subtract(grasp["position"], first["position"])) > 0.05


def test_excluded_poses_are_not_come_near(thing: httpx.Client) -> None:
    before = posted(thing)["grasps"][0]
    excluded = []
    for _ in range(4):
        answer = posted(thing, exclude=excluded, min_separation_m=0.02, min_separation_deg=30)
        (grasp,) = answer["grasps"]
        p, q = pose_of(grasp)
        for other in excluded:
            away = np.linalg.norm(p[0] - other["position"])
            angle = min(
                se3.angle_between(q[0], other["quaternion_xyzw"]),
                se3.angle_between(q[0], se3.jaw_twin(other["quaternion_xyzw"])),
            )
            assert away > 0.02 or angle > np.deg2rad(30)
        assert grasp["log_density"] <= before["log_density"] + 1e-6
        before = grasp
        excluded.append({name: grasp[name] for name in ("position", "quaternion_xyzw")})
    everything = {"position": [[0.0, 0.0, 0.0]], "quaternion_xyzw": [[0, 0, 0, 1]]}
    answer = posted(thing, exclude=everything, min_separation_m=1, min_separation_deg=180)
    assert (answer["status"], answer["nearest"]) == ("infeasible", None)


def test_obstacles_width_and_approach(
    http: httpx.Client,
    make_object: Make,
    put_box: Callable[..., Scene],
    post: Post,
    clusters: Callable[..., Poses],
) -> None:
    """A bar, 20 mm by 60 mm wide and 100 mm high, grasped from above across either side, and from a side."""
    make_object(http)
    box = put_box(http, "thing", (0.02, 0.06, 0.1))
    narrow, wide = (2**-0.5, 2**-0.5, 0.0, 0.0), (1.0, 0, 0, 0)
    trials = clusters([((0, 0, 0.04), wide)], 300, seed=1, sigma_m=0.003, sigma_rad=0.03)
    thin = clusters([((0, 0, 0.04), narrow)], 100, seed=2, sigma_m=0.003, sigma_rad=0.03)
    post(http, "thing", (np.concatenate([trials[0], thin[0]]), np.concatenate([trials[1], thin[1]])))
    for query in (
        {"obstacles": {"points": [[0, 0, 1]]}},
        {"max_width_m": 0.05},
        {"pregrasp_distance_m": 0.1},
    ):
        refused = http.post("/objects/thing/best-grasp", json=query)
        assert refused.status_code == 409, query
        assert "gripper" in refused.json()["title"]

    (grasp,) = posted(http, gripper="pg70")["grasps"]
    assert grasp["width_m"] == pytest.approx(0.06, abs=0.003)
    assert grasp["width_m"] == pytest.approx(box.widths(ToolPoses(*pose_of(grasp)), PG70)[0], abs=1e-6)
    (grasp,) = posted(http, gripper="pg70", max_width_m=0.04)["grasps"]
    assert grasp["width_m"] == pytest.approx(0.02, abs=0.003)
    assert posted(http, gripper="pg70", max_width_m=0.01)["status"] == "infeasible"

    # The wide grasp's palm, 112 mm along y, runs into a box beside the bar; the narrow one's does not.
    object_pose = [0.4, 0.1, 0.2, 0, 0, 2**-0.5, 2**-0.5]  # turned: the object's y is the world's -x
    beside = {"size_m": [0.02, 0.02, 0.02], "position": [0.4 - 0.05, 0.1, 0.2 + 0.1]}
    answer = posted(http, gripper="pg70", object_pose=object_pose, obstacles={"boxes": [beside]})
    (grasp,) = answer["grasps"]
    assert grasp["width_m"] < 0.04
    cloud = {"points": [[0.35, 0.1, 0.3 + dz] for dz in np.linspace(-0.01, 0.01, 5)], "point_radius_m": 0.01}
    answer = posted(http, gripper="pg70", object_pose=object_pose, obstacles=cloud)
    assert answer["grasps"][0]["width_m"] < 0.04
    # In the object frame the same numbers are far away.
    answer = posted(
        http, gripper="pg70", object_pose=object_pose, frame="object", obstacles={"boxes": [beside]}
    )
    assert answer["grasps"][0]["width_m"] > 0.05

    # A shelf 0.3 m above is in the way of an approach from above that starts far back.
    shelf = {"boxes": [{"size_m": [1, 1, 0.01], "position": [0, 0, 0.45]}]}
    near = posted(http, gripper="pg70", obstacles=shelf, pregrasp_distance_m=0.1)
    assert near["status"] == "ok"
    assert posted(http, gripper="pg70", obstacles=shelf, pregrasp_distance_m=0.4)["status"] == "infeasible"

"""Poses come and go in any frame of the gripper and with anybody's axes; what is kept is the tool's."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from graspdb.wire import CONVENTIONS
from graspdb.wire.frames.conventions import OWN_AXES, to_graspdb
from graspdb_density import se3

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]

TURN = [0.0, 0.0, np.sin(np.pi / 8), np.cos(np.pi / 8)]
MINE: dict[str, Any] = {
    "id": "mine",
    "max_opening_m": 0.08,
    "finger": {"width_m": 0.01, "thickness_m": 0.01, "length_m": 0.05},
    "tip_offset_m": 0.01,
    "palm_size_m": [0.05, 0.08, 0.05],
    "base_to_tool": {"position": [0.01, 0, 0.12], "quaternion_xyzw": TURN},
    "frames": {
        "flange": {"position": [0, 0, -0.02], "quaternion_xyzw": [0, 0, -TURN[2], TURN[3]]},
        "camera": {"position": [0.05, 0.02, 0.03], "quaternion_xyzw": [0.5, 0.5, -0.5, 0.5]},
    },
}
BARE = {
    **{name: value for name, value in MINE.items() if name not in ("base_to_tool", "frames")},
    "id": "bare",
}
ARROW = "application/vnd.apache.arrow.stream"


def matrix(position: Any, quaternion: Any) -> Floats:
    out = np.zeros((*np.shape(position)[:-1], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = se3.to_matrix(quaternion), position, 1.0
    return out


def expected(tool: Floats, frame: str, convention: str) -> Floats:
    """What poses of the tool are in another frame of the gripper, by matrices."""
    named = {"tool": MINE["base_to_tool"], "base": None, **MINE["frames"]}[frame]
    base_to_tool = matrix(MINE["base_to_tool"]["position"], MINE["base_to_tool"]["quaternion_xyzw"])
    there = np.eye(4) if named is None else matrix(named["position"], named["quaternion_xyzw"])
    fixed = np.asarray(np.linalg.inv(base_to_tool) @ there)
    if convention not in OWN_AXES:
        fixed[:3, :3] = np.array(to_graspdb(convention)).T  # type: ignore[arg-type]
    return np.asarray(tool @ fixed)


@pytest.fixture(scope="module")
def served(
    serve_module: Callable[..., str], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[httpx.Client]:
    url = serve_module(f"sqlite:///{tmp_path_factory.mktemp('frames')}/graspdb.sqlite")
    with httpx.Client(base_url=url, timeout=60) as http:
        yield http


@pytest.fixture(scope="module")
def thing(
    served: httpx.Client, make_object: Callable[..., str], post: Callable[..., Any], two_clusters: Poses
) -> str:
    """An object with 500 successes and some failures of a gripper whose frames are turned and shifted."""
    for gripper in (MINE, BARE):
        assert served.post("/grippers", json=gripper).status_code == 201
    slug = make_object(served, frames={"tracker": {"position": [0, 0.1, 0], "quaternion_xyzw": [0, 0, 1, 0]}})
    post(served, slug, two_clusters, gripper="mine")
    few = two_clusters[0][::10], two_clusters[1][::10]
    post(served, slug, few, "slipped", gripper="mine")
    return slug


def get(http: httpx.Client, place: str, **query: Any) -> Any:
    answer = http.get(place, params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


def problem(answer: httpx.Response) -> tuple[int, str, list[str]]:
    told = answer.json()
    return answer.status_code, told["type"].rpartition(":")[2], [e["field"] for e in told.get("errors", [])]


WORLD = [0.5, -0.3, 0.8, *se3.normalise([0.3, -0.2, 0.5, 0.7]).tolist()]


@pytest.mark.parametrize("frame", ["tool", "base", "flange", "camera"])
def test_the_best_grasps_are_of_the_frame(served: httpx.Client, thing: str, frame: str) -> None:
    place, pose = f"/objects/{thing}/best-grasp", ",".join(map(str, WORLD))
    plain = get(served, place, count=3, object_pose=pose)
    assert (plain["frame"], plain["convention"], plain["reference"]) == ("tool", "graspdb", "world")
    assert plain["tool_to_frame"] is None
    ids = {plain["answer"]}
    for convention in CONVENTIONS:
        told = get(served, place, count=3, object_pose=pose, frame=frame, convention=convention)
        assert (told["frame"], told["convention"]) == (frame, convention)
        ids.add(told["answer"])
        for grasp, tool in zip(told["grasps"], plain["grasps"], strict=True):
            for own, other in ((grasp, tool), (grasp["world"], tool["world"])):
                found = matrix(own["position"], own["quaternion_xyzw"])
                of_tool = matrix(other["position"], other["quaternion_xyzw"])
                np.testing.assert_allclose(found, expected(of_tool, frame, convention), atol=1e-9)
            assert grasp["density"] == tool["density"]
            if told["tool_to_frame"] is not None:
                fixed = matrix(*told["tool_to_frame"].values())
                np.testing.assert_allclose(of_tool @ fixed, found, atol=1e-9)
    # Another question, another answer: by its id, and by its ETag.
    assert len(ids) == len(CONVENTIONS) + 1
    seen = served.get(place, params={"frame": frame}).headers["etag"]
    again = served.get(
        place, params={"frame": frame, "convention": "graspnet"}, headers={"If-None-Match": seen}
    )
    assert again.status_code == 200
    assert served.get(place, params={"frame": frame}, headers={"If-None-Match": seen}).status_code == 304


def test_an_answer_is_asked_again_in_its_frame(served: httpx.Client, thing: str) -> None:
    told = get(served, f"/objects/{thing}/best-grasp", frame="flange", convention="graspnet", count=2)
    kept = get(served, f"/answers/{told['answer']}", now="true")
    assert kept["question"] == {"count": 2, "frame": "flange", "convention": "graspnet"}
    assert kept["result"] == told


def test_constraints_are_about_the_tool_whatever_the_frame(served: httpx.Client, thing: str) -> None:
    place = f"/objects/{thing}/best-grasp"
    limits = {
        "box_min": "-0.1,-0.1,-0.02",
        "box_max": "-0.06,0.1,0.02",
        "approach": "1,0,0",
        "approach_cone_deg": 20,
    }
    plain = get(served, place, **limits)["grasps"][0]
    grasp = get(served, place, frame="camera", **limits)["grasps"][0]
    found = matrix(grasp["position"], grasp["quaternion_xyzw"])
    tool = matrix(plain["position"], plain["quaternion_xyzw"])
    np.testing.assert_allclose(found, expected(tool, "camera", "graspdb"), atol=1e-9)
    none = get(
        served,
        place,
        frame="camera",
        box_min="1,1,1",
        sphere="1,1,1,0.1",
        approach="0,0,-1",
        approach_cone_deg=1,
    )
    assert none["status"] == "infeasible"
    assert none["nearest"] is not None
    same = get(served, place, box_min="1,1,1", sphere="1,1,1,0.1", approach="0,0,-1", approach_cone_deg=1)
    assert (none["conflict"], none["relax"]) == (same["conflict"], same["relax"])


def test_candidates_and_exclusions_are_of_the_frame(
    served: httpx.Client, thing: str, two_clusters: Poses
) -> None:
    p, q = (part[::25] for part in two_clusters)
    given = expected(matrix(p, q), "flange", "acronym")
    listed = [{"matrix": one.tolist()} for one in given]
    place = f"/objects/{thing}/best-grasp"

    def ranked(**request: Any) -> list[int]:
        answer = served.post(place, json={"count": 5, **request})
        assert answer.status_code == 200, answer.text
        return [grasp["candidate"] for grasp in answer.json()["grasps"]]

    plain = [{"matrix": one.tolist()} for one in matrix(p, q)]
    framed = {"frame": "flange", "convention": "acronym"}
    assert ranked(candidates=listed, **framed) == ranked(candidates=plain)
    kept = ranked(candidates=listed, exclude=listed[:12], **framed)
    assert kept == ranked(candidates=plain, exclude=plain[:12]) != ranked(candidates=plain)


def test_of_two_twins_the_nearer_one_is_given(served: httpx.Client, thing: str) -> None:
    place, pose = f"/objects/{thing}/best-grasp", ",".join(map(str, WORLD))
    for more in ({}, {"object_pose": pose}, {"object_pose": pose, "reference": "object"}):
        for frame, convention in (("tool", "graspdb"), ("camera", "graspnet")):
            asked = {**more, "frame": frame, "convention": convention}
            plain = get(served, place, **asked)["grasps"][0]
            tool = get(served, place, **more)["grasps"][0]
            where = "world" if more == {"object_pose": pose} else None
            of_tool = np.array((tool[where] if where else tool)["quaternion_xyzw"])
            answers = []
            for quaternion in (of_tool, se3.jaw_twin(of_tool)):
                wanted = expected(matrix([0, 0, 0], quaternion), frame, convention)[:3, :3]
                near = se3.multiply(se3.from_matrix(wanted), se3.from_rotation_vector([0.3, 0.2, -0.4]))
                told = get(served, place, **asked, near=",".join(map(str, near)))["grasps"][0]
                own = (told[where] if where else told)["quaternion_xyzw"]
                np.testing.assert_allclose(se3.to_matrix(own), wanted, atol=1e-9)
                answers.append(told)
            assert answers[0]["density"] == answers[1]["density"] == plain["density"]
    assert problem(served.get(place, params={"near": "0,0,0,2"})) == (422, "invalid-request", ["near"])


def test_likelihoods_are_the_same_in_every_frame(
    served: httpx.Client, thing: str, two_clusters: Poses
) -> None:
    place, (p, q) = f"/objects/{thing}/likelihood", (part[::50] for part in two_clusters)
    plain = served.post(place, json={"poses": {"position": p.tolist(), "quaternion_xyzw": q.tolist()}}).json()
    for frame in ("base", "camera"):
        for convention in ("graspdb", "graspnet"):
            given = expected(matrix(p, q), frame, convention)
            asked = {"frame": frame, "convention": convention}
            told = served.post(
                place, json={"poses": [{"matrix": one.tolist()} for one in given], **asked}
            ).json()
            assert (told["frame"], told["convention"]) == (frame, convention)
            for name in ("log_density", "success_probability", "effective_trials"):
                np.testing.assert_allclose(told[name], plain[name], rtol=1e-6)
    first = {"position": ",".join(map(str, given[0, :3, 3])), **asked}
    turn = ",".join(map(str, se3.from_matrix(given[0, :3, :3])))
    one = get(served, place, quaternion_xyzw=turn, **first)
    np.testing.assert_allclose(one["log_density"], plain["log_density"][:1], rtol=1e-6)


@pytest.mark.parametrize("kind", ["samples", "proposals"])
def test_draws_are_of_the_frame(served: httpx.Client, thing: str, kind: str) -> None:
    place = f"/objects/{thing}/{kind}"
    plain = served.post(place, json={"count": 20, "seed": 4}).json()
    told = served.post(place, json={"count": 20, "seed": 4, "frame": "base", "convention": "acronym"}).json()
    tool = matrix(np.array(plain["position"]), np.array(plain["quaternion_xyzw"]))
    found = matrix(np.array(told["position"]), np.array(told["quaternion_xyzw"]))
    np.testing.assert_allclose(found, expected(tool, "base", "acronym"), atol=1e-9)
    assert told["proposal_density"] == plain["proposal_density"]
    assert (told["frame"], told["convention"]) == ("base", "acronym")
    assert any("turned" in warning for warning in told["warnings"])


def test_what_can_not_be_told_is_refused_with_the_way_out(
    served: httpx.Client,
    thing: str,
    make_object: Callable[..., str],
    post: Callable[..., Any],
    two_clusters: Poses,
) -> None:
    place = f"/objects/{thing}/best-grasp"
    unknown = served.get(place, params={"frame": "wrist"})
    assert problem(unknown) == (422, "invalid-request", ["frame"])
    assert "base, tool, flange, camera" in unknown.json()["errors"][0]["message"]
    assert problem(served.get(place, params={"frame": "a b"}))[0] == 422
    assert problem(served.get(place, params={"convention": "mine"}))[2] == ["convention"]
    both = served.get(place, params={"frame": "object", "reference": "object"})
    assert problem(both) == (422, "invalid-request", ["frame", "reference"])
    bare = served.get(place, params={"gripper": "bare", "frame": "base"})
    assert problem(bare)[:2] == (409, "tool-unknown")
    assert "PUT /grippers/bare with base_to_tool" in bare.json()["title"]
    assert (
        get(served, place, gripper="bare", prior="false", convention="graspnet")["convention"] == "graspnet"
    )

    nameless = make_object(served, "nameless")
    post(served, nameless, two_clusters)
    told = served.get(f"/objects/{nameless}/best-grasp", params={"frame": "flange"})
    assert problem(told)[:2] == (409, "gripper-unknown")
    assert get(served, f"/objects/{nameless}/best-grasp", frame="flange", gripper="mine")["frame"] == "flange"
    # The tool's axes need no gripper.
    assert get(served, f"/objects/{nameless}/best-grasp", convention="graspnet")["frame"] == "tool"


def test_the_reference_by_either_name_is_the_same(served: httpx.Client, thing: str) -> None:
    place, pose = f"/objects/{thing}/best-grasp", ",".join(map(str, WORLD))
    for reference in ("world", "object"):
        asked = {"object_pose": pose, "approach": "0,0,-1", "approach_cone_deg": 100}
        old = get(served, place, frame=reference, **asked)
        new = get(served, place, reference=reference, **asked)
        assert (old["reference"], old["frame"], old["grasps"]) == (reference, "tool", new["grasps"])
    for name in ("frame", "reference"):
        assert problem(served.get(place, params={name: "world"}))[2] == ["object_pose"]


@pytest.mark.parametrize("kind", ["application/json", "application/x-ndjson", ARROW])
def test_trials_come_and_go_in_a_frame(
    served: httpx.Client, thing: str, make_object: Callable[..., str], two_clusters: Poses, kind: str
) -> None:
    slug = make_object(served, f"posted-{kind.rpartition('/')[2].rpartition('.')[2]}")
    tool = matrix(*(part[:6] for part in two_clusters))
    given = expected(tool, "flange", "graspnet")
    covariance = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4]).tolist()
    rows = [
        {
            "position": one[:3, 3].tolist(),
            "quaternion_xyzw": se3.from_matrix(one[:3, :3]).tolist(),
            "outcome": "success",
            "gripper": "mine",
            "achieved_pose": {
                "position": one[:3, 3].tolist(),
                "quaternion_xyzw": se3.from_matrix(one[:3, :3]).tolist(),
            },
            "pose_covariance": covariance,
        }
        for one in given
    ]
    place, framed = f"/objects/{slug}/trials", {"frame": "flange", "convention": "graspnet"}
    body = {
        "application/json": lambda: json.dumps({"trials": rows}).encode(),
        "application/x-ndjson": lambda: "\n".join(map(json.dumps, rows)).encode(),
        ARROW: lambda: _arrow(rows),
    }[kind]()
    made = served.post(place, params=framed, content=body, headers={"Content-Type": kind})
    assert made.status_code == 201, made.text

    stored = get(served, place)
    assert (stored["frame"], stored["convention"]) == ("tool", "graspdb")
    _same_poses(stored["items"], tool)
    assert not np.allclose(stored["items"][0]["pose_covariance"], covariance)
    back = served.get(place, params=framed, headers={"Accept": kind})
    assert back.status_code == 200, back.text
    if kind == "application/json":
        assert (back.json()["frame"], back.json()["convention"]) == ("flange", "graspnet")
        items = back.json()["items"]
    elif kind == ARROW:
        table = pa.ipc.open_stream(io.BytesIO(back.content)).read_all()
        assert json.loads(table.schema.metadata[b"graspdb"])["frame"] == "flange"
        items = table.to_pylist()
    else:
        items = [json.loads(line) for line in back.text.splitlines()]
    _same_poses(items, given)
    np.testing.assert_allclose(items[0]["pose_covariance"], covariance, atol=1e-15)
    one = get(served, f"{place}/1", **framed)
    _same_poses([one], given[:1])


def _same_poses(items: list[dict[str, Any]], poses: Floats) -> None:
    for pose in (lambda item: item, lambda item: item["achieved_pose"]):
        found = matrix(
            *(np.array([pose(i)[name] for i in items]) for name in ("position", "quaternion_xyzw"))
        )
        np.testing.assert_allclose(found, poses, atol=1e-9)


def _arrow(rows: list[dict[str, Any]]) -> bytes:
    sink = io.BytesIO()
    table = pa.Table.from_pylist(rows)
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue()


def test_trials_without_a_gripper_have_no_frame_but_the_tool(
    served: httpx.Client, thing: str, make_object: Callable[..., str]
) -> None:
    slug = make_object(served, "mixed")
    place = f"/objects/{slug}/trials"
    trial = {"position": [0, 0, 0.1], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True}

    def posted(gripper: str | None, **params: str) -> httpx.Response:
        return served.post(place, params=params, json={"trials": [{**trial, "gripper": gripper}]})

    refused = posted(None, frame="base")
    assert problem(refused) == (422, "invalid-request", ["trials.0.gripper"])
    assert problem(posted("none", frame="base"))[1] == "unknown-gripper"
    assert problem(posted("bare", frame="base"))[:2] == (409, "tool-unknown")
    assert problem(posted("mine", frame="wrist"))[2] == ["frame"]
    assert get(served, place)["items"] == []
    for gripper in (None, "mine"):
        assert posted(gripper).status_code == 201
    for accept in ("application/json", "application/x-ndjson"):
        told = served.get(place, params={"frame": "base"}, headers={"Accept": accept})
        assert problem(told)[:2] == (409, "gripper-unknown")
    assert len(get(served, place, frame="base", gripper="mine")["items"]) == 1
    assert len(get(served, place, convention="graspnet")["items"]) == 2
    # The same body in another frame is no repetition.
    key = {"Idempotency-Key": "once"}
    first = served.post(place, params={"frame": "base"}, json={**trial, "gripper": "mine"}, headers=key)
    again = served.post(place, params={"frame": "flange"}, json={**trial, "gripper": "mine"}, headers=key)
    assert (first.status_code, problem(again)[1]) == (201, "idempotency-key-reused")


def test_a_trial_is_brought_back_by_the_frames_it_came_with(
    served: httpx.Client, thing: str, make_object: Callable[..., str]
) -> None:
    moving = {**MINE, "id": "moving"}
    served.post("/grippers", json=moving)
    slug = make_object(served, "moved")
    trial = {"position": [0, 0, 0.1], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True, "gripper": "moving"}
    place = f"/objects/{slug}/trials"
    assert served.post(place, params={"frame": "base"}, json=trial).status_code == 201
    del moving["id"]
    other = {"position": [0, 0, 0.2], "quaternion_xyzw": [0, 0, 0, 1]}
    assert served.put("/grippers/moving", json={**moving, "base_to_tool": other}).status_code == 200
    assert served.post(place, params={"frame": "base"}, json=trial).status_code == 201
    back = get(served, place, frame="base")["items"]
    for item in back:
        np.testing.assert_allclose(item["position"], [0, 0, 0.1], atol=1e-12)
    assert [item["gripper_version"] for item in back] == [1, 2]
    tool = get(served, place)["items"]
    assert not np.allclose(tool[0]["position"], tool[1]["position"])


def test_a_promise_is_found_whatever_frame_it_was_given_in(served: httpx.Client, thing: str) -> None:
    best = get(served, f"/objects/{thing}/best-grasp", frame="camera", count=2)
    tried = best["grasps"][1]
    trial = {name: tried[name] for name in ("position", "quaternion_xyzw")}
    posted = served.post(
        f"/objects/{thing}/trials",
        params={"frame": "camera"},
        json={**trial, "outcome": True, "gripper": "mine", "answer": best["answer"], "source": "robot"},
    )
    assert posted.status_code == 201, posted.text
    report = get(served, f"/objects/{thing}/reports/promises", source="robot")
    assert report["trials"] == 1, report
    served.delete(f"/objects/{thing}/batches/{posted.json()['batch']}")


def test_a_pose_may_be_of_a_frame_of_the_object(served: httpx.Client, thing: str) -> None:
    place = f"/objects/{thing}/best-grasp"
    frames = get(served, f"/objects/{thing}")["frames"]
    assert list(frames) == ["mesh", "tracker"]
    tracker = matrix(frames["tracker"]["position"], frames["tracker"]["quaternion_xyzw"])
    mesh = matrix(WORLD[:3], WORLD[3:])
    seen = mesh @ tracker
    pose = [*seen[:3, 3], *se3.from_matrix(seen[:3, :3])]
    within = {"sphere": ",".join(map(str, [*(mesh @ [0, 0, 0.06, 1])[:3], 0.03])), "above_plane": "0,0,1,0"}
    within |= {"approach": ",".join(map(str, mesh[:3, :3] @ [0, 0, -1])), "approach_cone_deg": 30}
    plain = get(served, place, object_pose=",".join(map(str, WORLD)), **within)
    told = get(
        served,
        place,
        object_pose=",".join(map(str, pose)),
        object_frame="tracker",
        reference="world",
        **within,
    )
    assert plain["status"] == told["status"] == "ok"
    np.testing.assert_allclose(
        told["grasps"][0]["world"]["position"], plain["grasps"][0]["world"]["position"], atol=1e-6
    )
    unknown = served.get(place, params={"object_pose": ",".join(map(str, pose)), "object_frame": "lid"})
    assert problem(unknown) == (422, "invalid-request", ["object_frame"])
    assert "mesh, tracker" in unknown.json()["errors"][0]["message"]
    assert problem(served.get(place, params={"object_frame": "tracker"}))[2] == ["object_pose"]


def test_frames_of_an_object_are_changed_together(
    http: httpx.Client, make_object: Callable[..., str]
) -> None:
    slug = make_object(http)
    lid = {"position": [0, 0, 0.1], "quaternion_xyzw": [0, 0, 0, 1]}
    before = get(http, f"/objects/{slug}")
    assert list(before["frames"]) == ["mesh"]
    changed = http.patch(f"/objects/{slug}", json={"frames": {"lid": lid}}).json()
    assert changed["frames"]["lid"] == lid
    assert changed["revision"] == before["revision"] + 1
    again = http.patch(f"/objects/{slug}", json={"frames": changed["frames"]}).json()
    assert again["revision"] == changed["revision"]
    copied = http.post(f"/objects/{slug}/copies", json={"id": "copy"}).json()
    assert copied["frames"] == changed["frames"]
    for frames in ({"world": lid}, {"mesh": lid}, {"lid": {"position": [0, 0, 0]}}, {"a b": lid}):
        assert http.patch(f"/objects/{slug}", json={"frames": frames}).status_code == 422, frames
    assert list(http.patch(f"/objects/{slug}", json={"frames": None}).json()["frames"]) == ["mesh"]


def test_frames_as_far_off_as_they_may_be(served: httpx.Client, thing: str) -> None:
    far = {"position": [1.1, -1.1, 1.1], "quaternion_xyzw": [0, 0, 1, 0]}
    made = {
        **MINE,
        "id": "far",
        "base_to_tool": far,
        "frames": {"flange": {**far, "position": [-2, 0, 0]}},
    }
    assert served.post("/grippers", json=made).status_code == 201
    asked = {"gripper": "far", "prior": "false", "frame": "flange"}
    assert get(served, f"/objects/{thing}/best-grasp", **asked)["frame"] == "flange"
    trial = {"position": [999, 999, 999], "quaternion_xyzw": [0, 0, 0, 1], "outcome": True, "gripper": "far"}
    refused = served.post(f"/objects/{thing}/trials", params={"frame": "base"}, json=trial)
    assert problem(refused)[0::2] == (422, ["position"])

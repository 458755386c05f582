"""The density resource: which trials it is of, its counts, its kernel, its ETag."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]


def split(poses: Poses, *sizes: int) -> list[Poses]:
    edges = np.cumsum([0, *sizes])
    return [(poses[0][a:b], poses[1][a:b]) for a, b in pairwise(edges)]


def problem(answer: httpx.Response, status: int) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = answer.json()
    return body


def fields(answer: httpx.Response, status: int = 422) -> set[str]:
    return {item["field"] for item in problem(answer, status)["errors"]}


def test_counts_kernel_and_revision(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    post(http, "thing", two_clusters)
    receipt = post(http, "thing", two_clusters, "slipped")
    info = http.get("/objects/thing/density").json()
    assert info["size"] == 500
    assert info["outcomes"] == {"success": 500, "slipped": 500}
    assert info["revision"] == receipt["revision"]
    assert info["effective_sample_size"] == pytest.approx(500)
    assert info["kernel"]["kind"] == "isotropic"
    assert "leave-one-block-out" in info["kernel"]["rule"]
    assert info["unit"] == "1/(m^3 rad^3)"
    asked = http.get("/objects/thing/density?kernel=isotropic&sigma_position_m=0.03").json()["kernel"]
    assert asked["sigma_position_m"] == 0.03
    assert asked["sigma_rotation_deg"] == 15
    assert "as asked" in asked["rule"]


def test_no_success_is_an_answer_too(http: httpx.Client, make_object: Make, post: Post) -> None:
    make_object(http)
    info = http.get("/objects/thing/density").json()
    assert (info["size"], info["outcomes"], info["effective_sample_size"]) == (0, {}, 0)
    assert (info["kernel"]["sigma_position_m"], info["kernel"]["sigma_rotation_deg"]) == (0.015, 15)
    assert "default" in info["kernel"]["rule"]
    post(http, "thing", (np.zeros((3, 3)), np.array([[0, 0, 0, 1.0]] * 3)), "dropped")
    info = http.get("/objects/thing/density").json()
    assert (info["size"], info["outcomes"]) == (0, {"dropped": 3})


def test_selection_by_gripper_protocol_and_source(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    a, b, c, d = split(two_clusters, 100, 50, 20, 7)
    post(http, "thing", a, gripper="pg70", protocol="wrench", source="simulation")
    post(http, "thing", d)

    def size(query: str) -> int:
        answer = http.get(f"/objects/thing/density?{query}")
        assert answer.status_code == 200, answer.text
        return int(answer.json()["size"])

    # One gripper, one protocol: nothing to name; trials that name none go along.
    alone = http.get("/objects/thing/density").json()
    assert (alone["size"], alone["gripper"], alone["protocol"]) == (107, "pg70", "wrench")

    post(http, "thing", b, gripper="panda", protocol="wrench", source="robot")
    post(http, "thing", c, gripper="panda", protocol="lift", source="robot")
    told = problem(http.get("/objects/thing/density"), 409)
    assert told["type"].endswith("ambiguous-selection")
    assert told["grippers"] == ["panda", "pg70"]
    assert told["protocols"] == ["lift", "wrench"]
    told = problem(http.get("/objects/thing/density?gripper=panda"), 409)
    assert told["protocols"] == ["lift", "wrench"]
    assert size("gripper=pg70") == 107
    assert size("gripper=panda&protocol=lift") == 27
    assert size("gripper=panda&protocol=wrench") == 57
    # Who names no source is not of that source.
    assert size("source=simulation") == 100
    assert size("source=robot&gripper=panda&protocol=lift") == 20
    assert size("source=human") == 0
    for answer in (
        http.post("/objects/thing/best-grasp", json={}),
        http.post("/objects/thing/samples", json={"count": 3}),
        http.get("/objects/thing/best-grasp"),
    ):
        assert problem(answer, 409)["type"].endswith("ambiguous-selection")


def test_deleted_trials_make_nothing_ambiguous(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    a, b = split(two_clusters, 100, 50)
    post(http, "thing", a, gripper="pg70")
    batch = post(http, "thing", b, gripper="panda")["batch"]
    problem(http.get("/objects/thing/density"), 409)
    assert http.delete(f"/objects/thing/batches/{batch}").status_code in (200, 204)
    info = http.get("/objects/thing/density").json()
    assert (info["size"], info["gripper"]) == (100, "pg70")


def test_weights_follow_the_proposal_density(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    proposal = np.full(500, 10.0)
    proposal[0] = 1e-6
    post(http, "thing", two_clusters, proposal_density=proposal)
    info = http.get("/objects/thing/density").json()
    assert info["effective_sample_size"] == pytest.approx(1, abs=0.01)
    assert any("uneven" in warning for warning in info["warnings"])


def test_etag(http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses) -> None:
    make_object(http)
    post(http, "thing", two_clusters)
    for path in (
        "/objects/thing/density",
        "/objects/thing/likelihood?position=0,0,0.06&quaternion_xyzw=1,0,0,0",
        "/objects/thing/best-grasp?count=2",
    ):
        first = http.get(path)
        tag = first.headers["etag"]
        again = http.get(path, headers={"If-None-Match": tag})
        assert (again.status_code, again.content) == (304, b"")
        assert again.headers["etag"] == tag
        more = "&" if "?" in path else "?"
        assert http.get(f"{path}{more}sigma_position_m=0.02").headers["etag"] != tag
        post(http, "thing", two_clusters, "missed")
        changed = http.get(path, headers={"If-None-Match": tag})
        assert changed.status_code == 200
        assert changed.headers["etag"] != tag


def test_bad_requests_name_the_field(
    sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    http = sqlite_http
    make_object(http)
    post(http, "thing", two_clusters)
    path = "/objects/thing/density"
    problem(http.get("/objects/other/density"), 404)
    assert "nope" in problem(http.get(f"{path}?gripper=nope"), 404)["title"]
    assert problem(http.get(f"{path}?kernel=anisotropic"), 409)["kernels"] == ["isotropic"]
    assert "isotropic" in problem(http.get(f"{path}?kernel=my-kernel"), 404)["title"]
    for query, field in {
        "sigma_position_m=0": "sigma_position_m",
        "sigma_position_m=-1": "sigma_position_m",
        "sigma_position_m=nan": "sigma_position_m",
        "sigma_position_m=1e999": "sigma_position_m",
        "sigma_position_m=1e-9": "sigma_position_m",
        "sigma_position_m=5": "sigma_position_m",
        "sigma_rotation_deg=0": "sigma_rotation_deg",
        "sigma_rotation_deg=1e-5": "sigma_rotation_deg",
        "sigma_rotation_deg=200": "sigma_rotation_deg",
        "sigma_rotation_deg=x": "sigma_rotation_deg",
        "source=dream": "source",
        "gripper=a b": "gripper",
        "kernel=%00": "kernel",
        "sigma=1": "sigma",
    }.items():
        assert fields(http.get(f"{path}?{query}")) == {field}, query

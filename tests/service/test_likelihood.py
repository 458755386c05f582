"""Likelihood against the float64 sum over every trial, and every way to ask wrongly."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

import brute_force
from graspdb_density import IsotropicKernel, se3

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

#: The density's stated error with its default cut-off.
RELATIVE_ERROR = 2e-3
WIDTHS = {"sigma_position_m": 0.015, "sigma_rotation_deg": 15}


def listed(poses: Poses) -> list[dict[str, Any]]:
    return [
        {"position": p, "quaternion_xyzw": q}
        for p, q in zip(poses[0].tolist(), poses[1].tolist(), strict=True)
    ]


def columns(poses: Poses) -> dict[str, Any]:
    return {"position": poses[0].tolist(), "quaternion_xyzw": poses[1].tolist()}


def ask(http: httpx.Client, poses: object, **more: Any) -> dict[str, Any]:
    more = more if "kernel" in more else {**more, **WIDTHS}
    answer = http.post("/objects/thing/likelihood", json={"poses": poses, **more})
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def fields(answer: httpx.Response, status: int = 422) -> set[str]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    return {item["field"] for item in answer.json()["errors"]}


@pytest.fixture
def queries(two_clusters: Poses) -> Poses:
    rng = np.random.default_rng(5)
    rows = rng.choice(500, 80, replace=False)
    position = two_clusters[0][rows] + rng.normal(size=(80, 3)) * 0.01
    turns = se3.from_rotation_vector(rng.normal(size=(80, 3)) * 0.2)
    return position, se3.multiply(two_clusters[1][rows], turns)


@pytest.mark.parametrize("form", ["rows", "columns"])
def test_equals_brute_force(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses, queries: Poses, form: str
) -> None:
    make_object(http)
    post(http, "thing", two_clusters)
    post(http, "thing", queries, "collision")
    sent = listed(queries) if form == "rows" else columns(queries)
    for kernel, sigma_m, sigma_deg in (
        (None, 0.015, 15),
        ({"kind": "isotropic", "sigma_position_m": 0.03, "sigma_rotation_deg": 25}, 0.03, 25),
        ({"sigma_position_m": 0.01, "sigma_rotation_deg": 10, "cutoff": None}, 0.01, 10),
    ):
        answer = ask(http, sent, **({} if kernel is None else {"kernel": kernel}))
        exact = brute_force.log_density(
            IsotropicKernel(sigma_m, np.deg2rad(sigma_deg)),
            se3.Poses.of(*two_clusters),
            se3.Poses.of(*queries),
        )
        tolerance = 1e-5 if kernel and "cutoff" in kernel else RELATIVE_ERROR
        np.testing.assert_allclose(answer["log_density"], exact, atol=tolerance)
        np.testing.assert_allclose(answer["density"], np.exp(exact), rtol=tolerance)
        assert answer["kernel"]["sigma_position_m"] == sigma_m
        assert 0 < min(answer["relative"]) <= max(answer["relative"]) <= 1
        ratio = np.array(answer["relative"]) / np.array(answer["density"])
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)


def test_weights_of_eq_1(http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses) -> None:
    make_object(http)
    proposal = np.random.default_rng(3).uniform(1, 50, 500)
    proposal[::7] = np.nan
    post(http, "thing", two_clusters, proposal_density=proposal)
    weights = 1 / proposal
    weights[::7] = np.nanmean(weights)
    exact = brute_force.log_density(
        IsotropicKernel(0.015, np.deg2rad(15)),
        se3.Poses.of(*two_clusters),
        se3.Poses.of(*two_clusters),
        weights=weights,
    )
    np.testing.assert_allclose(ask(http, columns(two_clusters))["log_density"], exact, atol=RELATIVE_ERROR)


def test_relative_is_one_at_the_best_grasp(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    post(http, "thing", two_clusters)
    best = http.get("/objects/thing/best-grasp?collision_free=false").json()["grasps"][0]
    one = http.get(
        "/objects/thing/likelihood",
        params={
            "position": ",".join(map(str, best["position"])),
            "quaternion_xyzw": ",".join(map(str, best["quaternion_xyzw"])),
        },
    ).json()
    assert one["relative"][0] == pytest.approx(1, abs=1e-3)
    assert one["density"][0] == pytest.approx(best["density"], rel=1e-3)


def test_symmetry_follows_the_gripper(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses, queries: Poses
) -> None:
    make_object(http)
    profile = {
        "max_opening_m": 0.07,
        "finger": {"width_m": 0.02, "thickness_m": 0.01, "length_m": 0.05},
        "palm_size_m": [0.05, 0.05, 0.05],
        "symmetric": False,
    }
    assert http.post("/grippers", json={"id": "hook", **profile}).status_code == 201
    post(http, "thing", two_clusters, gripper="hook")
    kernel = IsotropicKernel(0.015, np.deg2rad(15))
    exact = brute_force.log_density(
        kernel, se3.Poses.of(*two_clusters), se3.Poses.of(*queries), symmetric=False
    )
    np.testing.assert_allclose(ask(http, columns(queries))["log_density"], exact, atol=RELATIVE_ERROR)
    # Trials without a gripper go along, and their jaw counts as symmetric.
    post(http, "thing", queries)
    both = np.concatenate([two_clusters[0], queries[0]]), np.concatenate([two_clusters[1], queries[1]])
    symmetric = np.arange(580) >= 500
    exact = brute_force.log_density(kernel, se3.Poses.of(*both), se3.Poses.of(*queries), symmetric=symmetric)
    np.testing.assert_allclose(ask(http, columns(queries))["log_density"], exact, atol=RELATIVE_ERROR)


def test_far_away_is_tiny_not_null(
    sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(sqlite_http)
    post(sqlite_http, "thing", two_clusters)
    far = (np.array([[3.0, 3, 3], [900, 900, 900]]), np.array([[0, 0, 0, 1.0]] * 2))
    answer = ask(sqlite_http, columns(far))
    exact = brute_force.log_density(
        IsotropicKernel(0.015, np.deg2rad(15)), se3.Poses.of(*two_clusters), se3.Poses.of(*far)
    )
    np.testing.assert_allclose(answer["log_density"], exact, rtol=1e-5)
    assert answer["density"] == [0, 0]
    assert answer["relative"] == [0, 0]


def test_no_success_is_an_exact_zero(http: httpx.Client, make_object: Make, queries: Poses) -> None:
    make_object(http)
    answer = ask(http, columns(queries))
    assert answer["density"] == [0] * 80
    assert answer["log_density"] == [None] * 80
    assert answer["relative"] == [0] * 80


def test_include_and_matrices(
    sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses, queries: Poses
) -> None:
    http = sqlite_http
    make_object(http)
    post(http, "thing", two_clusters)
    whole = ask(http, columns(queries))
    part = ask(http, columns(queries), include=["log_density"])
    assert part["log_density"] == whole["log_density"]
    assert not {"density", "relative", "collision_free"} & part.keys()
    matrices = np.zeros((80, 4, 4))
    matrices[:, :3, :3], matrices[:, :3, 3], matrices[:, 3, 3] = se3.to_matrix(queries[1]), queries[0], 1
    by_matrix = ask(http, [{"matrix": m} for m in matrices.tolist()])
    np.testing.assert_allclose(by_matrix["log_density"], whole["log_density"], atol=1e-9)
    mixed = listed(queries)
    mixed[3] = {"matrix": matrices[3].tolist()}
    np.testing.assert_allclose(ask(http, mixed)["log_density"], whole["log_density"], atol=1e-9)
    query = {"position": "0,0,0.06", "quaternion_xyzw": "1,0,0,0", "include": "density,relative"}
    assert http.get("/objects/thing/likelihood", params=query).json().keys() >= {"density", "relative"}
    # An exact float64 array comes back whole, whatever its length.
    many = 40_000
    rows = np.resize(np.arange(80), many)
    long = ask(http, columns((queries[0][rows], queries[1][rows])))
    np.testing.assert_array_equal(long["log_density"], np.array(whole["log_density"])[rows])


BAD_POSES = [
    (None, "poses"),
    ([], "poses"),
    ("x", "poses"),
    ([1], "poses.0"),
    ({"position": [], "quaternion_xyzw": []}, "poses"),
    ({"position": [[0, 0, 0]]}, "poses.quaternion_xyzw"),
    ({"position": [[0, 0, 0]], "quaternion_xyzw": [[0, 0, 0, 1]], "size": 1}, "poses.size"),
    ({"position": [[0, 0, 0]], "quaternion_xyzw": [[0, 0, 0, 1]] * 2}, "poses.quaternion_xyzw"),
    ({"position": [[0, 0, 0], [0, 0]], "quaternion_xyzw": [[0, 0, 0, 1]] * 2}, "poses.position.1"),
    ({"position": [[0, 0, None]], "quaternion_xyzw": [[0, 0, 0, 1]]}, "poses.position.0"),
    ({"position": [[0, 0, "1"]], "quaternion_xyzw": [[0, 0, 0, 1]]}, "poses.position.0"),
    ({"position": [[0, 0, 5e3]], "quaternion_xyzw": [[0, 0, 0, 1]]}, "poses.position.0"),
    ({"position": [[0, 0, 0]], "quaternion_xyzw": [[0, 0, 0, 0]]}, "poses.quaternion_xyzw.0"),
    ({"position": [[0, 0, 0]], "quaternion_xyzw": [[0, 0, 0, 1.1]]}, "poses.quaternion_xyzw.0"),
    ([{"position": [0, 0, 0]}], "poses.0.quaternion_xyzw"),
    ([{"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1], "posiiton": 1}], "poses.0.posiiton"),
    (
        [
            {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]},
            {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 2]},
        ],
        "poses.1.quaternion_xyzw",
    ),
    ([{"position": [0, 0], "quaternion_xyzw": [0, 0, 0, 1]}], "poses.0.position"),
    ([{"matrix": [[1, 0, 0, 0]] * 4}], "poses.0"),
    ([{"matrix": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}], "poses.0"),
    ([{"matrix": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}], "poses.0"),
]


def test_bad_poses_name_the_field(
    sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(sqlite_http)
    post(sqlite_http, "thing", two_clusters)
    for poses, field in BAD_POSES:
        answer = sqlite_http.post("/objects/thing/likelihood", json={"poses": poses})
        named = fields(answer)
        assert any(name == field or name.startswith(f"{field}.") for name in named), (poses, named)


def test_bad_options_name_the_field(
    sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    http = sqlite_http
    make_object(http)
    post(http, "thing", two_clusters)
    path, poses = "/objects/thing/likelihood", [{"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}]
    for more, field in (
        ({"unknown": 1}, "unknown"),
        ({"include": ["everything"]}, "include.0"),
        ({"source": "dream"}, "source"),
        ({"kernel": {"kind": "isotropic", "sigma_position_m": 0}}, "kernel.sigma_position_m"),
        ({"kernel": {"sigma_position_m": 0.01, "width": 1}}, "kernel.width"),
        ({"kernel": {"cutoff": 0}}, "kernel.cutoff"),
        ({"kernel": {"sigma_position_m": 0.01}, "sigma_position_m": 0.02}, "sigma_position_m"),
    ):
        assert field in fields(http.post(path, json={"poses": poses, **more})), more

    def raw(text: str, media: str = "application/json") -> httpx.Response:
        return http.post(path, content=text.encode(), headers={"Content-Type": media})

    for number in ("NaN", "Infinity", "1e999"):
        position = f"[{number},0,0]"
        row = '{"position":' + position + ',"quaternion_xyzw":[0,0,0,1]}'
        assert 400 <= raw('{"poses":[' + row + "]}").status_code < 500
        held = '{"position":[' + position + '],"quaternion_xyzw":[[0,0,0,1]]}'
        assert 400 <= raw('{"poses":' + held + "}").status_code < 500
    for text in ("", "[]", '{"poses":[', "null", '"poses"'):
        assert 400 <= raw(text).status_code < 500
    assert raw(json.dumps({"poses": poses}), "text/csv").status_code == 415
    assert fields(http.get(f"{path}?position=0,0&quaternion_xyzw=0,0,0,1"))
    assert fields(http.get(f"{path}?position=0,0,nan&quaternion_xyzw=0,0,0,1"))
    assert fields(http.get(f"{path}?position=0,0,0")) == {"quaternion_xyzw"}
    assert fields(http.get(f"{path}?position=0,0,0&quaternion_xyzw=0,0,0,3")) == {"quaternion_xyzw"}
    assert http.get("/objects/none/likelihood?position=0,0,0&quaternion_xyzw=0,0,0,1").status_code == 404


def test_too_many_poses(serve: Callable[..., str], sqlite_url: str, make_object: Make) -> None:
    with httpx.Client(base_url=serve(sqlite_url, max_query_poses=100), timeout=60) as http:
        make_object(http)
        poses = (np.zeros((101, 3)), np.array([[0, 0, 0, 1.0]] * 101))
        answer = http.post("/objects/thing/likelihood", json={"poses": columns(poses)})
        assert fields(answer, 413) == {"poses"}
        assert "100" in answer.json()["title"]


def test_livez_answers_while_a_heavy_query_runs(
    sqlite_http: httpx.Client, make_object: Make, post: Post, clusters: Callable[..., Poses]
) -> None:
    """Not timed: it counts how often the service says it lives before the heavy answer comes."""
    make_object(sqlite_http)
    rng = np.random.default_rng(0)
    centres = [(tuple(c), (1.0, 0.0, 0.0, 0.0)) for c in rng.normal(size=(40, 3)) * 0.02]
    poses = clusters(centres, 250)
    post(sqlite_http, "thing", poses)
    rows = np.resize(np.arange(len(poses[0])), 60_000)
    body = json.dumps({"poses": columns((poses[0][rows], poses[1][rows])), "include": ["relative"]}).encode()
    done = threading.Event()
    statuses: list[int] = []

    def heavy() -> None:
        answer = sqlite_http.post(
            "/objects/thing/likelihood", content=body, headers={"Content-Type": "application/json"}
        )
        statuses.append(answer.status_code)
        done.set()

    thread = threading.Thread(target=heavy)
    thread.start()
    alive = 0
    with httpx.Client(base_url=sqlite_http.base_url, timeout=10) as other:
        while not done.is_set():
            assert other.get("/livez").status_code == 200
            alive += 1
            time.sleep(0.005)
    thread.join()
    assert statuses == [200]
    assert alive >= 5

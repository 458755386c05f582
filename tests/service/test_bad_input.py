"""What makes no sense is refused with its field and a way out: widths, covariances, limits, grippers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

POSE = {"position": [0.0, 0.0, 0.06], "quaternion_xyzw": [1.0, 0.0, 0.0, 0.0]}


@pytest.fixture
def thing(sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses) -> httpx.Client:
    make_object(sqlite_http)
    post(sqlite_http, "thing", (two_clusters[0][:80], two_clusters[1][:80]), gripper="pg70")
    return sqlite_http


def refused(answer: httpx.Response, status: int = 422) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = answer.json()
    assert body["title"]
    return body


def fields(answer: httpx.Response, status: int = 422) -> set[str]:
    return {error["field"].removesuffix(".KernelSpec") for error in refused(answer, status)["errors"]}


@pytest.mark.parametrize("value", ["0", "-0.01", "1e-9", "50", "1e999", "NaN", '"wide"'])
@pytest.mark.parametrize("name", ["sigma_position_m", "sigma_rotation_deg"])
def test_widths_that_make_no_kernel(thing: httpx.Client, name: str, value: str) -> None:
    if (name, value) == ("sigma_rotation_deg", "50"):
        value = "500"
    poses = '"poses": [{"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}]'
    for path, rest in (("likelihood", f", {poses}"), ("best-grasp", ""), ("samples", ', "count": 3')):
        for form in (f'"{name}": {value}', f'"kernel": {{"{name}": {value}}}'):
            answer = thing.post(
                f"/objects/thing/{path}",
                content=f"{{{form}{rest}}}",
                headers={"Content-Type": "application/json"},
            )
            if value in ("NaN", "1e999") and answer.status_code == 400:
                continue  # No JSON at all.
            assert any(name in field or field == "body" for field in fields(answer)), answer.text


def component(**changes: Any) -> dict[str, Any]:
    covariance = np.diag([1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.01])
    return {"covariance": covariance.tolist(), **changes}


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (component(covariance=np.zeros((6, 6)).tolist()), "singular"),
        (component(covariance=np.diag([1e-4, 1e-4, 0.0, 0.01, 0.01, 0.01]).tolist()), "singular"),
        (component(covariance=np.full((6, 6), 1e-4).tolist()), "singular"),
        (component(covariance=np.diag([1e-4, 1e-4, -1e-4, 0.01, 0.01, 0.01]).tolist()), "definite"),
        (component(covariance=np.triu(np.full((6, 6), 1e-4)).tolist()), "symmetric"),
        (component(covariance=np.diag([1e-4] * 3 + [4.0] * 3).tolist()), "degrees"),
        (component(covariance=np.eye(3).tolist()), ""),
        (component(weight=0), ""),
        (component(weight=-1), ""),
        (component(mean=[0.0] * 5), ""),
    ],
)
def test_components_that_make_no_kernel(sqlite_http: httpx.Client, wrong: dict[str, Any], told: str) -> None:
    answer = sqlite_http.post("/kernels", json={"components": [component(), wrong]})
    problem = refused(answer)
    assert all(error["field"].startswith("components") for error in problem["errors"])
    assert told in problem["title"] + " ".join(error["message"] for error in problem["errors"])


@pytest.mark.parametrize(
    "request_",
    [
        {"window": {"position_m": 0}},
        {"window": {"position_m": 0.02, "rotation_deg": -5}},
        {"component_widths": {"sigma_position_m": 0}},
        {"component_widths": {"sigma_rotation_deg": 80}},
        {"components": 0},
        {"components": -1},
        {"kind": "sampled", "components": 10_000},
        {"kind": "cubic"},
        {"alignment": "up"},
    ],
)
def test_fits_that_can_not_be_asked_for(thing: httpx.Client, request_: dict[str, Any]) -> None:
    answer = thing.post("/kernels", json={"object": "thing", **request_})
    name = next(name for name in request_ if name != "kind" or len(request_) == 1)
    assert all(field.startswith(name) for field in fields(answer)), answer.text


def test_more_than_the_limit(sqlite_url: str, serve: Callable[..., str], make_object: Make) -> None:
    address = serve(sqlite_url, max_query_poses=100, max_samples=50)
    with httpx.Client(base_url=address, timeout=60) as http:
        make_object(http)
        columns = {name: [value] * 101 for name, value in POSE.items()}
        table = pa.table({name: pa.array(value) for name, value in columns.items()})
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, table.schema) as writer:
            writer.write_table(table)
        arrow = {"Content-Type": "application/vnd.apache.arrow.stream"}
        for answer in (
            http.post("/objects/thing/likelihood", json={"poses": columns}),
            http.post("/objects/thing/likelihood", json={"poses": [POSE] * 101}),
            http.post("/objects/thing/likelihood", content=sink.getvalue().to_pybytes(), headers=arrow),
        ):
            told = refused(answer, 413)
            assert told["type"].endswith("too-many-poses")
            assert "100" in told["title"]
            assert "several requests" in told["title"]
        for path in ("samples", "proposals"):
            told = refused(http.post(f"/objects/thing/{path}", json={"count": 51}), 413)
            assert told["type"].endswith("too-many-samples")
            assert "50" in told["title"]
        assert http.get("/info").json()["limits"]["max_query_poses"] == 100


def test_a_kernel_of_another_gripper_is_refused_wherever_it_is_named(thing: httpx.Client) -> None:
    made = thing.post("/kernels", json={"components": [component()], "gripper": "panda"}).json()["id"]
    sampled = thing.post(
        "/kernels", json={"kind": "sampled", "components": [{"mean": [0.0] * 6}], "gripper": "panda"}
    ).json()["id"]
    pose = "position=0,0,0.06&quaternion_xyzw=1,0,0,0"
    for kernel in (made, sampled):
        for answer in (
            thing.get(f"/objects/thing/density?kernel={kernel}"),
            thing.get(f"/objects/thing/likelihood?{pose}&kernel={kernel}"),
            thing.post("/objects/thing/likelihood", json={"poses": [POSE], "kernel": kernel}),
            thing.get(f"/objects/thing/best-grasp?kernel={kernel}"),
            thing.post("/objects/thing/samples", json={"count": 2, "kernel": kernel}),
            thing.post("/objects/thing/proposals", json={"count": 2, "kernel": kernel}),
            thing.get(f"/objects/thing/reports/convergence?kernel={kernel}"),
        ):
            told = refused(answer, 409)
            assert told["type"].endswith("kernel-of-another-gripper")
            assert "'panda'" in told["title"]
            assert "POST /kernels" in told["title"]
    assert math.isfinite(thing.get("/objects/thing/density").json()["effective_sample_size"])

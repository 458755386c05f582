"""Trials name the answer that they tried and the pose that they achieved, which estimates take."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pytest

DOWN = [1.0, 0.0, 0.0, 0.0]
Poses = tuple[Any, Any]
ARROW = "application/vnd.apache.arrow.stream"
HERE = {"position": [0.0, 0.0, 0.06], "quaternion_xyzw": DOWN}
THERE = {"position": [0.002, -0.001, 0.061], "quaternion_xyzw": [0.0, 1.0, 0.0, 0.0]}


@pytest.fixture
def thing(
    http: httpx.Client, make_object: Callable[..., str], post: Callable[..., Any], two_clusters: Poses
) -> str:
    slug = make_object(http)
    post(http, slug, two_clusters, gripper="pg70", protocol="lift", source="robot")
    return slug


def _answer(http: httpx.Client, slug: str, **question: Any) -> str:
    id: str = http.post(f"/objects/{slug}/best-grasp", json=question).json()["answer"]
    return id


def _stored(http: httpx.Client, slug: str, batch: str) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = http.get(f"/objects/{slug}/trials", params={"batch": batch}).json()["items"]
    return items


def _arrow_body() -> bytes:
    pose = pa.struct(
        [("position", pa.list_(pa.float64(), 3)), ("quaternion_xyzw", pa.list_(pa.float64(), 4))]
    )
    table = pa.table(
        {
            "position": pa.array([HERE["position"]] * 2, pa.list_(pa.float64(), 3)),
            "quaternion_xyzw": pa.array([DOWN] * 2, pa.list_(pa.float64(), 4)),
            "outcome": ["success", "failure"],
            "answer": pa.array(["mine", None]),
            "achieved_pose": pa.array([THERE, None], pose),
        }
    )
    sink = io.BytesIO()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue()


def test_in_every_format_in_and_out(http: httpx.Client, thing: str) -> None:
    id = _answer(http, thing, name="mine")
    first = {**HERE, "outcome": "success", "answer": "mine", "achieved_pose": THERE}
    second = {**HERE, "outcome": "failure"}
    columns = {
        "position": [HERE["position"]] * 2,
        "quaternion_xyzw": [DOWN] * 2,
        "outcome": ["success", "failure"],
        "answer": [id, None],
        "achieved_pose": [THERE, None],
    }
    path = f"/objects/{thing}/trials"
    lines = "\n".join(map(json.dumps, (first, second)))
    answers = [
        http.post(path, json={"trials": [first, second]}),
        http.post(path, json={"columns": columns}),
        http.post(path, content=lines, headers={"Content-Type": "application/x-ndjson"}),
        http.post(path, content=_arrow_body(), headers={"Content-Type": ARROW}),
    ]
    for answer in answers:
        assert answer.status_code == 201, answer.text
        batch = answer.json()["batch"]
        one, two = _stored(http, thing, batch)
        assert (one["answer"], one["achieved_pose"], one["position"]) == (id, THERE, HERE["position"])
        assert (two["answer"], two["achieved_pose"]) == (None, None)
        text = http.get(path, params={"batch": batch}, headers={"Accept": "application/x-ndjson"}).text
        assert [json.loads(line) for line in text.splitlines()] == [one, two]
        content = http.get(path, params={"batch": batch}, headers={"Accept": ARROW}).content
        read = pa.ipc.open_stream(content).read_all()
        assert read["answer"].to_pylist() == [id, None]
        assert read["achieved_pose"].to_pylist() == [THERE, None]
        assert http.get(f"{path}/{one['seq']}").json()["achieved_pose"] == THERE
    assert http.get(f"/answers/{id}").json()["trials"] == 4


def test_beside_the_trials_it_stands_for_all(http: httpx.Client, thing: str) -> None:
    id, other = _answer(http, thing), _answer(http, thing, count=2)
    trials = [{**HERE, "outcome": True}, {**HERE, "outcome": False, "answer": other}]
    receipt = http.post(f"/objects/{thing}/trials", json={"trials": trials, "answer": id}).json()
    assert [item["answer"] for item in _stored(http, thing, receipt["batch"])] == [id, other]


def test_wrong_ones_name_index_and_field(
    http: httpx.Client, thing: str, make_object: Callable[..., str], post: Callable[..., Any],
    two_clusters: Poses,
) -> None:  # fmt: skip
    other = make_object(http, "other")
    post(http, other, two_clusters)
    foreign = _answer(http, other, name="foreign")
    path, good = f"/objects/{thing}/trials", {**HERE, "outcome": "success"}
    before = http.get(f"/objects/{thing}").json()["revision"]
    nan = json.dumps({**good, "achieved_pose": {**HERE, "position": [0, 0, "X"]}}).replace('"X"', "NaN")
    wrong: list[tuple[Any, str]] = [
        *(({"answer": name}, "trials.1.answer") for name in (foreign, "foreign", "0" * 20, "unknown")),
        *(({"answer": name}, "trials.1.answer") for name in (3, "a b", "")),
        ({"achieved_pose": [0, 0, 0]}, "trials.1.achieved_pose"),
        ({"achieved_pose": {"position": [0, 0, 0]}}, "trials.1.achieved_pose"),
        ({"achieved_pose": {**HERE, "position": [60, 0, 2_000]}}, "trials.1.achieved_pose.position"),
        ({"achieved_pose": {**HERE, "position": [0, 0]}}, "trials.1.achieved_pose.position"),
        (
            {"achieved_pose": {**HERE, "quaternion_xyzw": [1, 1, 0, 0]}},
            "trials.1.achieved_pose.quaternion_xyzw",
        ),
    ]
    for more, field in wrong:
        refused = http.post(path, json={"trials": [good, {**good, **more}]})
        assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, field), refused.text
    assert http.post(path, content=nan, headers={"Content-Type": "application/json"}).status_code == 422
    shared = http.post(path, json={"trials": [good], "answer": "unknown"})
    assert (shared.status_code, shared.json()["type"].endswith("unknown-answer")) == (422, True)
    assert http.get(f"/objects/{thing}").json()["revision"] == before


def test_an_answer_that_trials_name_stays_until_they_go(http: httpx.Client, thing: str) -> None:
    id = _answer(http, thing, name="mine")
    trial = {**HERE, "outcome": "success", "answer": "mine"}
    batch = http.post(f"/objects/{thing}/trials", json=trial).json()["batch"]
    refused = http.delete(f"/answers/{id}")
    assert (refused.status_code, refused.json()["type"].endswith("answer-in-use")) == (409, True)
    # The name can be had for another question all the same.
    assert http.delete("/answers/mine").status_code == 204
    assert http.get(f"/answers/{id}").json()["names"] == []
    assert http.delete(f"/objects/{thing}/batches/{batch}").status_code == 204
    assert http.get(f"/answers/{id}").json()["trials"] == 0
    assert http.delete(f"/answers/{id}").status_code == 204


def test_a_copy_keeps_achieved_poses_and_leaves_answers_to_the_original(
    http: httpx.Client, thing: str
) -> None:
    id = _answer(http, thing)
    trial = {**HERE, "outcome": "success", "answer": id, "achieved_pose": THERE}
    http.post(f"/objects/{thing}/trials", json=trial)
    made = http.post(f"/objects/{thing}/copies", json={"id": "copy", "trials": True})
    assert made.status_code == 201, made.text
    batch = http.get("/objects/copy/batches").json()["items"][-1]["batch"]
    (copied,) = _stored(http, "copy", batch)
    assert (copied["achieved_pose"], copied["answer"]) == (THERE, None)
    assert http.delete(f"/objects/copy/batches/{batch}").status_code == 204
    assert http.get(f"/answers/{id}").json()["trials"] == 1


def test_estimates_take_the_pose_that_was_achieved(
    http: httpx.Client, make_object: Callable[..., str], clusters: Callable[..., Poses]
) -> None:
    """Commanded at one place and achieved 5 cm beside it: densities and probabilities are of the latter."""
    there, beside = make_object(http, "there"), make_object(http, "beside")
    position, quaternion = clusters([((0, 0, 0.06), DOWN)], 60)
    outcomes = ["success" if i % 3 else "failure" for i in range(60)]
    moved = position + np.array([0.05, 0, 0])
    poses = [
        {"position": p, "quaternion_xyzw": q}
        for p, q in zip(moved.tolist(), quaternion.tolist(), strict=True)
    ]
    columns: dict[str, Any] = {"quaternion_xyzw": quaternion.tolist(), "outcome": outcomes}
    for slug, more in (
        (there, {"position": moved.tolist()}),
        (beside, {"position": position.tolist(), "achieved_pose": poses}),
    ):
        assert http.post(f"/objects/{slug}/trials", json={"columns": {**columns, **more}}).status_code == 201
    asked = {"poses": [{"position": [0.05, 0, 0.06], "quaternion_xyzw": DOWN}, HERE]}
    expected, found = (http.post(f"/objects/{s}/likelihood", json=asked).json() for s in (there, beside))
    assert found["density"] == pytest.approx(expected["density"])
    assert found["success_probability"][0] == pytest.approx(expected["success_probability"][0])
    assert found["density"][0] > 10 * found["density"][1]
    # A tail that extends the density is read so, too.
    far = {**HERE, "position": [-0.05, 0, 0.06]}
    http.post(f"/objects/{there}/trials", json={**far, "outcome": "success"})
    http.post(f"/objects/{beside}/trials", json={**HERE, "outcome": "success", "achieved_pose": far})
    asked = {"poses": [far, HERE]}
    expected, found = (http.post(f"/objects/{s}/likelihood", json=asked).json() for s in (there, beside))
    assert found["density"] == pytest.approx(expected["density"])
    assert found["density"][0] > found["density"][1]

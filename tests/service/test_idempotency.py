"""Idempotency-Key: a request that is sent again creates nothing again."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

GRASP: dict[str, Any] = {"position": [0, 0, 0.1], "quaternion_xyzw": [0, 0, 0, 1], "outcome": "success"}
KEY = {"Idempotency-Key": "6f1c2f1e-0000-4000-8000-000000000001"}
OTHER = {"Idempotency-Key": "6f1c2f1e-0000-4000-8000-000000000002"}
GRIPPER = {
    "id": "mine",
    "max_opening_m": 0.05,
    "finger": {"width_m": 0.01, "thickness_m": 0.01, "length_m": 0.05},
    "palm_size_m": [0.05, 0.08, 0.05],
}


@pytest.fixture
def mug(http: httpx.Client) -> httpx.Client:
    """A client of a service that has an object ``mug``."""
    http.post("/objects", json={"id": "mug"})
    return http


def test_same_key_and_body_get_the_same_answer(mug: httpx.Client) -> None:
    first = mug.post("/objects/mug/trials", json=GRASP, headers=KEY)
    again = mug.post("/objects/mug/trials", json=GRASP, headers=KEY)
    assert (first.status_code, again.status_code) == (201, 201)
    assert again.json() == first.json()
    assert again.headers["location"] == first.headers["location"]
    assert mug.get("/objects/mug").json()["trials"] == 1
    assert mug.post("/objects/mug/trials", json=GRASP, headers=OTHER).json()["batch"] != first.json()["batch"]
    assert mug.get("/objects/mug").json()["trials"] == 2


def test_same_key_and_another_body_is_422(mug: httpx.Client) -> None:
    mug.post("/objects/mug/trials", json=GRASP, headers=KEY)
    other = mug.post("/objects/mug/trials", json={**GRASP, "outcome": False}, headers=KEY)
    assert other.status_code == 422
    assert other.json()["type"].endswith(":idempotency-key-reused")
    assert other.json()["errors"][0]["field"] == "Idempotency-Key"
    assert mug.get("/objects/mug").json()["trials"] == 1


def test_key_of_a_deleted_batch_is_409(mug: httpx.Client) -> None:
    batch = mug.post("/objects/mug/trials", json=GRASP, headers=KEY).json()["batch"]
    mug.delete(f"/objects/mug/batches/{batch}")
    again = mug.post("/objects/mug/trials", json=GRASP, headers=KEY)
    assert again.status_code == 409
    assert again.json()["type"].endswith(":idempotency-key-revoked")
    assert mug.get("/objects/mug").json()["trials"] == 0
    assert mug.post("/objects/mug/trials", json=GRASP, headers=OTHER).status_code == 201


def test_key_belongs_to_its_resource(mug: httpx.Client) -> None:
    mug.post("/objects", json={"id": "cup"})
    for name in ("mug", "cup"):
        assert mug.post(f"/objects/{name}/trials", json=GRASP, headers=KEY).status_code == 201
        assert mug.get(f"/objects/{name}").json()["trials"] == 1


def test_refused_request_leaves_its_key_free(mug: httpx.Client) -> None:
    bad = {**GRASP, "gripper": "mine"}
    assert mug.post("/objects/mug/trials", json=bad, headers=KEY).status_code == 422
    assert mug.post("/grippers", json=GRIPPER).status_code == 201
    # Not remembered: what was wrong may have been mended, as here.
    assert mug.post("/objects/mug/trials", json=bad, headers=KEY).status_code == 201


def test_objects_and_grippers_are_made_once(http: httpx.Client) -> None:
    for path, body in (("/objects", {"id": "mug"}), ("/grippers", GRIPPER)):
        first = http.post(path, json=body, headers=KEY)
        again = http.post(path, json=body, headers=KEY)
        assert (first.status_code, again.status_code) == (201, 201), again.text
        assert first.json() == again.json()
        assert http.post(path, json={**body, "name": "x"}, headers=KEY).status_code == 422
        assert http.post(path, json=body, headers=OTHER).status_code == 409


def test_keys_of_a_deleted_object_are_revoked(mug: httpx.Client) -> None:
    mug.post("/objects", json={"id": "cup"}, headers=KEY)
    mug.post("/objects/cup/trials", json=GRASP, headers=KEY)
    mug.post("/objects", json={"id": "cup-2"}, headers=OTHER)
    mug.delete("/objects/cup")
    assert mug.post("/objects", json={"id": "cup"}, headers=KEY).status_code == 409
    assert mug.post("/objects", json={"id": "cup"}).status_code == 201
    assert mug.post("/objects/cup/trials", json=GRASP, headers=KEY).status_code == 409
    assert mug.post("/objects", json={"id": "cup-2"}, headers=OTHER).status_code == 201


def test_bad_keys_are_refused(mug: httpx.Client) -> None:
    for key in ("", "a b", "x" * 201, "\u00e4"):
        headers = {"Idempotency-Key": key.encode("latin-1")}
        answer = mug.post("/objects/mug/trials", json=GRASP, headers=headers)  # type: ignore[arg-type]
        assert answer.status_code == 422, key
        assert answer.json()["errors"][0]["field"] == "Idempotency-Key"
    assert mug.get("/objects/mug").json()["trials"] == 0


def test_simultaneous_requests_with_one_key_store_once(mug: httpx.Client) -> None:
    threads = 8
    body = {"trials": [GRASP] * 20}
    for number in range(5):
        barrier = threading.Barrier(threads)

        def send(_: int, key: str = f"key-{number}", barrier: threading.Barrier = barrier) -> httpx.Response:
            barrier.wait()
            return mug.post("/objects/mug/trials", json=body, headers={"Idempotency-Key": key})

        with ThreadPoolExecutor(threads) as pool:
            answers = list(pool.map(send, range(threads)))
        assert {answer.status_code for answer in answers} == {201}
        assert len({answer.json()["batch"] for answer in answers}) == 1
    assert mug.get("/objects/mug").json()["trials"] == 100
    assert len(mug.get("/objects/mug/batches").json()["items"]) == 5

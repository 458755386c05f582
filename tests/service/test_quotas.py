"""How much of what users make up an object may have; what it has beyond a limit stays readable."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest

Serve = Callable[..., str]
POSE = {"position": [0, 0, 0.1], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True}


def _post(http: httpx.Client, protocols: list[str], **beside: Any) -> httpx.Response:
    trials = [{**POSE, "protocol": name} for name in protocols]
    return http.post("/objects/mug/trials", json={"trials": trials, **beside})


def _refused(answer: httpx.Response, kind: str, field: str, limit: int) -> None:
    assert answer.status_code == 422, answer.text
    problem = answer.json()
    assert problem["type"] == f"urn:graspdb:problem:{kind}"
    assert problem["limit"] == limit
    assert problem["errors"][0]["field"] == field


def test_protocols_of_an_object(database_url: str, serve: Serve) -> None:
    with httpx.Client(base_url=serve(database_url, max_object_protocols=30), timeout=60) as http:
        http.post("/objects", json={"id": "mug"})
        assert _post(http, [f"p{i % 20}" for i in range(40)]).status_code == 201
        _refused(_post(http, [f"q{i}" for i in range(11)]), "too-many-protocols", "trials.10.protocol", 30)
        _refused(_post(http, [f"r{i}" for i in range(99)]), "too-many-protocols", "trials.30.protocol", 30)
        assert _post(http, [f"q{i}" for i in range(10)]).status_code == 201
        _refused(_post(http, ["p1", "new"]), "too-many-protocols", "trials.1.protocol", 30)
        ambiguous = http.get("/objects/mug/density")
        assert ambiguous.status_code == 409
        assert "and 10 more" in ambiguous.json()["title"]
        assert len(ambiguous.json()["protocols"]) == 30
    # Beyond a lower limit everything is read, and what has its protocol already is stored.
    with httpx.Client(base_url=serve(database_url, max_object_protocols=2), timeout=60) as http:
        assert http.get("/objects/mug/density?protocol=q9").status_code == 200
        assert len(http.get("/objects/mug/trials?limit=1000").json()["items"]) == 50
        assert _post(http, ["p1", "q9"], source="robot").status_code == 201
        _refused(_post(http, ["new"]), "too-many-protocols", "trials.0.protocol", 2)


def test_combinations_of_an_object(database_url: str, serve: Serve) -> None:
    limits = {"max_object_provenances": 12}
    with httpx.Client(base_url=serve(database_url, **limits), timeout=60) as http:
        http.post("/objects", json={"id": "mug"})
        names = [f"p{i}" for i in range(5)]
        assert _post(http, names, source="robot").status_code == 201
        assert _post(http, names, source="human").status_code == 201
        refused = _post(http, names, source="import", gripper="pg70")
        _refused(refused, "too-many-provenances", "trials.2.protocol", 12)
        assert http.get("/objects/mug").json()["trials"] == 10
        assert _post(http, names, source="human").status_code == 201


@pytest.mark.parametrize(("count", "limit"), [(1_000, None), (2_000, 1_000), (200_000, 10_000)])
def test_invented_protocols_are_refused_before_they_cost_anything(
    sqlite_http: httpx.Client, count: int, limit: int | None
) -> None:
    sqlite_http.post("/objects", json={"id": "mug"})
    columns = {
        "position": [[0, 0, 0]] * count,
        "quaternion_xyzw": [[1, 0, 0, 0]] * count,
        "outcome": [True] * count,
        "protocol": [f"p{i}" for i in range(count)],
    }
    answer = sqlite_http.post("/objects/mug/trials", json={"columns": columns})
    if limit is None:
        assert answer.status_code == 201, answer.text
    else:
        kind = "too-many-protocols" if limit == 1_000 else "too-many-provenances"
        _refused(answer, kind, f"columns.protocol.{limit}", limit)


def test_metadata_under_a_lower_limit(sqlite_url: str, serve: Serve) -> None:
    large, small = {"note": "x" * 100}, {"note": "x"}
    with httpx.Client(base_url=serve(sqlite_url)) as http:
        assert http.post("/objects", json={"id": "mug", "metadata": large}).status_code == 201
    with httpx.Client(base_url=serve(sqlite_url, max_metadata_bytes=50)) as http:
        assert http.get("/objects/mug").json()["metadata"] == large
        trials = "/objects/mug/trials"
        assert http.post(trials, json={**POSE, "metadata": small}).status_code == 201
        for method, path, body, field in (
            ("POST", "/objects", {"id": "cup", "metadata": large}, "metadata"),
            ("PATCH", "/objects/mug", {"metadata": large}, "metadata"),
            ("POST", trials, {**POSE, "metadata": large}, "metadata"),
            ("POST", trials, {"trials": [POSE, {**POSE, "metadata": large}]}, "trials.1.metadata"),
            ("POST", trials, {"trials": [POSE], "metadata": large}, "metadata"),
            ("PATCH", f"{trials}/1", {"metadata": large}, "metadata"),
        ):
            _refused(http.request(method, path, json=body), "too-much-metadata", field, 50)
        assert http.patch("/objects/mug", json={"metadata": small}).status_code == 200


NAMES = {f"k{i}": i for i in range(1_001)}


@pytest.mark.parametrize(
    "metadata",
    [NAMES, {"a": 2**64}, {"a": [{"b": -(2**63) - 1}]}, {"a": "x" * 66_000}, {"a": "\0"}],
    ids=["names", "long", "long within", "size", "nul"],
)
def test_metadata_that_no_limit_allows(sqlite_http: httpx.Client, metadata: dict[str, Any]) -> None:
    answer = sqlite_http.post("/objects", json={"id": "mug", "metadata": metadata})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "metadata"


def test_whole_numbers_of_64_bits_come_back(http: httpx.Client) -> None:
    metadata = {"least": -(2**63), "most": 2**64 - 1, "double": 1e308, "name": "כוס 🙂 \u202e"}
    assert http.post("/objects", json={"id": "mug", "metadata": metadata}).status_code == 201
    assert http.get("/objects/mug").json()["metadata"] == metadata
    assert http.post("/objects/mug/trials", json={**POSE, "metadata": metadata}).status_code == 201
    assert http.get("/objects/mug/trials").json()["items"][0]["metadata"] == metadata

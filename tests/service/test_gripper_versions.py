"""Gripper profiles have versions: what was tried keeps its own, and answers tell which they mix."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

Make = Callable[..., str]
Serve = Callable[..., str]

MINE: dict[str, Any] = {
    "max_opening_m": 0.05,
    "finger": {"width_m": 0.01, "thickness_m": 0.01, "length_m": 0.05},
    "tip_offset_m": 0.01,
    "palm_size_m": [0.05, 0.08, 0.05],
    "force_n": 20,
}
TRIAL = {"position": [0, 0, 0.1], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True}


@pytest.fixture
def replicas(database_url: str, serve: Serve) -> Iterator[tuple[httpx.Client, httpx.Client]]:
    """Two services over one database."""
    here, there = (httpx.Client(base_url=serve(database_url), timeout=60) for _ in range(2))
    with here, there:
        yield here, there


def _put(http: httpx.Client, profile: dict[str, Any], gripper: str = "mine") -> dict[str, Any]:
    answer = http.put(f"/grippers/{gripper}", json=profile)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def _post(http: httpx.Client, thing: str, gripper: str | None, **more: Any) -> dict[str, Any]:
    answer = http.post(f"/objects/{thing}/trials", json={**TRIAL, "gripper": gripper, **more})
    assert answer.status_code == 201, answer.text
    receipt: dict[str, Any] = answer.json()
    return receipt


def test_a_profile_put_is_a_new_version_and_the_same_again_none(http: httpx.Client) -> None:
    made = http.post("/grippers", json={"id": "mine", **MINE}).json()
    assert (made["version"], made["newest_version"], made["changed"]) == (1, 1, [])
    wider = {**MINE, "max_opening_m": 0.06, "finger": {**MINE["finger"], "length_m": 0.04}}
    for _ in range(2):
        second = _put(http, wider)
        assert (second["version"], second["changed"]) == (2, ["finger.length_m", "max_opening_m"])
    assert http.get("/grippers/mine").json() == second
    first = http.get("/grippers/mine@1").json()
    assert (first["profile"], first["version"], first["newest_version"]) == (made["profile"], 1, 2)
    listed = http.get("/grippers/mine/versions?limit=1").json()
    assert listed["items"] == [first]
    rest = http.get("/grippers/mine/versions", params={"cursor": listed["next"]}).json()
    assert (rest["items"], rest["next"]) == ([second], None)
    versions = {item["id"]: item["version"] for item in http.get("/grippers").json()["items"]}
    assert versions.pop("mine") == 2
    assert set(versions.values()) == {1}
    assert _put(http, {**wider, "name": "Mine"})["name"] == "Mine"
    assert _put(http, {**wider, "id": "mine"})["version"] == 2
    assert (
        _put(http, {**http.get("/grippers/panda").json()["profile"], "force_n": 60}, "panda")["version"] == 2
    )


def test_versions_are_refused_where_a_gripper_is_meant(sqlite_http: httpx.Client) -> None:
    http = sqlite_http
    http.post("/grippers", json={"id": "mine", **MINE})
    for name in ("mine@2", "mine@0", "mine@", "mine@x", "none"):
        assert http.get(f"/grippers/{name}").status_code == 404, name
    assert http.put("/grippers/none", json=MINE).status_code == 404
    assert http.put("/grippers/mine@1", json=MINE).status_code == 422
    assert http.delete("/grippers/mine@1").status_code == 422
    assert http.put("/grippers/mine", json={**MINE, "id": "other"}).status_code == 422
    bad = http.put("/grippers/mine", json={**MINE, "tip_offset_m": 0.5})
    assert [error["field"] for error in bad.json()["errors"]] == ["tip_offset_m"]
    assert http.get("/grippers/mine").json()["version"] == 1


def test_trials_keep_their_version_and_queries_mix_all_with_a_warning(
    http: httpx.Client, make_object: Make, put_box: Callable[..., Any]
) -> None:
    http.post("/grippers", json={"id": "mine", **MINE})
    thing = make_object(http)
    put_box(http, thing)
    for _ in range(2):
        _post(http, thing, "mine")
    _post(http, thing, None)
    density = http.get(f"/objects/{thing}/density").json()
    assert (density["gripper"], density["gripper_versions"], density["warnings"]) == ("mine", [1], [])
    _put(http, {**MINE, "max_opening_m": 0.06})
    receipt = _post(http, thing, "mine")
    _post(http, thing, "mine@1", outcome=False)

    rows = http.get(f"/objects/{thing}/trials").json()["items"]
    assert [row["gripper"] for row in rows] == ["mine", "mine", None, "mine", "mine"]
    assert [row["gripper_version"] for row in rows] == [1, 1, None, 2, 1]
    counts = {
        name: http.get(f"/objects/{thing}/trials?gripper={name}").json()["items"]
        for name in ("mine", "mine@1")
    }
    assert [len(found) for found in counts.values()] == [4, 3]
    batch = http.get(f"/objects/{thing}/batches/{receipt['batch']}").json()
    assert (batch["grippers"], batch["gripper_versions"]) == (["mine"], ["mine@2"])

    # Several versions of one gripper are not ambiguous, and a correction throws no trial away.
    for query in ("", "?gripper=mine"):
        mixed = http.get(f"/objects/{thing}/density{query}").json()
        assert (mixed["gripper"], mixed["gripper_versions"], mixed["size"]) == ("mine", [1, 2], 4)
        (warning,) = mixed["warnings"]
        assert "mine@1 differs in max_opening_m" in warning
    first = http.get(f"/objects/{thing}/density?gripper=mine@1").json()
    assert (first["gripper"], first["gripper_versions"], first["size"]) == ("mine@1", [1], 3)
    assert first["warnings"] == []
    best = http.get(f"/objects/{thing}/best-grasp").json()
    likely = http.get(f"/objects/{thing}/likelihood?position=0,0,0.1&quaternion_xyzw=1,0,0,0").json()
    drawn = http.post(f"/objects/{thing}/samples", json={"count": 1}).json()
    assert best["warnings"] == likely["warnings"] == drawn["warnings"] == mixed["warnings"]
    assert http.get(f"/objects/{thing}/density?gripper=mine@3").status_code == 404
    unknown = http.post(f"/objects/{thing}/trials", json={**TRIAL, "gripper": "mine@3"})
    assert (unknown.status_code, unknown.json()["errors"][0]["field"]) == (422, "gripper")
    rows_of = {
        (row["gripper"], row["gripper_version"]) for row in http.get("/reports/summary").json()["rows"]
    }
    assert rows_of == {("mine", 1), ("mine", 2), (None, None)}
    assert http.delete("/grippers/mine").status_code == 409


def test_another_profile_is_another_answer_on_every_replica(
    replicas: tuple[httpx.Client, httpx.Client], make_object: Make, put_box: Callable[..., Any]
) -> None:
    """Trials that name no gripper: nothing of the object changes when a gripper does."""
    here, there = replicas
    here.post("/grippers", json={"id": "mine", **MINE})
    thing = make_object(here)
    put_box(here, thing, (0.04, 0.06, 0.1))
    for x in range(4):
        _post(here, thing, None, position=[0.004 * x, 0, 0.04], outcome=x % 2 == 0)
    place = f"/objects/{thing}/best-grasp"
    asked = {"gripper": "mine", "candidates": [TRIAL | {"position": [0, 0, 0.055]}]}
    asked["candidates"] = [{"position": [0, 0, 0.055], "quaternion_xyzw": [0.5**0.5, 0.5**0.5, 0, 0]}]

    def answers() -> list[tuple[str, Any]]:
        found = [http.get(place, params={"gripper": "mine"}) for http in replicas]
        return [
            (answer.headers["etag"], http.post(place, json=asked).json()["status"])
            for answer, http in zip(found, replicas, strict=True)
        ]

    before = answers()
    assert before[0] == before[1]
    assert before[0][1] == "ok"
    report = f"/objects/{thing}/reports/projection?gripper=mine"
    reports = [http.get(report).headers.get("etag") for http in replicas]

    # Too narrow for the box now: it collides wherever it was free.
    _put(here, {**MINE, "max_opening_m": 0.03})
    narrow = answers()
    assert narrow[0] == narrow[1]
    assert (narrow[0][0] != before[0][0], narrow[0][1]) == (True, "infeasible")
    assert (
        there.get(place, params={"gripper": "mine"}, headers={"If-None-Match": narrow[0][0]}).status_code
        == 304
    )
    assert there.get(report).headers.get("etag") not in reports

    # Deleted and made anew: version 1 is another profile's.
    assert here.delete("/grippers/mine").status_code == 204
    assert there.get(place, params={"gripper": "mine"}).status_code == 404
    here.post("/grippers", json={"id": "mine", **MINE})
    again = answers()
    assert again[0] == again[1]
    assert (again[0][0] in (narrow[0][0], before[0][0]), again[0][1]) == (False, "ok")


def test_two_puts_at_once_make_versions_one_after_the_other(http: httpx.Client) -> None:
    http.post("/grippers", json={"id": "mine", **MINE})
    forces = [21, 21, 22, 22, 23, 23]
    with ThreadPoolExecutor(len(forces)) as pool:
        answers = list(
            pool.map(lambda force: http.put("/grippers/mine", json={**MINE, "force_n": force}), forces)
        )
    assert {answer.status_code for answer in answers} == {200}
    versions = http.get("/grippers/mine/versions").json()["items"]
    assert [item["version"] for item in versions] == list(range(1, len(versions) + 1))
    assert 4 <= len(versions) <= 7
    assert all(item["changed"] == ["force_n"] for item in versions[1:])


def test_posting_and_deleting_at_once_stores_all_or_refuses(http: httpx.Client, make_object: Make) -> None:
    """Whoever comes first: a trial keeps its gripper, or a deleted gripper takes no trial."""
    thing = make_object(http)
    for turn in range(6):
        gripper = f"g{turn}"
        http.post("/grippers", json={"id": gripper, **MINE})
        receipt = _post(http, thing, gripper)
        http.delete(f"/objects/{thing}/batches/{receipt['batch']}")

        def ask(what: str, gripper: str = gripper) -> int:
            if what == "delete":
                return http.delete(f"/grippers/{gripper}").status_code
            if what == "put":
                return http.put(f"/grippers/{gripper}", json={**MINE, "force_n": 7}).status_code
            return http.post(f"/objects/{thing}/trials", json={**TRIAL, "gripper": gripper}).status_code

        wishes = ["delete", "post", "post", "put"]
        random.Random(turn).shuffle(wishes)
        with ThreadPoolExecutor(len(wishes)) as pool:
            codes = dict(zip(enumerate(wishes), pool.map(ask, wishes), strict=True))
        assert {code for (_, what), code in codes.items() if what == "post"} <= {201, 422}
        assert {code for (_, what), code in codes.items() if what == "put"} <= {200, 404}
        stored = sum(code == 201 for (_, what), code in codes.items() if what == "post")
        assert len(http.get(f"/objects/{thing}/trials?gripper={gripper}").json()["items"]) == stored
        deleted = next(code for (_, what), code in codes.items() if what == "delete")
        assert (deleted, http.get(f"/grippers/{gripper}").status_code) in ((204, 404), (409, 200))
        assert not (stored and deleted == 204)


def test_kernels_and_sweeps_are_of_a_version_or_of_all(
    http: httpx.Client, make_object: Make, put_box: Callable[..., Any]
) -> None:
    http.post("/grippers", json={"id": "mine", **MINE, "max_opening_m": 0.08})
    _put(http, {**MINE, "max_opening_m": 0.07})
    component = {
        "weight": 1,
        "mean": [0] * 6,
        "covariance": [[0.01 * (i == j) for j in range(6)] for i in range(6)],
    }
    given = {"kind": "anisotropic", "components": [component]}
    ids = {
        name: http.post("/kernels", json={**given, "gripper": name}).json()["id"]
        for name in ("mine", "mine@1")
    }
    for name, known in (("mine", list(ids.values())), ("mine@1", [ids["mine@1"]])):
        items = http.get("/kernels", params={"gripper": name}).json()["items"]
        assert [item["id"] for item in items] == known
    assert http.get(f"/kernels/{ids['mine@1']}").json()["gripper"] == "mine@1"
    assert http.post("/kernels", json={**given, "gripper": "mine@9"}).status_code == 422

    thing = make_object(http, mass_kg=0.1)
    put_box(http, thing)
    plan = {"grid": {"max_poses": 10}}
    sweeps = [
        http.post(f"/objects/{thing}/sweeps", json={**plan, "gripper": name}) for name in ("mine", "mine@1")
    ]
    assert [sweep.status_code for sweep in sweeps] == [202, 202]
    assert [(s.json()["gripper"], s.json()["gripper_version"]) for s in sweeps] == [("mine", 2), ("mine", 1)]
    jobs = http.post("/jobs/claim", json={"worker": "w", "capabilities": ["simulate"], "limit": 2}).json()[
        "jobs"
    ]
    assert [job["payload"]["gripper"]["max_opening_m"] for job in jobs] == [0.07, 0.08]
    assert http.post(f"/objects/{thing}/sweeps", json={**plan, "gripper": "mine@9"}).status_code == 422
    assert http.delete("/grippers/mine").status_code == 409

"""Answers have ids and names, and are given again exactly, whatever became of the trials since."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from typing import Any

import httpx
import pytest

from graspdb_service.api.context import Context
from graspdb_service.settings import Settings
from graspdb_service.storage import answers as stored
from graspdb_service.storage import objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database

Poses = tuple[Any, Any]
DOWN = [1.0, 0.0, 0.0, 0.0]


@pytest.fixture
def thing(
    http: httpx.Client, make_object: Callable[..., str], post: Callable[..., Any], two_clusters: Poses
) -> str:
    """An object with successes in two places, and failures between."""
    slug = make_object(http)
    outcomes = ["failure" if i % 4 == 0 else "success" for i in range(len(two_clusters[0]))]
    post(http, slug, two_clusters, outcomes, gripper="pg70", protocol="lift", source="robot")
    return slug


def _post_more(http: httpx.Client, slug: str) -> None:
    body = {"position": [0, 0, 0.06], "quaternion_xyzw": DOWN, "outcome": "failure"}
    assert http.post(f"/objects/{slug}/trials", json={**body, "gripper": "pg70"}).status_code == 201


QUESTIONS: list[tuple[str, dict[str, Any]]] = [
    ("best-grasp", {"count": 2, "approach": [0, 0, -1], "approach_cone_deg": 40}),
    ("likelihood", {"poses": [{"position": [0, 0, 0.06], "quaternion_xyzw": DOWN}]}),
    ("samples", {"count": 5}),
    ("proposals", {"count": 5, "strategy": "uncertainty"}),
]


@pytest.mark.parametrize(("kind", "question"), QUESTIONS)
def test_an_answer_is_given_again_exactly(
    http: httpx.Client, thing: str, kind: str, question: dict[str, Any]
) -> None:
    given = http.post(f"/objects/{thing}/{kind}", json=question).json()
    id = given["answer"]
    _post_more(http, thing)
    kept = http.get(f"/answers/{id}").json()
    assert kept["result"] == given
    assert (kept["answer"], kept["object"], kept["kind"]) == (id, thing, kind)
    assert (kept["revision"], kept["object_revision"]) == (1, 2)
    assert (kept["gripper"], kept["protocol"], kept["source"]) == ("pg70", "lift", None)
    assert (kept["estimator"], kept["kernel"]) == (given["estimator"], given["kernel"])
    assert {name: kept["question"][name] for name in question if name != "poses"} == {
        name: value for name, value in question.items() if name != "poses"
    }
    # The question as it is kept is a question: asked anew, it is today's.
    today = http.get(f"/answers/{id}", params={"now": True}).json()
    assert today["revision"] == 2
    assert today["answer"] != id
    assert today["question"] == kept["question"]
    again = http.post(f"/objects/{thing}/{kind}", json=kept["question"]).json()
    assert again == today["result"]


def test_the_same_question_has_one_id(http: httpx.Client, thing: str) -> None:
    asked = {"approach": "0,0,-1", "approach_cone_deg": 40}
    first = http.get(f"/objects/{thing}/best-grasp", params=asked).json()
    second = http.post(
        f"/objects/{thing}/best-grasp",
        json={"approach": [0, 0, -1], "approach_cone_deg": 40, "count": 1, "frame": None},
    ).json()
    assert first["answer"] == second["answer"]
    other = http.get(f"/objects/{thing}/best-grasp", params={**asked, "count": 2}).json()
    assert other["answer"] != first["answer"]
    _post_more(http, thing)
    assert http.get(f"/objects/{thing}/best-grasp", params=asked).json()["answer"] != first["answer"]
    http.get(f"/answers/{other['answer']}")
    kept = http.get(f"/objects/{thing}/answers").json()["items"]
    assert len({item["answer"] for item in kept}) == len(kept) == 3


def test_a_name_keeps_an_answer(http: httpx.Client, thing: str) -> None:
    path, question = f"/objects/{thing}/best-grasp", {"count": 2, "name": "bin-7"}
    first = http.post(path, json=question).json()
    assert first["newer_revision"] is None
    assert http.post(path, json=question).json() == first
    _post_more(http, thing)
    again = http.get(path, params=question).json()
    assert again == {**first, "newer_revision": 2}
    kept = http.get("/answers/bin-7").json()
    assert (kept["names"], kept["answer"], kept["result"]) == (["bin-7"], first["answer"], first)
    taken = http.post(path, json={"count": 3, "name": "bin-7"})
    assert (taken.status_code, taken.json()["type"][-10:]) == (409, "name-taken")
    assert "bin-7" in taken.json()["title"]
    assert http.post(f"/objects/{thing}/samples", json={"count": 2, "name": "bin-7"}).status_code == 409
    found = http.get(f"/objects/{thing}/answers", params={"name": "bin-7"}).json()["items"]
    assert [item["names"] for item in found] == [["bin-7"]]
    assert http.get(f"/objects/{thing}/answers", params={"name": "bin-8"}).json()["items"] == []
    assert http.delete("/answers/bin-7").status_code == 204
    assert http.get("/answers/bin-7").status_code == 404
    assert http.get(f"/answers/{first['answer']}").status_code == 404
    fresh = http.post(path, json={"count": 3, "name": "bin-7"}).json()
    assert fresh["revision"] == 2


def test_draws_without_a_seed_are_repeated_by_name(http: httpx.Client, thing: str) -> None:
    path = f"/objects/{thing}/samples"
    first = http.post(path, json={"count": 4, "name": "draws"}).json()
    assert http.post(path, json={"count": 4, "name": "draws"}).json() == first
    seeded = {"count": 4, "name": "draws", "seed": first["seed"]}
    assert http.post(path, json=seeded).json() == first
    assert http.post(path, json={**seeded, "seed": first["seed"] ^ 1}).status_code == 409


def test_one_of_many_who_ask_under_a_name_at_once_fixes_the_answer(http: httpx.Client, thing: str) -> None:
    def ask(_: int) -> Any:
        return http.post(f"/objects/{thing}/samples", json={"count": 3, "name": "race"}).json()

    with ThreadPoolExecutor(8) as pool:
        first, *others = pool.map(ask, range(8))
    assert all(other == first for other in others)
    assert http.get("/answers/race").json()["result"] == first


def test_names_that_can_not_be(http: httpx.Client, thing: str) -> None:
    path = f"/objects/{thing}/best-grasp"
    for name in ("a b", "", "0123456789abcdef0123"):
        refused = http.post(path, json={"name": name})
        assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, "name")
    many = http.post(f"/objects/{thing}/samples", json={"count": 1_001, "name": "many"})
    assert (many.status_code, many.json()["errors"][0]["field"]) == (422, "name")
    assert http.post(f"/objects/{thing}/samples", json={"count": 1_001}).json()["answer"] is None
    for reference in ("nothing", "0" * 20, "a%00b", "x" * 70):
        assert http.get(f"/answers/{reference}").status_code == 404
        assert http.delete(f"/answers/{reference}").status_code == 404


def test_two_names_of_one_answer(http: httpx.Client, thing: str) -> None:
    path = f"/objects/{thing}/best-grasp"
    ids = {http.post(path, json={"name": name}).json()["answer"] for name in ("one", "two")}
    (id,) = ids
    assert http.get("/answers/one").json()["names"] == ["one", "two"]
    http.delete("/answers/one")
    assert http.get(f"/answers/{id}").json()["names"] == ["two"]
    http.delete(f"/answers/{id}")
    assert http.get("/answers/two").status_code == 404


def test_an_object_takes_its_answers_along(
    http: httpx.Client, thing: str, make_object: Callable[..., str]
) -> None:
    id = http.post(f"/objects/{thing}/best-grasp", json={"name": "gone"}).json()["answer"]
    assert http.delete(f"/objects/{thing}").status_code == 204
    make_object(http, thing)
    assert http.get(f"/answers/{id}").status_code == 404
    assert http.get("/answers/gone").status_code == 404
    assert http.get(f"/objects/{thing}/answers").json()["items"] == []


def test_unchanged_is_told_of_answers_that_are_kept_only(http: httpx.Client, thing: str) -> None:
    path = f"/objects/{thing}/best-grasp"
    given = http.get(path)
    seen = {"If-None-Match": given.headers["etag"]}
    assert http.get(path, headers=seen).status_code == 304
    assert http.get(path, headers=seen, params={"count": 2}).status_code == 200
    # A name is written down, whatever the client has.
    assert http.get(path, headers=seen, params={"name": "mine"}).status_code == 200
    assert http.get(f"/answers/{given.json()['answer']}").json()["names"] == ["mine"]
    assert http.delete(f"/answers/{given.json()['answer']}").status_code == 204
    anew = http.get(path, headers=seen)
    assert (anew.status_code, anew.json()["answer"]) == (200, given.json()["answer"])
    assert http.get(f"/answers/{anew.json()['answer']}").status_code == 200
    assert http.get(path, headers={"If-None-Match": anew.headers["etag"]}).status_code == 304
    _post_more(http, thing)
    assert http.get(path, headers=seen).status_code == 200


def test_another_replica_finds_an_answer_at_once(
    database_url: str, serve: Callable[..., str], make_object: Callable[..., str], post: Callable[..., Any],
    two_clusters: Poses,
) -> None:  # fmt: skip
    one, two = (httpx.Client(base_url=serve(database_url), timeout=60) for _ in range(2))
    slug = make_object(one)
    post(one, slug, two_clusters)
    for count in range(1, 6):
        given = one.post(f"/objects/{slug}/best-grasp", json={"count": count}).json()
        assert two.get(f"/answers/{given['answer']}").json()["result"] == given
    one.close()
    two.close()


def test_a_database_that_takes_nothing_keeps_no_answer(
    sqlite_url: str, serve: Callable[..., str], make_object: Callable[..., str], post: Callable[..., Any],
    two_clusters: Poses, eventually: Callable[..., Any], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("graspdb_service.storage.database.SQLITE_BUSY_MS", 50)
    with httpx.Client(base_url=serve(sqlite_url), timeout=60) as http:
        slug = make_object(http)
        post(http, slug, two_clusters)
        other = sqlite3.connect(sqlite_url.removeprefix("sqlite:///"), isolation_level=None)
        other.execute("BEGIN IMMEDIATE")

        def ask(count: int) -> dict[str, Any]:
            answer = http.post(f"/objects/{slug}/best-grasp", json={"count": count})
            assert answer.status_code == 200
            body: dict[str, Any] = answer.json()
            return body

        first = ask(1)["answer"]
        counts = iter(range(2, 900))
        eventually(lambda: ask(next(counts))["answer"] is None)
        untagged = http.get(f"/objects/{slug}/best-grasp", params={"count": 950})
        assert "etag" not in untagged.headers
        assert http.get(f"/answers/{first}").status_code == 503
        assert http.post(f"/objects/{slug}/best-grasp", json={"name": "mine"}).status_code == 503
        other.execute("ROLLBACK")
        other.close()
        eventually(lambda: ask(next(counts))["answer"] is not None)
        # What was given an id before is kept after all.
        assert http.get(f"/answers/{first}").status_code == 200


def test_only_the_newest_are_kept_but_for_those_with_a_name(
    database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored, "SHORTEST_LIFE", timedelta(0))
    database = Database(database_url)
    ctx = Context.create(Settings(database_url=database_url, max_answers=3), database)
    with database.write() as tx:
        objects.create(tx, "thing", {})
        audit.record(tx, "object.create", object="thing")
        row = objects.find(tx, "thing")
        assert row is not None

    def given(number: int) -> stored.GivenAnswer:
        id = f"{number:020x}"
        return stored.GivenAnswer(id, row.id, "samples", 1, None, None, None, "1", b"{}", b'{"a":1}')

    assert ctx.answers.name(given(0), "first") == b'{"a":1}'
    for number in range(1, 9):
        assert ctx.answers.give(given(number))
        ctx.answers.settle([given(number).id])
        time.sleep(0.002)
    with database.read() as tx:
        kept = [item.id for item in stored.page(tx, row.id, before=0, limit=20, name=None, kind=None)]
    assert kept[0] == given(8).id
    assert given(0).id in kept
    assert 4 <= len(kept) <= 6
    ctx.close()

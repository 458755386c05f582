"""Grippers: those of the table of presets are built in, users add theirs."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx

from graspdb.wire.presets.grippers import PRESETS
from graspdb_service.storage import grippers
from graspdb_service.storage.database import Database
from graspdb_service.storage.schema import upgrade
from graspdb_service.usecases.grippers import seed

MINE: dict[str, Any] = {
    "id": "mine",
    "name": "Printed jaw",
    "max_opening_m": 0.05,
    "finger": {"width_m": 0.01, "thickness_m": 0.01, "length_m": 0.05},
    "tip_offset_m": 0.01,
    "palm_size_m": [0.05, 0.08, 0.05],
    "base_to_tool": {"matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.12], [0, 0, 0, 1]]},
    "symmetric": False,
}


def test_built_in_grippers_exist_from_the_start(http: httpx.Client) -> None:
    items = http.get("/grippers").json()["items"]
    assert [item["id"] for item in items] == sorted(PRESETS)
    assert all(item["builtin"] for item in items)
    assert all(item["profile"]["source"] and item["profile"]["unverified"] for item in items)
    pg70 = next(item for item in items if item["id"] == "pg70")["profile"]
    assert pg70["max_opening_m"] == 0.07
    assert pg70["finger"] == {"width_m": 0.02, "thickness_m": 0.015, "length_m": 0.07}
    assert (pg70["tip_offset_m"], pg70["palm_size_m"]) == (0.023, [0.08, 0.112, 0.092])
    assert (pg70["max_speed_m_s"], pg70["force_n"], pg70["friction"]) == (0.06, 40.0, 0.4)
    assert pg70["base_to_tool"]["position"] == [0, 0, 0.14]


def test_users_gripper_is_read_back(http: httpx.Client) -> None:
    made = http.post("/grippers", json=MINE)
    assert made.status_code == 201, made.text
    assert made.headers["location"] == "/grippers/mine"
    found = http.get("/grippers/mine")
    assert found.json() == made.json()
    profile = found.json()["profile"]
    assert profile["base_to_tool"] == {"position": [0, 0, 0.12], "quaternion_xyzw": [0, 0, 0, 1]}
    assert (profile["symmetric"], found.json()["builtin"]) == (False, False)
    assert http.get("/grippers/mine", headers={"If-None-Match": found.headers["etag"]}).status_code == 304
    assert http.post("/grippers", json=MINE).status_code == 409
    assert [g["id"] for g in http.get("/grippers").json()["items"]] == sorted({"mine", *PRESETS})


def test_grippers_come_in_pages(sqlite_http: httpx.Client) -> None:
    first = sqlite_http.get("/grippers?limit=1").json()
    second = sqlite_http.get("/grippers", params={"limit": 1, "cursor": first["next"]}).json()
    assert [first["items"][0]["id"], second["items"][0]["id"]] == sorted(PRESETS)[:2]
    last = sqlite_http.get(f"/grippers?limit={len(PRESETS)}").json()
    assert (len(last["items"]), last["next"]) == (len(PRESETS), None)


BAD_PROFILES: list[tuple[dict[str, Any], str]] = [
    ({"max_opening_m": 0}, "max_opening_m"),
    ({"max_opening_m": -1}, "max_opening_m"),
    ({"max_opening_m": 1e9}, "max_opening_m"),
    ({"palm_size_m": [0.1, 0.1, 3]}, "palm_size_m.2"),
    ({"finger": {"width_m": 5e-5, "thickness_m": 0.01, "length_m": 0.05}}, "finger.width_m"),
    ({"finger": {"width_m": 0.01, "thickness_m": 0.01}}, "finger.length_m"),
    ({"palm_size_m": [0.1, 0.1]}, "palm_size_m.2"),
    ({"tip_offset_m": 0.06}, "tip_offset_m"),
    ({"tip_offsets": [{"opening_m": 0.05, "tip_offset_m": 0.02}]}, "tip_offsets"),
    ({"tip_offsets": [{"opening_m": 0.02}]}, "tip_offsets.0.tip_offset_m"),
    ({"tip_offsets": [{"opening_m": x / 200, "tip_offset_m": 0.02} for x in range(99)]}, "tip_offsets"),
    ({"force_n": "strong"}, "force_n"),
    ({"fingers": 2}, "fingers"),
    ({"base_to_tool": {"position": [0, 0, 0], "quaternion_xyzw": [0] * 4}}, "base_to_tool.quaternion_xyzw"),
    ({"id": "no spaces"}, "id"),
]


def test_bad_profile_names_its_field(sqlite_http: httpx.Client) -> None:
    for change, field in BAD_PROFILES:
        answer = sqlite_http.post("/grippers", json={**MINE, **change})
        assert answer.status_code == 422, change
        assert [error["field"] for error in answer.json()["errors"]] == [field]
    assert len(sqlite_http.get("/grippers").json()["items"]) == len(PRESETS)


def test_missing_gripper_is_404(http: httpx.Client) -> None:
    for name in ("nope", "%00", "a%20b"):
        assert http.get(f"/grippers/{name}").status_code == 404


def test_replicas_that_start_at_once_seed_once(database_url: str) -> None:
    replicas = [Database(database_url) for _ in range(6)]
    if replicas[0].is_sqlite:
        upgrade(replicas[0])
    barrier = threading.Barrier(len(replicas))

    def start(database: Database) -> None:
        barrier.wait()
        seed(database)

    with ThreadPoolExecutor(len(replicas)) as pool:
        list(pool.map(start, replicas))
    with replicas[0].read() as tx:
        assert [row.id for row in grippers.page(tx, after="", limit=100)] == sorted(PRESETS)
    for database in replicas:
        database.dispose()


def test_a_wrong_profile_is_deleted_while_nothing_uses_it(
    http: httpx.Client, make_object: Callable[..., str]
) -> None:
    assert http.post("/grippers", json=MINE).status_code == 201
    place = f"/grippers/{MINE['id']}"
    thing = make_object(http)
    trial = {"position": [0, 0, 0.1], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True, "gripper": MINE["id"]}
    batch = http.post(f"/objects/{thing}/trials", json=trial).json()["batch"]
    refused = http.delete(place)
    assert (refused.status_code, refused.json()["type"].rpartition(":")[2]) == (409, "gripper-in-use")
    assert http.delete(f"/objects/{thing}/batches/{batch}").status_code == 204
    assert http.delete(place).status_code == 204
    assert http.get(place).status_code == 404
    assert http.delete(place).status_code == 404
    assert http.post("/grippers", json={**MINE, "force_n": 12}).status_code == 201
    assert http.post(f"/objects/{thing}/trials", json=trial).status_code == 201
    assert http.get(f"/objects/{thing}/density").json()["outcomes"] == {"success": 1}
    assert http.delete("/grippers/pg70").status_code == 409


def test_a_users_own_gripper_of_a_presets_name_stays_as_it_is(database_url: str) -> None:
    """As on a database of an older version: two built-in grippers that do not say where they are from, one of
    them changed since, and a gripper of the user's own.
    """
    database = Database(database_url)
    if database.is_sqlite:
        upgrade(database)
    own = {name: value for name, value in MINE.items() if name not in ("id", "name")}
    younger = {"source", "unverified", "tip_offsets", "joints"}
    bare = {
        name: PRESETS[name].profile.model_dump(mode="json", exclude=younger) for name in ("panda", "pg70")
    }
    changed = bare["pg70"] | {"force_n": 30.0}
    with database.write(audited=False) as tx:
        assert grippers.create(tx, "robotiq-2f-85", "Mine", own)
        assert grippers.create(tx, "panda", "Franka Panda hand", bare["panda"], builtin=True)
        assert grippers.create(tx, "pg70", "Schunk PG70", changed, builtin=True)
    for _ in range(2):
        seed(database)
        with database.read() as tx:
            rows = {row.id: row for row in grippers.page(tx, after="", limit=100)}
        assert sorted(rows) == sorted(PRESETS)
        assert (rows["robotiq-2f-85"].profile, rows["robotiq-2f-85"].builtin) == (own, False)
        assert (rows["panda"].profile, rows["panda"].version) == (
            PRESETS["panda"].profile.model_dump(mode="json"),
            1,
        )
        assert rows["pg70"].profile == changed
    database.dispose()

"""Objects: made, listed, changed, deleted with all that hangs on them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import httpx
from sqlalchemy import text

from graspdb_service.storage import objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database
from graspdb_service.storage.schema import upgrade

GRASP = {"position": [0, 0, 0.1], "quaternion_xyzw": [0, 0, 0, 1], "outcome": True}


def test_created_object_is_read_back(http: httpx.Client) -> None:
    sent = {
        "id": "mug.1",
        "name": "Becher – groß",
        "mass_kg": 0.3,
        "density_kg_m3": 1000,
        "friction": 0.4,
        "metadata": {"colour": "blau", "nested": {"sizes": [1, 2.5, None]}},
    }
    made = http.post("/objects", json=sent)
    assert made.status_code == 201
    assert made.headers["location"] == "/objects/mug.1"
    assert made.json().items() >= sent.items()
    found = http.get("/objects/mug.1").json()
    assert found == made.json()
    assert (found["revision"], found["epoch"], found["trials"], found["mesh"]) == (0, 0, 0, None)


def test_second_object_of_the_same_id_conflicts(http: httpx.Client) -> None:
    http.post("/objects", json={"id": "mug"})
    again = http.post("/objects", json={"id": "mug", "mass_kg": 1})
    assert again.status_code == 409
    assert again.json()["type"].endswith(":already-exists")
    assert http.get("/objects/mug").json()["mass_kg"] is None


def test_bad_id_names_its_field(sqlite_http: httpx.Client) -> None:
    for slug in ("", "-a", "a/b", "a b", "a\x00b", "ä", "x" * 65, "a\n", 5, None):
        answer = sqlite_http.post("/objects", json={"id": slug})
        assert answer.status_code == 422, slug
        assert [error["field"] for error in answer.json()["errors"]] == ["id"]
    assert sqlite_http.get("/objects").json() == {"items": [], "next": None}


def test_unknown_field_is_refused(sqlite_http: httpx.Client) -> None:
    answer = sqlite_http.post("/objects", json={"id": "mug", "mas_kg": 1})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "mas_kg"
    assert sqlite_http.get("/objects/mug").status_code == 404


def test_pages_cover_every_object_once(http: httpx.Client) -> None:
    names = [f"o{i:02}" for i in range(7)] + ["A", "Z.z"]
    for name in names:
        http.post("/objects", json={"id": name})
    seen: list[str] = []
    cursor: dict[str, str] = {}
    while True:
        page = http.get("/objects", params={"limit": 2, **cursor}).json()
        assert len(page["items"]) <= 2
        seen += [item["id"] for item in page["items"]]
        if page["next"] is None:
            break
        cursor = {"cursor": page["next"]}
    assert sorted(seen) == sorted(names)
    assert len(seen) == len(set(seen))


BAD_QUERIES = {
    "limit": ("limit=0", "limit=1001", "limit=ten", "limit=99999999999999999999", "limit=NaN"),
    "cursor": ("cursor=%00", "cursor=nonsense", "cursor=" + "W" * 499, "cursor=" + "W" * 501, "cursor=NTA"),
    "after": ("after=mug",),
}


def test_bad_page_query_names_its_parameter(http: httpx.Client) -> None:
    for field, queries in BAD_QUERIES.items():
        for query in queries:
            answer = http.get(f"/objects?{query}")
            assert answer.status_code == 422, query
            assert [error["field"] for error in answer.json()["errors"]] == [field]


def test_patch_sets_what_is_given_and_null_clears(http: httpx.Client) -> None:
    http.post("/objects", json={"id": "mug", "name": "Mug", "mass_kg": 0.3, "metadata": {"a": 1}})
    changed = http.patch("/objects/mug", json={"mass_kg": 0.4, "name": None})
    assert changed.status_code == 200
    after = changed.json()
    assert (after["mass_kg"], after["name"], after["metadata"]) == (0.4, None, {"a": 1})
    assert (after["revision"], after["epoch"]) == (1, 1)
    assert http.get("/objects/mug").json() == after
    assert http.patch("/objects/mug", json={"metadata": None}).json()["metadata"] is None


def test_patch_that_changes_nothing_keeps_the_revision(http: httpx.Client) -> None:
    http.post("/objects", json={"id": "mug", "mass_kg": 0.3})
    assert http.patch("/objects/mug", json={"mass_kg": 0.3}).json()["revision"] == 0
    assert http.patch("/objects/mug", json={}).json()["revision"] == 0


def test_patch_refuses_what_an_object_has_not(sqlite_http: httpx.Client) -> None:
    sqlite_http.post("/objects", json={"id": "mug"})
    answer = sqlite_http.patch("/objects/mug", json={"id": "cup"})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "id"


def test_etag_answers_304_until_something_changes(http: httpx.Client) -> None:
    http.post("/objects", json={"id": "mug"})
    tag = http.get("/objects/mug").headers["etag"]
    same = http.get("/objects/mug", headers={"If-None-Match": f'"other", {tag}'})
    assert (same.status_code, same.content) == (304, b"")
    http.post("/objects/mug/trials", json=GRASP)
    changed = http.get("/objects/mug", headers={"If-None-Match": tag})
    assert changed.status_code == 200
    assert changed.json()["outcomes"] == {"success": 1}


def test_etag_of_a_deleted_and_remade_object_is_another(http: httpx.Client) -> None:
    http.post("/objects", json={"id": "mug"})
    tag = http.get("/objects/mug").headers["etag"]
    http.delete("/objects/mug")
    http.post("/objects", json={"id": "mug"})
    assert http.get("/objects/mug", headers={"If-None-Match": tag}).status_code == 200


def test_delete_takes_everything_along(http: httpx.Client, database_url: str) -> None:
    for name in ("mug", "cup"):
        http.post("/objects", json={"id": name})
        http.post(f"/objects/{name}/trials", json={**GRASP, "gripper": "pg70"})
    assert http.delete("/objects/mug").status_code == 204
    for path in ("", "/trials", "/batches", "/mesh"):
        assert http.get(f"/objects/mug{path}").status_code == 404
    assert http.delete("/objects/mug").status_code == 404
    assert http.get("/objects/cup").json()["trials"] == 1
    database = Database(database_url)
    with database.read() as tx:
        for table in ("objects", "batches", "trials", "provenances", "tallies"):
            assert tx.execute(text(f"SELECT count(*) FROM {table}")).scalar() == 1, table
    database.dispose()


def test_delete_waits_for_no_running_sweep(http: httpx.Client) -> None:
    http.post("/objects", json={"id": "mug", "mass_kg": 0.3})
    stl = _tetrahedron_obj()
    assert (
        http.put("/objects/mug/mesh", content=stl, headers={"Content-Type": "model/obj"}).status_code == 200
    )
    swept = http.post("/objects/mug/sweeps", json={"grid": {"max_poses": 10}})
    assert swept.status_code == 202, swept.text
    refused = http.delete("/objects/mug")
    assert refused.status_code == 409
    assert refused.json()["type"].endswith(":sweep-running")
    http.post(f"/sweeps/{swept.json()['id']}/cancel")
    assert http.delete("/objects/mug").status_code == 204
    assert http.get(f"/sweeps/{swept.json()['id']}").status_code == 404


def _tetrahedron_obj() -> bytes:
    corners = ((0.0, 0.0, 0.0), (0.08, 0.0, 0.0), (0.0, 0.08, 0.0), (0.0, 0.0, 0.08))
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += [f"f {a} {b} {c}" for a, b, c in ((1, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 4))]
    return "\n".join(lines).encode()


def test_missing_object_is_404_whatever_its_name(http: httpx.Client) -> None:
    for name in ("nope", "%00", "..%2f..", "a%20b", "%ff", "x" * 300, "%ed%a0%80"):
        answer = http.get(f"/objects/{name}")
        assert answer.status_code == 404, name
        assert answer.headers["content-type"] == "application/problem+json"


def test_read_modify_writes_of_many_threads_lose_none(database_url: str) -> None:
    """1,200 increments over 8 threads: the object's row is the lock, on SQLite BEGIN IMMEDIATE."""
    database = Database(database_url)
    if database.is_sqlite:
        upgrade(database)
    with database.write() as tx:
        objects.create(tx, "mug", {"mass_kg": 0.0})
        audit.record(tx, "object.create", object="mug")

    def work(number: int) -> None:
        for _ in range(150):
            with database.write() as tx:
                row = objects.find(tx, "mug", lock=True)
                assert row is not None
                assert row.mass_kg is not None
                objects.advance(tx, row.id, rows=number % 3, append=True)
                objects.change(tx, row.id, {"mass_kg": row.mass_kg + 1.0})
                audit.record(tx, "object.change", object="mug")

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(8)))
    with database.read() as tx:
        row = objects.find(tx, "mug")
    database.dispose()
    assert row is not None
    assert (row.mass_kg, row.revision, row.last_seq) == (1200.0, 1200, 150 * (0 + 1 + 2 + 0 + 1 + 2 + 0 + 1))

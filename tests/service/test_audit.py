"""The audit: every change is recorded with its key, in the transaction that makes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest
from sqlalchemy import update

from graspdb.wire.access.keys import KeyCreate
from graspdb_service.storage import objects, tables
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database, Tx, UnauditedChange
from graspdb_service.usecases.access import keys

POSE = {"position": [0, 0, 0.05], "quaternion_xyzw": [1, 0, 0, 0]}
TRIAL = {**POSE, "outcome": True, "gripper": "pg70"}
GIVEN = {"components": [{"covariance": [[float(i == j) * 1e-3 for j in range(6)] for i in range(6)]}]}
GRIPPER: dict[str, Any] = {
    "id": "mine",
    "max_opening_m": 0.05,
    "finger": {"width_m": 0.01, "thickness_m": 0.01, "length_m": 0.05},
    "tip_offset_m": 0.01,
    "palm_size_m": [0.05, 0.08, 0.05],
}


@pytest.fixture
def boss(database_url: str, serve: Callable[..., str]) -> Iterator[httpx.Client]:
    """A client with the key ``boss`` of a server that takes keys."""
    database = Database(database_url)
    url = serve(database_url, auth="keys")
    made = keys.create(database, KeyCreate(name="boss", scopes=["admin"]))
    database.dispose()
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {made.key}"}, timeout=120) as client:
        yield client


def _done(client: httpx.Client, method: str, path: str, body: Any = None) -> httpx.Response:
    answer = client.request(method, path, json=body)
    assert answer.is_success, (method, path, answer.text)
    return answer


def test_every_change_is_recorded_with_its_key(boss: httpx.Client, put_box: Callable[..., Any]) -> None:
    began = datetime.now(UTC) - timedelta(seconds=1)
    _done(boss, "POST", "/objects", {"id": "mug", "mass_kg": 0.3})
    _done(boss, "PATCH", "/objects/mug", {"mass_kg": 0.4})
    put_box(boss, "mug")
    batch = _done(boss, "POST", "/objects/mug/trials", TRIAL).json()["batch"]
    _done(boss, "PATCH", "/objects/mug/trials/1", {"outcome": "slipped"})
    _done(boss, "DELETE", "/objects/mug/trials/1")
    sweep = _done(boss, "POST", "/objects/mug/sweeps", {"poses": [POSE]}).json()
    claimed = {"worker": "w", "capabilities": ["simulate"], "limit": 1}
    job = _done(boss, "POST", "/jobs/claim", claimed).json()["jobs"][0]
    result = {"outcomes": "AA==", "rows": {"pose_index": [], "quality": [], "width_m": []}}
    _done(boss, "PUT", f"/jobs/{job['id']}/result?lease_id={job['lease_id']}", result)
    other = _done(boss, "POST", "/objects/mug/sweeps", {"poses": [POSE, POSE]}).json()
    _done(boss, "POST", f"/sweeps/{other['id']}/cancel")
    _done(boss, "POST", f"/sweeps/{other['id']}/cancel")
    _done(boss, "POST", f"/sweeps/{other['id']}/retry")
    _done(boss, "POST", f"/sweeps/{other['id']}/cancel")
    kernel = _done(boss, "POST", "/kernels", GIVEN).json()["id"]
    _done(boss, "DELETE", f"/kernels/{kernel}")
    _done(boss, "POST", "/grippers", GRIPPER)
    _done(boss, "PUT", "/grippers/mine", {**GRIPPER, "max_opening_m": 0.06})
    _done(boss, "DELETE", "/grippers/mine")
    key = _done(boss, "POST", "/keys", {"name": "arm", "scopes": ["read"]}).json()["id"]
    _done(boss, "POST", f"/keys/{key}/rotate", {})
    _done(boss, "DELETE", f"/keys/{key}")
    _done(boss, "DELETE", f"/objects/mug/batches/{batch}")
    deleted = _done(boss, "DELETE", "/objects/mug")

    found = _done(boss, "GET", f"/audit?key=boss&limit=1000&since={began.isoformat().replace('+', '%2B')}")
    told = [(item["action"], item["object"], item["subject"]) for item in found.json()["items"]][::-1]
    assert told == [
        ("object.create", "mug", None),
        ("object.change", "mug", None),
        ("mesh.put", "mug", None),
        ("batch.create", "mug", batch),
        ("trial.correct", "mug", "1"),
        ("trial.withdraw", "mug", "1"),
        ("sweep.create", "mug", sweep["id"]),
        ("job.result", "mug", job["id"]),
        ("sweep.create", "mug", other["id"]),
        # What changes nothing, as cancelling twice, is no change.
        ("sweep.cancel", "mug", other["id"]),
        ("sweep.retry", "mug", other["id"]),
        ("sweep.cancel", "mug", other["id"]),
        ("kernel.create", None, kernel),
        ("kernel.delete", None, kernel),
        ("gripper.create", None, "mine"),
        ("gripper.change", None, "mine"),
        ("gripper.delete", None, "mine"),
        ("key.create", None, key),
        ("key.rotate", None, key),
        ("key.revoke", None, key),
        ("batch.delete", "mug", batch),
        ("object.delete", "mug", None),
    ]
    last = found.json()["items"][0]
    assert last["request_id"] == deleted.headers["x-request-id"]
    assert (sweep["key"], last["key"]) == ("boss", "boss")


def test_batches_tell_which_key_posted_them_and_the_audit_is_filtered(boss: httpx.Client) -> None:
    for slug in ("mug", "jug"):
        _done(boss, "POST", "/objects", {"id": slug})
    batch = _done(boss, "POST", "/objects/mug/trials", TRIAL).json()["batch"]
    assert boss.get(f"/objects/mug/batches/{batch}").json()["key"] == "boss"
    assert [item["action"] for item in boss.get("/audit?object=mug").json()["items"]] == [
        *("batch.create", "object.create")
    ]
    first = boss.get("/audit?action=object.create&limit=1").json()
    second = boss.get(f"/audit?action=object.create&limit=1&cursor={first['next']}").json()
    assert [page["items"][0]["object"] for page in (first, second)] == ["jug", "mug"]
    assert second["next"] is None
    assert boss.get("/audit?key=nobody").json()["items"] == []
    assert boss.get("/audit?since=2999-01-01T00:00:00Z").json()["items"] == []
    wrong = ("action=object.eat", "key=%00", "object=a b", "since=9999-12-31T23:59:59-14:00", "since=then")
    assert [boss.get(f"/audit?{query}").status_code for query in wrong] == [422] * len(wrong)


def test_a_change_without_its_record_is_not_committed(database_url: str, http: httpx.Client) -> None:
    _done(http, "POST", "/objects", {"id": "mug"})
    database = Database(database_url)
    changes: list[Any] = [
        lambda tx: objects.advance(tx, 1, append=True),
        lambda tx: objects.create(tx, "jug", {}),
        lambda tx: tx.execute(update(tables.grippers).values(name="x")),
        lambda tx: tx.execute(tables.batches.delete()) and objects.change(tx, 1, {"name": "x"}),
    ]
    for change in changes:
        with pytest.raises(UnauditedChange), database.write() as tx:
            change(tx)
    with database.write() as tx:
        # Nothing is changed, so nothing is to be told.
        assert not objects.create(tx, "mug", {})
        tx.execute(update(tables.grippers).where(tables.grippers.c.id == "none").values(name="x"))

    def fail(tx: Tx) -> None:
        objects.change(tx, 1, {"name": "x"})
        audit.record(tx, "object.change", object="mug")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), database.write() as tx:
        fail(tx)
    database.dispose()
    assert http.get("/objects/mug").json()["name"] is None
    assert [item["action"] for item in http.get("/audit?object=mug").json()["items"]] == ["object.create"]
    assert http.get("/objects/jug").status_code == 404

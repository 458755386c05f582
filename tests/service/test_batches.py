"""Batches: what was stored together leaves together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest

from graspdb_service.storage import objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database
from graspdb_service.storage.trials import batches, provenances, rows
from graspdb_service.trial_columns import Provenance, TrialColumns

Q = [0.0, 0.0, 0.0, 1.0]
GRASP: dict[str, Any] = {"position": [0, 0, 0.1], "quaternion_xyzw": Q, "outcome": "success"}


@pytest.fixture
def mug(http: httpx.Client) -> httpx.Client:
    """A client of a service that has an object ``mug``."""
    http.post("/objects", json={"id": "mug"})
    return http


def _add(http: httpx.Client, *outcomes: str | bool, **more: Any) -> str:
    body = {"trials": [{**GRASP, "outcome": outcome} for outcome in outcomes], **more}
    answer = http.post("/objects/mug/trials", json=body)
    assert answer.status_code == 201, answer.text
    key: str = answer.json()["batch"]
    return key


def test_batch_counts_its_outcomes(mug: httpx.Client) -> None:
    first = _add(mug, "success", "slipped", False, False, metadata={"robot": "left"})
    second = _add(mug, "success")
    listed = mug.get("/objects/mug/batches").json()
    assert [item["batch"] for item in listed["items"]] == [first, second]
    found = mug.get(f"/objects/mug/batches/{first}").json()
    assert found == listed["items"][0]
    expected = {
        "object": "mug",
        "inserted": 4,
        "packed": 0,
        "revision": 1,
        "sweep": None,
        "metadata": {"robot": "left"},
        "outcomes": {"failure": 2, "success": 1, "slipped": 1},
    }
    assert found.items() >= expected.items()


def test_batches_come_in_pages(mug: httpx.Client) -> None:
    keys = [_add(mug, True) for _ in range(5)]
    first = mug.get("/objects/mug/batches?limit=3").json()
    second = mug.get("/objects/mug/batches", params={"limit": 3, "cursor": first["next"]}).json()
    assert [item["batch"] for item in first["items"] + second["items"]] == keys
    assert second["next"] is None


def test_deleting_a_batch_undoes_it(mug: httpx.Client) -> None:
    kept = _add(mug, "success", "failure", gripper="pg70")
    gone = _add(mug, "success", "success", "slipped", gripper="pg70")
    after = _add(mug, "success")
    assert mug.delete(f"/objects/mug/batches/{gone}").status_code == 204
    found = mug.get("/objects/mug").json()
    assert found["outcomes"] == {"failure": 1, "success": 2}
    assert (found["revision"], found["epoch"]) == (4, 4)
    rows = mug.get("/objects/mug/trials").json()["items"]
    assert [(row["seq"], row["batch"]) for row in rows] == [(1, kept), (2, kept), (6, after)]
    assert mug.get(f"/objects/mug/batches/{gone}").status_code == 404
    assert mug.delete(f"/objects/mug/batches/{gone}").status_code == 404
    # Numbers are never given twice.
    _add(mug, "success")
    assert [row["seq"] for row in mug.get("/objects/mug/trials").json()["items"]] == [1, 2, 6, 7]


def test_batch_belongs_to_its_object(mug: httpx.Client) -> None:
    key = _add(mug, True)
    mug.post("/objects", json={"id": "cup"})
    assert mug.get(f"/objects/cup/batches/{key}").status_code == 404
    assert mug.delete(f"/objects/cup/batches/{key}").status_code == 404
    for name in ("nope", "%00", key.upper(), key + "0"):
        assert mug.get(f"/objects/mug/batches/{name}").status_code == 404
    assert mug.get("/objects/mug").json()["trials"] == 1


def test_etag_follows_the_batches(mug: httpx.Client) -> None:
    _add(mug, True)
    tag = {"If-None-Match": mug.get("/objects/mug/batches").headers["etag"]}
    assert mug.get("/objects/mug/batches", headers=tag).status_code == 304
    _add(mug, True)
    assert mug.get("/objects/mug/batches", headers=tag).status_code == 200


def test_batch_of_a_running_sweep_stays(mug: httpx.Client) -> None:
    box = ((0.0, 0.0, 0.0), (0.08, 0.0, 0.0), (0.0, 0.08, 0.0), (0.0, 0.0, 0.08))
    lines = [f"v {x} {y} {z}" for x, y, z in box] + ["f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"]
    mug.patch("/objects/mug", json={"mass_kg": 0.3})
    mesh = mug.put("/objects/mug/mesh", content="\n".join(lines), headers={"Content-Type": "model/obj"})
    assert mesh.status_code == 200, mesh.text
    sweep = mug.post("/objects/mug/sweeps", json={"grid": {"max_poses": 10}}).json()
    before = mug.get("/objects/mug").json()["revision"]
    path = f"/objects/mug/batches/{sweep['batch']}"
    refused = mug.delete(path)
    assert refused.status_code == 409
    assert refused.json()["type"].endswith(":sweep-running")
    mug.post(f"/sweeps/{sweep['id']}/cancel")
    assert mug.delete(path).status_code == 204
    assert mug.get("/objects/mug").json()["revision"] == before + 1


@pytest.fixture
def database(http: httpx.Client, database_url: str) -> Any:
    database = Database(database_url)
    yield database
    database.dispose()


def test_columns_are_read_as_they_were_stored(
    mug: httpx.Client, database: Database, clusters: Callable[..., Any]
) -> None:
    """The fast paths of both databases, with every mixture of missing values."""
    position, quaternion = clusters([((0, 0, 0), (0, 0, 0, 1))], 400, seed=5)
    rng = np.random.default_rng(0)
    proposal = np.where(rng.random(400) < 0.5, np.nan, rng.random(400) + 1e-300)
    quality = np.where(rng.random(400) < 0.3, np.nan, rng.normal(size=400))
    with database.write() as tx:
        row = objects.find(tx, "mug", lock=True)
        assert row is not None
        ids = np.array(
            [
                provenances.ensure(tx, row.id, Provenance("pg70", None, None)),
                provenances.ensure(tx, row.id, Provenance(None, "robot", "x")),
            ]
        )
        assert provenances.ensure(tx, row.id, Provenance("pg70", None, None)) == ids[0]
        # Posted, and once more as a sweep's.
        for pose_index in (np.empty(0, dtype=np.int64), np.arange(400, dtype=np.int64) * 2**40):
            revision, first = objects.advance(tx, row.id, rows=400, append=True)
            batch, key = batches.create(tx, row.id, revision=revision)
            audit.record(tx, "batch.create", object="mug", subject=key)
            columns = TrialColumns(
                position,
                quaternion,
                np.random.default_rng(1).integers(0, 3, 400).astype(np.uint8),
                ids[np.arange(400) % 2],
                proposal_density=proposal,
                quality=quality,
                pose_index=pose_index,
            )
            rows.insert(tx, row.id, batch, columns, revision=revision, first_seq=first)
            batches.grow(tx, batch, first_seq=first, last_seq=first + 399, inserted=400, packed=0)
    both = ids.tolist()
    with database.read() as tx:
        found = rows.posted(tx, row.id, both)
        fewer = rows.posted(tx, row.id, both, after_seq=99, without=(0, 2))
        successes = rows.successes(tx, row.id, [int(ids[1])], after_seq=first + 99)
        nothing = rows.posted(tx, row.id, [])
        page = rows.page(tx, row.id, after_seq=first - 1, limit=1000)
        counts = provenances.tallies(tx, row.id)
    assert found.seq.tolist() == list(range(first - 400, first))
    assert fewer.seq.tolist() == (100 + np.flatnonzero(columns.outcome[99:] == 1)).tolist()
    assert set(successes.batch.tolist()) == {batch}
    np.testing.assert_array_equal(found.position, position)
    np.testing.assert_array_equal(found.quaternion_xyzw, quaternion)
    np.testing.assert_array_equal(found.outcome, columns.outcome)
    np.testing.assert_array_equal(found.proposal_density, proposal)
    np.testing.assert_array_equal(found.provenance, columns.provenance)
    chosen = (columns.outcome == 1) & (np.arange(400) >= 100) & (columns.provenance == ids[1])
    np.testing.assert_array_equal(successes.position, position[chosen])
    assert len(nothing) == 0
    assert page.pose_index.tolist() == (np.arange(400) * 2**40).tolist()
    np.testing.assert_array_equal(page.quality, quality)
    expected = {(int(p), int(o)): 0 for p in ids for o in range(3)}
    for p, o in zip(columns.provenance, columns.outcome, strict=True):
        expected[int(p), int(o)] += 2
    assert {(p, o): n for p, o, n, _ in counts} == expected

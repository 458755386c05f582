"""A database written by any earlier version of the schema is upgraded with its rows, and read on.

``written/VERSION.sql`` is what graspdb's own code of that version wrote in a small afternoon. A version
without one is reached from the one before it, with made-up rows in what it added: a migration that somebody
adds is tested without a word here.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from sqlalchemy import MetaData

from graspdb_service.settings import Settings
from graspdb_service.storage import schema
from graspdb_service.storage.database import Database
from graspdb_service.storage.upkeep import layout
from graspdb_service.usecases.upkeep import doctor

WRITTEN = sorted(path.stem for path in Path(__file__).with_name("written").glob("*.sql"))
Invent = Callable[[Database], list[str]]


def insert_written(database: Database, version: str) -> None:
    """The rows that the code of a version wrote, in the words of either database."""
    script = Path(__file__).with_name("written").joinpath(f"{version}.sql").read_text(encoding="utf-8")
    as_bytes = r"X'\1'" if database.is_sqlite else r"'\\x\1'::bytea"
    with database.write() as tx:
        for statement in re.sub(r"bytes\('([0-9a-f]*)'\)", as_bytes, script).split(";\n"):
            if statement.strip():
                tx.exec_driver_sql(statement.replace("%", "%%") if not database.is_sqlite else statement)
        if not database.is_sqlite:
            for table in layout.layout_of(version):
                last = layout.last_id(tx, table)
                if last is not None:
                    layout.set_last_id(tx, table, last)


def counts(database: Database) -> dict[str, int]:
    found = MetaData()
    with database.read() as tx:
        found.reflect(tx)
        return {
            name: tx.exec_driver_sql(f'SELECT count(*) FROM "{name}"').scalar_one()
            for name in found.tables
            if name != "alembic_version"
        }


@pytest.fixture(params=schema.history())
def upgraded(request: pytest.FixtureRequest, empty_url: str, invent: Invent) -> Database:
    """A database that was at a version with rows in every table, now at the newest."""
    version = request.param
    base = max(written for written in WRITTEN if written <= version)
    database = Database(empty_url)
    schema.upgrade(database, base)
    insert_written(database, base)
    schema.upgrade(database, version)
    invent(database)
    before = counts(database)
    assert all(before.values()), before
    schema.upgrade(database)
    schema.check(database)
    after = counts(database)
    lost = {name: (number, after[name]) for name, number in before.items() if after.get(name, 0) < number}
    assert not lost, "rows went: SQLite deletes what refers to a table that is copied"
    return database


def test_what_an_earlier_version_wrote_is_read_on(upgraded: Database, serve: Callable[..., str]) -> None:
    url = upgraded.url.render_as_string(hide_password=False)
    told = doctor.examine(upgraded, Settings(database_url=url), {})
    assert [d for d in told if d.level == "error"] == []
    with httpx.Client(base_url=serve(url), timeout=240) as http:
        _reads(http)
        _goes_on(http)
    told = doctor.examine(upgraded, Settings(database_url=url), {})
    assert [d for d in told if d.level == "error"] == []
    upgraded.dispose()


def _reads(http: httpx.Client) -> None:
    def get(place: str, **query: Any) -> Any:
        answer = http.get(place, params=query)
        assert answer.status_code == 200, answer.text
        return answer.json()

    box = get("/objects/box")
    # 12 and 2 posted, 16 and 2 simulated; from 0004 on one of the posted is withdrawn.
    assert sum(box["outcomes"].values()) in (31, 32)
    assert box["outcomes"]["collision"] == 12
    trials = get("/objects/box/trials", limit=1000)["items"]
    assert [trial["seq"] for trial in trials] == sorted(trial["seq"] for trial in trials)
    posted = [trial for trial in trials if trial["sweep"] is None]
    assert len(posted) == 14
    # The same draws as conftest's, by another hand.
    rng = np.random.default_rng(7)
    first = [*rng.normal(scale=0.004, size=2), 0.05 + rng.normal(scale=0.004)]
    assert posted[0]["position"] == first
    assert posted[0]["metadata"] == {"operator": "Ørsted", "note": 'null "quoted"\n'}
    assert posted[0]["measured_at"].startswith("2026-03-01T12:00:00.000001")
    assert posted[0]["gripper"].split("@")[0] == "mine"
    best = get("/objects/box/best-grasp", gripper="mine", source="robot")["grasps"][0]
    np.testing.assert_allclose(best["position"], [-0.00065, -0.00213, 0.04875], atol=1e-3)
    assert get("/objects/box/density", gripper="mine", protocol="wrench")["revision"] == box["revision"]
    sweeps = get("/sweeps")["items"]
    assert {(sweep["state"], sweep["poses"]) for sweep in sweeps} == {("done", 16), ("done", 2)}
    for sweep in sweeps:
        assert len(get(f"/sweeps/{sweep['id']}/outcomes")["outcome"]) == sweep["poses"]
    assert get("/grippers/mine")
    assert get("/workers")["items"][0]["poses_done"] == 34


def _goes_on(http: httpx.Client) -> None:
    batches = http.get("/objects/box/batches").json()["items"]
    assert len(batches) == 5
    one = {"position": [0, 0, 0.05], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True, "gripper": "mine"}
    sent = {"trials": [one], "source": "robot"}
    last = max(trial["seq"] for trial in http.get("/objects/box/trials?limit=1000").json()["items"])
    receipt = http.post("/objects/box/trials", json=sent)
    assert receipt.status_code == 201, receipt.text
    listed = http.get("/objects/box/trials", params={"batch": receipt.json()["batch"]}).json()["items"]
    assert [trial["seq"] for trial in listed] == [last + 1]
    reused = http.post("/objects/box/trials", json=sent, headers={"Idempotency-Key": "first-afternoon"})
    assert reused.json()["type"].endswith("idempotency-key-reused")
    for batch in batches:
        assert http.delete(f"/objects/box/batches/{batch['batch']}").status_code == 204
    assert http.get("/objects/box").json()["outcomes"] == {"success": 1}

"""What is kept how long: keys, audit, workers and, where it is said, whole batches; counts stay right."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
from sqlalchemy import text

from graspdb_service.settings import Settings
from graspdb_service.storage.database import Database
from graspdb_service.usecases.upkeep import doctor
from graspdb_service.usecases.upkeep.upkeep import Upkeep

OLD = "'2020-01-01 00:00:00'"


def settings_of(database: Database, **more: Any) -> Settings:
    return Settings(database_url=database.url.render_as_string(hide_password=False), **more)


def count(database: Database, table: str) -> int:
    with database.read() as tx:
        return int(tx.execute(text(f"SELECT count(*) FROM {table}")).scalar_one())


def test_by_default_old_keys_and_workers_go_and_trials_stay(world_database: Database) -> None:
    with world_database.write() as tx:
        for number in range(1_200):
            tx.execute(
                text(
                    "INSERT INTO idempotency_keys"
                    " (scope, key, request_sha256, status, answer, revoked, created_at)"
                    f" VALUES ('POST /x', '{number}', '', 201, '{{}}', FALSE, {OLD})"
                )
            )
        tx.execute(text("UPDATE workers SET last_seen = 1000"))
        tx.execute(text(f"UPDATE batches SET created_at = {OLD}"))
    kept = count(world_database, "trials"), count(world_database, "batches")
    keys = count(world_database, "idempotency_keys")
    purged = Upkeep(settings_of(world_database), world_database).purge()
    assert purged == {"idempotency_keys": 1_200, "workers": 1}
    assert count(world_database, "idempotency_keys") == keys - 1_200
    assert (count(world_database, "trials"), count(world_database, "batches")) == kept
    assert Upkeep(settings_of(world_database), world_database).purge() == {
        "idempotency_keys": 0,
        "workers": 0,
    }


def test_old_batches_go_whole_where_that_is_said(world_database: Database, serve: Callable[..., str]) -> None:
    with world_database.write() as tx:
        tx.execute(text(f"UPDATE batches SET created_at = {OLD} WHERE id = (SELECT min(id) FROM batches)"))
        gone = tx.execute(text("SELECT inserted FROM batches ORDER BY id LIMIT 1")).scalar_one()
    before = count(world_database, "trials"), count(world_database, "batches")
    settings = settings_of(world_database, keep_trials_days=365)
    assert Upkeep(settings, world_database).purge()["batches"] == 1
    assert count(world_database, "trials") == before[0] - gone
    assert count(world_database, "batches") == before[1] - 1
    told = doctor.examine(world_database, settings, {})
    assert [d for d in told if d.level == "error"] == []
    with httpx.Client(base_url=serve(settings.database_url), timeout=240) as http:
        # What made it can't be sent again by mistake.
        body = {"trials": []}
        sent = http.post("/objects/box/trials", json=body, headers={"Idempotency-Key": "first-afternoon"})
        assert sent.status_code in (409, 422)


def test_a_service_purges_by_itself(
    world_database: Database, serve: Callable[..., str], eventually: Callable[..., Any]
) -> None:
    with world_database.write() as tx:
        tx.execute(text(f"UPDATE idempotency_keys SET created_at = {OLD}"))
    url = world_database.url.render_as_string(hide_password=False)
    with httpx.Client(base_url=serve(url), timeout=240) as http:
        eventually(lambda: count(world_database, "idempotency_keys") == 0)
        assert http.get("/info").json()["retention_days"]["idempotency"] == 30
        eventually(lambda: 'graspdb_purged_total{kind="idempotency_keys"}' in http.get("/metrics").text)

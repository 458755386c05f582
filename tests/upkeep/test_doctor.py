"""The doctor: nothing to say of a database in order and in use; every fault planted is named and judged."""

from __future__ import annotations

import json
import os
import sqlite3
import stat
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import text

from graspdb_service.settings import Settings
from graspdb_service.storage import schema
from graspdb_service.storage.database import Database
from graspdb_service.storage.tables import metadata
from graspdb_service.storage.upkeep import condition
from graspdb_service.usecases.upkeep import doctor
from graspdb_service.usecases.upkeep.doctor import Diagnosis


def examined(
    database: Database, environment: dict[str, str] | None = None, **settings: Any
) -> dict[str, Diagnosis]:
    url = database.url.render_as_string(hide_password=False)
    told = doctor.examine(database, Settings(database_url=url, **settings), environment or {})
    return {diagnosis.check: diagnosis for diagnosis in told}


def faults(database: Database) -> dict[str, str]:
    return {check: d.level for check, d in examined(database).items() if d.level != "ok"}


def plant(database: Database, *statements: str) -> None:
    """Change what no service would, constraints or not."""
    with database.write() as tx:
        if not database.is_sqlite:
            tx.execute(text("SET LOCAL session_replication_role = replica"))
        for statement in statements:
            tx.execute(text(statement))


def test_all_is_well_with_a_world_in_order(world_database: Database) -> None:
    found = examined(world_database)
    # A mesh outlives the object that was deleted only if another has the same.
    assert {check: d for check, d in found.items() if d.level != "ok"} == {}
    assert {
        "tallies",
        "batches",
        "revisions",
        "qualities",
        "packed outcomes",
        "owners",
        "references",
    } <= found.keys()


ROWS: list[tuple[str, str, str, bool]] = [
    # what is done to the database, the check that must find it, words of what was found, whether it is mended
    ("UPDATE tallies SET row_count = row_count + 3 WHERE outcome = 1", "tallies", "success", True),
    ("DELETE FROM tallies WHERE packed_count > 0", "tallies", "packed", True),
    ("UPDATE trials SET outcome = 2 WHERE seq = 2", "tallies", "collision", True),
    ("UPDATE batches SET inserted = inserted - 1 WHERE sweep_id IS NULL", "batches", "rows", True),
    ("UPDATE batches SET packed = 0 WHERE sweep_id IS NOT NULL", "batches", "packed", True),
    ("UPDATE batches SET last_seq = first_seq WHERE inserted > 1", "batches", "seq", True),
    ("UPDATE objects SET last_seq = 1", "revisions", "last_seq is 1", True),
    ("UPDATE objects SET revision = 1, epoch = 0", "revisions", "revision is 1", True),
    ("UPDATE objects SET epoch = revision + 1", "revisions", "epoch", True),
    (
        "UPDATE packed_outcomes SET outcomes = (SELECT max(outcomes) FROM packed_outcomes WHERE number = 1)"
        " WHERE number = 0",
        "packed outcomes",
        "were counted",
        False,
    ),
    ("DELETE FROM packed_outcomes WHERE number = 0", "packed outcomes", "has no outcomes", False),
    ("UPDATE objects SET quality_names = NULL", "qualities", "does not list", False),
    ("UPDATE batches SET quality_layout = NULL", "qualities", "bytes of qualities instead of 0", False),
    ("UPDATE trials SET batch_id = 999 WHERE seq = 1", "owners", "1 trials whose batch", False),
    ("UPDATE trials SET provenance_id = 999 WHERE seq = 1", "owners", "1 trials whose provenance", False),
    ("UPDATE jobs SET state = 'queued' WHERE number = 0", "owners", "jobs that are not done", False),
    (
        "UPDATE jobs SET sweep_id = NULL WHERE number = 0 AND kind = 'simulate'",
        "owners",
        "without a sweep",
        False,
    ),
    ("DELETE FROM trials WHERE seq = 4", "owners", "1 changes of trials", False),
    (
        "UPDATE idempotency_keys SET batch_key = 'no such batch' WHERE batch_key IS NOT NULL",
        "idempotency keys",
        "not there",
        False,
    ),
]


@pytest.mark.parametrize(("statement", "check", "words", "mended"), ROWS, ids=[row[0][:60] for row in ROWS])
def test_a_planted_fault_is_found(
    world_database: Database, statement: str, check: str, words: str, mended: bool
) -> None:
    if "trials WHERE seq = 4" in statement:
        statement = "DELETE FROM trials WHERE seq = (SELECT min(seq) FROM trial_changes)"
    plant(world_database, statement)
    found = examined(world_database)[check]
    assert found.level == "error"
    assert words in found.found
    assert found.meaning
    assert found.remedy
    assert found.repairable == mended
    if mended:
        with world_database.read() as tx:
            before = tx.execute(text("SELECT max(revision) FROM objects")).scalar_one()
        assert doctor.repair(world_database) == ["box"]
        assert faults(world_database) == {}
        with world_database.read() as tx:
            row = tx.execute(text("SELECT revision, epoch FROM objects")).one()
        # A new epoch: what was answered from wrong counts is answered no more.
        assert row.revision > before
        assert row.epoch == row.revision
        assert doctor.repair(world_database) == []


def test_references_that_lead_nowhere_are_found_in_every_table(world_database: Database) -> None:
    if world_database.is_sqlite:
        path = str(world_database.url.database)
        world_database.dispose()
        with sqlite3.connect(path) as connection:
            connection.execute("DELETE FROM objects")
    else:
        plant(world_database, "DELETE FROM objects")
    found = examined(world_database)["references"]
    assert found.level == "error"
    with world_database.read() as tx:
        broken = " ".join(condition.broken_references(tx))
    for table in ("trials", "batches", "sweeps", "jobs", "provenances"):
        assert f"{table} name a objects" in broken


def test_a_missing_index_and_a_strange_column_are_found(world_database: Database) -> None:
    plant(world_database, "DROP INDEX ix_trials_successes", "ALTER TABLE workers ADD COLUMN mood INTEGER")
    plant(world_database, "CREATE TABLE somebodys_own (id INTEGER)")
    found = examined(world_database)["tables and indexes"]
    assert found.level == "error"
    assert "ix_trials_successes" in found.found
    assert "mood" in found.found
    assert "somebodys_own" not in found.found


def test_every_index_of_the_code_is_looked_for(world_database: Database) -> None:
    names = sorted(str(index.name) for table in metadata.sorted_tables for index in table.indexes)
    plant(world_database, *(f"DROP INDEX {name}" for name in names))
    with world_database.read() as tx:
        found = " ".join(condition.schema_differences(tx))
    assert all(name in found for name in names)


@pytest.mark.parametrize("version", ["0001", "newer", "none"])
def test_another_version_of_the_schema_is_named(empty_url: str, version: str) -> None:
    database = Database(empty_url)
    if version != "none":
        schema.upgrade(database, "head" if version == "newer" else version)
    if version == "newer":
        plant(database, "UPDATE alembic_version SET version_num = '9999'")
    if database.is_sqlite:
        Path(str(database.url.database)).touch()
    found = examined(database)
    assert found["schema version"].level == "error"
    assert found["rows"].level == "warning"
    assert {"0001": "migrate", "newer": "newer", "none": "migrate"}[version] in found["schema version"].remedy
    database.dispose()


def test_times_to_come_and_a_clock_that_differs_are_found(
    world_database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(world_database, "UPDATE batches SET created_at = '2099-01-01 00:00:00'")
    assert "2099" in examined(world_database)["clock"].found
    monkeypatch.setattr(condition.time, "time", lambda: 1.0e9)
    found = examined(world_database)["clock"]
    assert found.level == "warning"
    assert "s from this machine's" in found.found


def test_damage_of_a_sqlite_file_is_found(world: Path, tmp_path: Path) -> None:
    content = bytearray(world.read_bytes())
    page = int.from_bytes(content[16:18], "big")
    # Behind the pages that hold the schema, without which the file can't be opened at all.
    for place in range(60 * page, len(content) - page, 7 * page):
        content[place : place + 40] = os.urandom(40)
    (tmp_path / "d.sqlite").write_bytes(content)
    database = Database(f"sqlite:///{tmp_path}/d.sqlite")
    told = doctor.examine(database, Settings(database_url=str(database.url)), {})
    found = next(diagnosis for diagnosis in told if diagnosis.check == "integrity")
    assert found.level == "error"
    assert "restore" in found.remedy
    database.dispose()


def test_the_file_its_journal_and_the_disk_are_looked_at(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "g.sqlite"
    path.write_bytes(world.read_bytes())
    path.chmod(0o666)
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    database = Database(f"sqlite:///{path}")
    found = examined(database)
    assert (found["file"].level, found["journal"].level) == ("error", "warning")
    assert "chmod" in found["file"].remedy
    assert stat.S_IMODE(path.stat().st_mode) == 0o666
    for free, level in ((1_000, "error"), (2**30, "warning"), (2**40, "ok")):
        usage = type("usage", (), {"total": 2**41, "free": free})
        monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _, usage=usage: usage)
        assert examined(database)["disk"].level == level
    database.dispose()


def test_settings_and_variables_are_looked_at(world: Path) -> None:
    database = Database(f"sqlite:///{world}")
    open_to_all = examined(database, host="0.0.0.0", auth="off")["settings"]
    assert open_to_all.level == "warning"
    assert "without keys" in open_to_all.found
    assert "memory" in examined(database, max_density_cache_bytes=2**50)["settings"].found
    assert "cores" in examined(database, threads=250)["settings"].found
    strange = examined(database, {"GRASPDB_MAX_BODY_BYTE": "1", "GRASPDB_URL": "x"})["environment"]
    assert strange.found == "GRASPDB_MAX_BODY_BYTE (did you mean GRASPDB_MAX_BODY_BYTES?)"
    database.dispose()


def test_nothing_is_found_while_batches_are_posted(database_url: str, serve: Callable[..., str]) -> None:
    stop = threading.Event()
    batch = {"trials": [{"position": [0, 0, 0.05], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True}] * 20}
    with httpx.Client(base_url=serve(database_url), timeout=240) as http:
        assert http.post("/objects", json={"id": "o"}).status_code == 201

        def post() -> None:
            while not stop.is_set():
                assert http.post("/objects/o/trials", json=batch).status_code == 201

        thread = threading.Thread(target=post)
        thread.start()
        database = Database(database_url)
        found = [faults(database) for _ in range(4)]
        stop.set()
        thread.join()
        database.dispose()
    assert found == [{}] * 4


def test_the_command_ends_with_what_it_found(server: Callable[..., Any], world: Path, tmp_path: Path) -> None:
    path = tmp_path / "g.sqlite"
    path.write_bytes(world.read_bytes())
    url = f"sqlite:///{path}"
    well = server("doctor", "--database-url", url)
    assert well.returncode == 0, well.stdout + well.stderr
    assert "tallies: agree" in well.stdout
    assert server("doctor", "--database-url", url, GRASPDB_THREDS="2").returncode == 1
    plant(Database(url), "UPDATE tallies SET row_count = 7")
    ill = server("doctor", "--json", "--database-url", url)
    assert ill.returncode == 2
    told = json.loads(ill.stdout)
    assert told["level"] == "error"
    assert [c["check"] for c in told["checks"] if c["level"] == "error" and c["repairable"]] == ["tallies"]
    mended = server("doctor", "--repair", "--database-url", url)
    assert (mended.returncode, "Counted anew: box." in mended.stdout) == (0, True)
    for elsewhere in (f"sqlite:///{tmp_path}/none.sqlite", "postgresql://127.0.0.1:1/x"):
        away = server("doctor", "--database-url", elsewhere)
        assert away.returncode == 2
        assert len(away.stderr.splitlines()) == 1, away.stderr
    assert not (tmp_path / "none.sqlite").exists()

"""Backups: one moment of a database in use, whole or refused, from either kind of database into either."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import stat
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import text

from graspdb_service.storage import schema
from graspdb_service.storage.database import Database
from graspdb_service.storage.tables import metadata
from graspdb_service.storage.upkeep import backup, layout
from graspdb_service.storage.upkeep.archive import ArchiveReader, DamagedArchive

PLACES = [
    *("/objects", "/objects/box", "/objects/box/trials?limit=1000", "/objects/box/batches", "/grippers"),
    *("/objects/box/density?gripper=mine", "/objects/box/best-grasp?gripper=mine&count=2", "/sweeps"),
    *("/kernels", "/workers", "/objects/box/trials/3", "/objects/box/convex-parts", "/objects/box/mesh"),
]


def silent(*_: Any) -> None:
    """No progress is shown."""


def rows_of(database: Database) -> dict[str, list[Any]]:
    """Every row of every table, as plain values in the order of their text."""
    with database.read() as tx:
        return {
            table.name: sorted(
                (row for _, line in layout.blocks(tx, table) for row in json.loads(line)), key=repr
            )
            for table in layout.layout_of("head")
        }


def restored(path: Path, url: str, *, overwrite: bool = False) -> backup.Restored:
    database, reader = Database(url), ArchiveReader(path)
    try:
        return backup.restore(database, reader, overwrite=overwrite, progress=silent)
    finally:
        reader.close()
        database.dispose()


def test_the_layout_has_every_table_and_column_of_the_code() -> None:
    found = {table.name: table.columns for table in layout.layout_of("head")}
    assert found == {
        table.name: [
            column.name for column in sorted(table.columns, key=lambda c: found[table.name].index(c.name))
        ]
        for table in metadata.sorted_tables
    }


def test_every_table_of_the_world_has_rows(world: Path) -> None:
    """Else nothing below would tell whether a table is copied."""
    database = Database(f"sqlite:///{world}")
    assert all(rows_of(database).values())
    database.dispose()


def test_both_kinds_hold_the_same_rows_and_counters_and_give_them_back(
    world: Path, world_database: Database, tmp_path: Path
) -> None:
    original = Database(f"sqlite:///{world}")
    expected = rows_of(original)
    assert rows_of(world_database) == expected
    backup.back_up(world_database, tmp_path / "again.backup", silent)
    restored(tmp_path / "again.backup", f"sqlite:///{tmp_path}/back.sqlite")
    back = Database(f"sqlite:///{tmp_path}/back.sqlite")
    assert rows_of(back) == expected
    for table in layout.layout_of("head"):
        with original.read() as a, world_database.read() as b, back.read() as c:
            assert layout.last_id(a, table) == layout.last_id(b, table) == layout.last_id(c, table), (
                table.name
            )
    for database in (original, back):
        database.dispose()


def test_a_restored_service_answers_byte_by_byte_as_before(
    world: Path, world_database: Database, serve: Callable[..., str], tmp_path: Path
) -> None:
    shutil.copyfile(world, tmp_path / "copy.sqlite")
    url = world_database.url.render_as_string(hide_password=False)
    with (
        httpx.Client(base_url=serve(f"sqlite:///{tmp_path}/copy.sqlite"), timeout=240) as before,
        httpx.Client(base_url=serve(url), timeout=240) as after,
    ):
        for place in PLACES:
            a, b = before.get(place), after.get(place)
            assert a.status_code == b.status_code == 200, (place, a.text, b.text)
            assert a.content == b.content or a.json() == b.json(), place
            assert a.headers.get("etag") == b.headers.get("etag"), place
            if "etag" in a.headers:
                assert after.get(place, headers={"If-None-Match": a.headers["etag"]}).status_code == 304
        page = before.get("/objects/box/trials?limit=7").json()
        rest = [c.get("/objects/box/trials", params={"cursor": page["next"]}).json() for c in (before, after)]
        assert rest[0] == rest[1]
        run = before.get("/objects/box/reports/bandwidth?gripper=mine&source=robot").json()
        assert after.get("/objects/box/reports/bandwidth?gripper=mine&source=robot").json() == run


def test_idempotency_and_numbers_go_on(
    world_database: Database, serve: Callable[..., str], world: Path
) -> None:
    url = world_database.url.render_as_string(hide_password=False)
    with world_database.read() as tx:
        body = tx.execute(text("SELECT max(id) FROM objects")).scalar_one()
        last = {table.name: layout.last_id(tx, table) for table in layout.layout_of("head")}
    # An object was deleted after the last that is there, so the counter is ahead of the rows.
    assert body == last["objects"]
    with httpx.Client(base_url=serve(url), timeout=240) as http:
        held = http.get("/objects/box").json()
        key = {"Idempotency-Key": "first-afternoon"}
        sent = http.post("/objects/box/trials", json={"trials": []}, headers=key)
        assert sent.status_code == 422
        assert sent.json()["type"].endswith("idempotency-key-reused")
        assert http.get("/objects/box").json() == held
        assert http.post("/objects", json={"id": "next"}).status_code == 201
        one = {"trials": [{"position": [0, 0, 0.05], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True}]}
        assert http.post("/objects/next/trials", json=one).status_code == 201
    with world_database.read() as tx:
        assert tx.execute(text("SELECT id FROM objects WHERE slug = 'next'")).scalar_one() == body + 1
        newest = tx.execute(text("SELECT max(id) FROM batches")).scalar_one()
    assert newest == (last["batches"] or 0) + 1


def test_a_backup_is_one_moment_while_batches_are_posted(
    database_url: str, serve: Callable[..., str], tmp_path: Path
) -> None:
    stop = threading.Event()
    batch = {"trials": [{"position": [0, 0, 0.05], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True}] * 50}
    with httpx.Client(base_url=serve(database_url), timeout=240) as http:
        assert http.post("/objects", json={"id": "o"}).status_code == 201

        def post() -> None:
            while not stop.is_set():
                assert http.post("/objects/o/trials", json=batch).status_code == 201

        thread = threading.Thread(target=post)
        thread.start()
        database = Database(database_url)
        for number in range(3):
            path = tmp_path / f"{number}.backup"
            backup.back_up(database, path, silent)
            restored(path, f"sqlite:///{tmp_path}/{number}.sqlite")
        stop.set()
        thread.join()
        database.dispose()
    for number in range(3):
        copy = Database(f"sqlite:///{tmp_path}/{number}.sqlite")
        with copy.read() as tx:
            counts = [
                tx.execute(text(query)).scalar_one() or 0
                for query in (
                    "SELECT count(*) FROM trials",
                    "SELECT sum(row_count) FROM tallies",
                    "SELECT sum(inserted) FROM batches",
                    "SELECT max(last_seq) FROM objects",
                    "SELECT 50 * max(revision) FROM objects",
                )
            ]
        copy.dispose()
        assert len(set(counts)) == 1, counts


@pytest.mark.parametrize("version", schema.history()[:-1])
def test_a_backup_of_an_earlier_schema_is_migrated(version: str, empty_url: str, tmp_path: Path) -> None:
    old = Database(f"sqlite:///{tmp_path}/old.sqlite")
    schema.upgrade(old, version)
    now = "'2026-01-01 00:00:00'"
    with old.write() as tx:
        tx.execute(
            text(
                "INSERT INTO objects (id, slug, revision, epoch, last_seq, created_at, updated_at)"
                f" VALUES (41, 'mug', 9, 3, 70, {now}, {now})"
            )
        )
    manifest = backup.back_up(old, tmp_path / "old.backup", silent)
    old.dispose()
    assert manifest.schema == version
    done = restored(tmp_path / "old.backup", empty_url)
    assert done.schema == schema.history()[-1]
    new = Database(empty_url)
    schema.check(new)
    with new.read() as tx:
        found = tx.execute(text("SELECT id, revision, epoch, last_seq FROM objects")).one()
    new.dispose()
    assert tuple(found) == (41, 9, 3, 70)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7), cut=st.booleans())
def test_a_damaged_backup_is_refused_wherever_the_damage_is(
    where: float, bit: int, cut: bool, world_backup: Path, damaged_copy: Callable[..., Any]
) -> None:
    """Whatever is read in spite of a flipped bit is what was written: some bits of a ZIP mean nothing."""
    whole = ArchiveReader(world_backup)
    entries = {table.name: table for table in whole.manifest.tables}

    def change(content: bytearray) -> bytearray:
        place = int(where * len(content))
        if cut:
            return content[:place]
        content[place] ^= 1 << bit
        return content

    with damaged_copy(change) as path:
        try:
            reader = ArchiveReader(path)
            try:
                reader.check(silent)
                assert not cut
                assert {table.name: table for table in reader.manifest.tables} == entries
            finally:
                reader.close()
        except DamagedArchive:
            pass
    whole.close()


def test_a_damaged_backup_changes_nothing(
    world_database: Database, damaged_copy: Callable[..., Any], world: Path
) -> None:
    def last_table(content: bytearray) -> bytearray:
        content[content.rfind(b"tables/") // 2] ^= 0x10
        return content

    expected = rows_of(world_database)
    world_database.dispose()
    url = world_database.url.render_as_string(hide_password=False)
    with damaged_copy(last_table) as path, pytest.raises(DamagedArchive):
        restored(path, url, overwrite=True)
    assert rows_of(world_database) == expected
    if world_database.is_sqlite:
        folder = Path(str(world_database.url.database)).parent
        assert not list(folder.glob("*.restoring*"))
        assert not list(folder.glob("*.replaced*"))


def test_a_changed_row_with_its_zip_in_order_is_refused(world_backup: Path, tmp_path: Path) -> None:
    forged = tmp_path / "forged.backup"
    with zipfile.ZipFile(world_backup) as source, zipfile.ZipFile(forged, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            target.writestr(
                name, content.replace(b'"box"', b'"bow"') if name.endswith("objects.ndjson") else content
            )
    with pytest.raises(DamagedArchive, match="objects"):
        restored(forged, f"sqlite:///{tmp_path}/x.sqlite")
    assert not (tmp_path / "x.sqlite").exists()


def test_data_is_replaced_only_when_that_is_said(
    world_database: Database, world_backup: Path, tmp_path: Path
) -> None:
    url = world_database.url.render_as_string(hide_password=False)
    with world_database.write() as tx:
        tx.execute(text("UPDATE objects SET revision = revision + 40, last_seq = last_seq + 500"))
        then = tx.execute(text("SELECT revision, last_seq FROM objects")).one()
    world_database.dispose()
    with pytest.raises(backup.RefusedRestore, match=r"objects.*--overwrite"):
        restored(world_backup, url)
    done = restored(world_backup, url, overwrite=True)
    assert done.continued == 1
    with world_database.read() as tx:
        now = tx.execute(text("SELECT revision, epoch, last_seq FROM objects")).one()
    # What a client was answered before the restore is of a revision that never comes again.
    assert tuple(now) == (then[0] + 1, then[0] + 1, then[1])
    assert (done.replaced is not None) == world_database.is_sqlite
    if done.replaced is not None:
        kept = Database(f"sqlite:///{done.replaced}")
        with kept.read() as tx:
            assert tuple(tx.execute(text("SELECT revision, last_seq FROM objects")).one()) == tuple(then)
        kept.dispose()


def test_a_started_service_without_data_may_be_restored_over(
    database_url: str, serve: Callable[..., str], world_backup: Path
) -> None:
    """Its built-in grippers are not somebody's data."""
    database = Database(database_url)
    with httpx.Client(base_url=serve(database_url)) as http:
        assert http.get("/grippers").status_code == 200
        with pytest.raises(backup.RefusedRestore, match="stop"):
            restored(world_backup, database_url)
    database.dispose()


def test_a_database_in_use_is_left_alone(world_database: Database, world_backup: Path) -> None:
    url = world_database.url.render_as_string(hide_password=False)
    with world_database.read() as tx:
        tx.execute(text("SELECT 1 FROM objects"))
        with pytest.raises(backup.RefusedRestore, match="stop"):
            restored(world_backup, url, overwrite=True)


def test_a_damaged_sqlite_file_is_replaced_and_kept(world_backup: Path, tmp_path: Path) -> None:
    path = tmp_path / "g.sqlite"
    path.write_bytes(b"SQLite format 3\0" + os.urandom(20_000))
    (tmp_path / "g.sqlite-wal").write_bytes(os.urandom(5_000))
    with pytest.raises(backup.RefusedRestore, match="--overwrite"):
        restored(world_backup, f"sqlite:///{path}")
    done = restored(world_backup, f"sqlite:///{path}", overwrite=True)
    assert done.replaced is not None
    assert done.replaced.stat().st_size > 20_000
    assert not (tmp_path / "g.sqlite-wal").exists()
    with sqlite3.connect(path) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_another_programs_file_is_not_taken_for_an_empty_one(world_backup: Path, tmp_path: Path) -> None:
    path = tmp_path / "photos.sqlite"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE photos (id INTEGER)")
    with pytest.raises(backup.RefusedRestore, match="photos"):
        restored(world_backup, f"sqlite:///{path}")


def test_the_commands_say_what_they_did_and_what_to_do(
    server: Callable[..., Any], world: Path, tmp_path: Path
) -> None:
    url = f"sqlite:///{world}"
    copy, fresh = str(tmp_path / "a.backup"), f"sqlite:///{tmp_path}/fresh.sqlite"
    done = server("backup", copy, "--database-url", url)
    assert done.returncode == 0, done.stderr
    assert "trials" in done.stdout
    assert stat.S_IMODE(os.stat(copy).st_mode) == 0o600
    again = server("backup", copy, "--database-url", url)
    assert (again.returncode, again.stdout) == (1, "")
    assert "--overwrite" in again.stderr
    assert server("restore", copy, "--dry-run", GRASPDB_DATABASE_URL=fresh).returncode == 0
    assert not (tmp_path / "fresh.sqlite").exists()
    told = json.loads(server("restore", copy, "--json", "--database-url", fresh).stdout)
    assert told["rows"]["objects"] == 1
    assert told["replaced"] is None
    (tmp_path / "text").write_text("not a backup")
    for order, words in (
        (("restore", str(tmp_path / "text")), "no backup"),
        (("restore", copy), "--overwrite"),
        (("backup", str(tmp_path / "no" / "folder")), "No such file"),
        (("backup", str(tmp_path / "b"), "--database-url", f"sqlite:///{tmp_path}/none"), "no database"),
        (("backup", str(tmp_path / "b"), "--database-url", "postgresql://127.0.0.1:1/x"), "does not answer"),
    ):
        failed = server(*order, **({} if "--database-url" in order else {"GRASPDB_DATABASE_URL": fresh}))
        assert failed.returncode == 1, (order, failed.stdout)
        assert words in failed.stderr, (order, failed.stderr)
        assert "Traceback" not in failed.stderr
    assert not (tmp_path / "none").exists()
    assert not list(tmp_path.glob("*.unfinished"))

"""One Alembic history for both databases: from a checkout, from a wheel, from several processes at once."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import inspect, text

from graspdb_service.storage import grippers, schema
from graspdb_service.storage.database import Database, UnsupportedDatabase
from graspdb_service.storage.tables import metadata
from graspdb_service.storage.trials import findings, provenances
from graspdb_service.storage.trials import rows as rows_of_trials
from graspdb_service.trial_columns import Provenance
from graspdb_service.usecases.trials import batches

ROOT = Path(__file__).parents[2]
KEY = "00000000-0000-4000-8000-000000000001"


@pytest.fixture(params=["sqlite", "postgres"])
def empty_url(request: pytest.FixtureRequest) -> str:
    """A database without a schema, of either kind."""
    name = "empty_sqlite_url" if request.param == "sqlite" else "empty_postgres_url"
    url: str = request.getfixturevalue(name)
    return url


def _head() -> str | None:
    return ScriptDirectory(str(schema.migrations_directory())).get_current_head()


def test_history_is_what_alembic_walks() -> None:
    script = ScriptDirectory(str(schema.migrations_directory()))
    assert schema.history() == [item.revision for item in script.walk_revisions()][::-1]


def _tables(database: Database) -> set[str]:
    with database.read() as tx:
        return set(inspect(tx).get_table_names())


def test_history_has_one_head_and_starts_from_nothing() -> None:
    script = ScriptDirectory(str(schema.migrations_directory()))
    assert len(script.get_heads()) == 1
    assert schema.migrations_directory() == ROOT / "db" / "migrations"


def test_migrations_make_exactly_the_tables_of_the_code(empty_url: str) -> None:
    database = Database(empty_url)
    with pytest.raises(schema.StaleSchema, match=r"no schema yet.*graspdb-server migrate"):
        schema.check(database)
    assert schema.upgrade(database) == _head()
    schema.check(database)
    with database.write() as tx:
        difference = compare_metadata(
            MigrationContext.configure(tx, opts={"compare_type": True, "render_as_batch": True}), metadata
        )
        # Raises where `alembic check` would fail.
        command.check(schema.alembic_config(tx))
    assert difference == []
    assert _tables(database) == {*metadata.tables, "alembic_version"}
    assert schema.upgrade(database) == _head()
    database.dispose()


def test_downgrade_leaves_nothing_and_upgrade_comes_back(empty_url: str) -> None:
    database = Database(empty_url)
    schema.upgrade(database)
    with database.write() as tx:
        command.downgrade(schema.alembic_config(tx), "base")
    assert _tables(database) == {"alembic_version"}
    schema.upgrade(database)
    schema.check(database)
    database.dispose()


@pytest.mark.parametrize("version", ["0001", "0002", "0004"])
def test_data_of_every_earlier_version_is_read_on(empty_url: str, version: str) -> None:
    """Batches from before findings have none, and go as before; what was tried was with a first version."""
    database = Database(empty_url)
    schema.upgrade(database, version)
    now = "'2026-01-01 00:00:00'"
    statements = (
        f"INSERT INTO objects (id, slug, revision, epoch, last_seq, created_at, updated_at)"
        f" VALUES (1, 'mug', 1, 0, 2, {now}, {now})",
        "INSERT INTO grippers (id, profile, builtin, created_at)"
        f""" VALUES ('mine', '{{"max_opening_m": 0.07}}', false, {now})""",
        "INSERT INTO provenances (id, object_id, gripper, source) VALUES (1, 1, 'mine', 'robot')",
        "INSERT INTO tallies (provenance_id, outcome, row_count, packed_count) VALUES (1, 1, 2, 0)",
        "INSERT INTO batches"
        " (id, key, object_id, revision, first_seq, last_seq, inserted, packed, created_at)"
        f" VALUES (1, '{KEY}', 1, 1, 1, 2, 2, 0, {now})",
        *(
            "INSERT INTO trials (object_id, seq, revision, batch_id, provenance_id, outcome,"
            f" px, py, pz, qx, qy, qz, qw) VALUES (1, {seq}, 1, 1, 1, 1, 0, 0, 0.1, 1, 0, 0, 0)"
            for seq in (1, 2)
        ),
    )
    with database.write() as tx:
        for statement in statements:
            tx.execute(text(statement))
    schema.upgrade(database)
    schema.check(database)
    found = batches.get(database, "mug", KEY)
    assert (found.outcomes, found.sources, found.findings) == ({"success": 2}, ["robot"], [])
    assert (found.grippers, found.gripper_versions) == (["mine"], ["mine@1"])
    with database.read() as tx:
        assert findings.totals(tx, 1, [1]) == []
        gripper = grippers.find(tx, "mine")
    assert gripper is not None
    assert (gripper.profile, gripper.versioned, gripper.changed) == ({"max_opening_m": 0.07}, "mine@1", None)
    batches.remove(database, "mug", KEY)
    database.dispose()


def test_rows_of_a_sweep_get_the_engine_that_simulated_all_of_it(empty_url: str) -> None:
    """What several engines, or an unknown one, simulated stays of none; and all of it goes back."""
    database = Database(empty_url)
    schema.upgrade(database, "0014")
    now = "'2026-01-01 00:00:00'"
    statements = [
        f"INSERT INTO objects (id, slug, revision, epoch, last_seq, created_at, updated_at)"
        f" VALUES (1, 'mug', 9, 0, 6, {now}, {now})",
        f"INSERT INTO grippers (id, builtin, created_at) VALUES ('mine', false, {now})",
        "INSERT INTO provenances (object_id, gripper, gripper_version, source, protocol)"
        " VALUES (1, 'mine', 1, 'simulation', 'wrench')",
        "INSERT INTO tallies (provenance_id, outcome, row_count, packed_count)"
        " VALUES (1, 1, 5, 0), (1, 2, 0, 7)",
    ]
    old, new = "'pybullet 3.2.7'", "'pybullet 3.2.8'"
    engines = {"one": [old, old], "two": [old, new], "unknown": ["NULL", "NULL"]}
    for place, (sweep, told) in enumerate(engines.items()):
        first = 2 * place + 1
        statements += [
            "INSERT INTO sweeps (id, object_id, provenance_id, gripper, protocol, fidelity, purpose, plan,"
            " request, snapshot, pose_count, chunk_poses, chunks, cancelled, created_at)"
            f" VALUES ('{sweep}', 1, 1, 'mine', 'wrench', 'standard', 'collect', 'poses', '{{}}', '{{}}',"
            f" 2, 1, 2, false, {now})",
            "INSERT INTO batches"
            " (id, key, object_id, sweep_id, revision, first_seq, last_seq, inserted, packed, created_at)"
            f" VALUES ({place + 1}, '{sweep}', 1, '{sweep}', 1, {first}, {first + 1}, 2, 0, {now})",
        ]
        for number, engine in enumerate(told):
            job = f"{sweep}-{number}"
            # One of the rows was withdrawn: it counts in no tally.
            withdrawn = "true" if job == "one-1" else "NULL"
            statements += [
                "INSERT INTO jobs"
                " (id, kind, capability, object_id, sweep_id, number, start, stop, state, attempts)"
                f" VALUES ('{job}', 'simulate', 'simulate', 1, '{sweep}', {number}, {number}, {number + 1},"
                " 'done', 1)",
                "INSERT INTO packed_outcomes (job_id, sweep_id, number, revision, outcomes, engine)"
                f" VALUES ('{job}', '{sweep}', {number}, 1, '', {engine})",
                "INSERT INTO trials (object_id, seq, revision, batch_id, provenance_id, outcome, withdrawn,"
                " px, py, pz, qx, qy, qz, qw) VALUES"
                f" (1, {first + number}, 1, {place + 1}, 1, 1, {withdrawn}, 0, 0, 0.1, 1, 0, 0, 0)",
            ]
    with database.write(audited=False) as tx:
        for statement in statements:
            tx.exec_driver_sql(statement)
    schema.upgrade(database)
    with database.read() as tx:
        rows = rows_of_trials.page(tx, 1, after_seq=0, limit=10)
        names = provenances.of_object(tx, 1)
        tallies = provenances.tallies(tx, 1)
    assert [names[number].engine for number in rows.provenance.tolist()] == ["pybullet 3.2.7"] * 2 + [
        None
    ] * 4
    assert {name.kin for name in names.values()} == {Provenance("mine@1", "simulation", "wrench")}
    named = next(number for number, name in names.items() if name.engine)
    assert tallies == [(1, 1, 4, 0), (1, 2, 0, 7), (named, 1, 1, 0)]
    with database.write(audited=False) as tx:
        command.downgrade(schema.alembic_config(tx), "0014")
    with database.read() as tx:
        assert tx.scalars(text("SELECT DISTINCT provenance_id FROM trials")).all() == [1]
        told = tx.execute(text("SELECT outcome, row_count, packed_count FROM tallies ORDER BY 1")).all()
    assert [tuple(row) for row in told] == [(1, 5, 0), (2, 0, 7)]
    database.dispose()


def test_several_processes_migrate_at_once(empty_url: str) -> None:
    replicas = [_server("migrate", "--database-url", empty_url) for _ in range(4)]
    for replica in replicas:
        output, _ = replica.communicate(timeout=120)
        assert replica.returncode == 0, output
        assert f"The schema is at {_head()}." in output
    database = Database(empty_url)
    schema.check(database)
    database.dispose()


def test_migration_from_a_wheel(empty_url: str, wheel: Path) -> None:
    """The installed package brings its history along: no checkout is needed."""
    script = (
        "import sys; from graspdb_service.storage import schema;"
        "from graspdb_service.storage.database import Database;"
        "print(schema.migrations_directory()); print(schema.upgrade(Database(sys.argv[1])))"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", script, empty_url],
        env={**os.environ, "PYTHONPATH": str(wheel)},
        cwd=wheel,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    where, revision = done.stdout.split()
    assert Path(where) == wheel / "graspdb_service" / "migrations"
    assert revision == _head()
    database = Database(empty_url)
    schema.check(database)
    database.dispose()


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An unpacked wheel of this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    build = "import sys; from hatchling.build import build_wheel; print(build_wheel(sys.argv[1]))"
    name = subprocess.run(
        [sys.executable, "-c", build, str(folder)], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()[-1]
    with zipfile.ZipFile(folder / name) as archive:
        archive.extractall(folder / "installed")
    return folder / "installed"


def test_stale_postgres_is_refused_by_name_of_the_command(empty_postgres_url: str) -> None:
    process = _server("serve", "--port", "0", "--database-url", empty_postgres_url)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "graspdb-server migrate" in output
    assert "Traceback" not in output
    database = Database(empty_postgres_url)
    assert _tables(database) <= {"alembic_version"}
    database.dispose()


def test_newer_schema_is_refused(empty_url: str) -> None:
    database = Database(empty_url)
    schema.upgrade(database)
    with database.write() as tx:
        tx.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    for use in (schema.check, schema.upgrade):
        with pytest.raises(schema.StaleSchema, match=r"9999.*newer"):
            use(database)
    database.dispose()
    for order in (["serve", "--port", "0"], ["migrate"]):
        process = _server(*order, "--database-url", empty_url)
        output, _ = process.communicate(timeout=60)
        assert process.returncode == 1
        assert "newer" in output
        assert "Traceback" not in output


def test_failed_migration_leaves_the_schema_as_it_was(empty_url: str) -> None:
    """DDL and the version table are in one transaction on both databases."""
    database = Database(empty_url)

    def interrupted() -> None:
        with database.write() as tx:
            command.upgrade(schema.alembic_config(tx), "head")
            assert inspect(tx).has_table("trials")
            raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        interrupted()
    assert _tables(database) == set()
    database.dispose()


def test_unsupported_databases_are_named() -> None:
    for url, word in (("sqlite://", "file"), ("nonsense", "no database URL")):
        with pytest.raises(UnsupportedDatabase, match=word):
            Database(url)
    process = _server("migrate", "--database-url", "mysql://x/y")
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "mysql is not supported" in output
    assert "Traceback" not in output


def _server(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "graspdb_service.cli", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )

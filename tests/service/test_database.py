"""What a transaction raises when the database breaks off."""

from __future__ import annotations

from contextlib import closing

import psycopg
import pytest
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from graspdb_service.storage.database import CommitUnknown, Database, Tx


def break_off(tx: Tx, postgres_url: str) -> None:
    """End the session behind a transaction."""
    session = tx.scalar(text("SELECT pg_backend_pid()"))
    with psycopg.connect(postgres_url, autocommit=True) as other:
        other.execute("SELECT pg_terminate_backend(%s, 10000)", [session])


def test_a_connection_lost_at_commit_leaves_it_unknown(postgres_url: str) -> None:
    """The commit may have arrived: nobody may be told that nothing was stored."""
    database = Database(postgres_url)
    with pytest.raises(CommitUnknown), database.write() as tx:
        break_off(tx, postgres_url)
    with database.write() as tx:
        assert tx.scalar(text("SELECT 1")) == 1
    database.dispose()


def ask_after_the_break(database: Database, postgres_url: str) -> None:
    with database.write() as tx, closing(tx.connection.cursor()) as cursor:
        break_off(tx, postgres_url)
        cursor.execute("SELECT 1")


def test_a_connection_lost_before_is_unavailable(postgres_url: str) -> None:
    """Also in the driver's own cursors, which many rows are copied through."""
    database = Database(postgres_url)
    with pytest.raises(OperationalError):
        ask_after_the_break(database, postgres_url)
    with database.write() as tx:
        assert tx.scalar(text("SELECT 1")) == 1
    database.dispose()


def test_the_drivers_own_errors_are_as_sqlalchemys(sqlite_url: str) -> None:
    database = Database(sqlite_url)
    with pytest.raises(OperationalError), database.read() as tx, closing(tx.connection.cursor()) as cursor:
        cursor.execute("DELETE FROM trials")
    database.dispose()

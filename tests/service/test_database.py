"""What a transaction raises when the database breaks off."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import httpx
import psycopg
import pytest
from sqlalchemy import event, text
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


#: What URLs, quotes, shells, and files of passwords would each take for something else.
STRANGE = "it's %41 p@ss:w/ö?r#d\\&$HOME `x` {}\"; --  "


def test_a_password_of_any_characters_is_read_from_its_file_for_each_connection(
    postgres_url: str, tmp_path: Path
) -> None:
    """The servers of tests trust everybody: what is told to them as a password is looked at on its way."""
    file = tmp_path / "password"
    shown = []
    database = Database(postgres_url, password_file=file)
    event.listen(database._writer, "do_connect", lambda *told: shown.append(told[3].get("password")))
    with (
        pytest.raises(OperationalError, match="GRASPDB_DATABASE_PASSWORD_FILE can't be read"),
        database.read(),
    ):
        pass
    for password, written in [(STRANGE, STRANGE), ("another", "another\n"), ("a\nb\n", "a\nb\n\n")]:
        file.write_text(written, "utf-8")
        database.dispose()
        with database.read() as tx:
            assert tx.scalar(text("SELECT 1")) == 1
        assert shown[-1] == password
    database.dispose()
    url = httpx.URL(postgres_url)
    own = str(url.copy_with(username=url.username, password="own"))
    named = Database(own, password_file=tmp_path / "none")
    with named.read() as tx:
        assert tx.scalar(text("SELECT 1")) == 1
    named.dispose()

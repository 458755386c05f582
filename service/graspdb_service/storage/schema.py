"""The schema's version: where the migrations are, what is applied, and applying the rest.

Several replicas may start at once: an upgrade runs in one transaction under a lock (an advisory lock on
PostgreSQL, BEGIN IMMEDIATE on SQLite), so one of them migrates and the others then find nothing to do.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import inspect, text

from graspdb_service.storage.database import Database, Tx

if TYPE_CHECKING:
    from alembic.config import Config

ADVISORY_LOCK = 4_707_204_120_121_130


class StaleSchema(RuntimeError):
    """The database's schema is not the one this version needs; the message names the way out."""


def migrations_directory() -> Path:
    """Where the Alembic history is: inside an installed wheel, or at the checkout's ``db/migrations``."""
    package = Path(__file__).resolve().parents[1]
    for candidate in (package / "migrations", package.parents[1] / "db" / "migrations"):
        if (candidate / "env.py").is_file():
            return candidate
    raise FileNotFoundError("the migrations are missing from this installation of graspdb")


def upgrade(database: Database, revision: str = "head") -> str:
    """Bring the schema to ``revision`` and return what it then is; safe when several processes do it."""
    with database.write() as tx:
        lock(tx)
        return apply(tx, revision)


def apply(tx: Tx, revision: str = "head") -> str:
    """As :func:`upgrade`, in an open transaction that holds the lock."""
    refuse_newer(tx)
    stored = current(tx)
    if revision == "head" and stored == history()[-1]:
        return stored
    from alembic import command  # late: 0.4 s, and a database that is current needs none of it

    command.upgrade(alembic_config(tx), revision)
    return current(tx) or "base"


def lock(tx: Tx) -> None:
    """Keep others from changing the schema until the transaction ends; SQLite's writer is alone anyway."""
    if tx.dialect.name == "postgresql":
        tx.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": ADVISORY_LOCK})


def check(database: Database) -> None:
    """Raise :class:`StaleSchema` unless the schema is exactly the one this version was written for."""
    with database.read() as tx:
        refuse_newer(tx)
        stored, head = current(tx), history()[-1]
    if stored != head:
        found = "has no schema yet" if stored is None else f"is at schema {stored}"
        raise StaleSchema(
            f"The database {found}, this version of graspdb needs {head}."
            " Stop the other replicas' writes if you can, then run: graspdb-server migrate"
        )


def alembic_config(tx: Tx) -> Config:
    """Alembic's configuration, bound to an open transaction."""
    from alembic.config import Config  # late: as above

    config = Config()
    config.set_main_option("script_location", str(migrations_directory()).replace("%", "%%"))
    config.attributes["connection"] = tx
    return config


def current(tx: Tx) -> str | None:
    """The version that the database's schema has; None without one."""
    if not inspect(tx).has_table("alembic_version"):
        return None
    stored: str | None = tx.scalar(text("SELECT version_num FROM alembic_version"))
    return stored


def history() -> list[str]:
    """Every version that this installation knows, the oldest first: numbers, which files are named by."""
    versions = migrations_directory() / "versions"
    return sorted(path.name.split("_")[0] for path in versions.glob("[0-9]*_*.py"))


def refuse_newer(tx: Tx) -> None:
    """StaleSchema if the database's schema is a version that this installation does not know."""
    stored = current(tx)
    if stored is not None and stored not in history():
        raise StaleSchema(
            f"The database is at schema {stored}, which this version of graspdb does not know:"
            " it was written by a newer one. Install that version or newer."
        )

"""Whether a database and the settings around it are in order: what was found, what it means, what to do.

Everything that the rows say is read in one snapshot, so that a service may go on writing meanwhile.
"""

from __future__ import annotations

import difflib
import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from graspdb_service.settings import Settings, is_loopback
from graspdb_service.storage import schema
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database, Tx, clock
from graspdb_service.storage.upkeep import condition, counters
from graspdb_service.storage.upkeep.backup import unhurried
from graspdb_service.storage.upkeep.counters import Disagreement, Survey

Level = Literal["ok", "warning", "error"]

#: Environment variables of ours that are no setting of the service.
_OTHERS = ("GRASPDB_URL", "GRASPDB_API_KEY", "GRASPDB_DB_PASSWORD", "GRASPDB_WORKER_PROCESSES")
_FEW = 5
_GIB = 2**30
#: A journal that long is one that readers or a stopped process keep from being folded into the file.
_LONG_JOURNAL_BYTES = 256 * 2**20
_LOW_DISK_BYTES, _NO_DISK_BYTES = 2 * _GIB, 200 * 2**20
#: Leases are judged by the database's clock and told by the service's.
_CLOCK_S = 2.0


@dataclass(frozen=True)
class Diagnosis:
    """One check: what was found, what that means and what to do about it (empty where all is well).

    ``repairable`` is whether ``--repair`` mends it.
    """

    check: str
    level: Level
    found: str
    meaning: str = ""
    remedy: str = ""
    repairable: bool = False


def examine(database: Database, settings: Settings, environment: Mapping[str, str]) -> Iterator[Diagnosis]:
    """Every check in turn, the cheap ones first; rows are looked at under this version's schema only."""
    yield _settings(settings)
    yield _variables(environment)
    yield from _disk(database, settings)
    integrity = _damage(database)
    yield integrity
    if integrity.level == "error":
        return
    with database.read() as tx:
        unhurried(tx)
        yield from _clock(tx)
        at_head = schema.current(tx) == schema.history()[-1]
        yield _version(tx)
        if not at_head:
            yield Diagnosis(
                *("rows", "warning", "not looked at, for the schema is not this version's"),
                "Whether counts and rows agree is unknown.",
                "Migrate (graspdb-server migrate), and run the doctor again.",
            )
            return
        yield _structure(tx)
        yield from _rows(tx)


def repair(database: Database) -> list[str]:
    """Count anew what disagrees with the rows, object by object; the objects that were mended."""
    with database.read() as tx:
        unhurried(tx)
        found = counters.survey(tx)
        wrong = [
            *counters.tallies_that_differ(tx, found),
            *counters.batches_that_differ(tx, found),
            *counters.counters_that_lag(tx, found),
        ]
        names = counters.slugs(tx, {item.object_id for item in wrong if item.object_id is not None})
    for object_id in sorted(names):
        with database.write() as tx:
            unhurried(tx)
            counters.recount(tx, object_id)
            audit.record(tx, "database.repair", object=names[object_id])
    return sorted(names.values())


# --- what the rows say ----------------------------------------------------------------------------------


def _rows(tx: Tx) -> Iterator[Diagnosis]:
    found = counters.survey(tx)
    recount = "graspdb-server doctor --repair counts them anew."
    rows = f"{found.trials:,} rows"
    yield _counted(
        tx,
        "tallies",
        counters.tallies_that_differ(tx, found),
        f"agree with {rows} and {sum(found.packed.values()):,} packed outcomes",
        "Counts, probabilities and weights of these objects are wrong.",
        recount,
    )
    yield _counted(
        tx,
        "batches",
        counters.batches_that_differ(tx, found),
        f"agree with {rows}",
        "Listings of batches mislead, and deleting one may leave trials behind.",
        recount,
    )
    yield _counted(
        tx,
        "revisions",
        counters.counters_that_lag(tx, found),
        "are those of the newest rows",
        "Caches may answer from the past, and new trials may collide with those that are there.",
        recount,
    )
    yield _counted(
        tx,
        "qualities",
        counters.qualities_that_differ(tx),
        "are packed as their batches say",
        "These trials can't be listed.",
        "Restore a backup, or delete the batch.",
        repairable=False,
    )
    yield _counted(
        tx,
        "packed outcomes",
        counters.chunks_that_differ(tx),
        "are what was counted when they came",
        "Outcomes of a sweep were lost or changed after they were stored.",
        "Delete the sweep's batch and sweep again, or restore a backup.",
        repairable=False,
    )
    yield from _owners(tx, found)


def _owners(tx: Tx, found: Survey) -> Iterator[Diagnosis]:
    lost = counters.rows_without_owners(tx, found)
    yield _told(
        "owners",
        lost,
        "every row has its batch, sweep and object",
        "These rows are in no listing by batch, and count in no selection or for ever.",
        "Restore a backup from before; or, if you know what they are, delete them by hand.",
    )
    yield _told(
        "references",
        condition.broken_references(tx),
        "all lead somewhere",
        "Somebody changed the database without its constraints; objects may not be readable.",
        "Restore a backup from before.",
    )
    keys = condition.keys_of_lost_batches(tx)
    yield _told(
        "idempotency keys",
        [f"{keys} answer with batches that are not there"] if keys else [],
        "name batches that are there",
        "A request sent again is answered as if its trials were stored, and they are not.",
        "Delete these keys, or wait until they are purged (GRASPDB_KEEP_IDEMPOTENCY_DAYS).",
    )
    number, size = condition.unused_assets(tx)
    yield _told(
        "meshes",
        [f"{number} meshes or parts of {size / 2**20:.1f} MiB are of no object"] if number else [],
        "every one is of an object",
        "They take space and nothing else.",
        "Nothing needs to be done.",
        level="warning",
    )


def _counted(
    tx: Tx,
    check: str,
    wrong: list[Disagreement],
    well: str,
    meaning: str,
    remedy: str,
    *,
    repairable: bool = True,
) -> Diagnosis:
    names = counters.slugs(tx, {item.object_id for item in wrong if item.object_id is not None})
    listed = [f"{names.get(item.object_id or 0, 'no object')}: {item.what}" for item in wrong]
    repairable = repairable and bool(names)
    return _told(check, listed, well, meaning, remedy, repairable=repairable)


def _told(
    check: str,
    wrong: list[str],
    well: str,
    meaning: str,
    remedy: str,
    *,
    level: Level = "error",
    repairable: bool = False,
) -> Diagnosis:
    if not wrong:
        return Diagnosis(check, "ok", well)
    more = f"; and {len(wrong) - _FEW} more" if len(wrong) > _FEW else ""
    return Diagnosis(check, level, "; ".join(wrong[:_FEW]) + more, meaning, remedy, repairable)


# --- schema, file and clock -----------------------------------------------------------------------------


def _version(tx: Tx) -> Diagnosis:
    stored, head = schema.current(tx), schema.history()[-1]
    if stored == head:
        return Diagnosis("schema version", "ok", f"is {head}, which this version of graspdb needs")
    if stored is not None and stored not in schema.history():
        return Diagnosis(
            *("schema version", "error", f"is {stored}, which this version of graspdb does not know"),
            "A newer version of graspdb wrote this database.",
            "Install that version or newer.",
        )
    return Diagnosis(
        *("schema version", "error", f"is {stored or 'none at all'}, this version of graspdb needs {head}"),
        "PostgreSQL: the service refuses to start. SQLite: it migrates when it starts.",
        "Take a backup (graspdb-server backup FILE), then run graspdb-server migrate.",
    )


def _structure(tx: Tx) -> Diagnosis:
    wrong = condition.schema_differences(tx) + [f"invalid: {name}" for name in condition.invalid_indexes(tx)]
    return _told(
        "tables and indexes",
        wrong,
        "are those of this version",
        "Somebody changed the schema by hand: queries may be slow or fail, constraints may not hold.",
        "Undo the change; with an index missing, create it as the message names it, or restore a backup.",
    )


def _damage(database: Database) -> Diagnosis:
    return _told(
        "integrity",
        condition.damage(database),
        "SQLite finds no damage" if database.is_sqlite else "is PostgreSQL's own affair (pg_amcheck)",
        "The file is damaged: by the disk, or by a copy of it while it was written.",
        "Stop the service and restore a backup: graspdb-server restore FILE --overwrite keeps this file.",
    )


def _clock(tx: Tx) -> Iterator[Diagnosis]:
    ahead = condition.clock_offset_s(tx)
    wrong = [f"the database's is {ahead:+.1f} s from this machine's"] if abs(ahead) > _CLOCK_S else []
    newest = condition.newest_stamp(tx) if schema.current(tx) == schema.history()[-1] else None
    if newest is not None and (newest - clock(tx)).total_seconds() > _CLOCK_S:
        wrong.append(f"something was done at {newest:%Y-%m-%d %H:%M:%S} UTC, which is still to come")
    yield _told(
        "clock",
        wrong,
        "this machine and the database agree, and nothing is of the future",
        "Leases of workers may end early or late, and retention counts days wrongly.",
        "Synchronise the clocks (NTP) of this machine and of the database's.",
        level="warning",
    )


def _disk(database: Database, settings: Settings) -> Iterator[Diagnosis]:
    file = condition.sqlite_file(database)
    if file is None:
        yield Diagnosis("disk", "ok", "of the database's server can't be seen from here")
        return
    usage = shutil.disk_usage(file.path.parent)
    free = f"{usage.free / _GIB:.1f} GiB of {usage.total / _GIB:.1f} GiB are free for {file.path}"
    needed = max(_LOW_DISK_BYTES, 2 * settings.max_body_bytes)
    yield _told(
        "disk",
        [free] if usage.free < needed else [],
        free,
        "When it is full, nothing can be stored any more; what is stored stays.",
        "Make room, or move the database: stop the service, move the file, change GRASPDB_DATABASE_URL.",
        level="error" if usage.free < _NO_DISK_BYTES else "warning",
    )
    wrong = []
    mode = file.path.stat().st_mode
    if mode & stat.S_IWOTH:
        wrong.append("everyone on this machine may change it")
    if not os.access(file.path, os.W_OK) or not os.access(file.path.parent, os.W_OK):
        wrong.append("this user can't write it or its folder, which SQLite needs as well")
    yield _told(
        "file",
        wrong,
        f"{file.path} may be written by its owner",
        "Who can write the file can change every trial and key in it; who can't, can't serve it.",
        f"chmod o-w {file.path}, or run as the user who owns file and folder.",
    )
    journal = f"{file.journal_bytes / 2**20:.0f} MiB, mode {file.journal_mode}"
    yield _told(
        "journal",
        [journal] if file.journal_bytes > _LONG_JOURNAL_BYTES or file.journal_mode != "wal" else [],
        journal,
        "Another mode than wal makes readers and writers wait for one another; a long journal is one that a"
        " reader has kept from being folded in, and slows every read.",
        "Restart the service when it is idle: it sets the mode, and folds the journal into the file.",
        level="warning",
    )


# --- settings -------------------------------------------------------------------------------------------


def _settings(settings: Settings) -> Diagnosis:
    wrong = []
    if settings.auth == "off" and not is_loopback(settings.host):
        wrong.append(f"serving on {settings.host} without keys (GRASPDB_AUTH=off)")
    memory = _memory_bytes()
    if memory and settings.max_density_cache_bytes > memory / 2:
        wrong.append(
            f"GRASPDB_MAX_DENSITY_CACHE_BYTES is {settings.max_density_cache_bytes / _GIB:.1f} GiB of"
            f" {memory / _GIB:.1f} GiB of memory"
        )
    cores = os.cpu_count() or 1
    if settings.threads > 2 * cores:
        wrong.append(f"GRASPDB_THREADS is {settings.threads} on {cores} cores")
    if "sqlite" in settings.database_url and not Path(settings.database_url.split(":///")[-1]).is_absolute():
        found = f"are usable; the database's path is relative, to {Path.cwd()}"
    else:
        found = "are usable"
    return _told(
        "settings",
        wrong,
        found,
        "Without keys whoever reaches the address may read, write and delete everything; too much memory or"
        " too many threads end or slow the service.",
        "Listen on 127.0.0.1, or serve with keys behind TLS; lower the other values.",
        level="warning",
    )


def _variables(environment: Mapping[str, str]) -> Diagnosis:
    known = {f"GRASPDB_{name.upper()}" for name in Settings.model_fields} | set(_OTHERS)
    strange = []
    for name in sorted(environment):
        if name.startswith("GRASPDB_") and not name.startswith("GRASPDB_TEST_") and name not in known:
            close: list[str] = difflib.get_close_matches(name, known, 1)
            strange.append(name + (f" (did you mean {close[0]}?)" if close else ""))
    return _told(
        "environment",
        strange,
        "every GRASPDB_ variable is one that graspdb knows",
        "These variables have no effect.",
        "Correct or unset them; the user guide lists those that exist.",
        level="warning",
    )


def _memory_bytes() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return 0

"""The keys that are in use, held in memory: a request that comes with one waits for no database.

What was read is trusted for a second, and for another while it is read again in the background: a key
revoked by this process opens nothing from then on, one revoked elsewhere for two seconds at most. While the
database does not answer nobody can revoke a key either: those that were good go on for five minutes, so that
what needs no database is still answered, and keys not seen before are refused as unavailable.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import math
import threading
import time
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime

from graspdb_service.principal import Principal
from graspdb_service.problems import ProblemError, busy
from graspdb_service.storage.access import keys as stored_keys
from graspdb_service.storage.access.keys import KeyRow
from graspdb_service.storage.database import UNAVAILABLE, Database, clock
from graspdb_service.usecases.access import keys

log = logging.getLogger("graspdb")

_FRESH_S, _USABLE_S, _OUTAGE_S = 1.0, 2.0, 300.0
#: A request waits so long for a key to be read, and after a failure none does for a second.
_PATIENCE_S, _PAUSE_S = 2.0, 1.0
#: Keys held, those that do not exist included, and read or waiting to be at a time: more would be a flood.
_MOST_HELD, _MOST_READING = 10_000, 200
_USE_NOTED_EVERY_S = 60.0
_CHALLENGE = 'Bearer realm="graspdb"'


@dataclass(frozen=True)
class _Held:
    """A key as it was read; None twice where there is none of this id.

    Times are of this process's steady clock: the key's own are the database's, which others may not share.
    """

    row: KeyRow | None
    principal: Principal | None
    read_at: float
    expires: float = math.inf
    overlap_ends: float = -math.inf


class KeyRing:
    """The keys of one service process, over a database that others may change."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._held: OrderedDict[str, _Held] = OrderedDict()
        self._reading: dict[str, tuple[Future[_Held], float]] = {}
        self._changes = 0
        self._failed_at = -_PAUSE_S
        self._uses: set[str] = set()
        self._noted: dict[str, float] = {}
        # Threads of its own: neither the requests' nor the computations' may keep a key waiting.
        self._readers = ThreadPoolExecutor(max_workers=2, thread_name_prefix="graspdb-keys")
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="graspdb-key-uses")

    async def open(self, sent: str | None) -> Principal:
        """Who has the key that was sent as ``Authorization``; 401 for nobody, 503 where it can't be told."""
        token = _token(sent)
        id = keys.id_in(token)
        if id is None:
            raise _refused("unknown", "This is no key of GraspDB's")
        held = await self._look_up(id)
        row, who = held.row, held.principal
        if row is None or who is None or not _matches(held, row, token):
            raise _refused("unknown", "This key is not known here: it is mistyped, or was rotated")
        if row.revoked_at is not None:
            raise _refused("revoked", f"The key {row.name!r} was revoked: ask an admin for another")
        if held.expires <= time.monotonic():
            raise _refused("expired", f"The key {row.name!r} has expired: ask an admin to rotate it")
        self._note_use(id)
        return who

    def forget(self, id: str) -> None:
        """Read a key anew before it opens anything else: it has just been changed."""
        with self._lock:
            self._changes += 1
            self._held.pop(id, None)
            self._reading.pop(id, None)

    def close(self) -> None:
        """Store what is left of uses, and stop."""
        self._readers.shutdown(wait=False, cancel_futures=True)
        self._writer.submit(self._store_uses)
        self._writer.shutdown(wait=True)

    # -- reading

    async def _look_up(self, id: str) -> _Held:
        now = time.monotonic()
        with self._lock:
            held = self._held.get(id)
            age = float("inf") if held is None else now - held.read_at
            if held is not None and age < _FRESH_S:
                return held
            reading = self._read(id, now)
        if held is not None and held.row is not None and age < _USABLE_S:
            return held
        if reading is not None:
            try:
                return await asyncio.wait_for(
                    asyncio.shield(asyncio.wrap_future(reading)), timeout=_PATIENCE_S
                )
            except (*UNAVAILABLE, asyncio.TimeoutError):
                self._failed_at = time.monotonic()
        if held is not None and held.row is not None and age < _OUTAGE_S:
            return held
        raise busy("Keys can't be looked up now: the database does not answer; try again", retry_after_s=2)

    def _read(self, id: str, now: float) -> Future[_Held] | None:
        """A reading of the key under way, one for all who wait; None where none is to be waited for."""
        known = self._reading.get(id)
        if known is not None:
            return None if now - known[1] > _PATIENCE_S else known[0]
        if now - self._failed_at < _PAUSE_S or len(self._reading) >= _MOST_READING:
            return None
        reading = self._readers.submit(self._load, id, self._changes)
        self._reading[id] = reading, now
        reading.add_done_callback(lambda done: self._read_ended(id, done))
        return reading

    def _load(self, id: str, changes: int) -> _Held:
        read_at = time.monotonic()
        with self._database.read() as tx:
            row, now = stored_keys.find(tx, id), clock(tx)
        held = _Held(None, None, read_at)
        if row is not None:
            expires = math.inf if row.expires_at is None else read_at + _seconds(now, row.expires_at)
            ends = -math.inf if row.previous_until is None else read_at + _seconds(now, row.previous_until)
            held = _Held(row, _principal(row), read_at, expires, ends)
        with self._lock:
            # What was read before a change here may be from before the change.
            if changes == self._changes:
                self._held[id] = held
                self._held.move_to_end(id)
                while len(self._held) > _MOST_HELD:
                    self._held.popitem(last=False)
        return held

    def _read_ended(self, id: str, ended: Future[_Held]) -> None:
        with self._lock:
            known = self._reading.get(id)
            if known is not None and known[0] is ended:
                del self._reading[id]

    # -- last use

    def _note_use(self, id: str) -> None:
        """Have it stored that the key is in use, once a minute and by another thread."""
        now = time.monotonic()
        if now - self._noted.get(id, -math.inf) < _USE_NOTED_EVERY_S:
            return
        self._noted[id] = now
        with self._lock:
            waiting = bool(self._uses)
            self._uses.add(id)
        if not waiting:
            self._writer.submit(self._store_uses)

    def _store_uses(self) -> None:
        with self._lock:
            uses, self._uses = self._uses, set()
        if not uses:
            return
        try:
            with self._database.write() as tx:
                stored_keys.note_uses(tx, uses)
        except UNAVAILABLE:
            log.warning("when keys were last used could not be stored; the next use will be")


def _principal(row: KeyRow) -> Principal:
    scopes = frozenset(row.scopes)
    return Principal(row.id, row.name, scopes, row.objects or "", row.requests_per_s, row.burst)


def _seconds(start: datetime, end: datetime) -> float:
    return (end - start).total_seconds()


def _matches(held: _Held, row: KeyRow, sent: str) -> bool:
    """Whether what was sent is the key's secret, or the one before while that works on; in constant time."""
    found = keys.digest(sent)
    before = row.previous_sha256 or ""
    is_before = held.overlap_ends > time.monotonic()
    return hmac.compare_digest(found, row.sha256) | (hmac.compare_digest(found, before) & is_before)


def _token(sent: str | None) -> str:
    """What stands in the header after ``Bearer``."""
    if sent is None:
        raise ProblemError(
            401,
            "key-required",
            "This needs a key: send it as `Authorization: Bearer KEY` (GRASPDB_API_KEY, api_key=);"
            " graspdb-server keys create makes one",
            headers={"WWW-Authenticate": _CHALLENGE},
        )
    kind, _, token = sent.strip().partition(" ")
    if kind.lower() != "bearer":
        raise _refused("unknown", "Send the key as `Authorization: Bearer KEY`")
    return token.strip()


def _refused(why: str, title: str) -> ProblemError:
    challenge = f'{_CHALLENGE}, error="invalid_token"'
    return ProblemError(401, f"key-{why}", title, headers={"WWW-Authenticate": challenge})

"""Answers kept as they were given: who asks never waits for a writer, unless for a name."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Collection
from contextlib import suppress
from typing import Any

from graspdb_service.problems import ProblemError, busy
from graspdb_service.storage import answers
from graspdb_service.storage.answers import AnswerRow, GivenAnswer
from graspdb_service.storage.database import UNAVAILABLE, CommitUnknown, Database
from graspdb_service.usecases.answers.references import is_answer_id

log = logging.getLogger("graspdb")

#: Answers wait so long for others to be written with.
_GATHER_S = 0.02
_BATCH = 200
#: More than these, or more bytes, do not wait to be written: what is given meanwhile is not kept.
_MOST_WAITING, _MOST_BYTES = 2_000, 64 * 2**20
#: Answers known to be written, and how long that is relied on: none is purged in that time.
_REMEMBERED, _RELIED_ON_S = 4_096, 60.0
#: How long a look-up waits for what this process, or another one, is about to write.
_OWN_WAIT_S, _OTHERS_WAIT_S, _POLL_S = 5.0, 0.5, 0.05
_RETRY_S = 1.0


class AnswerKeeper:
    """The answers of one service process, over a database that others may share.

    A thread writes them in small batches, and purges those of an object and kind that are not among the
    ``most`` given last, unless a name or a trial keeps them.
    """

    def __init__(self, database: Database, *, most: int) -> None:
        self._database = database
        self._most = most
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._waiting: OrderedDict[str, GivenAnswer] = OrderedDict()
        self._bytes = 0
        self._written: OrderedDict[str, float] = OrderedDict()
        self._since_purge: Counter[tuple[int, str]] = Counter()
        self._hurry = threading.Event()
        self._failing = self._closed = False
        self._thread: threading.Thread | None = None

    def give(self, given: GivenAnswer) -> bool:
        """Have an answer written soon; False where it can't be, as the database takes nothing now."""
        size = len(given.question) + len(given.result)
        with self._changed:
            if given.id in self._waiting or self._is_written(given.id):
                return True
            full = len(self._waiting) >= _MOST_WAITING or self._bytes + size > _MOST_BYTES
            if self._failing or self._closed or full:
                return False
            self._waiting[given.id] = given
            self._bytes += size
            if self._thread is None:
                self._thread = threading.Thread(target=self._write_on, name="graspdb-answers", daemon=True)
                self._thread.start()
            self._changed.notify_all()
        return True

    def name(self, given: GivenAnswer, name: str) -> bytes | None:
        """Write an answer at once and name it: its result as it is kept; None where the name is another's."""
        with self._database.write() as tx:
            answers.add(tx, [given])
            if not answers.put_name(tx, given.id, name):
                return None
            row = answers.find(tx, given.id)
            assert row is not None
            return answers.content(tx, row.number)[1]

    def keeps(self, id: str) -> bool:
        """Whether an answer is kept, or about to be."""
        with self._lock:
            if id in self._waiting or self._is_written(id):
                return True
        with self._database.read() as tx:
            return answers.is_kept(tx, id)

    def find(self, reference: str) -> AnswerRow | None:
        """The answer with this id or name; 503 where it waits for a database that takes nothing."""
        self.settle([reference])
        with self._database.read() as tx:
            return answers.find(tx, reference)

    def named(self, name: str) -> tuple[AnswerRow, dict[str, Any], bytes] | None:
        """The answer that a name stands for, with its question and its result as JSON."""
        with self._database.read() as tx:
            row = answers.find(tx, name)
            if row is None:
                return None
            question, result = answers.content(tx, row.number)
        return row, json.loads(question), result

    def settle(self, references: Collection[str]) -> None:
        """Wait until what this process gave under these ids is written; briefly for ids of others."""
        ids = {item for item in references if is_answer_id(item)}
        deadline = time.monotonic() + _OWN_WAIT_S
        with self._changed:
            own = ids & self._waiting.keys()
            while own & self._waiting.keys():
                self._hurry.set()
                left = deadline - time.monotonic()
                if left <= 0 or self._failing or self._closed:
                    raise busy("The answer is not written yet, the database takes nothing now: try again")
                self._changed.wait(left)
            missing = [id for id in ids - own if not self._is_written(id)]
        deadline = time.monotonic() + _OTHERS_WAIT_S
        while missing and time.monotonic() < deadline:
            with self._database.read() as tx:
                missing = [id for id in missing if not answers.is_kept(tx, id)]
            if missing:
                time.sleep(_POLL_S)

    def settle_own(self) -> None:
        """Wait until what this process gave is written, where the database takes it."""
        with self._lock:
            own = list(self._waiting)
        with suppress(ProblemError):
            self.settle(own)

    def forget(self, id: str) -> None:
        """An answer was deleted: given again, it is written again."""
        with self._lock:
            self._written.pop(id, None)

    def close(self) -> None:
        """Write what waits, and stop."""
        with self._changed:
            self._closed = True
            self._hurry.set()
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(10.0)

    def _is_written(self, id: str) -> bool:
        written = self._written.get(id)
        return written is not None and time.monotonic() - written < _RELIED_ON_S

    def _write_on(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._closed:
                    self._changed.wait()
                if not self._waiting:
                    return
            self._hurry.wait(_GATHER_S)
            self._hurry.clear()
            with self._lock:
                batch = list(self._waiting.values())[:_BATCH]
            if not self._write(batch):
                with self._changed:
                    if self._closed:
                        log.error("%d answers were given and could not be kept", len(self._waiting))
                        return
                    self._changed.wait(_RETRY_S)

    def _write(self, batch: list[GivenAnswer]) -> bool:
        """Write answers; False where the database takes nothing. What else fails is given up, and logged."""
        unwritable = False
        try:
            with self._database.write() as tx:
                answers.add(tx, batch)
                for object_id, kind in self._due(batch):
                    answers.purge(tx, object_id, kind, most=self._most)
        except (*UNAVAILABLE, CommitUnknown) as error:
            if not self._failing:
                log.warning("answers can't be kept now: %s", error)
            unwritable = True
        except Exception:
            log.exception("%d answers could not be kept", len(batch))
        with self._changed:
            self._failing = unwritable
            if not unwritable:
                for given in batch:
                    del self._waiting[given.id]
                    self._bytes -= len(given.question) + len(given.result)
                    self._written[given.id] = time.monotonic()
                while len(self._written) > _REMEMBERED:
                    self._written.popitem(last=False)
            self._changed.notify_all()
        return not unwritable

    def _due(self, batch: list[GivenAnswer]) -> list[tuple[int, str]]:
        """Of which objects and kinds enough was written that some may be too many."""
        self._since_purge.update((given.object_id, given.kind) for given in batch)
        due = [key for key, count in self._since_purge.items() if 20 * count >= self._most]
        for key in due:
            del self._since_purge[key]
        return due

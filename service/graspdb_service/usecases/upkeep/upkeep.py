"""What a service does by itself, behind its requests: delete what is kept no longer, count what there is."""

from __future__ import annotations

import logging
import threading
import time

from prometheus_client import Counter, Gauge

from graspdb_service.problems import ProblemError
from graspdb_service.settings import Settings
from graspdb_service.storage.database import Database
from graspdb_service.storage.upkeep import retention
from graspdb_service.storage.upkeep.retention import Figures
from graspdb_service.usecases.trials import batches

log = logging.getLogger("graspdb")

_COUNT_SECONDS = 15.0
_BATCHES = 100
_END_SECONDS = 5.0

_PURGED = Counter("graspdb_purged_total", "What retention has deleted.", ["kind"])
_LAST = Gauge("graspdb_upkeep_last_success_timestamp_seconds", "When retention last went through.")


class Upkeep:
    """The background task of one service process; several replicas may each have theirs."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self._settings, self._database = settings, database
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._keep_on, name="graspdb-upkeep", daemon=True)
        #: What there was when it was last counted; None before.
        self.figures: Figures | None = None

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._closed.set()
        if self._thread.is_alive():
            # What it does is soon done or fails; a transaction cut off here is rolled back.
            self._thread.join(_END_SECONDS)

    def purge(self) -> dict[str, int]:
        """Delete what the settings keep no longer; how many of each."""
        settings, database = self._settings, self._database
        purged = {
            "idempotency_keys": retention.purge_idempotency_keys(database, settings.keep_idempotency_days),
            "workers": retention.purge_workers(database, settings.keep_workers_days),
        }
        if settings.keep_audit_days is not None:
            purged["audit"] = retention.purge_audit(database, settings.keep_audit_days)
        if settings.keep_trials_days is not None:
            purged["batches"] = self._purge_batches(settings.keep_trials_days)
        for kind, number in purged.items():
            _PURGED.labels(kind).inc(number)
            if number:
                log.info("retention deleted %d %s", number, kind.replace("_", " "))
        _LAST.set_to_current_time()
        return purged

    def _purge_batches(self, days: float) -> int:
        deleted, after = 0, 0
        while not self._closed.is_set():
            with self._database.read() as tx:
                old = retention.old_batches(tx, days, after=after, limit=_BATCHES)
            after = old[-1][0] if old else after
            for _, slug, key in old:
                try:
                    batches.remove(self._database, slug, key)
                except ProblemError as problem:
                    # Its sweep still runs, or somebody else has just deleted it.
                    log.debug("batch %s of %s stays: %s", key, slug, problem.title)
                else:
                    deleted += 1
                    log.info("retention deleted batch %s of %s", key, slug)
            if len(old) < _BATCHES:
                break
        return deleted

    def _keep_on(self) -> None:
        due = 0.0
        while True:
            try:
                with self._database.read() as tx:
                    self.figures = retention.figures(tx)
                if time.monotonic() >= due:
                    self.purge()
                    due = time.monotonic() + self._settings.upkeep_seconds
            except Exception as error:
                if self._closed.is_set():
                    return
                # The database is away: readiness says so, and the next look may find it again.
                log.debug("upkeep failed", exc_info=True)
                log.warning("upkeep will be tried again: %s", str(error).splitlines()[0])
            if self._closed.wait(_COUNT_SECONDS):
                return

"""Runs: what takes long, computed once for a revision and its parameters, whoever asks, of whichever replica.

A run is a row with a lease. Who asks first takes it and computes; others, of other processes too, wait for
the row or are told where it will be. A holder that dies stops renewing, and the next who asks takes over.
Runs are computed one at a time on a thread of their own beside the compute pool: a minute's work must not
hold a query's place.
"""

from __future__ import annotations

import json
import logging
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from graspdb.wire.reports import ReportRun
from graspdb.wire.states import RunState
from graspdb_density.kde.weighted_sums import Progress
from graspdb_service import principal
from graspdb_service.problems import ProblemError, busy, conflict, found
from graspdb_service.storage import report_runs
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.report_runs import RunKey, RunRow

log = logging.getLogger("graspdb")

#: Runs that a process holds at most, computing or waiting their turn.
MAX_HELD = 16
#: Requests that may wait for a result at a time; the others are told at once where it will be.
_MAX_WAITING = 8
_TICK_S = 2.0
_POLL_S = 0.1
#: What the request is to blame for, and would be again: kept as the run's answer.
_KEPT_STATUSES = (404, 409, 413, 422)
_KEPT_MEMBERS = ("status", "kind", "title", "errors", "extra")

Result = Callable[[Tx], str]
"""A run's result as JSON, made in the transaction that ends the run."""


@dataclass(frozen=True)
class RunKind:
    """What runs of a kind are called in messages, and how they are computed."""

    noun: str
    compute: Callable[[RunRow, Progress], Result]


class RunCancelled(Exception):
    """A run was cancelled, or taken over, while it was computed."""


@dataclass(eq=False)
class _Held:
    """A run that this process computes, or will."""

    lease_id: str
    progress: float = 0.0
    stop: threading.Event = field(default_factory=threading.Event)


class Runs:
    """The runs of one service process, over a database that others may share.

    A request waits ``wait_s`` for a result; ``kinds`` go by what a run's row names as its report.
    """

    def __init__(self, database: Database, *, wait_s: float, kinds: Mapping[str, RunKind]) -> None:
        self._database = database
        self._wait_s = wait_s
        self._kinds = kinds
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="graspdb-report")
        self._waiting = threading.BoundedSemaphore(_MAX_WAITING)
        self._held: dict[str, _Held] = {}
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._closed = threading.Event()
        self._ticker: threading.Thread | None = None

    # -- what is asked

    def ask(self, key: RunKey) -> RunRow:
        """The run of a key: done, or under way after the wait.

        What the computation itself was refused for; 409 where it was cancelled, 429 where too many are under
        way.
        """
        with self._database.read() as tx:
            run = report_runs.find(tx, key)
        if run is None or not _settled(run):
            run = self._joined(key)
        return self._answered(run)

    def follow(self, id: str, lease_id: str | None) -> RunRow:
        """A run done, or under way after the wait; computed here where this process holds its lease."""
        run = self._row(id)
        if lease_id is not None:
            self._start(run, lease_id)
        return self._answered(run)

    def _answered(self, run: RunRow) -> RunRow:
        """The run once it has ended well, or as it is when the wait is over."""
        if run.state == RunState.RUNNING:
            run = self._waited(run)
        what = self._kinds[run.report].noun
        if run.state == RunState.CANCELLED:
            raise conflict("report-cancelled", f"The {what} was cancelled: ask again to compute it anew")
        if run.problem is not None:
            raise ProblemError(**run.problem)
        if run.state == RunState.FAILED:
            raise ProblemError(
                500, "internal-error", f"The {what} failed; the service's log says more: ask again to retry"
            )
        return run

    def get(self, id: str) -> RunRow:
        """A run as it is; one whose holder is gone is taken over."""
        run = self._row(id)
        if run.state == RunState.RUNNING and not run.live:
            lease = str(uuid.uuid4())
            with self._database.write() as tx:
                taken = report_runs.take_over(tx, id, lease_id=lease)
            if taken:
                self._start(run, lease)
            run = self._row(id)
        return run

    def cancel(self, id: str) -> RunRow:
        """End a run; one that has ended stays as it is."""
        self._row(id)
        with self._database.write() as tx:
            report_runs.cancel(tx, id)
        run = self._row(id)
        if run.state == RunState.CANCELLED:
            with self._lock:
                held = self._held.get(id)
                if held is not None:
                    held.stop.set()
                self._changed.notify_all()
        return run

    def close(self) -> None:
        """Stop, and leave what is under way to others."""
        self._closed.set()
        with self._lock:
            held = dict(self._held)
            self._changed.notify_all()
        for item in held.values():
            item.stop.set()
        self._pool.shutdown(wait=False, cancel_futures=True)
        for id, item in held.items():
            with self._database.write() as tx:
                report_runs.release(tx, id, item.lease_id)

    # -- joining and waiting

    def _row(self, id: str) -> RunRow:
        with self._database.read() as tx:
            run = report_runs.get(tx, id)
        if run is not None and not principal.sees(run.object):
            run = None
        return found(run, "report run", id, "runs of a past revision are deleted: ask for the report")

    def place(self) -> str:
        """A lease for a run that this process is to compute; 429 where it has too many."""
        with self._lock:
            if len(self._held) >= MAX_HELD:
                title = f"{MAX_HELD} reports are under way already: try again when some are done"
                raise busy(title, status=429, retry_after_s=5)
        return str(uuid.uuid4())

    def _joined(self, key: RunKey) -> RunRow:
        """The key's run, taken by this process where nobody has it."""
        lease = self.place()
        with self._database.write() as tx:
            mine = report_runs.ask(tx, key, id=str(uuid.uuid4()), lease_id=lease)
            run = report_runs.find(tx, key)
        if run is None:
            # A newer revision's run has swept this one away meanwhile.
            raise conflict("object-changed", "The object has just changed: ask again")
        if mine:
            self._start(run, lease)
        return run

    def _waited(self, run: RunRow) -> RunRow:
        """The run once it has ended, or as it is when the wait is over."""
        if not self._waiting.acquire(blocking=False):
            return run
        try:
            deadline = time.monotonic() + self._wait_s
            while run.state == RunState.RUNNING and time.monotonic() < deadline and not self._closed.is_set():
                with self._changed:
                    # What another process computes is looked for again and again.
                    most = 1.0 if run.id in self._held else _POLL_S
                    self._changed.wait(min(most, max(0.0, deadline - time.monotonic())))
                run = self.get(run.id)
            return run
        finally:
            self._waiting.release()

    # -- computing

    def _start(self, run: RunRow, lease_id: str) -> None:
        held = _Held(lease_id)
        with self._lock:
            self._held[run.id] = held
            if self._ticker is None:
                self._ticker = threading.Thread(target=self._renew, name="graspdb-report-leases", daemon=True)
                self._ticker.start()
        try:
            self._pool.submit(self._run, run, held)
        except RuntimeError:
            # The service is shutting down: close() releases what is held.
            log.info("report run %s is left to another process", run.id)

    def _run(self, run: RunRow, held: _Held) -> None:
        def progress(share: float) -> None:
            held.progress = min(max(share, 0.0), 1.0)
            if held.stop.is_set():
                raise RunCancelled

        made: Result | None = None
        problem: dict[str, Any] | None = None
        try:
            progress(0.0)
            made = self._kinds[run.report].compute(run, progress)
        except RunCancelled:
            self._drop(run.id)
            return
        except ProblemError as error:
            if error.status in _KEPT_STATUSES:
                problem = {name: getattr(error, name) for name in _KEPT_MEMBERS}
            else:
                log.warning("report run %s: %s", run.id, error.title)
        except Exception:
            log.exception("report run %s failed", run.id)
        try:
            with self._database.write() as tx:
                result = None if made is None else made(tx)
                if not report_runs.finish(tx, run.id, held.lease_id, result=result, problem=problem):
                    # Cancelled, or somebody else's by now: nothing of it is stored.
                    raise RunCancelled
        except RunCancelled:
            log.info("report run %s ended before it was done", run.id)
        except Exception:
            # Its lease runs out, and the next who asks computes it again.
            log.exception("report run %s could not be stored", run.id)
        finally:
            self._drop(run.id)

    def _drop(self, id: str) -> None:
        with self._changed:
            self._held.pop(id, None)
            self._changed.notify_all()

    def _renew(self) -> None:
        """Keep the leases of what is held, and stop what was cancelled or taken over elsewhere."""
        while not self._closed.wait(_TICK_S):
            with self._lock:
                held = dict(self._held)
            if not held:
                continue
            try:
                with self._database.write() as tx:
                    now = {id: (item.lease_id, item.progress) for id, item in held.items()}
                    kept = report_runs.renew(tx, now)
            except Exception:
                log.exception("leases of report runs could not be renewed")
                continue
            for id, item in held.items():
                if id not in kept:
                    item.stop.set()


def _settled(run: RunRow) -> bool:
    """Whether a run needs nobody to start it."""
    if run.state == RunState.RUNNING:
        return run.live
    return run.state == RunState.DONE or run.problem is not None


def model(run: RunRow) -> ReportRun:
    """As the wire has it, the result included."""
    problem = None if run.problem is None else ProblemError(**run.problem).document("")
    result = None if run.result is None else json.loads(run.result)
    return ReportRun.model_validate({**vars(run), "result": result, "problem": problem})

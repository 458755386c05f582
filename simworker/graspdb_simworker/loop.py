"""The pull loop: claim a job, simulate it in a child, hand in the result; renew leases all the while.

A worker holds nothing but leases, so it may be killed at any time: the service gives its jobs to others
when their leases run out. What it computed is not lost to a service that restarts: results are sent
until they are accepted or the lease is another's. Threads: one a child (``processes``), and one
heartbeat for all; if the heartbeat dies the worker stops rather than go on with leases that run out.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import random
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

from graspdb import errors, wire
from graspdb.transport import Transport
from graspdb.wire.sweeps import Engine
from graspdb_simworker.decomposition.supervisor import DecompositionFailed, ResourceLimits, decompose
from graspdb_simworker.process.local import LocalRunner
from graspdb_simworker.process.runner import ChunkCancelled, ChunkFailed, ChunkRunner, PhysicsMissing

log = logging.getLogger("graspdb.simworker")

CAPABILITIES = ("simulate", "lift", "shake", "drawn-wrench", "drawn-lift", "drawn-shake", "stated-shake")
"""Job kinds, protocols beyond ``wrench``, those with draws and with accelerations of their own, that this
worker's processes claim."""
DECOMPOSING = ("decompose",)
"""What it claims besides, one at a time."""
GLB = "model/gltf-binary"
MAX_BACKOFF_S = 15.0
IDLE_S = 2.0
_CACHED_PARTS = 16
#: For want of a key, or of a scope.
_REFUSED = (errors.AuthenticationError, errors.PermissionDenied)


class WorkerFailed(Exception):
    """The worker can't go on; the message says what to do."""


class NoPhysics(WorkerFailed):
    """Something that simulating takes is not installed."""


@dataclass
class Lease:
    """A claimed job, shared between the thread that works on it and the heartbeat."""

    job: str
    lease_id: str
    lease_s: float
    renewed: float
    unheard: bool = False
    lost: threading.Event = field(default_factory=threading.Event)
    progress: str | None = None

    def note(self, progress: str) -> None:
        """Say how far the work is, with the next renewal, which comes soon."""
        self.progress = progress[:200]
        self.renewed = -float("inf")


@dataclass
class WorkTally:
    """What a worker has done since it started."""

    jobs: int = 0
    poses: int = 0
    grasps: int = 0
    failures: int = 0
    lost: int = 0

    def __str__(self) -> str:
        return (
            f"{self.jobs} jobs, {self.poses} poses, {self.grasps} grasps in physics;"
            f" {self.failures} failed, {self.lost} not wanted any more"
        )


@dataclass(eq=False)
class Worker:
    """Pulls jobs from one service and runs up to ``processes`` chunks at once, a thread and a runner each.

    Give ``transport``, which all threads share, few retries: this loop has its own. ``exit_when_idle``
    returns when there is nothing left to claim, ``once`` after one job for each process. ``decompositions``
    are the limits of one mesh's; None leaves them to other workers. They have a thread of their own, which
    the service lists as another worker, so that no chunk that is ready waits for one. ``engine`` simulates
    chunks that name none; None for the default of whoever simulates. ``engines`` are those that chunks may
    name.
    """

    transport: Transport
    _: KW_ONLY
    name: str
    processes: int = 1
    exit_when_idle: bool = False
    once: bool = False
    make_runner: Callable[[], ChunkRunner] = LocalRunner
    decompositions: ResourceLimits | None = None
    engine: Engine | None = None
    engines: Sequence[Engine] = ()

    def __post_init__(self) -> None:
        if self.processes < 1:
            raise ValueError("processes must be at least 1")
        self._stop = threading.Event()
        self._done = threading.Event()
        self._lock = threading.Lock()
        self._leases: dict[str, Lease] = {}
        self._busy: set[str] = set()
        self._parts: dict[str, bytes] = {}
        self._fatal: WorkerFailed | None = None
        self.tally = WorkTally()

    def stop(self) -> None:
        """Stop soon: children are killed and leases given back. May be called from a signal handler."""
        self._stop.set()

    def run(self) -> None:
        """Work until stopped, or idle if so asked.

        WorkerFailed if the service refuses this worker, no engine is installed or the heartbeat died.
        """
        heartbeat = threading.Thread(
            target=self._guard, args=(self._heartbeat,), name="heartbeat", daemon=True
        )
        slots = [
            threading.Thread(target=self._guard, args=(self._slot,), name=f"slot-{number}", daemon=True)
            for number in range(self.processes)
        ]
        if self.decompositions is not None:
            slots.append(
                threading.Thread(target=self._guard, args=(self._decomposer,), name="decomposer", daemon=True)
            )
        heartbeat.start()
        for slot in slots:
            slot.start()
        try:
            for slot in slots:
                # In slices: a signal's handler runs in this thread only between them.
                while slot.is_alive():
                    slot.join(0.2)
        finally:
            self._stop.set()
            self._done.set()
            for thread in (*slots, heartbeat):
                thread.join(10.0)
        if self._fatal is not None:
            raise self._fatal

    def _guard(self, body: Callable[[], None]) -> None:
        try:
            body()
        except WorkerFailed as error:
            self._fail(error)
        except PhysicsMissing as error:
            self._fail(NoPhysics(f"no physics here: {error}"))
        except BaseException as error:
            log.exception("the worker's %s died", threading.current_thread().name)
            self._fail(WorkerFailed(f"{threading.current_thread().name} died: {error!r}"))

    def _fail(self, error: WorkerFailed) -> None:
        with self._lock:
            self._fatal = self._fatal or error
        self._stop.set()

    # -- heartbeat ----------------------------------------------------------------------------------------

    def _heartbeat(self) -> None:
        """Renew every lease at a third of its time. Ends only once all slots have ended."""
        while not self._done.is_set():
            now = time.monotonic()
            with self._lock:
                leases = list(self._leases.values())
            due = [lease for lease in leases if not lease.lost.is_set()]
            for lease in due:
                if now - lease.renewed >= lease.lease_s / 3.0:
                    self._renew(lease)
            shortest = min((lease.lease_s for lease in due), default=3.0)
            self._done.wait(min(1.0, shortest / 10.0))

    def _renew(self, lease: Lease) -> None:
        try:
            params = {"lease_id": lease.lease_id, "progress": lease.progress}
            path = f"/jobs/{lease.job}/lease"
            renewed = self.transport.model(wire.LeaseRenewed, "PUT", path, params=params, retries=0)
        except (errors.LeaseLost, errors.NotFound) as error:
            log.warning("job %s: lease lost (%s)", lease.job, error)
            lease.lost.set()
        except errors.GraspDBError as error:
            # Perhaps the service restarts. A lease that ran out may still be ours when it is back.
            level = logging.DEBUG if lease.unheard else logging.WARNING
            log.log(level, "job %s: could not renew the lease, trying on: %s", lease.job, error)
            lease.unheard = True
            lease.renewed += min(1.0, lease.lease_s / 10.0)
        else:
            lease.renewed, lease.lease_s, lease.unheard = time.monotonic(), renewed.lease_s, False
            if renewed.cancel:
                log.info("job %s: cancelled", lease.job)
                lease.lost.set()

    # -- jobs ---------------------------------------------------------------------------------------------

    def _slot(self) -> None:
        with self.make_runner() as runner:
            self._pull(self.name, (*CAPABILITIES, *self.engines), lambda job: self._work(runner, job))

    def _decomposer(self) -> None:
        self._pull(f"{self.name}-parts", DECOMPOSING, lambda job: self._work(None, job))

    def _pull(self, name: str, capabilities: Sequence[str], work: Callable[[wire.ClaimedJob], None]) -> None:
        """Claim and do one job after the other."""
        failures = 0
        while not self._stop.is_set():
            self._note_busy(True)
            try:
                job, wait = self._claim(name, capabilities)
            except _REFUSED as error:
                raise WorkerFailed(f"the service refuses this worker: {error}") from error
            except errors.InvalidInput as error:
                raise WorkerFailed(f"the service does not understand this worker: {error}") from error
            except errors.GraspDBError as error:
                failures += 1
                delay = _backoff(failures)
                log.warning("can't claim jobs (again in %.1f s): %s", delay, error)
                self._stop.wait(delay)
                continue
            failures = 0
            if job is not None:
                work(job)
            elif self._note_busy(False) and self.exit_when_idle:
                return
            if self.once:
                return
            if job is None:
                self._stop.wait(wait)

    def _note_busy(self, busy: bool) -> bool:
        """Note whether this thread claims or works, which may make work for others; whether none does."""
        with self._lock:
            (self._busy.add if busy else self._busy.discard)(threading.current_thread().name)
            return not self._busy

    def _claim(self, name: str, capabilities: Sequence[str]) -> tuple[wire.ClaimedJob | None, float]:
        request = wire.ClaimRequest(worker=name, capabilities=list(capabilities), limit=1)
        answer = self.transport.model(wire.ClaimResponse, "POST", "/jobs/claim", body=request, retries=0)
        return (answer.jobs[0] if answer.jobs else None), max(0.1, answer.retry_after_s or IDLE_S)

    def _work(self, runner: ChunkRunner | None, job: wire.ClaimedJob) -> None:
        with self._holding(job) as lease:
            try:
                payload = job.payload
                if isinstance(payload, wire.DecomposePayload):
                    self._decompose(payload, lease)
                    return
                if runner is None:
                    raise ChunkFailed("chunks were not asked for here")
                parts = self._parts_of(payload, lease)
                if payload.engine is None:
                    payload = payload.model_copy(update={"engine": self.engine})
                result = runner.run(payload, parts, wanted=lambda: self._wanted(lease))
            except ChunkCancelled:
                self._abandon(lease)
            except ChunkFailed as error:
                log.error("job %s failed: %s", job.id, error)
                self.tally.failures += 1
                self._report_failure(lease, str(error), permanent=isinstance(error, DecompositionFailed))
            except PhysicsMissing:
                self._release(lease)
                raise
            else:
                if self._hand_in(lease, "result", result):
                    self._count(payload.stop - payload.start, len(result.rows.pose_index))

    def _decompose(self, payload: wire.DecomposePayload, lease: Lease) -> None:
        """Make an object's convex parts and hand them in."""
        if self.decompositions is None:
            raise ChunkFailed("this worker does not do 'decompose' jobs")
        mesh = self._fetched(payload.mesh, payload.mesh_sha256, lease)
        limits, wanted = self.decompositions, lambda: self._wanted(lease)
        parts = decompose(payload, mesh, limits=limits, wanted=wanted, progress=lease.note)
        if self._hand_in(lease, "result", parts):
            self._count()

    @contextlib.contextmanager
    def _holding(self, job: wire.ClaimedJob) -> Iterator[Lease]:
        lease = Lease(job.id, job.lease_id, job.lease_s, time.monotonic())
        with self._lock:
            self._leases[lease.lease_id] = lease
        try:
            yield lease
        finally:
            with self._lock:
                self._leases.pop(lease.lease_id, None)

    def _wanted(self, lease: Lease) -> bool:
        return not (self._stop.is_set() or lease.lost.is_set())

    def _abandon(self, lease: Lease) -> None:
        if lease.lost.is_set():
            self.tally.lost += 1
        else:
            self._release(lease)

    def _release(self, lease: Lease) -> None:
        """Give a lease back, so that another worker need not wait until it runs out."""
        try:
            self.transport.request(
                "DELETE", f"/jobs/{lease.job}/lease", params={"lease_id": lease.lease_id}, retries=0
            )
        except errors.GraspDBError as error:
            log.warning("job %s: could not release the lease, it will run out: %s", lease.job, error)

    def _parts_of(self, payload: wire.SimulatePayload, lease: Lease) -> bytes:
        """The object's convex parts as GLB, fetched once for each hash.

        ChunkCancelled if the job is not wanted any more before they came; ChunkFailed if the service does not
        have those that the sweep was planned with.
        """
        digest = payload.parts_sha256
        with self._lock:
            if digest in self._parts:
                return self._parts[digest]
        data = self._fetched(payload.convex_parts, digest, lease)
        with self._lock:
            while len(self._parts) >= _CACHED_PARTS:
                self._parts.pop(next(iter(self._parts)))
            self._parts[digest] = data
        return data

    def _fetched(self, path: str, digest: str, lease: Lease) -> bytes:
        """Bytes with this SHA-256 from the service; raises as :meth:`_parts_of`."""
        failures = 0
        while True:
            if not self._wanted(lease):
                raise ChunkCancelled
            try:
                data = self.transport.request("GET", path, retries=0).content
                break
            except (
                errors.NotFound,
                errors.AuthenticationError,
                errors.PermissionDenied,
                errors.InvalidInput,
            ) as error:
                raise ChunkFailed(f"can't fetch {path}: {error}") from error
            except errors.GraspDBError as error:
                failures += 1
                log.warning("can't fetch %s: %s", path, error)
                self._stop.wait(_backoff(failures))
        found = hashlib.sha256(data).hexdigest()
        if found != digest:
            raise ChunkFailed(f"{path} has the SHA-256 {found}, the job was planned with {digest}")
        return data

    def _count(self, poses: int = 0, grasps: int = 0) -> None:
        """One more job is done."""
        with self._lock:
            self.tally.jobs += 1
            self.tally.poses += poses
            self.tally.grasps += grasps
            log.info("%s", self.tally)

    def _report_failure(self, lease: Lease, message: str, *, permanent: bool) -> None:
        self._hand_in(lease, "failure", {"error": message[:4000], "permanent": permanent})

    def _hand_in(self, lease: Lease, what: str, body: wire.SimulateResult | dict[str, Any] | bytes) -> bool:
        """Send until the service answers for good: whether it took it.

        The same body under the same lease is idempotent, so an answer lost on the way does no harm.
        Once the worker is asked to stop there is one more attempt, then the lease runs out by itself.
        """
        failures = 0
        is_glb = isinstance(body, bytes)
        sent: dict[str, Any] = (
            {"content": body, "headers": {"Content-Type": GLB}} if is_glb else {"body": body}
        )
        while True:
            last = self._stop.is_set()
            if lease.lost.is_set():
                self.tally.lost += 1
                return False
            try:
                params = {"lease_id": lease.lease_id}
                self.transport.request("PUT", f"/jobs/{lease.job}/{what}", params=params, retries=0, **sent)
            except (errors.Conflict, errors.NotFound) as error:
                log.warning("job %s: %s not wanted: %s", lease.job, what, error)
                self.tally.lost += 1
                return False
            except (
                errors.InvalidInput,
                errors.TooLarge,
                errors.AuthenticationError,
                errors.PermissionDenied,
            ) as error:
                log.error("job %s: the service refuses the %s: %s", lease.job, what, error)
                self.tally.failures += 1
                if what == "result":
                    self._report_failure(lease, f"the service refused the result: {error}", permanent=is_glb)
                return False
            except errors.GraspDBError as error:
                if last:
                    log.error("job %s: %s not sent, stopping: %s", lease.job, what, error)
                    return False
                failures += 1
                delay = _backoff(failures)
                log.warning("job %s: %s not sent (again in %.1f s): %s", lease.job, what, delay, error)
                self._stop.wait(delay)
            else:
                return True


def _backoff(failures: int) -> float:
    return min(MAX_BACKOFF_S, 0.25 * 2.0 ** min(failures, 10)) * random.uniform(0.6, 1.0)

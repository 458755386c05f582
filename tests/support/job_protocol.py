"""The job protocol over HTTP against a model: whatever workers and users do, the service does as it says.

Two workers claim, renew, give back, fail, come late, repeat themselves and lie about their leases; users
plan, cancel and retry sweeps, delete their batches, bring convex parts; and time passes by the database's
clock.
"""

from __future__ import annotations

import base64
import uuid
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, multiple, rule
from sqlalchemy import text

from graspdb.wire import OUTCOME_CODES, OUTCOMES
from graspdb_geometry.grids import PoseGrid
from graspdb_service.storage import objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database

GRID = {"position_step_m": 0.02, "rotation_step_deg": 60.0, "margin_m": 0.0, "max_poses": 1_500}
MAX_ATTEMPTS = 2
_COLLISION = OUTCOME_CODES["collision"]
WORKERS = ["alpha", "beta"]
GLB = {"Content-Type": "model/gltf-binary"}


@dataclass
class Job:
    """What the model knows of a job. ``holder`` is the lease that the service would still recognise."""

    object: str
    sweep: Sweep | None
    number: int
    order: tuple[int, int, int]
    state: str = "queued"
    attempts: int = 0
    holder: str | None = None
    expired: bool = False
    permanent: bool = False
    stored: tuple[bytes, dict[str, Any]] | None = None

    def queue(self, state: str = "queued") -> None:
        self.state, self.attempts, self.holder = state, 0, None


@dataclass
class Sweep:
    id: str
    object: str
    batch: str
    purpose: str
    chunk_poses: int
    jobs: list[Job] = field(default_factory=list)
    started: bool = False
    cancelled: bool = False
    deleted: bool = False
    needs_parts: bool = False

    def states(self) -> Counter[str]:
        return Counter(job.state for job in self.jobs)

    def is_open(self) -> bool:
        return any(job.state in ("waiting", "queued", "leased") for job in self.jobs)

    def state(self) -> str:
        if self.cancelled:
            return "cancelled"
        if self.is_open():
            return "running" if self.started else "queued"
        return "failed" if self.states()["failed"] else "done"


@dataclass(frozen=True)
class Lease:
    """A claim's answer, kept by its worker whatever happens."""

    job: Job
    id: str
    lease_id: str
    payload: dict[str, Any]


def outcome_of(index: np.ndarray) -> np.ndarray:
    """Outcomes that depend on the pose only, so that it does not matter who simulates it."""
    return np.array([1, 2, 2, 2, 4, 6, 2, 2], dtype=np.uint8)[(index * 2_654_435_761 >> 7) % 8]


class JobProtocol(RuleBasedStateMachine):
    """Subclasses set the service, its database, and the two objects that every example copies: ``convex``
    is its own convex part, ``dented`` needs a worker or a user to make ``parts``.
    """

    leases: Bundle[Lease] = Bundle("leases")
    http: httpx.Client
    database: Database
    parts: bytes
    grids: dict[str, PoseGrid]

    @initialize(target=leases)
    def begin(self) -> Any:
        """Two sweeps, one of which waits for parts, and a worker that has begun."""
        self.tag = uuid.uuid4().hex[:12]
        self.has_parts = {self._copy("convex"): True, self._copy("dented"): False}
        self.sweeps: list[Sweep] = []
        self.decomposition: Job | None = None
        self.planned = 0
        self.changed = True
        self._plan("convex", "collect", 600)
        self._plan("dented", "collect", 900)
        return self._claim("alpha", ["simulate", "decompose"], 3)

    def _copy(self, template: str) -> str:
        """An object of this example's own with the mesh of a template, which takes the service a while."""
        slug = f"{template}-{self.tag}"
        with self.database.write() as tx:
            like = objects.find(tx, template)
            assert like is not None
            objects.create(tx, slug, {"mass_kg": 0.3})
            audit.record(tx, "object.create", object=slug)
            row = objects.find(tx, slug)
            assert row is not None
            objects.advance(tx, row.id, append=False)
            same = ("mesh_sha256", "mesh_info", "parts_sha256", "parts_info")
            objects.change(tx, row.id, {name: getattr(like, name) for name in same})
        return slug

    # -- users

    @rule(
        data=st.data(),
        action=st.sampled_from(["plan", "cancel", "retry", "delete the batch", "bring parts"]),
    )
    def user(self, data: st.DataObject, action: str) -> None:
        sweep = data.draw(st.sampled_from(self.sweeps))
        if action == "plan" and self.planned < 4:
            template = data.draw(st.sampled_from(["convex", "dented"]))
            self._plan(template, data.draw(st.sampled_from(["collect", "check"])), 900)
        elif action == "cancel":
            self._cancel(sweep)
        elif action == "retry":
            self._retry(sweep)
        elif action == "delete the batch" and not sweep.deleted:
            self._delete_the_batch(sweep)
        elif action == "bring parts" and not self.has_parts[f"dented-{self.tag}"]:
            self._bring_parts(f"dented-{self.tag}")
        self.changed = True

    def _plan(self, template: str, purpose: str, chunk_poses: int) -> None:
        slug = f"{template}-{self.tag}"
        waits = not self.has_parts[slug]
        body = {"grid": GRID, "chunk_poses": chunk_poses, "purpose": purpose}
        headers = {"Idempotency-Key": str(uuid.uuid4())}
        answer = self.http.post(f"/objects/{slug}/sweeps", json=body, headers=headers)
        if waits and self.decomposition is not None and self.decomposition.state == "failed":
            assert kind_of(answer) == (409, "convex-parts-missing")
            return
        assert answer.status_code == 202, answer.text
        made = answer.json()
        sweep = Sweep(made["id"], slug, made["batch"], purpose, chunk_poses, needs_parts=waits)
        urgency = 0 if purpose == "check" else 1
        sweep.jobs = [
            Job(slug, sweep, number, (urgency, self.planned, number), "waiting" if waits else "queued")
            for number in range(made["chunks"])
        ]
        assert self.http.post(f"/objects/{slug}/sweeps", json=body, headers=headers).json() == made
        self.sweeps.append(sweep)
        self.planned += 1
        if waits:
            self._decompose(self.planned - 1)

    def _decompose(self, planned: int) -> None:
        """What follows for the decomposition when a sweep waits for it."""
        if self.decomposition is None:
            self.decomposition = Job(f"dented-{self.tag}", None, 0, (0, planned, 0))
        elif self.decomposition.state in ("failed", "cancelled"):
            self.decomposition.queue()

    def _cancel(self, sweep: Sweep) -> None:
        assert self.http.post(f"/sweeps/{sweep.id}/cancel").status_code == 200
        for job in sweep.jobs:
            if job.state in ("waiting", "queued", "leased"):
                job.state, sweep.cancelled = "cancelled", True
        wanted = any(job.state == "waiting" for each in self.sweeps for job in each.jobs)
        made = self.decomposition
        if sweep.object.startswith("dented") and not wanted and made and made.state in ("queued", "leased"):
            made.state = "cancelled"

    def _retry(self, sweep: Sweep) -> None:
        answer = self.http.post(f"/sweeps/{sweep.id}/retry")
        if sweep.deleted:
            assert kind_of(answer) == (409, "batch-deleted")
            return
        assert answer.status_code == 200, answer.text
        again = [job for job in sweep.jobs if job.state in ("failed", "cancelled")]
        waits = bool(again) and sweep.needs_parts and not self.has_parts[sweep.object]
        for job in again:
            job.queue("waiting" if waits else "queued")
            sweep.cancelled = False
        if waits:
            self._decompose(self.planned)
        elif again:
            sweep.needs_parts = False

    def _delete_the_batch(self, sweep: Sweep) -> None:
        answer = self.http.delete(f"/objects/{sweep.object}/batches/{sweep.batch}")
        if sweep.is_open():
            assert kind_of(answer) == (409, "sweep-running")
        else:
            assert answer.status_code == 204, answer.text
            sweep.deleted = True

    def _bring_parts(self, slug: str) -> None:
        answer = self.http.put(f"/objects/{slug}/convex-parts", content=self.parts, headers=GLB)
        assert answer.is_success, answer.text
        self._parts_are_there(slug)

    def _parts_are_there(self, slug: str) -> None:
        self.has_parts[slug] = True
        for sweep in self.sweeps:
            for job in sweep.jobs:
                if job.state == "waiting":
                    job.state, sweep.needs_parts = "queued", False
        if self.decomposition is not None and self.decomposition.state in ("queued", "leased"):
            self.decomposition.state = "cancelled"

    # -- workers

    @rule(
        target=leases,
        worker=st.sampled_from(WORKERS),
        capabilities=st.sampled_from([["simulate"], ["decompose"], ["simulate", "decompose"]]),
        limit=st.integers(1, 3),
    )
    def claim(self, worker: str, capabilities: list[str], limit: int) -> Any:
        return self._claim(worker, capabilities, limit)

    def _claim(self, worker: str, capabilities: list[str], limit: int) -> Any:
        self.changed = True
        for job in self._jobs():
            # Whoever claims next finds out that the last lease allowed has run out.
            if job.state == "leased" and job.expired and job.attempts >= MAX_ATTEMPTS:
                self._fail(job)
        free = sorted(
            (
                job
                for job in self._jobs()
                if ("decompose" if job.sweep is None else "simulate") in capabilities
                and (job.state == "queued" or (job.state == "leased" and job.expired))
            ),
            key=lambda job: job.order,
        )
        body = {"worker": worker, "capabilities": capabilities, "limit": limit}
        answer = self.http.post("/jobs/claim", json=body)
        assert answer.status_code == 200, answer.text
        found = [(self._named(job), job) for job in answer.json()["jobs"]]
        assert [job for job, _ in found] == free[:limit]
        claimed = []
        for job, given in found:
            assert given["lease_id"] != job.holder
            job.state, job.holder, job.expired = "leased", given["lease_id"], False
            job.attempts += 1
            if job.sweep is not None:
                job.sweep.started = True
            claimed.append(Lease(job, given["id"], given["lease_id"], given["payload"]))
        return multiple(*claimed)

    def _named(self, given: dict[str, Any]) -> Job:
        payload = given["payload"]
        if given["kind"] == "decompose":
            assert self.decomposition is not None
            assert payload["object"] == self.decomposition.object
            return self.decomposition
        (sweep,) = (each for each in self.sweeps if each.id == payload["sweep"])
        return sweep.jobs[payload["start"] // sweep.chunk_poses]

    @rule(lease=leases)
    def renew(self, lease: Lease) -> None:
        answer = self._put(lease, "lease")
        if self._holds(lease):
            assert answer.status_code == 200, answer.text
            assert not answer.json()["cancel"]
            lease.job.expired = False
        elif lease.job.state == "cancelled" and lease.job.holder == lease.lease_id:
            assert answer.json()["cancel"]
        else:
            assert kind_of(answer) == (409, "lease-lost")

    @rule(lease=leases)
    def give_back(self, lease: Lease) -> None:
        self.changed = True
        answer = self.http.delete(f"/jobs/{lease.id}/lease", params={"lease_id": lease.lease_id})
        if self._holds(lease):
            assert answer.status_code == 204, answer.text
            lease.job.state, lease.job.holder = "queued", None
            lease.job.attempts -= 1
        else:
            assert kind_of(answer) == (409, "lease-lost")

    @rule(lease=leases, permanent=st.booleans())
    def report_failure(self, lease: Lease, permanent: bool) -> None:
        answer = self._put(lease, "failure", json={"error": "boom", "permanent": permanent})
        job = lease.job
        if self._holds(lease):
            assert answer.status_code == 200, answer.text
            if permanent or job.attempts >= MAX_ATTEMPTS:
                self._fail(job)
            else:
                job.state = "queued"
            assert answer.json()["state"] == job.state
        elif job.holder == lease.lease_id and job.state in ("queued", "failed"):
            assert answer.json()["state"] == job.state
        else:
            assert kind_of(answer) == (409, "lease-lost")

    def _fail(self, job: Job) -> None:
        job.state = "failed"
        if job.sweep is None:
            for sweep in self.sweeps:
                for each in sweep.jobs:
                    if each.state == "waiting":
                        each.state = "failed"

    @rule(lease=leases, changed=st.integers(0, 9))
    def hand_in(self, lease: Lease, changed: int) -> None:
        """The result, which may come late, or once more; now and then not as it was."""
        job = lease.job
        if job.sweep is None:
            body, options = self.parts, {"headers": GLB}
        else:
            body = self._result(lease.payload, quality=0.5 if changed == 0 else None)
            options = {"headers": {"Content-Type": "application/json"}}
        answer = self._put(lease, "result", content=body, **options)
        if self._holds(lease):
            assert answer.status_code == 200, answer.text
            job.state, job.stored = "done", (body, answer.json())
            if job.sweep is None:
                self._parts_are_there(job.object)
        elif job.state == "done" and job.holder == lease.lease_id and job.stored and job.stored[0] == body:
            assert answer.json() == job.stored[1]
        else:
            assert kind_of(answer) == (409, "lease-lost")

    def _result(self, payload: dict[str, Any], quality: float | None) -> bytes:
        grid = PoseGrid(**payload["grid"])
        index = grid.pose_indices(payload["start"], payload["stop"])
        codes = outcome_of(index)
        physics = index[codes != _COLLISION].tolist()
        rows = {
            "pose_index": physics,
            "width_m": [0.04] * len(physics),
            "quality": [quality] * len(physics),
        }
        body = {"outcomes": base64.b64encode(codes.tobytes()).decode(), "rows": rows}
        return httpx.Request("PUT", "http://x", json=body).content

    @rule(lease=leases, action=st.sampled_from(["lease", "result", "failure"]))
    def come_with_a_lease_of_nobodys(self, lease: Lease, action: str) -> None:
        stranger = Lease(lease.job, lease.id, uuid.uuid4().hex, lease.payload)
        body: dict[str, Any] = {}
        if action == "failure":
            body = {"json": {"error": "boom"}}
        elif action == "result":
            body = {"content": self.parts, "headers": GLB}
        assert kind_of(self._put(stranger, action, **body)) == (409, "lease-lost")

    @rule(lease=leases)
    def let_one_lease_run_out(self, lease: Lease) -> None:
        self._pass_time("AND lease_id = :lease", lease=lease.lease_id)
        if self._holds(lease):
            lease.job.expired = True

    @rule()
    def let_time_pass(self) -> None:
        self._pass_time("")
        for job in self._jobs():
            job.expired = job.expired or job.state == "leased"

    def _pass_time(self, which: str, **values: Any) -> None:
        """Move the database's clock on by a day, as far as leases tell."""
        statement = (
            f"UPDATE jobs SET lease_expires_at = lease_expires_at - 86400 WHERE state = 'leased' {which}"
        )
        with self.database.write() as tx:
            tx.execute(text(statement), values)

    # -- what holds

    @invariant()
    def the_service_says_what_the_model_says(self) -> None:
        if not getattr(self, "changed", False):
            return
        self.changed = False
        for sweep in self.sweeps:
            info = self.http.get(f"/sweeps/{sweep.id}").json()
            states = sweep.states()
            assert (info["chunks_done"], info["chunks_failed"]) == (states["done"], states["failed"])
            assert info["state"] == sweep.state()
            done = self._poses([sweep])
            assert sum(info["outcomes"].values()) == len(done)
        for slug in self.has_parts:
            self._check_object(slug)
        query = text(
            "SELECT o.slug, j.sweep_id, j.number, j.state, j.attempts FROM jobs j"
            " JOIN objects o ON o.id = j.object_id WHERE o.slug IN (:first, :second)"
        )
        first, second = self.has_parts
        with self.database.read() as tx:
            stored = {tuple(row) for row in tx.execute(query, {"first": first, "second": second})}
        assert stored == {
            (job.object, job.sweep and job.sweep.id, job.number, job.state, job.attempts)
            for job in self._jobs()
        }

    def _check_object(self, slug: str) -> None:
        """Every pose that any undeleted sweep has done is the object's, once, whoever did it first."""
        kept = [s for s in self.sweeps if s.object == slug and s.purpose == "collect" and not s.deleted]
        index = self._poses(kept)
        codes = outcome_of(index)
        expected = {OUTCOMES[code]: int((codes == code).sum()) for code in np.unique(codes)}
        assert self.http.get(f"/objects/{slug}").json()["outcomes"] == expected
        with self.database.read() as tx:
            query = text(
                "SELECT pose_index, outcome FROM trials WHERE object_id ="
                " (SELECT id FROM objects WHERE slug = :slug) ORDER BY pose_index"
            )
            rows = [(int(pose), int(code)) for pose, code in tx.execute(query, {"slug": slug})]
        physics = codes != _COLLISION
        assert rows == list(zip(index[physics].tolist(), codes[physics].tolist(), strict=True))

    def _poses(self, sweeps: list[Sweep]) -> np.ndarray:
        """Indices of the poses of finished chunks, each once, ascending."""
        done = [np.empty(0, dtype=np.int64)]
        for sweep in sweeps:
            grid = self.grids[sweep.object.partition("-")[0]]
            for job in sweep.jobs:
                if job.state == "done":
                    start = job.number * sweep.chunk_poses
                    done.append(grid.pose_indices(start, min(start + sweep.chunk_poses, grid.total)))
        found: np.ndarray = np.unique(np.concatenate(done))
        return found

    def teardown(self) -> None:
        if not hasattr(self, "changed"):
            return
        for sweep in self.sweeps:
            self.http.post(f"/sweeps/{sweep.id}/cancel")
        for slug in self.has_parts:
            assert self.http.delete(f"/objects/{slug}").is_success

    def _jobs(self) -> list[Job]:
        made = [] if self.decomposition is None else [self.decomposition]
        return made + [job for sweep in self.sweeps for job in sweep.jobs]

    def _holds(self, lease: Lease) -> bool:
        return lease.job.state == "leased" and lease.job.holder == lease.lease_id

    def _put(self, lease: Lease, what: str, **body: Any) -> httpx.Response:
        self.changed = True
        return self.http.put(f"/jobs/{lease.id}/{what}", params={"lease_id": lease.lease_id}, **body)


def kind_of(answer: httpx.Response) -> tuple[int, str]:
    """Status and kind of a problem."""
    return answer.status_code, answer.json()["type"].rsplit(":", 1)[-1]

"""A lab on one small disk: database, service, workers and network, each of which can be made to fail.

:class:`Lab` holds the processes; :class:`Sender` posts batches and keeps the truth that a client knows;
:class:`Follower` reads along as an incremental client does.
"""

from __future__ import annotations

import json
import struct
import threading
import uuid
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from graspdb import Client
from graspdb.errors import GraspDBError
from graspdb_service.storage import schema
from graspdb_service.storage.database import Database
from jumping_clock import JumpingClock
from lossy_proxy import LossyProxy
from postgres_server import PostgresPrograms, PostgresServer
from real_processes import Process, free_port, wait_for
from small_disk import Guard, SmallDisk

BATCH = 60
BOX_M = (0.04, 0.04, 0.04)
GRIPPER, SOURCE, PROTOCOL = "pg70", "robot", "wrench"
SETTINGS = {
    "GRASPDB_LEASE_S": "2",
    "GRASPDB_RETRY_AFTER_S": "0.2",
    # Each killed worker costs an attempt, and so may a service that is away for longer than a lease.
    "GRASPDB_MAX_ATTEMPTS": "100",
    "GRASPDB_REPORT_WAIT_S": "0",
}


class Replica:
    """One process of the service."""

    def __init__(self, folder: Path, name: str, database_url: str, **environment: str) -> None:
        self.name = name
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.process = Process(
            folder / f"{name}.log",
            *("graspdb-server", "serve", "--port", str(self.port), "--database-url", database_url),
            cwd=folder,
            **SETTINGS,
            **environment,
        )
        self.http = httpx.Client(base_url=self.url, timeout=60)

    def wait(self) -> None:
        def is_ready() -> bool:
            assert self.process.is_running(), f"{self.name} ended by itself:\n{self.process.log()}"
            return self.http.get("/readyz").is_success

        wait_for(f"{self.name} is ready", is_ready)


class Lab:
    """``sqlite``: one service with one worker. ``postgres``: two replicas, each with a worker.

    The first replica is met through a network that loses answers, and has a clock of its own. Whatever is
    started here works in ``folder``, where the guard finds it.
    """

    def __init__(self, folder: Path, programs: PostgresPrograms | None) -> None:
        self._stack = ExitStack()
        try:
            self._begin(folder, programs)
        except BaseException:
            self._stack.close()
            raise

    def _begin(self, folder: Path, programs: PostgresPrograms | None) -> None:
        folder.chmod(0o755)
        self._stack.callback(Guard(folder).close)
        self.disk = SmallDisk(folder)
        self.postgres: PostgresServer | None = None
        url = f"sqlite:///{self.disk.folder / 'graspdb.sqlite'}"
        if programs is not None:
            home = self.disk.folder / "postgres"
            home.mkdir()
            self.postgres = PostgresServer(home, programs)
            self._stack.callback(self.postgres.stop)
            url = self.postgres.url
        self.database = Database(url, pool_size=2)
        self._stack.callback(self.database.dispose)
        schema.upgrade(self.database)
        self.clock = JumpingClock(folder / "clock")
        self.replicas = [Replica(folder, "service-0", url, **self.clock.environment)]
        if self.postgres is not None:
            self.replicas.append(Replica(folder, "service-1", url))
        for replica in self.replicas:
            self._stack.callback(replica.http.close)
            self._stack.callback(replica.process.clean_up)
            replica.process.start()
        for replica in self.replicas:
            replica.wait()
        self.proxy = LossyProxy(self.replicas[0].port)
        self._stack.callback(self.proxy.close)
        urls = [self.proxy.url, *(replica.url for replica in self.replicas[1:])]
        self.workers = [
            Process(
                folder / f"worker-{number}.log",
                *("graspdb-simworker", "run", "--url", each, "--name", f"w{number}", "--verbose"),
                cwd=folder,
            )
            for number, each in enumerate(urls)
        ]
        for worker in self.workers:
            self._stack.callback(worker.clean_up)
            worker.start()

    def close(self) -> None:
        self._stack.close()

    @property
    def http(self) -> httpx.Client:
        """A client of the replica that the network does not spoil."""
        return self.replicas[-1].http

    def heal(self) -> None:
        """Have everything run again."""
        self.disk.free(self.writers())
        self.proxy.share = 0.0
        self.clock.set(0.0)
        if self.postgres is not None:
            self.postgres.resume()
            if not self.postgres.is_running():
                self.postgres.restart()
        for process in (*(replica.process for replica in self.replicas), *self.workers):
            if process.is_running():
                process.resume()
            else:
                process.clean_up()
                process.start()
        for replica in self.replicas:
            replica.wait()

    def logs(self) -> str:
        """The ends of all logs, for whoever looks into a failure."""
        said = {f"service-{n}": replica.process.log() for n, replica in enumerate(self.replicas)}
        said |= {f"worker-{n}": worker.log() for n, worker in enumerate(self.workers)}
        if self.postgres is not None:
            said["postgres"] = self.postgres.log()
        return "\n".join(f"--- {name}\n{text}" for name, text in said.items())

    def writers(self) -> list[int]:
        """Processes that write to the disk."""
        if self.postgres is not None:
            return list(self.postgres.processes())
        return [self.replicas[0].process.pid]


@dataclass
class Sent:
    """A batch that was sent: its key, and what is known of it.

    ``receipt`` where it was acknowledged; ``refusal`` where the service said that nothing was stored;
    neither: nobody knows.
    """

    key: str
    receipt: dict[str, Any] | None = None
    refusal: str | None = None


class Sender(threading.Thread):
    """Posts batches one after the other, each with a key, and keeps what it was answered.

    A batch tells in every trial whose and which it is. With ``retrying`` the SDK sends, which tries again by
    itself; else a plain client, which takes every answer as it comes.
    """

    def __init__(self, number: int, url: str, slug: str, *, retrying: bool) -> None:
        super().__init__(daemon=True)
        self.number = number
        self.slug = slug
        self.sent: list[Sent] = []
        self.finish = threading.Event()
        self.error: Exception | None = None
        self._retrying = retrying
        self._sdk = Client(url, retries=8, timeout_s=60)
        self._http = httpx.Client(base_url=url, timeout=60)

    def position(self, batch: int) -> list[list[float]]:
        return [[batch * 1e-4, trial * 1e-4, 0.06 + 0.01 * self.number] for trial in range(BATCH)]

    def outcomes(self, batch: int) -> list[bool]:
        return [(batch + trial) % 3 == 0 for trial in range(BATCH)]

    def send(self, batch: int) -> None:
        """Send a batch, for the first time or again, and note the answer."""
        sent = self.sent[batch]
        if self._retrying:
            rows = np.array(self.position(batch))
            poses = np.hstack([rows, np.tile([0.0, 0.0, 0.0, 1.0], (BATCH, 1))])
            try:
                trials = self._sdk.objects.get(self.slug).trials
                receipt = trials.add(
                    poses,
                    self.outcomes(batch),
                    gripper=GRIPPER,
                    source=SOURCE,
                    protocol=PROTOCOL,
                    idempotency_key=sent.key,
                )
            except GraspDBError as error:
                # An earlier attempt may have been stored, whatever the last one met.
                if error.status not in (None, 429, 502, 503, 504, 507):
                    raise
            else:
                sent.receipt = {"batch": receipt.batch, "revision": receipt.revision}
            return
        try:
            answer = self.post(batch, sent.key)
        except httpx.TransportError:
            return
        if answer.status_code == 201:
            sent.receipt = answer.json()
        else:
            assert answer.status_code in (429, 503, 507), answer.text
            if "nothing was stored" in answer.json()["title"].lower():
                sent.refusal = answer.text

    def post(self, batch: int, key: str) -> httpx.Response:
        """Send a batch under a key, as it comes."""
        columns = {
            "position": self.position(batch),
            "quaternion_xyzw": [[0, 0, 0, 1]] * BATCH,
            "outcome": self.outcomes(batch),
        }
        body = {"columns": columns, "gripper": GRIPPER, "source": SOURCE, "protocol": PROTOCOL}
        headers = {"Idempotency-Key": key, "Content-Type": "application/json"}
        return self._http.post(f"/objects/{self.slug}/trials", content=json.dumps(body), headers=headers)

    def acknowledged(self) -> int:
        return sum(sent.receipt is not None for sent in self.sent)

    def run(self) -> None:
        try:
            while not self.finish.is_set():
                self.sent.append(Sent(str(uuid.uuid4())))
                self.send(len(self.sent) - 1)
                # What a dead replica takes none of is sent again in the end: not a thousand of them.
                self.finish.wait(0.04 if self.sent[-1].receipt else 0.4)
        except Exception as error:  # noqa: BLE001 - the test looks at it
            self.error = error

    def settle(self) -> None:
        """Send again what nobody knows of, under the same keys, until each is acknowledged."""
        for batch, sent in enumerate(self.sent):
            while sent.receipt is None:
                self.send(batch)

    def close(self) -> None:
        self.finish.set()
        self.join(120)
        self._sdk.close()
        self._http.close()


class Follower(threading.Thread):
    """Reads what is new, again and again, by the last revision seen."""

    def __init__(self, url: str, slug: str) -> None:
        super().__init__(daemon=True)
        self.seen: list[tuple[int, int]] = []
        self.finish = threading.Event()
        self._http = httpx.Client(base_url=url, timeout=60)
        self._path = f"/objects/{slug}/trials"

    def look(self) -> None:
        newest = max((revision for _, revision in self.seen), default=0)
        params = {"since_revision": newest}
        answer = self._http.get(self._path, params=params, headers={"Accept": "application/x-ndjson"})
        if answer.status_code == 200:
            rows = [json.loads(line) for line in answer.text.splitlines()]
            self.seen += [(row["seq"], row["revision"]) for row in rows]

    def run(self) -> None:
        while not self.finish.wait(0.1):
            with suppress(httpx.TransportError):
                self.look()

    def close(self) -> None:
        self.finish.set()
        self.join(120)
        self._http.close()


def box_stl() -> bytes:
    """The object of all tests here: a box, which is its own convex part."""
    corner = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * BOX_M
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    content = b"".join(struct.pack("<12fH", 0, 0, 0, *corner[list(face)].ravel(), 0) for face in faces)
    return b"\0" * 80 + struct.pack("<I", len(faces)) + content

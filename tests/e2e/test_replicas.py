"""Several replicas over one PostgreSQL: one service, whichever is asked, and, behind nginx, killed."""

from __future__ import annotations

import json
import random
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from postgres_server import PostgresPrograms
from replica_set import ReplicaSet
from small_disk import Guard

pytestmark = pytest.mark.timeout(600)

DOWN = {"quaternion_xyzw": [1.0, 0.0, 0.0, 0.0], "gripper": "pg70", "source": "robot"}


@pytest.fixture
def pair(postgres_url: str, serve: Callable[..., str]) -> Iterator[list[httpx.Client]]:
    """Clients of two replicas, each with caches of its own."""
    with ExitStack() as stack:
        yield [stack.enter_context(httpx.Client(base_url=serve(postgres_url), timeout=60)) for _ in range(2)]


def asked_of(replica: httpx.Client) -> dict[str, Any]:
    """What a replica says of the object now."""
    question = {"poses": {"position": [[0, 0, 0.05]], "quaternion_xyzw": [[1, 0, 0, 0]]}}
    answers = {
        "object": replica.get("/objects/box"),
        "trials": replica.get("/objects/box/trials"),
        "batches": replica.get("/objects/box/batches"),
        "density": replica.get("/objects/box/density"),
        "likelihood": replica.post("/objects/box/likelihood", json=question),
        "best-grasp": replica.get("/objects/box/best-grasp"),
        "objects": replica.get("/objects"),
    }
    assert {name: answer.status_code for name, answer in answers.items()} == dict.fromkeys(answers, 200)
    return {name: answer.json() for name, answer in answers.items()}


def write(replica: httpx.Client, chance: random.Random, number: int) -> httpx.Response:
    """Some change of the object, through one replica."""
    batches = [batch["batch"] for batch in replica.get("/objects/box/batches").json()["items"]]
    rows = replica.get("/objects/box/trials").json()["items"]
    kind = chance.choice(["post", "post", "delete", "withdraw", "correct", "patch"])
    if kind == "delete" and len(batches) > 1:
        return replica.delete(f"/objects/box/batches/{chance.choice(batches)}")
    if kind == "withdraw":
        return replica.delete(f"/objects/box/trials/{chance.choice(rows)['seq']}")
    if kind == "correct":
        told = {"outcome": chance.choice(["success", "slipped"])}
        return replica.patch(f"/objects/box/trials/{chance.choice(rows)['seq']}", json=told)
    if kind == "patch":
        return replica.patch("/objects/box", json={"mass_kg": 0.1 + number / 1_000})
    trials = [
        {"position": [0.0, number * 1e-4, 0.05 + n * 1e-3], "outcome": n % 3 > 0, **DOWN} for n in range(9)
    ]
    return replica.post("/objects/box/trials", json={"trials": trials})


def assert_alike(one: Any, other: Any) -> None:
    """Equal, numbers but for rounding: one may have extended what the other built anew."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for name in one:
            assert_alike(one[name], other[name])
    elif isinstance(one, list):
        assert len(one) == len(other)
        for each, its in zip(one, other, strict=True):
            assert_alike(each, its)
    else:
        assert one == (pytest.approx(other, rel=1e-4, abs=1e-6) if isinstance(other, float) else other)


def test_what_one_replica_was_told_another_answers_from_at_once(pair: list[httpx.Client]) -> None:
    chance = random.Random(7)
    assert pair[0].post("/objects", json={"id": "box", "mass_kg": 0.1}).status_code == 201
    for replica in pair:
        told = {"position": [0.0, 0.0, 0.04], "outcome": True, **DOWN}
        assert replica.post("/objects/box/trials", json=told).status_code == 201
    for number in range(12):
        here, there = chance.sample(pair, 2)
        done = write(here, chance, number)
        assert done.is_success, done.text
        assert_alike(asked_of(there), asked_of(here))


@pytest.fixture(scope="module")
def replicas(postgres_programs: PostgresPrograms) -> Iterator[ReplicaSet]:
    # Not pytest's folder, which PostgreSQL's user can't enter.
    folder = Path(tempfile.mkdtemp(prefix="graspdb-replicas-"))
    guard = Guard(folder)
    found = ReplicaSet(folder, postgres_programs)
    yield found
    found.close()
    guard.close()


@pytest.fixture(scope="module")
def proxy(replicas: ReplicaSet, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("nginx")
    return replicas.begin_proxy(folder)


@pytest.mark.long
def test_replicas_that_start_at_once_migrate_and_seed_once(replicas: ReplicaSet) -> None:
    told = [httpx.get(f"{url}/grippers", params={"limit": 1_000}).json()["items"] for url in replicas.urls]
    assert len({gripper["id"] for gripper in told[0]}) == len(told[0]) >= 2
    assert told[0] == told[1] == told[2]


@pytest.mark.long
def test_the_proxy_reaches_every_replica_and_passes_problems_on(replicas: ReplicaSet, proxy: str) -> None:
    with httpx.Client(base_url=proxy) as http:
        for _ in range(9):
            assert http.get("/objects").is_success
        refused = http.get("/objects/none")
    assert refused.headers["content-type"] == "application/problem+json"
    served = [httpx.get(f"{url}/metrics").text for url in replicas.urls]
    assert all('route="/objects",status="200"' in text for text in served)


class Asker(threading.Thread):
    """Asks one kind of thing of the proxy again and again, without trying anything again itself."""

    def __init__(self, url: str, ask: Callable[[httpx.Client, int], httpx.Response]) -> None:
        super().__init__(daemon=True)
        self._url, self._ask = url, ask
        self.answered = 0
        self.failed: list[str] = []
        self.finish = threading.Event()

    def run(self) -> None:
        with httpx.Client(base_url=self._url, timeout=60) as http:
            number = 0
            while not self.finish.is_set():
                try:
                    answer = self._ask(http, number)
                    if not answer.is_success:
                        self.failed.append(f"{answer.status_code} {answer.text[:300]}")
                except httpx.TransportError as error:
                    self.failed.append(repr(error))
                number += 1
                self.answered = number
                time.sleep(0.005)


def post_batch(http: httpx.Client, number: int, acknowledged: dict[int, dict[str, Any]]) -> httpx.Response:
    trials = [
        {"position": [0.0, number * 1e-5, 0.05 + n * 1e-4], "outcome": n % 3 > 0, **DOWN} for n in range(20)
    ]
    key = {"Idempotency-Key": str(uuid.uuid4())}
    answer = http.post("/objects/box/trials", json={"trials": trials}, headers=key)
    if answer.is_success:
        acknowledged[number] = answer.json()
    return answer


@pytest.mark.long
def test_a_killed_replica_costs_no_acknowledged_trial_and_fails_no_request(
    replicas: ReplicaSet, proxy: str
) -> None:
    with httpx.Client(base_url=proxy, timeout=60) as http:
        assert http.post("/objects", json={"id": "box", "mass_kg": 0.2}).status_code == 201
        acknowledged: dict[int, dict[str, Any]] = {}
        assert post_batch(http, 0, acknowledged).is_success
        question = {"poses": {"position": [[0, 0, 0.05]], "quaternion_xyzw": [[1, 0, 0, 0]]}}
        asked: list[Callable[[httpx.Client, int], httpx.Response]] = [
            lambda http, n: post_batch(http, n + 1, acknowledged),
            lambda http, n: http.get("/objects/box/best-grasp"),
            lambda http, n: http.post("/objects/box/likelihood", json=question),
            lambda http, n: http.get("/objects/box"),
        ]
        askers = [Asker(proxy, ask) for ask in asked]
        for asker in askers:
            asker.start()
        try:
            for number, replica in enumerate(replicas.replicas):
                before = [asker.answered for asker in askers]
                wait(
                    lambda before=before: all(
                        a.answered > n + 20 for a, n in zip(askers, before, strict=True)
                    )
                )
                replica.kill()
                before = [asker.answered for asker in askers]
                wait(
                    lambda before=before: all(
                        a.answered > n + 20 for a, n in zip(askers, before, strict=True)
                    )
                )
                replica.start()
                replicas.wait(number)
        finally:
            for asker in askers:
                asker.finish.set()
            for asker in askers:
                asker.join(60)
        assert [asker.failed for asker in askers] == [[]] * len(askers)
        for url in replicas.urls:
            rows = httpx.get(
                f"{url}/objects/box/trials", headers={"Accept": "application/x-ndjson"}, timeout=60
            )
            stored: dict[str, int] = {}
            for line in rows.text.splitlines():
                batch = json.loads(line)["batch"]
                stored[batch] = stored.get(batch, 0) + 1
            assert stored == {receipt["batch"]: 20 for receipt in acknowledged.values()}


def wait(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 240
    while not condition():
        assert time.monotonic() < deadline, "requests do not get on"
        time.sleep(0.02)

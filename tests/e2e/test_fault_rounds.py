"""Rounds of faults with real processes: after each, everything is as the clients know it to be.

In a round two clients post batches, workers simulate a sweep and one client reads along, while what the
round's seed says fails: processes die or freeze, answers get lost, the disk is full, a clock is set. Round
``n`` alone: ``pytest tests/e2e/test_fault_rounds.py -k "postgres and 17"``.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from sqlalchemy import text

from fault_lab import BOX_M, GRIPPER, PROTOCOL, SOURCE, Follower, Lab, Sender, box_stl
from grid_truth import full_grid, matrices
from postgres_server import PostgresServer
from real_processes import Process, wait_for

QUICK, ALL = 5, 50
STEP_M, ROTATION_STEP_DEG, MARGIN_M = 0.02, 60.0, 0.02
GRID = {"position_step_m": STEP_M, "rotation_step_deg": ROTATION_STEP_DEG, "margin_m": MARGIN_M}


@pytest.fixture(scope="module", params=["sqlite", "postgres"])
def lab(request: pytest.FixtureRequest) -> Iterator[Lab]:
    on_postgres = request.param == "postgres"
    programs = request.getfixturevalue("postgres_programs") if on_postgres else None
    made = Lab(Path(tempfile.mkdtemp(prefix="graspdb-faults-")), programs)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture(autouse=True)
def logs_of_a_failure(lab: Lab, request: pytest.FixtureRequest) -> Iterator[None]:
    failed = request.session.testsfailed
    yield
    if request.session.testsfailed > failed:
        note(lab.logs())


def note(text: str) -> None:
    """Say it where pytest shows it should the test fail."""
    sys.stdout.write(f"{text}\n")


# --- what can fail --------------------------------------------------------------------------------------


Fault = Callable[[random.Random], None]


def faults_of(lab: Lab) -> dict[str, Fault]:
    """Everything that can fail in this lab, by name."""
    processes = {f"service-{n}": replica.process for n, replica in enumerate(lab.replicas)}
    processes |= {f"worker-{n}": worker for n, worker in enumerate(lab.workers)}
    found: dict[str, Fault] = {f"kill {name}": partial(kill, process) for name, process in processes.items()}
    if lab.postgres is not None:
        found["kill postmaster"] = partial(kill_postgres, lab.postgres, whole=True)
        found["kill backend"] = partial(kill_postgres, lab.postgres, whole=False)
        found["freeze postgres"] = partial(freeze, lab.postgres)
    found |= {f"freeze {name}": partial(freeze, process) for name, process in processes.items()}
    found["lose answers"] = partial(lose_answers, lab)
    found["fill the disk"] = partial(fill_the_disk, lab)
    found["set the clock"] = partial(set_the_clock, lab)
    return found


def kill(process: Process, rng: random.Random) -> None:
    """kill -9; what it leaves undone is there for a while."""
    process.kill()
    time.sleep(rng.uniform(0.0, 0.3))


def kill_postgres(server: PostgresServer, rng: random.Random, *, whole: bool) -> None:
    """kill -9 of the postmaster, or of a process of its that serves a connection."""
    backends = server.backends()
    with suppress(ProcessLookupError):  # a connection that was just closed
        os.kill(server.postmaster() if whole or not backends else rng.choice(backends), signal.SIGKILL)
    time.sleep(rng.uniform(0.0, 0.3))


def freeze(target: Process | PostgresServer, rng: random.Random) -> None:
    """SIGSTOP, for longer than a lease or not."""
    target.pause()
    time.sleep(rng.uniform(0.3, 3.0))
    target.resume()


def lose_answers(lab: Lab, rng: random.Random) -> None:
    """Some of the answers that pass the network never arrive."""
    before = lab.proxy.lost
    lab.proxy.lose(rng.uniform(0.2, 0.6), rng.randrange(2**32))
    time.sleep(rng.uniform(0.5, 1.5))
    wait_for("an answer is lost", lambda: lab.proxy.lost > before)


def fill_the_disk(lab: Lab, rng: random.Random) -> None:
    lab.disk.fill(lab.writers())
    time.sleep(rng.uniform(0.3, 1.5))


def set_the_clock(lab: Lab, rng: random.Random) -> None:
    """The time of day of the first service goes hours ahead or back, and later returns."""
    lab.clock.set(rng.choice([-1, 1]) * rng.uniform(0.5, 100.0))
    time.sleep(rng.uniform(0.5, 1.5))


# --- a round --------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::graspdb.resources.trials.DoubtfulTrials")
@pytest.mark.parametrize(
    "seed", [pytest.param(n, marks=[pytest.mark.long] if n >= QUICK else []) for n in range(ALL)]
)
def test_after_faults_everything_is_as_the_clients_know_it(lab: Lab, seed: int) -> None:
    rng = random.Random(seed)
    faults = faults_of(lab)
    # The quick rounds share all that can fail between them, so that no run leaves anything out.
    plan = sorted(faults)[seed::QUICK] if seed < QUICK else rng.choices(sorted(faults), k=4)
    slug = f"round-{seed}"
    note(f"round {seed}: {', '.join(plan)}")
    started = time.monotonic()
    lab.heal()
    assert lab.http.post("/objects", json={"id": slug, "mass_kg": 0.16}).status_code == 201
    mesh = lab.http.put(f"/objects/{slug}/mesh", content=box_stl(), headers={"Content-Type": "model/stl"})
    assert mesh.is_success, mesh.text
    made = lab.http.post(f"/objects/{slug}/sweeps", json={"grid": GRID, "chunk_poses": 150})
    assert made.status_code == 202, made.text
    senders = [
        Sender(0, lab.proxy.url, slug, retrying=True),
        Sender(1, lab.replicas[-1].url, slug, retrying=False),
    ]
    follower = Follower(lab.replicas[-1].url, slug)
    try:
        for thread in (*senders, follower):
            thread.start()
        for name in plan:
            before = [sender.acknowledged() for sender in senders]
            wait_for(
                "both senders get on",
                lambda before=before: all(
                    sender.error or sender.acknowledged() > n
                    for sender, n in zip(senders, before, strict=True)
                ),
            )
            faults[name](rng)
            lab.heal()
            posted = [sender.acknowledged() for sender in senders]
            note(f"  {time.monotonic() - started:.1f} s, {name} is over: {posted} batches acknowledged")
        sweep = f"/sweeps/{made.json()['id']}"
        state = wait_for(
            "the sweep ends",
            # A 503 of a database that recovers has no state.
            lambda: (
                (now := lab.http.get(sweep).json()).get("state") in ("done", "failed", "cancelled") and now
            ),
            every=0.1,
        )
        for sender in senders:
            sender.finish.set()
            sender.join(120)
            assert sender.error is None, sender.error
        assert (state["state"], state["failed_chunks"]) == ("done", [])
        check(lab, slug, state, senders, follower)
    finally:
        for thread in (*senders, follower):
            thread.close()
    assert lab.http.delete(f"/objects/{slug}").is_success


@pytest.mark.parametrize("lab", ["postgres"], indirect=True)
def test_two_replicas_are_one_service(lab: Lab) -> None:
    """What one has stored the other knows; jobs are given out once; a dead one's report is taken over."""
    lab.heal()
    first, second = (replica.http for replica in lab.replicas)
    assert first.post("/objects", json={"id": "shared", "mass_kg": 0.16}).status_code == 201
    for number in range(10):
        one, other = (first, second) if number % 2 else (second, first)
        receipt = one.post("/objects/shared/trials", json=successes(800, number)).json()
        assert other.get(f"/objects/shared/batches/{receipt['batch']}").json()["inserted"] == 800
        density = other.get("/objects/shared/density").json()
        assert (density["revision"], density["size"]) == (receipt["revision"], 800 * (number + 1))

    report = "/objects/shared/reports/convergence"
    asked = [http.get(report) for http in (first, second)]
    assert [answer.status_code for answer in asked] == [202, 202]
    (run,) = {answer.headers["location"] for answer in asked}
    lab.replicas[0].process.kill()
    assert second.get(run).json()["state"] == "running"
    with lab.database.write() as tx:  # as if the dead replica's lease had run out
        tx.execute(text("UPDATE report_runs SET lease_expires_at = 0"))
    done = wait_for("the other replica takes over", lambda: done_run(second, run), every=0.1)
    lab.heal()
    assert first.get(run).json()["result"] == done["result"]

    mesh = first.put("/objects/shared/mesh", content=box_stl(), headers={"Content-Type": "model/stl"})
    assert mesh.is_success, mesh.text
    for worker in lab.workers:
        worker.pause()
    sweep = first.post("/objects/shared/sweeps", json={"grid": GRID, "chunk_poses": 50}).json()
    with ThreadPoolExecutor(8) as pool:
        claimed = [*chain(*pool.map(lambda n: claim_all([first, second][n % 2], f"c{n}"), range(8)))]
    assert len(set(claimed)) == len(claimed)
    # A worker that was paused with a claim on its way may have got one, too.
    assert sweep["chunks"] - len(lab.workers) <= len(claimed) <= sweep["chunks"]
    assert second.post(f"/sweeps/{sweep['id']}/cancel").json()["state"] == "cancelled"
    lab.heal()
    assert first.delete("/objects/shared").is_success


def successes(count: int, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    turns = rng.normal([1.0, 0.0, 0.0, 0.0], 0.1, (count, 4))
    columns = {
        "position": rng.normal(0.0, 0.01, (count, 3)).tolist(),
        "quaternion_xyzw": (turns / np.linalg.norm(turns, axis=1, keepdims=True)).tolist(),
        "outcome": [True] * count,
    }
    return {"columns": columns, "gripper": GRIPPER, "source": SOURCE, "protocol": PROTOCOL}


def done_run(http: httpx.Client, run: str) -> dict[str, Any] | None:
    now: dict[str, Any] = http.get(run).json()
    assert now["state"] in ("running", "done"), now
    return now if now["state"] == "done" else None


def claim_all(http: httpx.Client, worker: str) -> list[str]:
    """Ids of jobs that a worker gets, until there is none left."""
    got: list[str] = []
    body = {"worker": worker, "capabilities": ["simulate"], "limit": 3}
    while jobs := http.post("/jobs/claim", json=body).json()["jobs"]:
        got += [job["id"] for job in jobs]
    return got


# --- what must hold -------------------------------------------------------------------------------------


def check(lab: Lab, slug: str, sweep: dict[str, Any], senders: list[Sender], follower: Follower) -> None:
    rows = stored_trials(lab, slug)
    for sender in senders:
        check_batches(sender, rows)
        receipts = [sent.receipt["revision"] for sent in sender.sent if sent.receipt is not None]
        assert receipts == sorted(set(receipts)), "one client's batches, one after the other"
        sender.settle()
        check_again(sender)
    settled = stored_trials(lab, slug)
    assert settled[: len(rows)] == rows, "what was stored stays as it was"
    for sender in senders:
        check_batches(sender, settled)
    check_sweep(lab, sweep, settled)
    check_counts(lab, slug, sweep, settled)
    check_times(lab, slug, sweep)
    follower.finish.set()
    follower.join(120)
    follower.look()
    assert sorted(follower.seen) == [(row["seq"], row["revision"]) for row in settled]
    with lab.database.read() as tx:
        assert tx.scalar(text("SELECT count(*) FROM jobs WHERE state NOT IN ('done', 'cancelled')")) == 0


def stored_trials(lab: Lab, slug: str) -> list[dict[str, Any]]:
    """Every row, in commit order; the same of every replica."""
    answers = []
    for replica in lab.replicas:
        answer = replica.http.get(f"/objects/{slug}/trials", headers={"Accept": "application/x-ndjson"})
        assert answer.status_code == 200, answer.text
        answers.append([json.loads(line) for line in answer.text.splitlines()])
    rows = answers[0]
    assert all(other == rows for other in answers)
    revisions = [row["revision"] for row in rows]
    assert revisions == sorted(revisions)
    assert [row["seq"] for row in rows] == sorted({row["seq"] for row in rows})
    return rows


def check_batches(sender: Sender, rows: list[dict[str, Any]]) -> None:
    """What was acknowledged is there whole and once, what was refused is not; of the rest all or nothing."""
    found: dict[int, list[dict[str, Any]]] = {}
    for row in rows:
        if row["sweep"] is None and round(row["position"][2] * 100) == 6 + sender.number:
            found.setdefault(round(row["position"][0] * 1e4), []).append(row)
    for batch, stored in found.items():
        outcomes = [row["outcome"] == "success" for row in sorted(stored, key=lambda row: row["position"][1])]
        assert outcomes == sender.outcomes(batch), f"batch {batch}"
        assert len({(row["batch"], row["revision"]) for row in stored}) == 1, f"batch {batch}"
    for batch, sent in enumerate(sender.sent):
        name = None if sent.receipt is None else (sent.receipt["batch"], sent.receipt["revision"])
        if name is not None:
            assert batch in found, f"batch {batch} was acknowledged"
            assert (found[batch][0]["batch"], found[batch][0]["revision"]) == name
        elif sent.refusal is not None:
            assert batch not in found, sent.refusal
    assert found.keys() <= set(range(len(sender.sent)))


def check_again(sender: Sender) -> None:
    """A batch sent once more is answered as before, also through the other replica; another body is not."""
    for batch in {0, len(sender.sent) // 2, len(sender.sent) - 1}:
        sent = sender.sent[batch]
        assert sent.receipt is not None
        first = dict(sent.receipt)
        sender.send(batch)
        assert {name: sent.receipt[name] for name in first} == first
    other = sender.post((len(sender.sent) - 1) // 2 + 1, sender.sent[0].key) if len(sender.sent) > 1 else None
    assert other is None or other.status_code == 422, other.text


def check_times(lab: Lab, slug: str, sweep: dict[str, Any]) -> None:
    """All replicas write down the database's time, whatever their own clocks say."""
    if lab.postgres is None:
        return  # the clock of a SQLite database is the service's
    batches = lab.http.get(f"/objects/{slug}/batches", params={"limit": 1_000}).json()["items"]
    times = [batch["created_at"] for batch in batches]
    times += [sweep[name] for name in ("created_at", "started_at", "finished_at")]
    times.append(lab.http.get(f"/objects/{slug}").json()["updated_at"])
    now = datetime.now(UTC)
    assert all(abs((datetime.fromisoformat(each) - now).total_seconds()) < 1_200 for each in times)


def check_sweep(lab: Lab, sweep: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    """Every pose of the grid has one outcome and the right pose; those that met physics have one row."""
    grid = full_grid(BOX_M, STEP_M, ROTATION_STEP_DEG, MARGIN_M)
    found = lab.http.get(f"/sweeps/{sweep['id']}/outcomes", params={"limit": 100_000}).json()
    index = found["pose_index"]
    assert found["next"] is None
    assert len(index) == len(set(index)) == sweep["poses"]
    assert set(index) == set(grid)
    np.testing.assert_allclose(found["position"], [grid[i][0] for i in index], atol=1e-12)
    rotations = matrices(np.array(found["quaternion_xyzw"]))
    np.testing.assert_allclose(rotations, [grid[i][1] for i in index], atol=1e-12)
    outcome = dict(zip(index, found["outcome"], strict=True))
    assert {"success", "collision"} < set(outcome.values())
    assert Counter(outcome.values()) == Counter(sweep["outcomes"])
    swept = [row for row in rows if row["sweep"] is not None]
    stored = [row["pose_index"] for row in swept]
    assert len(set(stored)) == len(stored)
    assert [outcome[i] for i in stored] == [row["outcome"] for row in swept]
    np.testing.assert_allclose([row["position"] for row in swept], [grid[i][0] for i in stored], atol=1e-12)
    # What has no row is what geometry alone decided.
    assert {outcome[i] for i in outcome.keys() - set(stored)} <= {"collision", "missed"}


def check_counts(lab: Lab, slug: str, sweep: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    """Tallies equal rows and packed outcomes; the density is of the successes."""
    posted = Counter(row["outcome"] for row in rows if row["sweep"] is None)
    for replica in lab.replicas:
        info = replica.http.get(f"/objects/{slug}").json()
        assert info["outcomes"] == dict(posted + Counter(sweep["outcomes"]))
        assert info["revision"] == max(row["revision"] for row in rows) or len(rows) < info["trials"]
        density = replica.http.get(f"/objects/{slug}/density").json()
        assert density["size"] == info["outcomes"]["success"], density
        assert density["revision"] == info["revision"]
    query = text(
        "SELECT p.id, t.outcome, t.row_count, (SELECT count(*) FROM trials r"
        " WHERE r.provenance_id = p.id AND r.outcome = t.outcome) AS rows"
        " FROM tallies t JOIN provenances p ON p.id = t.provenance_id"
    )
    with lab.database.read() as tx:
        assert [row for row in tx.execute(query) if row.row_count != row.rows] == []

"""Kernels of as many components as held-out displacements favour: fitted by runs that outlast the answer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb.wire.kernels import KernelCreate
from graspdb.wire.queries import TrialSelection
from graspdb_density import se3
from graspdb_density.bandwidth import mixture_fit
from graspdb_service.api.context import Context
from graspdb_service.principal import Actor
from graspdb_service.settings import Settings
from graspdb_service.storage import report_runs
from graspdb_service.storage.database import Database
from graspdb_service.usecases.kernels import fit

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]
Serve = Callable[..., str]
AUTO = {"object": "thing", "components": "auto"}


@pytest.fixture(scope="module")
def grasps() -> Poses:
    """Successes of a narrow and a wide part."""
    rng = np.random.default_rng(0)
    scale = np.where(rng.random((70, 1)) < 0.5, 1.0, 3.5)
    xi = rng.standard_normal((70, 6)) * scale * np.array([0.006, 0.003, 0.004, 0.05, 0.1, 0.05])
    return xi[:, :3], se3.from_rotation_vector(xi[:, 3:])


@pytest.fixture
def http(
    database_url: str, serve: Serve, make_object: Make, post: Post, grasps: Poses,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[httpx.Client]:  # fmt: skip
    """A service that waits for nothing, and does not try more than two components."""
    monkeypatch.setattr(mixture_fit, "_TRIED_COMPONENTS", (1, 2))
    with httpx.Client(base_url=serve(database_url, report_wait_s=0), timeout=60) as client:
        make_object(client)
        post(client, "thing", grasps)
        yield client


def ended(http: httpx.Client, location: str) -> dict[str, Any]:
    """The run once it is not under way any more."""
    deadline = time.monotonic() + 240
    while True:
        answer = http.get(location)
        assert answer.status_code == 200, answer.text
        run: dict[str, Any] = answer.json()
        if run["state"] != "running":
            return run
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_a_long_fit_is_answered_with_its_run(http: httpx.Client, serve: Serve, database_url: str) -> None:
    key = {"Idempotency-Key": "once"}
    answer = http.post("/kernels", json=AUTO, headers=key)
    assert answer.status_code == 202, answer.text
    location, run = answer.headers["location"], answer.json()
    assert location == f"/report-runs/{run['id']}"
    assert (run["object"], run["report"], run["state"], run["result"]) == ("thing", "kernel", "running", None)
    # The same request joins it, another with the same key is refused.
    again = http.post("/kernels", json=AUTO, headers=key)
    assert again.headers["location"] in (location, f"/kernels/{run['id']}")
    assert http.post("/kernels", json={**AUTO, "gripper": "pg70"}, headers=key).status_code == 422
    assert http.post("/kernels", json={"object": "thing"}, headers=key).status_code == 422
    done = ended(http, location)
    assert (done["state"], done["progress"]) == ("done", 1.0)
    kernel = done["result"]
    assert kernel == http.get(f"/kernels/{run['id']}").json()
    likelihoods = kernel["provenance"]["likelihood_by_components"]
    assert likelihoods.keys() == {"1", "2"}
    assert kernel["provenance"]["successes"] == 70
    assert [item["id"] for item in http.get("/kernels").json()["items"]] == [kernel["id"]]
    # Asked once more with its key it is the kernel, from any process; without, it is another kernel.
    with httpx.Client(base_url=serve(database_url, report_wait_s=60), timeout=90) as patient:
        same = patient.post("/kernels", json=AUTO, headers=key)
        assert (same.status_code, same.headers["location"]) == (201, f"/kernels/{kernel['id']}")
        assert same.json() == kernel
        other = patient.post("/kernels", json=AUTO)
        assert other.status_code == 201, other.text
    assert other.json()["components"] == kernel["components"]
    assert len(http.get("/kernels").json()["items"]) == 2
    # Queries know it, and its run goes with it.
    assert http.get("/objects/thing/density", params={"kernel": kernel["id"]}).status_code == 200
    assert http.delete(f"/kernels/{kernel['id']}").status_code == 204
    assert http.get(location).status_code == 404


def test_a_cancelled_fit_makes_no_kernel(http: httpx.Client) -> None:
    location = http.post("/kernels", json=AUTO).headers["location"]
    cancelled = http.post(f"{location}/cancel").json()
    assert cancelled["state"] == "cancelled"
    # What comes after it has its turn: the cancelled one has ended by then.
    last = http.post("/kernels", json=AUTO).headers["location"]
    assert ended(http, last)["state"] == "done"
    assert ended(http, location)["result"] is None
    assert [item["id"] for item in http.get("/kernels").json()["items"]] == [last.rpartition("/")[2]]


def test_what_cannot_be_fitted_is_said(http: httpx.Client, make_object: Make, post: Post) -> None:
    assert http.post("/kernels", json={**AUTO, "object": "other"}).status_code == 404
    fields = http.post("/kernels", json={**AUTO, "kind": "sampled"}).json()["errors"]
    assert [item["field"] for item in fields] == ["components"]
    make_object(http, "few")
    post(http, "few", (np.zeros((3, 3)), se3.random_quaternions(3, np.random.default_rng(0))))
    run = ended(http, http.post("/kernels", json={**AUTO, "object": "few"}).headers["location"])
    assert run["state"] == "failed"
    assert run["problem"]["type"].endswith("too-few-trials")
    assert "there are 3, so 47 more are needed" in run["problem"]["title"]


def test_a_dead_processs_fit_is_taken_over(http: httpx.Client, database_url: str) -> None:
    context = Context.create(Settings(database_url=database_url), Database(database_url))
    row = context.densities.selections.resolve("thing", TrialSelection()).row
    request = KernelCreate.model_validate(AUTO)
    with context.database.write() as tx:
        report_runs.ask(tx, fit.run_key(row, "mine", request, Actor(key="robot")), id="mine", lease_id="gone")
        report_runs.release(tx, "mine", "gone")
    run = ended(http, "/report-runs/mine")
    assert run["state"] == "done"
    assert run["result"]["id"] == "mine"
    assert [item["id"] for item in http.get("/kernels").json()["items"]] == ["mine"]
    # The process that computes it did not ask for it.
    assert http.get("/audit?action=kernel.create").json()["items"][0]["key"] == "robot"
    context.close()

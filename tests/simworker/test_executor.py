"""Chunks handed to an executor: a real pool of processes, each with its pybullet child."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any

import pytest
from distributed import Client, LocalCluster

from graspdb.examples import example
from graspdb.wire import SimulatePayload
from graspdb_simworker.process.executor import ExecutorRunner
from graspdb_simworker.process.local import LocalRunner
from graspdb_simworker.process.runner import ChunkCancelled, ChunkFailed

MakePayload = Callable[..., SimulatePayload]


@pytest.fixture
def pool() -> Iterator[ProcessPoolExecutor]:
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


def test_a_pool_of_processes_gives_the_same_bytes_and_outlives_a_bad_chunk(
    pool: ProcessPoolExecutor, payload_of: MakePayload
) -> None:
    parts = example("mug").parts_glb()
    payload = payload_of("mug", start=0, stop=300)
    with ExecutorRunner(pool) as runner:
        first = runner.run(payload, parts)
        with pytest.raises(ChunkFailed, match="GLB"):
            runner.run(payload.model_copy(update={"parts_sha256": "other"}), b"no parts")
        again = runner.run(payload, parts)
    with LocalRunner() as here:
        assert first == again == here.run(payload, parts)
    assert first.rows.pose_index


def test_a_dask_cluster_is_an_executor_like_any_other(payload_of: MakePayload) -> None:
    parts = example("mug").parts_glb()
    payload = payload_of("mug", start=0, stop=300)
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
        client.get_executor() as executor,
        ExecutorRunner(executor) as runner,
        LocalRunner() as here,
    ):
        assert runner.run(payload, parts) == here.run(payload, parts)


def test_a_pool_whose_processes_die_fails_the_chunk_and_not_the_worker(payload_of: MakePayload) -> None:
    with ProcessPoolExecutor(1) as pool, ExecutorRunner(pool) as runner:
        pool.submit(os._exit, 3)
        with pytest.raises(ChunkFailed, match=r"BrokenProcessPool|takes no chunks"):
            runner.run(payload_of("mug", start=0, stop=10), b"")


def test_what_is_not_wanted_any_more_leaves_the_queue(payload_of: MakePayload) -> None:
    taken: list[Future[Any]] = []

    class Busy(ThreadPoolExecutor):
        def submit(self, *call: Any, **options: Any) -> Future[Any]:
            taken.append(Future())  # queued behind others
            return taken[-1]

    with Busy() as busy, ExecutorRunner(busy) as runner:
        asked = iter((True, True, False))
        with pytest.raises(ChunkCancelled):
            runner.run(payload_of("mug", start=0, stop=10), b"", wanted=lambda: next(asked))
    assert taken[0].cancelled()

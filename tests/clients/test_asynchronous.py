"""The asynchronous client against the real service: the same names, the same answers, many at once."""

from __future__ import annotations

import asyncio
import inspect
import uuid
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest
import trimesh

from graspdb import AsyncClient, Client, GraspDBError, Infeasible, asynchronous
from graspdb.reports import AllReports, Reports
from graspdb.resources.answers import Answers
from graspdb.resources.grippers import Grippers
from graspdb.resources.kernels import Kernels
from graspdb.resources.objects import GraspObject, Objects
from graspdb.resources.pages import Listing
from graspdb.resources.sweeps import Sweep, Sweeps
from graspdb.resources.trials import Batches, TrialListing, Trials

MIRRORS = {
    Client: asynchronous.AsyncClient,
    Objects: asynchronous.AsyncObjects,
    GraspObject: asynchronous.AsyncGraspObject,
    Trials: asynchronous.AsyncTrials,
    TrialListing: asynchronous.AsyncTrialListing,
    Listing: asynchronous.AsyncListing,
    Batches: asynchronous.AsyncBatches,
    Reports: asynchronous.AsyncReports,
    AllReports: asynchronous.AsyncAllReports,
    Sweeps: asynchronous.AsyncSweeps,
    Sweep: asynchronous.AsyncSweep,
    Grippers: asynchronous.AsyncGrippers,
    Answers: asynchronous.AsyncAnswers,
    Kernels: asynchronous.AsyncKernels,
}
#: How the synchronous client waits and pages: nothing that a program calls.
INNER = {(Sweep, "pauses"), (Sweep, "summary"), (Listing, "pages"), (TrialListing, "pages")}
DOWN = [1.0, 0.0, 0.0, 0.0]


def run(url: str, program: Callable[[AsyncClient], Awaitable[Any]]) -> Any:
    async def main() -> Any:
        async with AsyncClient(url) as db:
            return await program(db)

    return asyncio.run(main())


@pytest.mark.parametrize("sync", MIRRORS, ids=lambda c: c.__name__)
def test_everything_public_is_mirrored_with_its_parameters(sync: type) -> None:
    mirror = MIRRORS[sync]
    for name, member in inspect.getmembers(sync):
        if name.startswith("_") or (sync, name) in INNER:
            continue
        other = getattr(mirror, name, None)
        assert other is not None, f"{mirror.__name__}.{name} is missing"
        if inspect.isfunction(member):
            assert inspect.isfunction(other)
            ours = [p for p in inspect.signature(other).parameters if p != "self"]
            theirs = [p for p in inspect.signature(member).parameters if p != "self"]
            assert ours == theirs or ours == ["filters"], f"{mirror.__name__}.{name}"


def test_many_questions_at_once_have_the_answers_of_the_synchronous_client(
    service_url: str, db: Client, fresh_id: str
) -> None:
    async def program(client: AsyncClient) -> None:
        item = await client.objects.create(fresh_id, name="async")
        rng = np.random.default_rng(0)
        poses = np.concatenate([rng.normal(scale=0.01, size=(60, 3)), np.tile(DOWN, (60, 1))], axis=1)
        receipt = await item.trials.add(poses, "success", gripper="pg70", source="robot")
        assert receipt.inserted == 60
        await item.refresh()
        assert item.info.trials == 60
        boxes = [([-0.1, -0.1, z], [0.1, 0.1, 0.1]) for z in np.linspace(-0.01, 0.01, 12)]
        found = await asyncio.gather(*(item.best_grasp(box=box) for box in boxes))
        same = db.objects.get(fresh_id)
        for box, grasp in zip(boxes, found, strict=True):
            assert np.allclose(grasp.position, same.best_grasp(box=box).position)
        assert len([trial async for trial in item.trials]) == 60
        assert len(await item.trials.list(outcome="success").first(7)) == 7
        assert (await item.trials.list().arrays()).success.all()
        assert [batch.inserted async for batch in item.batches] == [60]
        assert fresh_id in [other.id async for other in client.objects]
        assert {"pg70", "panda"} <= {gripper.id async for gripper in client.grippers}
        with pytest.raises(Infeasible):
            await item.best_grasp(box=([1, 1, 1], [2, 2, 2]))
        with pytest.raises(GraspDBError):
            await client.objects.get(f"no-{uuid.uuid4().hex}")
        await item.delete()

    run(service_url, program)
    assert fresh_id not in [item.id for item in db.objects]


def test_a_wait_can_be_cancelled_and_times_out(service_url: str, fresh_id: str) -> None:
    async def program(client: AsyncClient) -> None:
        box = trimesh.creation.box([0.03, 0.04, 0.1])
        item = await client.objects.create(fresh_id, mesh=box, convex_parts=[box], mass_kg=0.1)
        sweep = await item.sweep()  # millions of poses
        with pytest.raises(TimeoutError, match=sweep.id):
            await sweep.wait(timeout=0.1)
        waiting = asyncio.create_task(sweep.wait())
        await asyncio.sleep(0.2)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        await sweep.cancel()
        assert (await sweep.wait(timeout=30)).state == "cancelled"
        assert [found.id async for found in item.sweeps()] == [sweep.id]

    run(service_url, program)

"""Fits that outlast their answer: the SDK waits for them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np
import pytest

from graspdb import AsyncClient, Client
from graspdb.errors import Conflict
from graspdb.wire.reports import ReportRun
from graspdb_density import se3
from graspdb_density.bandwidth import mixture_fit

Serve = Callable[..., str]


def test_fits_are_waited_for(sqlite_url: str, serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mixture_fit, "_TRIED_COMPONENTS", (1, 2))
    url = serve(sqlite_url, report_wait_s=0)
    rng = np.random.default_rng(0)
    turns = se3.from_rotation_vector(0.2 * rng.standard_normal((60, 3)))
    poses = np.concatenate([0.01 * rng.standard_normal((60, 3)), turns], axis=1)
    with Client(url) as db:
        db.objects.create(id="thing").trials.add(poses, True)
        seen: list[ReportRun] = []
        made = db.kernels.fit("thing", components="auto", progress=seen.append)
        assert made == db.kernels.get(made.id)
        assert made.provenance.likelihood_by_components
        assert {run.report for run in seen} == {"kernel"}
        with pytest.raises(TimeoutError, match="it goes on"):
            db.kernels.fit("thing", components="auto", timeout_s=0)
        db.objects.create(id="few").trials.add(poses[:3], True)
        with pytest.raises(Conflict, match="47 more are needed"):
            db.kernels.fit("few", components="auto")

    async def fitted() -> str:
        async with AsyncClient(url) as db:
            return (await db.kernels.fit("thing", components="auto")).id

    assert asyncio.run(fitted()) != made.id

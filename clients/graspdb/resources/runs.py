"""Waiting for what the service computes after its answer."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import httpx

from graspdb import wire
from graspdb.errors import GraspDBError, error_for
from graspdb.transport import Transport
from graspdb.wire.reports import ReportRun

RunProgress = Callable[[ReportRun], None]
"""Called with a run while it is waited for."""

_POLL_S = 0.5


def computed(
    transport: Transport,
    answer: httpx.Response,
    what: str,
    progress: RunProgress | None,
    timeout_s: float | None,
) -> Any:
    """What was answered, or (202) the result of the run that computes it; the typed error that it ended with.

    ``what`` it is, for messages. TimeoutError after ``timeout_s``, which does not end the run.
    """
    if answer.status_code != 202:
        return answer.json()
    began = time.monotonic()
    while True:
        run = transport.model(ReportRun, "GET", answer.headers["Location"])
        if progress is not None:
            progress(run)
        if run.result is not None:
            return run.result
        if run.problem is not None:
            raise error_for(wire.Problem.model_validate(run.problem))
        if run.state != "running":
            raise GraspDBError(f"{what} was {run.state}: ask again to compute it anew")
        if timeout_s is not None and time.monotonic() - began > timeout_s:
            raise TimeoutError(f"{what} is {run.progress:.0%} done after {timeout_s:g} s; it goes on")
        time.sleep(_POLL_S)

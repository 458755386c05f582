"""What one request took, kept while it is answered, in whichever of its threads."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Literal

from prometheus_client import Histogram

from graspdb_service.telemetry import traces

Phase = Literal["queue", "compute", "database"]

_PHASES = Histogram(
    "graspdb_phase_seconds",
    "What a request waits for a processor (queue), computes, or spends in transactions of the database.",
    ["phase"],
)


@dataclass
class RequestRecord:
    """A request under way: what the middlewares noted of it (its id, its key), and seconds by phase."""

    state: dict[str, Any]
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))

    def names(self) -> dict[str, str]:
        """The request's id and, where there is one, its key's id and name."""
        found = {"request_id": str(self.state.get("request_id", ""))}
        if "key_id" in self.state:
            found |= {"key_id": str(self.state["key_id"]), "key": str(self.state.get("key", ""))}
        return found


RECORD: ContextVar[RequestRecord | None] = ContextVar("graspdb_request", default=None)


@contextmanager
def timed(phase: Phase) -> Iterator[None]:
    """Count what this takes as a phase of the request that is being answered, if one is."""
    started = time.perf_counter()
    with traces.span(phase):
        try:
            yield
        finally:
            took = time.perf_counter() - started
            _PHASES.labels(phase).observe(took)
            record = RECORD.get()
            if record is not None:
                record.seconds[phase] += took

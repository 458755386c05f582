"""What can become of a job and its lease, a sweep, a report run: the states and who moves between them."""

from __future__ import annotations

from enum import Enum
from typing import Annotated

from pydantic import GetPydanticSchema
from pydantic_core import core_schema


class _State(str, Enum):
    """A string, as ``StrEnum`` makes one, which Python 3.10 does not have."""

    __str__ = str.__str__

    def __format__(self, spec: str) -> str:
        return format(self.value, spec)


class JobState(_State):
    """A job, and with it its lease.

    ::

        (new) -> WAITING -> QUEUED <-> LEASED -> DONE
                    |          |         |-----> FAILED
                    '----------+---------+-----> CANCELLED

    - new to WAITING: a sweep is planned while its object has no convex parts yet; else new to QUEUED.
    - WAITING to QUEUED: a decomposition stored the parts; to FAILED: it failed.
    - QUEUED to LEASED: a worker claims; so it may once a lease has run out and attempts are left.
    - LEASED to LEASED: the worker renews its lease, and may even after it ran out, until another claims.
    - LEASED to QUEUED: the worker gives the job back, or reports a failure with attempts left.
    - LEASED to DONE: the worker hands in the result, under a lease that is still the job's, run out or not.
    - LEASED to FAILED: the worker reports its last failure, or the last lease allowed has run out.
    - WAITING, QUEUED, LEASED to CANCELLED: somebody cancels the sweep; the worker learns it as it renews.
    - FAILED, CANCELLED to QUEUED or WAITING: somebody retries the sweep or asks for the decomposition again.
    """

    WAITING = "waiting"
    QUEUED = "queued"
    LEASED = "leased"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class SweepState(_State):
    """A sweep, as its chunks' jobs make it; only CANCELLED is somebody's decision.

    - new to QUEUED; to RUNNING: a worker claims the first of its chunks.
    - RUNNING to DONE or FAILED: the last chunk has ended, and none or some of them failed.
    - QUEUED to FAILED: the decomposition that it waits for failed.
    - QUEUED, RUNNING to CANCELLED: somebody cancels; what is stored stays.
    - FAILED, CANCELLED to QUEUED or RUNNING: somebody retries its failed and cancelled chunks.
    """

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class RunState(_State):
    """A report's run, computed by the replica that holds its lease.

    - new to RUNNING: a report takes long; RUNNING to RUNNING: another replica takes a lease that ran out.
    - RUNNING to DONE or FAILED: the replica stores the report, or the problem that it answers with.
    - RUNNING to CANCELLED: somebody cancels; the replica learns it as it renews.
    - CANCELLED, and FAILED without a problem, to RUNNING: the report is asked for again.
    """

    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


def _one_of(states: type[_State]) -> GetPydanticSchema:
    """A field that holds one of the states, and names their values in the OpenAPI document."""
    values = core_schema.literal_schema([state.value for state in states])
    schema = core_schema.no_info_after_validator_function(states, values)
    return GetPydanticSchema(lambda _source, _handler: schema)


# Declared as strings: FastAPI would list enums among the document's schemas.
AnySweepState = Annotated[str, _one_of(SweepState)]
AnyRunState = Annotated[str, _one_of(RunState)]

"""Errors that the SDK raises: each carries the service's problem, if it answered one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from graspdb.wire import FieldError, Problem, RobotReach
from graspdb.wire.reports import CheckCall
from graspdb.wire.sweeps import FailedChunk


class GraspDBError(Exception):
    """Base of every error of this package."""

    def __init__(self, message: str, *, problem: Problem | None = None) -> None:
        super().__init__(message)
        self.problem = problem

    @property
    def status(self) -> int | None:
        """The HTTP status, or None if no answer came."""
        return None if self.problem is None else self.problem.status

    @property
    def fields(self) -> list[FieldError]:
        """The fields the service names, each with what is wrong with it."""
        return [] if self.problem is None else self.problem.errors


def add_note(error: BaseException, note: str) -> None:
    """As ``error.add_note``, which Python 3.10 does not have: there only the command line shows notes."""
    vars(error)["__notes__"] = [*getattr(error, "__notes__", ()), note]


class Unreachable(GraspDBError):
    """No service answered at that address."""


class InvalidInput(GraspDBError):
    """400, 415 or 422: the request is wrong; ``fields`` says where."""


class AuthenticationError(GraspDBError):
    """401: no API key was sent, or one that is unknown, expired or revoked."""


class PermissionDenied(GraspDBError):
    """403: the key lacks a scope (``scopes`` names those of which one suffices), or is limited to others'
    objects.
    """

    @property
    def scopes(self) -> tuple[str, ...]:
        """The scopes of which the request needs one; empty where it was refused for something else."""
        extra = {} if self.problem is None else self.problem.model_extra or {}
        return tuple(extra.get("required_scopes", ()))


class NotFound(GraspDBError):
    """404: no such resource."""


class Conflict(GraspDBError):
    """409: the resource's state does not allow it now."""


class AmbiguousSelection(Conflict):
    """409: several grippers or protocols have trials, and none was named."""


class ChecksNeeded(Conflict):
    """409: a report compares simulated draws that are not there yet; ``calls`` are the sweeps that make them.

    ``mug.reports.simulate(error.calls)`` makes those sweeps.
    """

    @property
    def calls(self) -> list[CheckCall]:
        """The sweeps, of purpose ``check``."""
        extra = {} if self.problem is None else self.problem.model_extra or {}
        return [CheckCall.model_validate(call) for call in extra.get("calls", [])]


class LeaseLost(Conflict):
    """409: the job's lease is another worker's now, or the job was cancelled."""


class TooLarge(GraspDBError):
    """413: over a stated limit."""


class TooManyRequests(GraspDBError):
    """429: the service is busy; try again later."""


class RateLimited(TooManyRequests):
    """429: the key asked too often, and went on after the pauses that the service named."""


class ServiceError(GraspDBError):
    """5xx: the service failed."""


class DeadlineExceeded(ServiceError):
    """503: no answer within ``timeout_s``, or within what the service allows."""


class Infeasible(GraspDBError):
    """No admissible grasp lies within any kernel's reach, or the object has no success yet.

    ``nearest`` is the closest grasp outside the constraints, where there is one; ``conflict`` names the
    fewest constraints found that exclude each other, and ``relax`` a value of each that would do; ``reach``
    is why a robot's arm takes none, where it is the arm that does not.
    """

    def __init__(
        self,
        message: str,
        *,
        nearest: object | None = None,
        conflict: Sequence[str] = (),
        relax: Mapping[str, bool | float | list[float]] | None = None,
        reach: RobotReach | None = None,
    ) -> None:
        super().__init__(message)
        self.nearest = nearest
        self.conflict = tuple(conflict)
        self.relax = dict(relax or {})
        self.reach = reach


class SweepFailed(GraspDBError):
    """Chunks of a sweep failed for good; ``failed_chunks`` says which and why."""

    def __init__(self, message: str, *, failed_chunks: list[FailedChunk] | None = None) -> None:
        super().__init__(message)
        self.failed_chunks = failed_chunks or []


Unauthorized = AuthenticationError
Forbidden = PermissionDenied

_BY_TYPE: dict[str, type[GraspDBError]] = {
    "ambiguous-selection": AmbiguousSelection,
    "checks-needed": ChecksNeeded,
    "deadline": DeadlineExceeded,
    "lease-lost": LeaseLost,
    "rate-limited": RateLimited,
}
_BY_STATUS: dict[int, type[GraspDBError]] = {
    401: AuthenticationError,
    403: PermissionDenied,
    404: NotFound,
    409: Conflict,
    413: TooLarge,
    429: TooManyRequests,
}


def error_for(problem: Problem) -> GraspDBError:
    """The exception that stands for a problem, its message complete with fields and request id."""
    lines = [problem.title if problem.detail is None else f"{problem.title}: {problem.detail}"]
    lines += [f"  {item.field}: {item.message}" for item in problem.errors]
    if problem.request_id:
        lines.append(f"  (request {problem.request_id})")
    name = problem.type.rsplit(":", 1)[-1].rsplit("/", 1)[-1]
    kind = _BY_TYPE.get(name) or _BY_STATUS.get(problem.status)
    if kind is None:
        kind = ServiceError if problem.status >= 500 else InvalidInput
    return kind("\n".join(lines), problem=problem)

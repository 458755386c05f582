"""Problems (RFC 9457): the one error the use cases raise and the routes answer.

``kind`` is the stable last part of the problem's ``type``; ``title`` is for a person and says what to do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

T = TypeVar("T")

TYPE_PREFIX = "urn:graspdb:problem:"


class ProblemError(Exception):
    """Raise it anywhere below a route; it becomes ``application/problem+json``.

    ``kind`` is a stable slug, ``title`` what is wrong and the way out, for a person; ``errors`` are
    ``(field, message)`` pairs, a field a path such as ``trials.3.position``.
    """

    def __init__(
        self,
        status: int,
        kind: str,
        title: str,
        *,
        detail: str | None = None,
        errors: Sequence[tuple[str, str]] = (),
        headers: Mapping[str, str] | None = None,
        extra: Mapping[str, object] | None = None,
    ) -> None:
        super().__init__(title)
        self.status = status
        self.kind = kind
        self.title = title
        self.detail = detail
        self.errors = list(errors)
        self.headers = dict(headers or {})
        self.extra = dict(extra or {})

    def document(self, request_id: str) -> dict[str, object]:
        """The problem's JSON members."""
        body: dict[str, object] = {
            "type": TYPE_PREFIX + self.kind,
            "title": self.title,
            "status": self.status,
            "request_id": request_id,
        }
        if self.detail is not None:
            body["detail"] = self.detail
        if self.errors:
            body["errors"] = [{"field": field, "message": message} for field, message in self.errors]
        return {**body, **self.extra}


def not_found(what: str, name: str, way_out: str = "") -> ProblemError:
    """404 for a named resource."""
    return ProblemError(
        404, "not-found", f"There is no {what} {name!r}" + (f": {way_out}" if way_out else "")
    )


def found(value: T | None, what: str, name: str, way_out: str = "") -> T:
    """What a name stands for; 404 where that is nothing."""
    if value is None:
        raise not_found(what, name[:80], way_out)
    return value


def invalid(field: str, message: str, title: str = "The request is not valid") -> ProblemError:
    """422 naming one field."""
    return invalid_fields([(field, message)], title)


def invalid_fields(
    errors: Sequence[tuple[str, str]], title: str = "The request is not valid"
) -> ProblemError:
    """422 naming several fields, each with what is wrong."""
    return ProblemError(422, "invalid-request", title, errors=errors)


def busy(title: str, *, status: int = 503, retry_after_s: int = 1) -> ProblemError:
    """Not now: the same request again, a little later, will do."""
    return ProblemError(status, "busy", title, headers={"Retry-After": str(retry_after_s)})


def conflict(kind: str, title: str, **more: object) -> ProblemError:
    """409: not in this state; ``title`` says what to do."""
    return ProblemError(409, kind, title, extra=more)


def too_few_trials(why: str) -> ProblemError:
    """409: the trials don't suffice; ``why`` says how many it takes."""
    return conflict("too-few-trials", why[:1].upper() + why[1:])

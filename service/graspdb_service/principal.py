"""Who asks: the key behind the request that is being answered, and which objects it may see.

Held in a context variable that follows a request into its threads and no further. What the service does by
itself (a report's run, the start) has nobody behind it and sees everything.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import NamedTuple

from graspdb_service.problems import ProblemError


@dataclass(frozen=True)
class Principal:
    """A key that was accepted: what it may do, how often, and to which objects.

    ``objects`` is what their ids begin with, empty for all. None for a rate means the service's own.
    """

    key_id: str
    name: str
    scopes: frozenset[str]
    objects: str = ""
    requests_per_s: float | None = None
    burst: int | None = None

    def may(self, accepted: Collection[str]) -> bool:
        """Whether it has one of these scopes; ``admin`` has all."""
        return "admin" in self.scopes or not self.scopes.isdisjoint(accepted)


class Actor(NamedTuple):
    """Who did something, as the audit has it; all None where nobody is known."""

    key_id: str | None = None
    key: str | None = None
    request_id: str | None = None


@dataclass(frozen=True)
class _Asking:
    principal: Principal | None
    request_id: str | None


_ASKING: ContextVar[_Asking] = ContextVar("graspdb_asking")
_NOBODY = _Asking(None, None)


@contextmanager
def asking(principal: Principal | None, request_id: str | None) -> Iterator[None]:
    """What happens meanwhile is this key's doing (None: keys are off)."""
    token = _ASKING.set(_Asking(principal, request_id))
    try:
        yield
    finally:
        _ASKING.reset(token)


def actor() -> Actor:
    """Who asks."""
    now = _ASKING.get(_NOBODY)
    if now.principal is None:
        return Actor(request_id=now.request_id)
    return Actor(now.principal.key_id, now.principal.name, now.request_id)


def object_prefix() -> str:
    """What the ids of all objects begin with that who asks may see; empty for all objects."""
    principal = _ASKING.get(_NOBODY).principal
    return "" if principal is None else principal.objects


def sees(slug: str | None) -> bool:
    """Whether who asks may know of this object; what belongs to none is everybody's."""
    return slug is None or slug.startswith(object_prefix())


def refuse_hidden(slug: str) -> None:
    """403 for an object outside the key's: judged by its id alone, so it does not tell whether it exists."""
    if not sees(slug):
        raise _only_own(f"This key is limited to objects whose ids begin with {object_prefix()!r}")


def refuse_limited(what: str) -> None:
    """403 for a key limited to some objects where it would change what all objects share."""
    if object_prefix():
        raise _only_own(f"{what} belong to all objects: take a key that is not limited to some")


def _only_own(title: str) -> ProblemError:
    return ProblemError(403, "object-not-allowed", title, extra={"objects": object_prefix()})

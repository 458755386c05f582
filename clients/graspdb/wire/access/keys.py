"""API keys: made, described and rotated."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal, get_args

from pydantic import Field

from graspdb.wire.base import Request, Response, Slug

Scope = Literal["read", "trials:write", "objects:write", "jobs:work", "admin"]
"""What a key may do: ``admin`` implies all."""
SCOPES: tuple[Scope, ...] = get_args(Scope)

ExpiresDays = Annotated[int, Field(ge=1, le=36_500)]
RequestsPerS = Annotated[float, Field(gt=0, le=1e6)]
Burst = Annotated[int, Field(ge=1, le=1_000_000)]


class KeyCreate(Request):
    """A key to make."""

    name: Slug
    """Who or what will use it; a living key has it alone."""
    scopes: Annotated[list[Scope], Field(min_length=1, max_length=20)]
    """What it may do; ``admin`` implies all."""
    objects: Slug | None = None
    """What the ids of all objects begin with that it may see or change; null for all objects."""
    expires_days: ExpiresDays | None = None
    """In how many days it expires; null for never."""
    requests_per_s: RequestsPerS | None = None
    """Requests a second that it may make in the long run, counted over seconds; null for the service's own
    limit."""
    burst: Burst | None = None
    """Requests that it may make at once after a pause; null for the service's own limit."""


class KeyRotate(Request):
    """How to give a key another secret."""

    overlap_s: Annotated[float, Field(ge=0, le=30 * 86_400)] = 0.0
    """How long the old secret works on, seconds: until every client has the new one."""
    expires_days: ExpiresDays | None = None
    """In how many days the key expires from now; null leaves it as it was."""


class KeyInfo(Response):
    """A key without its secret, which nobody has but who was given it."""

    id: str
    """Id of the key, which is part of what is sent and no secret."""
    name: str
    """Who or what uses it."""
    scopes: list[str]
    """What it may do."""
    objects: str | None = None
    """What the ids of all objects begin with that it may see or change; null for all objects."""
    requests_per_s: float | None = None
    """Requests a second that it may make, counted over seconds; null for the service's own limit."""
    burst: int | None = None
    """Requests that it may make at once; null for the service's own limit."""
    state: Literal["usable", "expired", "revoked"]
    """Whether it opens anything."""
    created_at: datetime
    """When it was made, UTC."""
    created_by: str | None = None
    """Name of the key that made it; null where it was made on the command line."""
    expires_at: datetime | None = None
    """When it expires, UTC; null for never."""
    revoked_at: datetime | None = None
    """When it was revoked, UTC; null where it was not."""
    last_used_at: datetime | None = None
    """When it was last used, UTC, to about a minute; null for never."""


class KeyMade(KeyInfo):
    """A key that was just made or rotated."""

    key: str
    """What to send as ``Authorization: Bearer``. It is told this once and stored nowhere."""

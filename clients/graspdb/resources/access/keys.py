"""API keys, for a key with the scope ``admin``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from graspdb import wire
from graspdb.resources.pages import Listing, Resource, segment, validate


class Keys(Resource):
    """``db.keys``: who may ask, and what."""

    def create(
        self,
        /,
        name: str,
        *,
        scopes: Sequence[str],
        objects: str | None = None,
        expires_days: int | None = None,
        requests_per_s: float | None = None,
        burst: int | None = None,
    ) -> wire.KeyMade:
        """Make a key; ``key`` of the answer is told this once.

        ``scopes`` are of ``read``, ``trials:write``, ``objects:write``, ``jobs:work`` and ``admin``, which
        implies all; ``objects`` is what the ids of all objects begin with that it may see. Never sent twice:
        after Unreachable look into the list. Conflict where a living key has the name.
        """
        request = validate(
            wire.KeyCreate,
            {
                "name": name,
                "scopes": list(scopes),
                "objects": objects,
                "expires_days": expires_days,
                "requests_per_s": requests_per_s,
                "burst": burst,
            },
        )
        return self._transport.model(wire.KeyMade, "POST", self._path, body=request, retries=0)

    def list(self) -> Iterator[wire.KeyInfo]:
        """All keys, oldest first, without their secrets."""
        return iter(Listing(self._transport, self._path, wire.KeyInfo))

    def rotate(self, id: str, *, overlap_s: float = 0.0, expires_days: int | None = None) -> wire.KeyMade:
        """Give a key another secret, told this once; the old one works on for ``overlap_s`` seconds."""
        request = validate(wire.KeyRotate, {"overlap_s": overlap_s, "expires_days": expires_days})
        path = f"{self._path}/{segment(id)}/rotate"
        return self._transport.model(wire.KeyMade, "POST", path, body=request, retries=0)

    def revoke(self, id: str) -> None:
        """Let a key open nothing any more."""
        self._transport.request("DELETE", f"{self._path}/{segment(id)}")

    def __iter__(self) -> Iterator[wire.KeyInfo]:
        return self.list()

"""The audit, for a key with the scope ``admin``."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime

from graspdb import wire
from graspdb.resources.pages import Listing, Resource


class Audit(Resource):
    """``db.audit``: what was changed, and which key did it."""

    def list(
        self,
        *,
        object: str | None = None,
        key: str | None = None,
        action: str | None = None,
        since: datetime | None = None,
    ) -> Listing[wire.AuditEntry]:
        """Changes, the newest first: of an object, by a key (its id or name), of a kind, from a time on."""
        at = None if since is None else since.isoformat()
        asked = {"object": object, "key": key, "action": action, "since": at}
        return Listing(self._transport, self._path, wire.AuditEntry, asked)

    def __iter__(self) -> Iterator[wire.AuditEntry]:
        return iter(self.list())

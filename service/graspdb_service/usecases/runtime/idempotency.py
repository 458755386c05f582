"""Creating things at most once: an Idempotency-Key is kept in the transaction that creates."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from graspdb_service.problems import ProblemError, conflict
from graspdb_service.storage import idempotency
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.idempotency import Remembered


@dataclass(frozen=True)
class Created:
    """What a creating request is answered: a JSON body that can be kept, and where the new thing is.

    ``batch_key`` names the batch whose deletion makes the request unrepeatable.
    """

    body: dict[str, Any]
    location: str
    status: int = 201
    batch_key: str | None = None


@dataclass(frozen=True)
class Sent:
    """A creating request: its Idempotency-Key, its body, and what else changes the body's meaning."""

    key: str | None
    body: bytes
    beside: bytes = b""

    @functools.cached_property
    def digest(self) -> str:
        # In two steps, for a large body is never copied.
        found = hashlib.sha256(self.beside)
        found.update(self.body)
        return found.hexdigest()


def replay_or(database: Database, scope: str, sent: Sent, create: Callable[[Tx], Created]) -> Created:
    """Create in one transaction with the key, or answer what the same request was answered before.

    ``scope`` is method and path. Without a key ``create`` runs anyway, inside the transaction: parse and
    compute before. 422 where the key was used with another body, 409 where what it made has since been
    deleted.
    """
    digest = "" if sent.key is None else sent.digest
    with database.write() as tx:
        if sent.key is None:
            return create(tx)
        earlier = idempotency.claim(tx, scope, sent.key, digest)
        if earlier is None:
            made = create(tx)
            answer: dict[str, Any] = {"status": made.status, "location": made.location, "answer": made.body}
            idempotency.remember(tx, scope, sent.key, **answer, batch_key=made.batch_key)
            return made
    return _answer(earlier, sent)


def replayed(database: Database, scope: str, sent: Sent) -> Created | None:
    """What the same request was answered before, or None; refused as :func:`replay_or`, which takes the key.

    For requests whose checks may turn out otherwise the second time, or whose work is long: looked up first.
    """
    if sent.key is None:
        return None
    with database.read() as tx:
        earlier = idempotency.find(tx, scope, sent.key)
    return None if earlier is None else _answer(earlier, sent)


def _answer(earlier: Remembered, sent: Sent) -> Created:
    if earlier.request_sha256 != sent.digest:
        raise ProblemError(
            422,
            "idempotency-key-reused",
            "This Idempotency-Key came before with another body: send a new key for a new request",
            errors=[("Idempotency-Key", "already used with another body")],
        )
    if earlier.revoked:
        raise conflict(
            "idempotency-key-revoked",
            "What this request made has been deleted since: to make it again, send a new Idempotency-Key",
        )
    return Created(earlier.answer, earlier.location or "", earlier.status)

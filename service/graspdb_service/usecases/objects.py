"""Objects: make, find, change and delete them."""

from __future__ import annotations

import re

from graspdb_service.problems import ProblemError, not_found
from graspdb_service.storage import objects
from graspdb_service.storage.database import Tx
from graspdb_service.storage.objects import ObjectRow

SLUG = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def missing(slug: str) -> ProblemError:
    """404 for an object."""
    return not_found("object", slug[:80], "POST /objects makes one")


def require(tx: Tx, slug: str, *, lock: bool = False) -> ObjectRow:
    """The object with this slug, or a 404; ``lock`` holds it until the transaction ends."""
    row = objects.find(tx, slug, lock=lock) if SLUG.fullmatch(slug) else None
    if row is None:
        raise missing(slug)
    return row

"""Cursors of lists: opaque, and refused where this service did not make them."""

from __future__ import annotations

import base64
import binascii
import json
import re
from typing import Annotated, Any

from fastapi import Query

from graspdb_service.problems import ProblemError, invalid

Limit = Annotated[int, Query(ge=1, le=1_000, description="At most this many items.")]
Cursor = Annotated[
    str | None, Query(max_length=500, description="`next` of the page before; by default the first page.")
]


def encode_cursor(position: int | str | None) -> str | None:
    """An opaque cursor of the place after which the next page starts; None at the end."""
    if position is None:
        return None
    return base64.urlsafe_b64encode(json.dumps(position).encode()).decode().rstrip("=")


def number_cursor(cursor: str | None) -> int:
    """The number in a cursor that this service made, 0 without one."""
    position = 0 if cursor is None else _decode_cursor(cursor)
    if type(position) is not int or not 0 <= position < 2**63:
        raise _bad_cursor()
    return position


def name_cursor(cursor: str | None) -> str:
    """The name in a cursor that this service made, empty without one."""
    position = "" if cursor is None else _decode_cursor(cursor)
    if not isinstance(position, str) or not re.fullmatch(r"[A-Za-z0-9._-]{0,64}", position):
        raise _bad_cursor()
    return position


def _decode_cursor(cursor: str) -> Any:
    try:
        return json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
    except (ValueError, RecursionError, binascii.Error):
        raise _bad_cursor() from None


def _bad_cursor() -> ProblemError:
    return invalid("cursor", "a cursor is the `next` of the page before, unchanged")

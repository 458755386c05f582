"""What an answer is called: an id made of what it depends on, or a name of the user's."""

from __future__ import annotations

import hashlib
import re

from graspdb.wire.queries import ANSWER_ID

_ID = re.compile(ANSWER_ID)


def is_answer_id(reference: str) -> bool:
    """Whether an answer could have this id; no name looks so."""
    return _ID.fullmatch(reference) is not None


def answer_id(*parts: object) -> str:
    """The id of an answer that depends on these."""
    return hashlib.sha256(" ".join(map(str, parts)).encode()).hexdigest()[:20]

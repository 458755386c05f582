"""Reading a large JSON body in pieces.

orjson keeps the interpreter's lock while it parses: a hundred megabytes at once would hold up every other
request, ``/livez`` included, for seconds. Here a compiled scan, which holds no lock, finds the long arrays of
the document and cuts them between two of their items; orjson then parses the rest of the document and each
piece by itself. Every byte still goes through orjson, so what is no JSON is refused as ever.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import orjson
from numpy.typing import NDArray

#: Arrays of fewer bytes are parsed with the document.
LONG = 2**18
PIECE = 2**17
_MOST_ARRAYS = 64

_QUOTE, _BACKSLASH, _COMMA = ord('"'), ord("\\"), ord(",")
_OPEN_ARRAY, _CLOSE_ARRAY, _OPEN_OBJECT, _CLOSE_OBJECT = ord("["), ord("]"), ord("{"), ord("}")


@dataclass(frozen=True, eq=False)
class LongArray:
    """A long array of a document, parsed as it is iterated: lists of consecutive items."""

    body: bytes
    edges: tuple[int, ...]

    def __iter__(self) -> Iterator[list[Any]]:
        """Raises orjson.JSONDecodeError where the array is no JSON."""
        for start, stop in zip(self.edges[:-1], self.edges[1:], strict=True):
            # An edge stands on the bracket or comma before a piece.
            items = orjson.loads(b"[" + self.body[start + 1 : stop] + b"]")
            # All the array may be blanks; a piece of it may not.
            if not items and len(self.edges) > 2:
                raise orjson.JSONDecodeError("an item is missing", "", 0)
            yield items


def loads(body: bytes, *, long: int = LONG, piece: int = PIECE) -> Any:
    """As ``orjson.loads``, but for :class:`LongArray` where an object of depth 1 or 2 holds a long array.

    What is wrong within a long array is raised when it is iterated.
    """
    if len(body) < long or body.lstrip()[:1] != b"{":
        return orjson.loads(body)
    spans = np.empty((_MOST_ARRAYS, 2), dtype=np.int64)
    cuts = np.empty((len(body) // piece + _MOST_ARRAYS, 2), dtype=np.int64)
    found, cut_count = _scan(np.frombuffer(body, dtype=np.uint8), long, piece, spans, cuts)
    if found <= 0:
        return orjson.loads(body)
    # A name nobody can guess stands for each array: no text in the document can be taken for it.
    token = secrets.token_hex(16)
    arrays: dict[str, LongArray] = {}
    rest, after = [], 0
    for i, (start, stop) in enumerate(spans[:found].tolist()):
        inner = cuts[:cut_count][cuts[:cut_count, 0] == i, 1].tolist()
        name = f"{token}{i}"
        arrays[name] = LongArray(body, (start, *inner, stop))
        rest += [body[after:start], b'"', name.encode(), b'"']
        after = stop + 1
    document = orjson.loads(b"".join((*rest, body[after:])))

    def put_back(value: Any, depth: int) -> Any:
        if isinstance(value, str):
            return arrays.get(value, value)
        if isinstance(value, dict) and depth < 2:
            return {name: put_back(item, depth + 1) for name, item in value.items()}
        return value

    return put_back(document, 0)


@numba.njit(nogil=True, cache=True)
def _scan(
    text: NDArray[np.uint8], long: int, piece: int, spans: NDArray[np.int64], cuts: NDArray[np.int64]
) -> tuple[int, int]:
    """Find the long arrays of an object (depth 1 or 2) and commas between their items, a piece apart.

    Returns the numbers of both; -1 where the document does not balance or has too many.
    """
    depth = 0
    inside = 0  # depth of the array being scanned, 0 for none
    start = 0
    last = 0
    quoted = False
    escaped = False
    found = 0
    cut_count = 0
    first_cut = 0
    for i in range(len(text)):
        c = text[i]
        if quoted:
            if escaped:
                escaped = False
            elif c == _BACKSLASH:
                escaped = True
            elif c == _QUOTE:
                quoted = False
            continue
        if c == _QUOTE:
            quoted = True
        elif c in (_OPEN_ARRAY, _OPEN_OBJECT):
            depth += 1
            # Everything around an array that is not inside another is an object.
            if c == _OPEN_ARRAY and inside == 0:
                inside = depth
                start = last = i
                first_cut = cut_count
        elif c in (_CLOSE_ARRAY, _CLOSE_OBJECT):
            if inside == depth and depth > 0:
                if c == _CLOSE_OBJECT:
                    return -1, 0
                if 1 < depth <= 3 and i - start >= long:
                    if found == len(spans):
                        return -1, 0
                    spans[found, 0], spans[found, 1] = start, i
                    found += 1
                else:
                    cut_count = first_cut
                inside = 0
            depth -= 1
            if depth < 0:
                return -1, 0
        elif c == _COMMA and depth == inside and i - last >= piece:
            if cut_count == len(cuts):
                return -1, 0
            cuts[cut_count, 0], cuts[cut_count, 1] = found, i
            cut_count += 1
            last = i
    if depth != 0 or quoted:
        return -1, 0
    return found, cut_count

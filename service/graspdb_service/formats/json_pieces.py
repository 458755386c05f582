"""Reading a large JSON body in pieces.

orjson keeps the interpreter's lock while it parses: a hundred megabytes at once would hold up every other
request, ``/livez`` included, for seconds. Here a compiled scan, which holds no lock, finds the long arrays of
the document and cuts them between two of their items; orjson then parses the rest of the document and each
piece by itself. Every byte still goes through orjson, so what is no JSON is refused as ever; what could not
be parsed in short pieces is refused before.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numba
import numpy as np
import orjson
from numpy.typing import NDArray

from graspdb_service.problems import ProblemError

#: Arrays of fewer bytes are parsed with the document.
LONG = 2**18
PIECE = 2**17
#: Nothing that has to be parsed at once may have more bytes: one item, or all but the long arrays.
WHOLE = 2**20
_MOST_ARRAYS = 64

_QUOTE, _BACKSLASH, _COMMA = ord('"'), ord("\\"), ord(",")
_OPEN_ARRAY, _CLOSE_ARRAY, _OPEN_OBJECT, _CLOSE_OBJECT = ord("["), ord("]"), ord("{"), ord("}")


class Allowed(NamedTuple):
    """How many values a document may have, and how deep they may be nested."""

    values: int = 50_000_000
    depth: int = 32


@dataclass(frozen=True, eq=False)
class LongArray:
    """A long array of a document, parsed as it is iterated: lists of consecutive items, ``len()`` in all."""

    body: bytes
    edges: tuple[int, ...]
    count: int
    flaws: list[str] | None = field(default=None)
    """Where it is a list, NaN and Infinity are let through and noted here, for whoever can name the field."""

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[list[Any]]:
        """Raises orjson.JSONDecodeError where the array is no JSON."""
        for start, stop in zip(self.edges[:-1], self.edges[1:], strict=True):
            # An edge stands on the bracket or comma before a piece.
            text = b"[" + self.body[start + 1 : stop] + b"]"
            try:
                items = orjson.loads(text)
            except orjson.JSONDecodeError as error:
                if self.flaws is None:
                    raise
                items = lenient(text, error, self.flaws)
            # All the array may be blanks; a piece of it may not.
            if not items and len(self.edges) > 2:
                raise orjson.JSONDecodeError("an item is missing", "", 0)
            yield items


def lenient(text: bytes, error: orjson.JSONDecodeError, flaws: list[str]) -> Any:
    """What Python's own parser makes of it, which takes NaN and Infinity; ``error`` where that is nothing."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        raise error from None
    flaws.append(f"not valid JSON: {error}")
    return found


def loads(
    body: bytes,
    *,
    long: int = LONG,
    piece: int = PIECE,
    whole: int = WHOLE,
    allowed: Allowed | None = None,
    flaws: list[str] | None = None,
) -> Any:
    """As ``orjson.loads``, but for :class:`LongArray` where an object of depth 1 to 3 holds a long array.

    What is wrong within a long array is raised when it is iterated. 422 ``body-not-in-pieces`` for a document
    of which more than ``whole`` bytes would have to be parsed at once; 422 for more values or nesting than is
    allowed. With ``flaws`` NaN and Infinity are let through, and noted there.
    """
    if len(body) < long:
        return _loads(body, flaws)
    spans = np.empty((_MOST_ARRAYS, 3), dtype=np.int64)
    cuts = np.empty((len(body) // piece + _MOST_ARRAYS, 2), dtype=np.int64)
    found, cut_count, values, depth = _scan(np.frombuffer(body, dtype=np.uint8), long, piece, spans, cuts)
    _check(values, depth, allowed or Allowed())
    if found <= 0:
        _check_whole(
            len(body), whole, "it has no list of that size in an object, or its brackets do not match"
        )
        return _loads(body, flaws)
    # A name nobody can guess stands for each array: no text in the document can be taken for it.
    token = secrets.token_hex(16)
    arrays: dict[str, LongArray] = {}
    rest, after = [], 0
    for i, (start, stop, count) in enumerate(spans[:found].tolist()):
        inner = cuts[:cut_count][cuts[:cut_count, 0] == i, 1].tolist()
        edges = (start, *inner, stop)
        _check_whole(int(np.diff(edges).max()), whole + piece, "one item of a list is larger")
        name = f"{token}{i}"
        arrays[name] = LongArray(body, edges, count, flaws)
        rest += [body[after:start], b'"', name.encode(), b'"']
        after = stop + 1
    rest.append(body[after:])
    _check_whole(sum(map(len, rest)), whole, "what stands beside its long lists is larger")
    document = _loads(b"".join(rest), flaws)

    def put_back(value: Any, depth: int) -> Any:
        if isinstance(value, str):
            return arrays.get(value, value)
        if isinstance(value, dict) and depth < 3:
            return {name: put_back(item, depth + 1) for name, item in value.items()}
        return value

    return put_back(document, 0)


def _loads(text: bytes, flaws: list[str] | None) -> Any:
    try:
        return orjson.loads(text)
    except orjson.JSONDecodeError as error:
        if flaws is None:
            raise
        return lenient(text, error, flaws)


def _check(values: int, depth: int, allowed: Allowed) -> None:
    if values > allowed.values or depth > allowed.depth:
        many = f"{values:,} values" if values > allowed.values else f"nesting {depth} deep"
        raise ProblemError(
            422,
            "body-too-complex",
            f"A body may have {allowed.values:,} values, nested {allowed.depth} deep (see /info), and this"
            f" one has {many}: send it in several requests",
            errors=[("body", f"{many} is too much")],
        )


def _check_whole(size: int, whole: int, why: str) -> None:
    if size > whole:
        raise ProblemError(
            422,
            "body-not-in-pieces",
            f"A large body is read in pieces of at most {whole:,} bytes, and {why} ({size:,} bytes): send an"
            " object with the list of trials or poses, each small",
            errors=[("body", f"{why} than {whole:,} bytes")],
        )


# long: one pass over the bytes, whose state is in its variables
@numba.njit(nogil=True, cache=True)
def _scan(
    text: NDArray[np.uint8], long: int, piece: int, spans: NDArray[np.int64], cuts: NDArray[np.int64]
) -> tuple[int, int, int, int]:
    """Find the long arrays of an object (depth 1 to 3) and commas between their items, a piece apart.

    Returns the numbers of both; -1 where the document does not balance, is no object or has too many. Then
    the number of values, at least, and the greatest depth.
    """
    depth = 0
    deepest = 0
    values = 0
    inside = 0  # depth of the array being scanned, 0 for none
    start = 0
    last = 0
    items = 0
    quoted = False
    escaped = False
    begun = False
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
        if not begun and c > 32:
            begun = True
            if c != _OPEN_OBJECT:
                return -1, 0, 0, 0
        if c == _QUOTE:
            quoted = True
        if items == 0 and inside > 0 and c > 32 and not (c == _CLOSE_ARRAY and depth == inside):
            items = 1
        if c in (_OPEN_ARRAY, _OPEN_OBJECT):
            depth += 1
            values += 1
            deepest = max(deepest, depth)
            # Everything around an array that is not inside another is an object.
            if c == _OPEN_ARRAY and inside == 0:
                inside = depth
                start = last = i
                items = 0
                first_cut = cut_count
        elif c in (_CLOSE_ARRAY, _CLOSE_OBJECT):
            if inside == depth and depth > 0:
                if c == _CLOSE_OBJECT:
                    return -1, 0, values, deepest
                if 1 < depth <= 4 and i - start >= long:
                    if found == len(spans):
                        return -1, 0, values, deepest
                    spans[found, 0], spans[found, 1], spans[found, 2] = start, i, items
                    found += 1
                else:
                    cut_count = first_cut
                inside = 0
            depth -= 1
            if depth < 0:
                return -1, 0, values, deepest
        elif c == _COMMA:
            values += 1
            if depth == inside:
                items += 1
                if i - last >= piece:
                    if cut_count == len(cuts):
                        return -1, 0, values, deepest
                    cuts[cut_count, 0], cuts[cut_count, 1] = found, i
                    cut_count += 1
                    last = i
    if depth != 0 or quoted:
        return -1, 0, values, deepest
    return found, cut_count, values, deepest

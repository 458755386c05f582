"""Parsing in pieces is parsing: the same values, and the same refusals."""

from __future__ import annotations

import json
from typing import Any

import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspdb_service.formats.json_pieces import LongArray, loads

SCALARS = (
    st.none() | st.booleans() | st.integers(-1000, 1000) | st.floats(allow_nan=False, allow_infinity=False)
)
TEXT = st.text(alphabet=st.sampled_from('ab[]{},:"\\ \u00e9'), max_size=6)
VALUES = st.recursive(
    SCALARS | TEXT,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=30,
)
DOCUMENTS = st.dictionaries(TEXT, VALUES | st.dictionaries(TEXT, VALUES, max_size=3), max_size=4)


def whole(value: Any) -> Any:
    if isinstance(value, LongArray):
        return [item for items in value for item in items]
    if isinstance(value, dict):
        return {name: whole(item) for name, item in value.items()}
    return value


def parsed(text: bytes, **limits: int) -> Any:
    """What comes of a text, an error included."""
    try:
        return whole(loads(text, **limits))
    except orjson.JSONDecodeError:
        return "no JSON"


@settings(max_examples=300, deadline=None)
@given(DOCUMENTS | VALUES, st.sampled_from([None, 1]), st.integers(2, 40), st.integers(1, 20))
def test_same_values(document: Any, indent: int | None, long: int, piece: int) -> None:
    text = json.dumps(document, indent=indent).encode()
    assert parsed(text, long=long, piece=piece) == orjson.loads(text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b'{"a": [   ]}', {"a": []}),
        (b'{"a": {"b": [      ]}}', {"a": {"b": []}}),
        (b'{"a": [  1,     ]}', "no JSON"),
        (b'{"a": [    ,  1]}', "no JSON"),
    ],
)
def test_blanks_in_long_arrays(text: bytes, expected: Any) -> None:
    assert parsed(text, long=2, piece=3) == expected


@settings(max_examples=500, deadline=None)
@given(DOCUMENTS, st.data())
def test_same_refusals(document: Any, data: st.DataObject) -> None:
    """One character of a document changed, dropped or put in."""
    text = bytearray(json.dumps(document).encode())
    at = data.draw(st.integers(0, len(text) - 1))
    with_ = data.draw(st.sampled_from([b"", b",", b"[", b"]", b"{", b"}", b'"', b"\\", b"0", b" "]))
    text[at : at + data.draw(st.integers(0, 1))] = with_
    try:
        expected = orjson.loads(bytes(text))
    except orjson.JSONDecodeError:
        expected = "no JSON"
    assert parsed(bytes(text), long=2, piece=3) == expected


@pytest.mark.parametrize("piece", [1, 7, 1000])
def test_rows_and_columns(piece: int) -> None:
    rows = [[i / 7, -i, 1e-9] for i in range(500)]
    for document in ({"poses": {"position": rows, "text": "x"}, "n": 1}, {"a": [1], "poses": rows}):
        found = loads(json.dumps(document).encode(), long=1000, piece=piece)
        assert whole(found) == document
        held = found["poses"] if "a" in document else found["poses"]["position"]
        assert isinstance(held, LongArray)
        assert len(list(held)) > (1 if piece < 1000 else 0)

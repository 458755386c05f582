"""Columns of trials as an Arrow IPC stream, where pyarrow is installed."""

from __future__ import annotations

import importlib
import importlib.util
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

MEDIA_TYPE = "application/vnd.apache.arrow.stream"


def available() -> bool:
    """Whether pyarrow is installed."""
    return importlib.util.find_spec("pyarrow") is not None


def encoded(columns: Mapping[str, Any], shared: Mapping[str, Any]) -> bytes:
    """Columns as ``POST .../trials`` takes them: arrays, or lists with None; ``shared`` in the metadata."""
    pa = importlib.import_module("pyarrow")
    arrays: dict[str, Any] = {}
    for name, values in columns.items():
        if name == "qualities":
            arrays |= {f"qualities.{key}": _numbers(pa, column) for key, column in values.items()}
        elif isinstance(values, np.ndarray) and values.ndim == 2:
            arrays[name] = pa.FixedSizeListArray.from_arrays(
                _numbers(pa, values.reshape(-1)), values.shape[1]
            )
        elif name == "outcome":
            names, places = np.unique(np.asarray(values), return_inverse=True)
            arrays[name] = pa.DictionaryArray.from_arrays(
                _array(pa, pa.int32(), places.astype(np.int32)), _texts(pa, names.tolist())
            )
        elif name == "metadata":
            texts = [None if value is None else json.dumps(value, allow_nan=False) for value in values]
            arrays[name] = _texts(pa, texts)
        elif isinstance(values, np.ndarray):
            arrays[name] = _numbers(pa, values)
        else:
            arrays[name] = pa.array(values)
    schema = pa.schema(
        [(name, array.type) for name, array in arrays.items()], metadata={"graspdb": json.dumps(dict(shared))}
    )
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as stream:
        stream.write_batch(pa.record_batch(list(arrays.values()), schema=schema))
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _numbers(pa: Any, values: Any) -> Any:
    """Numbers, NaN as null."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    return _array(pa, pa.float64(), array, missing=np.isnan(array))


def _texts(pa: Any, texts: Sequence[str | None]) -> Any:
    pieces = [(text or "").encode() for text in texts]
    ends = np.concatenate([[0], np.cumsum([len(piece) for piece in pieces], dtype=np.int64)]).astype(np.int32)
    missing = np.array([text is None for text in texts], dtype=bool)
    return _array(pa, pa.string(), ends, b"".join(pieces), missing=missing)


def _array(pa: Any, kind: Any, *buffers: Any, missing: NDArray[np.bool_] | None = None) -> Any:
    """An array of these buffers: ``pyarrow.array`` imports all of pandas, where that is installed, to ask."""
    length = len(buffers[0]) if missing is None else len(missing)
    there = (
        None if missing is None or not missing.any() else np.packbits(~missing, bitorder="little").tobytes()
    )
    return pa.Array.from_buffers(kind, length, [there and pa.py_buffer(there), *map(pa.py_buffer, buffers)])

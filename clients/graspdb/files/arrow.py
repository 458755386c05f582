"""Columns of trials as an Arrow IPC stream, where pyarrow is installed."""

from __future__ import annotations

import importlib
import importlib.util
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

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
            flat = pa.array(np.ascontiguousarray(values, dtype=np.float64).reshape(-1))
            arrays[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        elif name == "outcome":
            names, places = np.unique(np.asarray(values), return_inverse=True)
            arrays[name] = pa.DictionaryArray.from_arrays(
                pa.array(places.astype(np.int32)), pa.array(names.tolist())
            )
        elif name == "metadata":
            texts = [None if value is None else json.dumps(value, allow_nan=False) for value in values]
            arrays[name] = pa.array(texts, pa.string())
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
    array = np.asarray(values, dtype=np.float64)
    return pa.array(array, mask=np.isnan(array))

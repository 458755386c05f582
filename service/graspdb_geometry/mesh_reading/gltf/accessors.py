"""Arrays of a GLB: views into its buffers, dense or sparse, of numbers of any type."""

from __future__ import annotations

import base64
import binascii
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from graspdb_geometry.mesh_reading.content import FaceArray, FloatArray, FormatError
from graspdb_geometry.mesh_reading.gltf.document import entries_of, entry_at, integer_of

FLOAT = 5126
_INDEX_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4"}
# Integers by KHR_mesh_quantization.
_POSITION_TYPES = {FLOAT: "<f4", 5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2"}
_COLUMNS = {"SCALAR": 1, "VEC3": 3}


class Glb(NamedTuple):
    """The document of a GLB and its binary chunk."""

    document: dict[str, Any]
    binary: bytes


def positions(glb: Glb, number: int) -> FloatArray:
    """Positions (V, 3) from an accessor; normalized integers are shares of their largest value."""
    found, normalized = _accessor(glb, number, "VEC3", _POSITION_TYPES)
    values = found.astype(np.float64)
    if normalized and found.dtype.kind in "iu":
        values = np.maximum(values / np.iinfo(found.dtype).max, -1.0)
    return values


def indices(glb: Glb, number: int) -> FaceArray:
    """Vertex numbers (n,) from an accessor."""
    found, _ = _accessor(glb, number, "SCALAR", _INDEX_TYPES)
    return found.reshape(-1).astype(np.int64)


def _accessor(glb: Glb, number: int, kind: str, types: dict[int, str]) -> tuple[npt.NDArray[Any], bool]:
    accessor = entry_at(entries_of(glb.document, "accessors"), number, "accessor")
    component = types.get(integer_of(accessor, "componentType"))
    if accessor.get("type") != kind or component is None:
        raise FormatError(f"accessor {number} of the GLB is not of a supported type")
    count = integer_of(accessor, "count")
    sparse = accessor.get("sparse")
    if "bufferView" in accessor:
        array = _view(glb, number, accessor, component, _COLUMNS[kind], count)
    elif isinstance(sparse, dict) and count <= len(glb.binary) + 2**20:
        array = np.zeros((count, _COLUMNS[kind]), dtype=component)
    else:
        raise FormatError(f"accessor {number} of the GLB has no data")
    if sparse is not None:
        array = _with_changes(glb, number, sparse, array)
    return array, accessor.get("normalized") is True


def _with_changes(glb: Glb, number: int, sparse: Any, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A sparse accessor's array: some of its rows stand elsewhere."""
    places, values = (sparse.get(key) if isinstance(sparse, dict) else None for key in ("indices", "values"))
    if not isinstance(places, dict) or not isinstance(values, dict):
        raise FormatError(f"accessor {number} of the GLB is not of a supported type")
    count = integer_of(sparse, "count")
    index_type = _INDEX_TYPES.get(integer_of(places, "componentType"))
    if index_type is None:
        raise FormatError(f"accessor {number} of the GLB is not of a supported type")
    rows = _view(glb, number, places, index_type, 1, count).reshape(-1).astype(np.int64)
    if rows.size and int(rows.max()) >= len(array):
        raise FormatError(f"accessor {number} of the GLB reaches beyond its data")
    changed = array.copy()
    changed[rows] = _view(glb, number, values, array.dtype.str, array.shape[1], count)
    return changed


def _view(
    glb: Glb, number: int, entry: dict[str, Any], component: str, columns: int, count: int
) -> npt.NDArray[Any]:
    """Rows (count, columns) of the buffer view that an accessor, or a part of one, refers to."""
    view = entry_at(entries_of(glb.document, "bufferViews"), integer_of(entry, "bufferView"), "bufferView")
    buffer = _buffer(glb, integer_of(view, "buffer", 0))
    item = np.dtype(component).itemsize * columns
    stride = integer_of(view, "byteStride", item)
    offset = integer_of(entry, "byteOffset", 0)
    view_offset, view_length = integer_of(view, "byteOffset", 0), integer_of(view, "byteLength")
    needed = offset + (stride * (count - 1) + item if count else 0)
    if stride < item or needed > view_length or view_offset + view_length > len(buffer):
        raise FormatError(f"accessor {number} of the GLB reaches beyond its data")
    return np.ndarray(
        (count, columns),
        dtype=component,
        buffer=buffer,
        offset=view_offset + offset,
        strides=(stride, np.dtype(component).itemsize),
    )


def _buffer(glb: Glb, number: int) -> bytes:
    """The binary chunk, or what stands as a data URI in the document; nothing outside of it."""
    buffers = entries_of(glb.document, "buffers")
    uri = entry_at(buffers, number, "buffer").get("uri") if buffers else None
    if uri is None and number == 0:
        return glb.binary
    head, comma, text = uri.partition(",") if isinstance(uri, str) else ("", "", "")
    if not comma or not head.startswith("data:") or not head.endswith(";base64"):
        raise FormatError("the GLB refers to buffers outside of it: export it with everything in one file")
    try:
        return base64.b64decode(text, validate=True)
    except binascii.Error:
        raise FormatError(f"buffer {number} of the GLB can't be read") from None

"""What a reader finds in a mesh file, and what it says of a file that it can't read."""

from __future__ import annotations

import codecs
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
FaceArray = npt.NDArray[np.int64]

#: Words converted at once: as strings of one length they take many times their own memory.
_WORDS = 500_000


class Geometry(NamedTuple):
    """Triangles as read: vertices (V, 3) in the file's unit, faces (F, 3) not yet checked."""

    vertices: FloatArray
    faces: FaceArray


class FileContent(NamedTuple):
    """Geometries of a file, and in words for the user what of it was left aside."""

    geometries: list[Geometry]
    notes: tuple[str, ...] = ()


class FormatError(ValueError):
    """The content can't be read as the format it claims to be."""


def check_limit(triangles: int, max_triangles: int) -> None:
    """FormatError if there are more triangles than allowed."""
    if triangles > max_triangles:
        raise FormatError(f"the mesh has more than {max_triangles:,} triangles: simplify it first")


def as_text(data: bytes) -> bytes:
    """Text as UTF-8 without byte order mark, with ``\\n`` at the end of its lines, whoever wrote it."""
    for mark, encoding in ((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")):
        if data.startswith(mark):
            data = data.decode(encoding, errors="replace").encode()
    data = data.removeprefix(codecs.BOM_UTF8)
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data


def numbers(words: list[bytes]) -> FloatArray:
    """Numbers from words of a text file; ``1,5`` and ``1.5D+00`` of other locales and languages too.

    ValueError if one is none.
    """
    found = np.empty(len(words))
    for first in range(0, len(words), _WORDS):
        some = words[first : first + _WORDS]
        try:
            found[first : first + _WORDS] = np.array(some, dtype="S64").astype(np.float64)
        except ValueError:
            plain = [word.replace(b",", b".").replace(b"D", b"e").replace(b"d", b"e") for word in some]
            found[first : first + _WORDS] = np.array(plain, dtype="S64").astype(np.float64)
    return found

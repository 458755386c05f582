"""Messages between a worker and its simulating child: a length, a kind and a body, over two pipes.

Worker to child: ``CHUNK`` (JSON: payload, rows already known; then the parts as GLB). Child to worker:
``READY`` once pybullet is loaded, ``BEFORE`` and ``AFTER`` around every closing, ``RESULT`` or
``ERROR`` at the end.
"""

from __future__ import annotations

import json
import math
import os
import select
import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from graspdb_simworker.labels import Label, Outcome

READY, CHUNK, BEFORE, AFTER, RESULT, ERROR, MISSING, NOTE = (b"R", b"C", b"B", b"A", b"D", b"E", b"M", b"N")
MAX_BYTES = 1 << 30

_HEADER = struct.Struct("<cQ")
_ROW = struct.Struct("<q")
_LABEL = struct.Struct("<qBdd")
_LENGTH = struct.Struct("<I")


class Closed(EOFError):
    """The other end is gone."""


class Silent(TimeoutError):
    """The other end said nothing for too long."""


def send(fd: int, kind: bytes, body: bytes = b"") -> None:
    """Write one message whole.

    Raises
    ------
    Closed
        If nobody reads any more.
    """
    view = memoryview(_HEADER.pack(kind, len(body)) + body)
    try:
        while view:
            view = view[os.write(fd, view) :]
    except BrokenPipeError as error:
        raise Closed("the pipe's reader is gone") from error


def receive(
    fd: int, *, silence_s: float | None = None, poll_s: float = 0.2, check: Callable[[], None] | None = None
) -> tuple[bytes, bytes]:
    """Read one message whole.

    Parameters
    ----------
    fd : int
    silence_s : float, optional
        Give up when nothing came for this long.
    check
        Called about every ``poll_s`` while waiting; what it raises ends the wait.

    Raises
    ------
    Closed, Silent
    """
    kind, length = _HEADER.unpack(_exactly(fd, _HEADER.size, silence_s, poll_s, check))
    if length > MAX_BYTES:
        raise Closed(f"a message of {length} bytes: the stream is broken")
    return kind, _exactly(fd, length, silence_s, poll_s, check)


def _exactly(
    fd: int, count: int, silence_s: float | None, poll_s: float, check: Callable[[], None] | None
) -> bytes:
    pieces: list[bytes] = []
    heard = time.monotonic()
    while count:
        while not select.select([fd], [], [], poll_s)[0]:
            if check is not None:
                check()
            if silence_s is not None and time.monotonic() - heard > silence_s:
                raise Silent(f"nothing heard for {silence_s:g} s")
        piece = os.read(fd, min(count, 1 << 20))
        if not piece:
            raise Closed("the pipe's writer is gone")
        pieces.append(piece)
        count -= len(piece)
        heard = time.monotonic()
    return b"".join(pieces)


def pack_row(row: int) -> bytes:
    return _ROW.pack(row)


def unpack_row(body: bytes) -> int:
    return int(_ROW.unpack(body)[0])


def pack_label(row: int, label: Label) -> bytes:
    return _LABEL.pack(row, int(label.outcome), label.width_m, label.quality)


def unpack_label(body: bytes) -> tuple[int, Label]:
    row, outcome, width, quality = _LABEL.unpack(body)
    return int(row), Label(Outcome(outcome), width, quality)


@dataclass(frozen=True)
class Chunk:
    """Body of a ``CHUNK``.

    Attributes
    ----------
    payload_json : str
        A simulate job's payload.
    known : mapping
        Labels, by row of the chunk, that an earlier child found or died of.
    pose_s : float
        After this many seconds in one closing the child ends itself.
    parts_glb : bytes
    """

    payload_json: str
    known: Mapping[int, Label]
    pose_s: float
    parts_glb: bytes


def pack_chunk(chunk: Chunk) -> bytes:
    known = [
        [row, int(label.outcome), _or_none(label.width_m), _or_none(label.quality)]
        for row, label in chunk.known.items()
    ]
    header = json.dumps({"payload": chunk.payload_json, "known": known, "pose_s": chunk.pose_s}).encode()
    return _LENGTH.pack(len(header)) + header + chunk.parts_glb


def unpack_chunk(body: bytes) -> Chunk:
    (length,) = _LENGTH.unpack_from(body)
    header = json.loads(body[_LENGTH.size : _LENGTH.size + length])
    known = {
        int(row): Label(Outcome(int(outcome)), _or_nan(width), _or_nan(quality))
        for row, outcome, width, quality in header["known"]
    }
    return Chunk(header["payload"], known, float(header["pose_s"]), body[_LENGTH.size + length :])


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)

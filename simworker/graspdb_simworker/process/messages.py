"""Bodies of the messages between a worker and its simulating child."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from graspdb_simworker.simulation.labels import Label, Outcome

_ROW = struct.Struct("<q")
_LABEL = struct.Struct("<qBdd")
_LENGTH = struct.Struct("<I")


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
    """Body of a ``CHUNK``: a simulate job's payload and the object's convex parts.

    ``known`` are labels, by row of the chunk, that an earlier child found or died of; after ``pose_s``
    seconds in one closing the child ends itself.
    """

    payload_json: str
    known: Mapping[int, Label]
    pose_s: float
    parts_glb: bytes


def pack_chunk(chunk: Chunk) -> bytes:
    known = [[row, int(label.outcome), label.width_m, label.quality] for row, label in chunk.known.items()]
    header = json.dumps({"payload": chunk.payload_json, "known": known, "pose_s": chunk.pose_s}).encode()
    return _LENGTH.pack(len(header)) + header + chunk.parts_glb


def unpack_chunk(body: bytes) -> Chunk:
    (length,) = _LENGTH.unpack_from(body)
    header = json.loads(body[_LENGTH.size : _LENGTH.size + length])
    known = {row: Label(Outcome(outcome), *measured) for row, outcome, *measured in header["known"]}
    return Chunk(header["payload"], known, header["pose_s"], body[_LENGTH.size + length :])

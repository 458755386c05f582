"""What a ``CHUNK`` says. Bodies of messages between a worker and its own child are pickled."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from graspdb_simworker.simulation.labels import Label


class Chunk(NamedTuple):
    """A simulate job's payload and the object's convex parts.

    ``known`` are labels, by the number of the closing, that an earlier child found or died of; after
    ``pose_s`` seconds in one closing the child ends itself.
    """

    payload_json: str
    known: Mapping[int, Label]
    pose_s: float
    parts_glb: bytes

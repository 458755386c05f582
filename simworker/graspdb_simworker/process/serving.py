"""The child's work: chunks in, labels and results out. Imported only where there is an engine."""

from __future__ import annotations

import pickle
import signal

from graspdb.wire import SimulatePayload
from graspdb_geometry import meshes
from graspdb_simworker.process import channel
from graspdb_simworker.process.messages import Chunk
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.labels import Label

WORKPIECE_FIELDS = {
    "parts_sha256",
    "mass_kg",
    "friction",
    "gripper",
    "protocol",
    "fidelity",
    "engine",
    "randomise",
}
"""Chunks that agree in these share their worlds."""


def serve(source: int, sink: int) -> None:
    """Answer chunks until the worker closes the pipe (which raises :class:`channel.Closed`)."""
    channel.send(sink, channel.READY)
    inbox = channel.Inbox(source)
    key: str | None = None
    workpiece: chunks.Workpiece | None = None
    while True:
        kind, body = inbox.receive(poll_s=3600.0)
        if kind != channel.CHUNK:
            raise channel.Closed(f"unexpected message {kind!r}")
        try:
            chunk: Chunk = pickle.loads(body)
            payload = SimulatePayload.model_validate_json(chunk.payload_json)
            wanted = payload.model_dump_json(include=WORKPIECE_FIELDS)
            if workpiece is None or key != wanted:
                if workpiece is not None:
                    workpiece.close()
                workpiece, key = None, None
                workpiece, key = chunks.prepare(payload, meshes.parts_from_glb(chunk.parts_glb)), wanted

            # By the processor's time: what else the machine does must not change a label.
            def before(closing: int, limit: float = chunk.pose_s) -> None:
                channel.send(sink, channel.BEFORE, pickle.dumps(closing))
                signal.setitimer(signal.ITIMER_PROF, limit)

            def after(closing: int, label: Label) -> None:
                signal.setitimer(signal.ITIMER_PROF, 0.0)
                channel.send(sink, channel.AFTER, pickle.dumps((closing, label)))

            result = chunks.simulate_chunk(payload, workpiece, known=chunk.known, before=before, after=after)
        except channel.Closed:
            raise
        except Exception as error:  # noqa: BLE001 - the chunk's failure, told to the worker
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            channel.send(sink, channel.ERROR, f"{type(error).__name__}: {error}".encode())
            continue
        channel.send(sink, channel.RESULT, result.model_dump_json().encode())

"""One simulating child, started, watched, killed and replaced: whatever a pose does to it, the chunk gets
its result."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from graspdb.processes import ChildProcess
from graspdb.wire import SimulatePayload, SimulateResult
from graspdb_simworker.process import channel
from graspdb_simworker.process.messages import Chunk
from graspdb_simworker.process.runner import ChunkCancelled, ChunkFailed, ChunkRunner, PhysicsMissing
from graspdb_simworker.simulation.labels import SIMULATION_ERROR, Label

COMMAND = (sys.executable, "-m", "graspdb_simworker.process.child")
POSE_SECONDS = 10.0
"""A closing takes milliseconds; after so much of the processor's time it hangs."""
SILENT = 6.0
"""A process that says nothing for this many times as long by the clock sleeps, however busy the machine."""
START_SECONDS = 600.0
"""Loading an engine and, the first time on a machine, compiling the collision test; if starved, too."""
RECYCLE_CHUNKS = 64
"""pybullet leaks: a child is replaced after this many chunks."""
GATHER_S = 0.02
"""A child tells of every closing, some hundred times a second: so long they may wait to be read together."""
MAX_DEATHS = 50
"""More dead children than this in one chunk are no bad luck with poses any more."""


class LocalRunner(ChunkRunner):
    """A simulating process and its replacements; used by one thread.

    ``command`` starts what answers as :mod:`.child` does. A closing may take ``pose_s`` seconds of the
    processor; after ``recycle_chunks`` chunks the process is replaced.
    """

    def __init__(
        self,
        command: Sequence[str] = COMMAND,
        *,
        pose_s: float = POSE_SECONDS,
        recycle_chunks: int = RECYCLE_CHUNKS,
    ) -> None:
        self._command = tuple(command)
        self._pose_s = pose_s
        self._recycle = recycle_chunks
        self._process: ChildProcess | None = None
        self._inbox: channel.Inbox | None = None
        self._chunks = 0

    def __exit__(self, *_: object) -> None:
        self.kill()

    @property
    def pid(self) -> int | None:
        """Process id of the living child."""
        return None if self._process is None else self._process.pid

    def kill(self) -> None:
        """End the child at once; harmless if there is none. May be called from any thread."""
        process, self._process = self._process, None
        if process is not None:
            channel.end(process)

    def run(
        self,
        payload: SimulatePayload,
        parts_glb: bytes,
        *,
        wanted: Callable[[], bool] = lambda: True,
        progress: Callable[[int], None] = lambda simulated: None,
    ) -> SimulateResult:
        """Simulate a chunk, replacing the process as often as a pose kills it; ``progress`` is told how many
        closings of the chunk are done."""
        known: dict[int, Label] = {}
        deaths = 0

        def check() -> None:
            if not wanted():
                raise ChunkCancelled

        try:
            while True:
                process, inbox = self._started(check)
                attempt = _Attempt(process, inbox, known, self._pose_s, check, progress)
                outcome = attempt.run(payload, parts_glb)
                if outcome is not None:
                    self._chunks += 1
                    if self._chunks >= self._recycle:
                        self.kill()
                    return outcome
                cause = self._cause_of_death()
                deaths += 1
                if attempt.simulating is not None:
                    known[attempt.simulating] = SIMULATION_ERROR
                elif attempt.heard == 0 and deaths > 1:
                    raise ChunkFailed(f"the simulating process dies before its first grasp: {cause}")
                if deaths > MAX_DEATHS:
                    raise ChunkFailed(f"{deaths} simulating processes died in this chunk, the last: {cause}")
        except BaseException:
            self.kill()
            raise

    def _started(self, check: Callable[[], None]) -> tuple[ChildProcess, channel.Inbox]:
        if self._process is not None and self._inbox is not None:
            return self._process, self._inbox
        self._chunks = 0
        process = self._process = channel.start(self._command)
        inbox = self._inbox = channel.Inbox(_fd(process.stdout), pause_s=GATHER_S)
        try:
            kind, body = inbox.receive(silence_s=START_SECONDS, check=check)
        except (channel.Closed, channel.Silent) as error:
            raise ChunkFailed(f"the simulating process did not start: {self._cause_of_death()}") from error
        if kind == channel.MISSING:
            raise PhysicsMissing(body.decode(errors="replace"))
        return process, inbox

    def _cause_of_death(self) -> str:
        process = self._process
        if process is None:
            return "killed"
        try:
            code = process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            code = None
        self.kill()
        if code is None:
            return "it hung and was killed"
        if code >= 0:
            return f"exit code {code}"
        name = signal.Signals(-code).name
        return "a grasp took too long" if name == "SIGPROF" else name


@dataclass
class _Attempt:
    """One try of one process at a chunk; remembers how far it came."""

    process: ChildProcess
    inbox: channel.Inbox
    known: dict[int, Label]
    pose_s: float
    check: Callable[[], None]
    progress: Callable[[int], None]
    simulating: int | None = None
    heard: int = 0

    def run(self, payload: SimulatePayload, parts_glb: bytes) -> SimulateResult | None:
        """The result, or None if the process died or fell silent."""
        chunk = Chunk(payload.model_dump_json(), self.known, self.pose_s, parts_glb)
        try:
            channel.send(_fd(self.process.stdin), channel.CHUNK, pickle.dumps(chunk))
            while True:
                # Before the first closing the prefilter runs: minutes at worst, for the largest chunks.
                silence = START_SECONDS if self.simulating is None else SILENT * self.pose_s + 5.0
                kind, body = self.inbox.receive(silence_s=silence, check=self.check)
                self.heard += 1
                # Here too: a busy child leaves no silence in which to ask.
                self.check()
                if kind == channel.BEFORE:
                    self.simulating = pickle.loads(body)
                elif kind == channel.AFTER:
                    closing, label = pickle.loads(body)
                    self.known[closing] = label
                    self.simulating = None
                    self.progress(len(self.known))
                elif kind == channel.RESULT:
                    return SimulateResult.model_validate_json(body)
                elif kind == channel.ERROR:
                    raise ChunkFailed(body.decode(errors="replace"))
        except (channel.Closed, channel.Silent):
            return None


def _fd(pipe: object) -> int:
    return pipe.fileno()  # type: ignore[attr-defined,no-any-return]

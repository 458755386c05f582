"""One pybullet child, started, watched, killed and replaced: whatever a pose does to it, the chunk gets
its result."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from types import TracebackType

from graspdb.wire import SimulatePayload, SimulateResult
from graspdb_simworker import messages
from graspdb_simworker.labels import SIMULATION_ERROR, Label

COMMAND = (sys.executable, "-m", "graspdb_simworker.child")
POSE_SECONDS = 10.0
"""A closing takes milliseconds; after so much of the processor's time it hangs."""
SILENT = 6.0
"""A process that says nothing for this many times as long by the clock sleeps, however busy the machine."""
START_SECONDS = 120.0
"""Loading pybullet and, the first time on a machine, compiling the collision test."""
RECYCLE_CHUNKS = 64
"""pybullet leaks: a child is replaced after this many chunks."""
MAX_DEATHS = 50
"""More dead children than this in one chunk are no bad luck with poses any more."""

_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


class Cancelled(Exception):
    """The chunk is not wanted any more."""


class ChunkFailed(Exception):
    """The chunk can't be simulated; the message says why."""


class PybulletMissing(Exception):
    """The child could not import pybullet."""


class Child:
    """A simulating process and its replacements; used by one thread.

    Parameters
    ----------
    command : sequence of str
        Starts the process that speaks :mod:`graspdb_simworker.messages`.
    pose_s : float
        Longest closing, seconds of the processor.
    recycle_chunks : int
        Chunks before the process is replaced.
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
        self._process: subprocess.Popen[bytes] | None = None
        self._chunks = 0

    def __enter__(self) -> Child:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()

    @property
    def pid(self) -> int | None:
        """Process id of the living child."""
        return None if self._process is None else self._process.pid

    def kill(self) -> None:
        """End the child at once; harmless if there is none. May be called from any thread."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()

    def run(
        self,
        payload: SimulatePayload,
        parts_glb: bytes,
        *,
        wanted: Callable[[], bool] = lambda: True,
        progress: Callable[[int], None] = lambda simulated: None,
    ) -> SimulateResult:
        """Simulate a chunk, replacing the child as often as a pose kills it.

        Parameters
        ----------
        payload : SimulatePayload
        parts_glb : bytes
            The object's convex parts.
        wanted
            Asked several times a second; the child is killed as soon as it says no.
        progress
            Told how many closings of the chunk are done.

        Raises
        ------
        Cancelled
            If it was not wanted any more.
        ChunkFailed
            With the reason, if the chunk as a whole can't be simulated.
        PybulletMissing
        """
        known: dict[int, Label] = {}
        deaths = 0

        def check() -> None:
            if not wanted():
                raise Cancelled

        try:
            while True:
                process = self._started(check)
                attempt = _Attempt(process, known, self._pose_s, check, progress)
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

    def _started(self, check: Callable[[], None]) -> subprocess.Popen[bytes]:
        if self._process is not None:
            return self._process
        self._chunks = 0
        process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, **_ONE_THREAD}
        )
        self._process = process
        try:
            kind, body = messages.receive(_fd(process.stdout), silence_s=START_SECONDS, check=check)
        except (messages.Closed, messages.Silent) as error:
            raise ChunkFailed(f"the simulating process did not start: {self._cause_of_death()}") from error
        if kind == messages.MISSING:
            raise PybulletMissing(body.decode(errors="replace"))
        return process

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


class _Attempt:
    """One try of one process at a chunk; remembers how far it came."""

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        known: dict[int, Label],
        pose_s: float,
        check: Callable[[], None],
        progress: Callable[[int], None],
    ) -> None:
        self._process = process
        self._known = known
        self._pose_s = pose_s
        self._check = check
        self._progress = progress
        self.simulating: int | None = None
        self.heard = 0

    def run(self, payload: SimulatePayload, parts_glb: bytes) -> SimulateResult | None:
        """The result, or None if the process died or fell silent."""
        chunk = messages.Chunk(payload.model_dump_json(), self._known, self._pose_s, parts_glb)
        try:
            messages.send(_fd(self._process.stdin), messages.CHUNK, messages.pack_chunk(chunk))
            while True:
                # Before the first closing the prefilter runs: minutes at worst, for the largest chunks.
                silence = START_SECONDS if self.simulating is None else SILENT * self._pose_s + 5.0
                kind, body = messages.receive(_fd(self._process.stdout), silence_s=silence, check=self._check)
                self.heard += 1
                # Here too: a busy child leaves no silence in which to ask.
                self._check()
                if kind == messages.BEFORE:
                    self.simulating = messages.unpack_row(body)
                elif kind == messages.AFTER:
                    row, label = messages.unpack_label(body)
                    self._known[row] = label
                    self.simulating = None
                    self._progress(len(self._known))
                elif kind == messages.RESULT:
                    return SimulateResult.model_validate_json(body)
                elif kind == messages.ERROR:
                    raise ChunkFailed(body.decode(errors="replace"))
        except (messages.Closed, messages.Silent):
            return None


def _fd(pipe: object) -> int:
    return pipe.fileno()  # type: ignore[attr-defined,no-any-return]

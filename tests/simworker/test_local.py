"""Children that die, hang or are not wanted any more; real processes."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspdb.examples import example
from graspdb.wire import SimulatePayload
from graspdb.wire.sweeps import Randomise
from graspdb_simworker.process import channel, local
from graspdb_simworker.process.local import LocalRunner
from graspdb_simworker.process.runner import ChunkCancelled, ChunkFailed, PhysicsMissing
from graspdb_simworker.simulation import chunks, draws
from graspdb_simworker.simulation.labels import Outcome

MakePayload = Callable[..., SimulatePayload]
GetWorkpiece = Callable[..., chunks.Workpiece]
FindPoses = Callable[[str, int], list[tuple[Any, Any]]]
FAULTY = (sys.executable, str(Path(__file__).with_name("faulty_child.py")))


@pytest.fixture(scope="module")
def mug_glb() -> bytes:
    return example("mug").parts_glb()


def alive(pid: int) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    return False


def test_a_child_gives_the_bytes_of_this_process_and_so_does_the_next(
    payload_of: MakePayload, workpiece_of: GetWorkpiece, mug_glb: bytes
) -> None:
    payload = payload_of("mug", stop=2_000)
    here = chunks.simulate_chunk(payload, workpiece_of("mug"))
    seen: list[int] = []
    with LocalRunner(recycle_chunks=2) as runner:
        results = []
        pids = []
        for _ in range(3):
            results.append(runner.run(payload, mug_glb, progress=seen.append))
            pids.append(runner.pid)
    # The parts travelled as GLB, in float32: the same labels, and widths within its rounding of a micrometre.
    assert results[0] == results[1] == results[2]
    assert pids[0] is not None
    assert pids[1] is None, "recycled after two chunks"
    assert pids[2] not in (None, pids[0])
    assert results[0].rows.pose_index == here.rows.pose_index
    different = np.frombuffer(results[0].outcomes, np.uint8) != np.frombuffer(here.outcomes, np.uint8)
    assert different.mean() < 0.002
    assert seen == list(range(1, len(here.rows.pose_index) + 1)) * 3


@pytest.mark.parametrize("how", ["crash", "hang", "spin"])
def test_a_deadly_pose_is_a_simulation_error_and_the_rest_goes_on(
    payload_of: MakePayload, physical_poses: FindPoses, mug_glb: bytes, how: str
) -> None:
    poses = physical_poses("mug", 12)
    payload = payload_of("mug", poses=poses)
    with LocalRunner() as runner:
        healthy = runner.run(payload, mug_glb)
    deadly = poses[7][0]
    with LocalRunner((*FAULTY, how, *map(repr, deadly)), pose_s=0.5) as runner:
        result = runner.run(payload, mug_glb)
    hit = np.array([np.allclose(p, deadly) for p, _ in poses])
    found, expected = (np.frombuffer(r.outcomes, np.uint8) for r in (result, healthy))
    assert hit[7]
    assert (found[hit] == Outcome.SIMULATION_ERROR).all()
    np.testing.assert_array_equal(found[~hit], expected[~hit])
    assert result.rows.pose_index == healthy.rows.pose_index
    assert result.rows.width_m[7] is None
    assert [q for q, dead in zip(result.rows.quality, hit, strict=True) if not dead] == [
        q for q, dead in zip(healthy.rows.quality, hit, strict=True) if not dead
    ]


def test_a_deadly_draw_is_one_that_did_not_hold(
    payload_of: MakePayload, physical_poses: FindPoses, mug_glb: bytes
) -> None:
    asked = Randomise(draws=3, pose_noise_m=1e-4, pose_noise_deg=0.1, seed=4)
    payload = payload_of("mug", poses=physical_poses("mug", 8), start=5, randomise=asked)
    with LocalRunner() as runner:
        healthy = runner.run(payload, mug_glb)
    assert healthy.successes is not None
    row = int(np.argmax(list(healthy.successes)))
    assert healthy.successes[row] == 3
    deadly = draws.noisy(asked, 1, *chunks.poses_of(payload))[0][row]
    seen: list[int] = []
    with LocalRunner((*FAULTY, "crash", *map(repr, deadly.tolist()))) as runner:
        result = runner.run(payload, mug_glb, progress=seen.append)
    expected = list(healthy.successes)
    expected[row] = 2
    assert result.successes is not None
    assert list(result.successes) == expected
    assert result.outcomes == healthy.outcomes
    assert result.rows.pose_index == healthy.rows.pose_index
    assert seen == sorted(seen)


def test_what_a_chunk_raises_is_its_failure_and_the_child_lives_on(
    payload_of: MakePayload, physical_poses: FindPoses, mug_glb: bytes
) -> None:
    poses = physical_poses("mug", 3)
    with LocalRunner((*FAULTY, "raise", *map(repr, poses[1][0]))) as runner:
        with pytest.raises(ChunkFailed, match="RuntimeError: the parts make no sense"):
            runner.run(payload_of("mug", poses=poses), mug_glb)
        assert len(runner.run(payload_of("mug", poses=poses[:1]), mug_glb).outcomes) == 1
        with pytest.raises(ChunkFailed, match="GLB"):
            runner.run(payload_of("mug", poses=poses[:1], parts_sha256="other"), b"no GLB at all")


def test_a_child_that_dies_at_once_fails_the_chunk(payload_of: MakePayload, mug_glb: bytes) -> None:
    with LocalRunner((*FAULTY, "start")) as runner, pytest.raises(ChunkFailed, match="exit code 3"):
        runner.run(payload_of("mug", stop=10), mug_glb)


WITHOUT = (
    "import sys; sys.modules.update(dict.fromkeys({missing}));"
    " from graspdb_simworker.process import child; sys.exit(child.main())"
)


def test_a_missing_engine_is_told_apart(payload_of: MakePayload, mug_glb: bytes) -> None:
    script = WITHOUT.format(missing=["pybullet", "mujoco"])
    with (
        LocalRunner((sys.executable, "-c", script)) as runner,
        pytest.raises(PhysicsMissing, match=r"pybullet.*graspdb\[sim,mujoco\]"),
    ):
        runner.run(payload_of("mug", stop=10), mug_glb)


def test_without_pybullet_mujoco_simulates(
    payload_of: MakePayload, mug_glb: bytes, grasps: dict[str, tuple[Any, Any]]
) -> None:
    with LocalRunner((sys.executable, "-c", WITHOUT.format(missing=["pybullet"]))) as runner:
        held = runner.run(payload_of("mug", poses=[grasps["rim"], grasps["above"]]), mug_glb)
        assert list(held.outcomes) == [Outcome.SUCCESS, Outcome.MISSED]
        with pytest.raises(ChunkFailed, match=r"pybullet is not installed: `pip install 'graspdb\[sim\]'`"):
            runner.run(payload_of("mug", poses=[grasps["rim"]], engine="pybullet"), mug_glb)


def test_a_chunk_that_is_not_wanted_any_more_kills_its_child(payload_of: MakePayload, mug_glb: bytes) -> None:
    lost = threading.Event()
    with LocalRunner() as runner:
        pids: list[int | None] = []

        def progress(done: int) -> None:
            pids.append(runner.pid)
            lost.set()

        with pytest.raises(ChunkCancelled):
            runner.run(
                payload_of("mug", stop=100_000), mug_glb, wanted=lambda: not lost.is_set(), progress=progress
            )
        assert pids[0] is not None
        assert not alive(pids[0])
        assert runner.pid is None
        # And the next chunk gets a new one.
        assert len(runner.run(payload_of("mug", stop=50), mug_glb).outcomes) == 50


WORKER = """
import pathlib, sys
from graspdb.wire import SimulatePayload
from graspdb_simworker.process.local import LocalRunner
payload, parts, *command = sys.argv[1:]
LocalRunner(command, pose_s=600.0).run(
    SimulatePayload.model_validate_json(payload),
    pathlib.Path(parts).read_bytes(),
    progress=lambda done: print(done, flush=True),
)
"""


@pytest.mark.parametrize("moment", ["early", "simulating", "hung"])
def test_a_child_ends_with_a_killed_worker(
    payload_of: MakePayload,
    physical_poses: FindPoses,
    mug_glb: bytes,
    tmp_path: Path,
    descendants: Callable[[], list[str]],
    eventually: Callable[..., Any],
    moment: str,
) -> None:
    poses = physical_poses("mug", 2)
    payload = payload_of("mug", poses=poses) if moment == "hung" else payload_of("mug", stop=100_000)
    command = (*FAULTY, "hang", *map(repr, poses[1][0])) if moment == "hung" else local.COMMAND
    (tmp_path / "parts.glb").write_bytes(mug_glb)
    arguments = [payload.model_dump_json(), str(tmp_path / "parts.glb"), *command]
    with subprocess.Popen([sys.executable, "-c", WORKER, *arguments], stdout=subprocess.PIPE) as worker:
        assert worker.stdout is not None
        if moment == "early":
            eventually(lambda: len(descendants()) == 2)
            time.sleep(np.random.default_rng().uniform(0.0, 2.0))
        else:
            assert worker.stdout.readline() == b"1\n"
        worker.kill()
        eventually(lambda: not descendants(), 10)


def test_messages_survive_the_pipe_and_broken_pipes_are_noticed() -> None:
    reader, writer = os.pipe()
    big = os.urandom(3 << 20)
    thread = threading.Thread(target=channel.send, args=(writer, channel.RESULT, big))
    thread.start()
    inbox = channel.Inbox(reader)
    assert inbox.receive(silence_s=10.0) == (channel.RESULT, big)
    thread.join()
    for body in (b"", b"one", b"two"):
        channel.send(writer, channel.NOTE, body)
    inbox = channel.Inbox(reader, pause_s=0.01)
    assert [inbox.receive()[1] for _ in range(3)] == [b"", b"one", b"two"]
    with pytest.raises(channel.Silent):
        inbox.receive(silence_s=0.1, poll_s=0.02)
    os.close(writer)
    with pytest.raises(channel.Closed):
        inbox.receive()
    os.close(reader)

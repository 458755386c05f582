"""How many trials it takes to a best grasp that holds, by the strategy that proposes them.

``python tests/benchmarks/statistics_proposals.py [OBJECT ...] [--strategies expected_improvement,uncertainty]
[--seeds 10] [--most 100] [--cone 30]``

Each run starts from the same 10 draws of ``edges`` and goes on in batches of 10: proposed by the service,
executed in simulation (`wrench`, PG70), posted as they were commanded. An execution displaces the tool by
2 mm and turns it by 2 degrees, normal along and about every axis of its frame. What collides as commanded is
a ``collision``, what does so only as executed a ``failure``. After every batch the best grasp is asked for by
success probability, with an approach within a cone about straight down (``--cone 0``: with any), and executed
100 times. It is reached with the first batch after which it holds in 95 of them, if it does so after the next
batch, too; runs end there, or after ``--most`` trials and one batch: these count as more, in the mean as
one batch more.
"""

from __future__ import annotations

import argparse
import math
import os
import socket
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb import Client
from graspdb.errors import Conflict, Infeasible, Unreachable
from graspdb.examples import EXAMPLES
from graspdb.processes import ChildProcess
from graspdb.resources.objects import GraspObject
from graspdb.resources.trials import DoubtfulTrials
from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_geometry import collision
from graspdb_simworker.inspection import inputs
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.labels import Outcome

NOISE_M, NOISE_RAD = 0.002, math.radians(2.0)
FIRST = BATCH = 10
EXECUTIONS, HOLDS = 100, 95
GRIPPER, PROTOCOL = "pg70", "wrench"


class Simulation:
    """One of the paper's objects, grasped by a robot that is not exact."""

    def __init__(self, name: str) -> None:
        payload, parts = inputs.load(name, GRIPPER, protocol=PROTOCOL)
        self.workpiece = chunks.prepare(payload, parts)

    def executed(self, poses: Poses, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Whether each holds where the tool came to."""
        turns = se3.from_rotation_vector(rng.standard_normal((len(poses), 3)) * NOISE_RAD)
        moves = se3.rotate(poses.quaternions_xyzw, rng.standard_normal((len(poses), 3)) * NOISE_M)
        p = poses.positions + moves
        q = se3.normalise(se3.multiply(poses.quaternions_xyzw, turns))
        codes, travel = self.workpiece.classify(p, q)
        held = np.zeros(len(poses), dtype=np.bool_)
        for i in np.flatnonzero(codes == collision.CONTACT):
            held[i] = self.workpiece.simulate(p[i], q[i], float(travel[i])).outcome is Outcome.SUCCESS
        return held

    def tried(self, poses: Poses, rng: np.random.Generator) -> list[str]:
        """What a robot would post of each."""
        codes, _ = self.workpiece.classify(poses.positions, poses.quaternions_xyzw)
        held = self.executed(poses, rng)
        return [
            "collision" if code == collision.COLLIDES else "success" if won else "failure"
            for code, won in zip(codes, held, strict=True)
        ]

    def holds(self, position: Any, quaternion: Any, rng: np.random.Generator) -> bool:
        """Whether a grasp holds in 95 of 100 executions; ends once it can't any more."""
        missed = 0
        for _ in range(EXECUTIONS // 10):
            some = Poses(np.tile(np.array(position), (10, 1)), np.tile(np.array(quaternion), (10, 1)))
            missed += int((~self.executed(some, rng)).sum())
            if missed > EXECUTIONS - HOLDS:
                return False
        return True


def run(
    item: GraspObject, simulation: Simulation, strategy: str, seed: int, bounds: dict[str, Any], most: int
) -> tuple[float, float]:
    """Trials until the best grasp holds, infinite where it does not, and seconds a batch was waited for."""
    rng = np.random.default_rng(seed)
    held_before, tried, waited = False, 0, list[float]()
    while True:
        started = time.perf_counter()
        drawn = proposed(item, strategy if tried else "edges", seed + 1_000 * tried, bounds)
        if tried:
            waited.append(time.perf_counter() - started)
        poses = Poses(drawn.position, drawn.quaternion_xyzw)
        item.trials.add(
            drawn,
            simulation.tried(poses, rng),
            proposal_density=drawn.proposal_density,
            gripper=GRIPPER,
            protocol=PROTOCOL,
            accept_implausible=True,
        )
        tried += len(poses)
        held = best_holds(item, simulation, bounds, np.random.default_rng([seed, tried]))
        if held and held_before:
            return tried - BATCH, statistics.median(waited)
        if tried >= most + BATCH:
            return math.inf, statistics.median(waited)
        held_before = held


def proposed(item: GraspObject, strategy: str, seed: int, bounds: dict[str, Any]) -> Any:
    """The next grasps; of the edges where nothing has succeeded that a strategy could start from."""
    more = bounds if strategy == "expected_improvement" else {}
    try:
        return item.proposals(BATCH, strategy=strategy, gripper=GRIPPER, seed=seed, **more)
    except Conflict:
        return item.proposals(BATCH, strategy="edges", gripper=GRIPPER, seed=seed)


def best_holds(
    item: GraspObject, simulation: Simulation, bounds: dict[str, Any], rng: np.random.Generator
) -> bool:
    """Whether there is a best grasp that holds."""
    try:
        best = item.best_grasp(objective="success_probability", prior=False, gripper=GRIPPER, **bounds)
    except (Infeasible, Conflict):
        return False
    return simulation.holds(best.position, best.quaternion_xyzw, rng)


def answers(db: Client) -> bool:
    """Whether the service has started."""
    try:
        return next(iter(db.objects.list()), None) is None
    except Unreachable:
        return False


@contextmanager
def service(folder: Path) -> Iterator[Client]:
    """A service of its own, in one thread."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    serving = "from graspdb_service.cli import main; main()"
    environment = os.environ | {"GRASPDB_DATABASE_URL": f"sqlite:///{folder / 'proposals.sqlite'}"}
    with (folder / "log").open("w") as log:
        command = [sys.executable, "-c", serving, "serve", "--port", str(port), "--log-level", "warning"]
        process = ChildProcess(command, env=environment, stdout=log, stderr=log)
        try:
            with Client(f"http://127.0.0.1:{port}") as db:
                while not answers(db):
                    time.sleep(0.1)
                yield db
        finally:
            process.terminate()
            process.wait(15)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("objects", nargs="*", default=list(EXAMPLES))
    parser.add_argument("--strategies", default="expected_improvement,uncertainty")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--most", type=int, default=100)
    parser.add_argument("--cone", type=float, default=30.0)
    asked = parser.parse_args()
    # Draws of edges collide, some of them, and are posted all the same.
    warnings.simplefilter("ignore", DoubtfulTrials)
    bounds = {"approach": (0.0, 0.0, -1.0), "approach_cone_deg": asked.cone} if asked.cone else {}
    print("object       strategy                 mean  median   of each run, sorted; seconds a batch")
    with tempfile.TemporaryDirectory() as folder, service(Path(folder)) as db:
        for name in asked.objects:
            simulation = Simulation(name)
            for strategy in asked.strategies.split(","):
                runs = []
                for seed in range(asked.seeds):
                    item = db.add_example(name)
                    runs.append(run(item, simulation, strategy, seed, bounds, asked.most))
                    item.delete()
                trials = sorted(count for count, _ in runs)
                told = " ".join("more" if math.isinf(count) else f"{count:.0f}" for count in trials)
                seconds = statistics.median(seconds for _, seconds in runs)
                middle = statistics.median(trials)
                mean = statistics.mean(min(count, asked.most + BATCH) for count in trials)
                shown = f"> {asked.most}" if math.isinf(middle) else f"{middle:.0f}"
                print(f"{name:12} {strategy:20} {mean:7.1f} {shown:>7}   {told}; {seconds:.2f}", flush=True)
            simulation.workpiece.close()


if __name__ == "__main__":
    main()

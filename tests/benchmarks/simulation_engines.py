"""Two engines on the same grasps of the paper's four objects: how often they agree, on what they differ, and
how fast each is.

``--poses`` grasps an object, all of which meet physics, by both protocols; of one processor's time.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from graspdb.examples import EXAMPLES
from graspdb.wire.sweeps import Engine, Protocol
from graspdb_geometry import collision
from graspdb_simworker.inspection import agreement, inputs
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.labels import Label, Outcome

ENGINES: tuple[Engine, ...] = get_args(Engine)


class Run(NamedTuple):
    """What an engine says of grasps, and how many a second."""

    labels: list[Label]
    rate: float

    @property
    def outcomes(self) -> NDArray[np.int64]:
        return np.array([label.outcome for label in self.labels])

    @property
    def held(self) -> NDArray[np.bool_]:
        return self.outcomes == Outcome.SUCCESS


def compared(name: str, protocol: Protocol, count: int) -> list[Run]:
    """The same ``count`` random grasps of an object in each engine."""
    runs = []
    for engine in ENGINES:
        payload, parts = inputs.load(name, "pg70", protocol=protocol, engine=engine)
        payload = agreement.enough_poses(payload, parts, math.ceil(count / 3))
        workpiece = chunks.prepare(payload, parts)
        _, positions, quaternions = chunks.poses_of(payload)
        codes, travel = workpiece.classify(positions, quaternions)
        rows = np.flatnonzero(codes == collision.CONTACT)[:count].tolist()
        # Loads what is compiled.
        workpiece.simulate(positions[rows[0]], quaternions[rows[0]], float(travel[rows[0]]))
        started = time.process_time()
        labels = [workpiece.simulate(positions[r], quaternions[r], float(travel[r])) for r in rows]
        runs.append(Run(labels, len(rows) / (time.process_time() - started)))
        workpiece.close()
    return runs


def main() -> None:
    """Print a row for each object and protocol, and the kinds of disagreement."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--poses", type=int, default=300)
    parser.add_argument("--protocols", default="wrench,lift")
    asked = parser.parse_args()
    print(
        f"{'':22} {'grasps':>7} {'hold in':>9} {'and':>7} {'agree':>7} {'same':>7} {'grasps/s':>9} {'and':>7}"
    )
    kinds: Counter[str] = Counter()
    for protocol in asked.protocols.split(","):
        total, agree = 0, 0
        for name in EXAMPLES:
            bullet, mujoco = compared(name, protocol, asked.poses)
            same = bullet.held == mujoco.held
            total, agree = total + len(same), agree + int(same.sum())
            print(
                f"{name + ', ' + protocol:22} {len(same):7} {bullet.held.mean():9.3f}"
                f" {mujoco.held.mean():7.3f}"
                f" {same.mean():7.3f} {(bullet.outcomes == mujoco.outcomes).mean():7.3f}"
                f" {bullet.rate:9.0f} {mujoco.rate:7.0f}",
                flush=True,
            )
            for one, two in zip(bullet.labels, mujoco.labels, strict=True):
                if (one.outcome is Outcome.SUCCESS) != (two.outcome is Outcome.SUCCESS):
                    kinds[
                        f"{one.outcome.name.lower()} in pybullet, {two.outcome.name.lower()} in MuJoCo"
                    ] += 1
        print(f"{protocol}: {agree / total:.4f} of {total} agree")
    for kind, number in kinds.most_common():
        print(f"{number:5} {kind}")


if __name__ == "__main__":
    main()

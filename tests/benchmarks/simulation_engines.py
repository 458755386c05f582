"""Two engines on the same grasps of the paper's four objects: how often they agree, on what they differ, and
how fast each is.

``--poses`` random grasps an object, all of which meet physics, by ``--protocols``; of one processor's time.
Agreement says little where few hold: with ``--halved`` half of the grasps are ones that hold by ``wrench`` in
pybullet, and ``--lighter 10`` makes every object so many times lighter. What the engines differ on is
simulated in both at the fine step: whom that sides with.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from graspdb.examples import EXAMPLES
from graspdb.wire import SimulatePayload
from graspdb.wire.sweeps import Engine, Fidelity, Protocol
from graspdb_geometry import collision
from graspdb_simworker.inspection import agreement, inputs
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.bodies import Part
from graspdb_simworker.simulation.labels import Label, Outcome

ENGINES: tuple[Engine, ...] = get_args(Engine)


class Run(NamedTuple):
    """What an engine says of grasps, how many a second, and what it says of some of them at the fine step."""

    labels: list[Label]
    rate: float
    fine: dict[int, Label]

    @property
    def outcomes(self) -> NDArray[np.int64]:
        return np.array([label.outcome for label in self.labels])

    @property
    def held(self) -> NDArray[np.bool_]:
        return self.outcomes == Outcome.SUCCESS


class Grasps(NamedTuple):
    """Random grasps of an object that meet physics, and how to simulate them."""

    payload: SimulatePayload
    parts: Sequence[Part]
    positions: NDArray[np.float64]
    quaternions: NDArray[np.float64]
    travel: NDArray[np.float64]

    def simulate(self, engine: Engine, fidelity: Fidelity, rows: Iterable[int]) -> tuple[list[Label], float]:
        """Labels of some grasps, and how many a second."""
        payload = self.payload.model_copy(update={"engine": engine, "fidelity": fidelity})
        workpiece = chunks.prepare(payload, self.parts)

        def one(row: int) -> Label:
            return workpiece.simulate(self.positions[row], self.quaternions[row], float(self.travel[row]))

        # Loads what is compiled.
        one(0)
        started = time.process_time()
        labels = [one(row) for row in rows]
        rate = len(labels) / (time.process_time() - started)
        workpiece.close()
        return labels, rate

    def halved(self, count: int) -> Grasps:
        """The first ``count`` of which half hold by ``wrench`` in pybullet, if there are as many."""
        asked = self._replace(payload=self.payload.model_copy(update={"protocol": "wrench"}))
        labels, _ = asked.simulate("pybullet", "standard", range(len(self.travel)))
        holds = np.array([label.outcome is Outcome.SUCCESS for label in labels])
        some = np.concatenate([np.flatnonzero(holds == held)[: count // 2] for held in (True, False)])
        return self._replace(
            positions=self.positions[some], quaternions=self.quaternions[some], travel=self.travel[some]
        )


def grasps_of(name: str, protocol: Protocol, asked: argparse.Namespace) -> Grasps:
    """Random grasps of an object, as many as asked for."""
    payload, parts = inputs.load(name, "pg70", protocol=protocol)
    payload = payload.model_copy(update={"mass_kg": payload.mass_kg / asked.lighter})
    wanted = asked.poses * (8 if asked.halved else 1)
    payload = agreement.enough_poses(payload, parts, math.ceil(wanted / 3))
    _, positions, quaternions = chunks.poses_of(payload)
    workpiece = chunks.prepare(payload, parts)
    codes, travel = workpiece.classify(positions, quaternions)
    workpiece.close()
    # They come in the grid's order.
    rows = np.random.default_rng(0).permutation(np.flatnonzero(codes == collision.CONTACT))[:wanted]
    pool = Grasps(payload, parts, positions[rows], quaternions[rows], travel[rows])
    return pool.halved(asked.poses) if asked.halved else pool


def compared(grasps: Grasps) -> list[Run]:
    """The same grasps in each engine."""
    found = [grasps.simulate(engine, "standard", range(len(grasps.travel))) for engine in ENGINES]
    differ = [
        row
        for row, labels in enumerate(zip(*(labels for labels, _ in found), strict=True))
        if len({label.outcome is Outcome.SUCCESS for label in labels}) > 1
    ]
    runs = []
    for engine, (labels, rate) in zip(ENGINES, found, strict=True):
        again = grasps.simulate(engine, "fine", differ)[0] if differ else []
        runs.append(Run(labels, rate, dict(zip(differ, again, strict=True))))
    return runs


def kind(row: int, bullet: Run, mujoco: Run) -> str:
    """How two engines differ on a grasp, in words."""
    names = [run.labels[row].outcome.name.lower() for run in (bullet, mujoco)]
    one, two = (run.fine[row].outcome is Outcome.SUCCESS for run in (bullet, mujoco))
    if one != two:
        fine = "they differ at the fine step, too"
    else:
        fine = f"both {'hold' if one else 'fail'} at the fine step"
    return f"{names[0]} in pybullet, {names[1]} in MuJoCo; {fine}"


def main() -> None:
    """Print a row for each object and protocol, and the kinds of disagreement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--poses", type=int, default=300)
    parser.add_argument("--protocols", default="wrench,lift,shake")
    parser.add_argument("--lighter", type=float, default=1.0)
    parser.add_argument("--halved", action="store_true")
    asked = parser.parse_args()
    print(
        f"{'':22} {'grasps':>7} {'hold in':>9} {'and':>7} {'agree':>7} {'same':>7} {'grasps/s':>9} {'and':>7}"
    )
    for protocol in asked.protocols.split(","):
        kinds: Counter[str] = Counter()
        total, agree = 0, 0
        for name in EXAMPLES:
            bullet, mujoco = compared(grasps_of(name, protocol, asked))
            same = bullet.held == mujoco.held
            total, agree = total + len(same), agree + int(same.sum())
            print(
                f"{name + ', ' + protocol:22} {len(same):7} {bullet.held.mean():9.3f}"
                f" {mujoco.held.mean():7.3f}"
                f" {same.mean():7.3f} {(bullet.outcomes == mujoco.outcomes).mean():7.3f}"
                f" {bullet.rate:9.0f} {mujoco.rate:7.0f}",
                flush=True,
            )
            kinds.update(kind(row, bullet, mujoco) for row in bullet.fine)
        print(f"{protocol}: {agree / total:.4f} of {total} agree")
        for what, number in kinds.most_common():
            print(f"{number:5} {what}", flush=True)


if __name__ == "__main__":
    main()

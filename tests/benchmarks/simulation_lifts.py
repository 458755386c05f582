"""How fast the protocol ``lift`` is: the paper's objects, and a tube of a hundred parts.

Random poses of the 10 mm x 15 degree grid that meet physics, and of these the ones that the jaw stalled on
and carried; grasps per second of CPU time on one core.
"""

from __future__ import annotations

import math
import time

import numpy as np
import trimesh
from simulation_throughput import PG70

from graspdb.examples import EXAMPLES, example
from graspdb.wire import GridPlan, SimulatePayload
from graspdb_geometry import collision
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.bodies import Part
from graspdb_simworker.simulation.labels import Outcome

GRASPS = 200
CARRIED = 40
TUBE = 100


def tube() -> list[Part]:
    """A tube of 60 mm, its wall 4 mm thick, cut along its height into so many pieces."""
    parts = []
    for k in range(TUBE):
        angles = 2.0 * math.pi * np.array([k, k + 1]) / TUBE
        corners = [
            (r * math.cos(a), r * math.sin(a), z)
            for a in angles
            for r in (0.026, 0.030)
            for z in (-0.04, 0.04)
        ]
        hull = trimesh.convex.convex_hull(np.array(corners))
        parts.append((np.asarray(hull.vertices, dtype=np.float64), np.asarray(hull.faces, dtype=np.int64)))
    return parts


def measure(name: str, parts: list[Part], mass_kg: float) -> None:
    """Print one object's row."""
    corners = np.concatenate([vertices for vertices, _ in parts])
    payload = SimulatePayload(
        sweep="benchmark",
        object="benchmark",
        convex_parts="",
        parts_sha256=name,
        mass_kg=mass_kg,
        friction=0.4,
        gripper=PG70,
        protocol="lift",
        fidelity="standard",
        grid=GridPlan(
            lower=tuple(corners.min(axis=0).tolist()),
            upper=tuple(corners.max(axis=0).tolist()),
            position_step_m=0.01,
            rotation_step_deg=15.0,
            margin_m=0.02,
            max_poses=100_000,
            seed=1,
        ),
        start=0,
        stop=40_000,
    )
    workpiece = chunks.prepare(payload, parts)
    _, positions, quaternions = chunks.poses_of(payload)
    codes, travel = workpiece.classify(positions, quaternions)
    spent, carrying, successes, carried = 0.0, 0.0, 0, 0
    rows = np.flatnonzero(codes == collision.CONTACT)[:GRASPS]
    for done, row in enumerate(rows.tolist(), 1):  # noqa: B007
        started = time.process_time()
        label = workpiece.simulate(positions[row], quaternions[row], float(travel[row]))
        took = time.process_time() - started
        spent += took
        # Not what was squeezed out before the jaw stalled: of that, nothing was measured.
        if label.quality != 0.0 and math.isfinite(label.quality):
            carrying += took
            carried += 1
        successes += label.outcome is Outcome.SUCCESS
        if carried >= CARRIED:
            break
    workpiece.close()
    print(
        f"{name:16} {len(parts):>6} {done:>8} {carried:>8} {successes:>8} {done / spent:>12.1f}"
        f" {carried / carrying:>16.1f}"
    )


def main() -> None:
    heads = ("parts", "grasps", "carried", "held", "grasps/s", "of those carried")
    print(
        f"{'object':16} {heads[0]:>6} {heads[1]:>8} {heads[2]:>8} {heads[3]:>8} {heads[4]:>12} {heads[5]:>16}"
    )
    for name in EXAMPLES:
        thing = example(name)
        measure(name, list(thing.parts), thing.mass_kg)
    measure("tube", tube(), 0.075)


if __name__ == "__main__":
    main()

"""How fast grasps are simulated: prefilter, physics, force test and the whole chain, by object.

Random chunks of the 10 mm x 15 degree grid with 20 mm margin, one of each jaw-symmetric pair; medians
over chunks, per second of CPU time on one core. The last line, by the wall clock, compares two children
at once with one.
"""

from __future__ import annotations

import statistics
import threading
import time

import numpy as np

from graspdb.examples import EXAMPLES, example
from graspdb.wire import GridPlan, SimulatePayload
from graspdb.wire.presets.grippers import PRESETS
from graspdb_geometry import collision
from graspdb_simworker.process.local import LocalRunner
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.force_test import weakest_force

CHUNK = 10_000
ROUNDS = 5
TARGETS = {"cone": 10_000, "elongated-d": 20_000, "screwdriver": 2_000, "mug": 7_000}
PG70 = PRESETS["pg70"].profile


def payload(name: str, start: int, stop: int) -> SimulatePayload:
    """A chunk of a random tenth of a million poses of the object's grid."""
    thing = example(name)
    lower, upper = thing.bounds
    return SimulatePayload(
        sweep="benchmark",
        object=name,
        convex_parts="",
        parts_sha256=name,
        mass_kg=thing.mass_kg,
        friction=thing.friction,
        gripper=PG70,
        protocol="wrench",
        fidelity="standard",
        grid=GridPlan(
            lower=tuple(lower.tolist()),
            upper=tuple(upper.tolist()),
            position_step_m=0.01,
            rotation_step_deg=15.0,
            margin_m=0.02,
            max_poses=100_000,
            seed=1,
        ),
        start=start,
        stop=stop,
    )


def measure(name: str) -> None:
    """Print one object's row."""
    workpiece = chunks.prepare(payload(name, 0, 1), example(name).parts)
    chunks.simulate_chunk(payload(name, 0, 500), workpiece)  # compiles
    prefilter, physics, chain, shares = [], [], [], []
    for k in range(ROUNDS):
        chunk = payload(name, k * CHUNK, (k + 1) * CHUNK)
        _, positions, quaternions = chunks.poses_of(chunk)
        started = time.process_time()
        codes, _ = workpiece.classify(positions, quaternions)
        filtered = time.process_time() - started
        started = time.process_time()
        chunks.simulate_chunk(chunk, workpiece)
        whole = time.process_time() - started
        grasps = int((codes == collision.CONTACT).sum())
        prefilter.append(CHUNK / filtered)
        physics.append(grasps / (whole - filtered))
        chain.append(CHUNK / whole)
        shares.append(grasps / CHUNK)
    workpiece.close()
    median = statistics.median
    print(
        f"{name:12} {median(prefilter):>14,.0f} {100 * median(shares):>10.1f} {median(physics):>10,.0f}"
        f" {median(chain):>11,.0f} {TARGETS[name]:>9,}"
    )


def force_test() -> float:
    """Median microseconds of one force test with eight contacts."""
    rng = np.random.default_rng(0)
    normals = np.resize([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], (8, 3))
    normals[:2] += rng.normal(size=(2, 3)) * 0.1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    forces = rng.uniform(1.0, 10.0, 8)
    times = []
    for _ in range(300):
        started = time.perf_counter()
        weakest_force(normals, forces, 0.4)
        times.append(time.perf_counter() - started)
    return 1e6 * statistics.median(times)


def children(count: int) -> float:
    """Poses per second of so many children at once, on the mug."""
    parts = example("mug").parts_glb()
    ready = threading.Barrier(count + 1)
    poses = 4 * CHUNK

    def work(number: int) -> None:
        with LocalRunner() as runner:
            runner.run(payload("mug", 0, 200), parts)
            ready.wait()
            for k in range(number, poses // CHUNK, count):
                runner.run(payload("mug", k * CHUNK, (k + 1) * CHUNK), parts)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    ready.wait()
    started = time.perf_counter()
    for thread in threads:
        thread.join()
    return poses / (time.perf_counter() - started)


def main() -> None:
    heads = ("prefilter/s", "physics %", "grasps/s", "chain/s", "target")
    print(f"{'object':12} {heads[0]:>14} {heads[1]:>10} {heads[2]:>10} {heads[3]:>11} {heads[4]:>9}")
    for name in EXAMPLES:
        measure(name)
    print(f"force test with eight contacts: {force_test():.1f} us")
    one, two = children(1), children(2)
    print(f"mug in children: one {one:,.0f} poses/s, two {two:,.0f} poses/s, ratio {two / one:.2f}")


if __name__ == "__main__":
    main()

"""What an object's symmetry is worth: predictions of simulated grasps with attempts shared by it and not.

Grasps at which the jaw closes on something are drawn uniformly about each of the paper's four objects, and
simulated; some are learned from, others judged. The outcomes of the mug are also given to the symmetry of a
mug without its handle, which they must refuse.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graspdb.examples import EXAMPLES, example
from graspdb_density import IsotropicKernel, SuccessModel
from graspdb_density.se3 import Poses
from graspdb_density.success.calibration import brier_skill
from graspdb_density.success.contradiction import contradiction
from graspdb_density.success.motions import Motions
from graspdb_geometry import collision, meshes
from graspdb_geometry.symmetry import find_symmetry
from graspdb_simworker.inspection import inputs
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.labels import Outcome

LEARNED, JUDGED, SPLITS = (100, 300, 1_000, 2_000), 1_000, 3
WIDTHS = {100: (0.015, 20.0), 300: (0.015, 20.0), 1_000: (0.01, 15.0), 2_000: (0.01, 15.0)}


def tried(name: str, count: int) -> tuple[Poses, NDArray[np.bool_]]:
    """Grasps on something, and whether each held in simulation."""
    payload, parts = inputs.load(name, "pg70", protocol="wrench")
    world = chunks.prepare(payload, parts)
    corners = np.concatenate([vertices for vertices, _ in example(name).parts])
    low, high = corners.min(axis=0) - 0.03, corners.max(axis=0) + 0.03
    rng = np.random.default_rng(1)
    found: list[tuple[NDArray[np.float64], ...]] = []
    while sum(len(each[0]) for each in found) < count:
        p, q = rng.uniform(low, high, (50_000, 3)), Rotation.random(50_000, random_state=rng).as_quat()
        codes, travel = world.classify(p, q)
        kept = codes == collision.CONTACT
        found.append((p[kept], q[kept], np.asarray(travel)[kept]))
    p, q, travel = (np.concatenate(column)[:count] for column in zip(*found, strict=True))
    won = [
        int(world.simulate(p[i], q[i], float(travel[i])).outcome) == int(Outcome.SUCCESS)
        for i in range(count)
    ]
    return Poses(p, q), np.array(won)


def motions_of(name: str) -> Motions:
    mesh = meshes.load(example(name).stl(), "model/stl")
    found = find_symmetry(mesh.vertices[mesh.faces])
    axis = None if found.axis is None else found.axis.direction
    return Motions.of(found.elements(mirrors=True), found.centre, axis=axis)


def main() -> None:
    """Print Brier skills and refusals."""
    print("object, attempts: Brier skill without and with symmetry, refused of splits")
    for name in EXAMPLES:
        poses, won = tried(name, max(LEARNED) + JUDGED)
        motions = motions_of(name)
        models: dict[int, list[SuccessModel]] = {}
        for count in LEARNED:
            kernel = IsotropicKernel(WIDTHS[count][0], math.radians(WIDTHS[count][1]))
            skills, refused = [], 0
            for split in range(SPLITS):
                order = np.random.default_rng(split).permutation(len(won))
                judged, learned = order[:JUDGED], order[JUDGED : JUDGED + count]
                model = SuccessModel.build(poses[learned], won[learned], kernel=kernel)
                models.setdefault(count, []).append(model)
                refused += contradiction(model, motions).refused
                skills.append(
                    [
                        brier_skill(each.probability(poses[judged]), won[judged])
                        for each in (model, model.shared(motions))
                    ]
                )
            off, auto = np.mean(skills, axis=0)
            print(f"{name:12s} {count:6,d}: {off:.3f} {auto:.3f}   {refused} of {SPLITS}", flush=True)
        if name == "mug":
            cup = Motions.of([np.eye(3), np.diag([1.0, -1.0, 1.0])], np.zeros(3), axis=[0.0, 0.0, 1.0])
            for count, each in models.items():
                refused = sum(contradiction(model, cup).refused for model in each)
                print(f"as a cup     {count:6,d}:               {refused} of {SPLITS}", flush=True)


if __name__ == "__main__":
    main()

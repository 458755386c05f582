"""Ridges and pairs of a rough mesh of 80,000 triangles and of the mug, and the nearest ridge of poses.

Run ``python tests/benchmarks/geometry_ridges.py``; times are of the processor.
"""

from __future__ import annotations

import time

import numpy as np
import trimesh

from graspdb.examples import example
from graspdb_geometry.features.jaw_pairs import pairs_of_mesh
from graspdb_geometry.features.ridges import ridges_of_mesh

POSES = 100_000


def main() -> None:
    rough = trimesh.creation.icosphere(6, 0.05)
    rng = np.random.default_rng(0)
    scanned = rough.vertices + rng.normal(size=rough.vertices.shape) * 0.0005, np.asarray(rough.faces)
    mug = example("mug").triangles
    ridges_of_mesh(*mug).frames(np.zeros((1, 3)))  # compiled before the clock starts
    for name, mesh in (("mug", mug), ("rough ball", scanned)):
        begin = time.process_time()
        ridges = ridges_of_mesh(*mesh)
        found = time.process_time()
        pairs = pairs_of_mesh(*mesh, ridges, watertight=True, opening_m=0.07)
        paired = time.process_time()
        ridges.frames(rng.uniform(-0.08, 0.08, (POSES, 3)))
        print(
            f"{name}: {len(mesh[1]):,} triangles, {len(ridges):,} ridges in {found - begin:.2f} s,"
            f" {len(pairs)} pairs in {paired - found:.2f} s,"
            f" frames of {POSES:,} poses in {time.process_time() - paired:.2f} s"
        )


if __name__ == "__main__":
    main()

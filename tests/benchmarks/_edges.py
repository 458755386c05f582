"""What an object's shape alone knows: grasps from its edges, before any trial, simulated.

With ``graspdb-server serve`` and ``graspdb-simworker run`` running:
``python tests/benchmarks/_edges.py [OBJECT ...] [--draws 2000] [--best 50] [--gripper pg70]``

Three sweeps of purpose ``check`` an object: draws of the strategy ``edges``, the best distinct grasps by the
same density, and as many random poses of the grid as draws.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from graspdb import Client
from graspdb.errors import NotFound
from graspdb.examples import EXAMPLES
from graspdb.resources.objects import GraspObject


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("objects", nargs="*", default=list(EXAMPLES))
    parser.add_argument("--draws", type=int, default=2_000)
    parser.add_argument("--best", type=int, default=50)
    parser.add_argument("--gripper", default="pg70")
    options = parser.parse_args()
    print("object       poses          simulated  succeed  collide")
    with Client() as db:
        for name in options.objects:
            item = untried(db, name)
            drawn = item.proposals(options.draws, strategy="edges", gripper=options.gripper, seed=1)
            best = item.best_grasps(count=options.best, gripper=options.gripper)
            if not all(grasp.prior for grasp in best):
                sys.exit(
                    f"{name} has successes, so its best grasps are no longer its edges': take a new database"
                )
            common = {"gripper": options.gripper, "purpose": "check"}
            sweeps = {
                "edges, drawn": item.sweep(poses=drawn, **common),
                "edges, best": item.sweep(poses=best.matrices, **common),
                "grid": item.sweep(max_poses=options.draws, **common),
            }
            for label, sweep in sweeps.items():
                outcome = sweep.wait().outcomes().outcome
                held, hit = np.mean(outcome == "success"), np.mean(outcome == "collision")
                print(f"{name:12} {label:14} {len(outcome):9,} {held:8.3f} {hit:8.3f}", flush=True)


def untried(db: Client, name: str) -> GraspObject:
    """The example, added where it is not there yet."""
    try:
        return db.objects.get(name)
    except NotFound:
        return db.add_example(name)


if __name__ == "__main__":
    main()

"""Do the best grasps hold when they are simulated again? The table in docs/experiments.md.

``graspdb-server serve &``, ``graspdb-simworker run --processes 2 &`` and ``graspdb add-example all``, then
``python tests/benchmarks/_best_again.py [OBJECT ...] [--successes 1000 3000] [--count 100] [--grid]``

For every object and number of successes it makes a copy of the object, has a random part of its grid
simulated that holds about so many (and no fewer), asks for the best distinct grasps by density and by success
probability, and has those simulated at the fine step as checks. ``--grid`` asks the objects themselves, too,
where their whole grids were swept.
"""

from __future__ import annotations

import argparse
import itertools
import math
from typing import Any

from scipy.special import betaincinv

from graspdb import Client
from graspdb.errors import NotFound
from graspdb.resources.objects import GraspObject

SHARES = {"cone": 0.0094, "elongated-d": 0.0072, "screwdriver": 0.135, "mug": 0.0139}
"""Successes per pose of the whole grid."""
OBJECTIVES = ("density", "success_probability")
TOPS = (20, 50, 100)
LEVEL = 0.90


def copied(db: Client, name: str, copy: str) -> GraspObject:
    """An object with another's geometry and properties, and none of its trials."""
    source = db.objects.get(name)
    return db.objects.create(
        copy,
        mesh=source.download_mesh(),
        media_type="model/stl",
        convex_parts=source.download_convex_parts(),
        mass_kg=source.info.mass_kg,
        density_kg_m3=source.info.density_kg_m3,
        friction=source.info.friction,
    )


def collected(db: Client, name: str, successes: int) -> GraspObject:
    """A copy of the object on which a random part of the grid was tried, with so many successes at least."""
    copy = f"{name}-{successes}"
    try:
        made = db.objects.get(copy)
    except NotFound:
        made = copied(db, name, copy)
    poses = math.ceil(1.1 * successes / SHARES[name])
    # A larger part of the same seed contains the smaller, and a pose counts once.
    for _ in itertools.repeat(None, 8):
        if made.refresh().info.outcomes.get("success", 0) >= successes:
            return made
        made.sweep(max_poses=poses, seed=1, margin_m=0.02).wait(progress=True)
        poses = math.ceil(1.2 * poses)
    raise RuntimeError(f"{made.id} has too few successes: {made.info.outcomes}")


def jeffreys(won: int, tried: int) -> tuple[float, float]:
    """Interval of a share of independent trials, which includes what was seen."""
    tail = 0.5 * (1.0 - LEVEL)
    low, high = (float(betaincinv(won + 0.5, tried - won + 0.5, t)) for t in (tail, 1.0 - tail))
    return min(low, won / tried), max(high, won / tried)


def row(made: GraspObject, label: str, objective: str, options: Any) -> str:
    """Shares of the best grasps that succeed, the best first."""
    found = made.best_grasps(
        count=options.count,
        objective=objective,
        collision_free=True,
        min_separation_m=options.separation_m,
        min_separation_deg=options.separation_deg,
    )
    check = made.sweep(poses=found.matrices, fidelity="fine", purpose="check").wait()
    outcomes = check.outcomes()
    held: list[bool] = outcomes.success[outcomes.pose_index.argsort()].tolist()
    cells = []
    for top in TOPS:
        if top > len(held):
            cells.append("")
            continue
        low, high = jeffreys(sum(held[:top]), top)
        cells.append(f"{sum(held[:top]) / top:.2f} ({low:.2f} to {high:.2f})")
    causes: dict[str, int] = {}
    for name in outcomes.outcome.tolist():
        causes[name] = causes.get(name, 0) + 1
    successes = made.info.outcomes.get("success", 0)
    told = ", ".join(
        f"{n} {name}" for name, n in sorted(causes.items(), key=lambda c: -c[1]) if name != "success"
    )
    cells = [label, f"{successes:,}", objective.replace("_", " "), *cells, told or "none failed"]
    return f"| {' | '.join(cells)} |"


def arguments() -> Any:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("objects", nargs="*", default=list(SHARES))
    parser.add_argument("--successes", type=int, nargs="*", default=[1_000, 3_000])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--grid", action="store_true")
    parser.add_argument("--separation-m", type=float, help="distinct grasps are so far apart (0.01)")
    parser.add_argument("--separation-deg", type=float, help="or turned by so much (20)")
    return parser.parse_args()


def main() -> None:
    """Print the table's rows as they come."""
    options = arguments()
    columns = ["object", "successes", "objective", *(f"best {top}" for top in TOPS), "the others"]
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}", flush=True)
    with Client() as db:
        for name in options.objects:
            asked = [collected(db, name, n) for n in options.successes]
            if options.grid:
                asked.append(db.objects.get(name))
            for made in asked:
                for objective in OBJECTIVES:
                    print(row(made, name, objective, options), flush=True)


if __name__ == "__main__":
    main()

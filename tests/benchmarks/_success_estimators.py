"""Estimators of success on random grasps of the paper's four objects: what they know of attempts left out.

``python tests/benchmarks/_success_estimators.py [OBJECT ...] [--attempts 40000] [--learn 300,3000,36000]
[--splits 2] [--labels FOLDER] [--engine pybullet] [--cases random,cubes,plain]``

Grasps are drawn uniformly in position and rotation about an object; those that don't collide and have
something between the fingers are simulated (`wrench`), which takes a minute and a half for 40,000; labels are
kept in FOLDER and read from there. Learned from some, judged on 4,000 others drawn at random, or on cubes of
45 mm that are left out of the learning whole; ``plain`` is at random, without the object's shape. A line has
the numbers of the kernel estimate under the density's widths, then of what was learned: Brier skill; expected
calibration error above 0.1; the largest difference of predicted and true in a tenth beyond two standard
errors; of the blocks (15 mm, or the cubes) predicted between 0.05 and 0.95, the share whose successes
intervals and chance explain; the share of attempts that are told at all, and their skill.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from graspdb.examples import EXAMPLES
from graspdb.wire.sweeps import Engine
from graspdb_density import SuccessEstimate, SuccessModel, choose_widths, validate_reach
from graspdb_density.kde.rows import Rows
from graspdb_density.se3 import Poses
from graspdb_density.success.calibration import assign_blocks, brier_skill, expected_calibration_error
from graspdb_estimators import GraspFeatures, StackedModel, fit_stack
from graspdb_geometry import collision
from graspdb_geometry.closing import ClosingGeometry
from graspdb_geometry.grippers import shape_of
from graspdb_geometry.mass import mass_properties
from graspdb_simworker.inspection import inputs
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.labels import Outcome

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
JUDGED, CUBE_M, MARGIN_M, DRAWN = 4_000, 0.045, 0.03, 100_000


class Labelled(NamedTuple):
    """Random grasps, whether they hold, and what the jaw closes on."""

    poses: Poses
    held: Bools
    features: GraspFeatures


def labelled(name: str, count: int, folder: Path | None, engine: Engine) -> Labelled:
    """Grasps of an object, simulated now or once."""
    payload, parts = inputs.load(name, "pg70", protocol="wrench", engine=engine)
    corners = np.concatenate([vertices[faces] for vertices, faces in map(_arrays, parts)])
    features = GraspFeatures(
        ClosingGeometry(corners, mass_properties(corners).centre), shape_of(payload.gripper)
    )
    kept = None if folder is None else folder / f"{name}-{engine}-{count}.npz"
    if kept is not None and kept.exists():
        stored = np.load(kept)
        return Labelled(Poses(stored["positions"], stored["quaternions"]), stored["held"], features)
    workpiece = chunks.prepare(payload, parts)
    points = corners.reshape(-1, 3)
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    rng = np.random.default_rng(0)
    found: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]] = []
    while sum(len(travel) for _, _, travel in found) < count:
        p = rng.uniform(low, high, (DRAWN, 3))
        q = Rotation.random(DRAWN, random_state=rng).as_quat()
        codes, travel = workpiece.classify(p, q)
        met = codes == collision.CONTACT
        found.append((p[met], q[met], travel[met]))
    p, q, travel = (np.concatenate(column)[:count] for column in zip(*found, strict=True))
    held = np.array(
        [
            workpiece.simulate(*grasp[:2], float(grasp[2])).outcome is Outcome.SUCCESS
            for grasp in zip(p, q, travel, strict=True)
        ]
    )
    workpiece.close()
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(kept, positions=p, quaternions=q, held=held)
    return Labelled(Poses(p, q), held, features)


def _arrays(part: tuple[object, object]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    return np.asarray(part[0], dtype=np.float64), np.asarray(part[1], dtype=np.int64)


def divided(poses: Poses, cubes: bool, learn: int, split: int) -> tuple[Ints, Ints]:
    """Rows to learn from and to judge on."""
    rng = np.random.default_rng(split)
    if not cubes:
        order = rng.permutation(len(poses))
        return order[JUDGED : JUDGED + learn], order[:JUDGED]
    fold = assign_blocks(poses.positions, edge_m=CUBE_M, folds=5, seed=split).fold
    return rng.permutation(np.flatnonzero(fold != 0))[:learn], np.flatnonzero(fold == 0)


def scores(found: SuccessEstimate, told: Bools, held: Bools, block: Ints) -> str:
    """The numbers of a line."""
    p = found.probability
    where = brier_skill(p[told], held[told]) if told.any() and 0 < held[told].mean() < 1 else math.nan
    return (
        f"{brier_skill(p, held):6.3f} {expected_calibration_error(p, held):6.3f} {_tenths(p, held):6.3f}"
        f" {_covered(found, held, block):6.2f} {told.mean():6.2f} {where:6.3f}"
    )


def _tenths(p: NDArray[np.float64], held: Bools) -> float:
    place = np.minimum((10.0 * p).astype(np.int64), 9)
    worst = -math.inf
    for tenth in np.unique(place):
        own, won = p[place == tenth], held[place == tenth]
        error = math.sqrt(max(own.mean() * (1.0 - own.mean()), 1e-4) / len(own))
        worst = max(worst, abs(own.mean() - won.mean()) - 2.0 * error)
    return worst


def _covered(found: SuccessEstimate, held: Bools, block: Ints) -> float:
    inside = []
    for each in np.unique(block):
        rows = block == each
        if 0.05 < found.probability[rows].mean() < 0.95:
            least = binom.ppf(0.05, rows.sum(), found.low[rows].mean())
            most = binom.ppf(0.95, rows.sum(), found.high[rows].mean())
            inside.append(least <= held[rows].sum() <= most)
    return float(np.mean(inside)) if inside else math.nan


def line(data: Labelled, cubes: bool, learn: int, split: int, shapes: bool) -> str:
    """What either estimator knows."""
    rows, judged = divided(data.poses, cubes, learn, split)
    poses, held = data.poses[rows], data.held[rows]
    kernel = choose_widths(Rows.of(poses[held])).kernel
    model = SuccessModel.build(poses, held, kernel=kernel)
    reach = validate_reach(model)
    features = data.features if shapes else None
    started = time.process_time()
    stack = fit_stack(model, features, reach=reach, own_widths=True)
    seconds = time.process_time() - started
    asked, won = data.poses[judged], data.held[judged]
    block = assign_blocks(asked.positions, edge_m=CUBE_M if cubes else 0.015).block
    plain, near = model.evaluate_near(asked)
    text = f"{len(rows):6} {scores(plain, reach.covers(near), won, block)}  |"
    if stack is None or stack.left_out.verdict != "better":
        return f"{text} as the kernel estimate: nothing shows that more would be better"
    if stack.kernel is not None:
        model = SuccessModel.build(poses, held, kernel=stack.kernel)
        reach = validate_reach(model)
    found, near = StackedModel(model, stack, features).evaluate_near(asked)
    return f"{text} {scores(found, stack.reach(reach).covers(near), won, block)}  {seconds:5.0f} s"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("objects", nargs="*", default=list(EXAMPLES))
    parser.add_argument("--attempts", type=int, default=40_000)
    parser.add_argument("--learn", default="300,3000,36000")
    parser.add_argument("--splits", type=int, default=2)
    parser.add_argument("--labels", type=Path)
    parser.add_argument("--engine", choices=get_args(Engine), default="pybullet")
    parser.add_argument("--cases", default="random,cubes,plain")
    asked = parser.parse_args()
    if unknown := set(asked.cases.split(",")) - {"random", "cubes", "plain"}:
        parser.error(f"--cases are random, cubes and plain, not {', '.join(sorted(unknown))}")
    for name in asked.objects:
        data = labelled(name, asked.attempts, asked.labels, asked.engine)
        print(f"{name}: {data.held.mean():.3f} of {len(data.held):,} hold", flush=True)
        for case in asked.cases.split(","):
            cubes, shapes = case == "cubes", case != "plain"
            where = "cubes of 45 mm left out" if cubes else "others at random"
            for learn in map(int, asked.learn.split(",")):
                for split in range(asked.splits):
                    told = line(data, cubes, learn, split, shapes)
                    print(f"  {where}{'' if shapes else ', no shapes'}: {told}", flush=True)


if __name__ == "__main__":
    main()

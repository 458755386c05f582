"""What attempts at other objects tell of one: the paper's four and ten foreign meshes, each left out.

The foreign meshes are pybullet's examples, scaled to fit a hand, of 600 kg/m^3. Grasps at which the jaw
closes on something are drawn uniformly about every object and simulated (`wrench`). Objects are left out in
five groups, whole; the numbers are Brier skills of what then is said of them: 0 is as good as knowing the
share of their successes, which nobody knows before any attempt. With ten, thirty and a hundred of an object's
own attempts besides, the kernel estimate of these beside the stack of both. Then more of the paper's objects'
own attempts: kernels, the stack that these teach, and the same with what the others tell.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pybullet_data
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graspdb.examples import EXAMPLES
from graspdb_density import SuccessModel, choose_widths, validate_reach
from graspdb_density.kde.rows import Rows
from graspdb_density.se3 import Poses
from graspdb_density.success.calibration import brier_skill, expected_calibration_error
from graspdb_estimators import (
    BoostedTrees,
    GraspFeatures,
    LeftOut,
    Lesson,
    StackedModel,
    fit_stack,
    fit_transfer,
)
from graspdb_geometry import collision, meshes
from graspdb_geometry.closing import ClosingGeometry
from graspdb_geometry.grippers import shape_of
from graspdb_geometry.mass import mass_properties
from graspdb_simworker.decomposition import convexity
from graspdb_simworker.decomposition.convexity import Candidate, CuttingLimits
from graspdb_simworker.inspection import inputs
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.labels import Outcome

FOREIGN = {
    "duck": ("duck.obj", 0.055),
    "teddy": ("teddy2_VHACD_CHs.obj", 0.11),
    "torus": ("torus/torus_textured.obj", 0.07),
    "prism": ("toys/prism.obj", 0.6),
    "concave box": ("toys/concave_box.obj", 0.05),
    "traffic cone": ("racecar/meshes/cone.obj", 0.5),
    "wrist of an arm": ("xarm/xarm_description/meshes/xarm6/collision/link6_vhacd.obj", 0.9),
    "motor": ("laikago/hip_motor_lores.obj", 0.7),
    "random 0": ("random_urdfs/000/000.obj", 0.014),
    "random 21": ("random_urdfs/021/021.obj", 0.012),
}
"""Meshes of pybullet's, and what they are scaled by."""
COUNT, DRAWN, MARGIN_M, KG_M3 = 3_000, 100_000, 0.03, 600.0


def workpiece(name: str) -> tuple[Any, list[tuple[NDArray[Any], NDArray[Any]]]]:
    """What is simulated of an object, and its convex parts."""
    if name in EXAMPLES:
        payload, parts = inputs.load(name, "pg70", protocol="wrench")
        return payload, [(np.asarray(vertices), np.asarray(faces)) for vertices, faces in parts]
    file, scale = FOREIGN[name]
    mesh = trimesh.load(Path(pybullet_data.getDataPath()) / file, force="mesh")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    found: list[Candidate] = []
    convexity.decompose(
        convexity.read(mesh.export(file_type="glb"), "model/gltf-binary", "m", scale),
        CuttingLimits(64, 60.0, 0),
        tell=lambda _: None,
        give=found.append,
    )
    parts = meshes.parts_from_glb(found[-1].glb)
    volume = mass_properties(np.concatenate([vertices[faces] for vertices, faces in parts])).volume
    payload, _ = inputs.load("cone", "pg70", protocol="wrench")
    return payload.model_copy(update={"object": name, "mass_kg": max(KG_M3 * volume, 0.02)}), parts


def lesson(name: str) -> Lesson:
    """Random grasps of an object that close on something, and whether they hold."""
    payload, parts = workpiece(name)
    corners = np.concatenate([vertices[faces] for vertices, faces in parts])
    world, points = chunks.prepare(payload, parts), corners.reshape(-1, 3)
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    rng = np.random.default_rng(0)
    found: list[tuple[NDArray[np.float64], ...]] = []
    while sum(len(travel) for _, _, travel in found) < COUNT:
        p, q = rng.uniform(low, high, (DRAWN, 3)), Rotation.random(DRAWN, random_state=rng).as_quat()
        codes, travel = world.classify(p, q)
        met = codes == collision.CONTACT
        found.append((p[met], q[met], travel[met]))
    p, q, travel = (np.concatenate(column)[:COUNT] for column in zip(*found, strict=True))
    outcomes = [world.simulate(p[i], q[i], float(travel[i])).outcome for i in range(COUNT)]
    world.close()
    held = np.array([outcome is Outcome.SUCCESS for outcome in outcomes], dtype=np.float64)
    poses, closing = Poses(p, q), ClosingGeometry(corners, mass_properties(corners).centre)
    closed = closing.features(poses, shape_of(payload.gripper)).astype(np.float32)
    return Lesson(name, poses, held, np.ones(COUNT), closed)


def skills(held: LeftOut, number: int) -> tuple[float, float]:
    """Of one object: the kernel estimate's, or the share's, and what was learned."""
    some = held.some(held.block == number)
    return brier_skill(some.kernel, some.share), brier_skill(some.learned, some.share)


def taught(lesson: Lesson, features: GraspFeatures, others: BoostedTrees, count: int) -> tuple[float, ...]:
    """Brier skills on the last third of an object's grasps from the first so many: the kernel estimate's, and
    those of the stack without what others tell and with it.
    """
    judged = np.arange(2 * COUNT // 3, COUNT)
    poses, held = lesson.poses[np.arange(count)], lesson.share[:count] >= 0.5
    asked, won = lesson.poses[judged], lesson.share[judged]
    kernel = choose_widths(Rows.of(poses[held])).kernel
    model = SuccessModel.build(poses, held, kernel=kernel)
    found = [brier_skill(model.probability(asked), won)]
    for told in (None, others):
        stack = fit_stack(model, features, reach=validate_reach(model), own_widths=True, others=told)
        if stack is None:
            found.append(np.nan)
            continue
        used = model if stack.kernel is None else SuccessModel.build(poses, held, kernel=stack.kernel)
        found.append(brier_skill(StackedModel(used, stack, features).probability(asked), won))
    return tuple(found)


def features_of(name: str) -> GraspFeatures:
    payload, parts = workpiece(name)
    corners = np.concatenate([vertices[faces] for vertices, faces in parts])
    return GraspFeatures(ClosingGeometry(corners, mass_properties(corners).centre), shape_of(payload.gripper))


def main() -> None:
    """Print a row an object, and their means."""
    lessons = []
    for name in itertools.chain(EXAMPLES, FOREIGN):
        lessons.append(lesson(name))
        print(f"# {name}: {lessons[-1].share.mean():.3f} hold", flush=True)
    for told in (lessons, lessons[: len(EXAMPLES)]):
        transfer = fit_transfer(told)
        assert transfer is not None
        untried, few = transfer.untried, transfer.stack.left_out
        print(f"\n{len(told)} objects | no attempt | its first 10, 30, 100: kernels | both")
        rows = []
        for number, each in enumerate(told):
            kernel, both = skills(few, number)
            rows.append((skills(untried, number)[1], kernel, both))
            print(f"{each.shape:16} | {rows[-1][0]:6.3f} | {kernel:6.3f} | {both:6.3f}")
        print(f"{'mean':16} | " + " | ".join(f"{mean:6.3f}" for mean in np.mean(rows, axis=0)))
        off = [expected_calibration_error(part.learned, part.share) for part in (untried, few)]
        print(f"expected calibration error {off[0]:.3f} without an attempt, {off[1]:.3f} with few")
    transfer = fit_transfer(lessons)
    assert transfer is not None
    print("\nown attempts | kernels, own stack, with others")
    for each in lessons[: len(EXAMPLES)]:
        for count in (60, 100, 300, 1_000, 2_000):
            found = taught(each, features_of(each.shape), transfer.trees_for(each.shape), count)
            print(f"{each.shape:16} {count:5} | " + " ".join(f"{skill:6.3f}" for skill in found), flush=True)


if __name__ == "__main__":
    main()

"""A robot's cell: the best grasp that a Panda can take, over HTTP and against asking of every grasp.

Data: the shell of successes of `service_queries`, 160,000 kernels, on a table with five boxes; the object
stands somewhere else in every question, so that nothing repeats. Approach of 100 mm and lift of 100 mm.

Three things are told: the time of an answer over HTTP; the time to test 1,000 grasps for reach on one core;
and, with ``--cells N``, the score of the search over that of the best of the 20,000 best centres, each of
which was tested, in N random cells. With ``--retest N`` so many answers' joints are put into pybullet, which
knows nothing of our kinematics: where the flange is, limits, collisions of links.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pybullet
from numpy.typing import NDArray
from service_queries import post, server, shell, sphere_stl, timed, told

from graspdb.wire.presets.grippers import PRESETS
from graspdb_density import GraspDensity, IsotropicKernel, ModeSearch, se3
from graspdb_density.search.lazy_search import DearTest
from graspdb_geometry.grippers import shape_of
from graspdb_geometry.mesh_reading.obj import read_obj
from graspdb_robots.collision import LinkShapes, Obstacle
from graspdb_robots.kinematics import Kinematics
from graspdb_robots.reaching import Reaching, RobotCell
from graspdb_robots.urdf import read_arm

sys.path.append(str(Path(__file__).parents[1] / "support"))
import known_robots

Floats = NDArray[np.float64]
KERNELS, BEST, WAY_M = 160_000, 20_000, 0.1
TABLE: dict[str, Any] = {"position": [0.5, 0, -0.05], "size_m": [1.0, 1.4, 0.1]}
PLACES = [(0.45, 0.42), (0.72, 0.3), (0.78, -0.05), (0.7, -0.35), (0.4, -0.42)]
BOXES = [TABLE, *({"position": [x, y, 0.1], "size_m": [0.08, 0.08, 0.2]} for x, y in PLACES)]


def placed(rng: np.random.Generator) -> list[float]:
    """The object in front of the arm, upright, turned at random about the vertical."""
    turn = rng.uniform(-np.pi, np.pi) / 2
    at = [rng.uniform(0.35, 0.62), rng.uniform(-0.22, 0.22), rng.uniform(0.05, 0.25)]
    return [*at, 0.0, 0.0, float(np.sin(turn)), float(np.cos(turn))]


def asked(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "robot": "panda",
        "object_pose": placed(rng),
        "obstacles": {"boxes": BOXES},
        "pregrasp_distance_m": WAY_M,
        "lift_m": WAY_M,
    }


def over_http(http: httpx.Client, questions: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Times of questions, and their answers with the poses that they were asked about."""
    path, answers, times = "/objects/shell/best-grasp", [], []
    # The first one has the density built, and the arm's map: it may take longer than a question may.
    warm = [http.post(path, json=asked(rng)).is_success for _ in range(8)]
    assert any(warm)
    plain = [
        timed(lambda: http.post(path, json={**asked(rng), "robot": None, "lift_m": None})) for _ in range(20)
    ]
    for _ in range(questions):
        body = asked(rng)
        started = time.perf_counter()
        answer = http.post(path, json=body)
        times.append(1000 * (time.perf_counter() - started))
        answer.raise_for_status()
        answers.append({"asked": body, **answer.json()})
    found = sum(answer["status"] == "ok" for answer in answers)
    told("best grasp without a robot, same cells", plain)
    told("best grasp that the arm can take", times, f"{found} reachable")
    return answers


def arm() -> Any:
    """The Panda's arm."""

    def points(name: str) -> Floats:
        path = known_robots.PANDA.parent / name.split("package://")[-1]
        return np.concatenate([item.vertices for item in read_obj(path.read_bytes(), 10**6).geometries])

    return read_arm(known_robots.PANDA.read_bytes(), "panda_link8", points)[1]


def matrices(poses: se3.Poses) -> Floats:
    found = np.tile(np.eye(4), (len(poses), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = se3.to_matrix(poses.quaternions_xyzw), poses.positions
    return found


class Cells:
    """Cells in this process, without the service."""

    def __init__(self) -> None:
        made = arm()
        self.kinematics, self.shapes = Kinematics(made), LinkShapes(made)
        profile = PRESETS["pg70"].profile
        self.in_tool = np.eye(4)
        self.in_tool[2, 3] = -0.14
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        halves, centres = shape_of(profile).boxes()
        self.gripper = tuple(
            centre + signs * half + [0, 0, 0.14] for half, centre in zip(halves, centres, strict=True)
        )

    def reaching(self, at: list[float]) -> Reaching:
        pose = matrices(se3.Poses(np.array([at[:3]]), np.array([at[3:]])))[0]
        boxes = []
        for i, box in enumerate(BOXES):
            frame = np.eye(4)
            frame[:3, 3] = box["position"]
            boxes.append(Obstacle(f"boxes.{i}", frame, size_m=np.array(box["size_m"])))
        cell = RobotCell(
            self.kinematics, self.shapes, self.gripper, self.in_tool, pose, tuple(boxes),
            distance_m=WAY_M, lift_m=WAY_M,
        )  # fmt: skip
        return Reaching(cell, np.eye(4))


def thousand(cells: Cells, poses: se3.Poses, rng: np.random.Generator) -> None:
    """The time to test 1,000 grasps of a cell, whichever they are."""
    times, shares = [], []
    for _ in range(7):
        reaching = cells.reaching(placed(rng))
        some = matrices(poses[rng.integers(0, len(poses), 1_000)])
        started = time.process_time()
        shares.append(reaching.reaches(some).mean())
        times.append(1000 * (time.process_time() - started))
    told(
        "1,000 grasps tested for reach, one core (processor's time)",
        times,
        f"{np.mean(shares):.0%} reachable",
    )


def against_all(cells: Cells, poses: se3.Poses, count: int) -> None:
    """The search's score over that of the best of the 20,000 best centres, each tested."""
    kernel = IsotropicKernel(0.005, np.radians(5.0))
    density = GraspDensity.build(poses, kernel=kernel, symmetric=np.ones(len(poses), dtype=bool))
    search, ratios, shares, asked_of = ModeSearch(density), [], [], []
    first = poses[search.ranking().order[:BEST]]
    logs = density.log_density(first)
    for number in range(count):
        rng = np.random.default_rng(1_000 + number)
        # Some of these are hard: far out, low, or tilted.
        at = placed(rng)
        at[0] += rng.uniform(0.0, 0.3)
        at[3:] = se3.random_quaternions(1, rng)[0].tolist()
        reaching, tested = cells.reaching(at), [0]

        def passes(some: se3.Poses, reaching: Reaching = reaching, tested: list[int] = tested) -> Any:
            tested[0] += len(some)
            return reaching.reaches(matrices(some))

        def likely(some: se3.Poses, reaching: Reaching = reaching) -> Any:
            return reaching.likely(matrices(some))

        found = search.maxima(dear=DearTest(passes, likely))
        able = reaching.reaches(matrices(first))
        shares.append(able.mean())
        asked_of.append(tested[0])
        if able.any():
            best = logs[able].max()
            ratios.append(float(np.exp(found[0].log_density - best)) if found else 0.0)
    print(
        f"search over the best of {BEST:,} tested, {len(ratios)} of {count} cells with any: least"
        f" {min(ratios):.4f}, median {np.median(ratios):.4f}; below 0.98: {sum(r < 0.98 for r in ratios)};"
        f" reachable {100 * min(shares):.2f} to {100 * max(shares):.1f} %, asked of"
        f" {int(np.median(asked_of))} grasps (median), {max(asked_of)} at most",
        flush=True,
    )


def retest(answers: list[dict[str, Any]]) -> None:
    """Whether pybullet agrees: places, limits, collisions of links with boxes and table."""
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(str(known_robots.PANDA), useFixedBase=True, physicsClientId=client)
    infos = [pybullet.getJointInfo(body, i) for i in range(pybullet.getNumJoints(body))]
    joints = [info[0] for info in infos if info[1].decode().startswith("panda_joint") and info[2] == 0]
    limits = [(infos[i][8], infos[i][9]) for i in joints]
    flange = next(info[0] for info in infos if info[12] == b"panda_link8")
    boxes = [
        pybullet.createMultiBody(
            0, pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=np.array(box["size_m"]) / 2),
            basePosition=box["position"],
        )
        for box in BOXES
    ]  # fmt: skip
    wrong, off, turned, count = 0, 0.0, 0.0, 0
    for answer in answers:
        for grasp in answer["grasps"]:
            world = grasp["world"]
            tool = matrices(se3.Poses(np.array([world["position"]]), np.array([world["quaternion_xyzw"]])))[0]
            for name, values in grasp["joints"].items():
                count += 1
                wanted = tool.copy()
                wanted[:3, 3] -= (WAY_M if name == "pregrasp" else 0.0) * tool[:3, 2] + 0.14 * tool[:3, 2]
                wanted[2, 3] += WAY_M if name == "lift" else 0.0
                for joint, value, (low, high) in zip(joints, values, limits, strict=True):
                    pybullet.resetJointState(body, joint, value)
                    wrong += not low - 1e-9 <= value <= high + 1e-9
                state = pybullet.getLinkState(body, flange, computeForwardKinematics=True)
                shift = float(np.linalg.norm(np.array(state[4]) - wanted[:3, 3]))
                matrix = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
                angle = float(np.arccos(np.clip((np.trace(matrix.T @ wanted[:3, :3]) - 1) / 2, -1, 1)))
                off, turned = max(off, shift), max(turned, angle)
                wrong += shift > 1e-4 or angle > 1e-3
                pybullet.performCollisionDetection()
                for box in boxes:
                    met = pybullet.getClosestPoints(body, box, 0.0)
                    # Links that are left out at the flange, and the foot on the table, are not meant;
                    # Bullet's margin makes hulls some tenths of a millimetre thicker.
                    wrong += any(-1 < item[3] < flange and item[8] < -1e-3 for item in met)
    pybullet.disconnect(client)
    print(
        f"{count} joint positions put into pybullet: {wrong} wrong; flange off by {off:.1e} m and"
        f" {turned:.1e} rad at most",
        flush=True,
    )


def main(questions: int = 100, cells: int = 0, again: int = 0) -> None:
    rng = np.random.default_rng(0)
    poses = shell(KERNELS, rng)
    with (
        tempfile.TemporaryDirectory() as folder,
        server(Path(folder)) as url,
        httpx.Client(base_url=url, timeout=300) as http,
    ):
        http.post("/objects", json={"id": "shell"}).raise_for_status()
        mesh = {"Content-Type": "model/stl"}
        http.put("/objects/shell/mesh?unit=m", content=sphere_stl(), headers=mesh).raise_for_status()
        post(http, "shell", poses)
        described = {"Content-Type": "application/zip"}
        stored = "/robots/panda?flange=panda_link8"
        http.put(stored, content=known_robots.panda_zip(), headers=described).raise_for_status()
        answers = over_http(http, max(questions, again), rng)
    if again:
        retest(answers)
    some = Cells()
    found = se3.Poses(*poses)
    thousand(some, found, rng)
    if cells:
        against_all(some, found, cells)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--questions", type=int, default=100)
    parser.add_argument("--cells", type=int, default=0)
    parser.add_argument("--retest", type=int, default=0)
    options = parser.parse_args()
    main(options.questions, options.cells, options.retest)

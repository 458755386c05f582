"""Best grasps by success probability and by its mean under noise, in process, against exhaustive search.

Data: attempts on the shell of the ellipsoid of ``service_queries`` at which the open gripper is free, as many
as it takes to have 160,000 successes; how likely each succeeds changes along and around the ellipsoid. Every
question has other constraints. Learning is off, so that nothing but the questions takes the processor.

Reported: the processor's time, the same as a ratio to a plain best grasp's median of the same run, and the
score's share of the best that an exhaustive search finds: from the best of every centre in reach by the rough
score random steps uphill by the score itself, and the service's own answer if that is higher. Last, how long
it takes until the last of 20 who ask at once, each under other constraints and noise that was not asked for
before, has an answer.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from fastapi.testclient import TestClient
from numpy.typing import NDArray
from service_queries import AXES, database_in, shell, sphere_stl

from graspdb.wire import BestGraspRequest
from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_service.api.context import Context
from graspdb_service.app import create_app
from graspdb_service.settings import Settings
from graspdb_service.usecases.densities.cache import kernel_of
from graspdb_service.usecases.grasps.answer import best_grasps
from graspdb_service.usecases.grasps.constraints import constraints
from graspdb_service.usecases.grasps.question import Question, question_of
from graspdb_service.usecases.grasps.search import ScoreSearch
from graspdb_service.usecases.trials.pose_frames import frame_of

Floats = NDArray[np.float64]
SLUG, JAW = "thing", "pg70"
KINDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "success probability": {"objective": "success_probability"},
    "robust: object shifts, turns": {"objective": "robust", "pose_noise_m": 0.003, "pose_noise_deg": 2.0},
    "robust: tool": {"objective": "robust", "tool_noise_m": 0.003, "tool_noise_deg": 2.0},
}
ASKERS = 20


def filled(folder: Path, successes: int, rng: np.random.Generator) -> Context:
    """A service with one object and its attempts."""
    settings = Settings(database_url=database_in(folder), learned_estimates=False)
    with TestClient(create_app(settings), base_url="http://127.0.0.1") as http:
        http.post("/objects", json={"id": SLUG}).raise_for_status()
        mesh = {"content": sphere_stl(), "headers": {"Content-Type": "model/stl"}}
        http.put(f"/objects/{SLUG}/mesh?unit=m", **mesh).raise_for_status()
        found = 0
        while found < successes:
            found += posted(http, rng)
    return create_app(settings).state.context


def posted(http: TestClient, rng: np.random.Generator) -> int:
    """Post some attempts at which the gripper is free; how many of them succeeded."""
    p, q = shell(60_000, rng)
    body = {"poses": {"position": p.tolist(), "quaternion_xyzw": q.tolist()}, "include": ["collision_free"]}
    answer = http.post(f"/objects/{SLUG}/likelihood", json={**body, "gripper": JAW})
    answer.raise_for_status()
    free = np.array(answer.json()["collision_free"], dtype=bool)
    p, q = p[free], q[free]
    around = np.arctan2(p[:, 1], p[:, 2])
    chance = 0.13 + 0.68 * np.exp(-((p[:, 0] / (0.5 * AXES[0])) ** 2)) * (0.6 + 0.4 * np.cos(3 * around))
    won = rng.random(len(p)) < chance
    columns = {
        "position": p.tolist(),
        "quaternion_xyzw": q.tolist(),
        "outcome": ["success" if w else "slipped" for w in won],
    }
    http.post(f"/objects/{SLUG}/trials", json={"columns": columns, "gripper": JAW}).raise_for_status()
    return int(won.sum())


def bounds(rng: np.random.Generator) -> dict[str, Any]:
    """Constraints that differ each time."""
    asked: dict[str, Any] = {"collision_free": True, "gripper": JAW}
    centre, kind = rng.uniform(-1, 1, 3) * AXES, rng.random()
    if kind < 0.5:
        half = rng.uniform(0.015, 0.06, 3)
        asked |= {"box_min": (centre - half).tolist(), "box_max": (centre + half).tolist()}
    elif kind < 0.75:
        asked["sphere"] = [*centre.tolist(), float(rng.uniform(0.02, 0.06))]
    if rng.random() < 0.5:
        approach = rng.normal(size=3).tolist()
        asked |= {"approach": approach, "approach_cone_deg": float(rng.uniform(20, 60))}
    return asked


def question(context: Context, request: BestGraspRequest) -> Question:
    """What the service makes of a request."""
    selected = context.densities.selections.resolve(SLUG, request)
    frame = frame_of(selected, request.pose_frame, request.convention)
    limits = constraints(request, selected, frame, None, context.scenes)
    built = context.densities.get(selected, kernel_of(request)[0])
    found = question_of(context, request, built, limits)
    assert found is not None
    return found


def exhaustive(context: Context, request: BestGraspRequest, climbers: int) -> float:
    """The highest score that is found from the best centres in reach."""
    asked = question(context, request)
    engine, limits = asked.engine, asked.bounds
    assert isinstance(engine, ScoreSearch)
    assert engine.score is not None
    assert engine.rough is not None
    rough, score, kernel = engine.rough, engine.score, asked.wide.centres.kernel

    def allowed(poses: Poses) -> NDArray[np.bool_]:
        ok = limits.region.contains(*poses)
        rows = np.flatnonzero(ok)
        ok[rows] = limits.admissible is None or limits.admissible(poses[rows])
        return ok

    p, q, inside = limits.region.project(*asked.wide.centres.poses)
    poses = Poses(p, q)[inside]
    poses = poses[np.random.default_rng(1).permutation(len(poses))[:20_000]]
    poses = poses[allowed(poses)]
    if not len(poses):
        return 0.0
    at = poses[np.argsort(-rough(poses), kind="stable")[:climbers]]
    values, rng = score(at), np.random.default_rng(0)
    for step in np.repeat([0.5, 0.25, 0.12, 0.06], 10):
        moved = at.positions + rng.standard_normal(at.positions.shape) * step * kernel.sigma_position_m
        turns = rng.standard_normal(at.positions.shape) * step * kernel.sigma_rotation
        turned = se3.multiply(at.quaternions_xyzw, se3.from_rotation_vector(turns))
        tried = Poses(*limits.region.project(moved, turned)[:2])
        ok = np.flatnonzero(allowed(tried))
        better = np.zeros(len(at), dtype=bool)
        new = values.copy()
        if ok.size:
            new[ok] = score(tried[ok])
            better[ok] = new[ok] > values[ok]
        at.positions[better], at.quaternions_xyzw[better] = (
            tried.positions[better],
            tried.quaternions_xyzw[better],
        )
        values = np.where(better, new, values)
    return float(values.max())


def asked(context: Context, more: dict[str, Any]) -> tuple[float, float]:
    """Milliseconds of the processor, and the best score."""
    busy = time.process_time()
    answer = best_grasps(context, SLUG, BestGraspRequest(**more))[0]
    took = (time.process_time() - busy) * 1000
    return took, answer.grasps[0].score if answer.grasps else 0.0


def several(context: Context, more: dict[str, Any], rng: np.random.Generator) -> tuple[float, float]:
    """Seconds by the clock, and of the processor, until the last of those who ask at once has an answer."""
    requests = [bounds(rng) | more for _ in range(ASKERS)]
    started, busy = time.perf_counter(), time.process_time()
    with concurrent.futures.ThreadPoolExecutor(ASKERS) as pool:
        list(pool.map(lambda request: asked(context, request), requests))
    return time.perf_counter() - started, time.process_time() - busy


def main(successes: int = 160_000, questions: int = 50, climbers: int = 24) -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        context = filled(Path(folder), successes, rng)
        try:
            plain = 0.0
            for name, more in KINDS.items():
                first, _ = asked(context, bounds(rng) | more)
                given = [bounds(rng) | more for _ in range(questions)]
                found = [asked(context, request) for request in given]
                p50, p99 = np.percentile([took for took, _ in found], [50, 99])
                plain = plain or p50
                line = f"{name:30s} first {first:7.0f} ms   p50 {p50:7.1f}   p99 {p99:7.1f}"
                line += f"   {p50 / plain:5.1f} x plain"
                if more:
                    shares = []
                    for request, (_, score) in zip(given, found, strict=True):
                        best = max(score, exhaustive(context, BestGraspRequest(**request), climbers))
                        shares.append(score / best if best > 0.0 else 1.0)
                    least, low = np.percentile(shares, [0, 10])
                    line += f"   share of the best: least {least:.4f}, of nine in ten {low:.4f}"
                print(line, flush=True)
            for name in ("success probability", "robust: object shifts, turns"):
                more = dict(KINDS[name])
                if "pose_noise_m" in more:
                    more["pose_noise_m"] = 0.0035
                clock, busy = several(context, more, rng)
                print(
                    f"{ASKERS} at once, {name:30s} last after {clock:6.1f} s, {busy:6.1f} s of the processor"
                )
        finally:
            context.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--successes", type=int, default=160_000)
    parser.add_argument("--questions", type=int, default=50)
    options = parser.parse_args()
    main(options.successes, options.questions)

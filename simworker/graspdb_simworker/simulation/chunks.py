"""One chunk of a sweep, from its payload to one outcome for every pose.

    poses of the plan -> exact geometry: collides | nothing between the fingers | needs physics ->
    closing -> label

Where something is drawn anew in each of several simulations of a pose, each draw goes this way, at its noisy
poses and in its world, and k of n succeed: see :mod:`.draws`.

A chunk gives the same bytes whatever ran before it, in whatever order, process or world.
"""

from __future__ import annotations

import base64
import gc
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import GridPlan, GripperProfile, ResultRows, SimulatePayload, SimulateResult
from graspdb_geometry import collision
from graspdb_geometry.grids import PoseGrid
from graspdb_geometry.grippers import shape_of
from graspdb_geometry.poses import ToolPoses
from graspdb_simworker.simulation.bodies import (
    MIN_FINGER_SHARE,
    Gripper,
    Part,
    closing_force,
    mass_properties,
)
from graspdb_simworker.simulation.draws import DrawnWorld, draws_of, noisy
from graspdb_simworker.simulation.force_test import compile_force_test
from graspdb_simworker.simulation.grasp_world import GraspWorld
from graspdb_simworker.simulation.labels import Label, Outcome, label_of, majority
from graspdb_simworker.simulation.lifting import MOTIONS, motion_of

PROTOCOLS = ("wrench", *MOTIONS)
"""Protocols this worker can simulate."""


class UnsupportedProtocol(ValueError):
    """The chunk asks for a protocol that this worker does not have."""


KEPT_WORLDS = 16
"""So many worlds of an object are kept. What is drawn beyond is built anew for every chunk, in 60 ms: a world
of pybullet's takes 28 MB."""


class Workpiece:
    """An object ready to be grasped: collision scene, and physics worlds, one a draw. Reused from chunk to
    chunk. ``draws`` are the worlds that every pose is simulated in, ``build`` builds one: the first at once,
    others when they are needed; draws that are equal share theirs.
    """

    def __init__(
        self,
        scene: collision.Scene,
        gripper: Gripper,
        draws: Sequence[DrawnWorld],
        build: Callable[[DrawnWorld], GraspWorld],
    ) -> None:
        self.scene = scene
        self.gripper = gripper
        self.draws = tuple(draws)
        self._build = build
        self._worlds: dict[DrawnWorld, GraspWorld] = {}
        self._world(self.draws[0])

    @property
    def world(self) -> GraspWorld:
        """The first draw's, which is the only one unless something is drawn."""
        return self._world(self.draws[0])

    def classify(
        self, positions: NDArray[np.float64], quaternions: NDArray[np.float64]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """What geometry says of tool poses (n, 3), (n, 4): its code (n,), and how far each finger can close
        before the first touches (n,), metres."""
        codes, first_contact = self.scene.classify(ToolPoses(positions, quaternions), self.gripper)
        return codes, np.minimum(first_contact.min(axis=1), 0.5 * self.gripper.max_opening_m)

    def simulate(
        self, position: NDArray[np.float64], quaternion: NDArray[np.float64], travel_m: float, draw: int = 0
    ) -> Label:
        """Close the jaw at one pose (tool in the object frame), in a draw's world, and label the outcome."""
        px, py, pz = (float(v) for v in position)
        x, y, z, w = (float(v) for v in quaternion)
        world = self._world(self.draws[draw])
        return label_of(world.close((px, py, pz), (x, y, z, w), travel_m), world.motion)

    def close(self) -> None:
        for world in self._worlds.values():
            world.close_world()
        self._worlds.clear()

    def _world(self, draw: DrawnWorld) -> GraspWorld:
        world = self._worlds.get(draw)
        if world is None:
            if len(self._worlds) >= KEPT_WORLDS:
                # The last: draws come in turn, and of the first all are there again for the next chunk.
                self._worlds.popitem()[1].close_world()
            world = self._worlds[draw] = self._build(draw)
        return world


def prepare(
    payload: SimulatePayload,
    parts: Sequence[Part],
    *,
    visible: bool = False,
    film_every_s: float = math.inf,
    moments_every_s: float = math.inf,
) -> Workpiece:
    """Build what the payload's chunks are simulated with; visible for pictures of the end, or at intervals.
    Moments of each closing are kept at such intervals, too.

    UnsupportedProtocol, EngineMissing, or ValueError for parts or a gripper that no physics can be done with.
    """
    motion = motion_of(payload.protocol)
    if motion is None and payload.protocol not in PROTOCOLS:
        raise UnsupportedProtocol(
            f"this worker simulates {', '.join(PROTOCOLS)}; the sweep asks for {payload.protocol!r}"
        )
    compile_force_test()

    def build(draw: DrawnWorld) -> GraspWorld:
        return GraspWorld(
            parts,
            mass_properties(parts, draw.mass_kg).displaced(draw.offset_m),
            draw.friction,
            gripper_of(payload.gripper, draw.mass_kg),
            payload.fidelity,
            engine=payload.engine,
            motion=motion,
            compliance=draw.compliance,
            visible=visible,
            film_every_s=film_every_s,
            moments_every_s=moments_every_s,
        )

    gripper = gripper_of(payload.gripper, payload.mass_kg)
    return Workpiece(collision.Scene(parts), gripper, draws_of(payload, parts), build)


def gripper_of(profile: GripperProfile, mass_kg: float) -> Gripper:
    """A gripper profile as the physics sees it, closing on an object of this mass.

    The profile's ``max_acceleration_m_s2`` has no part in it. The jaw arrives at full speed: from rest the
    PG70 would reach its 60 mm/s in 1.5 s at the 39 mm/s^2 that its driver gives, longer than its whole
    stroke takes, so that it would close ever more slowly, and the faster closing is the harder case for
    what floats between the fingers. Once they touch, force and friction decide and not the drive's ramp.
    """
    return Gripper(
        **vars(shape_of(profile)),
        finger_mass_kg=max(profile.finger_mass_kg, MIN_FINGER_SHARE * mass_kg),
        max_speed_m_s=profile.max_speed_m_s,
        force_n=profile.force_n,
        closing_force_n=closing_force(profile.force_n, mass_kg),
    )


def grid_of(plan: GridPlan) -> PoseGrid:
    """The grid that a payload describes."""
    return PoseGrid(**{name: getattr(plan, name) for name in GridPlan.model_fields})


def poses_of(
    payload: SimulatePayload,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """The chunk's pose indices (n,), positions (n, 3) and quaternions xyzw (n, 4), tool in the object frame.

    ValueError without grid and poses, or for as many poses as the payload does not say.
    """
    if payload.grid is not None:
        grid = grid_of(payload.grid)
        indices = grid.pose_indices(payload.start, payload.stop)
        positions, quaternions = grid.poses(indices)
        return indices, positions, quaternions
    if payload.poses is None:
        raise ValueError("a simulate job has either a grid or poses")
    positions = np.asarray(payload.poses.position, dtype=np.float64).reshape(-1, 3)
    quaternions = np.asarray(payload.poses.quaternion_xyzw, dtype=np.float64).reshape(-1, 4)
    indices = np.arange(payload.start, payload.stop, dtype=np.int64)
    if not len(positions) == len(quaternions) == len(indices):
        raise ValueError(f"the chunk names {len(indices)} poses and holds {len(positions)}")
    return indices, positions, quaternions


@dataclass(frozen=True)
class Simulated:
    """What became of poses: outcome codes (draws, poses), and by a pose's row the labels of its closings, of
    poses that met physics in any draw."""

    outcomes: NDArray[np.uint8]
    labels: Mapping[int, Sequence[Label]]

    @property
    def outcome(self) -> NDArray[np.uint8]:
        """What all draws of each pose come to (poses,)."""
        return majority(self.outcomes)

    @property
    def successes(self) -> NDArray[np.uint8]:
        """In how many draws each pose succeeded (poses,)."""
        succeeded: NDArray[np.uint8] = (self.outcomes == Outcome.SUCCESS).sum(axis=0).astype(np.uint8)
        return succeeded


def simulate_poses(
    payload: SimulatePayload,
    workpiece: Workpiece,
    indices: NDArray[np.int64],
    positions: NDArray[np.float64],
    quaternions: NDArray[np.float64],
    *,
    known: Mapping[int, Label] | None = None,
    before: Callable[[int], None] = lambda closing: None,
    after: Callable[[int, Label], None] = lambda closing, label: None,
) -> Simulated:
    """Simulate poses of a sweep, by their indices (n,) in its plan, in every draw.

    A closing's number is its pose's row; where something is drawn, plus the draw times the poses. ``known``
    closings need no physics any more: an earlier process simulated them or died of them. ``before`` and
    ``after`` are called around each of the others.
    """
    known = known or {}
    outcomes = np.full((len(workpiece.draws), len(indices)), Outcome.MISSED, dtype=np.uint8)
    labels: dict[int, list[Label]] = {}
    with _no_cycles():
        for draw, found in enumerate(outcomes):
            where, turned = noisy(payload.randomise, draw, indices, positions, quaternions)
            codes, travel = workpiece.classify(where, turned)
            found[codes == collision.COLLIDES] = Outcome.COLLISION
            for row in np.flatnonzero(codes == collision.CONTACT).tolist():
                closing = draw * len(indices) + row
                label = known.get(closing)
                if label is None:
                    before(closing)
                    label = workpiece.simulate(where[row], turned[row], float(travel[row]), draw)
                    after(closing, label)
                found[row] = label.outcome
                labels.setdefault(row, []).append(label)
    return Simulated(outcomes, labels)


def simulate_chunk(
    payload: SimulatePayload,
    workpiece: Workpiece,
    *,
    known: Mapping[int, Label] | None = None,
    before: Callable[[int], None] = lambda closing: None,
    after: Callable[[int, Label], None] = lambda closing, label: None,
) -> SimulateResult:
    """Simulate a chunk: an outcome for every pose, and rows for those that met physics, but for what collides
    in most draws and holds in none. Closings are numbered as in :func:`simulate_poses`."""
    poses = poses_of(payload)
    simulated = simulate_poses(payload, workpiece, *poses, known=known, before=before, after=after)
    outcome, successes = simulated.outcome, simulated.successes
    rows = ResultRows(pose_index=[], width_m=[], quality=[])
    for row, labels in sorted(simulated.labels.items()):
        if outcome[row] != Outcome.COLLISION or successes[row]:
            rows.pose_index.append(int(poses[0][row]))
            rows.width_m.append(_median([label.width_m for label in labels], 7))
            rows.quality.append(_median([label.quality for label in labels], 4))
    return SimulateResult(
        outcomes=base64.b64encode(outcome.tobytes()),
        successes=None if payload.randomise is None else base64.b64encode(successes.tobytes()),
        rows=rows,
        engine=workpiece.world.engine,
    )


@contextmanager
def _no_cycles() -> Iterator[None]:
    """Python's search for cyclic garbage put off: closings make tuples by the million and no cycles, and a
    twentieth of the time would go into looking."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _median(values: Sequence[float], digits: int) -> float | None:
    """Of those that were measured, rounded for the wire, where a missing measurement is null: beyond 0.1 um,
    digits say nothing."""
    measured = [value for value in values if math.isfinite(value)]
    return round(min(statistics.median(measured), 1e9), digits) if measured else None

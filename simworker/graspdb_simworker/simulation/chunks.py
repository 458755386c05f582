"""One chunk of a sweep, from its payload to one outcome for every pose.

    poses of the plan -> exact geometry: collides | nothing between the fingers | needs physics ->
    closing -> label

A chunk gives the same bytes whatever ran before it, in whatever order, process or world.
"""

from __future__ import annotations

import base64
import gc
import math
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
from graspdb_simworker.simulation.bodies import MIN_FINGER_SHARE, Gripper, Part, closing_force
from graspdb_simworker.simulation.force_test import compile_force_test
from graspdb_simworker.simulation.grasp_world import GraspWorld
from graspdb_simworker.simulation.labels import Label, Outcome, label_of
from graspdb_simworker.simulation.lifting import MOTIONS

PROTOCOLS = ("wrench", *MOTIONS)
"""Protocols this worker can simulate."""


class UnsupportedProtocol(ValueError):
    """The chunk asks for a protocol that this worker does not have."""


@dataclass(frozen=True)
class Workpiece:
    """An object ready to be grasped: collision scene and physics world. Reused from chunk to chunk."""

    scene: collision.Scene
    world: GraspWorld
    gripper: Gripper

    def classify(
        self, positions: NDArray[np.float64], quaternions: NDArray[np.float64]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """What geometry says of tool poses (n, 3), (n, 4): its code (n,), and how far each finger can close
        before the first touches (n,), metres."""
        codes, first_contact = self.scene.classify(ToolPoses(positions, quaternions), self.gripper)
        return codes, np.minimum(first_contact.min(axis=1), 0.5 * self.gripper.max_opening_m)

    def simulate(
        self, position: NDArray[np.float64], quaternion: NDArray[np.float64], travel_m: float
    ) -> Label:
        """Close the jaw at one pose (tool in the object frame) and label the outcome."""
        px, py, pz = (float(v) for v in position)
        x, y, z, w = (float(v) for v in quaternion)
        return label_of(self.world.close((px, py, pz), (x, y, z, w), travel_m), self.world.motion)

    def close(self) -> None:
        self.world.close_world()


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
    if payload.protocol not in PROTOCOLS:
        raise UnsupportedProtocol(
            f"this worker simulates {', '.join(PROTOCOLS)}; the sweep asks for {payload.protocol!r}"
        )
    compile_force_test()
    gripper = gripper_of(payload.gripper, payload.mass_kg)
    world = GraspWorld(
        parts,
        payload.mass_kg,
        payload.friction,
        gripper,
        payload.fidelity,
        engine=payload.engine,
        motion=MOTIONS.get(payload.protocol),
        visible=visible,
        film_every_s=film_every_s,
        moments_every_s=moments_every_s,
    )
    return Workpiece(collision.Scene(parts), world, gripper)


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


def simulate_chunk(
    payload: SimulatePayload,
    workpiece: Workpiece,
    *,
    known: Mapping[int, Label] | None = None,
    before: Callable[[int], None] = lambda row: None,
    after: Callable[[int, Label], None] = lambda row, label: None,
) -> SimulateResult:
    """Simulate a chunk: an outcome for every pose, and rows for those that met physics.

    ``known`` rows of the chunk need no physics any more: an earlier process simulated them or died of them.
    ``before`` and ``after`` are called around each closing with the row within the chunk.
    """
    known = known or {}
    indices, positions, quaternions = poses_of(payload)
    codes, travel = workpiece.classify(positions, quaternions)
    outcomes = np.full(len(indices), Outcome.MISSED, dtype=np.uint8)
    outcomes[codes == collision.COLLIDES] = Outcome.COLLISION
    physical = np.flatnonzero(codes == collision.CONTACT)
    rows = ResultRows(pose_index=[], width_m=[], quality=[])
    with _no_cycles():
        for row in physical.tolist():
            label = known.get(row)
            if label is None:
                before(row)
                label = workpiece.simulate(positions[row], quaternions[row], float(travel[row]))
                after(row, label)
            outcomes[row] = label.outcome
            rows.pose_index.append(int(indices[row]))
            rows.width_m.append(_finite(label.width_m, 7))
            rows.quality.append(_finite(label.quality, 4))
    packed = base64.b64encode(outcomes.tobytes())
    return SimulateResult(outcomes=packed, rows=rows, engine=workpiece.world.engine)


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


def _finite(value: float, digits: int) -> float | None:
    """Rounded for the wire, where a missing measurement is null: beyond 0.1 um, digits say nothing."""
    return round(min(value, 1e9), digits) if math.isfinite(value) else None

"""Payloads and workpieces of the example objects, as the service would plan them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb.examples import ExampleObject, example
from graspdb.wire import GridPlan, PosePlan, SimulatePayload
from graspdb.wire.presets.grippers import PRESETS
from graspdb_geometry.grippers import shape_of
from graspdb_geometry.poses import ToolPoses
from graspdb_simworker.simulation import chunks

PG70 = PRESETS["pg70"].profile
Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
HALF = math.sqrt(0.5)
RIM = ((0.0, 0.028, 0.035), (1.0, 0.0, 0.0, 0.0))
"""From above over the mug's wall, closing across it."""
ABOVE = ((0.0, 0.0, 0.100), (1.0, 0.0, 0.0, 0.0))
"""Above the mug, out of reach."""
WAIST = ((0.0, 0.0, 0.0), (0.0, HALF, 0.0, HALF))
"""From the side around the cone's middle."""


def plan(
    thing: ExampleObject,
    *,
    grid: dict[str, Any] | None = None,
    poses: list[tuple[Any, Any]] | None = None,
    start: int = 0,
    stop: int | None = None,
    **fields: Any,
) -> SimulatePayload:
    lower, upper = thing.bounds
    grid_plan = pose_plan = None
    if poses is None:
        grid_plan = GridPlan(
            **{
                "lower": tuple(lower),
                "upper": tuple(upper),
                "position_step_m": 0.01,
                "rotation_step_deg": 15.0,
                "margin_m": 0.02,
                "max_poses": 100_000,
                "seed": 5,
                **(grid or {}),
            }
        )
    else:
        pose_plan = PosePlan(position=[p for p, _ in poses], quaternion_xyzw=[q for _, q in poses])
        stop = start + len(poses)
    assert stop is not None
    return SimulatePayload(
        **{
            "sweep": "sweep",
            "object": thing.name,
            "convex_parts": f"/objects/{thing.name}/convex-parts",
            "parts_sha256": thing.name,
            "mass_kg": thing.mass_kg,
            "friction": thing.friction,
            "gripper": PG70,
            "protocol": "wrench",
            "fidelity": "standard",
            "grid": grid_plan,
            "poses": pose_plan,
            "start": start,
            "stop": stop,
            **fields,
        }
    )


@pytest.fixture(scope="session")
def payload_of() -> Callable[..., SimulatePayload]:
    """``payload_of(name, grid=..., poses=..., start=, stop=, ...)``: a chunk's payload for an example
    object."""

    def build(name: str, **options: Any) -> SimulatePayload:
        return plan(example(name), **options)

    return build


@pytest.fixture(scope="session")
def workpiece_of() -> Iterator[Callable[..., chunks.Workpiece]]:
    """A workpiece of an example object at a fidelity in an engine, built once."""
    built: dict[tuple[str, str, str], chunks.Workpiece] = {}

    def get(name: str, fidelity: str = "standard", engine: str = "pybullet") -> chunks.Workpiece:
        key = (name, fidelity, engine)
        if key not in built:
            thing = example(name)
            payload = plan(thing, stop=1, fidelity=fidelity, engine=engine)
            built[key] = chunks.prepare(payload, thing.parts)
        return built[key]

    yield get
    for workpiece in built.values():
        workpiece.close()


@pytest.fixture(scope="session")
def physical_poses() -> Callable[[str, int], list[tuple[Any, Any]]]:
    """Poses from all over an example's grid that only physics can decide."""

    def find(name: str, count: int) -> list[tuple[Any, Any]]:
        from graspdb_geometry import collision

        thing = example(name)
        _, positions, quaternions = chunks.poses_of(plan(thing, stop=40_000))
        codes, _ = collision.Scene(thing.parts).classify(ToolPoses(positions, quaternions), shape_of(PG70))
        rows = np.flatnonzero(codes == collision.CONTACT)
        assert len(rows) >= count
        rows = rows[np.linspace(0, len(rows) - 1, count).astype(int)]
        return [(tuple(positions[r].tolist()), tuple(quaternions[r].tolist())) for r in rows]

    return find


@pytest.fixture(scope="session")
def grasps() -> dict[str, tuple[Any, Any]]:
    """Grasps whose outcome is plain to see."""
    return {"rim": RIM, "above": ABOVE, "waist": WAIST}

"""Where `show` and `verify` take their object and gripper from: a service, or the examples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from graspdb.examples import example
from graspdb.transport import Transport
from graspdb.wire import Finger, GridPlan, GripperInfo, GripperProfile, ObjectInfo, Pose, SimulatePayload
from graspdb_geometry import collision, meshes
from graspdb_geometry.grippers import GRIPPER_SHAPES
from graspdb_simworker import chunks
from graspdb_simworker.bodies import Part
from graspdb_simworker.labels import Label, Outcome, label_of
from graspdb_simworker.scene import GraspWorld


@dataclass(frozen=True)
class Shown:
    """One grasp: its label, and a picture where physics was needed."""

    label: Label
    picture: NDArray[np.uint8] | None


def load(
    name: str, gripper: str, *, url: str | None = None, api_key: str | None = None, seed: int = 0
) -> tuple[SimulatePayload, Sequence[Part]]:
    """Payload of an object's default grid (10 mm, 15 degrees, 20 mm margin), and its convex parts.

    Raises
    ------
    ValueError
        For an unknown example or gripper, or an object that can't be simulated yet.
    GraspDBError
        As the service answers.
    """
    parts: Sequence[Part]
    if url is None:
        thing = example(name)
        shape = GRIPPER_SHAPES.get(gripper)
        if shape is None:
            raise ValueError(
                f"no gripper {gripper!r} without a service; there are {', '.join(GRIPPER_SHAPES)}"
            )
        profile = GripperProfile(
            max_opening_m=shape.max_opening_m,
            finger=Finger(
                width_m=shape.finger_width_m,
                thickness_m=shape.finger_thickness_m,
                length_m=shape.finger_length_m,
            ),
            tip_offset_m=shape.tip_offset_m,
            palm_size_m=shape.palm_size_m,
        )
        parts, mass, friction = thing.parts, thing.mass_kg, thing.friction
    else:
        with Transport(url, api_key=api_key, user_agent="graspdb-simworker") as transport:
            info = ObjectInfo.model_validate_json(transport.request("GET", f"/objects/{name}").content)
            if info.mass_kg is None or info.convex_parts is None:
                raise ValueError(f"{name} needs mass_kg and convex parts before it can be simulated")
            answer = transport.request("GET", f"/grippers/{gripper}")
            profile = GripperInfo.model_validate_json(answer.content).profile
            parts = meshes.parts_from_glb(transport.request("GET", f"/objects/{name}/convex-parts").content)
        mass = info.mass_kg
        friction = profile.friction if info.friction is None else info.friction
    points = np.concatenate([vertices for vertices, _ in parts])
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    grid = GridPlan(
        lower=(low[0], low[1], low[2]),
        upper=(high[0], high[1], high[2]),
        position_step_m=0.01,
        rotation_step_deg=15.0,
        margin_m=0.02,
        seed=seed,
        symmetric=profile.symmetric,
    )
    payload = SimulatePayload(
        sweep="",
        object=name,
        convex_parts="",
        parts_sha256="",
        mass_kg=mass,
        friction=friction,
        gripper=profile,
        protocol="wrench",
        fidelity="standard",
        grid=grid,
        start=0,
        stop=0,
    )
    return payload, parts


def simulate_one(
    payload: SimulatePayload, parts: Sequence[Part], pose: Pose, fidelity: Literal["standard", "fine"]
) -> Shown:
    """Simulate one grasp where it can be seen."""
    shape = chunks.shape_of(payload.gripper)
    codes, first = collision.Scene(parts).classify([pose.position], [pose.quaternion_xyzw], shape)
    if codes[0] == collision.COLLIDES:
        return Shown(Label(Outcome.COLLISION, shape.max_opening_m, 0.0), None)
    if codes[0] == collision.EMPTY:
        return Shown(Label(Outcome.MISSED, 0.0, 0.0), None)
    gripper = chunks.gripper_of(payload.gripper, payload.mass_kg)
    travel = min(float(first[0].min()), 0.5 * shape.max_opening_m)
    with GraspWorld(parts, payload.mass_kg, payload.friction, gripper, fidelity, visible=True) as world:
        closing = world.close(pose.position, pose.quaternion_xyzw, travel)
        label = label_of(closing, gripper, payload.mass_kg, payload.friction)
        return Shown(label, world.pictures[-1])

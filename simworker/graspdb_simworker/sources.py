"""Where `show` and `verify` take their object and gripper from: a service, or the examples."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from graspdb.examples import example
from graspdb.transport import Transport
from graspdb.wire import (
    OUTCOME_CODES,
    Finger,
    GridPlan,
    GripperInfo,
    GripperProfile,
    ObjectInfo,
    Pose,
    SimulatePayload,
    SweepInfo,
    SweepOutcomes,
)
from graspdb_geometry import collision, meshes
from graspdb_geometry.grippers import GRIPPER_SHAPES
from graspdb_simworker import chunks
from graspdb_simworker.bodies import Part
from graspdb_simworker.labels import Label, Outcome, label_of
from graspdb_simworker.scene import GraspWorld
from graspdb_simworker.verification import Stored

Protocol = Literal["wrench", "lift"]

_DRIVES: dict[str, dict[str, float]] = {
    "pg70": {"finger_mass_kg": 0.1, "max_speed_m_s": 0.06, "force_n": 40.0, "friction": 0.4},
    "panda": {"finger_mass_kg": 0.015, "max_speed_m_s": 0.05, "force_n": 70.0, "friction": 0.4},
}
"""What closes the grippers that can be had without a service: as every service has them built in."""


@dataclass(frozen=True)
class Shown:
    """One grasp: its label, and pictures where physics was needed, the end last."""

    label: Label
    pictures: Sequence[NDArray[np.uint8]]


def load(
    name: str,
    gripper: str,
    *,
    protocol: str = "wrench",
    url: str | None = None,
    api_key: str | None = None,
    seed: int = 0,
) -> tuple[SimulatePayload, Sequence[Part]]:
    """Payload of an object's default grid (10 mm, 15 degrees, 20 mm margin), and its convex parts.

    Raises
    ------
    ValueError
        For an unknown example, gripper or protocol, or an object that can't be simulated yet.
    GraspDBError
        As the service answers.
    """
    if protocol not in get_args(Protocol):
        raise ValueError(f"no protocol {protocol!r}; there are {', '.join(get_args(Protocol))}")
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
            **_DRIVES[gripper],
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
        protocol=cast(Protocol, protocol),
        fidelity="standard",
        grid=grid,
        start=0,
        stop=0,
    )
    return payload, parts


def sweep_of(
    sweep: str,
    *,
    per_outcome: int,
    url: str,
    api_key: str | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[SweepInfo, Stored]:
    """A sweep, and of each of its outcomes but collisions a random sample.

    Parameters
    ----------
    sweep : str
    per_outcome : int
        Poses to keep of each outcome, as many as there are at most.
    url, api_key
        The service.
    seed : int
    progress
        Told how many of how many poses have been read.

    Raises
    ------
    ValueError
        If nothing of the sweep is simulated yet.
    GraspDBError
        As the service answers.
    """
    rng = np.random.default_rng(seed)
    # For each outcome the poses with the smallest of random keys, one drawn for each pose.
    kept = {name: np.empty((0, 8)) for name in OUTCOME_CODES if name != "collision"}
    counts = dict.fromkeys(OUTCOME_CODES, 0)
    with Transport(url, api_key=api_key, user_agent="graspdb-simworker") as transport:
        info = SweepInfo.model_validate_json(transport.request("GET", f"/sweeps/{sweep}").content)
        cursor: str | None = None
        while True:
            params: dict[str, str | int] = {"limit": 100_000}
            if cursor is not None:
                params["cursor"] = cursor
            answer = transport.request("GET", f"/sweeps/{sweep}/outcomes", params=params)
            page = SweepOutcomes.model_validate_json(answer.content)
            outcomes = np.array(page.outcome, dtype=object)
            keys = rng.random(len(outcomes))
            for name, before in kept.items():
                rows = np.flatnonzero(outcomes == name)
                counts[name] += len(rows)
                new: NDArray[np.float64] = np.array(
                    [[keys[row], *page.position[row], *page.quaternion_xyzw[row]] for row in rows]
                ).reshape(-1, 8)
                both = np.concatenate([before, new])
                kept[name] = both[np.argsort(both[:, 0])[:per_outcome]]
            counts["collision"] += int((outcomes == "collision").sum())
            progress(sum(counts.values()), info.poses)
            cursor = page.next
            if cursor is None:
                break
    if not any(map(len, kept.values())):
        raise ValueError(f"sweep {sweep} has no outcome to verify yet")
    sample: NDArray[np.float64] = np.concatenate(list(kept.values()))
    codes = np.repeat([OUTCOME_CODES[name] for name in kept], [len(k) for k in kept.values()])
    by_code = {OUTCOME_CODES[name]: n for name, n in counts.items()}
    return info, Stored(sample[:, 1:4], sample[:, 4:8], codes.astype(np.uint8), by_code)


def simulate_one(
    payload: SimulatePayload,
    parts: Sequence[Part],
    pose: Pose,
    fidelity: Literal["standard", "fine"],
    *,
    film_every_s: float = math.inf,
) -> Shown:
    """Simulate one grasp where it can be seen: its end, and before it a picture at every interval."""
    shape = chunks.shape_of(payload.gripper)
    codes, first = collision.Scene(parts).classify([pose.position], [pose.quaternion_xyzw], shape)
    if codes[0] == collision.COLLIDES:
        return Shown(Label(Outcome.COLLISION, shape.max_opening_m, 0.0), [])
    if codes[0] == collision.EMPTY:
        return Shown(Label(Outcome.MISSED, 0.0, 0.0), [])
    gripper = chunks.gripper_of(payload.gripper, payload.mass_kg)
    travel = min(float(first[0].min()), 0.5 * shape.max_opening_m)
    with GraspWorld(
        parts,
        payload.mass_kg,
        payload.friction,
        gripper,
        fidelity,
        lifts=payload.protocol == "lift",
        visible=True,
        film_every_s=film_every_s,
    ) as world:
        closing = world.close(pose.position, pose.quaternion_xyzw, travel)
        label = label_of(closing, gripper, payload.mass_kg, payload.friction)
        return Shown(label, list(world.pictures))

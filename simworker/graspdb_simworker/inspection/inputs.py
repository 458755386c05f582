"""Where `show` and `verify` take their object and gripper from: a service, or the examples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graspdb.examples import example
from graspdb.transport import Transport
from graspdb.wire import GridPlan, GridSpec, GripperInfo, GripperProfile, ObjectInfo, SimulatePayload
from graspdb.wire.presets.grippers import PRESETS
from graspdb.wire.sweeps import Engine, simulated_protocol
from graspdb_geometry import meshes
from graspdb_simworker.simulation.bodies import Part


def load(
    name: str,
    gripper: str,
    *,
    protocol: str = "wrench",
    fine: bool = False,
    engine: Engine | None = None,
    url: str | None = None,
    api_key: str | None = None,
    seed: int = 0,
) -> tuple[SimulatePayload, Sequence[Part]]:
    """Payload of an object's default grid (10 mm, 15 degrees, 20 mm margin), and its convex parts.

    They come from the service at ``url``, or without one from the examples. No engine: the default one.

    ValueError for an unknown example, gripper or protocol, or an object that can't be simulated yet.
    """
    protocol = simulated_protocol(protocol)
    parts: Sequence[Part]
    if not url:
        thing = example(name)
        profile = _built_in(gripper)
        parts, mass, friction = thing.parts, thing.mass_kg, thing.friction
    else:
        with Transport(url, api_key=api_key, user_agent="graspdb-simworker") as transport:
            info = transport.model(ObjectInfo, "GET", f"/objects/{name}")
            if info.mass_kg is None:
                raise ValueError(f"{name} has no mass: graspdb objects change {name} --mass-kg ...")
            if info.convex_parts is None:
                raise ValueError(
                    f"{name} has no convex parts yet: its first sweep has a worker make them, or"
                    f" graspdb objects set-convex-parts {name} FILE stores yours"
                )
            profile = transport.model(GripperInfo, "GET", f"/grippers/{gripper}").profile
            parts = meshes.parts_from_glb(transport.request("GET", f"/objects/{name}/convex-parts").content)
        mass = info.mass_kg
        friction = profile.friction if info.friction is None else info.friction
    points = np.concatenate([vertices for vertices, _ in parts])
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    where = {"lower": low, "upper": high, "symmetric": profile.symmetric}
    grid = GridPlan.model_validate({**GridSpec(seed=seed).model_dump(), **where})
    payload = SimulatePayload(
        sweep="",
        object=name,
        convex_parts="",
        parts_sha256="",
        mass_kg=mass,
        friction=friction,
        gripper=profile,
        protocol=protocol,
        fidelity="fine" if fine else "standard",
        engine=engine,
        grid=grid,
        start=0,
        stop=0,
    )
    return payload, parts


def _built_in(gripper: str) -> GripperProfile:
    preset = PRESETS.get(gripper)
    if preset is None:
        raise ValueError(f"no gripper {gripper!r} without a service; there are {', '.join(PRESETS)}")
    return preset.profile

"""One grasp simulated again for its motion: what fingers and object do, as a document."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from typing import Any

import numpy as np

from graspdb.wire import Pose, SimulatePayload
from graspdb_geometry import collision
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.bodies import Part
from graspdb_simworker.simulation.grasp_world import APPROACH_GAP_M

MOMENTS_EVERY_S = 1.0 / 240.0


def motion(payload: SimulatePayload, parts: Sequence[Part], pose: Pose) -> dict[str, Any]:
    """The motion of a grasp that a worker simulates: its label, and moments in columns.

    ``times_s`` begin where the fingers start from wide open; ``fingers_m`` is how far the finger at +y and
    that at -y are from the middle; ``position`` and ``quaternion_xyzw`` are of the object frame in the tool
    frame, which stands still. Labels do not depend on what ran before, so the same pose, object and gripper
    have the same motion as in a sweep. No moments where the geometry decides. ``width_m`` is less than the
    fingers' last distance by Bullet's margins, which inflate the hulls that it lets touch.
    """
    with closing(chunks.prepare(payload, parts, moments_every_s=MOMENTS_EVERY_S)) as workpiece:
        position, quaternion = np.array([pose.position]), np.array([pose.quaternion_xyzw])
        codes, travel = workpiece.classify(position, quaternion)
        found: dict[str, Any] = {
            "object": payload.object,
            "protocol": payload.protocol,
            "outcome": {collision.COLLIDES: "collision", collision.EMPTY: "missed"}.get(int(codes[0])),
            "width_m": None,
        }
        moments = []
        way_s = 0.0
        if found["outcome"] is None:
            label = workpiece.simulate(position[0], quaternion[0], float(travel[0]))
            found |= {"outcome": label.outcome.name.lower(), "width_m": float(label.width_m)}
            moments = list(workpiece.world.moments)
            # Until just before they touch something, nothing but the fingers moves.
            way_s = max(0.0, float(travel[0]) - APPROACH_GAP_M) / workpiece.gripper.max_speed_m_s
            wide = 0.5 * workpiece.gripper.max_opening_m
            moments.insert(0, moments[0]._replace(time_s=-way_s, fingers_m=(wide, wide)))
    return found | {
        "times_s": [round(moment.time_s + way_s, 6) for moment in moments],
        "fingers_m": [list(moment.fingers_m) for moment in moments],
        "position": [list(moment.position) for moment in moments],
        "quaternion_xyzw": [list(moment.quaternion_xyzw) for moment in moments],
    }

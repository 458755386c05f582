"""What the page says of an arm that takes a grasp, or why it takes none."""

from __future__ import annotations

import re

import numpy as np

from graspdb.resources.results import Grasp
from graspdb.wire import RobotReach, SceneInfo
from graspdb_viewer.panels.cell.arm import ShownRobot
from graspdb_viewer.panels.words import plain


def taken(robot: ShownRobot, grasp: Grasp) -> str:
    """How the arm takes a grasp: joint values at each stage, and how near they come to limits."""
    joints = grasp.joints
    assert joints is not None
    stages = {"pregrasp": joints.pregrasp, "grasp": joints.grasp, "lift": joints.lift}
    known = {name: values for name, values in stages.items() if values is not None}
    rows = [f"| joint | {' | '.join(known)} |", f"|---|{'---|' * len(known)}"]
    for i, joint in enumerate(robot.info.joints):
        values = (_value(stage[i], joint.sliding) for stage in known.values())
        rows.append(f"| {plain(joint.name)} | {' | '.join(values)} |")
    told = "**The arm takes the best grasp.**"
    if grasp.joint_margin is not None:
        told += f" Nearest to a limit on the way: {grasp.joint_margin:.2f} rad or m."
    if grasp.manipulability is not None:
        told += f" Manipulability {grasp.manipulability:.3f}."
    return f"{told}\n\n" + "\n".join(rows)


def refused(robot: ShownRobot, reach: RobotReach, scene: SceneInfo | None) -> str:
    """Why the arm takes none, told of the grasp that it came nearest to."""
    of = f" Told of the nearest of {reach.tested} grasps that were tried."
    if reach.reason == "too_far":
        return f"**Out of the arm's reach** by {reach.off_m:.2f} m: no joint values lead there.{of}"
    if reach.reason == "singular":
        return f"**No straight approach and lift** lead there: the arm is singular on the way.{of}"
    if reach.reason == "joint_limit":
        beyond = {} if reach.joints is None else robot.beyond(np.array(reach.joints))
        said = [
            f"- {plain(name)} at {value:.2f}, its limit being {limit:.2f}"
            for name, (value, limit) in beyond.items()
        ]
        off = f", {reach.off_m:.2f} m off within them" if reach.off_m else ""
        lines = "\n".join(said)
        return f"**Only beyond a joint's limit**{off} (rad or m).{of}\n\n{lines}"
    pairs = [(item.link, item.other) for item in reach.colliding]
    pairs = pairs or ([] if reach.link is None else [(reach.link, str(reach.other))])
    lines = "\n".join(f"- {_link(link)} meets {plain(thing(other, scene))}" for link, other in pairs)
    return f"**It would collide.**{of}\n\n{lines}"


def thing(other: str, scene: SceneInfo | None) -> str:
    """What is collided with, by its place in the question or the scene."""
    place = re.fullmatch(r"(scene|obstacles)\.(boxes|objects)\.(\d+)", other)
    if place is not None:
        number = int(place[3])
        if place[1] == "obstacles":
            return "the obstacle"
        if place[2] == "objects" and scene is not None and number < len(scene.scene.objects):
            return f"{scene.scene.objects[number].object} of the scene"
        return f"box {number + 1} of the scene"
    known = {"object": "the object", "points": "points of the scene", "gripper": "the gripper"}
    return known.get(other, other)


def _link(name: str) -> str:
    return "the gripper" if name == "gripper" else plain(name)


def _value(value: float, sliding: bool) -> str:
    return f"{1e3 * value:.1f} mm" if sliding else f"{np.degrees(value):.1f}°"

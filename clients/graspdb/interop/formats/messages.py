"""JSON and YAML that hold a grasp's pose among other things: MultiGripperGrasp and moveit_msgs/Grasp."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from graspdb.interop.formats.source import SourceFile, Wishes, mapping_of, numbers, same_length
from graspdb.interop.grasps import Raw, Report, problem
from graspdb.interop.outcomes import FAILURE, SUCCESS

#: Hands and other grippers that MultiGripperGrasp has beside its parallel jaws.
_HANDS = re.compile(
    r"allegro|barrett|human|shadow|jaco|3f|3_?finger|leap|h5_?hand|inspire|dexee|svh|ability", re.I
)
QUALITY = "grasp_quality"
LEFT = (
    *("pre_grasp_posture", "grasp_posture", "pre_grasp_approach", "post_grasp_retreat"),
    *("post_place_retreat", "max_contact_force", "allowed_touch_objects"),
)


def read_multigripper(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """A dictionary of lists: ``pose`` [x, y, z, qw, qx, qy, qz], ``result`` 1 or 0, and other numbers."""
    data = mapping_of(source.name, source.json, "the file")
    if "pose" not in data and isinstance(data.get("grasps"), dict):
        yield _planned(source.name, data["grasps"], wishes, report)
        return
    gripper = data.get("gripper")
    if isinstance(gripper, str):
        if _HANDS.search(gripper):
            raise problem(source.name, f"has grasps of {gripper}, a hand; GraspDB knows parallel jaws")
        report.recognise(f"gripper {gripper}")
    if isinstance(data.get("object_ID"), (str, int)):
        report.recognise(f"object {data['object_ID']}")
    poses = numbers(source.name, "pose", data.get("pose"), (None, 7))
    order = wishes.quaternion_order or "wxyz"
    report.assume(f"quaternions {order}")
    quaternion = poses[:, 3:] if order == "xyzw" else poses[:, [4, 5, 6, 3]]
    outcome, qualities = None, {}
    for key, values in data.items():
        if key in ("pose", "gripper", "object_ID", "object_id") or not isinstance(values, list):
            continue
        flat = [float(x) if isinstance(x, bool) else x for x in values]
        if len(flat) != len(poses) or not all(x is None or isinstance(x, (int, float)) for x in flat):
            report.drop(key)
            continue
        column = np.array([np.nan if x is None else x for x in flat], dtype=np.float64)
        if key == "result":
            wrong = np.flatnonzero(~np.isin(column, (0.0, 1.0)))
            if wrong.size:
                row = int(wrong[0])
                raise problem(source.name, f"grasp {row}: result is {column[row]:g}; expected 1 or 0")
            outcome = np.where(column == 1.0, SUCCESS, FAILURE).astype(np.uint8)
            report.map("result 1 to success, 0 to failure")
        else:
            qualities[key] = column
    same_length(source.name, len(poses), {"result": outcome} if outcome is not None else {})
    yield Raw(0, poses[:, :3], quaternion=quaternion, order=order, outcome=outcome, qualities=qualities)


def _planned(file: str, grasps: dict[str, Any], wishes: Wishes, report: Report) -> Raw:
    """What GraspIt! planned before its simulation: ``{number: {body, pose, quality, ...}}``, w last."""
    order = wishes.quaternion_order or "xyzw"
    report.recognise("planned by GraspIt!, not simulated yet")
    report.assume(f"quaternions {order}")
    rows = [mapping_of(file, grasp, f"grasp {number}") for number, grasp in grasps.items()]
    bodies = sorted({str(row.get("body", "")) for row in rows})
    wanted = wishes.only.get("body")
    if wanted is None and len(bodies) > 1:
        raise problem(file, f"has grasps of {', '.join(bodies[:8])}: name one with --only body=...")
    chosen = [row for row in rows if wanted in (None, str(row.get("body", "")))]
    poses = numbers(file, "pose", [row.get("pose") for row in chosen], (None, 7))
    names = sorted({key for row in chosen for key, value in row.items() if isinstance(value, float)})
    qualities = {
        name: np.array(
            [x if isinstance(x := row.get(name), (int, float)) else np.nan for row in chosen], float
        )
        for name in names
    }
    report.drop("contacts and joints' values")
    quaternion = poses[:, 3:] if order == "xyzw" else poses[:, [4, 5, 6, 3]]
    return Raw(0, poses[:, :3], quaternion=quaternion, order=order, qualities=qualities)


def read_moveit(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """moveit_msgs/Grasp, one or many, in JSON or YAML; the frame of ``grasp_pose`` must be the object's."""
    grasps = list(_grasps(source))
    if not grasps:
        raise problem(source.name, "has no grasps")
    position, quaternion, quality, references = [], [], [], set()
    for number, grasp in enumerate(grasps):
        where = f"grasp {number}: grasp_pose"
        stamped = mapping_of(source.name, grasp.get("grasp_pose"), where)
        header = stamped.get("header") or {}
        reference = header.get("frame_id") if isinstance(header, dict) else None
        references.add(str(reference or ""))
        pose = mapping_of(source.name, stamped.get("pose"), f"{where}.pose")
        at = mapping_of(source.name, pose.get("position"), f"{where}.pose.position")
        turn = mapping_of(source.name, pose.get("orientation"), f"{where}.pose.orientation")
        position.append(numbers(source.name, f"{where}.pose.position", [at.get(c) for c in "xyz"], (3,)))
        parts = [turn.get(c) for c in "xyzw"]
        quaternion.append(numbers(source.name, f"{where}.pose.orientation", parts, (4,)))
        score = grasp.get(QUALITY)
        quality.append(
            np.nan if score is None else float(numbers(source.name, f"grasp {number}: {QUALITY}", score, ()))
        )
        for key in LEFT:
            if grasp.get(key):
                report.drop(key)
    report.references = sorted(references - {""})
    report.recognise(f"{len(grasps):,} moveit_msgs/Grasp, poses of the end effector's parent link")
    yield Raw(0, np.array(position), quaternion=np.array(quaternion), qualities={QUALITY: np.array(quality)})


def _grasps(source: SourceFile) -> Iterator[dict[str, Any]]:
    documents = [source.json] if source.suffix == ".json" else source.yaml
    for document in documents:
        if document is None:
            continue
        if isinstance(document, dict) and isinstance(document.get("grasps"), list):
            document = document["grasps"]
        for grasp in document if isinstance(document, list) else [document]:
            yield mapping_of(source.name, grasp, "a grasp")

"""isaac_grasp YAML and moveit_msgs/Grasp."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from graspdb.interop.formats.messages import QUALITY
from graspdb.interop.formats.source import extra
from graspdb.interop.grasps import Report
from graspdb.interop.writers.content import Content

_APPROACH_M, _LEAST_M = 0.1, 0.05
_UP = {"x": 0.0, "y": 0.0, "z": 1.0}


def isaac(path: Path, content: Content, report: Report) -> None:
    """isaac_grasp 1.0: a probability for each grasp, and the joints' values where the gripper has them."""
    closed, opened = content.joints("closed"), content.joints("open")
    if not closed:
        report.drop("the joints' values: the gripper's profile has none (cspace_position stays empty)")
    else:
        report.assume("joints are closed in the grasp, whatever the object's width")
    confidences = content.confidence(report)
    known = ~np.isnan(confidences)
    if not known.any():
        raise ValueError("of none of the grasps a success probability is known, so no confidence can be told")
    if not known.all():
        report.drop(f"{int((~known).sum()):,} grasps whose success probability is not known")
    rows = zip(
        content.poses.position[known].tolist(),
        content.poses.quaternion_xyzw[known].tolist(),
        confidences[known].tolist(),
        strict=True,
    )
    grasps = {
        f"grasp_{number}": {
            "confidence": confidence,
            "position": position,
            "orientation": {"w": w, "xyz": [x, y, z]},
            "cspace_position": dict(closed),
            "pregrasp_cspace_position": dict(opened),
        }
        for number, (position, (x, y, z, w), confidence) in enumerate(rows)
    }
    data = {
        "format": "isaac_grasp",
        "format_version": 1.0,
        "object_frame": content.object_name or "object",
        "gripper_frame": content.frame,
        "grasps": grasps,
    }
    report.assume(
        f"readers know that the gripper's frame is {content.frame}, its axes {content.convention}'s"
    )
    content.left(report, "confidence", "success_probability")
    _dump(path, data)


def moveit(path: Path, content: Content, report: Report) -> None:
    """A list of moveit_msgs/Grasp, JSON or YAML by the name's end, in the object's frame."""
    grasps = grasp_messages(content, report)
    if path.suffix.lower() == ".json":
        path.write_text(json.dumps(grasps, allow_nan=False), encoding="utf-8")
    else:
        _dump(path, grasps)


def grasp_messages(content: Content, report: Report) -> list[dict[str, Any]]:
    """moveit_msgs/Grasp as plain data, the gripper's postures, approach and retreats included."""
    name = next(iter(content.qualities), None)
    if name is None:
        quality = content.held(report).astype(float).tolist()
        report.map(f"outcome to {QUALITY}: 1 for a success, 0 for a failure")
    else:
        quality = content.qualities[name].tolist()
        report.map(f"{name} to {QUALITY}")
    closed, opened = content.joints("closed"), content.joints("open")
    if not closed:
        report.drop("postures: the gripper's profile has no joints")
    report.assume(f"approach over {_APPROACH_M:g} m along the gripper's, retreat along z of the object")
    approach = dict(zip("xyz", content.approach.tolist(), strict=True))
    frame = content.frame
    rows = zip(content.poses.position.tolist(), content.poses.quaternion_xyzw.tolist(), quality, strict=True)
    grasps: list[dict[str, Any]] = [
        {
            "id": f"grasp_{number}",
            "pre_grasp_posture": _posture(opened),
            "grasp_posture": _posture(closed),
            "grasp_pose": {
                "header": {"frame_id": ""},
                "pose": {
                    "position": dict(zip("xyz", position, strict=True)),
                    "orientation": dict(zip("xyzw", quaternion, strict=True)),
                },
            },
            QUALITY: None if score != score else score,
            "pre_grasp_approach": _translation(frame, approach),
            "post_grasp_retreat": _translation("", _UP),
            "post_place_retreat": _translation(frame, {axis: -value for axis, value in approach.items()}),
            "max_contact_force": 0.0,
            "allowed_touch_objects": [],
        }
        for number, (position, quaternion, score) in enumerate(rows)
    ]
    content.left(report, *([] if name is None else [name]))
    return grasps


def _posture(joints: dict[str, float]) -> dict[str, Any]:
    points = [{"positions": list(joints.values()), "time_from_start": {"secs": 0, "nsecs": 0}}]
    return {"joint_names": list(joints), "points": points if joints else []}


def _translation(frame: str, direction: dict[str, float]) -> dict[str, Any]:
    return {
        "direction": {"header": {"frame_id": frame}, "vector": direction},
        "desired_distance": _APPROACH_M,
        "min_distance": _LEAST_M,
    }


def _dump(path: Path, data: Any) -> None:
    yaml = extra("yaml", "YAML")
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    with path.open("w", encoding="utf-8") as file:
        yaml.dump(data, file, Dumper=dumper, sort_keys=False, default_flow_style=None, allow_unicode=True)

"""isaac_grasp YAML 1.0, with its older keys and with those of GraspDataGen.

Poses of the author's gripper frame, whose axes the format does not define.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from graspdb.interop.formats.source import SourceFile, Wishes, mapping_of, numbers
from graspdb.interop.frames import to_graspdb
from graspdb.interop.grasps import Raw, Report, problem

CONFIDENCE = "confidence"
_DATA_GEN = ("open_limit", "finger_colliders", "base_length", "bite_point", "bite_body_idx")


def read(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """``grasps: {name: {confidence, position, orientation {w, xyz}, ...}}``."""
    documents = source.yaml
    data = mapping_of(source.name, documents[0] if documents else None, "the file")
    version = data.get("format_version", 1.0)
    if str(version) not in ("1.0", "1"):
        raise problem(source.name, f"is isaac_grasp {version}; 1.0 is read")
    _say(source.name, data, report)
    grasps = mapping_of(source.name, data.get("grasps"), "grasps")
    if not grasps:
        raise problem(source.name, "has no grasps")
    position, quaternion, confidence = [], [], []
    for number, (label, grasp) in enumerate(grasps.items()):
        where = f"grasp {number} ({str(label)[:60]})"
        if not isinstance(grasp, dict):
            raise problem(source.name, f"{where} must be a mapping")
        orientation = grasp.get("orientation")
        if not isinstance(orientation, dict) or not isinstance(orientation.get("xyz"), list):
            raise problem(source.name, f"{where}: orientation must be {{w, xyz: [3]}}")
        parts = [*orientation["xyz"], orientation.get("w")]
        position.append(numbers(source.name, f"{where}: position", grasp.get("position"), (3,)))
        quaternion.append(numbers(source.name, f"{where}: orientation", parts, (4,)))
        score = grasp.get(CONFIDENCE)
        confidence.append(
            np.nan if score is None else float(numbers(source.name, f"{where}: confidence", score, ()))
        )
        if any(key in grasp for key in ("cspace_position", "pregrasp_cspace_position")):
            report.drop("the joints' values (cspace_position, pregrasp_cspace_position)")
    scores = np.array(confidence)
    qualities = {} if np.isnan(scores).all() else {CONFIDENCE: scores}
    yield Raw(0, np.array(position), quaternion=np.array(quaternion), qualities=qualities)


def _say(name: str, data: dict[str, Any], report: Report) -> None:
    for what in ("object_frame", "gripper_frame"):
        frame = data.get(what, data.get(f"{what}_link"))
        if isinstance(frame, str):
            report.recognise(f"{what} {frame}, which readers are told not to rely on")
    for what in ("object_file", "gripper_file"):
        if isinstance(data.get(what), str):
            if "suction" in data[what].lower():
                raise problem(name, "has grasps of a suction cup; GraspDB knows parallel jaws")
            report.recognise(f"{what} {data[what]}")
    scale = data.get("object_scale", data.get("object_file_scale"))
    if scale is not None:
        factor = float(
            np.ravel(numbers(name, "object_scale", [scale] if np.ndim(scale) == 0 else scale, (None,)))[0]
        )
        report.object_scale = factor
        report.recognise(f"poses of the mesh at scale {factor:.9g}")
    if "approach_axis" in data:
        axis = data["approach_axis"]
        if axis not in (0, 1, 2):
            raise problem(name, f"approach_axis is {axis!r}; expected 0, 1 or 2")
        report.recognise(f"approach along {'xyz'[axis]} of its gripper frame")
        if report.convention is not None and abs(to_graspdb(report.convention)[axis, 2]) < 0.5:
            raise problem(
                name,
                f"approach_axis {axis} says that {'xyz'[axis]} approaches, the convention {report.convention}"
                f" that another axis does: give --convention {'xyz'[axis]}/CLOSING",
            )
    dropped = [key for key in _DATA_GEN if key in data]
    if dropped:
        report.drop(f"{', '.join(dropped)}: the named gripper's profile has its own")

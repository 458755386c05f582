"""isaac_grasp YAML 1.0, with its older keys and with those of GraspDataGen.

Poses of the author's gripper frame, whose axes the format does not define.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from graspdb.interop import joints
from graspdb.interop.formats.messages import in_runs
from graspdb.interop.formats.source import SourceFile, Wishes, numbers
from graspdb.interop.frames import to_graspdb
from graspdb.interop.grasps import Raw, Report, problem

CONFIDENCE = "confidence"
POSTURES = ("cspace_position", "pregrasp_cspace_position")
"""Joints' values in the grasp, and before the jaw closes."""
_DATA_GEN = ("open_limit", "finger_colliders", "base_length", "bite_point", "bite_body_idx")


def read(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """``grasps: {name: {confidence, position, orientation {w, xyz}, ...}}``."""
    head: dict[str, Any] = {}
    number = 0

    def rows() -> Iterator[tuple[list[float], float, Any, Any]]:
        nonlocal number
        documents = 0
        for kind, label, value in source.entries(("grasps",)):
            if documents:
                report.drop("documents after the first one")
            elif kind == "head":
                head[str(label)] = value
            elif kind == "entry":
                where = f"grasp {number} ({str(label)[:60]})"
                yield _grasp(source.name, where, value)
                number += 1
            else:
                # What stands above the grasps explains what may be wrong with them.
                _say(source.name, head, report)
                documents += kind == "end"

    def raw(first: int, rows: list[tuple[list[float], float, Any, Any]]) -> Raw:
        poses = np.array([row[0] for row in rows], dtype=np.float64)
        scores = np.array([row[1] for row in rows])
        return Raw(
            first,
            poses[:, :3],
            quaternion=poses[:, 3:],
            order="wxyz",
            qualities={} if np.isnan(scores).all() else {CONFIDENCE: scores},
            more={joints.AT: [row[2] for row in rows], joints.BEFORE: [row[3] for row in rows]},
        )

    yield from in_runs(rows(), raw)
    if not number:
        raise problem(source.name, "has no grasps")


def _grasp(file: str, where: str, grasp: Any) -> tuple[list[float], float, Any, Any]:
    """Position and quaternion xyzw, confidence, and the joints' values in the grasp and before."""
    if not isinstance(grasp, dict):
        raise problem(file, f"{where} must be a mapping")
    orientation = grasp.get("orientation")
    if not isinstance(orientation, dict) or not isinstance(orientation.get("xyz"), list):
        raise problem(file, f"{where}: orientation must be {{w, xyz: [3]}}")
    parts = numbers(file, f"{where}: position", grasp.get("position"), (3,)).tolist()
    turn = [*orientation["xyz"], orientation.get("w")]
    parts += numbers(file, f"{where}: orientation", turn, (4,)).tolist()
    score = grasp.get(CONFIDENCE)
    confidence = np.nan if score is None else float(numbers(file, f"{where}: confidence", score, ()))
    after, before = (joints.by_name(file, f"{where}: {name}", grasp.get(name)) for name in POSTURES)
    return parts, confidence, after, before


def _say(name: str, data: dict[str, Any], report: Report) -> None:
    version = data.get("format_version", 1.0)
    if str(version) not in ("1.0", "1"):
        raise problem(name, f"is isaac_grasp {version}; 1.0 is read")
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

"""isaac_grasp YAML and moveit_msgs/Grasp."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from graspdb.interop.formats.messages import QUALITY
from graspdb.interop.grasps import Floats, Report
from graspdb.interop.parsing.events import extra
from graspdb.interop.writers.content import Content

_APPROACH_M, _LEAST_M = 0.1, 0.05
_UP = {"x": 0.0, "y": 0.0, "z": 1.0}


def isaac(path: Path, contents: Iterator[Content], report: Report) -> None:
    """isaac_grasp 1.0: a probability for each grasp, and the joints' values where they are known."""
    count = unknown = 0
    with path.open("w", encoding="utf-8") as file:
        for content in contents:
            confidences = content.confidence(report)
            known = ~np.isnan(confidences)
            unknown += int((~known).sum())
            if not content.first:
                _dump(file, _isaac_head(content, report), flow=False)
                file.write("grasps:\n")
            grasps = dict(_isaac_grasps(content, confidences, count, report))
            count += len(grasps)
            if grasps:
                _dump(file, grasps, indent="  ")
            content.left(report, "confidence", "success_probability", postures=True)
    if not count:
        raise ValueError("of none of the grasps a success probability is known, so no confidence can be told")
    if unknown:
        report.drop(f"{unknown:,} grasps whose success probability is not known")


def _isaac_head(content: Content, report: Report) -> dict[str, Any]:
    report.assume(
        f"readers know that the gripper's frame is {content.frame}, its axes {content.convention}'s"
    )
    return {
        "format": "isaac_grasp",
        "format_version": 1.0,
        "object_frame": content.object_name or "object",
        "gripper_frame": content.frame,
    }


def _isaac_grasps(
    content: Content, confidences: Floats, first: int, report: Report
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Grasps whose confidence is known, by names that are numbered from ``first`` on."""
    number = first
    rows = zip(content.poses.rows.tolist(), confidences.tolist(), content.postures(report), strict=True)
    for (x, y, z, *turn, w), confidence, (at, before) in rows:
        if confidence != confidence:
            continue
        if not at:
            report.drop("the joints' values: the gripper's profile has none (cspace_position stays empty)")
        yield (
            f"grasp_{number}",
            {
                "confidence": confidence,
                "position": [x, y, z],
                "orientation": {"w": w, "xyz": turn},
                "cspace_position": dict(at),
                "pregrasp_cspace_position": dict(before),
            },
        )
        number += 1


def moveit(path: Path, contents: Iterator[Content], report: Report) -> None:
    """A list of moveit_msgs/Grasp, JSON or YAML by the name's end, in the object's frame."""
    as_json = path.suffix.lower() == ".json"
    with path.open("w", encoding="utf-8") as file:
        file.write("[" if as_json else "")
        scored = None
        for content in contents:
            scored = scored if content.first else content.score()
            grasps = grasp_messages(content, scored, report)
            if as_json:
                for number, grasp in enumerate(grasps, content.first):
                    file.write(f"{',' if number else ''}\n{json.dumps(grasp, allow_nan=False)}")
            else:
                _dump(file, grasps)
        if as_json:
            file.write("]\n")


def grasp_messages(content: Content, name: str | None, report: Report) -> list[dict[str, Any]]:
    """moveit_msgs/Grasp as plain data, the gripper's postures, approach and retreats included; ``name`` is
    the quality that is told, None: the outcome.
    """
    if name is None:
        quality = content.held(report).astype(float).tolist()
        report.map(f"outcome to {QUALITY}: 1 for a success, 0 for a failure")
    else:
        quality = content.qualities[name].tolist()
        report.map(f"{name} to {QUALITY}")
    report.assume(f"approach over {_APPROACH_M:g} m along the gripper's, retreat along z of the object")
    approach = dict(zip("xyz", content.approach.tolist(), strict=True))
    back = {axis: -value for axis, value in approach.items()}
    frame = content.frame
    rows = zip(content.poses.rows.tolist(), quality, content.postures(report), strict=True)
    grasps: list[dict[str, Any]] = []
    for number, (pose, score, (at, before)) in enumerate(rows, content.first):
        if not at:
            report.drop("postures: the gripper's profile has no joints")
        grasps.append(
            {
                "id": f"grasp_{number}",
                "pre_grasp_posture": _posture(before),
                "grasp_posture": _posture(at),
                "grasp_pose": {
                    "header": {"frame_id": ""},
                    "pose": {
                        "position": dict(zip("xyz", pose[:3], strict=True)),
                        "orientation": dict(zip("xyzw", pose[3:], strict=True)),
                    },
                },
                QUALITY: None if score != score else score,
                "pre_grasp_approach": _translation(frame, approach),
                "post_grasp_retreat": _translation("", _UP),
                "post_place_retreat": _translation(frame, back),
                "max_contact_force": 0.0,
                "allowed_touch_objects": [],
            }
        )
    content.left(report, *([] if name is None else [name]), postures=True)
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


def _dump(file: IO[str], data: Any, indent: str = "", flow: bool | None = None) -> None:
    """Write a piece of YAML, a list or a mapping, each line of it indented."""
    yaml = extra("yaml", "YAML")
    dumper = _dumper(yaml)
    text = yaml.dump(data, Dumper=dumper, sort_keys=False, default_flow_style=flow, allow_unicode=True)
    file.write("".join(f"{indent}{line}\n" for line in text.splitlines()) if indent else text)


@functools.cache
def _dumper(yaml: Any) -> Any:
    """PyYAML's, but that it repeats what is shared, so that every reader and the eye find it in its place."""

    class Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
        def ignore_aliases(self, data: Any) -> bool:
            return True

    return Dumper

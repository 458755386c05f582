"""JSON and YAML that hold a grasp's pose among other things: MultiGripperGrasp and moveit_msgs/Grasp."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from graspdb.interop import joints
from graspdb.interop.formats.source import CHUNK, SourceFile, Wishes, column_of, mapping_of, numbers
from graspdb.interop.grasps import Floats, Raw, Report, problem
from graspdb.interop.outcomes import FAILURE, SUCCESS
from graspdb.interop.parsing.reader import Column

#: Hands and other grippers that MultiGripperGrasp has beside its parallel jaws.
_HANDS = re.compile(
    r"allegro|barrett|human|shadow|jaco|3f|3_?finger|leap|h5_?hand|inspire|dexee|svh|ability", re.I
)
QUALITY = "grasp_quality"
#: Postures, and what a trial has them as.
POSTURES = {"grasp_posture": joints.AT, "pre_grasp_posture": joints.BEFORE}
LEFT = (
    *("pre_grasp_approach", "post_grasp_retreat", "post_place_retreat"),
    *("max_contact_force", "allowed_touch_objects"),
)
_OF_ALL = ("gripper", "object_ID", "object_id")
#: The jaw before and after MultiGripperGrasp's simulation closed it.
_PLANNED, _FINAL = "dofs", "final_dofs"


def read_multigripper(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """A dictionary of lists: ``pose`` [x, y, z, qw, qx, qy, qz], ``result`` 1 or 0, and other numbers."""
    if source.judged(_is_planned):
        yield from _planned(source, wishes, report)
        return
    data = source.mapping(lambda path: len(path) == 1 and path[0] not in _OF_ALL)
    gripper = data.get("gripper")
    if isinstance(gripper, str):
        if _HANDS.search(gripper):
            raise problem(source.name, f"has grasps of {gripper}, a hand; GraspDB knows parallel jaws")
        report.recognise(f"gripper {gripper}")
    if isinstance(data.get("object_ID"), (str, int)):
        report.recognise(f"object {data['object_ID']}")
    poses = column_of(source.name, "pose", data.get("pose"), (7,))
    if not len(poses):
        raise problem(source.name, "has no grasps")
    report.assume(f"quaternions {wishes.quaternion_order or 'wxyz'}")
    columns = dict(_columns(data, poses, report))
    if "result" in data and "result" not in columns:
        raise problem(source.name, f"result must be 1 or 0 for each of {len(poses)} grasps")
    postures = [name for name in (_FINAL, _PLANNED) if name in columns]
    for first in range(0, len(poses), CHUNK):
        part = {name: column.take(first, first + CHUNK) for name, column in columns.items()}
        more = {
            kind: [joints.values_of(source.name, name, None, row) for row in part.pop(name).tolist()]
            for name, kind in zip(postures, joints.KINDS, strict=False)
        }
        outcome = None
        if "result" in part:
            outcome = _outcomes(source.name, part.pop("result"), first)
            report.map("result 1 to success, 0 to failure")
        yield _of_rows(first, poses.take(first, first + CHUNK), wishes, "wxyz", outcome, part, more)


def _is_planned(outline: Any) -> bool | None:
    """Whether these are GraspIt!'s plans, not simulated yet, as soon as that is told."""
    if not isinstance(outline, dict) or "pose" in outline:
        return False
    return True if isinstance(outline.get("grasps"), dict) else None


def _columns(data: dict[str, Any], poses: Column, report: Report) -> Iterator[tuple[str, Column]]:
    """What has numbers for each grasp: one, or of joints several."""
    for key, values in data.items():
        if key == "pose" or not isinstance(values, Column):
            continue
        fits = values.regular and values.count == poses.count
        of_joints = key in (_PLANNED, _FINAL) and len(values.shape) == 1 and not values.gaps
        if fits and (values.shape == () or of_joints) and not (key in (_PLANNED, _FINAL) and not of_joints):
            yield key, values
        else:
            report.drop(key)


def _outcomes(file: str, held: Floats, first: int) -> Any:
    wrong = np.flatnonzero(~np.isin(held, (0.0, 1.0)))
    if wrong.size:
        row = int(wrong[0])
        raise problem(file, f"grasp {first + row}: result is {held[row]:g}; expected 1 or 0")
    return np.where(held == 1.0, SUCCESS, FAILURE).astype(np.uint8)


def _of_rows(
    first: int,
    rows: Floats,
    wishes: Wishes,
    own: str,
    outcome: Any = None,
    qualities: dict[str, Floats] | None = None,
    more: dict[str, Any] | None = None,
) -> Raw:
    """Grasps of rows with position and quaternion, in the format's ``own`` order if nobody says another."""
    order = wishes.quaternion_order or own
    quaternion = rows[:, 3:] if order == "xyzw" else rows[:, [4, 5, 6, 3]]
    return Raw(
        first,
        rows[:, :3],
        quaternion=quaternion,
        order=order,
        outcome=outcome,
        qualities=qualities or {},
        more=more or {},
    )


def _planned(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """What GraspIt! planned before its simulation: ``{number: {body, pose, quality, ...}}``, w last."""
    report.recognise("planned by GraspIt!, not simulated yet")
    report.assume(f"quaternions {wishes.quaternion_order or 'xyzw'}")
    wanted, bodies = wishes.only.get("body"), set[str]()

    def raw(first: int, rows: list[dict[str, Any]]) -> Raw:
        poses = numbers(source.name, "pose", [row.get("pose") for row in rows], (None, 7))
        names = sorted({key for row in rows for key, value in row.items() if isinstance(value, float)})
        qualities = {
            name: np.array(
                [x if isinstance(x := row.get(name), (int, float)) else np.nan for row in rows], float
            )
            for name in names
        }
        return _of_rows(first, poses, wishes, "xyzw", None, qualities)

    def chosen() -> Iterator[dict[str, Any]]:
        for kind, number, value in source.entries(("grasps",)):
            if kind != "entry":
                continue
            row = mapping_of(source.name, value, f"grasp {number}")
            body = str(row.get("body", ""))
            bodies.add(body)
            if wanted is None and len(bodies) > 1:
                told = ", ".join(sorted(bodies))
                raise problem(source.name, f"has grasps of {told}: name one with --only body=...")
            if wanted in (None, body):
                yield row

    yield from in_runs(chosen(), raw)
    report.drop("contacts and joints' values")


def in_runs(grasps: Iterator[Any], raw: Callable[[int, list[Any]], Raw]) -> Iterator[Raw]:
    """Grasps that come one at a time, so many together."""
    rows: list[Any] = []
    first = 0
    for grasp in grasps:
        rows.append(grasp)
        if len(rows) == CHUNK:
            yield raw(first, rows)
            first, rows = first + len(rows), []
    if rows:
        yield raw(first, rows)


def read_moveit(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """moveit_msgs/Grasp, one or many, in JSON or YAML; the frame of ``grasp_pose`` must be the object's."""
    references: set[str] = set()
    number = 0

    def row(grasp: Any) -> tuple[list[float], float, Any, Any]:
        nonlocal number
        where = f"grasp {number}"
        number += 1
        found = _message(source.name, where, mapping_of(source.name, grasp, where), references, report)
        report.references = sorted(references - {""})
        return found

    def raw(first: int, rows: list[tuple[list[float], float, Any, Any]]) -> Raw:
        poses = np.array([row[0] for row in rows], dtype=np.float64)
        return Raw(
            first,
            poses[:, :3],
            quaternion=poses[:, 3:],
            order="xyzw",
            qualities={QUALITY: np.array([row[1] for row in rows])},
            more={joints.AT: [row[2] for row in rows], joints.BEFORE: [row[3] for row in rows]},
        )

    yield from in_runs(map(row, source.grasps(("grasps",))), raw)
    if not number:
        raise problem(source.name, "has no grasps")
    report.recognise(f"{number:,} moveit_msgs/Grasp, poses of the end effector's parent link")


def _message(
    file: str, where: str, grasp: dict[str, Any], references: set[str], report: Report
) -> tuple[list[float], float, Any, Any]:
    """Position and quaternion xyzw of one message, its score, and its postures after and before closing."""
    stamped = mapping_of(file, grasp.get("grasp_pose"), f"{where}: grasp_pose")
    header = stamped.get("header") or {}
    references.add(str((header.get("frame_id") if isinstance(header, dict) else None) or ""))
    pose = mapping_of(file, stamped.get("pose"), f"{where}: grasp_pose.pose")
    parts: list[float] = []
    for name, letters in (("position", "xyz"), ("orientation", "xyzw")):
        what = f"{where}: grasp_pose.pose.{name}"
        given = mapping_of(file, pose.get(name), what)
        parts += numbers(file, what, [given.get(c) for c in letters], (len(letters),)).tolist()
    score = grasp.get(QUALITY)
    quality = np.nan if score is None else float(numbers(file, f"{where}: {QUALITY}", score, ()))
    for key in LEFT:
        if grasp.get(key):
            report.drop(key)
    after, before = (_posture(file, f"{where}: {name}", grasp.get(name), report) for name in POSTURES)
    return parts, quality, after, before


def _posture(file: str, where: str, posture: Any, report: Report) -> Any:
    """The joints' values at the end of a trajectory_msgs/JointTrajectory; None where it has none."""
    if not posture:
        return None
    given = mapping_of(file, posture, where)
    names, points = given.get("joint_names") or [], given.get("points") or []
    if not isinstance(names, list) or not isinstance(points, list):
        raise problem(file, f"{where} must have lists joint_names and points")
    if not points:
        return None
    if len(points) > 1:
        report.drop("points of postures before the last one")
    last = mapping_of(file, points[-1], f"{where}.points")
    if any(last.get(name) for name in ("velocities", "accelerations", "effort")):
        report.drop("velocities, accelerations and effort of postures")
    return joints.values_of(file, f"{where}.points.positions", names, last.get("positions") or [])

"""XML of GraspIt! worlds and of UIBK's experiments: millimetres, quaternions with w first."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from graspdb.interop import joints
from graspdb.interop.formats.messages import in_runs
from graspdb.interop.formats.source import SourceFile, Wishes
from graspdb.interop.frames import precede
from graspdb.interop.grasps import Floats, Raw, Report, problem
from graspdb.interop.outcomes import SUCCESS
from graspdb.poses import Poses, matrices, quaternions_of
from graspdb.wire import OUTCOME_CODES

_FULL = re.compile(r"\s*\(([^()]*)\)\s*\[([^\[\]]*)\]\s*")
#: The code of a grasp of which no outcome is told.
_UNTOLD = 255
#: What UIBK's causes of failure begin with, and the outcome that each is.
_CAUSES = {
    "OBJECTSLIPPED": "slipped",
    "OBJECTDROPPED": "dropped",
    "OBJECTMISSED": "missed",
    "COLLISION": "collision",
    "TIMEOUT": "timeout",
    "SIMULATIONFAILURE": "simulation_error",
}


def read_graspit(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """Each ``robot`` of a world is a grasp of its one ``graspableBody``."""
    bodies: list[Element] = []
    for _, element in source.elements(("graspableBody", "obstacle")):
        if element.tag == "obstacle":
            report.drop("obstacles")
        elif bodies:
            raise problem(source.name, "has several graspable bodies; a grasp is of one")
        else:
            bodies.append(element)
    if not bodies:
        raise problem(source.name, "has 0 graspable bodies; a grasp is of one")
    at, turn = _transform(source.name, bodies[0])
    back = np.asarray(np.linalg.inv(matrices(at, turn)), dtype=np.float64)
    _recognise(report, "object", bodies[0])
    robots = 0

    def placed() -> Iterator[tuple[Floats, Floats, Any]]:
        nonlocal robots
        for _, robot in source.elements(("robot",)):
            _recognise(report, "gripper", robot)
            values = (robot.findtext("dofValues") or "").split()
            posture = None
            if values:
                found = _floats(source.name, f"robot {robots}: dofValues", " ".join(values), len(values))
                assert found is not None
                posture = joints.values_of(source.name, f"robot {robots}: dofValues", None, found.tolist())
            yield *_transform(source.name, robot), posture
            robots += 1

    def raw(first: int, rows: list[tuple[Floats, Floats, Any]]) -> Raw:
        poses = Poses(np.array([row[0] for row in rows]), np.array([row[1] for row in rows]))
        moved, turned = precede(back, poses)
        return Raw(first, moved, quaternion=turned, more={joints.AT: [row[2] for row in rows]})

    yield from in_runs(placed(), raw)
    if not robots:
        raise problem(source.name, "has no robot, so no grasp")


def _recognise(report: Report, what: str, element: Element) -> None:
    name = (element.findtext("filename") or "").strip()
    report.recognise(f"{what} {name or 'without a name'}")


def _transform(file: str, element: Element) -> tuple[Floats, Floats]:
    """Position (3,) as written and unit quaternion xyzw (4,); GraspIt! normalises what it reads."""
    text = element.findtext("transform/fullTransform")
    if text is None:
        raise problem(file, f"{element.tag} has no transform/fullTransform")
    found = _FULL.fullmatch(text)
    try:
        if found is None:
            raise ValueError
        w, x, y, z = map(float, found[1].split())
        position = np.array([float(part) for part in found[2].split()])
        if position.shape != (3,) or not np.hypot(np.hypot(w, x), np.hypot(y, z)) > 1e-6:
            raise ValueError
    except ValueError:
        raise problem(file, f"a fullTransform is (qw qx qy qz)[x y z], not {text.strip()[:80]!r}") from None
    quaternion = np.array([x, y, z, w])
    return position, quaternion / np.linalg.norm(quaternion)


def read_uibk(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """``experiments/experiment`` with object, gripper and ``grasps/grasp``: pose, and an outcome."""
    told, objects, grippers = False, dict[int, str](), dict[int, str]()
    for number, element in source.elements(("object", "gripper", "outcome"), "experiment"):
        if element.tag == "outcome":
            told = told or element.find("success") is not None or element.find("failure") is not None
        else:
            (objects if element.tag == "object" else grippers)[number] = element.get("type", "")
    kinds, wanted = sorted(set(objects.values())), wishes.only.get("object")
    if wanted is None and len(kinds) > 1:
        raise problem(source.name, f"has grasps of {', '.join(kinds[:8])}: name one with --only object=...")
    for number in sorted({*objects, *grippers}):
        if wanted in (None, objects.get(number, "")):
            for what, types in (("object", objects), ("gripper", grippers)):
                if types.get(number):
                    report.recognise(f"{what} {types[number]}")
    counted = untold = 0

    def grasps() -> Iterator[Element]:
        nonlocal counted
        for number, grasp in source.elements(("grasp",), "experiment"):
            if wanted in (None, objects.get(number, "")):
                yield grasp
                counted += 1

    for raw in in_runs(grasps(), partial(_of_elements, source.name, report)):
        assert raw.outcome is not None
        without = raw.outcome == _UNTOLD
        untold += int(without.sum())
        yield raw.part(~without) if told else replace(raw, outcome=None)
    if not counted:
        raise problem(source.name, "has no grasps" + (f" of {wanted}" if wanted else ""))
    if told and untold:
        report.drop(f"{untold:,} grasps without an outcome")


def _of_elements(file: str, report: Report, first: int, grasps: list[Element]) -> Raw:
    placed = [_pose(file, first + row, grasp) for row, grasp in enumerate(grasps)]
    codes, qualities = _outcomes(grasps, report)
    return Raw(
        first,
        np.array([at for at, _ in placed]),
        quaternion=np.array([turn for _, turn in placed]),
        outcome=codes,
        qualities=qualities,
    )


def _pose(file: str, number: int, grasp: Element) -> tuple[Floats, Floats]:
    where = f"grasp {number}"
    position = _floats(file, f"{where}: position", grasp.findtext("pose/position/euclidean"), 3)
    assert position is not None
    element = grasp.find("pose/orientation/quaternion")
    turned = _floats(
        file, f"{where}: rotmatrix", grasp.findtext("pose/orientation/rotmatrix"), 9, needed=False
    )
    if element is None:
        if turned is None:
            raise problem(file, f"{where} has no orientation")
        return position, _checked(file, where, turned)
    parts = _floats(file, f"{where}: quaternion", element.text, 4)
    assert parts is not None
    quaternion = parts if element.get("format", "wxyz") == "xyzw" else parts[[1, 2, 3, 0]]
    if turned is not None and abs(abs(_checked(file, where, turned) @ quaternion) - 1.0) > 1e-4:
        raise problem(file, f"{where}: its quaternion and its rotmatrix are different rotations")
    return position, quaternion


def _checked(file: str, where: str, nine: Floats) -> Floats:
    try:
        return np.asarray(quaternions_of(nine.reshape(1, 3, 3))[0])
    except ValueError:
        raise problem(file, f"{where}: its rotmatrix is no rotation") from None


def _floats(file: str, what: str, text: str | None, count: int, *, needed: bool = True) -> Floats | None:
    if text is None and not needed:
        return None
    try:
        found = np.array([float(part) for part in (text or "").split()])
    except ValueError:
        found = np.zeros(0)
    if found.shape != (count,):
        raise problem(file, f"{what} must be {count} numbers")
    return found


def _outcomes(grasps: list[Element], report: Report) -> tuple[Any, dict[str, Floats]]:
    """Codes (N,), :data:`_UNTOLD` where nothing is told, and the qualities by name."""
    codes = np.full(len(grasps), _UNTOLD, dtype=np.uint8)
    qualities: dict[str, Floats] = {}

    def note(name: str, row: int, text: str | None) -> None:
        try:
            value = float(text or "")
        except ValueError:
            return
        qualities.setdefault(name, np.full(len(grasps), np.nan))[row] = value

    for row, grasp in enumerate(grasps):
        outcome = grasp.find("outcome")
        if outcome is None:
            continue
        success, failure = outcome.find("success"), outcome.find("failure")
        if success is not None:
            codes[row] = SUCCESS
            note("quality", row, success.get("quality"))
        elif failure is not None:
            cause = failure.get("cause", "").upper()
            name = next((to for start, to in _CAUSES.items() if cause.startswith(start)), "failure")
            codes[row] = OUTCOME_CODES[name]
            report.map(f"failure{f' {cause}' if cause else ''} to {name}")
        for informal in outcome.findall("informal"):
            note(informal.get("uri", "informal"), row, informal.get("quality"))
    return codes, qualities

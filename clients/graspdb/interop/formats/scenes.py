"""XML of GraspIt! worlds and of UIBK's experiments: millimetres, quaternions with w first."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from graspdb.interop.formats.source import SourceFile, Wishes
from graspdb.interop.frames import precede
from graspdb.interop.grasps import Floats, Raw, Report, problem
from graspdb.interop.outcomes import SUCCESS
from graspdb.poses import Poses, matrices, quaternions_of
from graspdb.wire import OUTCOME_CODES

_FULL = re.compile(r"\s*\(([^()]*)\)\s*\[([^\[\]]*)\]\s*")
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
    world = source.xml
    bodies, robots = world.findall("graspableBody"), world.findall("robot")
    if len(bodies) != 1:
        raise problem(source.name, f"has {len(bodies)} graspable bodies; a grasp is of one")
    if not robots:
        raise problem(source.name, "has no robot, so no grasp")
    at, turn = _transform(source.name, bodies[0])
    back = np.asarray(np.linalg.inv(matrices(at, turn)), dtype=np.float64)
    placed = [_transform(source.name, robot) for robot in robots]
    position = np.array([p for p, _ in placed])
    quaternion = np.array([q for _, q in placed])
    moved, turned = precede(back, Poses(position, quaternion))
    for element in (bodies[0], *robots):
        name = (element.findtext("filename") or "").strip()
        report.recognise(f"{'object' if element is bodies[0] else 'gripper'} {name or 'without a name'}")
    if any(robot.find("dofValues") is not None for robot in robots):
        report.drop("the joints' values (dofValues)")
    if world.find("obstacle") is not None:
        report.drop("obstacles")
    yield Raw(0, moved, quaternion=turned)


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
    root = source.xml
    experiments = root.findall("experiment") if root.tag == "experiments" else [root]
    kinds = sorted({_kind(experiment, "object") for experiment in experiments})
    wanted = wishes.only.get("object")
    if wanted is None and len(kinds) > 1:
        raise problem(source.name, f"has grasps of {', '.join(kinds[:8])}: name one with --only object=...")
    chosen = [e for e in experiments if wanted in (None, _kind(e, "object"))]
    for what in ("object", "gripper"):
        for kind in sorted({_kind(experiment, what) for experiment in chosen} - {""}):
            report.recognise(f"{what} {kind}")
    grasps = [grasp for experiment in chosen for grasp in _grasps_of(experiment)]
    if not grasps:
        raise problem(source.name, "has no grasps" + (f" of {wanted}" if wanted else ""))
    position, quaternion = [], []
    for number, grasp in enumerate(grasps):
        at, turn = _pose(source.name, number, grasp)
        position.append(at)
        quaternion.append(turn)
    codes, qualities = _outcomes(grasps, report)
    untold = codes == 255
    if untold.any() and not untold.all():
        report.drop(f"{int(untold.sum()):,} grasps without an outcome")
    raw = Raw(
        0,
        np.array(position),
        quaternion=np.array(quaternion),
        outcome=None if untold.all() else codes,
        qualities=qualities,
    )
    yield raw if untold.all() else raw.part(~untold)


def _kind(experiment: Element, what: str) -> str:
    found = experiment.find(what)
    return "" if found is None else found.get("type", "")


def _grasps_of(experiment: Element) -> list[Element]:
    return experiment.findall("grasps/grasp") or experiment.findall("grasp")


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
    """Codes (N,), 255 where nothing is told, and the qualities by name."""
    codes = np.full(len(grasps), 255, dtype=np.uint8)
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

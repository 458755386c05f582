"""The arm of a URDF: the chain from its root to a link, and convex solids of the links' collision shapes.

Pinocchio reads the joints. The file's text is all that is read here: meshes are asked for by name.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin  # extra: robot
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from .arm import Arm, Floats, LinkSolid
from .collision import self_collisions

MAX_LINKS, MAX_JOINTS, MAX_SOLIDS = 300, 12, 200
_LONGEST_NAME = 200
#: Sides of the prism that stands for a cylinder, which it contains.
_SIDES = 24
#: Points of a mesh of which no hull is made; only a broken file has so flat a body.
_FLAT_M = 1e-4
#: Draws by which pairs of solids are judged, and the share of them that must collide to say that they always
#: do: their hulls overlap where the links are joined.
_DRAWS, _ALWAYS = 400, 0.3

MeshPoints = Callable[[str], "Floats | None"]
"""Points of a mesh by its name in the file, in the file's unit; None where it is not known."""


class UrdfError(ValueError):
    """What is wrong with a robot, for a person, and which field of the request says it."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field
        self.message = message


def read_arm(xml: bytes, flange: str | None, mesh_points: MeshPoints) -> tuple[str, Arm]:
    """The robot's name, and its arm from the root to the link ``flange``.

    UrdfError for what is no URDF, names no such link (or none, with the links there are), or has no chain of
    1 to 12 joints to it.
    """
    root = _parsed(xml)
    links = [_name(link, "link") for link in root.findall("link")]
    if not 1 <= len(links) <= MAX_LINKS:
        raise UrdfError("robot", f"a robot has 1 to {MAX_LINKS} links, not {len(links)}")
    if flange is None or flange not in links:
        told = "name the link that the gripper is mounted on" if flange is None else f"no link {flange!r}"
        raise UrdfError("flange", f"{told}: the robot has {', '.join(links)}"[:2_000])
    parents = {
        _end(joint, "child"): (_end(joint, "parent"), _name(joint, "joint"), joint.get("type", ""))
        for joint in root.findall("joint")
    }
    path, beyond = _path(flange, parents), _beyond(flange, parents)
    movable = [name for _, name, kind in path if kind != "fixed"]
    if not 1 <= len(movable) <= MAX_JOINTS:
        raise UrdfError(
            "flange", f"{len(movable)} joints lead to it, not 1 to {MAX_JOINTS}: is it the flange?"
        )
    for joint in root.findall("joint"):
        if joint.get("name") in movable and joint.find("mimic") is not None:
            raise UrdfError("robot", f"joint {joint.get('name')!r} mimics another: such arms are not known")
    model = _reduced(xml, set(movable))
    arm = _chain(model, flange, movable)
    solids, untested = _solids(root, model, beyond, mesh_points)
    solid = Arm(**{**vars(arm), "solids": solids, "untested": untested})
    ends = tuple(dict.fromkeys([*(parent for parent, _, _ in path), flange]))
    whole = Arm(**{**vars(solid), "pairs": _pairs(solid), "links": ends})
    return root.get("name", "robot")[:_LONGEST_NAME], whole


def _parsed(xml: bytes) -> Any:
    if re.search(rb"<!\s*(DOCTYPE|ENTITY)", xml, re.IGNORECASE):
        raise UrdfError("robot", "a URDF has no DOCTYPE and no entities: remove them")
    try:
        root = ElementTree.fromstring(xml)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise UrdfError("robot", f"not XML: {error}") from None
    if root.tag != "robot":
        told = "expand it first (xacro FILE > FILE.urdf)" if "xacro" in root.tag else "send a URDF"
        raise UrdfError("robot", f"its root element is <{root.tag[:80]}>, not <robot>: {told}")
    if any("xacro" in str(item.tag) for item in root.iter()):
        raise UrdfError("robot", "it has xacro in it: expand it first (xacro FILE > FILE.urdf)")
    return root


def _name(item: Any, kind: str) -> str:
    name = item.get("name")
    if not name:
        raise UrdfError("robot", f"a {kind} has no name")
    if len(name) > _LONGEST_NAME:
        raise UrdfError("robot", f"a {kind}'s name has more than {_LONGEST_NAME} characters")
    return str(name)


def _end(joint: Any, end: str) -> str:
    found = joint.find(end)
    link = None if found is None else found.get("link")
    if not link:
        raise UrdfError("robot", f"joint {joint.get('name')!r} names no {end} link")
    return str(link)


def _path(flange: str, parents: dict[str, tuple[str, str, str]]) -> list[tuple[str, str, str]]:
    """Joints (parent link, name, type) from the root to the flange."""
    path: list[tuple[str, str, str]] = []
    link = flange
    while link in parents:
        path.append(parents[link])
        link = parents[link][0]
        if len(path) > MAX_LINKS:
            raise UrdfError("robot", "its links go round in a circle")
    return path[::-1]


def _beyond(flange: str, parents: dict[str, tuple[str, str, str]]) -> set[str]:
    """The links that hang at the flange: a gripper, which its own profile stands for."""
    found, more = set[str](), {flange}
    while more:
        found |= more
        more = {child for child, (parent, _, _) in parents.items() if parent in more} - found
    return found - {flange}


def _reduced(xml: bytes, movable: set[str]) -> Any:
    try:
        model = pin.buildModelFromXML(xml.decode("utf-8"))
        locked = [i for i, name in enumerate(model.names) if i and name not in movable]
        low, high = model.lowerPositionLimit, model.upperPositionLimit
        rest = np.clip(pin.neutral(model), np.fmin(low, high), np.fmax(low, high))
        return pin.buildReducedModel(model, locked, rest) if locked else model
    except (RuntimeError, ValueError, UnicodeDecodeError, IndexError) as error:
        raise UrdfError("robot", f"pinocchio can't read it: {str(error)[:300]}") from None


def _chain(model: Any, flange: str, movable: list[str]) -> Arm:
    names = list(model.names)[1:]
    if names != movable:
        raise UrdfError("robot", f"the joints to the flange are no single chain of one axis each: {movable}")
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    sliding, axes, lower, upper = [], [], [], []
    for i in range(1, model.njoints):
        joint = model.joints[i]
        if joint.nv != 1:
            raise UrdfError("robot", f"joint {model.names[i]!r} turns about more than one axis")
        column = pin.getJointJacobian(model, data, i, pin.LOCAL)[:, joint.idx_v]
        slides = bool(np.abs(column[:3]).max() > 0.5)
        axis = column[:3] if slides else column[3:]
        sliding.append(slides)
        axes.append(axis / np.linalg.norm(axis))
        # A joint without end has a cosine and a sine, and no limits.
        endless = joint.nq != 1
        low = -np.inf if endless else float(model.lowerPositionLimit[joint.idx_q])
        high = np.inf if endless else float(model.upperPositionLimit[joint.idx_q])
        if not low < high:
            raise UrdfError("robot", f"joint {model.names[i]!r} has no range: limits {low:g} and {high:g}")
        if slides and not (math.isfinite(low) and math.isfinite(high) and high - low < 100.0):
            raise UrdfError("robot", f"joint {model.names[i]!r} slides without end: give it limits in metres")
        lower.append(low if abs(low) < 100.0 else -np.inf)
        upper.append(high if abs(high) < 100.0 else np.inf)
    frame = model.frames[model.getFrameId(flange, pin.FrameType.BODY)]
    return Arm(
        joints=tuple(names),
        sliding=np.array(sliding, dtype=np.bool_),
        lower=np.array(lower),
        upper=np.array(upper),
        placements=np.array([place.homogeneous for place in model.jointPlacements])[1:],
        axes=np.array(axes),
        flange=np.array(frame.placement.homogeneous),
    )


def _solids(
    root: Any, model: Any, beyond: set[str], mesh_points: MeshPoints
) -> tuple[tuple[LinkSolid, ...], tuple[str, ...]]:
    solids, untested = list[LinkSolid](), list[str]()
    for link in root.findall("link"):
        name = _name(link, "link")
        if name in beyond or not model.existFrame(name, pin.FrameType.BODY):
            continue
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        shapes = link.findall("collision")
        read = 0
        for shape in shapes:
            found = _shape(shape, mesh_points)
            if found is None:
                continue
            points, radius = found
            place = np.array(frame.placement.homogeneous) @ _origin(shape.find("origin"))
            moved = points @ place[:3, :3].T + place[:3, 3]
            if len(solids) == MAX_SOLIDS:
                raise UrdfError("robot", f"more than {MAX_SOLIDS} collision shapes: send simpler ones")
            solids.append(LinkSolid(name, int(frame.parentJoint), moved, radius))
            read += 1
        if read < len(shapes) or (not shapes and link.find("visual") is not None):
            untested.append(name)
    return tuple(solids), tuple(untested)


def _shape(shape: Any, mesh_points: MeshPoints) -> tuple[Floats, float] | None:
    """Points of a collision shape's hull, metres, in its own frame, and how far around them it reaches."""
    geometry = shape.find("geometry")
    kind = None if geometry is None or not len(geometry) else geometry[0]
    if kind is None:
        return None
    if kind.tag == "box":
        half = np.array(_numbers(kind.get("size"), 3)) / 2
        return half * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T, 0.0
    if kind.tag == "sphere":
        return np.zeros((1, 3)), _number(kind.get("radius"))
    if kind.tag in ("cylinder", "capsule"):
        radius, end = _number(kind.get("radius")), _number(kind.get("length")) / 2
        if kind.tag == "capsule":
            return np.array([[0.0, 0.0, -end], [0.0, 0.0, end]]), radius
        turn = np.arange(_SIDES) * 2 * np.pi / _SIDES
        rim = radius / math.cos(np.pi / _SIDES) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        return np.concatenate([np.column_stack([rim, np.full(_SIDES, z)]) for z in (-end, end)]), 0.0
    if kind.tag != "mesh":
        return None
    points = mesh_points(kind.get("filename") or "")
    if points is None:
        return None
    hull = _hull(points * np.array(_numbers(kind.get("scale") or "1 1 1", 3)))
    return None if hull is None else (hull, 0.0)


def _hull(points: Floats) -> Floats | None:
    if len(points) < 4 or not np.isfinite(points).all() or np.ptp(points, axis=0).max() < _FLAT_M:
        return None
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:
        return None


def _origin(item: Any) -> Floats:
    place = np.eye(4)
    if item is not None:
        place[:3, 3] = _numbers(item.get("xyz") or "0 0 0", 3)
        place[:3, :3] = Rotation.from_euler("xyz", _numbers(item.get("rpy") or "0 0 0", 3)).as_matrix()
    return place


def _numbers(text: str | None, count: int) -> list[float]:
    try:
        values = [float(word) for word in (text or "").split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise UrdfError("robot", f"{(text or '')[:80]!r} should be {count} numbers")
    return values


def _number(text: str | None) -> float:
    value = _numbers(text, 1)[0]
    if not 0.0 <= value < 100.0:
        raise UrdfError("robot", f"a size of {value:g} m is none of a robot's")
    return value


def _pairs(arm: Arm) -> NDArray[np.int64]:
    """Solids to be tested against each other: not those of one link or of neighbours, nor those that collide
    in a large share of all positions, or in the middle one: their hulls overlap.
    """
    near = [
        (i, j)
        for i, one in enumerate(arm.solids)
        for j, other in enumerate(arm.solids[:i])
        if abs(one.joint - other.joint) > 1
    ]
    if not near:
        return np.zeros((0, 2), dtype=np.int64)
    pairs = np.array(near, dtype=np.int64)
    low, high = arm.range_of()
    drawn = np.random.default_rng(0).uniform(low, high, (_DRAWS, len(low)))
    hits = self_collisions(Arm(**{**vars(arm), "pairs": pairs}), np.concatenate([arm.middle[None], drawn]))
    return np.asarray(pairs[~hits[0] & (hits[1:].mean(axis=0) < _ALWAYS)])

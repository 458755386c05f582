"""Gripper profiles made of URDFs: which links are the two fingers, how far they open, where their tips are.

The file itself and meshes that lie in its folder are all that is opened. What a URDF does not say is assumed
in words, and stands in the profile as not verified.
"""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from graspdb.poses import as_poses
from graspdb.wire import GripperProfile

Floats = NDArray[np.float64]

MAX_BYTES, MAX_MESH_BYTES, MAX_LINKS = 4 * 2**20, 64 * 2**20, 200
_STEPS = 32
#: Tips that move by less than this along the approach move straight.
_STRAIGHT_M = 5e-4
#: Fingers that are this far apart across their closing direction are not one finger.
_BESIDE_M = 0.01
_TOOL_NAMES = ("hand_tcp", "tcp", "grasp_frame", "grasp_center", "grasp_link", "tool_center", "hande_end")
_FLANGE_NAMES = ("flange", "mount", "coupler", "attach")
_SUCTION = re.compile(r"suction|vacuum|cup|ejector", re.IGNORECASE)
#: What libraries raise at a file that is not what it should be.
_TROUBLES = (
    *(ArithmeticError, AssertionError, AttributeError, LookupError, NotImplementedError, OSError),
    *(SyntaxError, TypeError, ValueError, struct.error),
)
_MESHES = {".stl": "stl", ".obj": "obj", ".ply": "ply"}
_OTHER = "graspdb knows parallel jaws with two fingers; see docs/guide/grippers.md"


@dataclass(frozen=True)
class FoundGripper:
    """A gripper as a URDF has it: ``found`` says what of the file is which part, ``assumed`` what it leaves
    open.
    """

    name: str
    profile: GripperProfile
    found: Mapping[str, str]
    assumed: tuple[str, ...]


def read_gripper(path: Path | str) -> FoundGripper:
    """The profile of the gripper in a URDF file (extra ``urdf``); ValueError, in words, for what is none."""
    model = _Model.read(Path(path))
    jaw = _jaw(model)
    swing = _swing(model, jaw)
    assumed = [*model.notes, *jaw.notes, *swing.notes]
    fields = _profile(model, jaw, swing, assumed)
    source = f"URDF {model.name!r}, {Path(path).name}; base is the link {model.root}"
    profile = GripperProfile.model_validate({**fields, "source": source, "unverified": assumed})
    found = {
        "base": model.root,
        "palm": jaw.palm,
        "fingers": f"{jaw.tips[0]} and {jaw.tips[1]}",
        "driven joints": ", ".join(jaw.drivers),
        "mimic joints": ", ".join(jaw.mimics) or "none",
        "opening": f"{1e3 * swing.openings[-1]:.1f} mm",
        "tips": "move on arcs" if profile.tip_offsets else "move straight",
        "approach, closing": f"{_axis(jaw.axes[:, 2])}, {_axis(jaw.axes[:, 1])} of the base",
    }
    return FoundGripper(model.name, profile, found, tuple(assumed))


@dataclass(frozen=True, eq=False)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    origin: Floats
    axis: Floats
    lower: float
    upper: float
    velocity: float | None
    effort: float | None
    mimic: tuple[str, float, float] | None

    @property
    def moves(self) -> bool:
        return self.kind in ("prismatic", "revolute", "continuous")

    def at(self, value: float) -> Floats:
        """The child in the parent, (4, 4)."""
        motion = np.eye(4)
        if self.kind == "prismatic":
            motion[:3, 3] = value * self.axis
        elif self.moves:
            x, y, z = self.axis
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            motion[:3, :3] += math.sin(value) * cross + (1.0 - math.cos(value)) * cross @ cross
        return np.asarray(self.origin @ motion)


@dataclass(frozen=True, eq=False)
class _Model:
    """A URDF's tree; ``corners`` (8 k, 3) of the boxes about the geometry of each link, in its frame."""

    name: str
    root: str
    joints: tuple[_Joint, ...]
    corners: Mapping[str, Floats]
    masses: Mapping[str, float]
    notes: tuple[str, ...]

    @classmethod
    def read(cls, path: Path) -> _Model:
        robot = _parsed(path)
        names = [str(link.name) for link in robot.links]
        if len(names) > MAX_LINKS or len(robot.joints) > MAX_LINKS:
            raise ValueError(
                f"{path.name} has more than {MAX_LINKS} links or joints: give the gripper's own URDF"
            )
        joints = tuple(_joint(joint) for joint in robot.joints)
        root = _root(names, joints)
        corners, notes = {}, list[str]()
        for link in robot.links:
            corners[str(link.name)], told = _corners(link, path)
            notes += told
        masses = {str(link.name): float(link.inertial.mass or 0.0) for link in robot.links if link.inertial}
        return cls(str(robot.name), root, joints, corners, masses, tuple(dict.fromkeys(notes)))

    def below(self, link: str) -> list[_Joint]:
        return [joint for joint in self.joints if joint.parent == link]

    def subtree(self, link: str) -> Iterator[str]:
        """A link and all that hang on it."""
        yield link
        for joint in self.below(link):
            yield from self.subtree(joint.child)

    def rigid(self, link: str) -> list[str]:
        """A link and what hangs on it without a moving joint in between."""
        fixed = [joint.child for joint in self.below(link) if not joint.moves]
        return [link, *(name for child in fixed for name in self.rigid(child))]

    def moving(self, link: str) -> list[_Joint]:
        """The moving joints below a link."""
        links = set(self.subtree(link))
        return [joint for joint in self.joints if joint.moves and joint.parent in links]

    def poses(self, values: Mapping[str, float]) -> dict[str, Floats]:
        """Every link in the root, (4, 4); joints that are not named are at 0."""
        found, pending = {self.root: np.eye(4)}, [self.root]
        while pending:
            link = pending.pop()
            for joint in self.below(link):
                found[joint.child] = found[link] @ joint.at(self.value(joint, values))
                pending.append(joint.child)
        return found

    def value(self, joint: _Joint, values: Mapping[str, float]) -> float:
        """Where a joint is, with the driven ones at these values."""
        if joint.mimic is None:
            return values.get(joint.name, 0.0)
        leader, multiplier, offset = joint.mimic
        return multiplier * values.get(leader, 0.0) + offset

    def points(self, links: Sequence[str], poses: Mapping[str, Floats]) -> Floats:
        """Corners of the links' boxes in the root frame, metres, (k, 3)."""
        parts = [self.corners[link] @ poses[link][:3, :3].T + poses[link][:3, 3] for link in links]
        return np.concatenate(parts) if parts else np.empty((0, 3))


def _parsed(path: Path) -> Any:
    """The file as yourdfpy reads it, once it is known to be harmless."""
    try:
        import yourdfpy
    except ImportError as error:
        raise ImportError("reading a URDF needs yourdfpy: pip install 'graspdb[urdf]'") from error
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path.name} is larger than {MAX_BYTES:,} bytes: that is no gripper's URDF")
    data = path.read_bytes()
    if b"\x00" in data or b"<!doctype" in data.lower() or b"<!entity" in data.lower():
        raise ValueError(f"{path.name} has a DTD or is no UTF-8: a URDF has neither, and it is not read")
    try:
        tree = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ValueError(f"{path.name} is no XML: {error}") from None
    if any("xacro" in str(element.tag) for element in tree.iter()) or b"${" in data:
        raise ValueError(
            f"{path.name} is a xacro file: make a URDF of it first (xacro {path.name} > FILE.urdf)"
        )
    if tree.tag != "robot":
        raise ValueError(f"{path.name} is no URDF: its outermost element is <{tree.tag}>, not <robot>")
    try:
        loaded = yourdfpy.URDF.load(io.BytesIO(data), build_scene_graph=False, load_meshes=False)
    except _TROUBLES as error:
        # Whatever a library makes of somebody's file is no reason for a traceback.
        raise ValueError(f"{path.name} can't be read as a URDF: {type(error).__name__}: {error}") from None
    return loaded.robot


def _joint(joint: Any) -> _Joint:
    limit, mimic = joint.limit, joint.mimic
    axis = np.asarray([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, dtype=np.float64)
    origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=np.float64)
    lower, upper = (
        0.0 if limit is None or getattr(limit, end) is None else float(getattr(limit, end))
        for end in ("lower", "upper")
    )
    norm = float(np.linalg.norm(axis))
    if not (np.isfinite(origin).all() and np.isfinite([norm, lower, upper]).all() and norm > 1e-9):
        raise ValueError(f"joint {joint.name!r} has numbers that are not finite, or no axis")
    tied = None
    if mimic is not None:
        multiplier = 1.0 if mimic.multiplier is None else float(mimic.multiplier)
        tied = (str(mimic.joint), multiplier, 0.0 if mimic.offset is None else float(mimic.offset))
    velocity, effort = (
        None if limit is None or getattr(limit, what) is None else float(getattr(limit, what))
        for what in ("velocity", "effort")
    )
    parent, child = str(joint.parent), str(joint.child)
    return _Joint(
        *(str(joint.name), str(joint.type), parent, child, origin, axis / norm, lower, upper),
        *(velocity, effort, tied),
    )


def _root(names: Sequence[str], joints: Sequence[_Joint]) -> str:
    """The link that everything hangs on; ValueError where the links are no tree."""
    children = [joint.child for joint in joints]
    strangers = {link for joint in joints for link in (joint.parent, joint.child)} - set(names)
    if strangers:
        raise ValueError(f"joints name links that there are not: {', '.join(sorted(strangers)[:5])}")
    if len(set(names)) < len(names) or len(set(children)) < len(children):
        raise ValueError("a link stands twice, or hangs on two joints: the links of a URDF are a tree")
    roots = [name for name in names if name not in set(children)]
    if len(roots) != 1:
        raise ValueError(f"{len(roots)} links hang on no joint: a URDF has one root")
    reached, pending = set[str](), [roots[0]]
    while pending:
        link = pending.pop()
        reached.add(link)
        pending += [joint.child for joint in joints if joint.parent == link]
    if len(reached) < len(names):
        raise ValueError("some links hang on one another in a circle: the links of a URDF are a tree")
    return roots[0]


def _corners(link: Any, path: Path) -> tuple[Floats, list[str]]:
    """Corners of boxes about a link's collision geometry, or of what is seen, and what could not be read."""
    found, notes = list[Floats](), list[str]()
    for element in link.collisions or link.visuals or ():
        geometry = element.geometry
        origin = np.eye(4) if element.origin is None else np.asarray(element.origin, dtype=np.float64)
        box = _box(geometry, path, notes)
        if box is None or not np.isfinite(origin).all() or not np.isfinite(box).all():
            continue
        low, high = box
        signs = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        found.append((low + signs * (high - low)) @ origin[:3, :3].T + origin[:3, 3])
    return (np.concatenate(found) if found else np.empty((0, 3))), notes


def _box(geometry: Any, path: Path, notes: list[str]) -> Floats | None:
    """Lower and upper corner of a geometry in its own frame, (2, 3) metres."""
    if geometry is None:
        return None
    if geometry.box is not None:
        half = np.abs(np.asarray(geometry.box.size, dtype=np.float64)) / 2
    elif geometry.cylinder is not None:
        radius, length = float(geometry.cylinder.radius), float(geometry.cylinder.length)
        half = np.array([radius, radius, length / 2])
    elif geometry.sphere is not None:
        half = np.full(3, float(geometry.sphere.radius))
    elif geometry.mesh is not None:
        return _mesh_box(geometry.mesh, path, notes)
    else:
        return None
    return np.array([-half, half])


def _mesh_box(mesh: Any, path: Path, notes: list[str]) -> Floats | None:
    """The box about a mesh in the URDF's own folder; elsewhere nothing is opened."""
    name = str(mesh.filename)
    folder = path.resolve().parent
    if "://" in name or Path(name).is_absolute():
        notes.append(f"mesh {name} is not opened: only files in the folder of the URDF are")
        return None
    file = (folder / name).resolve()
    if not file.is_relative_to(folder):
        notes.append(f"mesh {name} is not opened: it lies outside the folder of the URDF")
        return None
    kind = _MESHES.get(file.suffix.lower())
    if kind is None or not file.is_file() or file.stat().st_size > MAX_MESH_BYTES:
        notes.append(f"mesh {name} is not read: there is no such STL, OBJ or PLY file of at most 64 MiB")
        return None
    import trimesh

    try:
        # From memory, so that no other file that the mesh names is opened.
        loaded = trimesh.load(io.BytesIO(file.read_bytes()), file_type=kind, force="mesh")
        bounds = np.asarray(loaded.bounds, dtype=np.float64)
    except _TROUBLES as error:
        notes.append(f"mesh {name} is not read: {type(error).__name__}")
        return None
    scale = np.ones(3) if mesh.scale is None else np.asarray(mesh.scale, dtype=np.float64) * np.ones(3)
    scaled = bounds * scale
    return np.sort(scaled, axis=0) if scaled.shape == (2, 3) else None


@dataclass(frozen=True, eq=False)
class _Jaw:
    """What of a model is the palm and what the fingers; ``axes`` (3, 3): the tool's in the root, in columns.

    ``parts`` are each finger's links; ``open_at`` and ``shut_at`` the values of the driven joints.
    """

    palm: str
    tips: tuple[str, str]
    parts: tuple[tuple[str, ...], tuple[str, ...]]
    drivers: tuple[str, ...]
    mimics: tuple[str, ...]
    open_at: Mapping[str, float]
    shut_at: Mapping[str, float]
    axes: Floats
    notes: tuple[str, ...]

    def values(self, share: float) -> dict[str, float]:
        """Of the driven joints, from shut (0) to open (1)."""
        return {n: (1.0 - share) * self.shut_at[n] + share * self.open_at[n] for n in self.drivers}


def _jaw(model: _Model) -> _Jaw:
    palm, notes = _palm(model)
    moving = model.moving(palm)
    drivers = [joint for joint in moving if joint.mimic is None and joint.upper > joint.lower]
    mimics = [joint for joint in moving if joint.mimic is not None]
    if not drivers:
        raise ValueError(f"no joint below {palm} has a range to move in: are its limits missing? {_OTHER}")
    if len(drivers) > 2:
        raise ValueError(f"{len(drivers)} joints move independently: that is a hand. {_OTHER}")
    middle = {joint.name: (joint.lower + joint.upper) / 2 for joint in drivers}
    poses = model.poses(middle)
    leaves = _leaves(model, list(model.subtree(palm)))
    approach, tips = _fingers(model, leaves, poses)
    closing = _middle(model, tips[0], poses) - _middle(model, tips[1], poses)
    closing -= approach * (closing @ approach)
    y = _snapped(closing / np.linalg.norm(closing))
    axes = np.column_stack([np.cross(y, approach), y, approach])
    parts = tuple(tuple(_finger_links(model, palm, tip)) for tip in tips)
    jaw = _Jaw(
        palm=palm,
        tips=tips,
        parts=(parts[0], parts[1]),
        drivers=tuple(joint.name for joint in drivers),
        mimics=tuple(joint.name for joint in mimics),
        open_at={joint.name: joint.upper for joint in drivers},
        shut_at={joint.name: joint.lower for joint in drivers},
        axes=axes,
        notes=tuple(notes),
    )
    return _opened(model, jaw, drivers)


def _palm(model: _Model) -> tuple[str, list[str]]:
    """The link that the fingers branch off, below joints that move both alike."""
    palm, notes = model.root, list[str]()
    if not model.moving(palm):
        told = (
            "it looks like a suction cup"
            if _looks_like_suction(model)
            else "it may be a suction cup or a tool"
        )
        raise ValueError(f"no joint of {model.name!r} moves, so it has no fingers: {told}. {_OTHER}")
    while True:
        ways = [j for j in model.below(palm) if j.moves or model.moving(j.child)]
        if len(ways) != 1:
            return palm, notes
        (way,) = ways
        if way.moves and not model.moving(way.child):
            if _looks_like_suction(model):
                raise ValueError(f"{model.name!r} looks like a suction cup. {_OTHER}")
            raise ValueError(f"only one finger moves ({way.child}); both must. {_OTHER}")
        if way.moves:
            notes.append(f"joint {way.name} turns or moves the whole jaw: it is held at 0")
        if len(notes) > 1:
            raise ValueError(
                "several joints move the whole jaw, as a robot's do: give the gripper's own URDF"
            )
        palm = way.child


def _looks_like_suction(model: _Model) -> bool:
    return any(_SUCTION.search(name) for name in [model.name, *model.corners])


def _leaves(model: _Model, links: Sequence[str]) -> list[str]:
    """Links that a joint moves and no moving joint hangs on, with geometry."""
    moved = [joint.child for joint in model.joints if joint.moves and joint.child in links]
    leaves = [link for link in moved if not model.moving(link)]
    shaped = [link for link in leaves if any(len(model.corners[part]) for part in model.rigid(link))]
    if len(shaped) < 2:
        told = "; ".join(model.notes[:2]) or "boxes, cylinders, spheres and meshes in its folder are read"
        raise ValueError(f"the fingers have no geometry that can be read: {told}")
    return shaped


def _fingers(
    model: _Model, leaves: Sequence[str], poses: Mapping[str, Floats]
) -> tuple[Floats, tuple[str, str]]:
    """The approach, along one of the root's axes, and the foremost link of either finger."""
    middles = np.array([_middle(model, leaf, poses) for leaf in leaves])
    centre = middles.mean(axis=0)
    axis = int(np.argmax(np.abs(centre)))
    if abs(centre[axis]) < 1e-6:
        raise ValueError("the fingers lie about the root's origin: which way they approach is not known")
    approach = np.zeros(3)
    approach[axis] = math.copysign(1.0, centre[axis])
    across = middles - centre - np.outer((middles - centre) @ approach, approach)
    ahead = [float((model.points(model.rigid(leaf), poses) @ approach).max()) for leaf in leaves]
    first = int(np.argmax(ahead))
    direction = across[first]
    if np.linalg.norm(direction) < 1e-6:
        raise ValueError(f"a finger is in the middle of the others: that is a hand. {_OTHER}")
    direction = direction / np.linalg.norm(direction)
    sides = across @ direction
    aside = np.abs(across @ np.cross(approach, direction))
    if (aside > _BESIDE_M + 0.2 * np.abs(sides)).any():
        raise ValueError(f"there are more than two fingers, or they do not face each other. {_OTHER}")
    front: list[str] = []
    for sign in (1.0, -1.0):
        side = [i for i in range(len(leaves)) if sign * sides[i] > 0]
        if not side:
            raise ValueError(f"all that moves is on one side: where is the other finger? {_OTHER}")
        front.append(leaves[max(side, key=lambda i: ahead[i])])
    return approach, (front[0], front[1])


def _finger_links(model: _Model, palm: str, tip: str) -> list[str]:
    """The tip and all between it and the palm that moves."""
    by_child = {joint.child: joint for joint in model.joints}
    links, link = [tip], tip
    while by_child[link].parent != palm:
        link = by_child[link].parent
        links.append(link)
    return links


def _middle(model: _Model, link: str, poses: Mapping[str, Floats]) -> Floats:
    points = model.points(model.rigid(link), poses)
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def _snapped(direction: Floats) -> Floats:
    """A direction, exactly along an axis where it is within a degree of it."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < math.cos(math.radians(1.0)):
        return direction
    exact = np.zeros(3)
    exact[axis] = math.copysign(1.0, direction[axis])
    return exact


def _gap(model: _Model, jaw: _Jaw, values: Mapping[str, float]) -> float:
    """How far apart the tips' boxes are in the closing direction, metres; negative where they overlap."""
    poses = model.poses(values)
    one, other = (model.points(model.rigid(tip), poses) @ jaw.axes[:, 1] for tip in jaw.tips)
    return float(one.min() - other.max())


def _opened(model: _Model, jaw: _Jaw, drivers: Sequence[_Joint]) -> _Jaw:
    """The jaw with each driven joint's end at which it is open."""
    open_at, shut_at = dict(jaw.open_at), dict(jaw.shut_at)
    for joint in drivers:
        middle = {other.name: (other.lower + other.upper) / 2 for other in drivers}
        low, high = (_gap(model, jaw, middle | {joint.name: end}) for end in (joint.lower, joint.upper))
        if abs(high - low) < 1e-5:
            raise ValueError(f"joint {joint.name} does not change how far the fingers are apart. {_OTHER}")
        if low > high:
            open_at[joint.name], shut_at[joint.name] = joint.lower, joint.upper
    notes = list(jaw.notes)
    if len(drivers) == 2:
        notes.append("joints: the two driven joints are taken to move alike")
    return _Jaw(**{**vars(jaw), "open_at": open_at, "shut_at": shut_at, "notes": tuple(notes)})


@dataclass(frozen=True, eq=False)
class _Swing:
    """Openings (n,) ascending from shut, the tips' place along the approach (n,), the joints' share (n,)."""

    openings: Floats
    ahead: Floats
    shares: Floats
    notes: tuple[str, ...]


def _swing(model: _Model, jaw: _Jaw) -> _Swing:
    shares = np.linspace(0.0, 1.0, _STEPS + 1)
    gaps = np.array([_gap(model, jaw, jaw.values(share)) for share in shares])
    tips = np.array([_ahead(model, jaw, jaw.values(share)) for share in shares])
    notes = list[str]()
    if not (np.diff(gaps) > 0).all() or gaps[-1] <= 1e-4:
        raise ValueError("the fingers do not open steadily over their joints' range, or not at all")
    if gaps[0] > 1e-3:
        notes.append(f"opening: {1e3 * gaps[0]:.1f} mm are left between the closed fingers' boxes")
    if gaps[0] < 0.0:
        shut = float(np.interp(0.0, gaps, shares))
        keep = shares > shut
        tip = float(np.interp(shut, shares, tips))
        if gaps[0] < -1e-3:
            notes.append("opening: the boxes touch before the joints' end, which is taken as closed")
        gaps, tips = np.array([0.0, *gaps[keep]]), np.array([tip, *tips[keep]])
        shares = np.array([shut, *shares[keep]])
    return _Swing(gaps, tips, shares, tuple(notes))


def _ahead(model: _Model, jaw: _Jaw, values: Mapping[str, float]) -> float:
    poses = model.poses(values)
    return float(max((model.points(model.rigid(t), poses) @ jaw.axes[:, 2]).max() for t in jaw.tips))


def _profile(model: _Model, jaw: _Jaw, swing: _Swing, assumed: list[str]) -> dict[str, Any]:
    """Fields of the profile; adds to what is assumed."""
    poses = model.poses(jaw.values(1.0))
    one, other = (model.points(model.rigid(tip), poses) @ jaw.axes for tip in jaw.tips)
    middle = (one[:, 1].min() + other[:, 1].max()) / 2
    sides = (min(one[:, 0].min(), other[:, 0].min()), max(one[:, 0].max(), other[:, 0].max()))
    centre = np.array([sum(sides) / 2, middle])
    begin = min(one[:, 2].min(), other[:, 2].min())
    palm_low, palm_high, face = _palm_box(model, jaw, poses, centre, begin)
    tip = float(swing.ahead[-1])
    length = tip - face
    offset = _tool_offset(model, poses, jaw, tip, length, assumed)
    position = jaw.axes @ np.array([*centre, tip - offset])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = jaw.axes, position
    place = as_poses(pose)
    ahead = swing.ahead - tip + offset
    arcs = float(np.ptp(ahead)) > _STRAIGHT_M
    if (ahead < 0.0).any():
        raise ValueError("the closed fingertips are behind the tool's origin: name a frame 'tcp' behind them")
    points = zip(swing.openings[:-1], ahead[:-1], strict=True)
    offsets = [{"opening_m": round(float(o), 6), "tip_offset_m": round(float(a), 6)} for o, a in points]
    thickness = max(float(np.ptp(part[:, 1])) for part in (one, other))
    assumed.append("friction: 0.4; a URDF says nothing of the pads'")
    return {
        "max_opening_m": round(float(swing.openings[-1]), 6),
        "finger": {
            "width_m": round(float(sides[1] - sides[0]), 6),
            "thickness_m": round(thickness, 6),
            "length_m": round(float(length), 6),
        },
        "tip_offset_m": round(float(offset), 6),
        "tip_offsets": offsets if arcs else [],
        "palm_size_m": [round(float(size), 6) for size in np.maximum(palm_high - palm_low, 1e-3)],
        "base_to_tool": {
            "position": place.position[0].tolist(),
            "quaternion_xyzw": place.quaternion_xyzw[0].tolist(),
        },
        "frames": _flange(model, poses),
        "joints": _joint_values(model, jaw, swing),
        "symmetric": True,
        **_drive(model, jaw, assumed),
    }


def _flange(model: _Model, poses: Mapping[str, Floats]) -> dict[str, Any]:
    """The frame on which the gripper is screwed, where a link is named so."""
    for link in _static(model):
        if link != model.root and any(name in link.lower() for name in _FLANGE_NAMES):
            at = as_poses(poses[link])
            position, quaternion = at.position[0].tolist(), at.quaternion_xyzw[0].tolist()
            return {"flange": {"position": position, "quaternion_xyzw": quaternion}}
    return {}


def _joint_values(model: _Model, jaw: _Jaw, swing: _Swing) -> dict[str, Any]:
    """Of driven and mimic joints: open, and where the fingers meet."""
    ends = {"open": jaw.values(1.0), "closed": jaw.values(float(swing.shares[0]))}
    named = {joint.name: joint for joint in model.joints}
    joints = [named[name] for name in (*jaw.drivers, *jaw.mimics)]
    return {
        joint.name: {end: round(model.value(joint, values), 6) for end, values in ends.items()}
        for joint in joints
    }


def _palm_box(
    model: _Model, jaw: _Jaw, poses: Mapping[str, Floats], centre: Floats, tips_begin: float
) -> tuple[Floats, Floats, float]:
    """Extents of the palm about the tool's axis, which passes through ``centre`` (2,), and where the fingers
    begin: linkage behind them is palm.
    """
    tips = {name for tip in jaw.tips for name in model.rigid(tip)}
    linkage = [link for link in model.subtree(model.root) if link not in tips and len(model.corners[link])]
    points = model.points(linkage, poses) @ jaw.axes
    points = points[points[:, 2] < tips_begin + 1e-9] if len(points) else points
    if not len(points):
        # Nothing behind the fingers: a plate at the root.
        return np.array([-0.02, -0.02, -1e-3]), np.array([0.02, 0.02, 0.0]), min(0.0, tips_begin - 1e-3)
    static = model.points([link for link in linkage if link in set(_static(model))], poses) @ jaw.axes
    face = min(float(static[:, 2].max()) if len(static) else 0.0, tips_begin)
    face = max(face, float(points[:, 2].max()))
    low, high = points.min(axis=0), points.max(axis=0)
    # The profile's box is even about the tool's axis, wherever the base is.
    reach = np.maximum(np.abs(low[:2] - centre), np.abs(high[:2] - centre))
    return np.array([*-reach, low[2]]), np.array([*reach, face]), face


def _static(model: _Model) -> list[str]:
    return model.rigid(model.root)


def _tool_offset(
    model: _Model,
    poses: Mapping[str, Floats],
    jaw: _Jaw,
    tip: float,
    length: float,
    assumed: list[str],
) -> float:
    """How far behind the open tips the tool's origin is: at a frame that says so by its name, else 10 mm."""
    for link in (name for wanted in _TOOL_NAMES for name in model.corners if name.lower().endswith(wanted)):
        behind = tip - float(poses[link][:3, 3] @ jaw.axes[:, 2])
        if link in poses and 0.0 <= behind <= length:
            assumed.append(f"base_to_tool: the tool's origin is at the height of the frame {link}")
            return behind
    assumed.append("base_to_tool: no frame is named tcp; the tool's origin is 10 mm behind the open tips")
    return min(0.01, length / 2)


def _drive(model: _Model, jaw: _Jaw, assumed: list[str]) -> dict[str, float]:
    """Force, speed and mass, where the file tells them."""
    joints = {joint.name: joint for joint in model.joints}
    driver = joints[jaw.drivers[0]]
    told: dict[str, float] = {}
    straight = driver.kind == "prismatic"
    if straight and driver.velocity is not None and 1e-3 <= driver.velocity <= 1.0:
        told["max_speed_m_s"] = driver.velocity
    else:
        assumed.append("max_speed_m_s: 0.06, which is usual")
    if straight and driver.effort is not None and 0.1 <= driver.effort <= 10_000.0:
        told["force_n"] = driver.effort
        assumed.append(f"force_n: the effort limit of {driver.name}")
    else:
        assumed.append("force_n: 40, which is usual")
    mass = sum(model.masses.get(link, 0.0) for part in jaw.parts[0] for link in model.rigid(part))
    if 1e-3 <= mass <= 5.0:
        told["finger_mass_kg"] = round(mass, 6)
    else:
        assumed.append("finger_mass_kg: 0.1, which is usual")
    return told


def _axis(direction: Floats) -> str:
    """A direction in words: ``+z``, or its numbers."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) > 1.0 - 1e-9:
        return f"{'+' if direction[axis] > 0 else '-'}{'xyz'[axis]}"
    return " ".join(f"{x:+.2f}" for x in direction)

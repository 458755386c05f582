"""From the constraints a person asks for, in either frame, to what a search takes, in the object's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from graspdb.wire import BestGraspRequest, GraspConstraints, Obstacles, Pose, PoseColumns
from graspdb.wire.frames.gripper_frames import RESERVED, NoSuchFrame
from graspdb.wire.frames.object_frames import MESH, mesh_placed
from graspdb_density import Region, se3
from graspdb_density.se3 import Poses
from graspdb_density.search.pose_noise import normal_displacements
from graspdb_geometry.collision import PointCloud, Scene, box_part
from graspdb_service.problems import ProblemError, invalid_fields
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.cells.standing import PlacedSolid, StandingScene
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.trials.pose_frames import PoseFrame
from graspdb_service.usecases.trials.selection import Selected

_AXES = np.eye(3)
#: Limits that miss each other by less than this meet: they come rounded, and are turned.
_TOUCH_M = 1e-8
_NOISE = ("pose_noise_m", "pose_noise_deg", "tool_noise_m", "tool_noise_deg")


#: Draws of a pose's covariance that a mean is taken over.
_BELIEF_DRAWS = 64


@dataclass(frozen=True, eq=False)
class Belief:
    """By what a grasp is displaced (K), seen from where the object may be, and how likely that is (K,); in
    words, what was believed.
    """

    displacements: Poses
    weights: Floats
    told: str


@dataclass(frozen=True, eq=False)
class Constraints:
    """What bounds a grasp, in the object frame, and what its parts were called in the request.

    ``object_pose`` is the object frame in the world frame, one pose, where it was given, ``in_world`` whether
    the request's constraints were in that; ``frame`` what its poses were of. ``obstacles`` are what the
    gripper must not touch besides the object; ``candidates`` the only poses to rank, ``exclude`` those to
    stay away from, all of the tool.
    """

    region: Region
    half_space_names: tuple[str, ...]
    object_pose: Poses | None
    in_world: bool
    frame: PoseFrame
    obstacles: tuple[Scene | PointCloud | PlacedSolid, ...] = ()
    candidates: Poses | None = None
    exclude: Poses | None = None
    scene: StandingScene | None = None
    belief: Belief | None = None

    def named(self, active: tuple[str, ...]) -> list[str]:
        """The request's names of the region's active limits, each once."""
        names = []
        for item in active:
            kind, _, index = item.partition("[")
            if kind == "half_spaces":
                names.append(self.half_space_names[int(index.rstrip("]"))])
            else:
                names.append({"spheres": "sphere"}.get(kind, kind))
        return list(dict.fromkeys(names))


def constraints(
    request: GraspConstraints,
    selected: Selected,
    frame: PoseFrame,
    scene: StandingScene | None = None,
    solids: Scenes | None = None,
) -> Constraints:
    """Check a request's constraints and bring them to the object frame; 422 names fields that contradict.

    Boxes become half spaces, for in the object frame they may stand askew. ``frame``: what its poses are of;
    ``scene`` the one that the request names, and ``solids`` what its objects' geometry is found in.
    """
    _check(request)
    pose = _object_pose(request, selected.row)
    in_world = request.in_world
    shift, turn = pose if in_world and pose is not None else (np.zeros(3), se3.IDENTITY)
    rotation = se3.to_matrix(turn)

    planes = _planes(request)
    names = [name for name, _, _ in planes]
    # n . (R x + t) >= d is (R^T n) . x >= d - n . t.
    rows = [[*(rotation.T @ normal), d - float(normal @ shift)] for _, normal, d in planes]
    spheres = None
    if request.sphere is not None:
        centre = rotation.T @ (np.array(request.sphere[:3]) - shift)
        spheres = [[*centre, request.sphere[3]]]
    apart = _apart(names, np.array(rows).reshape(-1, 4), None if spheres is None else np.array(spheres[0]))
    if apart:
        told = "no position fulfils " + " and ".join(apart) + " at once"
        raise _contradiction([(name, told) for name in apart])
    try:
        region = Region(
            half_spaces=rows or None,
            approach=None if request.approach is None else rotation.T @ np.array(request.approach),
            approach_angle=_radians(request.approach_cone_deg),
            closing=None if request.closing is None else rotation.T @ np.array(request.closing),
            closing_angle=_radians(request.closing_cone_deg),
            spheres=spheres,
            closing_signed=not selected.jaw_symmetric,
        )
    except ValueError as error:
        # What is left to contradict after the checks above are the two cones.
        cones = ("approach_cone_deg", "closing_cone_deg")
        raise _contradiction([(name, str(error)) for name in cones]) from None
    into = se3.inverse(Poses(shift, turn))
    posted = request if isinstance(request, BestGraspRequest) else BestGraspRequest()
    return Constraints(
        region,
        tuple(names),
        pose,
        in_world,
        frame,
        (*_obstacles(posted.obstacles, into), *_scene(scene, solids, pose)),
        _moved(posted.candidates, into, frame),
        _moved(posted.exclude, into, frame),
        scene,
        _belief(posted, pose),
    )


def _belief(request: BestGraspRequest, pose: Poses | None) -> Belief | None:
    """Where the object may be beside its pose."""
    belief = request.object_belief
    if belief is None or pose is None:
        return None
    if belief.covariance is not None:
        try:
            drawn = normal_displacements(np.array(belief.covariance), _BELIEF_DRAWS)
        except ValueError as error:
            raise _contradiction([("object_pose.covariance", str(error))]) from None
        turned = se3.multiply(se3.from_rotation_vector(drawn[:, 3:]), pose.quaternions_xyzw)
        there = Poses(pose.positions + drawn[:, :3], se3.normalise(turned))
        told = "the covariance of the object's pose"
    else:
        values = np.array(belief.poses)
        given = Poses(values[:, :3], se3.normalise(values[:, 3:]))
        # Of the frame that object_pose is of, as that is.
        first = Poses(np.array(request.object_pose)[:3], np.array(request.object_pose)[3:])
        there = Poses(*se3.compose(given, Poses(*se3.compose(se3.inverse(first), pose))))
        told = f"{len(values)} weighted poses of the object"
    weights = np.ones(len(there)) if belief.weights is None else np.array(belief.weights)
    p, q = se3.compose(se3.inverse(there), pose)
    return Belief(Poses(p, se3.normalise(q)), weights / weights.sum(), told)


def _object_pose(request: GraspConstraints, row: ObjectRow) -> Poses | None:
    """The object frame in the world frame, where it is known; 422 for a frame that the object has not."""
    if request.object_pose is None:
        return None
    values = request.object_pose
    given = Pose.model_construct(position=values[:3], quaternion_xyzw=values[3:])
    frames = {name: Pose.model_validate(pose) for name, pose in (row.frames or {}).items()}
    try:
        pose = mesh_placed(given, frames, request.object_frame or MESH)
    except NoSuchFrame as error:
        told = f"{error}: PATCH /objects/{row.slug} with it in frames adds one"
        raise invalid_fields([("object_frame", told)]) from None
    return Poses(np.array(pose.position), np.array(pose.quaternion_xyzw))


def _planes(request: GraspConstraints) -> list[tuple[str, Floats, float]]:
    """Half spaces n, d, each with the name of the field it comes from."""
    planes = [("box_min", axis, low) for axis, low in zip(_AXES, request.box_min or (), strict=False)]
    planes += [("box_max", -axis, -high) for axis, high in zip(_AXES, request.box_max or (), strict=False)]
    given = [] if request.above_plane is None else [("above_plane", request.above_plane)]
    if isinstance(request, BestGraspRequest):
        given += [(f"half_spaces.{i}", row) for i, row in enumerate(request.half_spaces or ())]
    for name, row in given:
        length = float(np.linalg.norm(row[:3]))
        planes.append((name, np.array(row[:3]) / length, row[3] / length))
    return planes


def _obstacles(given: Obstacles | None, into: Poses) -> tuple[Scene | PointCloud, ...]:
    solids: list[Scene | PointCloud] = []
    if given is not None and given.boxes:
        parts = []
        for box in given.boxes:
            p, q = se3.compose(into, Poses(np.array(box.position), np.array(box.quaternion_xyzw)))
            parts.append(box_part(np.array(box.size_m) / 2, p, q))
        solids.append(Scene(parts))
    if given is not None and given.points:
        points = into.positions + se3.rotate(into.quaternions_xyzw, np.array(given.points))
        solids.append(PointCloud(points, given.point_radius_m))
    return tuple(solids)


def _scene(
    scene: StandingScene | None, solids: Scenes | None, object_pose: Poses | None
) -> tuple[Scene | PointCloud | PlacedSolid, ...]:
    """What stands in a scene, which is in the world, in the object frame."""
    if scene is None or solids is None or object_pose is None:
        return ()
    into = se3.inverse(object_pose)
    found: list[Scene | PointCloud | PlacedSolid] = list(_obstacles(scene.content, into))
    for item in scene.content.objects:
        solid = solids.solid(scene.rows[item.object])
        if solid is not None:
            pose = se3.compose(into, Poses(np.array(item.pose[:3]), np.array(item.pose[3:])))
            found.append(PlacedSolid(solid, Poses(*pose)))
    return tuple(found)


def _moved(given: Sequence[Pose] | PoseColumns | None, into: Poses, frame: PoseFrame) -> Poses | None:
    if given is None:
        return None
    p, q = se3.compose(into, frame.to_tool(poses_of(given)))
    return Poses(p, se3.normalise(q))


def poses_of(given: Sequence[Pose] | PoseColumns) -> Poses:
    """A request's poses in either form."""
    if isinstance(given, PoseColumns):
        return Poses(np.array(given.position), np.array(given.quaternion_xyzw))
    p = np.array([pose.position for pose in given]).reshape(-1, 3)
    return Poses(p, np.array([pose.quaternion_xyzw for pose in given]).reshape(-1, 4))


def _apart(names: Sequence[str], planes: Floats, sphere: Floats | None) -> list[str]:
    """The fewest fields that leave no position together, as far as dropping one after the other tells."""
    fields = list(dict.fromkeys(names)) + ([] if sphere is None else ["sphere"])

    def contradict(chosen: Sequence[str]) -> bool:
        rows = planes[[name in chosen for name in names]]
        return not _meet(rows, sphere if "sphere" in chosen else None)

    if len(fields) < 2 or not contradict(fields):
        return []
    for name in list(fields):
        rest = [field for field in fields if field != name]
        if rest and contradict(rest):
            fields = rest
    return fields


def _meet(planes: Floats, sphere: Floats | None) -> bool:
    """Whether half spaces (K, 4), with a sphere (4,), have a common point.

    The point of the half spaces nearest to the sphere's centre is that of a least-distance problem, which is
    one of non-negative least squares (Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23).
    """
    if not len(planes):
        return True
    centre = np.zeros(3) if sphere is None else sphere[:3]
    normals, limits = planes[:, :3], planes[:, 3] - planes[:, :3] @ centre - _TOUCH_M
    # The problem in units of the largest distance, where its residual tells empty from far.
    unit = max(float(np.abs(limits).max()), 1e-3)
    table = np.vstack([normals.T, limits / unit])
    target = np.array([0.0, 0.0, 0.0, 1.0])
    multipliers, residual = nnls(table, target)
    if residual < 1e-9:
        return False
    rest = table @ multipliers - target
    nearest = -rest[:3] / rest[3] * unit
    return sphere is None or float(np.linalg.norm(nearest)) <= sphere[3] + _TOUCH_M


def _check(request: GraspConstraints) -> None:
    errors = []
    if request.box_min is not None and request.box_max is not None:
        for axis, low, high in zip("xyz", request.box_min, request.box_max, strict=True):
            if low > high:
                message = f"box_min exceeds box_max along {axis} ({low:g} > {high:g})"
                errors += [("box_min", message), ("box_max", message)]
    for name in ("approach", "closing"):
        axis, angle = getattr(request, name), getattr(request, f"{name}_cone_deg")
        if axis is not None and angle is None:
            errors.append((f"{name}_cone_deg", f"{name} needs it: the half angle of the cone, in degrees"))
        if angle is not None and axis is None:
            errors.append((name, f"{name}_cone_deg needs it: the axis of the cone"))
    if request.sphere is not None and not request.sphere[3] > 0:
        errors.append(("sphere", "its fourth number is the radius and must be positive"))
    vectors = {"sphere": request.sphere, "above_plane": request.above_plane}
    if isinstance(request, BestGraspRequest):
        vectors |= {f"half_spaces.{i}": row for i, row in enumerate(request.half_spaces or ())}
    for name, value in vectors.items():
        if value is None:
            continue
        if name != "sphere" and np.linalg.norm(value[:3]) < 1e-9:
            errors.append((name, "its first three numbers are the normal and must not be zero"))
        if max(abs(x) for x in value) > 1e6:
            errors.append((name, "metres, and at most 1e6: is the unit right?"))
    if request.frame in RESERVED and request.reference is not None:
        message = f"frame={request.frame} is reference={request.frame} by its older name: give one"
        errors += [("frame", message), ("reference", message)]
    elif request.in_world and request.object_pose is None:
        errors.append(("object_pose", "constraints in the world frame need the object's pose in it"))
    if request.object_frame is not None and request.object_pose is None:
        errors.append(("object_pose", "object_frame needs it: the pose that this frame of the object has"))
    if request.object_pose is not None and max(abs(x) for x in request.object_pose[:3]) > 1e6:
        errors.append(("object_pose", "metres, and at most 1e6: is the unit right?"))
    if request.pregrasp_distance_m is not None and request.collision_free is False:
        message = "a free approach and collision_free=false contradict each other"
        errors += [("pregrasp_distance_m", message), ("collision_free", message)]
    errors += _objective(request)
    errors += _cell(request)
    if errors:
        raise _contradiction(errors)


def _cell(request: GraspConstraints) -> list[tuple[str, str]]:
    """What is wrong with what a request says of a robot and a scene."""
    if not isinstance(request, BestGraspRequest):
        return []
    errors = []
    for name in ("robot", "scene", "object_belief"):
        if getattr(request, name) is not None and request.object_pose is None:
            errors.append(("object_pose", f"{name} needs it: the object's pose in the world"))
    for name in ("robot_base_pose", "joints_now", "lift_m"):
        if getattr(request, name) is not None and request.robot is None:
            errors.append(("robot", f"{name} needs it: the id of a stored robot"))
    if request.robot is not None and request.near is not None:
        told = "with a robot the joints choose the twin: leave one of the two out"
        errors += [("near", told), ("robot", told)]
    return errors


def _objective(request: GraspConstraints) -> list[tuple[str, str]]:
    given = [name for name in _NOISE if getattr(request, name) is not None]
    if isinstance(request, BestGraspRequest) and request.object_belief is not None:
        told = "what is believed of the object's pose is averaged over by objective=robust"
        if request.objective != "robust":
            return [("objective", f"{told}: leave objective out")]
        beside = [name for name in ("pose_noise_m", "pose_noise_deg") if getattr(request, name) is not None]
        return [(name, f"{told}: leave the noise out") for name in beside]
    if request.objective == "robust":
        if not any(getattr(request, name) for name in given):
            return [(name, "objective=robust needs noise: one of the four above 0") for name in _NOISE]
        return []
    beside = [*given, *(["robust_of"] if request.robust_of is not None else [])]
    return [(name, f"counts with objective=robust only, not with {request.objective}") for name in beside]


def _contradiction(errors: list[tuple[str, str]]) -> ProblemError:
    return invalid_fields(errors, "The constraints are incomplete or contradict each other")


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)

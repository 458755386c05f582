"""From the constraints a person asks for, in either frame, to a region in the object frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import BestGraspRequest
from graspdb_density import Region, se3
from graspdb_service.problems import ProblemError

Floats = NDArray[np.float64]

_AXES = np.eye(3)


@dataclass(frozen=True, eq=False)
class Constraints:
    """A region in the object frame and what its parts were called in the request.

    Attributes
    ----------
    object_pose
        The object frame in the world frame (position, quaternion), where it was given.
    """

    region: Region
    half_space_names: tuple[str, ...]
    object_pose: tuple[Floats, Floats] | None

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

    def to_world(self, position: Floats, quaternion: Floats) -> tuple[Floats, Floats] | None:
        """A grasp (object frame) in the world frame, where the object's pose is known."""
        if self.object_pose is None:
            return None
        p, q = se3.compose(*self.object_pose, position, quaternion)
        return p, se3.canonical(se3.normalise(q))


def constraints(request: BestGraspRequest, *, jaw_symmetric: bool = True) -> Constraints:
    """Check a request's constraints and bring them to the object frame.

    Boxes become half spaces, for in the object frame they may stand askew.

    Parameters
    ----------
    jaw_symmetric
        Whether the tool's y and its opposite close alike.

    Raises
    ------
    ProblemError
        422 naming the fields that contradict each other.
    """
    _check(request)
    pose = None
    if request.object_pose is not None:
        values = np.array(request.object_pose)
        pose = values[:3], values[3:]
    in_world = pose is not None and request.frame != "object"
    rotation = se3.to_matrix(pose[1]) if in_world and pose is not None else np.eye(3)
    shift = pose[0] if in_world and pose is not None else np.zeros(3)

    names, planes = [], []
    if request.box_min is not None:
        for axis, low in zip(_AXES, request.box_min, strict=True):
            names.append("box_min")
            planes.append((axis, low))
    if request.box_max is not None:
        for axis, high in zip(_AXES, request.box_max, strict=True):
            names.append("box_max")
            planes.append((-axis, -high))
    if request.above_plane is not None:
        normal = np.array(request.above_plane[:3])
        length = float(np.linalg.norm(normal))
        names.append("above_plane")
        planes.append((normal / length, request.above_plane[3] / length))
    # n . (R x + t) >= d is (R^T n) . x >= d - n . t.
    rows = [[*(rotation.T @ normal), d - float(normal @ shift)] for normal, d in planes]
    spheres = None
    if request.sphere is not None:
        centre = rotation.T @ (np.array(request.sphere[:3]) - shift)
        spheres = [[*centre, request.sphere[3]]]
    try:
        region = Region(
            half_spaces=rows or None,
            approach=None if request.approach is None else rotation.T @ np.array(request.approach),
            approach_angle=_radians(request.approach_cone_deg),
            closing=None if request.closing is None else rotation.T @ np.array(request.closing),
            closing_angle=_radians(request.closing_cone_deg),
            spheres=spheres,
            closing_signed=not jaw_symmetric,
        )
    except ValueError as error:
        # What is left to contradict after the checks above are the two cones.
        cones = ("approach_cone_deg", "closing_cone_deg")
        raise _contradiction([(name, str(error)) for name in cones]) from None
    return Constraints(region, tuple(names), pose)


def _check(request: BestGraspRequest) -> None:
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
    if request.above_plane is not None and np.linalg.norm(request.above_plane[:3]) < 1e-9:
        errors.append(("above_plane", "its first three numbers are the normal and must not be zero"))
    for name in ("sphere", "above_plane"):
        value = getattr(request, name)
        if value is not None and max(abs(x) for x in value) > 1e6:
            errors.append((name, "metres, and at most 1e6: is the unit right?"))
    if request.frame == "world" and request.object_pose is None:
        errors.append(("object_pose", "constraints in the world frame need the object's pose in it"))
    if request.object_pose is not None and max(abs(x) for x in request.object_pose[:3]) > 1e6:
        errors.append(("object_pose", "metres, and at most 1e6: is the unit right?"))
    if errors:
        raise _contradiction(errors)


def _contradiction(errors: list[tuple[str, str]]) -> ProblemError:
    return ProblemError(
        422, "invalid-request", "The constraints are incomplete or contradict each other", errors=errors
    )


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)

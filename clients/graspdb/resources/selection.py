"""What questions have in common: which trials they are about, and what a best grasp has to fulfil.

Methods take these as keywords, ``**selection: Unpack[Selection]``: editors complete them, type checkers check
them, and a name that is none of them is a TypeError.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from graspdb import wire
from graspdb.poses import as_poses, as_vector7
from graspdb.resources.pages import checked

__all__ = ["Constraints", "Kernel", "Selection", "TrialSelection", "best_grasp_request", "query", "taken"]

Kernel = wire.KernelSpec | Mapping[str, Any] | str


class TrialSelection(TypedDict, total=False):
    """Which trials a question is about.

    Parameters
    ----------
    gripper, protocol, source
        Only trials of these; the first two are needed where an object's trials have several. A trial that
        names no gripper or protocol fits every selection.
    """

    gripper: str | None
    protocol: str | None
    source: str | None


class Selection(TrialSelection, total=False):
    """Which trials a density is built from (:class:`TrialSelection`), and with which kernel.

    Parameters
    ----------
    kernel
        ``isotropic`` (the default), ``anisotropic`` (the newest one fitted for this object and gripper), a
        stored kernel's id, or a mapping ``{"kind": "isotropic", "sigma_position_m": ..., "cutoff": ...}``.
    sigma_position_m, sigma_rotation_deg
        Widths of the isotropic kernel, standard deviations per axis; by default chosen from the trials.
    """

    kernel: Kernel | None
    sigma_position_m: float | None
    sigma_rotation_deg: float | None


class Constraints(Selection, total=False):
    """What a best grasp is chosen by, besides the :class:`Selection`.

    All constraints are in ``frame``: the world's if ``object_pose`` is given, else the object's.

    Parameters
    ----------
    objective
        ``density`` (the default), ``success_probability`` (ranks by the lower end of its interval), or
        ``robust``: the mean success probability, or density (``robust_of``), under noise.
    pose_noise_m, pose_noise_deg, tool_noise_m, tool_noise_deg
        That noise, deviations per axis: of the object's pose about its bounding box's centre (acts on the
        left), and of the tool's (acts on the right).
    box
        Lower and upper corner (3,) of where the tool's origin may be, metres.
    sphere
        ``x, y, z, r``: the tool's origin is within ``r`` metres of the centre.
    above_plane
        ``nx, ny, nz, d``: n.x >= d at the tool's origin.
    half_spaces
        More such rows (K, 4).
    approach, approach_cone_deg
        Direction (3,) of the tool's z axis, and the half angle of the cone about it.
    closing, closing_cone_deg
        The same for the tool's y axis, in which the fingers close.
    collision_free
        That the gripper does not touch the object before it closes; true where it can be known.
    obstacles
        ``boxes`` (each ``size_m`` and a pose), ``points`` (K, 3) and their ``point_radius_m``: what the open
        gripper must not touch either.
    pregrasp_distance_m
        The straight approach is free from this far back.
    max_width_m
        How far apart the fingers are at most, once both touch the object.
    candidates
        Rank these poses, (N, 4, 4) or (N, 7), as they are; ``grasp.candidate`` is the place in them.
    exclude
        Poses to stay away from, by the separation.
    object_pose
        The object in the world: (4, 4) or ``x y z qx qy qz qw``.
    min_separation_m, min_separation_deg
        How far apart two grasps are, in either, to count as distinct.
    include
        Scores to compute, as in `GraspObject.likelihood`. By default the success
        probability comes along where the objective needs it or there are at most 500,000 attempts.
    prior
        Whether an object with geometry and no success yet may answer from its edges; such grasps have
        ``grasp.prior``. By default it does where a gripper is known; True says what is missing where it
        can't.
    """

    objective: str | None
    robust_of: str | None
    pose_noise_m: float | None
    pose_noise_deg: float | None
    tool_noise_m: float | None
    tool_noise_deg: float | None
    box: tuple[ArrayLike, ArrayLike] | None
    sphere: ArrayLike | None
    above_plane: ArrayLike | None
    half_spaces: ArrayLike | None
    approach: ArrayLike | None
    approach_cone_deg: float | None
    closing: ArrayLike | None
    closing_cone_deg: float | None
    collision_free: bool | None
    obstacles: wire.Obstacles | Mapping[str, Any] | None
    pregrasp_distance_m: float | None
    max_width_m: float | None
    candidates: ArrayLike | Any | None
    exclude: ArrayLike | Any | None
    object_pose: ArrayLike | Any | None
    frame: str | None
    include: Sequence[str] | None
    min_separation_m: float | None
    min_separation_deg: float | None
    prior: bool | None


def taken(kind: type[Any], given: Mapping[str, Any], method: str) -> dict[str, Any]:
    """Keywords that a method was given, all of which ``kind``, a TypedDict, must name.

    Raises
    ------
    TypeError
        Naming the first that it does not.
    """
    known: frozenset[str] = kind.__optional_keys__
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            meant = f"; did you mean {near[0]!r}?" if near else f"; there are {', '.join(sorted(known))}"
            raise TypeError(f"{method}() got an unexpected keyword argument {name!r}{meant}")
    return dict(given)


def query(selection: Mapping[str, Any]) -> dict[str, Any]:
    """A selection as a query string takes it: the kernel a name, its widths beside it.

    Raises
    ------
    InvalidInput
        For a kernel that is none.
    ValueError
        For widths given twice, or a cut-off, which only questions about poses take.
    """
    fields = dict(selection)
    if fields.get("kernel") is None or isinstance(fields["kernel"], str):
        return fields
    kernel = fields.pop("kernel")
    spec = checked(wire.KernelSpec, kernel) if isinstance(kernel, Mapping) else kernel
    if spec.cutoff is not None:
        raise ValueError("a cutoff is for questions about poses: leave it out of the kernel here")
    for name in ("sigma_position_m", "sigma_rotation_deg"):
        value = getattr(spec, name)
        if value is not None and fields.get(name) is not None:
            raise ValueError(f"{name} is given twice: in the kernel and beside it")
        fields[name] = fields.get(name) if value is None else value
    return fields | {"kernel": spec.kind}


def best_grasp_request(count: int, given: Mapping[str, Any]) -> wire.BestGraspRequest:
    """The request for ``count`` grasps within :class:`Constraints`.

    Raises
    ------
    InvalidInput, ValueError
        Naming every wrong field.
    """
    fields = {**given, "count": count}
    box = fields.pop("box", None)
    if box is not None:
        if len(box) != 2:
            raise ValueError("box is a pair: its lower and its upper corner, each x, y, z")
        fields["box_min"] = numbers("box's lower corner", box[0], 3, "x, y, z")
        fields["box_max"] = numbers("box's upper corner", box[1], 3, "x, y, z")
    for name, what in (
        ("sphere", "x, y, z, r"),
        ("above_plane", "nx, ny, nz, d"),
        ("approach", "x, y, z"),
        ("closing", "x, y, z"),
    ):
        fields[name] = numbers(name, fields.get(name), what.count(",") + 1, what)
    fields["half_spaces"] = _rows("half_spaces", fields.get("half_spaces"), 4, "nx, ny, nz, d")
    fields["obstacles"] = _obstacles(fields.get("obstacles"))
    for name in ("candidates", "exclude"):
        fields[name] = _pose_columns(fields.get(name))
    if fields.get("object_pose") is not None:
        fields["object_pose"] = as_vector7(fields["object_pose"])
    if fields.get("include") is not None:
        fields["include"] = named(fields["include"])
    return checked(wire.BestGraspRequest, fields)


def named(names: Sequence[str] | str) -> list[str]:
    """Names as a list; one may stand alone."""
    return [names] if isinstance(names, str) else list(names)


def numbers(name: str, values: ArrayLike | None, count: int, what: str) -> list[float] | None:
    """A vector as JSON.

    Raises
    ------
    ValueError
        For another shape.
    """
    if values is None:
        return None
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (count,):
        raise ValueError(f"{name} has shape {array.shape}; expected {count} numbers: {what}")
    listed: list[float] = array.tolist()
    return listed


def _rows(name: str, values: ArrayLike | None, count: int, what: str) -> list[list[float]] | None:
    if values is None:
        return None
    array = np.asarray(values, dtype=np.float64)
    array = array[None] if array.ndim == 1 and array.size else array
    if array.size and (array.ndim != 2 or array.shape[1] != count):
        raise ValueError(f"{name} has shape {array.shape}; expected rows of {count} numbers: {what}")
    rows: list[list[float]] = array.reshape(-1, count).tolist()
    return rows


def _pose_columns(poses: ArrayLike | Any | None) -> dict[str, Any] | None:
    if poses is None:
        return None
    position, quaternion = as_poses(poses)
    return {"position": position.tolist(), "quaternion_xyzw": quaternion.tolist()}


def _obstacles(obstacles: wire.Obstacles | Mapping[str, Any] | None) -> Any:
    """Points may be an array."""
    if obstacles is None or isinstance(obstacles, wire.Obstacles):
        return obstacles
    points = {"points": _rows("points", obstacles["points"], 3, "x, y, z")} if "points" in obstacles else {}
    return {**obstacles, **points}

"""How far open the jaw has to be: what fingers close on, also where their tips move on arcs, and pre-shaping.

A finger whose tip moves on an arc is ahead of where it was wide open once the jaw has closed. So it may meet
what it could not reach, and the volume that it sweeps is a stack of boxes, one an opening, each narrower and
reaching farther.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from graspdb_geometry.collision import TOUCH_TOLERANCE_M, Scene, Surface
from graspdb_geometry.grippers import PALM, GripperShape
from graspdb_geometry.poses import PoseArrays, ToolPoses, checked

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Values = TypeVar("Values", FloatArray, BoolArray)

#: Openings that are commanded are whole steps of this, rounded up.
STEP_M = 1e-3
#: Openings are looked for in steps of this.
_SEARCH_M = 5e-3

Solid = Scene | Surface


def holds(solid: Solid, poses: PoseArrays, shape: GripperShape, threads: int = 1) -> BoolArray:
    """Whether the open gripper is free and its fingers will meet something in closing, (n,)."""
    held = solid.holds(poses, shape, threads=threads)
    if not shape.tip_offsets:
        return held
    poses = ToolPoses(*checked(poses))
    rows = np.flatnonzero(~held)
    rows = rows[~solid.collides(_of(poses, rows), shape, threads=threads)]
    for opening, _ in reversed(shape.tip_offsets):
        if not len(rows):
            break
        between = solid.extents(_of(poses, rows), _inside(shape.column(opening)), threads)
        met = ~np.isnan(between[:, 0])
        held[rows[met]] = True
        rows = rows[~met]
    return held


def widths(solid: Solid, poses: PoseArrays, shape: GripperShape, threads: int = 1) -> FloatArray:
    """How far apart the fingers are once both touch the object, metres, (n,); NaN where the open gripper
    collides, or meets nothing.

    A free object is centred as they close: that is its extent along y between the fingers as they are then.
    """
    if not shape.tip_offsets:
        return solid.widths(poses, shape, threads)
    poses = ToolPoses(*checked(poses))
    found = np.full(len(np.asarray(poses.positions)), np.nan)
    rows = np.flatnonzero(~solid.collides(poses, shape, threads=threads))
    wider = shape.max_opening_m
    openings = [opening for opening, _ in reversed(shape.tip_offsets)]
    for opening, below in zip([shape.max_opening_m, *openings], [*openings, 0.0], strict=True):
        if not len(rows):
            break
        # As far ahead as the tips are at this opening, as wide as they came from.
        half, centre = _inside(shape.column(opening))
        half[1] = wider / 2
        between = np.diff(solid.extents(_of(poses, rows), (half, centre), threads))[:, 0]
        with np.errstate(invalid="ignore"):
            met = between >= below
        found[rows[met]] = np.minimum(between[met], wider)
        rows, wider = rows[~met], opening
    return found


def needed(solid: Solid, poses: PoseArrays, shape: GripperShape, threads: int = 1) -> FloatArray:
    """How far open the jaw must be to come to each pose with something between its fingers, metres, (n,).

    Where the open gripper is free that is twice what lies farthest from the middle of what is between its
    fingers. Elsewhere the same at the least opening at which it is free with something between them, found
    where it has 5 mm to spare. NaN where there is none.
    """
    poses = ToolPoses(*checked(poses))
    found = np.full(len(np.asarray(poses.positions)), np.nan)
    rows = np.flatnonzero(~np.isnan(solid.extents(poses, _inside(shape.swept()), threads)[:, 0]))
    halves, centres = shape.boxes()
    palm = _inside((halves[PALM], centres[PALM]))
    rows = rows[np.isnan(solid.extents(_of(poses, rows), palm, threads)[:, 0])]
    for opening in [shape.max_opening_m, *np.arange(_SEARCH_M, shape.max_opening_m, _SEARCH_M)]:
        if not len(rows):
            break
        jaw = shape.at(float(opening))
        free = rows[~solid.collides(_of(poses, rows), jaw, threads=threads)]
        full = free[~np.isnan(solid.extents(_of(poses, free), _inside(jaw.column()), threads)[:, 0])]
        found[full] = jaw.max_opening_m
        rows = np.setdiff1d(rows, full)
    known = np.flatnonzero(~np.isnan(found))
    found[known] = _closer(solid, _of(poses, known), shape, found[known], threads)
    return found


def _closer(
    solid: Solid, poses: ToolPoses, shape: GripperShape, openings: FloatArray, threads: int
) -> FloatArray:
    """Openings (n,) at which the jaw is free, reduced to what is between its fingers there."""

    def reach(jaw: GripperShape, some: ToolPoses) -> FloatArray:
        between = np.abs(solid.extents(some, _inside(jaw.column()), threads)).max(axis=1)
        return np.asarray(np.minimum(2.0 * between, jaw.max_opening_m), dtype=np.float64)

    closer = at_each(openings, poses, shape, reach)
    if not shape.tip_offsets:
        # The fingers come in where nothing was, and were free before where they leave.
        return closer
    # Tips that are farther ahead then may meet what they did not: from there on the jaw opens again, by
    # halves of what is left up to where it is known to be free.
    lower, upper = np.minimum(_whole_steps(closer), openings), openings.copy()

    def clear(rows: npt.NDArray[np.intp], at: FloatArray) -> BoolArray:
        some = _of(poses, rows)
        return ~at_each(at, some, shape, lambda jaw, own: solid.collides(own, jaw, threads=threads))

    rows = np.arange(len(upper))
    free = clear(rows, lower)
    upper[free], rows = lower[free], rows[~free]
    while len(rows := rows[upper[rows] - lower[rows] > 1.5 * STEP_M]):
        middle = _whole_steps((lower[rows] + upper[rows]) / 2)
        free = clear(rows, middle)
        upper[rows[free]], lower[rows[~free]] = middle[free], middle[~free]
    return upper


def commanded(needed_m: FloatArray, clearance_m: float, shape: GripperShape) -> FloatArray:
    """What to open to, metres, (n,): what is needed and a clearance, in whole millimetres; wide for NaN."""
    opening = _whole_steps(needed_m + clearance_m)
    return np.where(np.isnan(opening), shape.max_opening_m, np.minimum(opening, shape.max_opening_m))


def at_each(
    openings: FloatArray,
    poses: PoseArrays,
    shape: GripperShape,
    tested: Callable[[GripperShape, ToolPoses], Values],
) -> Values:
    """What a test tells of every pose (n,) with the jaw at its opening (n,)."""
    poses = ToolPoses(*checked(poses))
    distinct, which = np.unique(openings, return_inverse=True)
    if not len(distinct):
        return tested(shape, poses)
    values = [tested(shape.at(opening), _of(poses, which == i)) for i, opening in enumerate(distinct)]
    told = np.empty(len(openings), dtype=values[0].dtype)
    for i, value in enumerate(values):
        told[which == i] = value
    return told


def _whole_steps(openings: FloatArray) -> FloatArray:
    """Rounded up, but not by what floating point adds: 19 mm, the middle of 18 and 20, are 19 steps. Halving
    would never end where they were 20.
    """
    return np.asarray(np.ceil(openings / STEP_M - 1e-6) * STEP_M)


def _inside(box: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """A box (half extents, centre) that what only touches it along x or z is outside of."""
    half, centre = box
    return np.maximum(half - np.array([1.0, 0.0, 1.0]) * TOUCH_TOLERANCE_M, 0.0), centre


def _of(poses: ToolPoses, rows: npt.NDArray[np.intp] | BoolArray) -> ToolPoses:
    p, q = np.asarray(poses.positions), np.asarray(poses.quaternions_xyzw)
    return ToolPoses(p[rows], q[rows])

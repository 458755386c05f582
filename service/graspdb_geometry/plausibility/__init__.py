"""Whether poses can be grasps of an object: how far off they lie, what the gripper meets, whose convention
they follow."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graspdb_geometry.plausibility import conventions
from graspdb_geometry.plausibility.doubt import Doubt, Target
from graspdb_geometry.plausibility.meetings import TOLERANCE_M, meetings
from graspdb_geometry.poses import PoseArrays, ToolPoses, checked

__all__ = ["TOLERANCE_M", "Doubt", "Target", "doubts"]


def doubts(poses: PoseArrays, held: npt.ArrayLike, target: Target | None) -> list[Doubt]:
    """What is doubtful about grasps of one gripper.

    Parameters
    ----------
    poses : (n)
        Of the tool in the object frame.
    held : (n,) bool
        Which of them succeeded.
    target : Target or None
        The object and gripper, where either is known.

    Returns
    -------
    list of Doubt
        A unit or convention that they look like instead first, then single poses. Codes:
        ``looks-like-millimetres``, ``looks-like-centimetres``, ``looks-like-wxyz``,
        ``another-approach-axis``, ``another-closing-axis``, ``implausible-poses`` (beyond
        `Target.limit_m`), ``out-of-reach``, ``approaches-away``, ``collides``,
        ``closes-on-nothing``; without a target ``far-from-the-rest``.

    Raises
    ------
    ValueError
        As :func:`graspdb_geometry.poses.checked`.
    """
    positions, quaternions = checked(poses)
    tools = ToolPoses(positions, quaternions)
    found = [conventions.unit(positions, target)]
    if found == [None]:
        # In another unit every direction is off as well: nothing to be told from them.
        found.append(conventions.rotations(tools, np.flatnonzero(held), target))
        if target is None:
            found.append(conventions.stragglers(positions))
    single = [] if target is None else meetings(tools, target)
    return [doubt for doubt in found if doubt is not None] + single
